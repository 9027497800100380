"""What the data of a problem can and cannot determine: information of all biases, trajectories marginalised."""

import jax.numpy as jnp
import numpy as np
import xarray as xr

from probcal.analysis.standpoint import check_free, standpoint
from probcal.analysis.verdict import narrowed
from probcal.errors import InputError
from probcal.identifiability.directions import marginal, weak_directions
from probcal.identifiability.gauge import NULL, gauge
from probcal.identifiability.remedies import WEAK
from probcal.problem import Problem
from probcal.results.answer import tracks_of
from probcal.results.build import bands
from probcal.results.groups import bias_coords, constant_group, datum_of, direction_group, gather, track_groups
from probcal.simulate import Truth
from probcal.smoothing.linearised import Linearisation, linearise
from probcal.smoothing.mode import Point
from probcal.types import float64

RULE = (
    f"gauge: with the state of every epoch free, rows leave less than {NULL:g} of the information that known states "
    f"would give; weak: information below {WEAK:g} in units of the prior scale, trajectories marginalised"
)


@float64
def observability(problem: Problem, *, point: Point | None = None, truth: Truth | None = None) -> xr.DataTree:
    """What data and surveys determine, before any fit: a tree whose directions, biases and sensors bear names.

    The information of the biases has every trajectory marginalised (papers README, standard forms) and is in units of
    the prior scale. It is taken at the automatic start, at a `truth` (tracks and biases: to plan before there are
    data), or at a `point`. Groups: `bias` (share of each answer that the data give under a prior of one scale, the
    bound on its sd, the information matrix), `spectrum`, `direction` (gauge and weak ones with words and remedies),
    `datum`, `sensor` and `target` (how many biases each determines: their leverages, which add up with what the motion
    tells), `track`. Attributes: `status` (determined; weak; open, where the data say next to nothing of a direction),
    `rule`, counts. Raises `InputError` where no bias is free.

    >>> observability(problem).attrs["status"]
    'determined'
    """
    check_free(problem)
    point = standpoint(problem, point, truth)
    at = linearise(problem.model.by_information(), point)
    found = _information(at)
    null = gauge(problem, point)
    directions = weak_directions(problem, found.information, point, null)
    groups = {
        "bias": _biases(problem, found),
        "spectrum": _spectrum(found.information),
        **_leverage_groups(problem, at, found),
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
        raise InputError(
            "observability: the rows have no finite derivatives at the start; is a target at the place of a sensor?"
        )
    return Information(information)


def _status(least: float, gauge: bool) -> str:
    """What the least information of any direction means for a fit; a gauge is never determined by its motion alone."""
    word = narrowed(1.0 - 1.0 / (1.0 + least))
    if word == "prior only":
        return "open"
    return "weak" if gauge else word


def _biases(problem: Problem, found: Information) -> xr.Dataset:
    scales, labels = problem.scales, list(problem.labels)
    columns = {
        "scale": scales,
        "kind": np.array([b.kind for b in problem.biases], str),
        "share": found.share,
        "sd": np.sqrt(np.diag(found.covariance)) * scales,
        "verdict": np.array([narrowed(share) for share in found.share]),
    }
    group = xr.Dataset({k: ("bias_label", v) for k, v in columns.items()}, coords=bias_coords(problem))
    matrix = (("bias_label", "bias_label_other"), found.information)
    return group.assign(information=matrix).assign_coords(bias_label_other=labels)


def _spectrum(information: np.ndarray) -> xr.Dataset:
    """Eigenvalues of the information in z, ascending, and their shares."""
    values = np.maximum(np.linalg.eigvalsh(information), 0.0)
    return xr.Dataset({"information": ("eigenvalue", values), "share": ("eigenvalue", values / (1.0 + values))})


def _leverage_groups(problem: Problem, at: Linearisation, found: Information) -> dict[str, xr.Dataset]:
    """How many biases each datum, sensor and target determines; the motion tells the rest."""
    parts = at.leverages(jnp.asarray(found.covariance))
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
    groups["target"].attrs["motion"] = max(float(found.share.sum() - values.sum()), 0.0)
    return groups
