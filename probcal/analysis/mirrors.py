"""Answers beside the one reported, on the other side of a mirror: what they say of a fit, and of each bias."""

import numpy as np

from probcal.analysis.check import Case, Checked, check
from probcal.analysis.findings import Finding
from probcal.labels import PIECE, SCENE
from probcal.modes.reflections import touched
from probcal.results.modes import alike, rivals
from probcal.results.read import each_track, saved_by_epoch
from probcal.results.schema import DIFFERENT


@check()
def check_mirrors(case: Case) -> Checked:
    """A finding for each answer that fits about as well, and how far each bias is another one there.

    All biases are in doubt where a target touches the mirror of a scene or a piece, since it may then go on at either
    side.
    """
    fit, found, every, group = case.fit, dict[int, str](), rivals(case.tree), alike(case.tree)
    pairs = zip(every["mode"].values, every["gain"].values, strict=True)
    text = "another answer fits about as well ({:.1f} nats apart): {}: declare what tells them apart"
    told = [Finding("mirror", "fit", text.format(abs(gain), name)) for name, gain in pairs]
    for name, away in zip(group["mode"].values, group["apart"].values, strict=True):
        for m in np.flatnonzero(away > DIFFERENT).tolist():
            found.setdefault(m, f"it is {away[m]:.1f} sd away in an answer that fits as well: {name}")
    if {SCENE, PIECE} & set(group["kind"].values.tolist()):
        near, where = touched(fit.problem, fit.point, _variances(case))
        if near < DIFFERENT:
            text = f"{where}, which hides on which side it goes on"
            found = dict.fromkeys(range(fit.problem.model.biases), text) | found
    return Checked(findings=told, doubts={"weak": found})


def _variances(case: Case) -> list[np.ndarray]:
    """Variances (E, n) of the states on this side; draws of chains lie on both.

    By the saved tracks of a large fit.
    """
    if case.fit.whole:
        return case.fit.expansion.followed(case.fit.root)
    tracked = dict(each_track(case.tree))
    return [saved_by_epoch(epochs, tracked, "sd", "targets") ** 2 for epochs in case.fit.problem.epochs]
