"""The density of an association: which detection of each scan is of which object, and which objects there are.

T slots of objects, each present in the whole recording or absent, their number Poisson up to T; detections are missed
and false as `Detection` says. Trajectories and biases are integrated by Laplace's formula at their joint mode, which is
exact where sensors are linear, Gaussian and see all; a field of view is read at the mode.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammaln

from probcal import linalg
from probcal.gaussian import recursion as rec
from probcal.gaussian.mode import Eliminated, Kept, Point, eliminate, factors, follow, log_density
from probcal.gaussian.search import between, halved, zeros_from
from probcal.gaussian.solves import Dense
from probcal.model.epochs import Move
from probcal.model.model import Model
from probcal.priors import Precision
from probcal.tracking.scan import View, Watch, detected, present
from probcal.tracking.update import TINY, Biases, births, rows_from

STEPS = 40  # of Gauss-Newton
SETTLED = 1e-9  # nats at which they end


class Association(NamedTuple):
    """The slot of each scan (T, K) that holds the detection of an object, D where it was missed; who is there (T,)."""

    choice: Any
    present: Any


class First(NamedTuple):
    """The terms of each detection (K, D) alone: evidence, object state, rows about that state."""

    evidence: jax.Array  # (K, D) with the probability of detection
    mean: jax.Array  # (K, D, n)
    covariance: jax.Array  # (K, D, n, n)
    share: jax.Array  # (K,) probability of detection anywhere in the start of the motion
    information: jax.Array  # (K, D, n, n) of the rows about the state, biases held
    pull: jax.Array  # (K, D, n) that times the state, and the score there


class Recording(NamedTuple):
    """The data that the moves read; a pytree: one kernel serves all associations and recordings."""

    watch: Watch
    epoch: jax.Array  # (K,) of each scan in the recursion
    place: tuple[tuple[jax.Array, jax.Array], ...]  # scan and slot (N,) of the rows of each block
    first: First
    z: jax.Array  # (M,) where a search for the mode begins
    prior: Precision
    objects: jax.Array  # () mean number


class Fit(NamedTuple):
    """An association with its trajectories and biases: the density that the chain samples, and the Gaussian there."""

    density: jax.Array  # () log, up to a constant that no association changes
    z: jax.Array  # (M,)
    biases: Dense  # their precision
    states: jax.Array  # (T, E, n)
    noises: jax.Array  # (T, E, n)
    by_bias: rec.Smoothed  # (T, E, n, M) minus what the biases move
    kept: Kept  # T leading
    volume: jax.Array  # () log det of the precisions of all noises


# what is known before any move


@partial(jax.jit, static_argnames="views")
def first_of(watch: Watch, views: tuple[View, ...], cloud: jax.Array, z: jax.Array) -> First:
    """The terms of each detection alone: motion start carried to its scan, biases at z, sd 1."""
    known = Biases(z, jnp.eye(len(z)), jnp.zeros(watch.model.level_spread.shape[0]))

    def carried(carry: tuple[jax.Array, jax.Array], move: Move) -> Any:
        mean, root = carry
        mean, root = move.F @ mean + move.drift, linalg.tria(jnp.concatenate([move.F @ root, move.L], 1))
        return (mean, root), (mean, root)

    _, (means, roots) = jax.lax.scan(carried, (watch.mean, watch.root), watch.scans.epoch.move[0])

    def one(at: Any) -> First:
        scan, mean, root = at
        evidence, x, spread, share = births(watch._replace(mean=mean, root=root), scan, views, cloud, known)
        own, held = jnp.arange(len(x)), known._replace(covariance=jnp.zeros_like(known.covariance))
        seen = jax.vmap(lambda state: rows_from(watch.model, scan, state, held))(x)
        J, score = seen.information[own, own], seen.score[own, own]
        return First(evidence, x, spread, share, J, jnp.einsum("dij,dj->di", J, x) + score)

    return jax.lax.map(one, (watch.scans, means, roots))


def places(numbers: np.ndarray, blocks: list[np.ndarray]) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """Scan and slot of the rows of each block, by the row of the table behind every slot (K, D), -1 of none."""
    found = {int(numbers[k, d]): (k, d) for k, d in np.argwhere(numbers >= 0)}
    pairs = [np.array([found[int(row)] for row in own], int).reshape(-1, 2) for own in blocks]
    return tuple((own[:, 0], own[:, 1]) for own in pairs)


def log_clutter(watch: Watch) -> jax.Array:
    """Log density (K, D) of a false detection, by slot."""
    return jnp.log(jnp.maximum(watch.scans.clutter[:, None] * watch.scans.density, TINY))


# the density of an association


@partial(jax.jit, static_argnames="views")
def fitted(scene: Recording, views: tuple[View, ...], a: Association) -> Fit:
    """The mode of trajectories and biases given an association, and the density of that.

    The search begins where detections say by themselves, smoothed: it depends on the association alone. The system is
    that of its last step, which moves nothing.
    """
    model, prior = scene.watch.model, scene.prior
    part, used = model.recursions[0], model.entries(0)
    levels = jnp.zeros(model.level_spread.shape[0])
    L = factors(part, levels)
    weights = tuple((a.choice[:, k] == d[None]) * 1.0 for k, d in scene.place)

    def of(w: tuple[jax.Array, ...]) -> Model:
        return model.weighted([own[:, None] for own in w])

    def at(x: jax.Array, u: jax.Array, z: jax.Array) -> Point:
        return Point((x,), (u,), z, levels)

    @jax.jit
    def system(x: jax.Array, u: jax.Array, z: jax.Array) -> Eliminated:
        return jax.vmap(lambda w, x, u: eliminate(of(w), at(x, u, z), expected=True))(weights, x, u)

    def cost(x: jax.Array, u: jax.Array, z: jax.Array) -> jax.Array:
        return 0.5 * prior.square(z) - jnp.sum(jax.vmap(lambda w, x, u: log_density(of(w), at(x, u, z)))(weights, x, u))

    def step(state: Any) -> Any:
        (x, u, z), _, value, _, count = state
        solved = system(x, u, z)
        dz = Dense.of(jnp.sum(solved.information, 0) + prior.matrix()).solve(jnp.sum(solved.score, 0) - prior.pull(z))
        moved = jax.vmap(lambda x, u, own: follow(model, at(x, u, z), own.parts, dz))(x, u, solved)
        full = (moved.states[0], moved.noises[0], z + dz)

        def part_way(share: jax.Array) -> tuple[jax.Array, Any]:
            found = between((x, u, z), full, share)
            return cost(*found), found

        _, new, found = halved(part_way, value)
        return found, solved, new, value - new, count + 1

    start = _begun(scene, L, used, a)
    first = ((*start, scene.z), zeros_from(system, *start, scene.z), cost(*start, scene.z), jnp.full((), jnp.inf), 0)
    (x, u, z), solved, value, _, _ = jax.lax.while_loop(lambda s: (s[3] > SETTLED) & (s[4] < STEPS), step, first)
    biases = Dense.of(jnp.sum(solved.information, 0) + prior.matrix())
    (kept,) = solved.parts
    volume = jnp.sum(solved.logdet)
    density = 0.5 * (prior.log_determinant() - volume - biases.log_determinant()) - value
    by_bias = jax.vmap(lambda own: rec.smooth(part.F, own.gain, own.cross))(kept)
    known = density + _counted(scene, views, a, x, z)
    return Fit(known, z, biases, x, u, by_bias, kept, volume)


def _begun(scene: Recording, L: jax.Array, used: tuple[int, ...], a: Association) -> tuple[jax.Array, jax.Array]:
    """States and noises (T, E, n) of what the detections of each slot say by themselves, smoothed."""
    part, first = scene.watch.model.recursions[0], scene.first
    K, D, n = first.mean.shape
    own, taken = jnp.minimum(a.choice, D - 1), a.choice < D
    scans = jnp.arange(K)[None, :]
    J = jnp.where(taken[:, :, None, None], first.information[scans, own], 0.0)
    b = jnp.where(taken[:, :, None], first.pull[scans, own], 0.0)
    shape = (len(a.choice), len(part.drift), n)
    J = jnp.zeros((*shape, n)).at[:, scene.epoch].add(J)
    b = jnp.zeros(shape).at[:, scene.epoch].add(b)

    def one(J: jax.Array, b: jax.Array) -> tuple[jax.Array, jax.Array]:
        smooth = rec.smooth(part.F, rec.gains(part.F, L, J, used), b[:, :, None], part.drift[:, :, None])
        return smooth.states[:, :, 0], smooth.noises[:, :, 0]

    return jax.vmap(one)(J, b)


def chances(scene: Recording, views: tuple[View, ...], states: jax.Array, z: jax.Array) -> jax.Array:
    """Probability (T, K) that each scan detects the object of each slot, by states (T, E, n)."""

    def one(x: jax.Array) -> jax.Array:
        return jax.vmap(lambda scan, at: detected(scene.watch.model, scan, views, at, z))(scene.watch.scans, x)

    return jax.vmap(one)(states[:, scene.epoch])


def _counted(scene: Recording, views: tuple[View, ...], a: Association, states: jax.Array, z: jax.Array) -> jax.Array:
    """Log of what an association says beside the measured values: who is there, what was missed, what is false."""
    there = jax.vmap(present)(scene.watch.scans)
    T, D = len(a.present), there.shape[1]
    taken = a.choice < D
    chance = chances(scene, views, states, z)
    told = jnp.log(jnp.maximum(jnp.where(taken, chance, 1.0 - chance), TINY))
    left = there & ~jnp.any(a.choice[:, :, None] == jnp.arange(D)[None, None], 0)  # (K, D), of no object
    false = jnp.where(left, log_clutter(scene.watch), 0.0)
    number = jnp.sum(a.present)
    known = number * jnp.log(scene.objects) + gammaln(T - number + 1.0)
    return known + jnp.sum(jnp.where(a.present[:, None], told, 0.0)) + jnp.sum(false)
