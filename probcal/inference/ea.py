"""Modes and evidence: EA, MAP and weighted least squares, with every trajectory marginalised."""

from __future__ import annotations

from dataclasses import InitVar, dataclass
from functools import partial
from typing import Any, ClassVar, TypeGuard

import jax
import jax.numpy as jnp
import numpy as np

from probcal.errors import InputError
from probcal.gaussian.choose import engine_named, estimates
from probcal.gaussian.climb import find_marginal_mode
from probcal.gaussian.engine import Engine
from probcal.gaussian.linearised import laplace_of
from probcal.gaussian.mode import Eliminated, Mode, Point, cost, eliminate, find_mode, mixing_gain
from probcal.inference.ending import astray
from probcal.inference.hierarchy import held, hierarchy_of
from probcal.inference.integrate import Integration, likelihood
from probcal.inference.loop import Trace
from probcal.inference.method import Context, Given, State
from probcal.inference.posed import Form
from probcal.inference.pruned import without_far_modes
from probcal.inference.relevance import best_precisions
from probcal.inference.run import KernelClimb, Maximiser, learn, renew_noise, single_course, valued
from probcal.linalg import library
from probcal.model.model import Mixing, Model
from probcal.priors import ARD, Flat, Gaussian, Horseshoe, Laplace, Precision, Prior
from probcal.problem import Problem

RULES = ("mackay", "em")
MODES = ("joint", "marginal")
STEPS = 30  # between two updates of precisions or levels
UNHELD = 15  # of a mode without a prior, after which one that went astray ends
FEW = 2  # of the marginal mode, each of which costs several joint ones, where precisions are learnt
MANY = 500  # biases beyond which precisions are integrated by expectation propagation in the place of sweeps
BETTER, GAIN = 5, 0.1  # most times that a climb begins again from better precisions, and nats that make them so
PRECISIONS = ("integrated", "maximised")


@partial(jax.jit, static_argnames=("prior", "rule"))
def _with_precisions(prior: Prior, given: Given, state: State, fresh: jax.Array, rule: str) -> State:
    """The state with precisions that follow from the last iteration, if it is not a fresh one."""
    found = state.found
    alpha = learn(prior, given, state.alpha, found.gamma, jnp.diagonal(found.covariance), state.point.z, rule)
    return state._replace(alpha=jnp.where(fresh, state.alpha, alpha))


def learnt(model: Model, prior: Prior, given: Given, state: State, rule: str) -> tuple[Model, State]:
    """Model and state with precisions and levels that follow from what the last iteration found, if there was one."""
    fresh = library(state.objective).isneginf(state.objective)
    state = _with_precisions(prior, given, state, fresh, rule) if prior.learns else state
    return renew_noise(model, state, state.found.covariance, fresh)


def _climb(
    model: Model, start: Point, prior: Precision, steps: int, tolerance: jax.Array, trajectory: str,
    known: Eliminated | None = None,
) -> tuple[Mode, Eliminated]:  # fmt: skip
    """The mode of the joint or of the marginal density, and the system eliminated there.

    Where that of the start is `known` a joint climb is a single step: each costs one elimination.
    """
    if trajectory == "marginal":
        return find_marginal_mode(model, start, prior, steps, tolerance)
    mode = find_mode(model, start, prior, steps, tolerance, once=known is not None, known=known)
    return mode, eliminate(model, mode.point, expected=True)


def _iterate(model: Model, prior: Prior, given: Given, state: State, rule: str, trajectory: str) -> State:
    """New precisions and levels, then the mode and the evidence at that mode: all of one state belongs together."""
    model, state = learnt(model, prior, given, state, rule)
    now = given.prior._replace(alpha=state.alpha)
    few = (prior.learns or model.tailed) and trajectory == "marginal"
    steps = FEW if few else STEPS if prior.proper else UNHELD
    known = state.carry or None
    mode, solved = _climb(model, state.point, now, steps, 1e-2 * given.tolerance, trajectory, known)
    ended = (trajectory == "marginal") & (mode.iterations < steps)
    state = _settled(model, prior, given, state, mode, solved, ended)
    return state._replace(carry=() if known is None else solved)


@partial(jax.jit, static_argnames="prior")
def _settled(
    model: Model, prior: Prior, given: Given, state: State, mode: Mode, solved: Eliminated, ended: Any
) -> State:
    """The state at a mode, with what was found there by a marginal search that `ended`, or by another."""
    now = given.prior._replace(alpha=state.alpha)
    state = state._replace(found=laplace_of(model, mode.point, solved, now))
    objective = (
        state.found.evidence
        if prior.proper or not prior.learns
        else _density(model, prior, given, mode.point) - mode.volume
    )
    still = jnp.abs(objective - state.objective) < given.tolerance
    # on a cusp, where a target grazes a sensor, and where rounding hides what is left, no step lowers the cost
    nothing = still & (mode.gained < given.tolerance)
    learns = prior.learns or model.learns_noise
    # nor on a kink of the marginal density, where tracks leave a plane of all sensors
    kink = ended & (mode.gained < GAIN / 5) & (jnp.abs(objective - state.objective) < GAIN / 5)
    done = nothing | (mode.converged & still if learns else mode.converged | kink)
    done = done | jnp.any(astray(prior, mode.point.z, given.surveyed))  # it diverged: no further step helps
    refused = state.refused & mode.refused
    state = state._replace(point=mode.point, objective=objective, refused=refused, done=done)
    return valued(prior, given, state)


def _density(model: Model, prior: Prior, given: Given, point: Point) -> jax.Array:
    """Log joint density with the prior's own penalty."""
    held = given.prior._replace(alpha=jnp.where(given.surveyed, given.prior.alpha, 0.0))
    penalty = jnp.where(given.surveyed, 0.0, prior.penalty(point.z, 0.0))
    return mixing_gain(model) - cost(model, point, held) - jnp.sum(penalty)


@dataclass(frozen=True)
class EA(Maximiser):
    """Evidence approximation with trajectories marginalised: the default.

    `precisions` "integrated" (the default) climbs to the mode of the marginal density under the declared scales, takes
    the Gaussian likelihood of the biases there, and integrates the precisions of a proper hierarchical prior
    (`Horseshoe` by default): by Gibbs sweeps, above 500 biases by expectation propagation. The answer is a mixture.
    "maximised" climbs to the precisions of largest evidence (type-II maximum likelihood, Paper B 24-25) and takes them
    as known; where nothing gains any more, single precisions are set to their exact maximum and groups of biases (one
    component, one node) taken out or in together (Tipping, Faul 2003). An ARD prior with a flat hyper-prior has no
    posterior and is always maximised. Noise levels that are unknown maximise the evidence and are held.

    `trajectory` says what the reported point is: "marginal" the mode of the biases with the trajectory integrated
    (Laplace, see `gaussian.marginal`; the places of targets at rest by quadrature where Laplace is wrong, on a ring or
    on either side of a line, see `gaussian.places`), "joint" that of biases and trajectory together, which shrinks a
    scene whose size only the motion tells. `EA.as_printed()` is the joint mode with precisions maximised; Paper B as
    printed is in `benchmarks/papers/paper_b.py`. `update` of maximised precisions is "mackay" (Paper B 25) or "em"
    (Paper C 40; the same fixed points, slower). `tolerance` is the change of log evidence, in nats, at which it stops;
    `iterations` caps the outer loop. `engine` "auto" is "dense" where its matrices need up to 240 MB, unless an epoch
    sees less than a quarter of more than 500 biases; else "cholmod" where the extra `sparse` is installed, "superlu"
    without it: the same numbers by another library. An object with the members of `gaussian.engine.Engine` is one of
    your own; "iterative" is for `MAP`.
    Raises `InputError` for another update, trajectory, engine or kind of precisions.

    >>> type(EA().first_prior()), type(EA.as_printed().first_prior())
    (<class 'probcal.priors.Horseshoe'>, <class 'probcal.priors.ARD'>)
    """

    iterations: int = 200
    tolerance: float = 1e-3
    update: str = "mackay"
    trajectory: str = "marginal"
    precisions: str = "integrated"
    engine: str | Engine = "auto"
    form: InitVar[str] = ""  # the word of versions before for `engine`

    name = "EA"
    intervals = (
        "a mixture over the precisions around the Gaussian likelihood at one point; unknown noise levels are held"
    )
    plugged: ClassVar[str] = (
        "plug-in: the precisions (and unknown levels) are taken as known, so the intervals are too narrow"
    )

    def __post_init__(self, form: str) -> None:
        known = {"update": RULES, "trajectory": MODES, "precisions": PRECISIONS}
        object.__setattr__(self, "engine", engine_named(self.name, self.engine, form))
        for field, words in known.items():
            if getattr(self, field) not in words:
                raise InputError(f'EA({field}="{getattr(self, field)}"): give one of {", ".join(words)}')

    @classmethod
    def as_printed(cls, **settings: Any) -> EA:
        """The joint mode with precisions maximised, the baseline of comparisons."""
        return cls(**{"trajectory": "joint", "precisions": "maximised"} | settings)

    def first_prior(self) -> Prior:
        """`Horseshoe()` where precisions are integrated, else `ARD()`."""
        return Horseshoe() if self.precisions == "integrated" else ARD()

    def takes(self, prior: Prior) -> bool:
        """Any hierarchical prior where precisions are integrated, else ARD."""
        return prior.hierarchical if self.precisions == "integrated" else isinstance(prior, ARD)

    def further(self, task: KernelClimb, state: State, course: Trace) -> tuple[State, Trace]:
        """The end of climbs again where precisions are maximised, without biases that another mode keeps in."""
        problem, prior, context = task.problem, task.prior, task.context
        if task.alpha is not None or not self._tries_again(prior):
            return state, course
        if (prior.shape, prior.rate, prior.by) == (1.0, 0.0, None):
            state, course = self._climbed_again(problem, prior, state, course, context)
        if prior.correlation:
            return state, course

        def climb(point: Point, alpha: np.ndarray, mixing: Mixing) -> State:
            return self.climb(problem.with_mixing(mixing), prior, point, context, alpha)[0]

        kept = without_far_modes(problem.model, prior, task.given, state, climb)
        return kept, course if kept is state else course.and_then(single_course(kept))

    def _tries_again(self, prior: Prior) -> TypeGuard[ARD]:
        """True if maximised precisions are tried anew after a climb."""
        return self.trajectory == "marginal" and isinstance(prior, ARD) and not self.integrates(prior)

    def climbs_once(self, problem: Problem, prior: Prior) -> bool:
        """Not where maximised precisions are tried anew after a climb."""
        return super().climbs_once(problem, prior) and not self._tries_again(prior)

    def _climbed_again(
        self, problem: Problem, prior: Prior, state: State, trace: Trace, context: Context
    ) -> tuple[State, Trace]:
        """The state after climbs from better precisions, while there are any."""
        for _ in range(BETTER):
            alpha, gain = self._better(problem, prior, state)
            if gain <= GAIN or not np.isfinite(float(state.objective)):
                break
            tried, more = self.climb(problem.with_mixing(state.mixing), prior, state.point, context, alpha)
            if not float(tried.objective) > float(state.objective) + self.tolerance:
                break
            state, trace = tried, trace.and_then(more)
        return state, trace

    def _better(self, problem: Problem, prior: Prior, state: State) -> tuple[np.ndarray, float]:
        """Precisions of largest evidence on the Gaussian likelihood at a state, and the nats that they gain."""
        how = Integration(Form(problem.model.biases, hierarchy_of(Gaussian(), problem)), True)
        model = problem.model.with_mixing(state.mixing)
        known, sound = likelihood(how, model, problem.first_precision(prior), state.point)
        if not bool(sound):
            return np.asarray(state.alpha), 0.0
        learnt, members = np.flatnonzero(~held(prior, problem)).tolist(), problem.members
        names = dict.fromkeys((kind, members[m][kind]) for kind in ("component", "owner") for m in learnt)
        sets = [[m for m in learnt if members[m][kind] == name] for kind, name in names]
        information = np.asarray(known.information + known.first.coupled())
        return best_precisions(information, np.asarray(known.pull), np.asarray(state.alpha), learnt, sets)

    def integrates(self, prior: Prior) -> bool:
        """True if the precisions of a prior are integrated: a flat hyper-prior leaves no posterior."""
        return self.precisions == "integrated" and not (isinstance(prior, ARD) and prior.rate == 0.0)

    def climbs_under(self, prior: Prior) -> Prior:
        """The declared scales where precisions are integrated after the climb."""
        return Gaussian(correlation=prior.correlation) if self.integrates(prior) else prior

    def integration(self, problem: Problem, prior: Prior) -> Integration | None:
        """The hierarchy of the prior, at the mode that the climb reached.

        None where it governs no bias.
        """
        if not self.integrates(prior):
            return None
        form = Form(problem.model.biases, hierarchy_of(prior, problem))
        if not form.hierarchy.learnt:
            return None
        return Integration(form, self.trajectory == "marginal", len(form.hierarchy.learnt) <= MANY)

    def note(self, prior: Prior) -> str:
        """A note on the validity of the intervals with these settings and a prior."""
        return self.intervals if self.integrates(prior) else self.plugged

    def remark(self, prior: Prior) -> str:
        """That precisions were maximised though it was not asked for."""
        if self.precisions == "maximised" or self.integrates(prior):
            return ""
        return (
            "The precisions were maximised, since ARD with a flat hyper-prior has no posterior: the intervals are too"
            " narrow; Horseshoe() or ARD(rate=0.5) is integrated."
        )

    def begin(self, model: Model, start: Point) -> Any:
        """The system at the start, where climbs to the joint mode solve what they report: precisions then change with
        every step.

        With noise that is not Gaussian steps have other weights, and unknown levels change the system in between.
        """
        same = model.weighs_as_expected and not model.learns_noise
        return eliminate(model, start, expected=True) if self.trajectory == "joint" and same else ()

    def iterate(self, model: Model, prior: Prior, given: Given, state: State) -> State:
        """Mode, evidence, new precisions."""
        return _iterate(model, prior, given, state, self.update, self.trajectory)


@dataclass(frozen=True)
class MAP(Maximiser):
    """Mode under a given prior with its Laplace covariance: of the marginal, or of trajectories and biases jointly.

    `Gaussian` is l2, `Laplace` l1 (thesis 4.13-4.14), `Flat` maximum likelihood; `trajectory` "marginal" or "joint", as
    in `EA`, places on rings included. `engine` as in `EA`; "iterative" makes no factor of the biases: steps by
    conjugate gradients, sds (with their relative errors, `sd_error`) and the evidence by draws (see
    `gaussian.iterative`). It is for what has no room for a sparse factor; "auto" goes on with it where making one is
    refused for want of memory. Under `Flat` a climb of which a bias still lies more than ten scales from its stated
    value after fifteen steps, or thirty, has diverged and ends there. Raises `InputError` for another trajectory or
    engine.
    """

    iterations: int = 500
    tolerance: float = 1e-6
    trajectory: str = "marginal"
    engine: str | Engine = "auto"
    form: InitVar[str] = ""  # the word of versions before for `engine`

    name = "MAP"
    priors: ClassVar[tuple[type, ...]] = (Gaussian, Flat, Laplace)
    intervals = "Laplace: exact for a Gaussian or flat prior where the problem is linear and Gaussian"

    def __post_init__(self, form: str) -> None:
        if self.trajectory not in MODES:
            raise InputError(f'{self.name}(trajectory="{self.trajectory}"): give one of {", ".join(MODES)}')
        object.__setattr__(self, "engine", engine_named(self.name, self.engine, form))

    def remark(self, prior: Prior) -> str:
        """That sds are estimated where no factor of the biases was made."""
        if not estimates(self.engine):
            return ""
        return "No factor of the biases was made: sds and evidence are estimated, each with its standard error."

    def iterate(self, model: Model, prior: Prior, given: Given, state: State) -> State:
        """Mode and its covariance."""
        return _iterate(model, prior, given, state, "mackay", self.trajectory)


@dataclass(frozen=True)
class LeastSquares(MAP):
    """Weighted non-linear least squares of biases and target states, without prior or motion (thesis 4.1-4.8).

    Known targets (`Known`) stay known; the state of an unknown target is free at every epoch. Weights are those
    of the declared noise. Take it where targets are known; `MAP` with `Flat` adds the motion.
    """

    trajectory: str = "joint"

    name = "least squares"
    priors = (Flat,)

    def __post_init__(self, form: str) -> None:
        if self.trajectory != "joint":
            raise InputError(
                f'{self.name}(trajectory="{self.trajectory}"): without motion there is the joint mode only'
            )
        super().__post_init__(form)

    def prepare(self, problem: Problem) -> Problem:
        """The problem without motion."""
        return problem.unlinked()
