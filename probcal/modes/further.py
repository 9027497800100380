"""Further starts: swapped pairs of nodes, and sparse draws of the biases."""

import jax
import jax.numpy as jnp
import numpy as np

from probcal.gaussian.mode import Point
from probcal.modes.grid import grid_start, joint_cost
from probcal.modes.swaps import TRIED
from probcal.modes.swaps import swaps as all_swaps
from probcal.priors import Precision
from probcal.problem import Problem

DRAWN = 3  # draws of the biases that are tried for one further start
SPARSE = 0.3  # share of the biases that a draw moves


def further_starts(problem: Problem, count: int, key: jax.Array) -> list[Point]:
    """`count` other starts: of swapped pairs of nodes and of sparse draws of the biases, those that fit best.

    A swap is the field's commonest gross error, and no local search finds it; draws move a share of the biases by
    two scales. Each comes with the track that suits it; half of the starts are swaps where there are any.
    """
    if count < 1:
        return []
    seeds = jax.random.split(key, 3)
    swaps = np.array([*all_swaps(problem).values()]).reshape(-1, len(problem.labels))
    swaps = swaps[np.sort(np.asarray(jax.random.permutation(seeds[0], len(swaps)))[:TRIED])]
    shape = (DRAWN * count, len(problem.labels))
    moved = np.asarray(jax.random.uniform(seeds[1], shape)) < SPARSE
    drawn = np.where(moved, 2.0 * np.asarray(jax.random.normal(seeds[2], shape)), 0.0)
    points = [grid_start(problem, jax.device_put(problem.first_z + z), 30) for z in np.concatenate([swaps, drawn])]
    flat = Precision(jnp.zeros(len(problem.labels)))
    costs = [float(joint_cost(problem.model, point, flat)) for point in points]
    value = np.nan_to_num(costs, nan=np.inf)
    pairs, others = np.argsort(value[: len(swaps)]), len(swaps) + np.argsort(value[len(swaps) :])
    half = min(len(pairs), (count + 1) // 2)
    return [points[k] for k in (*pairs[:half], *others[: count - half])]
