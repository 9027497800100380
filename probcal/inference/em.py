"""Expectation maximisation: EM (ML and MAP) and the double loop EM-EA of Paper C."""

from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from probcal.errors import InputError
from probcal.gaussian.esteps import EStep, Extended, shorten
from probcal.gaussian.linearised import laplace
from probcal.gaussian.mode import Point, cost, mixing_gain
from probcal.gaussian.solves import Dense
from probcal.inference.method import Context, Given, MethodTask, ParticleSmoother, State
from probcal.inference.run import Maximiser, learn, renew_noise, valued
from probcal.model.model import Model
from probcal.priors import ARD, Flat, Gaussian, Laplace, Precision, Prior
from probcal.problem import Problem

EXTENDED = Extended()
BY_PATHS = "Gaussian of the curvature of the marginal likelihood, by the slope of its score over filters"
RIDGE = 1e-12  # of the information, where a flat prior meets a bias that no row reads


def _inner(
    model: Model, step: EStep, point: Point, prior: Precision, carry: Any, key: jax.Array
) -> tuple[Point, jax.Array, jax.Array, Any]:
    """One E and one M step (Paper A 15-21, Paper C 2c and 35); also the variances of z at fixed trajectories (36).

    Then whether both steps were refused, and what the E-step carries on.
    """
    expected, carry = step(model, point, prior, carry, key)
    point = expected.point
    biases = Dense.of(expected.information + prior.matrix() + RIDGE * jnp.eye(model.biases))
    move = biases.solve(expected.score - prior.pull(point.z))
    finite = jnp.all(jnp.isfinite(move))
    move = jnp.where(jnp.isfinite(move), move, 0.0)
    point, stuck = shorten(model, point, point._replace(z=point.z + move), prior, expected.slack)
    return point, biases.marginals(), expected.refused & (stuck | ~finite), carry


def _iterate(model: Model, prior: Prior, given: Given, state: State, inner: int, step: EStep) -> State:
    """`inner` E and M steps, then the update of the precisions (Paper C 40) and of the levels."""
    now = given.prior._replace(alpha=state.alpha)
    point, variance, refused, carry = state.point, jnp.zeros_like(state.alpha), state.refused, state.carry
    seed, *seeds = jax.random.split(state.seed, inner + 1)
    for own in seeds:
        point, variance, stuck, carry = _inner(model, step, point, now, carry, own)
        refused = refused & stuck
    alpha = learn(prior, given, state.alpha, jnp.zeros_like(variance), variance, point.z, "em")
    model, state = renew_noise(model, state._replace(point=point), jnp.diag(variance))
    point = state.point
    after = given.prior._replace(alpha=alpha)
    free = jnp.where(given.surveyed, 0.0, prior.penalty(point.z, alpha) - 0.5 * alpha * point.z**2)
    value = mixing_gain(model) - cost(model, point, after) - jnp.sum(free)
    if prior.proper:
        value = value + 0.5 * after.log_determinant()
    done = jnp.abs(value - state.objective) < given.tolerance
    return state._replace(point=point, alpha=alpha, objective=value, refused=refused, done=done, seed=seed, carry=carry)


@dataclass(frozen=True)
class EM(Maximiser):
    """Expectation maximisation of the biases: ML with `Flat`, MAP with `Gaussian` (Paper A 15-21, Paper C 27-36).

    `e_step` is a value: `Extended()` or, by sigma points, `Unscented()` or `Cubature()`. It stops when the joint log
    density changes by less than `tolerance`; 0 runs all `iterations`, as the papers do. Raises `InputError` for an
    E-step that is none.

    `Particles(500)` as E-step is Paper A's algorithm: any motion, roads too; it stops where the
    biases only scatter about a place. The intervals are by the slope of the score of the marginal
    likelihood over filters; `sd_error` is the Monte Carlo error of each sd over the sd, and where
    it stays above 6 % the fit has not converged.
    """

    e_step: EStep | ParticleSmoother = EXTENDED
    iterations: int = 500
    tolerance: float = 1e-5
    inner: int = 1

    name: ClassVar[str] = "EM"
    priors: ClassVar[tuple[type, ...]] = (Gaussian, Flat, Laplace)
    intervals: ClassVar[str] = "Laplace: exact for a Gaussian or flat prior where the problem is linear and Gaussian"

    def __post_init__(self):
        if not isinstance(self.e_step, EStep | ParticleSmoother):
            raise InputError(
                f"{self.name}(e_step={self.e_step!r}): give an E-step such as Extended(), Cubature() or Particles(500)"
            )
        if self.inner < 1:
            raise InputError(f"{self.name}(inner={self.inner}): at least one inner iteration is needed")

    @property
    def by_particles(self) -> bool:
        """Whether trajectories are particles."""
        return isinstance(self.e_step, ParticleSmoother)

    def note(self, prior: Prior) -> str:
        """What the intervals are worth."""
        return BY_PATHS if self.by_particles and not prior.learns else super().note(prior)

    def task(self, problem: Problem, prior: Prior, start: Point, context: Context) -> MethodTask:
        """A climb, by particles where the E-step draws them."""
        if isinstance(self.e_step, ParticleSmoother):
            return self.e_step.task(self, problem, prior, start, context)
        return super().task(problem, prior, start, context)

    def iterate(self, model: Model, prior: Prior, given: Given, state: State) -> State:
        """Inner EM steps, then new precisions."""
        assert isinstance(self.e_step, EStep)
        return _iterate(model, prior, given, state, self.inner, self.e_step)

    def begin(self, model: Model, start: Point) -> Any:
        """What the E-step carries to its first step."""
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

    name: ClassVar[str] = "EM-EA"
    priors: ClassVar[tuple[type, ...]] = (ARD,)
    intervals: ClassVar[str] = "plug-in: the precisions are taken as known, so the intervals are too narrow"
