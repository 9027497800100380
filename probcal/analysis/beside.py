"""Answers beside the one reported, on the other side of a mirror: what they say of a fit, and of each bias."""

from collections.abc import Callable, Sequence

import numpy as np
import xarray as xr

from probcal.analysis.findings import Finding
from probcal.inference import residuals
from probcal.inference.fitted import Judged
from probcal.labels import PIECE, SCENE
from probcal.modes.clocks import EXPLAINED, turning_time
from probcal.modes.reflections import touched
from probcal.results.modes import alike, rivals
from probcal.results.read import each_track, saved_by_epoch
from probcal.results.schema import DIFFERENT


def mirror_findings(tree: xr.DataTree) -> list[Finding]:
    """One for each answer that fits about as well."""
    group = rivals(tree)
    pairs = zip(group["mode"].values, group["gain"].values, strict=True)
    return [Finding("mirror", "fit", f"{name}: an answer {abs(gain):.1f} nats apart") for name, gain in pairs]


def mirror_doubts(
    fit: Judged, tree: xr.DataTree, variances: Callable[[], Sequence[np.ndarray]] | None = None
) -> dict[int, str]:
    """How far each bias is another one in an answer on the other side of a mirror that fits as well.

    All of them where a target touches the mirror of a scene or a piece, since it may then go on at either side.
    `variances` are those (E, n) of the states of each recursion on this side of it, by default those of the saved
    tracks.
    """
    found, group = dict[int, str](), alike(tree)
    for name, away in zip(group["mode"].values, group["apart"].values, strict=True):
        for m in np.flatnonzero(away > DIFFERENT):
            found.setdefault(int(m), f"it is {away[m]:.1f} sd away in an answer that fits as well: {name}")
    if {SCENE, PIECE} & set(group["kind"].values.tolist()):
        near, where = touched(fit.problem, fit.point, variances() if variances else _saved(fit, tree))
        if near < DIFFERENT:
            every = dict.fromkeys(range(fit.problem.model.biases), f"{where}, which hides on which side it goes on")
            return every | found
    return found


def _saved(fit: Judged, tree: xr.DataTree) -> list[np.ndarray]:
    """Variances (E, n) of the states of each recursion from the saved tracks."""
    tracked = dict(each_track(tree))
    return [saved_by_epoch(epochs, tracked, "sd", "targets") ** 2 for epochs in fit.problem.epochs]


def lag_doubts(fit: Judged, found: residuals.Filtered) -> dict[int, str]:
    """Why clocks are in doubt whose rows the fit explains badly: another lag may explain them.

    The slope tells of lags within the reach of the search alone, however much sds are widened.
    """
    mean, timed = found.innovations.spread(slice(None)), fit.problem.timed
    if not timed or mean < EXPLAINED:
        return {}
    reach = turning_time(fit.problem, fit.point)
    said = f"a lag more than {reach:.2g} s away may explain innovations of mean square {mean:.2g}"
    return {m: said for m, label in enumerate(fit.problem.labels) if label in timed}
