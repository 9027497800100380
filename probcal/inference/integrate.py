"""Precisions integrated: a mixture of Gaussians of the biases around their Gaussian likelihood.

At a point the data leave a Gaussian likelihood of the biases in natural form, G and G z + g, g the score of the
marginal density. Gibbs sweeps over hyper-parameters and biases sample what a hierarchical prior makes of it; the point
then moves to the mean of the mixture, once, and the sweeps go on. Noise levels are held.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr

from probcal import linalg
from probcal.inference.gibbs import gibbs_sweep
from probcal.inference.hierarchy import Phi
from probcal.inference.posed import Form, Natural, activity, draw_given, prior_precision
from probcal.inference.propagate import Propagated, nodes_of, propagate
from probcal.model.model import Model
from probcal.priors import Precision
from probcal.results.schema import INTERVAL
from probcal.smoothing.linearised import compress_and_eliminate, linearise_rows
from probcal.smoothing.marginal import volume_slope
from probcal.smoothing.mode import Eliminated, Point, smooth_tracks

CHAINS, BURN, FIRST, KEPT = (
    4,
    60,
    120,
    500,
)  # sweeps: before, around the mode, and around the mean, whose draws are kept
EVERY = 5  # kept draws between two whose conditional Gaussian enters the moments
MOVES, NEAR = 6, 1.0  # most times that the point moves to the mean, and sd by which it may have moved at the last
HALVINGS = 40  # of the bracket of a quantile


@dataclass(frozen=True)
class Integration:
    """The static part: what the integration is compiled for."""

    form: Form
    marginal: bool  # whether the determinant of the trajectories belongs to the likelihood; not at a joint mode
    sweeps: bool = True  # Gibbs; else expectation propagation, for biases that are many


class Moments(NamedTuple):
    """What a mixture says of the biases z."""

    mean: jax.Array  # (M,)
    covariance: jax.Array  # (M, M)
    lower: jax.Array  # (M,) of the interval
    upper: jax.Array  # (M,)
    gamma: jax.Array  # (M,)


class Integrated(NamedTuple):
    """Where the integration ended: the mixture, its draws, and the likelihood behind it."""

    point: Point  # biases at the mean, trajectories at their mode
    information: jax.Array  # (M, M) of the data about z
    moments: Moments
    z: jax.Array  # (CHAINS, KEPT, M)
    phi: Phi  # leading dims (CHAINS, KEPT)
    settled: Any = True  # whether a propagation came to rest


def integrate(
    how: Integration, model: Model, first: Precision, start: Point, key: jax.Array, *, search: bool = False
) -> Integrated:
    """Integrate the hyper-parameters of a hierarchy, from a mode of the biases under their declared scales.

    `first` is the prior of what no hierarchy governs. Once the mean of the mixture is known the likelihood is taken
    there; with `search`, which no kernel can hold, until the mean moves by less than an sd.
    """
    known, _ = likelihood(how, model, first, start)
    nodes = None if how.sweeps else nodes_of(how.form)
    chains = begin(how.form, known, jax.random.fold_in(key, 0)) if how.sweeps else None
    point = start
    for turn in range(MOVES if search else 1):
        own = jax.random.fold_in(key, turn + 2)
        if nodes is None:
            chains, swept = run_sweeps(how.form, known, chains, own, FIRST)
            mean, spread = swept.mean, swept.spread
        else:
            found = propagate(how.form, known, nodes, own, CHAINS * KEPT)
            mean, spread = found.mean, jnp.sqrt(jnp.diagonal(found.covariance))
        before = point.z
        point, known = recentred(how, model, point, known, mean)
        if search and np.max(np.abs(np.asarray(point.z) - before) / np.maximum(spread, 1e-9), initial=0.0) < NEAR:
            break
    if nodes is not None:
        return _propagated(how, model, known, point, propagate(how.form, known, nodes, key, CHAINS * KEPT))
    _, swept = run_sweeps(how.form, known, chains, jax.random.fold_in(key, 1), KEPT)
    total = moments(how.form, known, swept.phi)
    return Integrated(point_at(model, point, total.mean), known.information, total, swept.z, swept.phi)


def _propagated(how: Integration, model: Model, known: Natural, point: Point, found: Propagated) -> Integrated:
    """What expectation propagation leaves, which draws nothing of the hyper-parameters."""
    tail = 50.0 * (1.0 - INTERVAL)
    lower, upper = jnp.percentile(found.z, jnp.array([tail, 100.0 - tail]), axis=0)
    total = Moments(found.mean, found.covariance, lower, upper, found.gamma)
    z = found.z.reshape(CHAINS, KEPT, how.form.biases)
    return Integrated(point_at(model, point, found.mean), known.information, total, z, {}, found.settled)


def likelihood(how: Integration, model: Model, first: Precision, point: Point) -> tuple[Natural, jax.Array]:
    """The Gaussian likelihood of the biases at a point, and whether it is one."""
    _, solved = compress_and_eliminate(model, point, linearise_rows(model, point))
    volume, smooth = (
        volume_slope(model, point, solved) if how.marginal else (jnp.zeros_like(point.z), jnp.ones((), bool))
    )
    return _natural(point.z, first, solved, volume, smooth)


@jax.jit
def _natural(
    z: jax.Array, first: Precision, solved: Eliminated, volume: jax.Array, smooth: jax.Array
) -> tuple[Natural, jax.Array]:
    score = solved.score - 0.5 * volume
    pull = solved.information @ z + score
    sound = smooth & jnp.all(jnp.isfinite(solved.information)) & jnp.all(jnp.isfinite(pull))
    return Natural(solved.information, pull, jnp.zeros(0), first), sound


def point_at(model: Model, point: Point, z: jax.Array) -> Point:
    """The point at biases z (M,), trajectories at their mode."""
    return smooth_tracks(model, point._replace(z=z))


def recentred(how: Integration, model: Model, point: Point, known: Natural, mean: jax.Array) -> tuple[Point, Natural]:
    """Point and likelihood at a mean (M,); as they were where there is no likelihood at the mean."""
    moved = point_at(model, point, mean)
    after, sound = likelihood(how, model, known.first, moved)
    return chosen(sound, (moved, after), (point, known))


@jax.jit
def chosen(first: jax.Array, one: Any, other: Any) -> Any:
    """One pytree or the other."""
    return jax.tree.map(lambda a, b: jnp.where(first, a, b), one, other)


@partial(jax.jit, static_argnames="form")
def begin(form: Form, known: Natural, key: jax.Array) -> tuple[jax.Array, Phi]:
    """Biases and hyper-parameters that each chain starts from: drawn from the prior, so further out than the data."""

    def one(own: jax.Array) -> tuple[jax.Array, Phi]:
        phi = form.hierarchy.begin(own)
        return draw_given(form, known, phi, jax.random.fold_in(own, 1)), phi

    return jax.lax.map(one, jax.random.split(key, CHAINS))


class Swept(NamedTuple):
    """Draws of all chains; zeros beyond those that were asked for."""

    z: jax.Array  # (CHAINS, KEPT, M)
    phi: Phi  # leading dims (CHAINS, KEPT)
    mean: jax.Array  # (M,)
    spread: jax.Array  # (M,) their sd


@partial(jax.jit, static_argnames="form")
def run_sweeps(form: Form, known: Natural, chains: Any, key: jax.Array, count: int) -> tuple[Any, Swept]:
    """`count` sweeps of every chain from where it stands, after those of the burn-in; also where the chains end."""

    def chain(pair: tuple[Any, jax.Array]) -> tuple[Any, Any]:
        def one(k: jax.Array, state: Any) -> Any:
            (theta, phi), drawn = state
            at = gibbs_sweep(form, known, theta, phi, jax.random.fold_in(pair[1], k), backwards=False)
            return at, jax.tree.map(lambda kept, leaf: kept.at[jnp.maximum(k - BURN, 0)].set(leaf), drawn, at)

        blank = jax.tree.map(lambda leaf: jnp.zeros((KEPT, *leaf.shape), leaf.dtype), pair[0])
        return jax.lax.fori_loop(0, BURN + count, one, (pair[0], blank))

    ends, (z, phi) = jax.lax.map(chain, (chains, jax.random.split(key, CHAINS)))
    mean, square = jnp.sum(z, (0, 1)) / (CHAINS * count), jnp.sum(z**2, (0, 1)) / (CHAINS * count)
    return ends, Swept(z, phi, mean, jnp.sqrt(jnp.maximum(square - mean**2, 0.0)))


@partial(jax.jit, static_argnames="form")
def moments(form: Form, known: Natural, phi: Phi) -> Moments:
    """Mean, covariance, interval and gamma of the mixture of the Gaussians that hyper-parameters leave (thinned)."""
    flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[::EVERY], phi)

    def one(phi: Phi) -> tuple[jax.Array, jax.Array, jax.Array]:
        alpha, coupling = prior_precision(form, known, phi)
        active = activity(form, known, phi)
        both = active[:, None] & active[None, :]
        matrix = jnp.where(both, known.information + coupling + jnp.diag(alpha), jnp.eye(form.biases))
        covariance = jnp.where(both, linalg.inverse_and_logdet(matrix)[0], 0.0)
        gamma = jnp.where(active, jnp.clip(1.0 - alpha * jnp.diagonal(covariance), 0.0, 1.0), 0.0)
        return covariance @ known.pull, covariance, gamma

    def add(total: jax.Array, own: Phi) -> tuple[jax.Array, Any]:
        mean, covariance, gamma = one(own)
        return total + covariance, (mean, jnp.diagonal(covariance), gamma)

    total, (means, variances, gammas) = jax.lax.scan(add, jnp.zeros((form.biases, form.biases)), flat)
    count, mean = means.shape[0], jnp.mean(means, 0)
    covariance = total / count + jnp.cov(means, rowvar=False, bias=True).reshape(total.shape)
    sds = jnp.sqrt(jnp.maximum(variances, 0.0))
    tail = 0.5 * (1.0 - INTERVAL)
    lower, upper = (quantile(means, sds, share) for share in (tail, 1.0 - tail))
    return Moments(mean, covariance, lower, upper, jnp.mean(gammas, 0))


def quantile(means: jax.Array, sds: jax.Array, share: float) -> jax.Array:
    """Quantile (M,) of each mixture of Gaussians of means and sds (S, M), by halving a bracket."""
    width = 10.0 * jnp.max(sds, 0) + 1e-12

    def half(_: int, ends: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        low, high = ends
        at = 0.5 * (low + high)
        below = jnp.mean(ndtr((at[None] - means) / jnp.maximum(sds, 1e-12)), 0) < share
        return jnp.where(below, at, low), jnp.where(below, high, at)

    low, high = jax.lax.fori_loop(0, HALVINGS, half, (jnp.min(means, 0) - width, jnp.max(means, 0) + width))
    return 0.5 * (low + high)
