"""From a problem to a posed posterior: a start, a frame that is moved to where a pilot finds the mass, its worth."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal.gaussian.frame import Frame, frame_at, log_weight, place, refined
from probcal.gaussian.mode import Point, smooth_tracks
from probcal.inference.gibbs import gibbs_sweep
from probcal.inference.hierarchy import Phi, hierarchy_of
from probcal.inference.posed import Form, Posed, activity, conditional
from probcal.inference.psis import smoothed
from probcal.model.model import Model
from probcal.model.trajectories import States
from probcal.priors import Prior
from probcal.problem import Problem

PILOTS = 4  # chains of the pilot
BURN, KEPT, STRIDE = 100, 100, 4  # sweeps before, draws kept of each pilot, sweeps between two
FITS, GOOD = 0.5, 0.9  # Pareto k-hat and acceptance of a new theta at which a frame is left alone
SCARCE = 0.1  # acceptance below which it has failed: leaps are rare
ROUNDS = 4  # trajectories at which that acceptance is judged, each by as small a part of the draws
TAILED = 25  # draws below which a Pareto tail cannot be fitted
FITTINGS, FITTED = 2, 20  # rounds and draws (with mirror images) that a frame is fitted to
SPREAD = 1.5  # by how much chains start further out than the pilot's draws
DRAWN_IN = 0.3  # factor by which draws of a bad frame are scaled down, several times if needed


class Pilot(NamedTuple):
    """Independent-looking draws of the frame's posterior, leading dims (draws,)."""

    theta: jax.Array
    phi: Phi


class Worth(NamedTuple):
    """The importance diagnostics of a Gaussian reference for the joint posterior."""

    khat: float  # Pareto k-hat of the weights of its draws
    acceptance: float  # of a new theta, trajectories held in the frame's coordinates
    whole: float  # acceptance of theta and trajectories together
    moves: int

    @property
    def failed(self) -> bool:
        """True if leaps on the frame would hardly ever be taken."""
        return self.acceptance < SCARCE

    @property
    def good(self) -> bool:
        """True if the frame may be left where it is."""
        return self.khat < FITS and self.acceptance > GOOD

    def order(self, *, whole: bool) -> tuple[float, float]:
        """The better one is larger, for leaps or for independent draws of the whole."""
        return (self.whole if whole else min(self.acceptance, GOOD)), -self.khat


@partial(jax.jit, static_argnames="form")
def pilot(form: Form, posed: Posed, key: jax.Array) -> Pilot:
    """Gibbs on the frame alone, from over-dispersed draws of the prior of the hyper-parameters."""

    def chain(key: jax.Array) -> tuple[jax.Array, Phi]:
        start, first, run = jax.random.split(key, 3)
        phi = form.hierarchy.draw(start)
        theta = conditional(form, posed, phi).draw(first)

        def one(carry: Any, k: jax.Array) -> tuple[Any, Any]:
            theta, phi = carry
            found = gibbs_sweep(form, posed, theta, phi, jax.random.fold_in(run, k), backwards=False)
            return found, found

        _, found = jax.lax.scan(one, (theta, phi), jnp.arange(BURN + STRIDE * KEPT))
        return jax.tree.map(lambda leaf: leaf[BURN::STRIDE], found)

    found = jax.lax.map(chain, jax.random.split(key, PILOTS))
    return Pilot(*jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), found))


@jax.jit
def weights(posed: Posed, theta: jax.Array, keys: jax.Array) -> jax.Array:
    """Log weights (D,) of draws theta (D, Q), trajectories drawn from the frame by keys (D,)."""

    def one(pair: tuple[jax.Array, jax.Array]) -> jax.Array:
        eps = posed.frame.normals(jax.random.split(pair[1], len(posed.frame.loops)))
        return log_weight(posed.model, posed.frame, pair[0], eps)

    return jax.lax.map(one, (theta, keys))


def weights_along(posed: Posed, theta: jax.Array, key: jax.Array) -> jax.Array:
    """Log weights (ROUNDS, D) of draws theta (D, Q), all of a round with the same trajectories from the frame."""
    keys = jax.random.split(key, ROUNDS)[np.repeat(np.arange(ROUNDS), len(theta))]
    return weights(posed, jnp.tile(theta, (ROUNDS, 1)), keys).reshape(ROUNDS, -1)


def moved(model: Model, frame: Frame, theta: jax.Array, key: jax.Array) -> Frame:
    """The frame at the mean of draws theta (D, Q), trajectories at their mode, then fitted to the draws."""
    frame = frame_at(model, smooth_tracks(model, _middle(model, frame, theta)))
    for k in range(FITTINGS):
        eps = _fitting(frame, jax.random.fold_in(key, k))
        frame = refined(model, frame, theta[:: theta.shape[0] // FITTED][:FITTED], eps)
    return frame


@jax.jit
def _middle(model: Model, frame: Frame, theta: jax.Array) -> Point:
    resting = tuple(jnp.zeros_like(x) for x in frame.point.states)
    return place(model, frame, jnp.mean(theta, 0), resting)


@jax.jit
def _fitting(frame: Frame, key: jax.Array) -> States:
    return jax.vmap(frame.normals)(jax.random.split(key, (FITTED, len(frame.loops))))


def pareto_khat(log_weights: np.ndarray) -> float:
    """Pareto k-hat of log weights (D,); 0 where they are all equal, infinite where it cannot be told."""
    if len(log_weights) < TAILED or not np.isfinite(log_weights).all():
        return np.inf
    if np.ptp(log_weights) < 1e-6:
        return 0.0
    return float(smoothed(log_weights[None])[1][0])


def acceptance(log_weights: np.ndarray) -> float:
    """Expected acceptance of an independent draw by an independence sampler, from log weights (D,) of such draws."""
    if not np.isfinite(log_weights).any():
        return 0.0
    weight = np.exp(log_weights - log_weights.max())
    return float(np.minimum(weight[:, None], weight[None, :]).mean() / weight.mean())


def pose(
    problem: Problem, prior: Prior, start: Point, key: jax.Array, *, whole: bool = False
) -> tuple[Form, Posed, Pilot, Worth]:
    """The posterior of a problem posed around a start, the draws of its pilot, and the frame's worth.

    The frame is moved to the mean of the pilot's draws until their weights say that it fits. The best one is that for
    leaps, or where the `whole` is drawn at once that for independent draws.
    """
    model = problem.model
    form = Form(model.biases, hierarchy_of(prior, problem))
    posed = Posed(model, frame_at(model, start), problem.first_precision(prior))
    best = None
    for move in range(2):  # further moves made few frames better, and some worse
        keys = jax.random.split(jax.random.fold_in(key, move), 3)
        found = pilot(form, posed, keys[0])
        logs = np.asarray(weights(posed, found.theta, jax.random.split(keys[1], len(found.theta))))
        held = np.asarray(weights_along(posed, found.theta[::ROUNDS], keys[1]))
        worth = Worth(pareto_khat(logs), float(np.mean([acceptance(own) for own in held])), acceptance(logs), move)
        if best is None or worth.order(whole=whole) > best[2].order(whole=whole):
            best = posed, found, worth
        if worth.good:
            break
        draws = found.theta
        frame = moved(model, posed.frame, draws, keys[2])
        if not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(frame)):
            break
        posed = posed._replace(frame=frame)
    assert best is not None
    if best[2].failed:
        best = *_nearby(form, best[0], key), best[2]
    return form, *best


def _nearby(form: Form, bad: Posed, key: jax.Array) -> tuple[Posed, Pilot]:
    """The frame as if each entry of theta were also measured with sd 1, and draws near its point.

    Draws of a frame that does not fit lie where the joint density is absurd. They are scaled down
    about the point until the density there is lower by no more than one nat per entry of theta.
    """
    frame, share = bad.frame, 1.0
    near = bad._replace(frame=frame._replace(information=frame.information + jnp.eye(len(frame.theta))))
    found = pilot(form, near, key)
    away = (found.theta - frame.theta)[:: len(found.theta) // FITTED]
    keys = jnp.broadcast_to(key, (len(away) + 1, *key.shape))
    for power in range(5):
        share = DRAWN_IN**power
        theta = frame.theta + share * jnp.concatenate([jnp.zeros_like(away[:1]), away])
        here, *there = np.asarray(weights(near, theta, keys))
        if np.median(there) > here - len(frame.theta):
            break
    return near, found._replace(theta=frame.theta + share * (found.theta - frame.theta))


def chain_start(form: Form, posed: Posed, found: Pilot, k: int, chains: int) -> tuple[jax.Array, Phi]:
    """theta and phi of chain k: a draw of the pilot, further out than it lies."""
    pick = (k * found.theta.shape[0]) // chains
    phi = jax.tree.map(lambda leaf: leaf[pick], found.phi)
    mean = found.theta.mean(0)
    theta = mean + SPREAD * (found.theta[pick] - mean)
    return jnp.where(activity(form, posed, phi), theta, 0.0), phi
