"""Gibbs sampling by sparse factors: full Bayes where no dense matrix of the biases fits.

One sweep: hyper-parameters given the biases, by their conjugate updates; then all trajectories and biases at once given
those. A quarter turn about the mean of their sparse Gaussian is an independent draw of that; what the model is beside
the Gaussian kicks it on the way, and the Metropolis rule makes it exact.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal.errors import FitError, InputError
from probcal.gaussian.cholesky import Factor
from probcal.gaussian.climb import climb_to_mode, settle_each
from probcal.gaussian.engine import Factors, Spread
from probcal.gaussian.joint import blocks_of, missing
from probcal.gaussian.joint_density import JointDensity, point_of_variables, variables_of
from probcal.gaussian.mode import Point, log_density
from probcal.gaussian.sparse import SparseEngine, SparseExpansion
from probcal.identifiability.directions import alone_directions, screened_directions
from probcal.inference.blockwise import NAMED, BlockPosterior, declared_blocks, diverged, told_columns
from probcal.inference.chains import Draw, Sample
from probcal.inference.hierarchy import Phi, hierarchy_of
from probcal.inference.method import Context
from probcal.inference.mixed import mixing
from probcal.inference.posed import Form, Natural, Posed
from probcal.inference.posterior import RARE, bias_status, judge_chains, values_by_datum
from probcal.inference.sampler import Sampler
from probcal.inference.sampling import SamplerRun, drawn_by, restored_as
from probcal.model.model import Model
from probcal.priors import PRECISION_BOUNDS, Horseshoe, Precision, Prior
from probcal.problem import Problem
from probcal.results.answer import Answer, Draws, Summary
from probcal.results.blocks import SensorBlocks
from probcal.results.schema import INTERVAL, ROPE
from probcal.status import Status

STEPS = 60  # of the climb to the mode
PILOT = 40  # sweeps on the Gaussian alone, the last half of which tells where the reference is taken
KICKS, TRIED, WANTED = (1, 2, 4, 8, 16, 32, 64), 6, 0.7  # kicks of a turn: the fewest of which so many are taken
SHORTER = 0.1  # share by which a turn may be shorter than a quarter
NUMBERS = 4_000_000  # most numbers of draws of states, and of hyper-parameters by bias, that are kept


class SparseState(NamedTuple):
    """Where all chains stand, and what they share."""

    at: Any  # (C, n) variables
    phi: Any  # (C, ...) of each hyper-parameter
    made: Any  # () sweeps of a chain
    thin: Any  # () of them from one draw to the next
    summed: Any  # (2,) sweeps of all chains in the sums: of this thin after the warm-up, and of the one before
    total: Any  # (2, S) sum of the states
    square: Any  # (2, S) of their squares, both about the reference
    gamma: Any  # (2, M) sum of gamma
    variance: Any  # (2, M) sum of the variances of the biases given their hyper-parameters
    reference: Any  # (n,) where the Gaussian is taken
    kicks: Any  # () of a turn


SUMS = ("summed", "total", "square", "gamma", "variance")


class _Chain(NamedTuple):
    """One chain in a sweep."""

    number: int
    made: int  # sweeps of it
    at: np.ndarray  # (n,)
    phi: Any  # a `Phi`
    rest: float  # of the log density there, beside that of the Gaussian
    rate: float  # of the last turn: how likely it was taken


@dataclass(frozen=True)
class Gibbs(Sampler):
    """Exact posterior of biases, hyper-parameters and trajectories, sampled by sparse factors: for large networks.

    Each sweep draws the hyper-parameters given the biases, factorises the joint precision of all states and biases,
    and moves these together by a Hamiltonian quarter turn about its mean, which splits off the Gaussian (Shahbaba
    and others 2014): an independent draw where the model is linear, elsewhere kicked as often as it takes to be
    accepted. Any prior with a density, no correlations; noise levels are known, motions those of the sparse form.
    Of more than four million numbers no draws of states are kept, their means and sds are. Chains run one after the
    other and start at draws under the declared scales, on the side of a mirror that fits best; they do not visit the
    others, which the answer names. Draws that have not mixed are made anew with 4 times as many sweeps from one to the
    next, up to `patience`. Raises `InputError` for less than one chain or draw.
    """

    chains: int = 4
    warmup: int = 50
    draws: int = 250
    patience: int = 4

    name: ClassVar[str] = "Gibbs"
    priors: ClassVar[tuple[type, ...]] = (Horseshoe, Prior)
    chunk: ClassVar[int] = 25
    sparsely: ClassVar[bool] = True

    def answer(self, problem: Problem, prior: Prior, start: Point, context: Context) -> Answer:
        """Draws of the posterior from a start, and what they say."""
        check_gibbs(problem, prior)
        began = time.perf_counter()
        model, engine = problem.model, SparseEngine()
        form = Form(model.biases, hierarchy_of(prior, problem))
        first = prior.precision(problem.labels, problem.surveyed)
        factors = Factors.alone(np.ones(model.biases) if form.hierarchy.learnt else np.asarray(first.alpha))
        try:
            mode = climb_to_mode(lambda at: engine.settled(model, at), start, factors, STEPS, 1e-3).at
            assert isinstance(mode, SparseExpansion)
            runs = _SparseChains(self, form, first, engine, mode, context.key)
            drawn, thin, stopped = drawn_by(self, runs, 1, context.monitor, context.storage, context.threads)
            natural = Natural(jnp.zeros((0, 0)), jnp.zeros(0), model.level_spread, first)
            seconds = time.perf_counter() - began
            run = SamplerRun(self, self, form, natural, None, drawn, seconds, stopped, "", (), thin)
            mixed = mixing(run.z)
            posterior = SparseChains.drawn(problem, prior, run, runs, mixed)
        except MemoryError:
            raise FitError(
                f"the sparse factor of {model.state_size} state entries and {model.biases} biases does not fit in"
                " memory: take fewer sensors or a shorter time"
            ) from None
        except np.linalg.LinAlgError:
            if prior.proper:
                raise FitError(
                    "Gibbs: the precision under some draw of the hyper-parameters is singular in double precision:"
                    " survey or fix what no row tells"
                ) from None
            raise diverged(problem, engine.at(model, start), factors) from None
        named = alone_directions(problem, posterior.point, posterior.declared, NAMED)  # a flat prior has no more
        found, weak = screened_directions(problem, posterior.at, posterior.declared, NAMED) if prior.proper else named
        posterior = replace(posterior, open=found, weak=weak)
        status, message = judge_chains(problem, prior, run, mixed, posterior.point)
        if (rate := float(np.asarray(drawn.stats["acceptance_rate"]).mean(1).min())) < RARE:
            status = Status.NOT_CONVERGED if status is Status.CONVERGED else status
            message = (
                f"{message} A chain takes {rate:.1%} of its turns: the posterior is too far from the Gaussian of its"
                " linearised rows; take collapsed or nuts, of fewer sensors where these do not fit."
            ).strip()
        ended = bias_status(problem, mixed, model.biases)
        return Answer(
            problem,
            self,
            self,
            prior,
            posterior,
            status,
            message,
            ended,
            run.z.shape[1],
            interrupted=bool(stopped),
        )

    def keeps_states(self, model: Model) -> bool:
        """Whether draws of all states are few enough to be kept."""
        return self.chains * self.draws * model.state_size <= NUMBERS

    def check_kept(self, problem: Problem, keep: tuple[str, ...]) -> None:
        """Raise `InputError` where draws of states are asked for that would take too much room."""
        if {"states", "replicas"} & set(keep) and not self.keeps_states(problem.model):
            raise InputError(
                f"Gibbs() keeps draws of states up to {NUMBERS:,} numbers, {self.chains} x {self.draws} draws of"
                f" {problem.model.state_size} states are more: take fewer draws, or leave save out (means and sds are"
                " always there)"
            )

    def first(self, form: Form, posed: Posed, theta: jax.Array, phi: Phi, key: jax.Array) -> Any:
        """Not asked: there is no frame."""
        raise AssertionError("sparse chains have no frame")

    def step(self, form: Form, posed: Posed, chain: Any) -> tuple[Any, Sample]:
        """Not asked: a sweep calls the sparse library, which no kernel holds."""
        raise AssertionError("a sparse sweep is no kernel")


def check_gibbs(problem: Problem, prior: Prior) -> None:
    """Raise `InputError` naming what Gibbs sampling by sparse factors does not take."""
    if lacks := missing(problem.model):
        raise InputError(f"Gibbs() does not take {lacks}: take Collapsed() or NUTS()")
    if prior.correlation:
        raise InputError("Gibbs() takes a prior without correlations: take Collapsed(), or leave them out")


@dataclass(frozen=True, eq=False)
class _Given:
    """Trajectories and biases given hyper-parameters: a Gaussian, and what the model is beside it."""

    density: JointDensity
    factor: Factor
    alpha: np.ndarray  # (M,)
    mean: np.ndarray  # (n,)

    @classmethod
    def of(cls, density: JointDensity, alpha: np.ndarray) -> _Given:
        """Factorise the precision that precisions alpha (M,) leave."""
        factor = density.joint.factor(density.entries, Factors.alone(alpha))
        pull = density.slope.copy()
        pull[density.joint.states :] -= alpha * density.at[density.joint.states :]
        return cls(density, factor, alpha, density.at + factor.solve(pull))

    def times(self, vector: np.ndarray) -> np.ndarray:
        """The precision times a vector (n,)."""
        found = np.asarray(self.density.matrix @ vector)
        found[self.density.joint.states :] += self.alpha * vector[self.density.joint.states :]
        return found

    def energy(self, step: np.ndarray, speed: np.ndarray) -> float:
        """Half the squares of a deviation and of a speed (n,) by the precision."""
        return 0.5 * float(step @ self.times(step) + speed @ self.times(speed))

    def turned(
        self, at: np.ndarray, rest: float, kicks: int, rng: np.random.Generator
    ) -> tuple[np.ndarray, float, float, np.ndarray]:
        """Variables (n,) after a turn, the rest of their log density, its acceptance, and the speed it began with."""
        speed = self.factor.draw(rng, 1)[0]
        begun, angle = speed, 0.5 * np.pi * (1.0 - SHORTER * rng.random()) / kicks
        step = at - self.mean
        before = self.energy(step, speed) - rest
        whole, half = (np.cos(angle), np.sin(angle)), (np.cos(0.5 * angle), np.sin(0.5 * angle))
        for k in range(kicks + 1):
            c, s = whole if 0 < k < kicks else half
            step, speed = c * step + s * speed, c * speed - s * step
            if k < kicks:
                value, slope = self.density.rest(self.mean + step)
                if not abs(value) < 1e100:  # nats: it diverges, and so does the turn back
                    return at, rest, 0.0, begun
                speed = speed + angle * self.factor.solve(slope)
        there, _ = self.density.rest(self.mean + step)
        gain = before - (self.energy(step, speed) - there)
        rate = float(np.exp(min(gain, 0.0))) if np.isfinite(gain) else float(np.isfinite(there) > np.isfinite(rest))
        return (self.mean + step, there, rate, begun) if rng.random() < rate else (at, rest, rate, begun)


@partial(jax.jit, static_argnames="form")
def _updated(form: Form, phi: Phi, z: jax.Array, key: jax.Array) -> Phi:
    """Hyper-parameters drawn anew given the biases (M,)."""
    learnt = jnp.asarray(form.hierarchy.learnt, int)
    for k, update in enumerate(form.hierarchy.updates()):
        phi = update(phi, z[learnt], jax.random.fold_in(key, k))
    return phi


@partial(jax.jit, static_argnames="form")
def _precisions(form: Form, phi: Phi, first: Precision) -> jax.Array:
    return form.hierarchy.alpha(phi, first.alpha)


def _log_prior(form: Form, phi: Phi, first: Precision, z: np.ndarray) -> float:
    """Log density of biases (M,) and hyper-parameters, that of a flat prior counting as one."""
    alpha = np.asarray(_precisions(form, phi, first))
    own = np.where(alpha > 0, np.log(np.where(alpha > 0, alpha, 1.0) / (2 * np.pi)) - alpha * z**2, 0.0)
    return 0.5 * float(np.sum(own)) + float(form.hierarchy.log_prior(phi))


class _SparseChains:
    """All chains, one after the other: the library keeps one factor at a time, and takes all processors for it."""

    def __init__(
        self, method: Gibbs, form: Form, first: Precision, engine: SparseEngine, mode: SparseExpansion, key: jax.Array
    ):
        self.method, self.form, self.prior, self.engine = method, form, first, engine
        self.mode, self.key, self.model, self.joint = mode, key, mode.model, mode.joint
        self.state: SparseState | None = None  # where the chains stood last
        self._density: JointDensity | None = None
        self._last: _Given | None = None

    def _rng(self, *which: int) -> np.random.Generator:
        return np.random.default_rng([*np.asarray(jax.random.key_data(self.key)).ravel().tolist(), *which])

    def _at(self, reference: np.ndarray) -> JointDensity:
        """The Gaussian at a reference (n,), made once."""
        if self._density is None or not np.array_equal(self._density.at, reference):
            self._density = JointDensity.of(self.model, self.joint, self.mode.point, reference)
        return self._density

    def _given(self, density: JointDensity, phi: Phi) -> _Given:
        """What hyper-parameters leave; factorised once where there are none."""
        alpha, last = np.asarray(_precisions(self.form, phi, self.prior)), self._last
        if last is None or last.density is not density or not np.array_equal(last.alpha, alpha):
            self._last = last = _Given.of(density, alpha)
        return last

    def first(self) -> SparseState:
        """Chains at draws under the declared scales; the reference at the mean of sweeps on the Gaussian."""
        M, states, begin = self.form.biases, self.joint.states, self.form.hierarchy.begin
        key = jax.random.fold_in(self.key, 1)
        density, rng = self._at(variables_of(self.model, self.joint, self.mode.point)), self._rng(0)
        scales = np.ones(M) if self.form.hierarchy.learnt else np.asarray(self.prior.alpha)
        wide = _Given.of(density, scales)
        at = wide.mean[None] + wide.factor.draw(rng, self.method.chains)
        phis = [begin(jax.random.fold_in(key, c)) for c in range(self.method.chains)]
        if self.form.hierarchy.learnt:
            z, phi, total = at[0, states:], phis[0], np.zeros(M)
            for k in range(PILOT):
                phi = _updated(self.form, phi, jnp.asarray(z), jax.random.fold_in(key, self.method.chains + k))
                given = self._given(density, phi)
                z = (given.mean + given.factor.draw(rng, 1)[0])[states:]
                total += given.mean[states:] * (2 * k >= PILOT)
            moved = self.mode.moved(total / (PILOT - PILOT // 2) - np.asarray(self.mode.point.z))
            density = self._at(variables_of(self.model, self.joint, settle_each(self.model, moved)))
            given = self._given(density, phi)
        else:
            given = _Given.of(density, scales)
        here = given.mean + given.factor.draw(rng, 1)[0]
        kicks = self._kicks(given, here, rng)
        stacked = {name: np.stack([np.asarray(phi[name]) for phi in phis]) for name in phis[0]}
        return self._begun(at, stacked, density.at, kicks)

    def _begun(self, at: np.ndarray, phi: Any, reference: np.ndarray, kicks: int) -> SparseState:
        M, S = self.form.biases, self.joint.states
        return SparseState(
            at, phi, np.array(0), np.array(1), np.zeros(2, int), np.zeros((2, S)), np.zeros((2, S)), np.zeros((2, M)),
            np.zeros((2, M)), reference, np.array(kicks),
        )  # fmt: skip

    def _kicks(self, given: _Given, at: np.ndarray, rng: np.random.Generator) -> int:
        """The fewest kicks with which turns are taken often enough."""
        rest, _ = given.density.rest(at)
        for kicks in KICKS:
            rates = []
            for _ in range(TRIED):
                at, rest, rate, _ = given.turned(at, rest, kicks, rng)
                rates.append(rate)
            if np.mean(rates) >= WANTED:
                break
        return kicks

    def restored(self, leaves: list[np.ndarray]) -> SparseState:
        """The state of saved leaves; raises `InputError` where they are those of another."""
        C, n = self.method.chains, self.joint.places.size
        phi = jax.eval_shape(self.form.hierarchy.begin, self.key)
        stacked: Any = {name: np.zeros((C, *leaf.shape)) for name, leaf in phi.items()}
        blank = self._begun(np.zeros((C, n)), stacked, np.zeros(n), 1)
        self.state = restored_as(blank, leaves)
        return self.state

    def advance(self, state: SparseState, thin: int, pool: ThreadPoolExecutor) -> tuple[SparseState, Draw]:
        """All chains one chunk further, every `thin`-th sweep kept."""
        density, sums = self._at(np.asarray(state.reference)), {name: np.array(getattr(state, name)) for name in SUMS}
        if int(state.thin) != thin:  # begun anew: what was before is warm-up
            sums = {name: np.stack([np.zeros_like(own[0]), own[0]]) for name, own in sums.items()}
        ends, drawn = list[_Chain](), []
        for c in range(self.method.chains):
            at, phi = np.asarray(state.at[c]), {name: leaf[c] for name, leaf in state.phi.items()}
            own = _Chain(c, int(state.made), at, phi, density.rest(at)[0], 0.0)
            parts = []
            for _ in range(self.method.chunk):
                for _ in range(thin):
                    own, moments = self._swept(density, own, int(state.kicks))
                    if thin > 1 or own.made > self.method.warmup:
                        for name, value in moments.items():
                            sums[name][0] += value
                parts.append(self._draw(density, own))
            ends.append(own)
            drawn.append(jax.tree.map(lambda *leaves: np.stack(leaves), *parts))
        self.state = state._replace(
            at=np.stack([own.at for own in ends]), made=np.array(ends[0].made), thin=np.array(thin),
            phi={name: np.stack([np.asarray(own.phi[name]) for own in ends]) for name in state.phi},
            **sums,
        )  # fmt: skip
        return self.state, jax.tree.map(lambda *leaves: np.stack(leaves), *drawn)

    def _states(self, at: np.ndarray) -> tuple[np.ndarray, ...]:
        """States (E, n) of each recursion; nothing where the draws of all would take too much room."""
        if not self.method.keeps_states(self.model):
            return ()
        known = self.mode.point.states
        return tuple(np.where(own >= 0, at[own], np.asarray(x)) for own, x in zip(self.joint.slots, known, strict=True))

    def _swept(self, density: JointDensity, chain: _Chain, kicks: int) -> tuple[_Chain, dict[str, Any]]:
        """One sweep of a chain, and what is summed over sweeps."""
        states = self.joint.states
        rng = self._rng(1, chain.number, chain.made)
        key = jax.random.fold_in(jax.random.fold_in(self.key, 2 + chain.number), chain.made)
        phi = _updated(self.form, chain.phi, jnp.asarray(chain.at[states:]), key)
        given = self._given(density, phi)
        at, rest, rate, speed = given.turned(chain.at, chain.rest, kicks, rng)
        step, variance = at[:states] - density.at[:states], _variances(given, speed)
        gamma = 1.0 - given.alpha * variance
        moments = {"summed": 1, "total": step, "square": step**2, "gamma": gamma, "variance": variance}
        return _Chain(chain.number, chain.made + 1, at, phi, rest, rate), moments

    def _draw(self, density: JointDensity, chain: _Chain) -> Draw:
        """What is kept of a chain where it stands."""
        at, z, none = chain.at, chain.at[self.joint.states :], np.zeros(0)
        step = at - density.at
        value = density.value + chain.rest + float(step @ (density.slope - 0.5 * (density.matrix @ step)))
        value += _log_prior(self.form, chain.phi, self.prior, z)
        most = NUMBERS / (self.method.chains * self.method.draws)
        phi = {name: np.asarray(leaf) for name, leaf in chain.phi.items() if np.size(leaf) <= most}
        fields: dict[str, Any] = {"theta": z, "phi": phi, "gamma": none, "variance": none, "density": np.array(value)}
        return Draw(**fields | {"states": self._states(at), "stats": {"acceptance_rate": np.array(chain.rate)}})


def _variances(given: _Given, drawn: np.ndarray) -> np.ndarray:
    """Unbiased estimates of the variances (M,) of the biases from a draw (n,) about zero, the rest of each given."""
    states = given.density.joint.states
    own = given.density.matrix.diagonal()[states:] + given.alpha
    return 1.0 / own + (drawn[states:] - given.times(drawn)[states:] / own) ** 2


def _covariances(z: np.ndarray, members: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Covariances (B, p, p) of the members (B, p) of each block over draws z; of a single draw, variances (M,)."""
    M, none = len(variance), members == len(variance)
    flat = np.concatenate([z.reshape(-1, M), np.zeros((z.shape[0] * z.shape[1], 1))], 1)
    found = np.zeros((*members.shape, members.shape[1]))
    own = flat - flat.mean(0)
    for b, block in enumerate(members):
        found[b] = own[:, block].T @ own[:, block] / max(len(flat) - 1, 1)
    eye = np.eye(members.shape[1])[None]
    if len(flat) == 1:
        found = eye * np.append(variance, 0.0)[members][:, None]
    return found + eye * none[:, None]


@dataclass(frozen=True, eq=False)
class SparseChains(BlockPosterior):
    """The draws of the biases by sparse factors, and moments of the states."""

    run: SamplerRun | None = None
    middle: tuple[np.ndarray, ...] = ()  # (E, n) mean states of each recursion

    chained: ClassVar[bool] = True

    @classmethod
    def drawn(
        cls, problem: Problem, prior: Prior, run: SamplerRun, runs: _SparseChains, mixed: Mapping[str, np.ndarray]
    ) -> SparseChains:
        """The posterior of a run, what the data leave open not yet said."""
        z, model, M, state = run.z, problem.model, run.form.biases, runs.state
        assert state is not None
        mean = z.mean((0, 1))
        which = 0 if int(state.thin) == run.thin else 1  # a longer run that was interrupted leaves the draws before it
        count, total, square, told, spread = (np.asarray(getattr(state, name))[which] for name in SUMS)
        members = blocks_of(model)
        blocks = SensorBlocks(M, members, _covariances(z, members, spread / count))
        variance, gamma = square / count - (total / count) ** 2, np.clip(told / count, 0.0, 1.0)
        tail = 50 * (1 - INTERVAL)
        lower, upper = np.percentile(z, [tail, 100 - tail], axis=(0, 1))
        alpha = np.clip((1 - gamma) / np.maximum(blocks.variance, 1e-300), *PRECISION_BOUNDS)
        held = np.isin(np.arange(M), run.form.hierarchy.learnt, invert=True)
        alpha = np.where(held, np.asarray(run.posed.first.alpha), alpha)
        joint, at = runs.joint, runs.engine.settled(model, runs.mode.moved(mean - np.asarray(runs.mode.point.z)))
        declared = declared_blocks(at)
        columns = dict(mixed) | told_columns(declared) | {"inclusion": (np.abs(z) > ROPE).mean((0, 1))}
        summary = Summary(
            "exact", "sampled", mean, None, lower, upper, gamma, alpha, None, np.zeros(0), None, columns, blocks
        )
        middle = np.asarray(state.reference)[: joint.states] + total / count
        whole = np.concatenate([np.maximum(variance, 0.0), blocks.variance])
        spread = Spread(blocks.variance, np.zeros(M), tuple(joint.state_values(whole)))
        point = point_of_variables(model, joint, at.point, np.concatenate([middle, mean]))
        return cls(
            problem, prior, at.point, summary, at, Factors.alone(alpha), spread, declared, (), 0, None, run,
            tuple(np.asarray(x) for x in point.states),
        )  # fmt: skip

    def log_joint(self, point: Point, phi: Phi) -> float:
        """Log density of data, noises, biases and hyper-parameters at a point, as it is kept of each draw."""
        known = _log_prior(self._run.form, phi, self._run.posed.first, np.asarray(point.z))
        return float(log_density(self.problem.model, point)) + known

    @property
    def states(self) -> Sequence[np.ndarray]:
        """Mean states (E, n) of each recursion."""
        return self.middle

    def draws(self, key: jax.Array, keep: tuple[str, ...]) -> Draws:
        """The draws that were made, those of states where they are few."""
        run = self._run
        if not run.states:
            return Draws(run.z, run.levels, [], np.arange(run.z.shape[1]), [], [])
        kept, likelihood, replicas = values_by_datum(self.problem, run, key, keep)
        return Draws(run.z, run.levels, run.states if "states" in keep else [], kept, likelihood, replicas)

    @property
    def _run(self) -> SamplerRun:
        assert self.run is not None
        return self.run

    @property
    def variables(self) -> Mapping[str, Any]:
        """Hyper-parameters of every draw; those by bias where they are few."""
        return self._run.form.hierarchy.variables(self.problem.labels, self.hyper)

    @property
    def hyper(self) -> Mapping[str, np.ndarray]:
        """Draws of the hyper-parameters, (chain, draw, ...)."""
        return {name: np.asarray(a) for name, a in self._run.draws.phi.items()}

    @property
    def stats(self) -> Mapping[str, np.ndarray]:
        """Log density of every draw, and how likely its turn was taken."""
        own = {name: np.asarray(value) for name, value in self._run.draws.stats.items()}
        return {"lp": np.asarray(self._run.draws.density)} | own

    @property
    def attrs(self) -> Mapping[str, float]:
        """Seconds, and steps from one draw to the next, beside what a sparse fit tells."""
        return {**super().attrs, "seconds": self._run.seconds, "thin": float(self._run.thin)}
