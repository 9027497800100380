"""Smoothed particles of all targets at the epochs of a model, and what they say of states, biases and levels."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from probcal.model.model import At, Model, scaled
from probcal.particles.backward import smooth_particles
from probcal.particles.conditional import conditional_paths
from probcal.particles.filtering import run_filter
from probcal.particles.settings import ParticleSettings
from probcal.particles.targets import Targets, along_targets, place_by_epoch

DRAWS = 20  # paths that are read off one conditional filter
AT_ONCE = 25  # paths whose rows are linearised together


class Ensemble(NamedTuple):
    """Smoothed particles of every recursion: N at each of E epochs, in the order of the recursion."""

    states: tuple[Any, ...]  # (E, N) leading
    weights: tuple[jax.Array, ...]  # (E, N)
    log_evidence: jax.Array  # () of all targets
    lost: tuple[jax.Array, ...]  # (E,) whether no particle could have given the rows of an epoch

    def path(self, n: Any) -> tuple[Any, ...]:
        """States (E leading) of each recursion along path n."""
        return jax.tree.map(lambda leaf: leaf[:, n], self.states)

    def row_weights(self, model: Model, n: Any) -> list[jax.Array]:
        """Weight (N,) of path n at the epoch of each row, for each block; 0 beyond the last path."""
        count = self.weights[0].shape[1]
        return [
            jnp.where(n < count, self.weights[r][data.epoch, jnp.minimum(n, count - 1)], 0.0)
            for _, data, r in model.each_block()
        ]


class StateMoments(NamedTuple):
    """The moments of the vectors that rows read from the states of one recursion."""

    mean: jax.Array  # (E, n)
    variance: jax.Array  # (E, n)


class Expectation(NamedTuple):
    """Of the log-likelihood by biases z and log levels, smoothed particles in the place of the states."""

    score: jax.Array  # (M,)
    information: jax.Array  # (M, M) at given states, expected over them
    spread: jax.Array  # (M, M) covariance of the score over the paths: what the states take away (Louis 1982)


@partial(jax.jit, static_argnames="how")
def ensemble(
    model: Model, targets: tuple[Targets, ...], z: jax.Array, levels: jax.Array, key: jax.Array, how: ParticleSettings
) -> Ensemble:
    """Filter and smooth every target of a model."""
    found: list[Any] = []
    for r, own in enumerate(targets):

        def one(epochs: Any, there: jax.Array, key: jax.Array, own: Targets = own) -> Any:
            keys = jax.random.split(key)
            filtered = run_filter(own.model, epochs, there, z, levels, keys[0], how)
            return smooth_particles(own.model, filtered, epochs, there, levels, keys[1], how)

        seeds, E = jax.random.split(jax.random.fold_in(key, r), len(own.there)), model.recursions[r].time.shape[0]
        smoothed = jax.vmap(one)(own.epochs, own.there, seeds)
        put = partial(place_by_epoch, own.place, E=E)
        states = jax.tree.map(lambda leaf, put=put: put(leaf[:, :, :, 0]), smoothed.states[0])
        found.append((states, put(smoothed.weights), jnp.sum(smoothed.log_evidence), put(smoothed.lost)))
    states, weights, evidence, lost = zip(*found, strict=True)
    return Ensemble(states, weights, jnp.sum(jnp.stack(evidence)), lost)


@partial(jax.jit, static_argnames="how")
def filter_ensemble(
    model: Model, targets: tuple[Targets, ...], z: jax.Array, levels: jax.Array, key: jax.Array, how: ParticleSettings
) -> Ensemble:
    """Filter every target of a model: particles as they are weighed at each epoch, none smoothed."""
    found: list[Any] = []
    for r, own in enumerate(targets):

        def one(epochs: Any, there: jax.Array, key: jax.Array, own: Targets = own) -> Any:
            return run_filter(own.model, epochs, there, z, levels, key, how)

        seeds, E = jax.random.split(jax.random.fold_in(key, r), len(own.there)), model.recursions[r].time.shape[0]
        filtered = jax.vmap(one)(own.epochs, own.there, seeds)
        put = partial(place_by_epoch, own.place, E=E)
        drawn = jax.tree.map(lambda leaf, put=put: put(leaf[:, :, :, 0]), filtered.states[0])
        told = jnp.sum(filtered.log_evidence)
        found.append((drawn, put(jnp.exp(filtered.log_weights)), told, put(filtered.lost)))
    states, weights, evidence, lost = zip(*found, strict=True)
    return Ensemble(states, weights, jnp.sum(jnp.stack(evidence)), lost)


def conditional_ensemble(
    model: Model, targets: tuple[Targets, ...], paths: tuple[Any, ...], z: jax.Array, levels: jax.Array,
    key: jax.Array, how: ParticleSettings,
) -> tuple[Ensemble, tuple[Any, ...]]:  # fmt: skip
    """Paths of every target drawn given one (T, K, 1, ...) of each recursion, and the next one to be given."""
    found: list[Any] = []
    for r, (own, path) in enumerate(zip(targets, paths, strict=True)):

        def one(epochs: Any, there: jax.Array, given: Any, key: jax.Array, own: Targets = own) -> Any:
            return conditional_paths(own.model, epochs, there, (given,), z, levels, key, how, DRAWS)[0][0]

        seeds, E = jax.random.split(jax.random.fold_in(key, r), len(own.there)), model.recursions[r].time.shape[0]
        drawn = jax.vmap(one)(own.epochs, own.there, path, seeds)  # (T, K, draws, 1, ...)
        seen = jax.tree.map(lambda leaf, own=own, E=E: place_by_epoch(own.place, leaf[:, :, :, 0], E), drawn)
        found.append(
            (
                seen,
                jnp.full((E, DRAWS), 1.0 / DRAWS),
                jnp.zeros(E, bool),
                jax.tree.map(lambda leaf: leaf[:, :, 0], drawn),
            )
        )
    states, weights, lost, after = zip(*found, strict=True)
    return Ensemble(states, weights, jnp.zeros(()), lost), after


def first_paths(targets: tuple[Targets, ...], found: Ensemble) -> tuple[Any, ...]:
    """One path (T, K, 1, ...) of each recursion out of many."""
    return jax.tree.map(lambda leaf: leaf[:, :, None], _by_target(targets, found.path(0)))


def _by_target(targets: tuple[Targets, ...], states: tuple[Any, ...]) -> tuple[Any, ...]:
    """States (E leading) of each recursion as (T, K, ...)."""
    pairs = zip(targets, states, strict=True)
    return tuple(jax.tree.map(partial(along_targets, own.place), path) for own, path in pairs)


@jax.jit
def vectors_of(model: Model, states: tuple[Any, ...]) -> tuple[jax.Array, ...]:
    """The vectors (E, N, n) that rows read from particles (E, N leading) of each recursion."""
    return jax.vmap(model.vectors_of, 1, 1)(states)


@jax.jit
def state_moments(model: Model, found: Ensemble) -> tuple[StateMoments, ...]:
    """Mean and variance of what rows see of the states of each recursion."""

    def moments(_: Any, seen: jax.Array, weights: jax.Array) -> StateMoments:
        mean = jnp.einsum("en,enu->eu", weights, seen)
        return StateMoments(mean, jnp.einsum("en,enu->eu", weights, (seen - mean[:, None]) ** 2))

    return model.each(moments, vectors_of(model, found.states), found.weights)


@jax.jit
def nearest_states(model: Model, found: Ensemble) -> tuple[Any, ...]:
    """States (E leading) that stand for the particles: their mean, or, of a motion without linear form, the particle
    that is nearest to the mean of all that rows see, in units of its sd, so that it is on the road (Paper A 43).
    """

    def nearest(_: Any, states: Any, seen: jax.Array, weights: jax.Array, form: Any) -> Any:
        if form is None:
            return jnp.einsum("en,enu->eu", weights, states)
        off = seen - jnp.einsum("en,enu->eu", weights, seen)[:, None]
        variance = jnp.einsum("en,enu->eu", weights, off**2)[:, None]
        away = jnp.sum(off**2 / jnp.maximum(variance, 1e-12), 2)
        best = jnp.argmin(jnp.where(weights > 0, away, jnp.inf), 1)
        return jax.tree.map(lambda leaf: jax.vmap(lambda own, j: own[j])(leaf, best), states)

    return model.each(nearest, found.states, vectors_of(model, found.states), found.weights, model.sampled)


def at_states(model: Model, states: tuple[Any, ...], z: jax.Array, levels: jax.Array) -> Expectation:
    """Score and information of the biases at single states, of no spread (Paper A 16-20)."""
    information, score = model.of_biases(model.linearise_biases(At(states, z, levels), expected=True))
    return Expectation(score, information, jnp.zeros_like(information))


def over_paths(
    model: Model, found: Ensemble, z: jax.Array, levels: jax.Array, *, observed: bool = False
) -> Expectation:
    """Score, information and spread of the score of the biases over smoothed particles.

    The information is that of the model, or with `observed` the curvature that the data have: less the spread, it is
    then the curvature of the marginal likelihood (Louis 1982). The spread has a meaning where the particles form
    paths, all of one weight.
    """
    N, M = found.weights[0].shape[1], model.biases
    count = -(-N // AT_ONCE)

    def one(n: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        at, shares = At(found.path(jnp.minimum(n, N - 1)), z, levels), found.row_weights(model, n)
        lins = model.linearise_biases(at, expected=True)
        information, score = model.of_biases(scaled(lins, [share[:, None] for share in shares]))
        if observed:
            information = model.curvature_by_biases(at, shares)
        return information, score, jnp.where(n < N, score * N, 0.0)

    def some(carry: Any, k: jax.Array) -> tuple[Any, None]:
        information, score, each = jax.vmap(one)(k * AT_ONCE + jnp.arange(AT_ONCE))
        added = (jnp.sum(information, 0), jnp.sum(score, 0), each.T @ each / N)
        return jax.tree.map(jnp.add, carry, added), None

    blank = (jnp.zeros((M, M)), jnp.zeros(M), jnp.zeros((M, M)))
    (information, score, square), _ = jax.lax.scan(some, blank, jnp.arange(count))
    return Expectation(score, information, square - score[:, None] * score[None, :])


expected_over_paths = jax.jit(over_paths)
observed_over_paths = jax.jit(partial(over_paths, observed=True))


def log_likelihood_over(model: Model, found: Ensemble, z: jax.Array, levels: jax.Array) -> jax.Array:
    """Log-likelihood () of all rows expected over smoothed particles."""
    N = found.weights[0].shape[1]

    def one(n: jax.Array) -> jax.Array:
        told = model.log_likelihood(At(found.path(jnp.minimum(n, N - 1)), z, levels))
        pairs = zip(found.row_weights(model, n), told, strict=True)
        return sum((jnp.sum(share[:, None] * part) for share, part in pairs), jnp.zeros(()))

    def some(total: jax.Array, k: jax.Array) -> tuple[jax.Array, None]:
        return total + jnp.sum(jax.vmap(one)(k * AT_ONCE + jnp.arange(AT_ONCE))), None

    return jax.lax.scan(some, jnp.zeros(()), jnp.arange(-(-N // AT_ONCE)))[0]


def log_motion_over(targets: tuple[Targets, ...], found: Ensemble, levels: jax.Array) -> jax.Array:
    """Log density () of the steps of all targets expected over paths: by it the levels of process noise are learnt."""
    paths = _by_target(targets, found.states)

    def one(n: jax.Array) -> jax.Array:
        alone = jax.tree.map(lambda leaf: leaf[:, :, n][:, :, None], paths)
        return log_motion_of(targets, alone, levels)

    return jnp.mean(jax.vmap(one)(jnp.arange(found.weights[0].shape[1])))


def log_motion_of(targets: tuple[Targets, ...], paths: tuple[Any, ...], levels: jax.Array) -> jax.Array:
    """Log density () of the steps of all targets along paths (T, K, 1, ...), their starts left out."""
    total = jnp.zeros(())
    for own, states in zip(targets, paths, strict=True):

        def along(path: Any, epochs: Any, there: jax.Array, own: Targets = own) -> jax.Array:
            old, new = (jax.tree.map(lambda leaf, c=c: leaf[c], path) for c in (slice(None, -1), slice(1, None)))
            later = jax.tree.map(lambda leaf: leaf[1:], epochs)
            each = jax.vmap(lambda a, b, epoch: own.model.log_step((a,), (b,), epoch, levels))(old, new, later)
            return jnp.sum(jnp.where(there[1:], each, 0.0))

        if own.there.shape[1] > 1:
            total = total + jnp.sum(jax.vmap(along)(states, own.epochs, own.there))
    return total


def moved_levels(
    model: Model, targets: tuple[Targets, ...], found: Ensemble, z: jax.Array, levels: jax.Array
) -> jax.Array:
    """One Newton step of the log levels up their expectation over paths, with their log-normal prior."""

    def value(levels: jax.Array) -> jax.Array:
        prior = -0.5 * jnp.sum((levels / model.level_spread) ** 2)
        motion = log_motion_over(targets, found, levels) if model.driven else 0.0
        return log_likelihood_over(model, found, z, levels) + motion + prior

    slope, curvature = jax.grad(value)(levels), jnp.diagonal(jax.jacfwd(jax.jacfwd(value))(levels))
    step = slope / jnp.maximum(-curvature, 1.0 / model.level_spread**2)
    return levels + jnp.clip(jnp.where(jnp.isfinite(step), step, 0.0), -1.0, 1.0)
