"""Gibbs sampling of hyper-parameters, trajectories and biases: full Bayes of a network of any size.

One sweep: hyper-parameters given the biases, by their conjugate updates; unknown levels and latent
scales of the noise given trajectories and biases (`noise_step.py`); then all trajectories and biases
at once given those, by split HMC (`split_hmc.py`) about an expansion of the engine that suits the
size.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal.errors import FitError, InputError
from probcal.gaussian.choose import choose_fast
from probcal.gaussian.engine import Factors
from probcal.gaussian.information import at_levels
from probcal.gaussian.joint import blocks_of
from probcal.gaussian.mode import Point, mixed_density
from probcal.inference.chains import Draw
from probcal.inference.ending import diverged
from probcal.inference.engined import HostClimb
from probcal.inference.gibbs import draw_hyper, log_prior_of, precisions
from probcal.inference.hierarchy import Phi, hierarchy_of
from probcal.inference.method import Context
from probcal.inference.noise_step import draw_noise, levels_alone, log_prior_levels
from probcal.inference.posed import Form, Natural
from probcal.inference.posterior import SamplerRun, chains, conclude_draws
from probcal.inference.sampler import Sampler
from probcal.inference.sampling import Chains, DrawnChunks
from probcal.inference.split_hmc import Reference, SplitGaussian, placed, split_variables, variables_of
from probcal.model.model import Model
from probcal.modes.explore import CLIMB
from probcal.priors import Horseshoe, Prior
from probcal.problem import Problem
from probcal.results.answer import Answer, Posterior, Tracks, blocks_under
from probcal.results.blocks import SensorBlocks

PILOT = 40  # sweeps on the Gaussian alone, the last half of which tells where the reference is taken
KICKS, TRIED, WANTED = (1, 2, 4, 8, 16, 32, 64), 6, 0.7  # kicks of a turn: the fewest of which so many are taken
NUMBERS = 4_000_000  # most numbers of draws of states, and of hyper-parameters by bias, that are kept


class SweepState(NamedTuple):
    """The states of all chains, and the quantities that they share."""

    at: Any  # (C, n + H) states, biases and log levels
    phi: Any  # (C, ...) of each hyper-parameter
    made: Any  # () sweeps of a chain
    summed: Any  # () sweeps of all chains after the warm-up, which the sums are of
    total: Any  # (S,) sum of the states
    square: Any  # (S,) of their squares, both about the reference
    gamma: Any  # (M,) sum of gamma
    variance: Any  # (M,) sum of the variances of the biases given their hyper-parameters
    reference: Any  # (n,) where the Gaussian is taken
    kicks: Any  # () of a turn


SUMS = ("summed", "total", "square", "gamma", "variance")


class _Chain(NamedTuple):
    """One chain in a sweep."""

    number: int
    made: int  # sweeps of it
    at: np.ndarray  # (n,)
    levels: np.ndarray  # (H,)
    phi: Any  # a `Phi`
    reference: Reference  # under its noise
    rest: float  # of the log density there, next to that of the Gaussian
    rate: float  # of the last turn: how likely it was taken


@dataclass(eq=False)
class GibbsChains(Chains):
    """All chains, one after the other: a library of sparse factors keeps one at a time, and takes all processors for
    it."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.model, self.key, self.engine = self.problem.model, self.context.key, choose_fast(self.problem.model)
        self.form = Form(self.biases, hierarchy_of(self.prior, self.problem))
        self.first = self.problem.first_precision(self.prior)
        self.posed = Natural(jnp.zeros((0, 0)), jnp.zeros(0), self.model.level_spread, self.first)
        self.factors = Factors.alone(np.ones(self.biases)) if self.form.hierarchy.learnt else Factors.of(self.first)
        self.alone, self.coupled = levels_alone(self.model), Factors.coupled(self.first)
        self._reference: Reference | None = None
        self._last: SplitGaussian | None = None

    def init(self) -> SweepState:
        """Chains about the mode under the declared scales."""
        own, alone = (self.first, self.factors, CLIMB, 1e-3), Context(self.key)
        climb = HostClimb(self.method, self.problem, self.prior, self.start, alone, *own, engine=self.engine)
        self.mode = climb.at(alone.run(climb)[0])
        self.model = self.mode.model
        return self.begun()

    def _at(self, variables: np.ndarray) -> Reference:
        """The reference at variables (n,), made once."""
        if self._reference is None or not np.array_equal(self._reference.variables, variables):
            point = placed(self.model, self.mode.point, jnp.asarray(variables))
            self._reference = Reference(self.engine.at(self.model, point))
        return self._reference

    def _given(self, reference: Reference, phi: Phi) -> SplitGaussian:
        """The Gaussian given the hyper-parameters; factorised once where there are none."""
        alpha, last = np.asarray(precisions(self.form, phi, self.first)), self._last
        if last is None or last.reference is not reference or not np.array_equal(last.alpha, alpha):
            self._last = last = SplitGaussian.of(reference, alpha, self.coupled)
        return last

    def begun(self) -> SweepState:
        """Chains at draws under the declared scales; the reference at the mean of sweeps on the Gaussian."""
        M, C = self.form.biases, self.method.chains
        key, drawn = jax.random.fold_in(self.key, 1), jax.random.fold_in(self.key, 0)
        reference = self._at(variables_of(self.mode.point.states, self.mode.point.z))
        scales = np.ones(M) if self.form.hierarchy.learnt else np.asarray(self.first.alpha)
        wide = SplitGaussian.of(reference, scales, self.coupled)
        at = wide.mean[None] + np.stack([wide.deviation(jax.random.fold_in(drawn, c)) for c in range(C)])
        phis = self.form.hierarchy.begin(C)
        phi = jax.tree.map(lambda leaf: jnp.asarray(leaf[-1]), phis)
        if self.form.hierarchy.learnt:
            z, total = at[0, -M:], np.zeros(M)
            for k in range(PILOT):
                phi = draw_hyper(self.form, phi, jnp.asarray(z), jax.random.fold_in(key, C + k))
                given = self._given(reference, phi)
                z = (given.mean + given.deviation(jax.random.fold_in(drawn, C + k)))[-M:]
                total += given.mean[-M:] * (2 * k >= PILOT)
            moved = self.mode.moved(total / (PILOT - PILOT // 2) - np.asarray(self.mode.point.z))
            settled = self.engine.settled(self.model, moved).point
            reference = self._at(variables_of(settled.states, settled.z))
        given = self._given(reference, phi)
        here = given.mean + given.deviation(jax.random.fold_in(drawn, C + PILOT))
        tried = _Chain(0, 0, here, np.asarray(self.mode.point.levels), phi, reference, reference.rest(here)[0], 0.0)
        kicks = self._kicks(tried, jax.random.fold_in(drawn, C + PILOT + 1))
        return self._begun(at, phis, reference.variables, kicks)

    def _begun(self, at: np.ndarray, phi: Any, reference: np.ndarray, kicks: int) -> SweepState:
        M, S = self.form.biases, self.model.state_size
        levels = np.broadcast_to(self.mode.point.levels, (len(at), len(self.mode.point.levels)))
        whole, counts = np.concatenate([at, levels], 1), (np.array(0), np.array(0))
        sums = np.zeros(S), np.zeros(S), np.zeros(M), np.zeros(M)
        return SweepState(whole, phi, *counts, *sums, reference, np.array(kicks))

    def _kicks(self, chain: _Chain, key: jax.Array) -> int:
        """The fewest kicks with which turns are taken often enough."""
        for kicks in KICKS:
            rates = []
            for k in range(TRIED):
                own = jax.random.fold_in(jax.random.fold_in(key, kicks), k)
                chain, _, _ = self._turned(chain, kicks, own, jax.random.fold_in(own, 3))
                rates.append(chain.rate)
            if np.mean(rates) >= WANTED:
                break
        return kicks

    def advance(self, state: SweepState, thin: int) -> tuple[SweepState, Draw]:
        """All chains one chunk further, every `thin`-th sweep kept."""
        reference, sums = self._at(np.asarray(state.reference)), {name: np.array(getattr(state, name)) for name in SUMS}
        ends, drawn = list[_Chain](), []
        for c in range(self.method.chains):
            at, levels = np.split(np.asarray(state.at[c]), [len(reference.variables)])
            phi = {name: leaf[c] for name, leaf in state.phi.items()}
            own = _Chain(c, int(state.made), at, levels, phi, reference, reference.rest(at)[0], 0.0)
            parts = []
            for _ in range(self.method.chunk):
                for _ in range(thin):
                    own, moments = self._swept(own, int(state.kicks))
                    if own.made > self.method.warmup:
                        for name, value in moments.items():
                            sums[name] += value
                parts.append(self._draw(own))
            ends.append(own)
            drawn.append(jax.tree.map(lambda *leaves: np.stack(leaves), *parts))
        after = state._replace(
            at=np.stack([np.append(own.at, own.levels) for own in ends]),
            made=np.array(ends[0].made),
            phi={name: np.stack([np.asarray(own.phi[name]) for own in ends]) for name in state.phi},
            **sums,
        )  # fmt: skip
        return after, jax.tree.map(lambda *leaves: np.stack(leaves), *drawn)

    def _states(self, at: np.ndarray) -> tuple[np.ndarray, ...]:
        """States (E, n) of each recursion; nothing where the draws of all would take too much room."""
        return split_variables(self.model, at)[0] if self.method.keeps_states(self.model) else ()

    def _swept(self, chain: _Chain, kicks: int) -> tuple[_Chain, dict[str, Any]]:
        """One sweep of a chain, and what is summed over sweeps."""
        states = self.model.state_size
        key = jax.random.fold_in(jax.random.fold_in(self.key, 2 + chain.number), chain.made)
        phi = draw_hyper(self.form, chain.phi, jnp.asarray(chain.at[states:]), key)
        keys = jax.random.fold_in(key, 1), jax.random.fold_in(key, 2)
        chain, given, speed = self._turned(chain._replace(phi=phi), kicks, *keys)
        step, variance = chain.at[:states] - chain.reference.variables[:states], given.variances(speed)
        gamma = 1.0 - given.alpha * variance
        moments = {"summed": 1, "total": step, "square": step**2, "gamma": gamma, "variance": variance}
        return chain._replace(made=chain.made + 1), moments

    def _turned(
        self, chain: _Chain, kicks: int, key: jax.Array, noise: jax.Array
    ) -> tuple[_Chain, SplitGaussian, np.ndarray]:
        """A chain after steps of its noise and of the rest, the Gaussian of these, and their speed."""
        chain = self._with_noise(chain, noise) if self.model.learns_noise else chain
        given = self._given(chain.reference, chain.phi)
        at, rest, rate, speed = given.turned(chain.at, chain.rest, kicks, key)
        return chain._replace(at=at, rest=rest, rate=rate), given, speed

    def _with_noise(self, chain: _Chain, key: jax.Array) -> _Chain:
        """A chain after a step of levels and latent scales, its reference under them."""
        known = at_levels(self.model, self.mode.point, jnp.asarray(chain.levels))
        model, point = draw_noise(self.model, placed(self.model, known, chain.at), key, self.alone)
        there = placed(model, point, chain.reference.variables)
        reference, at = Reference(self.engine.at(model, there)), variables_of(point.states, point.z)
        levels, rest = np.asarray(point.levels), reference.rest(at)[0]
        return chain._replace(at=at, levels=levels, reference=reference, rest=rest)

    def outcome(self, state: SweepState, course: DrawnChunks) -> Answer:
        """The answer by draws of the biases and sums over sweeps."""
        of_run = partial(gibbs_chains, runs=self, state=state)
        return conclude_draws(self.problem, self.prior, self.run(course), of_run)

    def beyond_memory(self, error: MemoryError) -> Answer:
        """Raises what to do without memory for a factor."""
        raise FitError(
            f"the factor of {self.model.state_size} state entries and {self.biases} biases does not fit in"
            " memory: take fewer sensors or a shorter time"
        ) from None

    def singular(self, error: np.linalg.LinAlgError) -> Answer:
        """Raises what to do where the data leave a bias open."""
        if self.prior.proper:
            raise FitError(
                "Gibbs: the precision under some draw of the hyper-parameters is singular in double precision:"
                " survey or fix what no row tells"
            ) from None
        raise diverged(self.problem, self.engine.at(self.model, self.start), self.factors) from None

    def _draw(self, chain: _Chain) -> Draw:
        """The stored draw of a chain at its present state."""
        at, z, none = chain.at, chain.at[self.model.state_size :], np.zeros(0)
        value = chain.reference.log_density(at) + log_prior_of(self.form, chain.phi, self.first, z)
        value += float(jnp.sum(log_prior_levels(self.model, chain.levels)))
        most = NUMBERS / (self.method.chains * self.method.draws)
        phi = {name: np.asarray(leaf) for name, leaf in chain.phi.items() if np.size(leaf) <= most}
        fields: dict[str, Any] = {
            "theta": np.append(z, chain.levels),
            "phi": phi,
            "gamma": none,
            "variance": none,
            "density": np.array(value),
        }
        return Draw(**fields | {"states": self._states(at), "stats": {"acceptance_rate": np.array(chain.rate)}})


@dataclass(frozen=True)
class Gibbs(Sampler):
    """Exact posterior of biases, hyper-parameters and trajectories, sampled together: for networks of any size.

    Each sweep draws the hyper-parameters given the biases, and unknown levels and latent scales of
    the noise given biases and trajectories; it solves for the Gaussian of all states and biases
    given those, by sparse factors where the network is large, and moves these together by a
    Hamiltonian quarter turn about its mean, which splits off the Gaussian (Shahbaba and others
    2014): an independent draw where the model is linear, elsewhere kicked as often as it takes to be
    accepted. Any prior with a density.
    Of more than four million numbers no draws of states are kept, their means and sds are. Chains
    run one after the other; biases and tracks start at draws under the declared scales, on the side
    of a mirror that fits best. They do not visit the others, which the answer names. Where
    draws have not mixed every second one is kept of twice as many sweeps, up to one of `patience`.
    Raises `InputError` for less than one chain or draw.
    """

    chains: int = 4
    warmup: int = 50
    draws: int = 250
    patience: int = 4
    effective: int = 0

    name = "Gibbs"
    priors = (Horseshoe, Prior)
    work = GibbsChains
    chunk = 25
    roomy = False
    engined = True
    refusal = (
        "turns: the posterior is too far from the Gaussian of its linearised rows; take collapsed or nuts, of fewer"
        " sensors where these do not fit"
    )

    def keeps_states(self, model: Model) -> bool:
        """True if draws of all states are few enough to be kept."""
        return self.chains * self.draws * model.state_size <= NUMBERS

    def check_kept(self, problem: Problem, keep: tuple[str, ...]) -> None:
        """Raise `InputError` where draws of states are asked for that would take too much room."""
        if {"states", "replicas"} & set(keep) and not self.keeps_states(problem.model):
            raise InputError(
                f"Gibbs() keeps draws of states up to {NUMBERS:,} numbers, {self.chains} x {self.draws} draws of"
                f" {problem.model.state_size} states are more: take fewer draws, or leave save out (means and sds are"
                " always there)"
            )


def gibbs_chains(
    problem: Problem,
    prior: Prior,
    run: SamplerRun,
    mixed: Mapping[str, np.ndarray],
    runs: GibbsChains,
    state: SweepState,
) -> Posterior:
    """The posterior of a run of `Gibbs`: the draws of the biases, and moments of the states."""
    z, model, M = run.z, problem.model, run.form.biases
    count, total, square, told, spread = (np.asarray(getattr(state, name)) for name in SUMS)
    blocks = SensorBlocks.drawn(z.reshape(-1, M), blocks_of(model), spread / count)
    near = runs.mode.moved(z.mean((0, 1)) - np.asarray(runs.mode.point.z))
    at = runs.engine.settled(runs.model, at_levels(runs.model, near, jnp.asarray(run.levels.mean((0, 1)))))
    middle = np.asarray(state.reference)[: model.state_size] + total / count
    sd = np.sqrt(np.maximum(square / count - (total / count) ** 2, 0.0))
    moments = tuple(map(Tracks, split_variables(model, middle)[0], split_variables(model, sd)[0]))

    def joint(point: Point, phi: Phi) -> float:
        known = log_prior_of(run.form, phi, run.posed.first, np.asarray(point.z))
        levels = jnp.sum(log_prior_levels(model, point.levels))
        return known + float(mixed_density(model, point) + levels)

    return chains(
        problem, prior, run, mixed, blocks, np.clip(told / count, 0.0, 1.0), at.point, at=at, moments=moments,
        declared=blocks_under(at, Factors.alone(np.ones(M))), joint=joint,
    )  # fmt: skip
