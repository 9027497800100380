"""Cramer-Rao bounds of biases and tracks: what no estimator can do better on a problem, before any fit.

The trajectory is a random nuisance whose density is that of the motion. Where an expectation is taken, the information
of every row is averaged over the draws and the trajectory eliminated from the average: the bound of van Trees (1968,
2.4.3) for biases and whitened motion noise together, and the hybrid one (Rockah, Schultheiss 1987). Averages of
eliminated systems would be no bound.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from probcal import linalg
from probcal.analysis.standpoint import draw_states, on_tracks_of, true_biases, true_point
from probcal.errors import InputError, check_known
from probcal.gaussian.choose import choose
from probcal.gaussian.engine import Expansion, Factors, told_alone
from probcal.gaussian.mode import Point
from probcal.labels import NOBODY, listed
from probcal.linalg import spectrum
from probcal.model.model import At, Model
from probcal.model.rows import Linearised, LinearRows
from probcal.model.trajectories import States
from probcal.problem import Problem
from probcal.results.groups import along, bias_coords, by_target, node_of
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
    names those whose bound exceeds their scale. A large network of more than 600 biases has no `covariance`; there a
    bias has no bound where its variance grows with the inverse of a precision of that share of its information.
    Raises `InputError` for an unknown kind or label, tracks with gaps, and draws at which a sensor is not finite.

    >>> bounds(problem)["bias"]["sd"].sizes["bias_label"]
    12
    """
    check_known(kind, KINDS, f'bounds: kind is "{kind}"')
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
    at = _averaged(model, levels, z, states)
    alone = told_alone(at) + prior
    information = at.information()
    if information is None:
        # variance (M,) of the biases, who is bounded (M,), and variances (E, n) of the states
        ridge = LOST * np.where(alone > 0, alone, 1.0) * (prior == 0)
        try:
            found = at.spread(Factors.alone(prior + ridge))
            loose = at.spread(Factors.alone(prior + 10.0 * ridge)) if ridge.any() else found
        except np.linalg.LinAlgError:
            raise InputError(
                "bounds: rounding hides which biases of so many have none; survey or fix some of those that"
                ' observability names, or take kind="posterior"'
            ) from None
        variance, bounded, spread = found.biases, found.biases < FOLLOWS * loose.biases, found.states
        return _tree(problem, kind, len(z), np.sqrt(variance), None, bounded, spread)
    root, bounded = _bounded_root(information + np.diag(prior), alone)
    covariance = root @ root.T
    return _tree(problem, kind, len(z), np.sqrt(np.diagonal(covariance)), covariance, bounded, at.followed(root))


def _averaged(model: Model, levels: jax.Array, z: jax.Array, states: States) -> Expansion:
    """The information of all rows, averaged over points z (D, M) and states (D, E, n), and the trajectories."""
    rows = _average(model, levels, z, states)
    if not all(bool(np.isfinite(leaf).all()) for leaf in jax.tree.leaves(rows)):
        raise InputError("bounds: a sensor is not finite at the trajectories drawn; give truth=Truth(tracks)")
    first = tuple(x[0] for x in states)
    return choose(model).at(model, Point(first, tuple(jnp.zeros_like(x) for x in first), z[0], levels), rows)


@jax.jit
def _average(model: Model, levels: jax.Array, z: jax.Array, states: States) -> LinearRows:
    """Rows of the expected information, averaged over points z (D, M) and states (D, E, n), without scores.

    The average of H'WH of a row is the information of as many data as the row reads states and biases.
    """

    def at(z_d: jax.Array, states_d: States) -> list[jax.Array]:
        lins = model.linearise(At(states_d, z_d, levels), expected=True)
        both = [(jnp.concatenate([lin.state, lin.bias], 2), lin.weight) for lin in lins]
        return [jnp.einsum("ncv,nc,ncw->nvw", H, weight, H) for H, weight in both]

    def add(total: list[jax.Array], point: tuple[jax.Array, States]) -> tuple[list[jax.Array], None]:
        return jax.tree.map(jnp.add, total, at(*point)), None

    shapes = jax.eval_shape(at, z[0], tuple(x[0] for x in states))
    total, _ = jax.lax.scan(add, jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes), (z, states))
    return tuple(_rooted(own / len(z), len(block.used)) for block, _, _, own in model.each_block(total))


def _rooted(information: jax.Array, used: int) -> Linearised:
    """Data of weight one that have the information (N, v, v), about `used` states and then biases."""
    size = jnp.sqrt(jnp.diagonal(information, axis1=1, axis2=2))
    size = jnp.where(size == 0, 1.0, size)
    values, vectors = linalg.spectrum(information / linalg.outer(size))
    root = jnp.sqrt(jnp.maximum(values, 0.0))[:, :, None] * vectors.mT * size[:, None, :]
    return Linearised(jnp.zeros_like(size), jnp.ones_like(size), root[:, :, :used], root[:, :, used:])


def _bounded_root(information: np.ndarray, alone: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Root (M, R) of the covariance bound, from information (M, M) and that with all else known (M,); who is bounded.

    A parameter is bounded where its unit vector lies in the range of the information. The range is taken after
    division by what each parameter would have with all else known, which no choice of units changes; the rows of the
    others hold the generalised inverse, which is right for every function that is bounded.
    """
    if not len(alone):
        return np.zeros((0, 0)), np.zeros(0, bool)
    size = np.sqrt(np.where(alone > 0, alone, 1.0))
    values, vectors = spectrum(information / np.outer(size, size))
    lost = values <= LOST
    bounded = np.abs(vectors[:, lost]).max(1, initial=0.0) <= INVOLVED
    return vectors[:, ~lost] / np.sqrt(values[~lost]) / size[:, None], bounded


def _tree(
    problem: Problem, kind: str, count: int, sd: np.ndarray, covariance: np.ndarray | None, bounded: np.ndarray,
    variances: Sequence[np.ndarray],
) -> xr.DataTree:  # fmt: skip
    """The tree of standard deviations (M,) and a covariance (M, M) of z, and variances (E, n) of the states."""
    labels, sd = np.array(problem.labels, str), (sd * problem.scales)[bounded]
    own = {"sd": sd, "scale": problem.scales[bounded]}
    bias = xr.Dataset(along("bias_label", own), coords=bias_coords(problem, bounded))
    if covariance is not None:
        covariance = (covariance * np.outer(problem.scales, problem.scales))[np.ix_(bounded, bounded)]
        bias = bias.assign_coords(bias_label_other=labels[bounded])
        bias["covariance"] = (("bias_label", "bias_label_other"), covariance)
    variances = [np.maximum(v, 0.0) for v in variances]
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
    """A message on biases without a bound, and bounded ones (M',) whose bound exceeds their
    scale."""
    found = []
    if not bounded.all():
        open_ = listed(labels[~bounded].tolist(), 12)
        found.append(f"Unbounded: the data say nothing of some combination of {open_}; survey or fix some of them.")
    if loose.any():
        wide = listed(labels[bounded][loose].tolist(), 12)
        found.append(f"Bounded beyond their scale, the data leave them to a prior: {wide}.")
    return " ".join(found) or "Every bias has a bound within its scale."
