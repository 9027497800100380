"""The observability of all biases of a problem: their information, trajectories marginalised."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr

from probcal.analysis.standpoint import check_free, standpoint
from probcal.analysis.verdict import narrowed
from probcal.errors import InputError
from probcal.gaussian.choose import choose
from probcal.gaussian.engine import Factors
from probcal.gaussian.joint import blocks_of
from probcal.gaussian.mode import Point
from probcal.identifiability.directions import screened_directions, weak_directions, with_kinds
from probcal.identifiability.gauge import NULL, gauge
from probcal.identifiability.remedies import WEAK, Direction
from probcal.linalg import eigenvalues, marginalise
from probcal.problem import Problem
from probcal.results.answer import Tracks
from probcal.results.blocks import SensorBlocks
from probcal.results.groups import along, bias_coords, constant_group, datum_of, direction_group, gather, track_groups
from probcal.simulate import Truth
from probcal.types import float64

RULE = (
    f"gauge: with the state of every epoch free, rows leave less than {NULL:g} of the information that known states "
    f"would give; weak: information below {WEAK:g} in units of the prior scale, trajectories marginalised"
)

NOT_FINITE = "observability: the rows have no finite derivatives at the start; is a target at the place of a sensor?"
SCREENED = (
    "of so many biases rigid motions, common shifts and the combinations of each sensor were looked at; no spectrum"
)


@float64
def observability(problem: Problem, *, point: Point | None = None, truth: Truth | None = None) -> xr.DataTree:
    """The observability from data and surveys, before any fit: a tree of named directions, biases
    and sensors.

    The information of the biases has every trajectory marginalised (papers README, standard forms) and is in units of
    the prior scale. It is taken at the automatic start, at a `truth` (tracks and biases: to plan before there are
    data), or at a `point`. Groups: `bias` (share of each answer that the data give under a prior of one scale, the
    bound on its sd, the information matrix), `spectrum`, `direction` (gauge and weak ones with words and remedies),
    `datum`, `sensor` and `target` (how many biases each determines: their leverages, which add up with what the motion
    tells), `track`. Attributes: `status` (determined; weak; open, where the data say next to nothing of a direction),
    `rule`, counts. A large network of more than 600 biases has no spectrum and no information matrix; its directions
    are those of single sensors and those that all share (`screened` says so). Raises `InputError` where no bias is
    free.

    >>> observability(problem).attrs["status"]
    'determined'
    """
    check_free(problem)
    point = standpoint(problem, point, truth)
    model, scales = problem.model.by_information(), Factors.alone(np.ones(problem.model.biases))
    engine = choose(model)
    at = engine.at(model, point)
    if not all(np.isfinite(own).all() for lin in at.rows for own in lin):
        raise InputError(NOT_FINITE)
    information = at.information()
    members = np.arange(model.biases)[:, None] if information is not None else blocks_of(model)
    leverages, states = at.leverages(scales), at.states(scales)
    blocks = SensorBlocks(model.biases, members, np.asarray(at.marginals(scales, members)))
    share = np.clip(1.0 - blocks.variance, 0.0, 1.0)
    spread = [np.sqrt(np.maximum(np.diagonal(np.asarray(own), axis1=1, axis2=2), 0.0)) for own in states]
    tracked = [Tracks(np.asarray(x), own) for _, x, own in model.each_layout(point.states, spread)]
    groups = {
        "bias": _biases(problem, share, np.sqrt(blocks.variance), information),
        **_leverage_groups(problem, leverages, share),
        **track_groups(problem, tracked, point.states),
        "constant_data": constant_group(problem),
    }
    if information is None:
        directions, weak = screened_directions(problem, at, blocks)
        gauges = sum(own.kind == "gauge" for own in directions)
        least, countable = min((own.information for own in directions), default=WEAK), True
    else:
        groups["spectrum"] = _spectrum(information)
        directions, values, gauges, countable = _directions(problem, information, point, exact=engine.cheap)
        least, weak = float(values[0]), int((values < WEAK).sum())
    if directions:
        groups["direction"] = direction_group(problem.labels, directions)
    result = xr.DataTree.from_dict(groups)
    result.attrs.update(
        status=_status(max(least, 0.0), gauges > 0), rule=RULE, countable=int(countable),
        data=problem.measurements.table.source, gauge=gauges, weak=weak,
    )  # fmt: skip
    if information is None:
        result.attrs["screened"] = SCREENED
    return result


def _directions(
    problem: Problem, information: np.ndarray, point: Point, *, exact: bool
) -> tuple[tuple[Direction, ...], np.ndarray, int, bool]:
    """Weak directions by name, eigenvalues of the marginal information, number of gauges, and
    whether these count.

    Gauges are the null space of the rows where that is `exact`; else each direction is tried by
    itself.
    """
    free = ~problem.surveyed
    values = eigenvalues(marginalise(information, free)[0]) if free.any() else np.full(1, np.inf)
    if exact:
        null = gauge(problem, point)
        found = weak_directions(problem, information, point, null)
        return found, values, null.basis.shape[1] if null.countable else 0, null.countable
    found = weak_directions(problem, information, point)
    found = tuple(with_kinds(problem, point, found)) if found else found
    return found, values, sum(direction.kind == "gauge" for direction in found), True


def _status(least: float, gauge: bool) -> str:
    """The status of a fit from the least information of any direction; a gauge is never determined
    by its motion alone."""
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
    group = xr.Dataset(along("bias_label", columns), coords=bias_coords(problem))
    if information is None:
        return group
    matrix = (("bias_label", "bias_label_other"), information)
    return group.assign(information=matrix).assign_coords(bias_label_other=labels)


def _spectrum(information: np.ndarray) -> xr.Dataset:
    """Eigenvalues of the information in z, ascending, and their shares."""
    values = np.maximum(eigenvalues(information), 0.0)
    return xr.Dataset({"information": ("eigenvalue", values), "share": ("eigenvalue", values / (1.0 + values))})


def _leverage_groups(problem: Problem, parts: Sequence[Any], share: np.ndarray) -> dict[str, xr.Dataset]:
    """The number of biases that each datum (N, C), sensor and target determines; the motion tells the rest."""
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
