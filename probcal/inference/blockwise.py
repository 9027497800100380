"""Fits whose dense form does not fit: the marginal mode by sparse factors, precisions integrated by
propagation.

`EA()` and `MAP()` come here by themselves (`engine="auto"`): where the matrices of the dense form
take more than 240 MB, and where there are more than 500 biases of which an epoch sees few, which is
faster. Where memory does not hold the factor either, `MAP` goes on by products alone
(`engine="iterative"`). What needs the whole covariance of the biases is not there; variances and
gamma of each are.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar, cast

import jax
import jax.numpy as jnp
import numpy as np

from probcal.errors import FitError, InputError
from probcal.gaussian.choose import choose_fast, engine_of, estimates
from probcal.gaussian.climb import climb_to_mode, climb_with_noise
from probcal.gaussian.engine import Engine, Estimate, Expansion, Factors, Group, Spread, evidence, mean
from probcal.gaussian.information import mean_square
from probcal.gaussian.joint import blocks_of
from probcal.gaussian.mode import Point
from probcal.identifiability.directions import alone_directions, screened_directions, shared_directions
from probcal.identifiability.remedies import Direction
from probcal.inference.ending import conclude_at, fallen
from probcal.inference.hierarchy import held, hierarchy_of
from probcal.inference.integrate import quantile
from probcal.inference.method import Context, Iterated
from probcal.inference.placed import Reached, with_places
from probcal.inference.posed import Form
from probcal.inference.propagate import BlockMarginals, Blocks, Propagation
from probcal.modes.mirrors import SideClimb
from probcal.priors import PRECISION_BOUNDS, Flat, Gaussian, Precision, Prior
from probcal.problem import Problem
from probcal.results.answer import HALF, Answer, Draws, Posterior, Summary, Tracks
from probcal.results.blocks import SensorBlocks
from probcal.results.schema import INTERVAL, ROPE

CHAINS, NUMBERS, MOST = 4, 400_000, 250  # of the draws of all biases that a tree holds, and draws of a chain
STEPS = 60  # of the climb
HELD = 30.0  # nats that a node may fit worse on its other side, tracks held, and is still tried: each is a climb
NAMED = 20  # combinations of single sensors that are named


def takes_sparse(method: Iterated, problem: Problem) -> bool:
    """Whether a method is to solve a problem in its sparse form; raises `InputError` where that was
    asked in vain."""
    asked = getattr(method, "engine", "dense")
    engine = engine_of(asked, problem.model)
    return engine is asked or not engine.cheap


def gains_by_sparse(method: Iterated, problem: Problem, prior: Prior, starts: int) -> bool:
    """Whether a fit that may take either form is faster in the sparse one, and loses nothing that
    was asked."""
    free = getattr(method, "engine", "dense") == "auto"
    return free and not choose_fast(problem.model).cheap and not _lacking(method, prior, starts)


def check_sparse(method: Iterated, prior: Prior, starts: int) -> None:
    """Raise `InputError` naming what a sparse fit does not do."""
    if wrong := _lacking(method, prior, starts):
        if estimates(getattr(method, "engine", "auto")):
            raise InputError(f'{method.name}(engine="iterative") takes {wrong}')
        raise InputError(f"{method.name} on a network of this size is solved in sparse form, which takes {wrong}")


def _lacking(method: Iterated, prior: Prior, starts: int) -> str:
    """What a sparse fit takes in the place of what was asked; empty where it does that."""
    wrong = ""
    if getattr(method, "trajectory", "") != "marginal":
        wrong = 'trajectory="marginal" alone'
    elif estimates(getattr(method, "engine", "auto")) and not isinstance(prior, (Gaussian, Flat)):
        wrong = "precisions that are given (MAP() with Gaussian() or Flat())"
    elif not (method.integrates(prior) if hasattr(method, "integrates") else isinstance(prior, (Gaussian, Flat))):
        wrong = (
            "precisions that are integrated or given (EA() with Horseshoe() or ARD(rate=0.5), MAP() with Gaussian())"
        )
    elif starts > 1:
        wrong = "one start"
    return wrong


@dataclass(frozen=True, eq=False)
class ExpansionLikelihood:
    """The likelihood at a point as a propagation reads it, by what any engine gives."""

    expand: Callable[[Point], Expansion]
    here: Expansion
    prior: Factors  # of the biases that no hierarchy governs

    @property
    def z(self) -> np.ndarray:
        """Biases (M,) of the point."""
        return np.asarray(self.here.point.z)

    def marginals(self, members: np.ndarray, sites: Blocks) -> BlockMarginals:
        """Marginals of the blocks, and the factors of the prior and the sites."""
        factors = self.prior + Factors((Group(members, sites.precision, sites.pull),))
        covariance = np.asarray(self.here.marginals(factors, members))
        return BlockMarginals(np.asarray(mean(self.here, factors)), covariance, factors)

    def at(self, z: np.ndarray) -> ExpansionLikelihood:
        """The likelihood at other biases (M,), every track following."""
        return replace(self, here=self.expand(self.here.moved(z - self.z)))


@dataclass(frozen=True, eq=False)
class BlockPosterior(Posterior):
    """Marginals of the biases of each sensor and of the states: no covariance of all biases is
    held."""

    at: Expansion
    factors: Factors  # of the prior, or the sites in its place
    spread: Spread  # under these
    declared: SensorBlocks  # what a prior of the declared scales leaves
    open: tuple[Direction, ...]  # combinations that the data leave to the prior, those of many sensors first
    weak: int  # how many there are; some have no name
    evidence_error: float | None = None  # standard error of the log evidence, where that is estimated

    chained: ClassVar[bool] = False
    held: ClassVar[bool] = True

    @property
    def sound(self) -> bool:
        """Whether every number is finite."""
        return bool(np.isfinite(self.summary.sd).all() and np.isfinite(self.summary.mean).all())

    @property
    def states(self) -> Sequence[np.ndarray]:
        """States (E, n) of each recursion at the point."""
        return [np.asarray(x) for x in self.point.states]

    def tracks(self) -> Sequence[Tracks]:
        """States at the point, and their sd with the biases uncertain."""
        pairs = self.problem.model.each_layout(self.states, self.spread.states)
        return [Tracks(x, np.sqrt(np.maximum(own, 0.0))) for _, x, own in pairs]

    @property
    def expansion(self) -> Expansion:
        """The posterior expanded about the point."""
        return self.at

    def draws(self, key: jax.Array, keep: tuple[str, ...]) -> Draws:
        """Draws of the biases from the Gaussian with their means, sds and correlations, few where
        they are many."""
        self.check_kept(keep)
        M = len(self.summary.mean)
        count = CHAINS * int(np.clip(NUMBERS // (CHAINS * M), 2, MOST))
        normal = np.asarray(self.at.deviations(self.factors, key, count).z) / np.sqrt(self.spread.biases)
        z = (self.summary.mean + self.summary.sd * normal).reshape(CHAINS, -1, M)
        levels = np.broadcast_to(self.summary.levels, (*z.shape[:2], len(self.summary.levels)))
        return Draws(z, levels, [], np.arange(z.shape[1]), [], [])

    def check_kept(self, keep: tuple[str, ...]) -> None:
        """Raise `InputError` for draws of what would take too much room."""
        if {"states", "replicas"} & set(keep):
            raise InputError(
                "fit(save=...): a fit in sparse form keeps no draws of states or replicas; leave save out, or give"
                ' engine="dense"'
            )

    def log_prior(self, draws: Draws) -> np.ndarray | None:
        """None: it takes as much room as the draws."""
        return None

    @property
    def attrs(self) -> Mapping[str, float]:
        """The limit of inclusion, how many directions are weak, and the error of an evidence that
        is estimated."""
        estimated = {} if self.evidence_error is None else {"log_evidence_error": self.evidence_error}
        return {"rope": ROPE, "sparse": 1.0, "weak": float(self.weak)} | estimated


def blockwise_answer(method: Iterated, problem: Problem, prior: Prior, start: Point, context: Context) -> Answer:
    """The answer of `EA` or `MAP` by blocks of sensors; raises `FitError` where a flat prior leaves
    no interval."""
    model, asked = problem.model, getattr(method, "engine", "auto")
    engine = engine_of(asked, model)
    integrated = hasattr(method, "integrates") and method.integrates(prior)
    first = prior.precision(problem.labels, problem.surveyed)
    declared = first
    if integrated:
        declared = Gaussian(correlation=prior.correlation).precision(problem.labels, problem.surveyed)
    factors = Factors.of(declared)

    def told(k: int, value: float) -> bool:
        context.monitor.tell(method.name, min(k, method.iterations), method.iterations, value, bound=True)
        return bool(context.monitor.stopped)

    def climb(problem: Problem, start: Point) -> Reached:
        turns, tolerance = method.iterations, method.tolerance
        steps, model = min(STEPS, turns), problem.model
        mode = climb_with_noise(engine, model, start, declared, factors, steps, turns, tolerance, told)
        value = float(mode.trace[-1])  # without unknown noise the density
        return Reached(problem.with_mixing(mode.at.model.mixing), mode.at, factors, value, mode)

    try:
        end, agree = climb(problem, start), True
        if model.rests and getattr(method, "integrates_places", False):
            end, agree = with_places(climb, end, engine, lambda: context.monitor.stopped)
        problem, at, mode = end.problem, end.at, end.state
        worth = evidence(at, declared, factors)
        form = Form(model.biases, hierarchy_of(prior, problem)) if integrated else None
        if form is not None and form.hierarchy.learnt:  # else every bias has a survey
            together = shared_directions(problem, at, factors)  # while its factor is at hand
            posterior, settled = _integrated(problem, prior, form, first, engine, at, worth, context.key, told)
            alone, count = alone_directions(problem, posterior.point, posterior.declared, NAMED)
            posterior = replace(posterior, open=(*together, *alone), weak=len(together) + count)
        else:
            posterior, settled = _gaussian(problem, prior, at, worth, first), True
    except MemoryError:
        size = f"{model.state_size} state entries and {model.biases} biases"
        if not engine.exact:
            raise FitError(
                f"memory does not hold {size}, not even without a factor: take fewer sensors or a shorter time"
            ) from None
        if asked == "auto" and isinstance(prior, (Gaussian, Flat)):
            return blockwise_answer(replace(cast("Any", method), engine="iterative"), problem, prior, start, context)
        raise FitError(
            f"the sparse factor of {size} does not fit in memory:"
            ' MAP(engine="iterative") makes none; or take fewer sensors or a shorter time'
        ) from None
    except np.linalg.LinAlgError:
        raise diverged(problem, engine.at(model, start), factors) from None
    square = float(mean_square(problem.model, posterior.point))
    return conclude_at(
        problem, method, prior, posterior, mode.trace, square, len(mode.trace),
        converged=mode.converged and settled and agree, refused=mode.refused, evidence=worth.value,
        lost=fallen(prior, len(problem.levels), mode.trace.max(), mode.trace[-1]) if model.learns_noise else 0.0,
        stopped=context.monitor.stopped,
    )  # fmt: skip


def diverged(problem: Problem, at: Expansion, factors: Factors) -> FitError:
    """What to say where the precision at a point with the factors of a prior is not positive
    definite."""
    told = np.append(np.zeros(problem.model.biases), 0.0)
    for *_, read, lin in problem.model.each_block(problem.model.read, at.rows):
        own = np.einsum("ncp,nc->np", np.asarray(lin.bias) ** 2, np.asarray(lin.weight))
        np.add.at(told, read, own)
    nothing = np.flatnonzero(told[:-1] + np.asarray(factors.diagonal(problem.model.biases)) == 0)
    silent = ", ".join([problem.labels[m] for m in nothing][:NAMED])
    why = f"no row tells {silent}" if silent else "the information matrix is singular"
    return FitError(f"The fit diverged: {why}; the estimate is invalid. Use a prior, or fix some biases.")


def side_climb(problem: Problem, asked: Any) -> SideClimb:
    """To the marginal mode, with its log evidence, or without a factor its log marginal density.

    An estimated log determinant of the biases would blur what tells the sides apart; reflected it
    is nearly the same.
    """
    engine, scales = engine_of(asked, problem.model), Precision(jnp.ones(problem.model.biases))
    factors = Factors.of(scales)

    def mode(point: Point) -> tuple[Point, float]:
        try:
            found = climb_to_mode(lambda at: engine.settled(problem.model, at), point, factors, STEPS, 1e-3)
            worth = evidence(found.at, scales, factors).value if engine.exact else -found.value
            return found.at.point, worth
        except (np.linalg.LinAlgError, FitError):  # not positive definite, or conjugate gradients did not end
            return point, -np.inf

    return SideClimb(mode, lambda _, evidence: evidence, HELD)


def blocks_at(at: Expansion, factors: Factors, spread: Spread) -> SensorBlocks:
    """Covariances of the biases of each sensor; their variances alone where these are estimated."""
    M = at.model.biases
    if spread.error.any():
        return SensorBlocks(M, np.arange(M)[:, None], spread.biases[:, None, None])
    members = blocks_of(at.model)
    return SensorBlocks(M, members, np.asarray(at.marginals(factors, members)))


def declared_blocks(at: Expansion) -> SensorBlocks:
    """Covariances of the biases of each sensor under a prior of the declared scales, at a point."""
    scales = Factors.alone(np.ones(at.model.biases))
    return blocks_at(at, scales, at.spread(scales))


def _gaussian(problem: Problem, prior: Prior, at: Expansion, worth: Estimate, first: Precision) -> BlockPosterior:
    """The Gaussian at a mode under precisions `first`; `worth` is its log evidence."""
    factors, z, alpha = Factors.of(first), np.asarray(at.point.z), np.asarray(first.alpha)
    spread = at.spread(factors)
    blocks = blocks_at(at, factors, spread)
    half, gamma = HALF * np.sqrt(spread.biases), np.clip(1.0 - alpha * spread.biases, 0.0, 1.0)
    declared = blocks if prior.proper else blocks.under_scales()
    errors = {"sd_error": 0.5 * spread.error / spread.biases} if spread.error.any() else {}
    summary = Summary(
        "Laplace", "given", z, None, z - half, z + half, gamma, alpha, None, np.asarray(at.point.levels),
        worth.value if prior.proper else None, told_columns(declared) | errors, blocks=blocks,
    )  # fmt: skip
    named = alone_directions(problem, at.point, declared, NAMED)  # a flat prior leaves no room for more
    found = screened_directions(problem, at, declared, NAMED) if prior.proper else named
    estimated = worth.error if prior.proper and worth.error else None
    return BlockPosterior(problem, prior, at.point, summary, at, factors, spread, declared, *found, estimated)


def told_columns(declared: SensorBlocks) -> dict[str, np.ndarray]:
    """A column with the share that data narrow each bias, of its declared scale."""
    return {"contraction": np.clip(1.0 - declared.variance, 0.0, 1.0)}


def _integrated(
    problem: Problem, prior: Prior, form: Form, first: Precision, engine: Engine, at: Expansion, worth: Estimate,
    key: jax.Array, told: Any,
) -> tuple[BlockPosterior, bool]:  # fmt: skip
    """The marginals that a hierarchy makes of the likelihood at a mode, this taken anew at their
    mean; nothing said to be open."""
    first = form.rest(first)
    likelihood = ExpansionLikelihood(partial(engine.settled, at.model), at, Factors.of(first))
    work = Propagation.of(form, first, likelihood, blocks_of(problem.model), key)
    work.run(told)
    swept, last, begun, ended = work.swept, work.found, work.begun, work.likelihood
    assert swept is not None
    assert last is not None
    assert begun is not None
    assert isinstance(ended, ExpansionLikelihood)
    middle, own, here = work.mean, work.variance, ended.here
    declared = SensorBlocks(len(middle), work.members, begun.covariance)
    tail, alone = 0.5 * (1.0 - INTERVAL), np.asarray(work.first.alpha)
    lower, upper = (np.asarray(quantile(swept.means, swept.sds, share)) for share in (tail, 1.0 - tail))
    alpha = np.clip((1 - swept.gamma) / np.maximum(own, 1e-300), *PRECISION_BOUNDS)
    alpha = np.where(held(prior, problem), alone, alpha)
    summary = Summary(
        "mixture", "integrated", middle, None, lower, upper, swept.gamma, alpha, None, np.asarray(at.point.levels),
        worth.value, told_columns(declared), SensorBlocks(len(middle), work.members, swept.covariance),
    )  # fmt: skip
    point = here.moved(middle - np.asarray(here.point.z))
    spread = here.spread(last.whole)
    return BlockPosterior(problem, prior, point, summary, here, last.whole, spread, declared, (), 0), work.settled
