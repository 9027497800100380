"""Particle Gibbs: trajectories by a conditional particle filter with ancestor sampling, biases given trajectories.

The exact answer where no Gaussian stands for the trajectories: yes-or-no sensors, mirrored bearings, roads. One sweep
draws the path of every target given the biases (Lindsten, Jordan, Schon 2014), then biases, levels and
hyper-parameters given the paths.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal import linalg
from probcal.errors import InputError
from probcal.inference.chains import Draw, Sample, repeated
from probcal.inference.draws import slice_step
from probcal.inference.gibbs import draw_hyper
from probcal.inference.hierarchy import Phi, hierarchy_of
from probcal.inference.pose import SPREAD
from probcal.inference.posed import Form, Natural, conditional, log_prior, prior_precision
from probcal.inference.posterior import SamplerRun, chains, conclude_draws
from probcal.inference.sampler import Sampler
from probcal.inference.sampling import Chains, DrawnChunks, each_chain
from probcal.linalg import invert, without_negative
from probcal.model.model import At, Model, Recursion
from probcal.modes.grid import follow_states, track_mode
from probcal.particles.conditional import conditional_path
from probcal.particles.em import searched
from probcal.particles.ensemble import ensemble, expected_over_paths, first_paths, log_motion_of, state_moments
from probcal.particles.particles import Particles
from probcal.particles.proposals import check_proposal
from probcal.particles.targets import Targets, place_by_epoch
from probcal.particles.weighted import Paths, check_learnt, louis, prepared, unexplained
from probcal.priors import Horseshoe, Prior
from probcal.problem import Problem
from probcal.results.answer import Answer, Posterior

SEARCH = 40  # iterations of the search for a start, where there is none
LENGTHS = (1.0, 0.3)  # of steps of all biases; 1 is an independent draw from the Gaussian at given paths
NEAR, FAR = 0.2, 20.0  # shortest and longest steps of a sensor by itself, in sd at given paths
CROWD = 500  # least particles of passes that are no sweeps
MANY = 20  # draws a bias from which their covariance is inverted
STUCK = 0.2  # share of the paths that a sweep renews below which it is said
CONDITIONAL = Particles(100)


class GibbsState(NamedTuple):
    """The state of a chain."""

    theta: jax.Array  # (Q,) biases, log levels
    phi: Phi
    paths: tuple[Any, ...]  # (T, K, 1, ...) of each recursion
    key: jax.Array


class Held(NamedTuple):
    """The quantities that stay the same in all sweeps."""

    model: Model
    targets: tuple[Targets, ...]
    natural: Natural  # the data about the biases as a Gaussian: only gamma is read off it
    group: jax.Array  # (M,) biases of one group share a row, or the prior ties them
    reference: jax.Array  # (M, M) information about the biases at given paths, by which steps of a sensor are scaled
    of_sensor: tuple[jax.Array, ...]  # (S,) group of each sensor of each block, one more than there are for none


def groups_of(model: Model, coupling: np.ndarray) -> tuple[jax.Array, tuple[jax.Array, ...]]:
    """Groups (M,) of biases that share a sensor or that the prior ties, and the group of each sensor of each block."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    M, pairs = model.biases, [np.argwhere(coupling != 0)]
    read = [np.asarray(data.bias) for data in model.rows]
    for bias in read:
        for own in bias:
            free = own[own < M]
            pairs.append(np.stack([np.repeat(free[:1], len(free)), free], 1))
    a, b = np.concatenate(pairs).T if pairs else np.zeros((2, 0), int)
    _, group = connected_components(coo_matrix((np.ones(len(a)), (a, b)), shape=(M, M)), directed=False)
    padded = np.append(group, M)
    first = [np.where(bias < M, bias, M).min(1, initial=M) for bias in read]
    return jnp.asarray(group), tuple(jnp.asarray(padded[own]) for own in first)


def states_of(held: Held, paths: tuple[Any, ...]) -> tuple[Any, ...]:
    """States (E leading) of each recursion along paths (T, K, 1, ...)."""

    def states(part: Recursion, own: Targets, path: Any) -> Any:
        return jax.tree.map(lambda leaf: place_by_epoch(own.place, leaf[:, :, 0], part.time.shape[0]), path)

    return held.model.each(states, held.targets, paths)


@partial(jax.jit, static_argnames=("method", "form"))
def run_particle_sweeps(method: ParticleGibbs, form: Form, held: Held, chain: GibbsState, thin: jax.Array) -> Any:
    """`method.chunk` draws of one chain, `thin` sweeps apart."""

    def one(chain: GibbsState, _: None) -> tuple[GibbsState, Draw]:
        chain, sample = repeated(partial(method.step, form, held), chain, thin)
        M = form.biases
        given = conditional(form, held.natural, sample.phi)
        variance = given.variance[:M]
        gamma = jnp.clip(1.0 - given.alpha[:M] * variance, 0.0, 1.0)
        vectors = held.model.vectors_of(states_of(held, chain.paths))
        density = sample.joint + log_prior(form, held.natural, sample.theta, sample.phi)
        return chain, Draw(sample.theta, sample.phi, gamma, variance, vectors, density, sample.stats)

    return jax.lax.scan(one, chain, None, length=method.chunk)


@partial(jax.jit, static_argnames=("form", "how"))
def begin_chains(form: Form, how: Particles, held: Held, theta: Any, keys: jax.Array) -> GibbsState:
    """States of chains (chains leading) about theta (Q,), on paths that particles draw there."""

    def one(key: jax.Array) -> GibbsState:
        seeds = jax.random.split(key, 4)
        phi = form.hierarchy.draw(seeds[0])
        place = theta + SPREAD * conditional(form, held.natural, phi).deviation(seeds[1])
        found = ensemble(held.model, held.targets, *jnp.split(place, [form.biases]), seeds[2], how)
        return GibbsState(place, phi, first_paths(held.targets, found), jax.random.key_data(seeds[3]))

    return jax.lax.map(one, keys)


@dataclass(eq=False)
class ParticleChains(Chains):
    """Chains of particle Gibbs: a thread each."""

    def init(self) -> GibbsState:
        """Chains about the start, further out than the data leave the biases, on paths drawn there."""
        problem, particles, prior = self.problem, self.method.particles, self.prior
        check_learnt(problem)
        targets = prepared(problem, particles)
        check_proposal(problem.model, particles, conditional=True)
        for own in targets:
            own.model.check_density()
        keys = jax.random.split(self.context.key, 4)
        crowd = replace(particles, count=max(particles.count, CROWD), smoother="backward")
        z, levels = np.asarray(self.start.z), np.zeros(len(problem.levels))
        if not z.any():  # a sweep goes where the last path was: chains are begun where the data may be explained
            begun = searched(problem, crowd, self.start, SEARCH, keys[3])
            z, levels = np.asarray(begun.z), np.asarray(begun.levels)
        self.paths = Paths(problem, crowd, targets)
        told = louis(self.paths, z, levels, keys[0])
        reference = expected_over_paths(problem.model, told.found, jnp.asarray(z), jnp.asarray(levels)).information
        H = len(levels)
        self.posed = natural = Natural(
            jnp.asarray(np.pad(told.information, (0, H))),
            jnp.asarray(np.pad(told.information @ z + told.score, (0, H))),
            problem.model.level_spread, problem.first_precision(prior),
        )  # fmt: skip
        self.form = Form(self.biases, hierarchy_of(prior, problem))
        group, of_sensor = groups_of(problem.model, np.asarray(natural.first.coupled()))
        self.held = Held(problem.model, targets, natural, group, reference, of_sensor)
        seeds = jax.random.split(keys[1], self.method.chains)
        return begin_chains(self.form, crowd, self.held, np.concatenate([z, levels]), seeds)

    def advance(self, state: GibbsState, thin: int) -> tuple[GibbsState, Draw]:
        """All chains one chunk further, every `thin`-th sweep kept."""
        method, form, sweeps = self.method.kernel(), self.form, jnp.asarray(thin)
        chains, threads = self.method.chains, self.context.threads
        return each_chain(lambda own: run_particle_sweeps(method, form, self.held, own, sweeps), state, chains, threads)

    def outcome(self, state: GibbsState, course: DrawnChunks) -> Answer:
        """The answer by the draws, and whether paths were renewed."""
        run, problem = self.run(course), self.problem
        linear = all(part is None for part in problem.model.sampled)
        share, solved = float(np.mean(run.draws.stats["renewed"])), problem if linear else problem.seen()
        renewed = (share,) if share < STUCK else ()
        of_run = partial(particle_chains, paths=self.paths)
        return conclude_draws(solved, self.prior, run, of_run, unexplained, renewed=renewed)


@dataclass(frozen=True)
class ParticleGibbs(Sampler):
    """Exact posterior of biases, hyper-parameters and trajectories for any motion, by particle Gibbs.

    A sweep draws every path anew by a conditional filter of `particles` with ancestor sampling, then takes `steps` of
    the biases at given paths: of all together, by Gauss-Newton proposals, and of each sensor by itself, near and far,
    which given the paths knows nothing of the others. The motion needs a density. Where draws
    have not mixed every second one is kept of twice as many sweeps, up to one of `patience`.
    Raises `InputError` for settings outside their ranges.
    """

    chains: int = 4
    warmup: int = 200
    draws: int = 500
    particles: Particles = CONDITIONAL
    steps: int = 40
    patience: int = 16

    name: ClassVar[str] = "ParticleGibbs"
    priors: ClassVar[tuple[type, ...]] = (Horseshoe, Prior)
    work = ParticleChains
    chunk: ClassVar[int] = 25

    def __post_init__(self):
        super().__post_init__()
        if not isinstance(self.particles, Particles):
            raise InputError(f"ParticleGibbs(particles={self.particles!r}): give settings such as Particles(200)")
        for name, value in (("steps", self.steps), ("patience", self.patience)):
            if value < 1:
                raise InputError(f"ParticleGibbs({name}={value}): it must be at least 1")

    @property
    def by_particles(self) -> bool:
        """Trajectories are particles."""
        return True

    def kernel(self) -> ParticleGibbs:
        """The method whatever the number of its chains and draws."""
        return replace(self, chains=1, warmup=0, draws=1, patience=1)

    def step(self, form: Form, posed: Any, chain: GibbsState) -> tuple[GibbsState, Sample]:
        """One sweep; `posed` is what is `Held`."""
        held: Held = posed
        model, M = held.model, form.biases
        key, *keys = jax.random.split(chain.key, 5)
        z, levels = chain.theta[:M], chain.theta[M:]
        paths, renewed = [], []
        for r, (own, old) in enumerate(zip(held.targets, chain.paths, strict=True)):
            seeds = jax.random.split(jax.random.fold_in(keys[0], r), len(own.there))

            def one(epochs: Any, there: Any, path: Any, k: Any, own: Targets = own) -> Any:
                return conditional_path(own.model, epochs, there, (path,), z, levels, k, self.particles)

            (new,), moved = jax.vmap(one)(own.epochs, own.there, old, seeds)
            paths.append(new)
            renewed.append(jnp.sum(moved & own.there) / jnp.sum(own.there))
        at = states_of(held, tuple(paths))
        theta, rate = self._moved(form, held, at, chain.theta, chain.phi, keys[1])
        theta = self._levels(form, held, at, tuple(paths), theta, keys[2])
        phi = draw_hyper(form, chain.phi, theta, keys[3])
        told = sum(jnp.sum(part) for part in model.log_likelihood(At(at, theta[:M], theta[M:])))
        joint = told + log_motion_of(held.targets, tuple(paths), theta[M:])
        stats = {"acceptance_rate": rate, "renewed": jnp.mean(jnp.stack(renewed))}
        return GibbsState(theta, phi, tuple(paths), key), Sample(theta, (), phi, joint, stats)

    def _moved(
        self, form: Form, held: Held, at: Any, theta: jax.Array, phi: Phi, key: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Steps of the biases at given paths, and the share of them taken.

        A proposal is a shorter or longer part of a draw from the Gaussian of a Gauss-Newton step: for a linear sensor
        it is always taken.
        """
        M, levels = form.biases, theta[form.biases :]
        alpha, coupling = prior_precision(form, held.natural, phi)
        prior = (jnp.diag(alpha) + coupling)[:M, :M]

        def place(z: jax.Array) -> tuple[jax.Array, ...]:
            point = At(at, z, levels)
            told = sum(jnp.sum(part) for part in held.model.log_likelihood(point))
            information, score = held.model.of_biases(held.model.linearise_biases(point, expected=True))
            lower, inverse = linalg.factor_and_inverse(information + prior)
            slope = score - prior @ z
            return told - 0.5 * z @ prior @ z, inverse.T @ (inverse @ slope), lower, inverse

        def log_proposal(here: tuple[jax.Array, ...], z: jax.Array, other: jax.Array, length: Any) -> jax.Array:
            white = here[2].T @ (other - z - (1 - jnp.sqrt(1 - length**2)) * here[1]) / length
            return jnp.sum(jnp.log(jnp.diagonal(here[2]))) - 0.5 * jnp.sum(white**2)

        def together(carry: Any, inputs: Any) -> tuple[Any, jax.Array]:
            z, here = carry
            own, length = inputs
            seeds = jax.random.split(own)
            noise = here[3].T @ jax.random.normal(seeds[0], z.shape)
            other = z + (1 - jnp.sqrt(1 - length**2)) * here[1] + length * noise
            there = place(other)
            gain = there[0] - here[0] + log_proposal(there, other, z, length) - log_proposal(here, z, other, length)
            taken = jnp.log(jax.random.uniform(seeds[1])) < jnp.where(jnp.isfinite(gain), gain, -jnp.inf)
            return jax.tree.map(lambda new, old: jnp.where(taken, new, old), (other, there), (z, here)), taken

        groups = form.biases + 1  # at most, and one for the rows of sensors without bias

        def values(z: jax.Array) -> jax.Array:
            """Log density of each group."""
            total = jnp.zeros(groups).at[held.group].add(-0.5 * z * (prior @ z))
            told = held.model.log_likelihood(At(at, z, levels))
            for _, data, _, part, own in held.model.each_block(told, held.of_sensor):
                total = total.at[own[data.sensor]].add(jnp.sum(part, 1))
            return total

        def apart(carry: Any, own: jax.Array) -> tuple[Any, jax.Array]:
            z, here = carry
            seeds = jax.random.split(own, 3)
            span = jnp.log(NEAR) + (jnp.log(FAR) - jnp.log(NEAR)) * jax.random.uniform(seeds[0], (groups,))
            other = z + jnp.exp(span)[held.group] * (spread.T @ jax.random.normal(seeds[1], z.shape))
            there = values(other)
            gain = jnp.where(jnp.isfinite(there), there - here, -jnp.inf)
            taken = jnp.log(jax.random.uniform(seeds[2], (groups,))) < gain
            found = (jnp.where(taken[held.group], other, z), jnp.where(taken, there, here))
            return found, jnp.mean(taken[held.group])

        seeds, z = jax.random.split(key, 3), theta[:M]
        lengths = jnp.asarray(LENGTHS)
        (z, _), taken = jax.lax.scan(together, (z, place(z)), (jax.random.split(seeds[0], len(LENGTHS)), lengths))
        # by a factor that no draw of the biases moves, so that a step is as likely as its way back
        spread = linalg.factor_and_inverse(held.reference + prior)[1]
        (z, _), _ = jax.lax.scan(apart, (z, values(z)), jax.random.split(seeds[1], self.steps))
        return theta.at[:M].set(z), jnp.mean(taken)

    def _levels(
        self, form: Form, held: Held, at: Any, paths: tuple[Any, ...], theta: jax.Array, key: jax.Array
    ) -> jax.Array:
        """Unknown noise levels at given paths and biases, one after the other."""
        M, model = form.biases, held.model

        def density(h: int, theta: jax.Array, value: jax.Array) -> jax.Array:
            levels = theta[M:].at[h].set(value)
            told = sum(jnp.sum(part) for part in model.log_likelihood(At(at, theta[:M], levels)))
            motion = log_motion_of(held.targets, paths, levels) if model.driven else 0.0
            return told + motion - 0.5 * (value / model.level_spread[h]) ** 2

        for h in range(model.level_spread.shape[0]):
            value = slice_step(jax.random.fold_in(key, h), theta[M + h], partial(density, h, theta))
            theta = theta.at[M + h].set(value)
        return theta


def particle_chains(
    problem: Problem, prior: Prior, run: SamplerRun, mixed: Mapping[str, np.ndarray], paths: Paths
) -> Posterior:
    """The posterior of a run on `paths`, at states that stand for the particles at its means (Paper A 43).

    Where the precisions are known, the draws say what the data tell of the biases.
    """
    z, levels = run.z.mean((0, 1)), run.levels.mean((0, 1))
    point = paths.point(paths.at(z, levels, jax.random.key(0)), z, levels)
    if all(form is None for form in paths.problem.model.sampled):
        near = follow_states(problem, [np.asarray(x) for x in point.states])
        point = track_mode(problem, near._replace(z=jnp.asarray(z), levels=jnp.asarray(levels)))
    without = paths.at(np.zeros_like(z), levels, jax.random.key(1))
    zero = paths.point(without, np.zeros_like(z), levels)
    zero = zero._replace(states=tuple(m.mean for m in state_moments(paths.problem.model, without)))
    found = chains(problem, prior, run, mixed, point=point, zero=zero)
    summary, first, learnt = found.summary, run.posed.first, run.form.hierarchy.learnt
    if not learnt and run.z.shape[0] * run.z.shape[1] >= MANY * run.form.biases:
        told = invert(summary.covariance.matrix()) - np.asarray(first.matrix())
        summary = replace(summary, information=without_negative(told))
    term = np.asarray(run.posed.pull)[: run.form.biases]
    if not learnt:  # of a Gaussian its slope vanishes at the mean, the prior's included
        term = np.asarray(summary.information) @ z + np.asarray(first.pull(jnp.asarray(z)))
    return replace(found, summary=summary, term=term)
