"""Replicas of the data at draws of a fit: posterior predictive checks, and the kurtosis of what is standardised.

A discrepancy of the data is compared with that of a replica at the same draw of biases and trajectories (Gelman,
Meng and Stern 1996). The draws have seen the data: a p-value lies nearer to one half than a uniform one would.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from probcal.gaussian.draws import draw
from probcal.inference.fitted import Judged
from probcal.inference.residuals import all_gaussian, exact_kurtosis
from probcal.model.model import At, Data, Model
from probcal.model.motions import level_logs
from probcal.model.rows import standardised
from probcal.model.trajectories import States
from probcal.results.read import each_track, saved_states

DRAWS = 400
VALUES = 20_000_000  # of all states drawn
LEAST = 20  # draws, however many states there are


class FitDraws(NamedTuple):
    """Draws of biases (D, M), log levels (D, H) and states (D, E, n); replicas (D, N, C) where a tree holds them."""

    z: jax.Array
    levels: jax.Array
    states: States
    replicas: Sequence[jax.Array] | None


class Predictive(NamedTuple):
    """Of every datum: p-values (D,) of its sensor's channel, and excess kurtosis (D,) of what is standardised.

    `misfit` is the probability that a replica has a larger -log p than the data, `mean` a larger mean residual.
    """

    misfit: np.ndarray
    mean: np.ndarray
    kurtosis: np.ndarray
    draws: int  # behind the p-values


@partial(jax.jit, static_argnames="count")
def _discrepancies(
    model: Model, levels: jax.Array, drawn: FitDraws, sensors: Data, count: int,
    key: jax.Array,
) -> tuple[list[jax.Array], list[jax.Array]]:  # fmt: skip
    """By draw, data or replica, sensor and channel (D, 2, 2, S, C): -log p and sum of scores; fourth powers (N, C)."""

    def one(fourth: list[jax.Array], given: tuple[FitDraws, jax.Array]) -> tuple[list[jax.Array], list[jax.Array]]:
        draw, number = given
        at = At(draw.states, draw.z, draw.levels)
        replicas = model.sample(at, jax.random.fold_in(key, number)) if draw.replicas is None else draw.replicas
        here = at._replace(levels=levels)  # what is compared is judged at one noise level

        def of(values: Any) -> tuple[list[jax.Array], list[jax.Array]]:
            version = model.with_values(values)
            v = [standardised(score, weight) for score, weight in version.score(here)]
            pairs = zip(version.log_likelihood(here), v, sensors, strict=True)
            sums = [jax.ops.segment_sum(jnp.stack([-own, value], 1), sensor, count) for own, value, sensor in pairs]
            return sums, [value**4 for value in v]

        measured = [data.y for data in model.rows]
        found, powers = jax.lax.map(of, [jnp.stack(pair) for pair in zip(measured, replicas, strict=True)])
        return [a + b[1] for a, b in zip(fourth, powers, strict=True)], found

    total = drawn.z.shape[0]
    nothing = [jnp.zeros(there.shape) for there in model.measured]
    fourth, found = jax.lax.scan(one, nothing, (drawn, jnp.arange(total)))
    return found, [power / total for power in fourth]


def check_replicas(fit: Judged, drawn: FitDraws, key: jax.Array) -> Predictive:
    """P-values by sensor and channel, and kurtosis, at draws of a fit."""
    problem = fit.problem
    sensors = tuple(jax.device_put(problem.measurements.sensor[index]) for index in problem.row_index)
    count = len(problem.network.sensors)
    found, fourth = _discrepancies(problem.model, fit.point.levels, drawn, sensors, count, key)
    kurtosis = np.zeros(len(fit.data)) if all_gaussian(problem.model) else exact_kurtosis(fit, fit.flat(fourth) - 3.0)
    parts = list[np.ndarray]()
    for sensor, values in zip(sensors, map(np.asarray, found), strict=True):
        above = (values[:, 1] > values[:, 0]).mean(0) + 0.5 * (values[:, 1] == values[:, 0]).mean(0)  # (S, 2, C)
        parts.append(np.moveaxis(above[np.asarray(sensor)], 1, 0))
    misfit, mean = fit.flat(parts)
    return Predictive(misfit, mean, kurtosis, drawn.z.shape[0])


def draws_of(fit: Judged, tree: xr.DataTree, key: jax.Array) -> FitDraws:
    """Up to 400 draws of a fit, biases and levels as its tree has them.

    The states are those of the tree where it holds them; else a trajectory is drawn for each draw of the biases, from
    the Gaussian of the problem linearised at the fit.
    """
    posterior, problem = tree["posterior"].to_dataset(), fit.problem
    tracked = dict(each_track(tree))
    total = posterior.sizes["chain"] * posterior.sizes["draw"]
    most = min(DRAWS, total, max(VALUES // problem.model.state_size, LEAST))
    chosen = np.linspace(0, total - 1, most).astype(int)

    def thin(values: np.ndarray) -> Any:
        return values.reshape(total, *values.shape[2:])[chosen]

    z = jax.device_put(thin(posterior["bias"].values) / problem.scales)
    levels: Any = np.broadcast_to(fit.point.levels, (most, len(problem.levels)))
    if "level" in posterior:
        levels = np.asarray(level_logs(problem.levels, thin(posterior["level"].values)))
    if any("state" not in track for track in tracked.values()):
        states = tuple(map(jax.device_put, draw(fit.expansion, z, levels, key).states))
        return FitDraws(z, levels, states, None)
    states = tuple(jnp.asarray(thin(own)) for own in saved_states(problem, tracked))
    replicas = tree["posterior_predictive"].to_dataset()["y"] if "posterior_predictive" in tree.children else None
    if replicas is None or replicas.sizes["draw"] < posterior.sizes["draw"]:
        return FitDraws(z, levels, states, None)
    blocks = fit.in_blocks(thin(replicas.values).T)
    return FitDraws(z, levels, states, [jnp.moveaxis(own, -1, 0) for own in blocks])
