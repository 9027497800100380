"""Posterior predictive checks: discrepancies of the data against those of replicas, at the same draws.

Gelman, Meng and Stern (1996). The draws have seen the data: a p-value lies nearer to one half than a uniform one.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from probcal import rows
from probcal.analysis.fitted import Fitted
from probcal.problem import Spec, System
from probcal.tree import suffix

DRAWS = 200


@partial(jax.jit, static_argnames="spec")
def _discrepancies(
    spec: Spec, system: System, levels: jax.Array, z: jax.Array, states: tuple[jax.Array, ...], key: jax.Array
) -> list[jax.Array]:
    """By draw, sensor and channel (D, 4, S, C): misfit -log p and sum of standardised scores, of data and replica."""

    def one(draw):
        z_d, states_d, seed = draw
        found = []
        for b, (block, data, r) in enumerate(zip(spec.blocks, system.rows, spec.recursion, strict=True)):
            predicted = rows.predict(block, data, states_d[r], z_d)
            drawn = rows.sample(block, data, predicted, levels, jax.random.fold_in(seed, b))
            std, values = rows.noise_std(data, levels), []
            for version in (data, data._replace(y=drawn)):
                score, weight = rows.weigh(block, version, predicted, std, expected=True)
                standard = jnp.where(weight > 0, score / jnp.sqrt(jnp.where(weight > 0, weight, 1.0)), 0.0)
                values += [-rows.log_likelihood(block, version, predicted, levels), standard]
            count = data.bias.shape[0]
            found.append(jnp.stack([jax.ops.segment_sum(v, data.sensor, count) for v in values]))
        return found

    return jax.lax.map(one, (z, states, jax.random.split(key, z.shape[0])))


class Predictive(NamedTuple):
    """Of every datum's sensor and channel, (D,): probability that a replica misfits more, or has a larger mean."""

    misfit: np.ndarray
    mean: np.ndarray


def check(fit: Fitted, tree: xr.DataTree, key: jax.Array) -> Predictive | None:
    """P-values by sensor and channel at up to 200 draws of biases and trajectories; None where the tree has none."""
    posterior = tree["posterior"].to_dataset()
    problem = fit.problem
    names = [f"state{suffix(problem, r)}" for r in range(len(problem.epochs))]
    if not set(names) <= set(posterior.data_vars):
        return None
    total = posterior.sizes["chain"] * posterior.sizes["draw"]
    chosen = np.linspace(0, total - 1, min(DRAWS, total)).astype(int)

    def thin(name: str) -> jax.Array:
        values = posterior[name].values
        return jnp.asarray(values.reshape(total, *values.shape[2:])[chosen])

    z = thin("bias") / problem.scales[None, :]
    states = tuple(thin(name) for name in names)
    found = _discrepancies(problem.spec, problem.system, fit.point.levels, z, states, key)
    parts: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
    for data, values in zip(problem.system.rows, map(np.asarray, found), strict=True):
        for k, kind in enumerate(parts):
            above = (values[:, k + 2] > values[:, k]).mean(0) + 0.5 * (values[:, k + 2] == values[:, k]).mean(0)
            kind.append(above[np.asarray(data.sensor)])
    return Predictive(fit.flat(parts[0]), fit.flat(parts[1]))
