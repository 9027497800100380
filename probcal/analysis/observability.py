"""What the data of a problem can and cannot determine: information of all biases, trajectories marginalised."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np
import xarray as xr

from probcal.analysis.standpoint import check_free, standpoint
from probcal.analysis.verdict import narrowed
from probcal.errors import InputError
from probcal.gaussian.cholesky import exact
from probcal.gaussian.joint import JointPrecision, blocks_of, too_large
from probcal.gaussian.linearised import Linearisation, linearise, linearise_rows
from probcal.gaussian.mode import Point
from probcal.identifiability.directions import marginal, open_alone, open_together, weak_directions
from probcal.identifiability.gauge import NULL, gauge, unfixed
from probcal.identifiability.remedies import WEAK
from probcal.problem import Problem
from probcal.results.answer import Tracks, tracks_of
from probcal.results.blocks import SensorBlocks
from probcal.results.build import bands
from probcal.results.groups import bias_coords, constant_group, datum_of, direction_group, gather, track_groups
from probcal.simulate import Truth
from probcal.types import float64

RULE = (
    f"gauge: with the state of every epoch free, rows leave less than {NULL:g} of the information that known states "
    f"would give; weak: information below {WEAK:g} in units of the prior scale, trajectories marginalised"
)

NOT_FINITE = "observability: the rows have no finite derivatives at the start; is a target at the place of a sensor?"
NAMED = 20  # combinations of single sensors that are named where biases are many


@float64
def observability(problem: Problem, *, point: Point | None = None, truth: Truth | None = None) -> xr.DataTree:
    """What data and surveys determine, before any fit: a tree whose directions, biases and sensors bear names.

    The information of the biases has every trajectory marginalised (papers README, standard forms) and is in units of
    the prior scale. It is taken at the automatic start, at a `truth` (tracks and biases: to plan before there are
    data), or at a `point`. Groups: `bias` (share of each answer that the data give under a prior of one scale, the
    bound on its sd, the information matrix), `spectrum`, `direction` (gauge and weak ones with words and remedies),
    `datum`, `sensor` and `target` (how many biases each determines: their leverages, which add up with what the motion
    tells), `track`. Attributes: `status` (determined; weak; open, where the data say next to nothing of a direction),
    `rule`, counts. A network too large for matrices of all biases has no spectrum and no information matrix; its
    directions are those of single sensors and what all share. Raises `InputError` where no bias is free.

    >>> observability(problem).attrs["status"]
    'determined'
    """
    check_free(problem)
    point = standpoint(problem, point, truth)
    if too_large(problem.model):
        return _of_many(problem, point)
    at = linearise(problem.model.by_information(), point)
    found = _information(at)
    null = gauge(problem, point)
    directions = weak_directions(problem, found.information, point, null)
    groups = {
        "bias": _biases(problem, found.share, np.sqrt(np.diag(found.covariance)), found.information),
        "spectrum": _spectrum(found.information),
        **_leverage_groups(problem, at.leverages(jnp.asarray(found.covariance)), found.share),
        **track_groups(problem, bands(tracks_of(at, jnp.asarray(found.covariance)), point)),
        "constant_data": constant_group(problem),
    }
    if directions:
        groups["direction"] = direction_group(problem.labels, directions)
    free = ~problem.surveyed
    values = np.linalg.eigvalsh(marginal(found.information, free)) if free.any() else np.full(1, np.inf)
    result = xr.DataTree.from_dict(groups)
    result.attrs.update(
        status=_status(max(float(values[0]), 0.0), null.countable and null.basis.shape[1] > 0), rule=RULE,
        countable=int(null.countable), data=problem.measurements.table.source,
        gauge=null.basis.shape[1] if null.countable else 0,
        weak=int((values < WEAK).sum()),
    )  # fmt: skip
    return result


def _of_many(problem: Problem, point: Point) -> xr.DataTree:
    """The same of biases too many for a matrix of all: no spectrum and no information matrix."""
    model, M = problem.model.by_information(), problem.model.biases
    joint, lins = JointPrecision.of(model), linearise_rows(model, point)
    entries = joint.values(model, lins, point.levels)
    if not np.isfinite(entries).all():
        raise InputError(NOT_FINITE)
    if not exact():
        raise InputError(f"observability of {M} biases needs exact variances, of sparsax: install probcal[sparse]")
    factor, members = joint.factor(entries, np.ones(M)), blocks_of(model)
    together = open_together(problem, point, lambda columns: factor.solve(joint.of_biases(columns))[joint.states :])
    free = unfixed(problem, point, np.stack([d.vector for d in together], 1)) if together else ()
    together = tuple(replace(d, kind="gauge" if own else d.kind) for d, own in zip(together, free, strict=True))
    inverse = factor.inverse_entries()
    blocks = SensorBlocks(M, members, joint.block_values(members, joint.pairs(members), inverse))
    alone, count = open_alone(problem, point, members, blocks.covariance, NAMED)
    held = joint.states_alone(entries)
    inside = np.zeros_like(inverse)
    inside[joint.places.column < joint.states] = held.inverse_entries()
    variances = [joint.predicted_variances(model, lins, values) for values in (inverse, inside)]
    parts = [np.asarray(lin.weight) * (a - b) for lin, a, b in zip(lins, *variances, strict=True)]
    share = np.clip(1.0 - blocks.variance, 0.0, 1.0)
    spread = joint.state_values(inverse[joint.places.diagonal])
    tracked = [Tracks(np.asarray(x), np.sqrt(own)) for x, own in zip(point.states, spread, strict=True)]
    groups = {
        "bias": _biases(problem, share, np.sqrt(blocks.variance)),
        **_leverage_groups(problem, parts, share),
        **track_groups(problem, bands(tracked, point)),
        "constant_data": constant_group(problem),
    }
    directions = (*together, *alone)
    if directions:
        groups["direction"] = direction_group(problem.labels, directions)
    least = min((d.information for d in directions), default=WEAK)
    gauges = sum(d.kind == "gauge" for d in directions)
    result = xr.DataTree.from_dict(groups)
    result.attrs.update(
        status=_status(least, gauges > 0), rule=RULE, countable=1, data=problem.measurements.table.source,
        gauge=gauges, weak=len(together) + count,
    )  # fmt: skip
    return result


class Information:
    """Information (M, M) of the data about z, and the covariance (M, M) under a prior of one scale (or the survey)."""

    def __init__(self, information: np.ndarray):
        self.information = information
        values, vectors = np.linalg.eigh(information)  # what rounding leaves below 0 is nothing
        self.covariance = (vectors / (1.0 + np.maximum(values, 0.0))) @ vectors.T

    @property
    def share(self) -> np.ndarray:
        """Share of each answer (M,) that the data give."""
        return np.clip(1.0 - np.diag(self.covariance), 0.0, 1.0)


def _information(at: Linearisation) -> Information:
    information = np.asarray(at.information)
    if not np.isfinite(information).all():
        raise InputError(NOT_FINITE)
    return Information(information)


def _status(least: float, gauge: bool) -> str:
    """What the least information of any direction means for a fit; a gauge is never determined by its motion alone."""
    word = narrowed(1.0 - 1.0 / (1.0 + least))
    if word == "prior only":
        return "open"
    return "weak" if gauge else word


def _biases(problem: Problem, share: np.ndarray, sd: np.ndarray, information: np.ndarray | None = None) -> xr.Dataset:
    """Group `bias` from shares (M,) and sds (M,) of z."""
    scales, labels = problem.scales, list(problem.labels)
    columns = {
        "scale": scales,
        "kind": np.array([b.kind for b in problem.biases], str),
        "share": share,
        "sd": sd * scales,
        "verdict": np.array([narrowed(own) for own in share]),
    }
    group = xr.Dataset({k: ("bias_label", v) for k, v in columns.items()}, coords=bias_coords(problem))
    if information is None:
        return group
    matrix = (("bias_label", "bias_label_other"), information)
    return group.assign(information=matrix).assign_coords(bias_label_other=labels)


def _spectrum(information: np.ndarray) -> xr.Dataset:
    """Eigenvalues of the information in z, ascending, and their shares."""
    values = np.maximum(np.linalg.eigvalsh(information), 0.0)
    return xr.Dataset({"information": ("eigenvalue", values), "share": ("eigenvalue", values / (1.0 + values))})


def _leverage_groups(problem: Problem, parts: Sequence[Any], share: np.ndarray) -> dict[str, xr.Dataset]:
    """How many biases each datum (N, C), sensor and target determines; the motion tells the rest."""
    datum, picks = datum_of(problem)
    values = gather([np.asarray(part) for part in parts], picks)
    each = xr.Dataset({"leverage": ("datum", values)}, coords=datum["coords"])
    groups = {"datum": each}
    for name in ("sensor", "target"):
        frame = each.to_dataframe().groupby(name, sort=False)["leverage"].agg(["sum", "size"])
        groups[name] = xr.Dataset(
            {"leverage": (name, frame["sum"].to_numpy()), "data": (name, frame["size"].to_numpy())},
            coords={name: frame.index.to_numpy(str)},
        )
    groups["target"].attrs["motion"] = max(float(share.sum() - values.sum()), 0.0)
    return groups
