"""Joint mode and evidence: EA, MAP and weighted least squares, with every trajectory marginalised."""

from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp

from probcal.errors import InputError
from probcal.inference.run import Given, Maximiser, State, learn, valued
from probcal.model.model import Model
from probcal.priors import ARD, Flat, Gaussian, Laplace, Prior
from probcal.problem import Problem
from probcal.smoothing.information import paper_b, update_levels
from probcal.smoothing.linearised import laplace
from probcal.smoothing.marginal import find_marginal_mode
from probcal.smoothing.mode import Point, cost, find_mode, track

RULES = ("mackay", "em")
MODES = {"joint": find_mode, "marginal": find_marginal_mode}
STEPS = {"joint": 30, "marginal": 2}  # between two updates of the precisions; a marginal step costs several joint ones
TRAJECTORIES = (*MODES, "smoothed")


def _learnt(model: Model, prior: Prior, given: Given, state: State, rule: str) -> State:
    """The state with precisions and levels that follow from what the last iteration found, if there was one."""
    fresh = jnp.isneginf(state.objective)
    alpha = learn(
        prior, given, state.alpha, state.found.gamma, jnp.diagonal(state.found.covariance), state.point.z, rule
    )
    point = state.point
    if point.levels.shape[0]:
        moved = update_levels(model, point, state.found.covariance)
        point = jax.tree.map(lambda after, before: jnp.where(fresh, before, after), moved, point)
    return state._replace(point=point, alpha=jnp.where(fresh, state.alpha, alpha))


def _iterate(model: Model, prior: Prior, given: Given, state: State, rule: str, trajectory: str) -> State:
    """New precisions and levels, then the mode and the evidence at that mode: all of one state belongs together."""
    state = _learnt(model, prior, given, state, rule)
    now = given.prior._replace(alpha=state.alpha)
    mode = MODES[trajectory](model, state.point, now, STEPS[trajectory], 1e-2 * given.tolerance)
    found = laplace(model, mode.point, now)
    objective = (
        found.evidence if prior.proper or not prior.learns else _density(model, prior, given, mode.point) - mode.volume
    )
    still = jnp.abs(objective - state.objective) < given.tolerance
    # where a target grazes a sensor the density has a cusp: no step lowers the cost, and none is needed
    settled = mode.converged | (mode.gained < given.tolerance)
    done = still & settled if prior.learns or mode.point.levels.shape[0] else mode.converged
    refused = state.refused & mode.refused
    state = state._replace(point=mode.point, found=found, objective=objective, refused=refused, done=done)
    return valued(prior, given, state)


def _density(model: Model, prior: Prior, given: Given, point: Point) -> jax.Array:
    """Log joint density with the prior's own penalty."""
    held = given.prior._replace(alpha=jnp.where(given.surveyed, given.prior.alpha, 0.0))
    penalty = jnp.where(given.surveyed, 0.0, prior.penalty(point.z, 0.0))
    return -cost(model, point, held) - jnp.sum(penalty)


def _iterate_paper_b(model: Model, prior: Prior, given: Given, state: State, rule: str) -> State:
    """Smooth at the current biases, then their posterior (16)-(17) for the precisions (25) of Paper B."""
    state = _learnt(model, prior, given, state, rule)
    point = track(model, state.point)
    found, step = paper_b(model, point, given.prior._replace(alpha=state.alpha))
    refused = state.refused & ~jnp.all(jnp.isfinite(step))
    step = jnp.where(jnp.isfinite(step), jnp.clip(step, -1.0, 1.0), 0.0)
    done = (jnp.abs(found.evidence - state.objective) < given.tolerance) & (jnp.max(jnp.abs(step)) < 1e-3)
    point = point._replace(z=point.z + step)
    state = state._replace(point=point, found=found, objective=found.evidence, refused=refused, done=done)
    return valued(prior, given, state)


@dataclass(frozen=True)
class EA(Maximiser):
    """Evidence approximation with trajectories marginalised exactly: the default.

    `update` of the precisions is "mackay" (Paper B 25) or "em" (Paper C 40; the same fixed points, slower).
    `trajectory` says what the reported point is: "joint" the mode of biases and trajectory together, "marginal" that of
    the biases with the trajectory integrated (Laplace; see `smoothing.marginal`), which does not shrink a scene whose
    size only the motion tells. "smoothed" is Paper B as printed: the smoothed density of each epoch alone stands for
    the trajectory (R-bar, 10-17), so that the data count twice. `tolerance` is the change of log evidence, in nats,
    at which it stops; `iterations` caps the outer loop. Raises `InputError` for another update or trajectory.
    """

    iterations: int = 200
    tolerance: float = 1e-3
    update: str = "mackay"
    trajectory: str = "joint"

    name: ClassVar[str] = "EA"
    priors: ClassVar[tuple[type, ...]] = (ARD,)
    intervals: ClassVar[str] = (
        "plug-in: the precisions (and unknown levels) are taken as known, so the intervals are too narrow"
    )

    def __post_init__(self):
        for field, known in (("update", RULES), ("trajectory", TRAJECTORIES)):
            if getattr(self, field) not in known:
                raise InputError(f'EA({field}="{getattr(self, field)}"): give one of {", ".join(known)}')

    def note(self) -> str:
        """What the intervals are worth with these settings."""
        twice = "; the data count twice (Paper B as printed)" if self.trajectory == "smoothed" else ""
        return self.intervals + twice

    def iterate(self, model: Model, prior: Prior, given: Given, state: State) -> State:
        """Mode (or smoothed trajectory), evidence, new precisions."""
        if self.trajectory == "smoothed":
            return _iterate_paper_b(model, prior, given, state, self.update)
        return _iterate(model, prior, given, state, self.update, self.trajectory)


@dataclass(frozen=True)
class MAP(Maximiser):
    """Mode under a given prior with its Laplace covariance: of trajectories and biases jointly, or of the marginal.

    `Gaussian` is l2, `Laplace` l1 (thesis 4.13-4.14), `Flat` maximum likelihood; `trajectory` "joint" or "marginal", as
    in `EA`. Raises `InputError` for another trajectory.
    """

    iterations: int = 500
    tolerance: float = 1e-6
    trajectory: str = "joint"

    name: ClassVar[str] = "MAP"
    priors: ClassVar[tuple[type, ...]] = (Gaussian, Flat, Laplace)
    intervals: ClassVar[str] = "Laplace: exact for a Gaussian or flat prior where the problem is linear and Gaussian"

    def __post_init__(self):
        if self.trajectory not in MODES:
            raise InputError(f'{self.name}(trajectory="{self.trajectory}"): give one of {", ".join(MODES)}')

    def iterate(self, model: Model, prior: Prior, given: Given, state: State) -> State:
        """Mode and its covariance."""
        return _iterate(model, prior, given, state, "mackay", self.trajectory)


@dataclass(frozen=True)
class LeastSquares(MAP):
    """Weighted non-linear least squares of biases and target states, without prior or motion (thesis 4.1-4.8).

    Known targets (`Known`) stay known; the state of an unknown target is free at every epoch. Weights are those
    of the declared noise. Take it where targets are known; `MAP` with `Flat` adds the motion.
    """

    name: ClassVar[str] = "least squares"
    priors: ClassVar[tuple[type, ...]] = (Flat,)

    def prepare(self, problem: Problem) -> Problem:
        """The problem without motion."""
        return problem.unlinked()
