"""Expectation maximisation: EM (ML and MAP) and the double loop EM-EA of Paper C."""

from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp

from probcal import linalg
from probcal.errors import InputError
from probcal.inference.run import Given, Maximiser, State, learn
from probcal.model import sigma
from probcal.model.model import Model
from probcal.priors import ARD, Flat, Gaussian, Laplace, Precision, Prior
from probcal.smoothing.information import laplace, state_covariances, update_levels
from probcal.smoothing.mode import Point, between, cost, eliminate_rows, find_mode, follow

HALVINGS = 8
LINEARISATIONS = ("extended", "unscented", "cubature")


def _shorten(model: Model, point: Point, proposal: Point, prior: Precision, slack: float) -> tuple[Point, jax.Array]:
    """The longest of the halved steps that leaves the cost finite and at most `slack` above the old one.

    Also whether there was none.
    """
    bound = cost(model, point, prior) + slack

    def worse(state):
        t, tries = state
        return ~(cost(model, between(point, proposal, t), prior) <= bound) & (tries < HALVINGS)

    t, tries = jax.lax.while_loop(worse, lambda s: (0.5 * s[0], s[1] + 1), (jnp.ones(()), 0))
    found = between(point, proposal, jnp.where(tries < HALVINGS, t, 0.0))
    return jax.tree.map(lambda new, old: jnp.where(jnp.isfinite(new), new, old), found, point), jnp.asarray(
        tries >= HALVINGS
    )


def _inner(model: Model, point: Point, prior: Precision, rule: str) -> tuple[Point, jax.Array, jax.Array]:
    """One E and one M step (Paper A 15-21, Paper C 2c and 35); also the variances of z at fixed trajectories (36).

    Last, whether both steps were refused.
    """
    slack = 0.0
    if rule == "extended":  # one damped pass of the extended smoother, linearised at the last trajectory
        mode = find_mode(model, point, prior, 1, 0.0, joint=False)
        point, refused = mode.point, mode.refused
        information, score = model.of_biases(model.linearise(point, expected=False))
    else:
        spread = state_covariances(model, point)
        lins = sigma.regress(model, point, spread, rule)
        smoothed = follow(model, point, eliminate_rows(model, point, lins, joint=False), jnp.zeros_like(point.z))
        # the mean of a density lies off its mode, by half a unit of cost a dimension at most in the Gaussian case
        slack = 0.5 * sum(u.size for u in point.noises)
        point, refused = _shorten(model, point, smoothed, prior, slack)
        spread = state_covariances(model, point)
        information, score = sigma.expect_biases(model, point, spread, rule)
    matrix = information + prior.matrix() + 1e-12 * jnp.eye(model.biases)
    step = linalg.solve_positive(matrix, score - prior.pull(point.z))
    finite = jnp.all(jnp.isfinite(step))
    step = jnp.where(jnp.isfinite(step), step, 0.0)
    point, stuck = _shorten(model, point, point._replace(z=point.z + step), prior, slack)
    return point, linalg.inverse_diagonal(matrix), refused & (stuck | ~finite)


def _iterate(model: Model, prior: Prior, given: Given, state: State, inner: int, linearisation: str) -> State:
    """`inner` E and M steps, then the update of the precisions (Paper C 40) and of the levels."""
    now = given.prior._replace(alpha=state.alpha)
    point, variance, refused = state.point, jnp.zeros_like(state.alpha), state.refused
    for _ in range(inner):
        point, variance, stuck = _inner(model, point, now, linearisation)
        refused = refused & stuck
    alpha = learn(prior, given, state.alpha, jnp.zeros_like(variance), variance, point.z, "em")
    if point.levels.shape[0]:
        point = update_levels(model, point, jnp.diag(variance))
    after = given.prior._replace(alpha=alpha)
    free = jnp.where(given.surveyed, 0.0, prior.penalty(point.z, alpha) - 0.5 * alpha * point.z**2)
    value = -cost(model, point, after) - jnp.sum(free)
    if prior.proper:
        value = value + 0.5 * after.log_determinant()
    done = jnp.abs(value - state.objective) < given.tolerance
    return State(point, alpha, state.found, value, state.best, refused, done)


@dataclass(frozen=True)
class EM(Maximiser):
    """Expectation maximisation of the biases: ML with `Flat`, MAP with `Gaussian` (Paper A 15-21, Paper C 27-36).

    `linearisation` of the E-step is "extended" or, by sigma points, "unscented" or "cubature". It stops when the
    joint log density changes by less than `tolerance`; 0 runs all `iterations` and counts as converged, as the
    papers do. Raises `InputError` for another linearisation.
    """

    iterations: int = 500
    tolerance: float = 1e-5
    inner: int = 1
    linearisation: str = "extended"

    name: ClassVar[str] = "EM"
    priors: ClassVar[tuple[type, ...]] = (Gaussian, Flat, Laplace)
    intervals: ClassVar[str] = "Laplace: exact for a Gaussian or flat prior where the problem is linear and Gaussian"

    def __post_init__(self):
        if self.linearisation not in LINEARISATIONS:
            raise InputError(
                f'{self.name}(linearisation="{self.linearisation}"): give one of {", ".join(LINEARISATIONS)}'
            )
        if self.inner < 1:
            raise InputError(f"{self.name}(inner={self.inner}): at least one inner iteration is needed")

    def iterate(self, model: Model, prior: Prior, given: Given, state: State) -> State:
        """Inner EM steps, then new precisions."""
        return _iterate(model, prior, given, state, self.inner, self.linearisation)

    def close(self, model: Model, given: Given, state: State) -> State:
        """Covariance and evidence at the point, trajectories marginalised."""
        found = laplace(model, state.point, given.prior._replace(alpha=state.alpha))
        return state._replace(found=found, best=jnp.fmax(state.best, found.evidence))


@dataclass(frozen=True)
class EMEA(EM):
    """The double loop of Paper C (Algorithm 1): `inner` EM steps, then precisions by update (40).

    By default 50 outer iterations are run as in the paper (`tolerance` 0); `linearisation` as in `EM`. The
    reported covariance is marginalised over the trajectories, unlike the paper's (36), whose intervals are
    narrower still.
    """

    iterations: int = 50
    tolerance: float = 0.0

    name: ClassVar[str] = "EM-EA"
    priors: ClassVar[tuple[type, ...]] = (ARD,)
    intervals: ClassVar[str] = "plug-in: the precisions are taken as known, so the intervals are too narrow"
