"""Precisions integrated: a mixture of Gaussians of the biases around their Gaussian likelihood.

At a point the data leave a Gaussian likelihood of the biases in natural form, G and G z + g, g the score of the
marginal density. Gibbs sweeps over hyper-parameters and biases sample what a hierarchical prior makes of it; the point
then moves to the mean of the mixture, once, and the sweeps go on. Noise levels are held.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal import linalg
from probcal.gaussian.choose import engine_of
from probcal.gaussian.engine import Engine, Expansion, Factors
from probcal.gaussian.joint import blocks_of
from probcal.gaussian.marginal import volume_slope
from probcal.gaussian.mode import Point, eliminate, smooth_tracks
from probcal.gaussian.search import chosen
from probcal.inference.gibbs import gibbs_sweep
from probcal.inference.hierarchy import Phi
from probcal.inference.method import Context
from probcal.inference.posed import Form, Natural, natural
from probcal.inference.propagate import BiasLikelihood, Propagation
from probcal.model.model import Model
from probcal.priors import Precision
from probcal.results.answer import few_draws
from probcal.results.blocks import SensorBlocks
from probcal.results.schema import INTERVAL
from probcal.simulate import chance_of

CHAINS, BURN, FIRST, KEPT = (
    4,
    60,
    120,
    500,
)  # sweeps: before, around the mode, and around the mean, whose draws are kept
EVERY = 5  # kept draws between two whose conditional Gaussian enters the moments
MOVES, NEAR = 6, 1.0  # most times that the point moves to the mean, and sd by which it may have moved at the last
CLOSE = 0.015  # Monte Carlo error of each mean in sd, and of each sd over it, at which sweeps end
FEWEST, BATCHES = 4, 27  # batches of kept sweeps that show this error, and the most
WORK = 6700  # batches times squared biases at most: a batch of 16 biases takes 0.1 s, of 150 over 1 s
HALVINGS = 40  # of the bracket of a quantile
ATOM = 1e-9  # scales within which a quantile is that of the biases that are exactly zero


@dataclass(frozen=True)
class Integration:
    """The static part: what the integration is compiled for."""

    form: Form
    marginal: bool  # whether the determinant of the trajectories belongs to the likelihood; not at a joint mode
    sweeps: bool = True  # Gibbs; else expectation propagation, for biases that are many


class Moments(NamedTuple):
    """The moments of the biases z under a mixture."""

    mean: Any  # (M,)
    covariance: Any  # (M, M)
    lower: Any  # (M,) of the interval
    upper: Any  # (M,)
    gamma: Any  # (M,)


class Integrated(NamedTuple):
    """The result of the integration: the mixture, its draws, and the likelihood behind it."""

    point: Point  # biases at the mean, trajectories at their mode
    information: Any  # (M, M) of the data about z; None where it is not held
    moments: Moments
    z: Any  # (CHAINS, KEPT, M)
    phi: Phi  # leading dims (CHAINS, KEPT)
    settled: Any = True  # whether a propagation came to rest
    mean_error: Any = 0.0  # (M,) Monte Carlo error of the mean, in sd; 0 where it was not estimated
    sd_error: Any = 0.0  # (M,) that of the sd, over the sd


def integrate(
    how: Integration, model: Model, first: Precision, start: Point, key: jax.Array, *, search: bool = False
) -> Integrated:
    """Integrate the hyper-parameters of a hierarchy, from a mode of the biases under their declared scales.

    `first` is the prior of what no hierarchy governs. Once the mean of the mixture is known the likelihood is taken
    there; with `search`, which no kernel can hold, until the mean moves by less than an sd.
    """
    if not how.sweeps:
        engine = engine_of("dense", model)
        return by_propagation(how.form, first, engine, engine.at(model, start), Context(key), marginal=how.marginal)[0]
    known, _ = likelihood(how, model, first, start)
    chains, point = begin(how.form), start
    for turn in range(MOVES if search else 1):
        chains, swept = run_sweeps(how.form, known, chains, key, FIRST, BURN, turn * (BURN + KEPT))
        before = point.z
        there = point_at(model, point, swept.mean)  # taken unless it has no likelihood
        after, sound = likelihood(how, model, known.first, there)
        point, known = chosen(sound, (there, after), (point, known))
        moved = np.subtract(point.z, before) / np.maximum(swept.spread, 1e-9) if search else np.zeros(0)
        if search and np.max(np.abs(moved), initial=0.0) < NEAR:
            break
    if search:
        # the mixture of batches of sweeps, taken until their means and sds agree, and its draws from all of them
        most, kept, found = int(np.clip(WORK // max(how.form.biases, 1) ** 2, 2, BATCHES)), list[Any](), list[Moments]()
        for k in range(most):
            chains, swept = run_sweeps(
                how.form, known, chains, key, KEPT, 0 if k else BURN, (MOVES + k) * (BURN + KEPT)
            )
            kept.append(jax.device_get((swept.z, swept.phi)))
            found.append(jax.device_get(moments(how.form, known, swept.phi)))
            total, mean_error, sd_error = pooled(found)
            if k + 1 >= FEWEST and max(np.max(mean_error, initial=0.0), np.max(sd_error, initial=0.0)) < CLOSE:
                break
        z, phi = jax.tree.map(lambda *parts: np.concatenate(parts, 1)[:, :: len(parts)], *kept)
        middle = point_at(model, point, jax.device_put(total.mean))
        return Integrated(middle, known.information, total, z, phi, True, mean_error, sd_error)
    _, swept = run_sweeps(how.form, known, chains, key, KEPT, BURN, BURN + KEPT)
    total = moments(how.form, known, swept.phi)
    return Integrated(point_at(model, point, total.mean), known.information, total, swept.z, swept.phi)


@np.errstate(over="ignore", invalid="ignore")  # what is not finite is no answer, which the status says
def pooled(found: Sequence[Moments]) -> tuple[Moments, np.ndarray, np.ndarray]:
    """Moments of equal batches together, and the errors (M,) of means, in sd, and of sds, over the sd."""
    mean, within, lower, upper, gamma = (np.stack(column) for column in zip(*found, strict=True))
    middle, count = mean.mean(0), len(found)
    covariance = within.mean(0) + (mean - middle).T @ (mean - middle) / count
    sd = np.sqrt(np.maximum(np.diagonal(covariance), np.finfo(float).tiny))
    sds = np.sqrt(np.diagonal(within, axis1=1, axis2=2))
    errors = [part.std(0, ddof=1) / np.sqrt(count) / sd if count > 1 else np.zeros_like(sd) for part in (mean, sds)]
    return Moments(middle, covariance, lower.mean(0), upper.mean(0), gamma.mean(0)), errors[0], errors[1]


def by_propagation(
    form: Form,
    first: Precision,
    engine: Engine,
    at: Expansion,
    context: Context,
    *,
    marginal: bool = True,
) -> tuple[Integrated, Propagation]:
    """The posterior by expectation propagation, and the propagation where it ended.

    It keeps no draws of the hyper-parameters. `first` is the prior of what no hierarchy governs,
    `at` where the climb ended.
    """
    first = form.rest(first)
    known = BiasLikelihood(engine, at, Factors.of(first), marginal)
    work = Propagation.of(form, first, known, blocks_of(at.model), context.key)
    work.resume(context.run(work)[0])
    swept, here = work.swept, work.likelihood.here
    z, covariance = joint_draws(work)
    lower, upper = interval(swept.means, swept.sds)
    total = Moments(work.mean, covariance, lower, upper, swept.gamma)
    point = work.likelihood.expand(here.moved(work.mean - work.likelihood.z)).point
    return Integrated(point, here.information() if covariance.whole else None, total, z, {}, work.settled), work


def joint_draws(work: Propagation) -> tuple[np.ndarray, SensorBlocks]:
    """Draws (chain, draw, M) that have the marginals of a propagation, and the covariance as far as it is held.

    They are ordered as those of the Gaussian of likelihood and sites are (Iman and Conover 1982).
    """
    swept, factors, here = work.swept, work.factors, work.likelihood.here
    M, whole = work.form.biases, work.likelihood.engine.cheap  # covariance of all biases is made
    shape = (CHAINS, KEPT if whole else few_draws(M))
    count, rng = shape[0] * shape[1], chance_of(work.key)
    ordered = np.asarray(here.deviations(factors, work.key, count).z)
    pick = rng.integers(len(swept.means), size=(count, M))
    centre, spread = (np.take_along_axis(np.asarray(part), pick, 0) for part in (swept.means, swept.sds))
    alone = np.sort(centre + spread * rng.standard_normal((count, M)), 0)
    z = np.take_along_axis(alone, np.argsort(np.argsort(ordered, 0), 0), 0).reshape(*shape, M)
    if not whole:
        return z, SensorBlocks(M, work.members, swept.covariance)
    own = SensorBlocks.of(np.asarray(here.marginals(factors, np.arange(M)[None]))[0])
    return z, own.widened(np.sqrt(work.variance / own.variance))


def likelihood(how: Integration, model: Model, first: Precision, point: Point) -> tuple[Natural, jax.Array]:
    """The Gaussian likelihood of the biases at a point, and whether it is one."""
    solved = eliminate(model, point, expected=True)
    volume, smooth = (
        volume_slope(model, point, solved) if how.marginal else (jnp.zeros_like(point.z), jnp.ones((), bool))
    )
    xp = linalg.library(point.z, solved.score)
    information, score, z, volume, smooth = map(xp.asarray, (*solved[:2], point.z, volume, smooth))
    pull = information @ z + score - 0.5 * volume
    sound = smooth & xp.isfinite(information).all() & xp.isfinite(pull).all()
    return Natural(information, pull, xp.zeros(0), first), sound


def point_at(model: Model, point: Point, z: jax.Array) -> Point:
    """The point at biases z (M,), trajectories at their mode."""
    return smooth_tracks(model, point._replace(z=z))


def begin(form: Form) -> tuple[Any, Any]:
    """Biases, which the first sweep draws, and far starts of the hyper-parameters of each chain."""
    return np.zeros((CHAINS, form.biases)), form.hierarchy.begin(CHAINS)


class Swept(NamedTuple):
    """Draws of all chains; zeros beyond those that were asked for."""

    z: jax.Array  # (CHAINS, KEPT, M)
    phi: Phi  # leading dims (CHAINS, KEPT)
    mean: jax.Array  # (M,)
    spread: jax.Array  # (M,) their sd


@partial(jax.jit, static_argnames="form")
def run_sweeps(
    form: Form, known: Natural, chains: Any, key: jax.Array, count: int, burn: int = BURN, before: int = 0
) -> tuple[Any, Swept]:
    """`count` sweeps of every chain from its state, after `burn` others; also the last states.

    `before` is the number of those that have used the key."""

    def chain(pair: tuple[Any, jax.Array]) -> tuple[Any, Any]:
        def one(k: jax.Array, state: Any) -> Any:
            (theta, phi), drawn = state
            own = jax.random.fold_in(key, CHAINS * (before + k) + pair[1])
            at = gibbs_sweep(form, known, theta, phi, own, backwards=True)
            return at, jax.tree.map(lambda kept, leaf: kept.at[jnp.maximum(k - burn, 0)].set(leaf), drawn, at)

        blank = jax.tree.map(lambda leaf: jnp.zeros((KEPT, *leaf.shape), leaf.dtype), pair[0])
        return jax.lax.fori_loop(0, burn + count, one, (pair[0], blank))

    ends, (z, phi) = jax.lax.map(chain, (chains, jnp.arange(CHAINS)))
    mean, square = jnp.sum(z, (0, 1)) / (CHAINS * count), jnp.sum(z**2, (0, 1)) / (CHAINS * count)
    return ends, Swept(z, phi, mean, jnp.sqrt(jnp.maximum(square - mean**2, 0.0)))


@partial(jax.jit, static_argnames="form")
def moments(form: Form, known: Natural, phi: Phi) -> Moments:
    """Mean, covariance, interval and gamma of the mixture of the Gaussians that hyper-parameters leave (thinned)."""
    flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[::EVERY], phi)

    def add(total: jax.Array, own: Phi) -> tuple[jax.Array, Any]:
        matrix, pull, active, alpha = natural(form, known, own)
        covariance = jnp.where(linalg.outer(active), linalg.inverse_and_logdet(matrix)[0], 0.0)
        variance = jnp.maximum(jnp.diagonal(covariance), 0.0)
        gamma = jnp.where(active, jnp.clip(1.0 - alpha * variance, 0.0, 1.0), 0.0)
        return total + covariance, (covariance @ pull, jnp.sqrt(variance), gamma)

    total, (means, sds, gammas) = jax.lax.scan(add, jnp.zeros((form.biases, form.biases)), flat)
    count, mean = means.shape[0], jnp.mean(means, 0)
    covariance = total / count + jnp.cov(means, rowvar=False, bias=True).reshape(total.shape)
    lower, upper = interval(means, sds)
    return Moments(mean, covariance, lower, upper, jnp.mean(gammas, 0))


@jax.jit
def interval(means: jax.Array, sds: jax.Array) -> jax.Array:
    """Lower and upper end (2, M) of the interval of mixtures of Gaussians of means and sds (S, M).

    By halving a bracket; an atom counts.
    """
    width, shares = 10.0 * jnp.max(sds, 0) + 1e-12, jnp.array([-INTERVAL, INTERVAL])

    def half(_: int, ends: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        low, high = ends
        at = 0.5 * (low + high)
        inside = jax.lax.erf((at[:, None] - means[None]) / (jnp.sqrt(2.0) * jnp.maximum(sds, 1e-12))[None])
        below = jnp.mean(inside, 1) < shares[:, None]
        return jnp.where(below, at, low), jnp.where(below, high, at)

    first = jnp.min(means, 0) - width, jnp.max(means, 0) + width
    low, high = jax.lax.fori_loop(0, HALVINGS, half, tuple(jnp.stack([end, end]) for end in first))
    found = 0.5 * (low + high)
    return jnp.where(jnp.abs(found) < ATOM, 0.0, found)
