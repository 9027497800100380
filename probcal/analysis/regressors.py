"""Columns that predictions may follow beyond their model, by the geometry at a fit."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from probcal.geometry import slopes
from probcal.inference.fitted import Judged
from probcal.inference.residuals import FEWEST
from probcal.noise import Bernoulli

MOVING = ("position", "velocity", "acceleration")  # components of which others are the rates
UNCENTRED = ("time", "reading")  # columns of which a multiple is a cause of its own


def regressors(
    fit: Judged, group: np.ndarray, kinds: Sequence[tuple[Any, Any]], still: Sequence[bool], after: np.ndarray
) -> dict[str, np.ndarray]:
    """Columns (D, k) by name, of data whose channel is `group` (D,) of these `kinds`, type and declaration.

    `still` says which have nodes that do not move, `after` (D,) is what the fit leaves.
    The constant part of a channel is taken out, but of `UNCENTRED`; zero where a channel does not have a column, or has
    too few data.
    """
    line, count = lines(fit), np.bincount(group)
    flat, far = np.hypot(line[:, 0], line[:, 1])[:, None], np.linalg.norm(line, axis=1)[:, None] / farthest(fit)
    value = fit.flat(fit.problem.model.values)
    found = {
        "time": rates(fit)[:, None], "direction": line[:, :2] / np.maximum(flat, 1e-9),
        "distance": np.hstack([far, far**2]), "elevation": np.arctan2(line[:, 2:], flat),
        "reading": (value - after)[:, None],
    }  # fmt: skip
    few = np.array([channel.noise == Bernoulli() for _, channel in kinds]) | (count < FEWEST)
    for name, columns in found.items():
        if name not in UNCENTRED:
            means = np.reshape([np.bincount(group, own) for own in columns.T], (-1, len(count))) / count
            columns = columns - means.T[group]
        if name == "reading":
            has = [not channel.wrap for _, channel in kinds]
        elif name == "time":
            has = [own.reads_target and rests for (own, _), rests in zip(kinds, still, strict=True)]
        else:
            has = [kind.reads_target and kind.arity == 1 for kind, _ in kinds]
        found[name] = np.where((np.array(has) & ~few)[group, None], columns, 0.0)
    return found


def lines(fit: Judged) -> np.ndarray:
    """Lines (D, d) from the first node of every datum to its target."""
    places, found = fit.problem.positions(fit.point.states), list[np.ndarray]()
    for _, data, r in fit.problem.model.each_block():
        line = places[r][np.asarray(data.epoch)] - np.asarray(data.pose)[:, 0, : places[r].shape[1]]
        found.append(np.broadcast_to(line.T[:, :, None], (line.shape[1], *data.y.shape)))
    return fit.flat(found).T


def farthest(fit: Judged) -> float:
    """The largest distance of a target from a node that sees it."""
    return float(f"{max(np.linalg.norm(lines(fit), axis=1).max(), 1e-9):.3g}")  # as it is said


def rates(fit: Judged) -> np.ndarray:
    """Derivative (D,) of every prediction by time, along the track of its target."""
    moving = []
    for _, epochs, states in fit.problem.model.each_layout(fit.problem.epochs, fit.point.states):
        rate = np.zeros(np.shape(states))
        own = [name.rpartition("_")[0] in MOVING for name in epochs.components]
        for mine in epochs.members.values():
            some = np.ix_(np.flatnonzero(mine), own)
            time, first, back = np.unique(epochs.time[mine].round(6), return_index=True, return_inverse=True)
            rate[some] = slopes(time, np.asarray(states)[some][first])[back]
        moving.append(rate)
    parts = fit.problem.model.each_block(fit.lins)
    return fit.flat(
        np.einsum("ncj,nj->nc", lin.state, moving[r][np.asarray(data.epoch)][:, list(block.used)])
        for block, data, r, lin in parts
    )
