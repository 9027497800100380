"""Further starts: swapped pairs of nodes, and sparse draws of the biases."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np

from probcal.priors import Precision
from probcal.problem import Problem
from probcal.smoothing.grid import grid_start, joint_cost
from probcal.smoothing.mode import Point

TRIED = 60  # swaps of two nodes that are tried for further starts
DRAWN = 3  # draws of the biases that are tried for one further start
SPARSE = 0.3  # share of the biases that a draw moves


def _swaps(problem: Problem) -> np.ndarray:
    """Biases (swaps, M) that exchange the places of two nodes, for every pair of fixed ones with free positions."""
    place: dict[str, list[int]] = {}
    for m, bias in enumerate(problem.biases):
        if bias.component == "position" and bias.kind == "scale":
            place.setdefault(bias.owner, []).append(m)
    d = problem.network.dimension
    free = [n for n in problem.network.nodes if n.path is None and len(place.get(n.name, ())) == d]
    found = []
    for a, b in itertools.combinations(free, 2):
        z = np.zeros(len(problem.labels))
        z[place[a.name]], z[place[b.name]] = b.position - a.position, a.position - b.position
        found.append(z / problem.scales)
    return np.array(found).reshape(-1, len(problem.labels))


def further_starts(problem: Problem, count: int, key: jax.Array) -> list[Point]:
    """`count` other starts: of swapped pairs of nodes and of sparse draws of the biases, those that fit best.

    A swap is the field's commonest gross error, and no local search finds it; draws move a share of the biases by
    two scales. Each comes with the track that suits it; half of the starts are swaps where there are any.
    """
    if not count:
        return []
    seeds = jax.random.split(key, 3)
    swaps = _swaps(problem)
    swaps = swaps[np.sort(np.asarray(jax.random.permutation(seeds[0], len(swaps)))[:TRIED])]
    shape = (DRAWN * count, len(problem.labels))
    moved = np.asarray(jax.random.uniform(seeds[1], shape)) < SPARSE
    drawn = np.where(moved, 2.0 * np.asarray(jax.random.normal(seeds[2], shape)), 0.0)
    points = [grid_start(problem, jnp.asarray(z), 30) for z in np.concatenate([swaps, drawn])]
    flat = Precision.single(jnp.zeros(len(problem.labels)))
    costs = [float(joint_cost(problem.model, point, flat)) for point in points]
    value = np.nan_to_num(costs, nan=np.inf)
    pairs, others = np.argsort(value[: len(swaps)]), len(swaps) + np.argsort(value[len(swaps) :])
    half = min(len(pairs), (count + 1) // 2)
    return [points[k] for k in (*pairs[:half], *others[: count - half])]
