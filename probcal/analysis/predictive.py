"""Replicas of the data at draws of a fit: posterior predictive checks, and the kurtosis of what is standardised.

A discrepancy of the data is compared with that of a replica at the same draw of biases and trajectories (Gelman,
Meng and Stern 1996). The draws have seen the data: a p-value lies nearer to one half than a uniform one would.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from probcal import rows
from probcal.analysis.fitted import Fitted
from probcal.noise import Bernoulli, Gaussian
from probcal.problem import Spec, System
from probcal.smoothing.draws import predictive
from probcal.tree import suffix

DRAWS = 200
AT_FIT = 64  # replicas at the fit itself, where a tree holds no draws


class Drawn(NamedTuple):
    """Draws of biases (D, M) and states (D, E, n), and replicas (D, N, C) of each block at them."""

    z: jax.Array
    states: tuple[jax.Array, ...]
    replicas: list[jax.Array]


class Predictive(NamedTuple):
    """Of every datum: p-values (D,) of its sensor's channel (None without posterior draws), and excess kurtosis (D,).

    `misfit` is the probability that a replica has a larger -log p than the data, `mean` a larger mean residual.
    """

    misfit: np.ndarray | None
    mean: np.ndarray | None
    kurtosis: np.ndarray


@partial(jax.jit, static_argnames=("spec", "count"))
def _discrepancies(
    spec: Spec, system: System, levels: jax.Array, drawn: Drawn, sensors: tuple[jax.Array, ...], count: int
) -> tuple[list[jax.Array], list[jax.Array]]:
    """By draw, data or replica, sensor and channel (D, 2, 2, S, C): -log p and sum of scores; fourth powers (N, C)."""

    def one(draw):
        found, fourth = [], []
        parts = zip(spec.blocks, system.rows, spec.recursion, draw.replicas, sensors, strict=True)
        for block, data, r, replica, sensor in parts:
            predicted = rows.predict(block, data, draw.states[r], draw.z)
            std = rows.noise_std(data, levels)

            def of(y, block=block, data=data, predicted=predicted, std=std, sensor=sensor):
                version = data._replace(y=y)
                score, weight = rows.weigh(block, version, predicted, std, expected=True)
                v = rows.standardised(score, weight)
                misfit = -rows.log_likelihood(block, version, predicted, levels)
                return jax.ops.segment_sum(jnp.stack([misfit, v], 1), sensor, count), v**4

            sums, powers = jax.vmap(of)(jnp.stack([data.y, replica]))
            found.append(sums)
            fourth.append(powers[1])
        return found, fourth

    found, fourth = jax.lax.map(one, drawn)
    return found, [jnp.mean(f, 0) for f in fourth]


def check(fit: Fitted, tree: xr.DataTree, key: jax.Array) -> Predictive:
    """P-values by sensor and channel at up to 200 draws, where the tree has states and replicas; and kurtosis."""
    problem = fit.problem
    drawn = _of_tree(fit, tree)
    known = drawn is not None
    gaussian = all(isinstance(channel.noise, Gaussian) for block in problem.spec.blocks for channel in block.channels)
    if drawn is None:
        if gaussian:
            return Predictive(None, None, np.zeros(len(fit.data)))
        drawn = _at_fit(fit, key)
    sensors = tuple(jnp.asarray(problem.measurements.sensor[index]) for index in problem.row_index)
    count = len(problem.network.sensors)
    found, fourth = _discrepancies(problem.spec, problem.system, fit.point.levels, drawn, sensors, count)
    kurtosis = np.zeros(len(fit.data)) if gaussian else _exact(fit, fit.flat(fourth) - 3.0)
    if not known:
        return Predictive(None, None, kurtosis)
    parts: tuple[list[Any], list[Any]] = ([], [])
    for sensor, values in zip(sensors, map(np.asarray, found), strict=True):
        above = (values[:, 1] > values[:, 0]).mean(0) + 0.5 * (values[:, 1] == values[:, 0]).mean(0)  # (S, 2, C)
        for k, part in enumerate(parts):
            part.append(above[np.asarray(sensor), k])
    return Predictive(fit.flat(parts[0]), fit.flat(parts[1]), kurtosis)


def _exact(fit: Fitted, kurtosis: np.ndarray) -> np.ndarray:
    """Excess kurtosis (D,), that of yes-or-no data in closed form, 1 / (p q) - 6: replicas may lack a rare event."""
    lins = zip(fit.problem.spec.blocks, fit.lins, strict=True)
    answers = [
        np.broadcast_to([isinstance(c.noise, Bernoulli) for c in block.channels], lin.weight.shape)
        for block, lin in lins
    ]
    variance = fit.flat([lin.weight for lin in fit.lins])
    return np.maximum(np.where(fit.flat(answers), 1 / np.maximum(variance, 1e-12) - 6, kurtosis), -2.0)


def _of_tree(fit: Fitted, tree: xr.DataTree) -> Drawn | None:
    """Some of the draws that a tree holds, or None."""
    posterior, problem = tree["posterior"].to_dataset(), fit.problem
    names = [f"state{suffix(problem, r)}" for r in range(len(problem.epochs))]
    if not set(names) <= set(posterior.data_vars) or "posterior_predictive" not in tree.children:
        return None
    total = posterior.sizes["chain"] * posterior.sizes["draw"]
    chosen = np.linspace(0, total - 1, min(DRAWS, total)).astype(int)

    def thin(values: np.ndarray) -> np.ndarray:
        return values.reshape(total, *values.shape[2:])[chosen]

    flat, replicas, start = thin(tree["posterior_predictive"].to_dataset()["y"].values), [], 0
    for data, (row, channel) in zip(problem.system.rows, fit.picks, strict=True):
        block = np.zeros((len(chosen), *data.y.shape))
        block[:, row, channel] = flat[:, start : start + len(row)]
        replicas.append(jnp.asarray(block))
        start += len(row)
    states = tuple(jnp.asarray(thin(posterior[name].values)) for name in names)
    return Drawn(jnp.asarray(thin(posterior["bias"].values) / problem.scales), states, replicas)


def _at_fit(fit: Fitted, key: jax.Array) -> Drawn:
    """Replicas at the fit itself."""
    levels, z, *states = (
        jnp.asarray(np.tile(x, (AT_FIT,) + (1,) * x.ndim)) for x in (fit.point.levels, fit.point.z, *fit.point.states)
    )
    _, replicas = predictive(fit.problem.spec, fit.problem.system, levels, z, tuple(states), key)
    return Drawn(z, tuple(states), replicas)
