"""The models M0, M1 and M2 of received levels, fitted by least squares where the track of the target is known."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from probcal.errors import InputError, nearest
from probcal.labels import AXES
from probcal.lazy import xr
from probcal.linalg import singular
from probcal.problem import Problem
from probcal.sensors import CLOSE
from probcal.simulate import Truth

MODELS = ("M0", "M1", "M2")
POWERS = ("target", "time")
FEWEST = 20  # residuals of which a test makes sense


class _Rows(NamedTuple):
    """Rows of one channel whose target's place is known."""

    time: np.ndarray
    node: np.ndarray
    target: np.ndarray
    distance: np.ndarray
    level: np.ndarray


def power_law(
    problem: Problem, tracks: Truth, *, model: str = "M2", power: str = "target", reference: str | None = None
) -> xr.DataTree:
    """Source levels, gains of the nodes and exponent by least squares, the tracks known (RSS paper 4-5).

    Every channel in dB of a sensor with one node is fitted by itself: level = theta_1 + theta_2(node) + theta_3 c,
    c = 10 log10 |p - s|, so that theta_3 is minus the exponent. `model` "M0": nothing; "M1": without theta_3; "M2":
    all. `power` gives theta_1 by "target" or by "time" (a level of its own at every time of every target). The gains
    are those beside the `reference` node (the first that has rows), whose gain is 0, as only sums are seen (5b).

    A node of the tree a channel: `estimate` and `sd` by `parameter` (labels `theta_1.<target>[@<time>]`,
    `theta_2.<node>`, `theta_3`), `covariance` (5f); `residual` by row with time, node and target; attributes `rmse`
    in dB (5d), `rows`, `exponent`, `exponent_sd`, and of the residuals `skewness`, `kurtosis` (excess), `p_normal` (of
    D'Agostino and Pearson) and `autocorrelation` of successive rows of a node. Rows where a track has a gap are left
    out. Raises `InputError` where no channel is in dB, no row has a known place, or the data do not tell a parameter.
    """
    if model not in MODELS:
        raise InputError(f'power_law: model is "{model}"{nearest(model, MODELS)}')
    if power not in POWERS:
        raise InputError(f'power_law: power is "{power}"{nearest(power, POWERS)}')
    names = [n for n in problem.measurements.channels if _in_decibels(problem, n)]
    if not names:
        raise InputError('power_law: no channel of a sensor with one node is in dB; declare it, Channel("dB", ...)')
    every = {name: _rows(problem, tracks, name) for name in names}
    found = {name: _fitted(name, rows, model, power, reference) for name, rows in every.items() if len(rows.level)}
    if not found:
        raise InputError("power_law: no row has a target of known place; give its track, Truth(tracks=...)")
    return xr.DataTree.from_dict(found)


def _in_decibels(problem: Problem, name: str) -> bool:
    """True if a channel is a level of sensors with one node."""
    for kind in problem.network.types:
        channel = dict(kind.expand(problem.network.dimension)).get(name)
        if channel is not None and channel.unit in ("dB", "dBm") and kind.arity == 1:
            return True
    return False


def _rows(problem: Problem, tracks: Truth, name: str) -> _Rows:
    """Measured rows of a channel with the distances to the known places, in order of node, target and time."""
    data, d = problem.measurements, problem.network.dimension
    mine = np.flatnonzero(data.measured[:, data.channels.index(name)])
    target = np.array(data.target_names)[data.target[mine]]
    place = tracks.positions(data.time[mine], target, d)
    sensors = problem.network.sensors
    stand = np.empty((len(mine), d))
    for k in np.unique(data.sensor[mine]):
        node, own = sensors[k].nodes[0], data.sensor[mine] == k
        if node.path is not None:
            stand[own] = node.path.at(data.time[mine][own])["position"]
        else:
            stand[own] = node.position + [problem.fixed.get(f"{node.name}.position_{a}", 0.0) for a in AXES[:d]]
    node = np.array([sensors[k].nodes[0].name for k in data.sensor[mine]])
    distance = np.maximum(np.linalg.norm(place - stand, axis=1), CLOSE)
    kept = np.flatnonzero(np.isfinite(distance))
    kept = kept[np.lexsort((data.time[mine][kept], target[kept], node[kept]))]
    level = data.value[mine, data.channels.index(name)]
    return _Rows(data.time[mine][kept], node[kept], target[kept], distance[kept], level[kept])


def _design(rows: _Rows, model: str, power: str, reference: str | None) -> tuple[np.ndarray, list[str]]:
    """Regressors (rows, parameters) and their names (5b, each theta_1 and theta_2 with a column of its own)."""
    columns: list[np.ndarray] = []
    names: list[str] = []
    if model == "M0":
        return np.zeros((len(rows.level), 0)), names
    keys = rows.target
    if power == "time":
        keys = np.array([f"{name}@{time:.9g}" for name, time in zip(rows.target, rows.time, strict=True)])
    for key in dict.fromkeys(keys):
        columns.append(keys == key)
        names.append(f"theta_1.{key}")
    nodes = list(dict.fromkeys(rows.node))
    first = nodes[0] if reference is None else reference
    if first not in nodes:
        raise InputError(f'power_law: reference "{first}" has no rows{nearest(first, nodes)}')
    for node in nodes:
        if node != first:
            columns.append(rows.node == node)
            names.append(f"theta_2.{node}")
    if model == "M2":
        columns.append(10 * np.log10(rows.distance))
        names.append("theta_3")
    return np.stack(columns, 1).astype(float), names


def _fitted(name: str, rows: _Rows, model: str, power: str, reference: str | None) -> xr.Dataset:
    """Least squares of one channel (5c), its covariance (5f), RMSE (5d) and checks of the residuals."""
    from scipy import stats

    X, names = _design(rows, model, power, reference)
    n, p = X.shape
    if n <= p:
        raise InputError(
            f'power_law: channel "{name}" has {n} rows for {p} parameters; give more rows, or power="target"'
        )
    size = np.sqrt((X**2).mean(0))
    U, values, V = singular(X / size)
    if p and values[-1] < 1e-9 * values[0]:
        lost = names[int(np.abs(V[-1] / size).argmax())]
        raise InputError(
            f'power_law: channel "{name}": the rows do not tell {lost} from the other parameters; give rows of more'
            ' nodes or at more distances, or power="target"'
        )
    estimate = (V.T / values) @ (U.T @ rows.level) / size
    left = rows.level - X @ estimate
    rmse = float(np.sqrt(left @ left / (n - p)))
    covariance = rmse**2 * (V.T / values**2) @ V / np.outer(size, size)
    sd = np.sqrt(np.diagonal(covariance))
    attrs: dict[str, Any] = {"model": model, "power": power, "rows": n, "rmse": rmse, "unit": "dB"}
    if p and n >= FEWEST and rmse > 0:
        same = (rows.node[1:] == rows.node[:-1]) & (rows.target[1:] == rows.target[:-1])
        attrs |= {
            "skewness": float(stats.skew(left)),
            "kurtosis": float(stats.kurtosis(left)),
            "p_normal": float(stats.normaltest(left).pvalue),
            "autocorrelation": float((left[1:] * left[:-1])[same].mean() / (left**2).mean()) if same.any() else 0.0,
        }
    if model == "M2":
        attrs |= {"exponent": -float(estimate[-1]), "exponent_sd": float(sd[-1])}
    coords: dict[str, Any] = {"parameter": np.array(names, str), "parameter_other": np.array(names, str)}
    coords |= {"time": ("row", rows.time), "node": ("row", rows.node), "target": ("row", rows.target)}
    variables = {
        "estimate": ("parameter", estimate), "sd": ("parameter", sd),
        "covariance": (("parameter", "parameter_other"), covariance),
        "residual": ("row", left), "distance": ("row", rows.distance),
    }  # fmt: skip
    return xr.Dataset(variables, coords=coords, attrs=attrs)
