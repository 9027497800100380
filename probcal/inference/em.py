"""Expectation maximisation: EM (ML and MAP) and the double loop EM-EA of Paper C."""

from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal.errors import InputError
from probcal.gaussian.choose import engine_named, estimates
from probcal.gaussian.dense import DenseEngine
from probcal.gaussian.engine import Engine, Factors, Group, evidence
from probcal.gaussian.esteps import EStep, Expected, Extended, shorten
from probcal.gaussian.linearised import laplace
from probcal.gaussian.mode import Point, cost, mixing_gain
from probcal.gaussian.solves import Dense
from probcal.gaussian.tails import Variances, renewed_noise
from probcal.inference.ending import conclude_at
from probcal.inference.engined import Engined
from probcal.inference.loop import Pause, Trace
from probcal.inference.method import Context, Given, MethodTask, ParticleSmoother, State
from probcal.inference.mixture import gaussian_at
from probcal.inference.run import KernelClimb, Maximiser, learn, single_course, stepped, valued
from probcal.model.model import Model
from probcal.model.variants import biases_alone
from probcal.priors import ARD, Flat, Gaussian, Laplace, Precision, Prior
from probcal.problem import Problem
from probcal.results.answer import Answer

EXTENDED = Extended()
BY_PATHS = "Gaussian of the curvature of the marginal likelihood, by the slope of its score over filters"
RIDGE = 1e-12  # of the information, where a flat prior meets a bias that no row reads


class MatrixStep(NamedTuple):
    """The M step in kernels: the biases at fixed trajectories, by one matrix of all."""

    def solved(self, model: Model, expected: Expected, prior: Precision) -> tuple[Any, Any]:
        """Step (M,) of the biases (Paper C 35), and their variances (M,) at fixed tracks (36)."""
        information = model.between_biases(expected.information)
        biases = Dense.of(information + prior.matrix() + RIDGE * jnp.eye(model.biases))
        return biases.solve(expected.score - prior.pull(expected.point.z)), biases.marginals()

    def spread(self, model: Model, point: Point, prior: Precision) -> Variances:
        """Variances of which unknown noise follows, biases and trajectories both uncertain."""
        at = DenseEngine().at(model, point)
        biases = Dense.of(at.eliminated.information + prior.matrix())
        return Variances.dense(at, biases.covariance())


class EngineStep(NamedTuple):
    """The same on any engine, of the information by sensor as factors."""

    engine: Engine
    learns: bool  # whether precisions are, so that the variances matter

    def solved(self, model: Model, expected: Expected, prior: Precision) -> tuple[Any, Any]:
        """The step (M,) of the biases, and their variances (M,)."""
        M, z = model.biases, expected.point.z
        parts = model.each_block(expected.information)
        groups = (Group(np.asarray(data.bias), own, np.zeros(data.bias.shape)) for _, data, _, own in parts)
        factors = Factors.of(prior) + Factors.alone(np.full(M, RIDGE)) + Factors(tuple(groups))
        at = self.engine.at(biases_alone(model), Point((), (), z, expected.point.levels), ())
        move = at.solve(factors, np.asarray(expected.score - prior.pull(z)))
        if not self.learns:
            return move, np.zeros(M)
        return move, at.marginals(factors, np.arange(M)[:, None])[:, 0, 0]

    def spread(self, model: Model, point: Point, prior: Precision) -> Variances:
        """Variances of which unknown noise follows."""
        return Variances.of(self.engine.at(model, point), Factors.of(prior))


@partial(jax.jit, static_argnums=0, inline=True)
def _expected(step: EStep, *given: Any) -> tuple[Expected, Any]:
    return step(*given)


@partial(jax.jit, inline=True)
def _moved(model: Model, expected: Expected, move: Any, prior: Precision) -> tuple[Point, jax.Array]:
    """The point after a step of the biases, and whether both steps were refused."""
    point, there = expected.point, jnp.isfinite(move)
    after = point._replace(z=point.z + jnp.where(there, move, 0.0))
    point, stuck = shorten(model, point, after, prior, expected.slack)
    return point, expected.refused & (stuck | ~jnp.all(there))


def _iterate(
    model: Model, prior: Prior, given: Given, state: State, method: "EM", biases: MatrixStep | EngineStep
) -> State:
    """`inner` E and M steps (Paper A 15-21, Paper C 2c), then new precisions (40) and levels."""
    now = given.prior._replace(alpha=state.alpha)
    point, variance, refused, carry = state.point, jnp.zeros_like(state.alpha), state.refused, state.carry
    seed, *seeds = jax.random.split(state.seed, method.inner + 1)
    for own in seeds:
        expected, carry = _expected(method.e_step, model, point, now, carry, own)
        move, variance = biases.solved(model, expected, now)
        point, stuck = _moved(model, expected, move, now)
        refused = refused & stuck
    alpha = learn(prior, given, state.alpha, jnp.zeros_like(variance), variance, point.z, "em")
    if model.learns_noise:
        model, point = renewed_noise(model, point, biases.spread(model, point, now))
        state = state._replace(mixing=model.mixing)
    return _valued(
        model, prior, given, state._replace(point=point, alpha=alpha, refused=refused, seed=seed, carry=carry)
    )


@partial(jax.jit, static_argnames="prior", inline=True)
def _valued(model: Model, prior: Prior, given: Given, state: State) -> State:
    """The state with the log density there, and whether it stays."""
    point, alpha = state.point, state.alpha
    after = given.prior._replace(alpha=alpha)
    free = jnp.where(given.surveyed, 0.0, prior.penalty(point.z, alpha) - 0.5 * alpha * point.z**2)
    value = mixing_gain(model) - cost(model, point, after) - jnp.sum(free)
    if prior.proper:
        value = value + 0.5 * after.log_determinant()
    done = jnp.abs(value - state.objective) < given.tolerance
    return state._replace(objective=value, done=done)


@dataclass(eq=False)
class EngineEM(Engined, KernelClimb):
    """EM on any engine: trajectories by kernels, the biases and their covariance by the engine."""

    whole = False

    def step(self, state: State, count: int, pause: Pause) -> tuple[State, Trace]:
        """One iteration."""
        state = stepped(self, self.model, self.bare, self.given, state)
        return state, single_course(state)

    def iterate(self, model: Model, prior: Prior, given: Given, state: State) -> State:
        """Inner EM steps, then new precisions."""
        biases = EngineStep(self.engine, prior.learns)
        return _iterate(model, prior, given, state, self.method, biases)

    def ended(self, state: State, trace: Trace) -> bool:
        """True where the density stays."""
        return bool(state.done)

    def outcome(self, state: State, course: Trace) -> Answer:
        """The Gaussian at the last state, trajectories marginalised."""
        problem = self.problem.with_mixing(state.mixing)
        prior = self.given.prior._replace(alpha=state.alpha)
        at = self.engine.at(problem.model, state.point)
        worth = evidence(at, prior)
        posterior = gaussian_at(problem, self.prior, at, worth, prior)
        return conclude_at(
            problem, self.method, self.prior, posterior, course, converged=bool(state.done),
            evidence=worth.value, stopped=self.context.monitor.stopped, refused=bool(state.refused),
        )  # fmt: skip


@dataclass(frozen=True)
class EM(Maximiser):
    """Expectation maximisation of the biases: ML with `Flat`, MAP with `Gaussian` (Paper A 15-21, Paper C 27-36).

    `e_step` is a value: `Extended()` or, by sigma points, `Unscented()` or `Cubature()`. It stops when the joint log
    density changes by less than `tolerance`; 0 runs all `iterations`, as the papers do. `engine` as in `EA`. Raises
    `InputError` for an E-step that is none, or another engine.

    `Particles(500)` as E-step is Paper A's algorithm: any motion, roads too; it stops where the
    biases only scatter about a place. The intervals are by the slope of the score of the marginal
    likelihood over filters; `sd_error` is the Monte Carlo error of each sd over the sd, and where
    it stays above 6 % the fit has not converged.
    """

    e_step: EStep | ParticleSmoother = EXTENDED
    iterations: int = 500
    tolerance: float = 1e-5
    inner: int = 1
    engine: str | Engine = "auto"

    name = "EM"
    priors: ClassVar[tuple[type, ...]] = (Gaussian, Flat, Laplace)
    intervals = "Laplace: exact for a Gaussian or flat prior where the problem is linear and Gaussian"

    def __post_init__(self):
        if not isinstance(self.e_step, EStep | ParticleSmoother):
            raise InputError(
                f"{self.name}(e_step={self.e_step!r}): give an E-step such as Extended(), Cubature() or Particles(500)"
            )
        if self.inner < 1:
            raise InputError(f"{self.name}(inner={self.inner}): at least one inner iteration is needed")
        object.__setattr__(self, "engine", engine_named(self.name, self.engine))

    @property
    def by_particles(self) -> bool:
        """True if trajectories are particles."""
        return isinstance(self.e_step, ParticleSmoother)

    def note(self, prior: Prior) -> str:
        """A note on the validity of the intervals."""
        return BY_PATHS if self.by_particles and not prior.learns else super().note(prior)

    def task(self, problem: Problem, prior: Prior, start: Point, context: Context) -> MethodTask:
        """A climb, by particles where the E-step draws them."""
        if isinstance(self.e_step, ParticleSmoother):
            return self.e_step.task(self, problem, prior, start, context)
        engine = self.expands_by(problem.model)
        own = self, problem, prior, start, context
        return super().task(*own[1:]) if engine is None else EngineEM(*own, engine=engine)

    def lacking(self, prior: Prior, starts: int) -> str:
        """As every climb; precisions may be learnt where an engine is exact."""
        return super().lacking(prior if estimates(self.engine) else Gaussian(), starts)

    def iterate(self, model: Model, prior: Prior, given: Given, state: State) -> State:
        """Inner EM steps, then new precisions."""
        return _iterate(model, prior, given, state, self, MatrixStep())

    def begin(self, model: Model, start: Point) -> Any:
        """The state that the E-step carries into its first step."""
        assert isinstance(self.e_step, EStep)
        return self.e_step.begin(model, start)

    def close(self, model: Model, prior: Prior, given: Given, state: State) -> State:
        """Covariance and evidence at the point, trajectories marginalised."""
        found = laplace(model, state.point, given.prior._replace(alpha=state.alpha))
        return valued(prior, given, state._replace(found=found))


@dataclass(frozen=True)
class EMEA(EM):
    """The double loop of Paper C (Algorithm 1): `inner` EM steps, then precisions by update (40).

    By default 50 outer iterations are run as in the paper (`tolerance` 0); `e_step` as in `EM`. The
    reported covariance is marginalised over the trajectories, unlike the paper's (36), whose intervals are
    narrower still.
    """

    iterations: int = 50
    tolerance: float = 0.0

    name = "EM-EA"
    priors = (ARD,)
    intervals = "plug-in: the precisions are taken as known, so the intervals are too narrow"
