"""The only writer of results: one labelled DataTree from the answer of any method."""

from __future__ import annotations

import json
from collections.abc import Sequence
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from probcal.gaussian.draws import many_data, residuals
from probcal.gaussian.mode import Point
from probcal.labels import AXES, START
from probcal.lazy import xr
from probcal.model.motions import level_values
from probcal.modes.explore import NEAR, SAME
from probcal.results.accessor import register
from probcal.results.answer import Answer, Draws, Tracks
from probcal.results.groups import (
    along,
    bias_coords,
    by_target,
    constant_group,
    datum_of,
    direction_group,
    gather,
    track_groups,
)
from probcal.results.modes import AGAIN, ELSEWHERE, LEAST, PART, REJECTED, REPORTED, ModeRow, mode_group, same_as
from probcal.results.schema import BOUND, EVIDENCE, INTERVAL, RESULTS_VERSION
from probcal.table import first_date

if TYPE_CHECKING:
    from probcal.problem import Problem

SHARP = 256  # steps to which the spread of a log-likelihood over the draws is rounded, so that its file is small
AT_ONCE = 10_000  # data that are rounded at once
COARSE = 64  # the same of residuals by noise and of tracks by their sd, in the file of a large fit
SAMPLE = ("chain", "draw")


def build(answer: Answer, directions: Sequence[Any], key: jax.Array, keep: tuple[str, ...]) -> xr.DataTree:
    """Assemble the DataTree of a fit (groups posterior, calibration, track, observed_data, ...).

    `directions` are those that the data leave open; `keep` names the draws that the tree holds beside those of the
    biases, made with `key`.
    """
    problem, posterior = answer.problem, answer.posterior
    draws = posterior.draws(key, keep)
    before = posterior.before
    tracks, zero = posterior.tracks(), [np.asarray(states) for states in before.states]
    large = many_data(problem.model)  # no log-likelihood by datum, and nothing finer than noise or sd tell
    if large:
        zero = [_stepped(states, own.sd, COARSE) for states, own in zip(zero, tracks, strict=True)]
        tracks = [Tracks(*(_stepped(values, own.sd, COARSE) for values in own)) for own in tracks]
    groups = {
        "posterior": _posterior_group(answer, draws),
        "calibration": _calibration_group(answer),
        **_mode_groups(answer),
        **track_groups(problem, tracks, zero, draws.states, _sample(draws) if len(draws.states) else None),
        "constant_data": constant_group(problem, posterior.point),
        **_data_groups(answer, draws, before, large),
    }
    if answer.trace is not None:
        dims = ("iteration", "bias_label")
        steps = {} if answer.steps is None else {"bias": (dims, answer.steps * problem.scales)}
        steps |= {} if answer.precisions is None else {"precision": (dims, answer.precisions)}
        coords = {"bias_label": list(problem.labels)} if steps else {}
        groups["optimisation"] = xr.Dataset({"objective": ("iteration", answer.trace), **steps}, coords=coords)
    if posterior.stats:
        groups["sample_stats"] = xr.Dataset(along(SAMPLE, posterior.stats), coords=_sample(draws))
    if large and len(draws.log_likelihood):
        summed = sum(np.asarray(part).sum((2, 3)) for part in draws.log_likelihood)
        where = {"chain": np.arange(draws.z.shape[0]), "draw": draws.kept}
        groups["log_likelihood_sum"] = xr.Dataset({"y": (SAMPLE, summed)}, coords=where)
    if (log_prior := posterior.log_prior(draws)) is not None:
        coords = {**_sample(draws), "bias_label": list(problem.labels)}
        groups["log_prior"] = xr.Dataset({"bias": ((*SAMPLE, "bias_label"), log_prior)}, coords=coords)
    if problem.levels:
        groups["level"] = xr.Dataset(
            {
                "std": ("level", level_values(problem.levels, posterior.summary.levels)),
                "guess": ("level", [level.guess for level in problem.levels]),
            },
            coords={"level": [level.label for level in problem.levels]},
        )
    if directions:
        groups["direction"] = direction_group(problem.labels, directions)
    for group in groups.values():
        group.attrs.update(inference_library="probcal", inference_library_version=version("probcal"))
    register()
    tree = xr.DataTree.from_dict(groups)
    tree.attrs.update(_attrs(answer))
    return tree


def _sample(draws: Draws) -> dict[str, Any]:
    chains, count = draws.z.shape[:2]
    return {"chain": np.arange(chains), "draw": np.arange(count)}


def _posterior_group(answer: Answer, draws: Draws) -> xr.Dataset:
    """Draws of the biases, and of what else varies with them."""
    problem = answer.problem
    values = {"bias": ((*SAMPLE, "bias_label"), draws.z * problem.scales)}
    further: dict[str, Any] = {}
    for name, (dims, drawn, *own) in answer.posterior.variables.items():
        values[name] = ((*SAMPLE, *dims), drawn)
        further |= own[0] if own else {}
    return xr.Dataset(values, coords={**_sample(draws), **further, **bias_coords(problem)})


def _calibration_group(answer: Answer) -> xr.Dataset:
    """One entry a bias, in its unit; covariance, information of the data, and couplings of the prior."""
    problem, found = answer.problem, answer.posterior.summary
    scales, labels = problem.scales, list(problem.labels)
    columns = {
        "mean": found.mean * scales, "sd": found.sd * scales, "lower": found.lower * scales,
        "upper": found.upper * scales, "gamma": found.gamma, "precision": found.precision, "scale": scales,
        "status": np.array(answer.bias_status, str), "pull": answer.posterior.pull,
        "kind": np.array([b.kind for b in problem.biases], str), **found.columns,
    }  # fmt: skip
    at = np.asarray(answer.posterior.point.z)
    if not np.allclose(at, found.mean, rtol=0.0, atol=1e-9, equal_nan=True):  # of chains on several sides
        columns["point"] = at * scales
    known = answer.posterior.expansion.information() if found.information is None else found.information
    matrices = {} if known is None else {"information": known}  # too many biases for it else
    if answer.prior.correlation:
        columns |= {"correlation": np.zeros(len(labels)), "correlated_with": np.array(labels, object)}
        for members, value in answer.prior.correlated(labels, problem.surveyed):
            columns["correlation"][members], columns["correlated_with"][members] = value, labels[members[0]]
    values = along("bias_label", columns)
    values |= found.covariance.columns(scales)
    values |= along(("bias_label", "bias_label_other"), matrices)
    coords = bias_coords(problem) | ({"bias_label_other": labels} if matrices else {})
    return xr.Dataset(values, coords=coords)


def _data_groups(answer: Answer, draws: Draws, before: Point, large: bool) -> dict[str, xr.Dataset]:
    """The data, what is left of them without and with calibration, and what the draws say of each, unless `large`."""
    problem = answer.problem
    datum, picks = datum_of(problem)
    coords = datum["coords"]
    old, new = residuals(problem.model, before), residuals(problem.model, answer.posterior.point)
    parts = {"before": old.innovation, "after": new.innovation, "std": new.std, "weight": new.reliance}
    left = {name: gather([np.asarray(part) for part in own], picks) for name, own in parts.items()}
    if large:
        left |= {name: _stepped(left[name], left["std"], COARSE) for name in ("before", "after")}
    residual = along("datum", left)
    groups = {
        "observed_data": xr.Dataset({"y": ("datum", datum["y"])}, coords=coords),
        "residual": xr.Dataset(residual, coords=coords),
    }
    kept = {"chain": np.arange(draws.z.shape[0]), "draw": draws.kept, **coords}
    for name, own in (("log_likelihood", draws.log_likelihood), ("posterior_predictive", draws.replicas)):
        if len(own) and not (large and name == "log_likelihood"):
            values = gather(own, picks)
            rounded = _rounded(values) if name == "log_likelihood" else values
            groups[name] = xr.Dataset({"y": ((*SAMPLE, "datum"), rounded)}, coords=kept)
    return groups


def _attrs(answer: Answer) -> dict[str, Any]:
    """The attributes of a tree: the request, the method that ran, and the status."""
    found = answer.posterior.summary
    stated = found.precisions == "given" and answer.prior.hierarchical  # it governs no bias
    intervals = (answer.prior.note if found.kind == "Laplace" else "") or answer.method.note(answer.prior)
    intervals = "Laplace: every bias has a survey, so that no precision is estimated" if stated else intervals
    if found.kind == "Laplace" and answer.problem.model.tailed:
        intervals += "; each epoch's precision of the heavy-tailed process noise is held at its mean"
    if count := len(answer.posterior.parts):
        intervals = f"a mixture of {count} answers, each: {intervals}"
    # the date of time 0; nothing where times are no dates
    date = first_date(answer.problem.measurements.table)
    attrs = {
        "method": answer.method.name, "requested": answer.requested.name,
        "prior": answer.prior.title(answer.problem.biases),
        "approximate": found.kind, "precisions": found.precisions, "correlated": int(bool(answer.prior.correlation)),
        "intervals": intervals,
        "settings": f"{answer.method!r}, {answer.prior!r}", "interval_probability": INTERVAL,
        "results_version": RESULTS_VERSION, "motion": answer.motion, "interrupted": int(answer.interrupted),
        "assessed": 0,
        "status": str(answer.status), "message": answer.message, "data": answer.problem.measurements.table.source,
        "versions": json.dumps({name: version(name) for name in ("probcal", "jax", "arviz", "numpy", "xarray")}),
        **answer.posterior.attrs, **_epoch(answer.problem), **({"time_origin": date} if date else {}),
        **({"places": "integrated"} if answer.problem.tilted else {}),
    }  # fmt: skip
    if found.evidence is not None:
        tailed = answer.problem.model.tailed
        attrs[BOUND if tailed else EVIDENCE[found.precisions]] = found.evidence
    return attrs


def _rounded(log_likelihood: np.ndarray) -> np.ndarray:
    """Values (chain, draw, datum), rounded in place to 1/256 of their spread over the draws of a datum.

    What is rounded away is noise, and the rest compresses to a byte and a half a value.
    """
    for start in range(0, log_likelihood.shape[2], AT_ONCE):
        part = log_likelihood[:, :, start : start + AT_ONCE]
        with np.errstate(invalid="ignore"):  # a row of probability zero
            spread = part.std((0, 1))
        log_likelihood[:, :, start : start + AT_ONCE] = _stepped(part, spread, SHARP)
    return log_likelihood


def _stepped(values: np.ndarray, spread: np.ndarray, steps: int) -> np.ndarray:
    """Values (..., n) rounded to a part of their spread (..., n), a power of two; as they are where it is too small."""
    sure = np.isfinite(spread) & (spread > 1e-9)
    step = np.exp2(np.floor(np.log2(np.where(sure, spread, 1.0) / steps)))
    return np.where(sure, np.rint(values / step) * step, values)


def build_tracks(problem: Problem, tracks: Sequence[Tracks], before: Sequence[Any]) -> xr.DataTree:
    """A tree of tracks alone, for data to which a calibration was applied."""
    register()
    tree = xr.DataTree.from_dict(track_groups(problem, tracks, before))
    tree.attrs["data"] = problem.measurements.table.source
    tree.attrs.update(_epoch(problem))
    return tree


def _epoch(problem: Problem) -> dict[str, float]:
    """Length of common epochs in s and the largest shift of a row to one; nothing where rows keep their times."""
    return {} if problem.epoch is None else {"epoch": problem.epoch, "epoch_shift": problem.epoch_shift}


def modes_of(answer: Answer) -> tuple[list[ModeRow], list[Sequence[Any]]]:
    """All answers of a fit and their states (E, n), the reported one first, then others by gain.

    The tree has what an `Answer` carries besides its own posterior by this function alone.
    """
    scales, posterior, optima = answer.problem.scales, answer.posterior, dict(enumerate(answer.optima))
    mean, sd = (own * scales for own in posterior.here)
    sd = np.maximum(sd, LEAST * scales)

    def started(point: Point) -> dict[str, Any]:
        """Start, status and objective of the answer of a start, each once; nothing of another answer."""
        k = next((k for k, one in optima.items() if one.posterior.point is point), None)
        return {} if k is None else _of_start(k, optima.pop(k))

    known = {"status": str(answer.status)} | started(posterior.point)
    modes = [ModeRow(REPORTED, REPORTED, mean, 0.0, **known)]
    states = [posterior.states if posterior.side is None else posterior.point.states]
    for other in sorted(answer.mirrors, key=lambda other: -other.gain):
        known = {"status": other.status} | started(other.point)
        modes.append(ModeRow(other.name, other.kind, mean + other.shift * scales, other.gain, **known))
        states.append(other.point.states)
    for own in posterior.parts:
        modes.append(ModeRow(own.name, PART, own.shift * scales, own.gain, own.status))
        states.append(own.point.states)
    for k, one in sorted(optima.items(), key=lambda item: -item[1].objective):
        bias = one.posterior.here[0] * scales
        gain = one.objective - answer.objective if one.method == answer.method else np.nan
        kind = START if one.status.settled and gain > -NEAR else REJECTED
        kind = kind if same_as(bias, modes, sd) is None else AGAIN
        modes.append(ModeRow(ELSEWHERE, kind, bias, gain, **_of_start(k, one)))
        states.append(one.posterior.states)
    return modes, states


def _of_start(k: int, answer: Answer) -> dict[str, Any]:
    return {"start": k, "status": str(answer.status), "objective": answer.objective}


def _mode_groups(answer: Answer) -> dict[str, xr.Dataset]:
    """The group `mode`, and the places of the tracks in each where there are several."""
    problem, found = answer.problem, answer.posterior.summary
    modes, states = modes_of(answer)
    name = BOUND if problem.model.tailed else EVIDENCE.get(found.precisions, "")
    known = found.evidence is not None and found.precisions != "integrated"
    attrs = {"same": SAME, "objective": name if known and name else "objective"}
    groups = {"mode": mode_group(modes, answer.posterior.here[1] * problem.scales, bias_coords(problem), attrs)}
    if len(modes) > 1:
        places = [np.stack(own) for own in zip(*map(problem.positions, states), strict=True)]
        axes = {"axis": list(AXES[: problem.network.dimension])}
        tracks = by_target(problem, {"position": (("mode", "time", "axis"), places)}, axes)
        groups |= {f"mode/track/{name}": own for name, own in tracks.items()}
    return groups
