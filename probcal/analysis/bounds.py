"""Cramer-Rao bounds of biases and tracks: what no estimator can do better on a problem, before any fit.

The trajectory is a random nuisance whose density is that of the motion. Where an expectation is taken, the rows are
compressed at every draw, the compressed systems averaged and the trajectory eliminated from their average: the
bound of van Trees (1968, 2.4.3) for biases and whitened motion noise together, and the hybrid one (Rockah,
Schultheiss 1987). Averages of eliminated systems would be no bound.
"""

from collections.abc import Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from probcal.analysis.standpoint import draw_states, on_tracks_of, true_biases, true_point
from probcal.errors import InputError, nearest
from probcal.gaussian.choose import choose, direct_engine
from probcal.gaussian.engine import Factors
from probcal.gaussian.joint import JointPrecision
from probcal.gaussian.linearised import Trajectory, linearise_rows, state_variances, trajectories_of
from probcal.gaussian.mode import Compressed, compress, eliminate_compressed
from probcal.labels import NOBODY, listed
from probcal.model.model import At, Model
from probcal.problem import Problem
from probcal.results.groups import bias_coords, by_target, node_of
from probcal.simulate import Key, Truth, as_key
from probcal.types import float64

KINDS = ("parametric", "posterior", "hybrid")
LOST = 1e-12  # share of its information below which a direction has no bound
INVOLVED = 1e-5  # entry of such a direction above which a bias has none
FOLLOWS = 2.0  # times the variance with ten times the ridge, from which on there is no bound


@float64
def bounds(
    problem: Problem, *, kind: str = "posterior", truth: Truth | None = None, draws: int = 50, key: Key = 0
) -> xr.DataTree:
    """Cramer-Rao bounds: of each bias with all trajectories marginalised, of each state with the biases marginalised.

    - `"posterior"` (Bayesian): biases drawn from N(0, scale^2) or their survey; bounds the mean squared error.
    - `"hybrid"`: biases at their true values and without a prior, unless surveyed; trajectories random.
    - `"parametric"`: information at one point, true biases and true tracks; no prior but surveys and the motion.

    Trajectories are drawn from the motion, but held at `truth.tracks` where there are some (velocities by differences):
    a start that is not declared is drawn ten extents wide, and bounds over such draws mean little, so state it or give
    tracks. True biases come from `truth.biases`, else 0. The parametric kind takes the motion's mean for what a track
    leaves out, and the automatic start for a target without a track (for the biases too, without a truth). Unknown
    noise levels are taken at their guesses, process noise that is not Gaussian by the Fisher information of its family.

    Groups: `bias` (`sd` and `covariance` in the unit of the bias, `unit`, `scale`, dim `bias_label`) and `track` (`sd`
    by `time` and `component`, `position_rmse` in m). A bias has no bound where it takes part in a direction of which
    the elimination leaves less than 1e-12 of the information that its biases would have with all else known; such
    biases are left out of `bias`, listed in the group `unbounded` and named in the attribute `message`, which also
    names those whose bound exceeds their scale. Where the dense form takes more than 240 MB the bounds come from sparse
    factors, and there is no `covariance`.
    Raises `InputError` for an unknown kind or label, tracks with gaps, and draws at which a sensor is not finite.

    >>> bounds(problem)["bias"]["sd"].sizes["bias_label"]
    12
    """
    if kind not in KINDS:
        raise InputError(f'bounds: kind is "{kind}"{nearest(kind, KINDS)}')
    if draws < 1:
        raise InputError(f"bounds: draws={draws}; take at least one")
    given = Truth() if truth is None else truth
    keys = jax.random.split(as_key(key))
    model, levels = problem.model.by_information(), jnp.zeros(len(problem.levels))
    if kind == "parametric":
        z, states = true_point(problem, truth)
    else:
        states = on_tracks_of(problem, given, draw_states(problem, draws, keys[0]))
        z = jnp.broadcast_to(true_biases(problem, given), (draws, model.biases))
        z = jax.random.normal(keys[1], z.shape) if kind == "posterior" else z
    prior = np.ones(model.biases) if kind == "posterior" else problem.surveyed.astype(float)
    if not choose(problem.model).cheap:
        variance, bounded, spread = _by_sparse(model, levels, z, states, prior)
        return _tree(problem, kind, len(z), np.sqrt(variance), None, bounded, spread)
    compressed = average(model, levels, z, states)
    _check_finite(jax.tree.leaves(compressed))
    information, trajectories = _eliminated(model, levels, compressed)
    alone = np.diagonal(compressed.information) + prior
    covariance, bounded = invert(np.asarray(information) + np.diag(prior), alone)
    spread = [np.maximum(np.asarray(v), 0.0) for v in state_variances(trajectories, jnp.asarray(covariance))]
    return _tree(problem, kind, len(z), np.sqrt(np.diagonal(covariance)), covariance, bounded, spread)


def _check_finite(leaves: Iterable[Any]) -> None:
    if not all(bool(np.isfinite(leaf).all()) for leaf in leaves):
        raise InputError("bounds: a sensor is not finite at the trajectories drawn; give truth=Truth(tracks)")


def _by_sparse(
    model: Model, levels: jax.Array, z: jax.Array, states: tuple[jax.Array, ...], prior: np.ndarray
) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """Variance (M,) of the biases, who is bounded (M,), and variances (E, n) of the states, by sparse factors.

    A share `LOST` of the information that each bias would have with all else known is added where there is no prior.
    A bias whose variance follows when ten times that is added has no bound.
    """
    joint = JointPrecision.of(model)
    values = np.zeros(len(joint.kept))
    for k in range(len(z)):
        lins = linearise_rows(model, At(tuple(x[k] for x in states), z[k], levels))
        values += joint.values(model, lins, levels) / len(z)
    _check_finite([values])
    on = joint.places.row == joint.places.column
    alone = np.bincount(joint.places.row[on], values[on], joint.places.size)[joint.states :]
    ridge = LOST * np.where(alone > 0, alone, 1.0) * (prior == 0)

    def variances(alpha: np.ndarray) -> np.ndarray:
        return direct_engine().library(joint.places, joint.under(values, Factors.alone(alpha))).inverse_diagonal()[0]

    try:
        variance = variances(prior + ridge)
        loose = variances(prior + 10.0 * ridge) if ridge.any() else variance
    except np.linalg.LinAlgError:
        raise InputError(
            "bounds: rounding hides which biases of so many have none; survey or fix some of those that"
            ' observability names, or take kind="posterior"'
        ) from None
    own, bounded = variance[joint.states :], variance[joint.states :] < FOLLOWS * loose[joint.states :]
    return own, bounded, joint.state_values(variance)


@jax.jit
def average(model: Model, levels: jax.Array, z: jax.Array, states: tuple[jax.Array, ...]) -> Compressed:
    """Expected information of compressed rows, averaged over points z (D, M) and states (D, E, n)."""

    def at(z_d: jax.Array, states_d: tuple[jax.Array, ...]) -> Compressed:
        lins = model.linearise(At(states_d, z_d, levels), expected=True)
        blind = [lin._replace(score=jnp.zeros_like(lin.score)) for lin in lins]  # a bound does not see the data
        return compress(model, blind)

    def add(total: Compressed, point: tuple[jax.Array, tuple[jax.Array, ...]]) -> tuple[Compressed, None]:
        return jax.tree.map(jnp.add, total, at(*point)), None

    shapes = jax.eval_shape(at, z[0], tuple(x[0] for x in states))
    total, _ = jax.lax.scan(add, jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes), (z, states))
    return jax.tree.map(lambda leaf: leaf / z.shape[0], total)


@jax.jit
def _eliminated(model: Model, levels: jax.Array, compressed: Compressed) -> tuple[jax.Array, tuple[Trajectory, ...]]:
    """Information (M, M) of z, trajectories marginalised, and these given z."""
    noises = tuple(jnp.zeros_like(part.drift) for part in model.recursions)
    solved = eliminate_compressed(model, noises, levels, compressed)
    return solved.information, trajectories_of(model, levels, solved)


def invert(information: np.ndarray, alone: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Covariance bound (M, M) from information and its diagonal with all else known (M,), and who is bounded (M,).

    A parameter is bounded where its unit vector lies in the range of the information. The range is taken after
    division by what each parameter would have with all else known, which no choice of units changes; the rows of the
    others hold the generalised inverse, which is right for every function that is bounded.
    """
    if not len(alone):
        return np.zeros((0, 0)), np.zeros(0, bool)
    size = np.sqrt(np.where(alone > 0, alone, 1.0))
    values, vectors = np.linalg.eigh(information / np.outer(size, size))
    lost = values <= LOST
    bounded = np.abs(vectors[:, lost]).max(1, initial=0.0) <= INVOLVED
    inverse = (vectors[:, ~lost] / values[~lost]) @ vectors[:, ~lost].T
    return inverse / np.outer(size, size), bounded


def _tree(
    problem: Problem, kind: str, count: int, sd: np.ndarray, covariance: np.ndarray | None, bounded: np.ndarray,
    variances: list[np.ndarray],
) -> xr.DataTree:  # fmt: skip
    """The tree of standard deviations (M,) and a covariance (M, M) of z, and variances (E, n) of the states."""
    labels, sd = np.array(problem.labels, str), (sd * problem.scales)[bounded]
    own = {"sd": sd, "scale": problem.scales[bounded]}
    bias = xr.Dataset({k: ("bias_label", value) for k, value in own.items()}, coords=bias_coords(problem, bounded))
    if covariance is not None:
        covariance = (covariance * np.outer(problem.scales, problem.scales))[np.ix_(bounded, bounded)]
        bias = bias.assign_coords(bias_label_other=labels[bounded])
        bias["covariance"] = (("bias_label", "bias_label_other"), covariance)
    place = [np.sqrt(v.sum(1)) for v in problem.positions(variances)]
    spread = (("time", "component"), [np.sqrt(v) for v in variances])
    tracks = by_target(problem, {"sd": spread, "position_rmse": (("time",), place)})
    groups = {
        "bias": bias,
        **{f"track/{name}": group for name, group in tracks.items() if name != node_of(NOBODY)},
    }
    message = _message(labels, bounded, sd > problem.scales[bounded])
    if not bounded.all():
        groups["unbounded"] = xr.Dataset(coords=bias_coords(problem, ~bounded))
    tree = xr.DataTree.from_dict(groups)
    tree.attrs.update(kind=kind, draws=count, message=message, data=problem.measurements.table.source)
    return tree


def _message(labels: np.ndarray, bounded: np.ndarray, loose: np.ndarray) -> str:
    """What has no bound, and which of the bounded (M',) have one beyond their scale, in words."""
    found = []
    if not bounded.all():
        open_ = listed(labels[~bounded].tolist(), 12)
        found.append(f"Unbounded: the data say nothing of some combination of {open_}; survey or fix some of them.")
    if loose.any():
        wide = listed(labels[bounded][loose].tolist(), 12)
        found.append(f"Bounded beyond their scale, the data leave them to a prior: {wide}.")
    return " ".join(found) or "Every bias has a bound within its scale."
