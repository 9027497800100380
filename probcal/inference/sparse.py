"""Fits whose dense form does not fit: the marginal mode by sparse factors, precisions integrated by propagation.

`EA()` and `MAP()` come here by themselves (`form="auto"`): where the matrices of the dense form take more than 240 MB,
and where there are more than 500 biases of which an epoch sees few, which is faster. Where memory does not hold the
factor either, `MAP` goes on by products alone (`form="matrix-free"`).
What needs the whole covariance of the biases is not there; variances and gamma of each are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, cast

import jax
import jax.numpy as jnp
import numpy as np

from probcal.errors import FitError, InputError
from probcal.gaussian.cholesky import Factor, exact
from probcal.gaussian.information import mean_square
from probcal.gaussian.joint import JointPrecision, blocks_of, is_thin, missing, prefers_sparse
from probcal.gaussian.linearised import linearise_rows
from probcal.gaussian.mode import Point
from probcal.gaussian.sparse_mode import SparseMode, SparseSystem, find_sparse_mode, system_at
from probcal.identifiability.directions import open_alone, open_together
from probcal.identifiability.remedies import Direction
from probcal.inference.ending import conclude_at
from probcal.inference.hierarchy import held, hierarchy_of
from probcal.inference.integrate import quantile
from probcal.inference.posed import Form
from probcal.inference.propagate import BlockMarginals, Blocks, Propagation
from probcal.model.model import Model
from probcal.modes.mirrors import SideClimb
from probcal.priors import PRECISION_BOUNDS, Flat, Gaussian, Precision, Prior
from probcal.problem import Problem
from probcal.results.answer import HALF, Answer, Draws, Posterior, Summary, Tracks
from probcal.results.blocks import SensorBlocks
from probcal.results.schema import INTERVAL, ROPE

if TYPE_CHECKING:
    from probcal.inference.run import Context, Maximiser

CHAINS, NUMBERS, MOST = 4, 400_000, 250  # of the draws of all biases that a tree holds, and draws of a chain
STEPS = 60  # of the climb
HELD = 30.0  # nats that a node may fit worse on its other side, tracks held, and is still tried: each is a climb
NAMED = 20  # combinations of single sensors that are named
PRODUCTS = "matrix-free"
SPARSE = ("sparse", PRODUCTS)
FORMS = ("auto", "dense", *SPARSE)


def takes_sparse(method: Maximiser, problem: Problem) -> bool:
    """Whether a method is to solve a problem in its sparse form; raises `InputError` where that was asked in vain."""
    form = getattr(method, "form", "dense")
    lacks = missing(problem.model)
    if form in SPARSE and lacks:
        raise InputError(f'{method.name}(form="{form}") does not take {lacks}: give form="dense"')
    return bool(form in SPARSE or (form == "auto" and not lacks and prefers_sparse(problem.model)))


def gains_by_sparse(method: Maximiser, problem: Problem, prior: Prior, starts: int) -> bool:
    """Whether a fit that may take either form is faster in the sparse one, and loses nothing that was asked."""
    either = getattr(method, "form", "dense") == "auto" and not missing(problem.model)
    return either and is_thin(problem.model) and not _lacking(method, prior, starts)


def check_sparse(method: Maximiser, prior: Prior, starts: int) -> None:
    """Raise `InputError` naming what a sparse fit does not do."""
    if wrong := _lacking(method, prior, starts):
        if getattr(method, "form", "") == PRODUCTS:
            raise InputError(f'{method.name}(form="{PRODUCTS}") takes {wrong}')
        raise InputError(f"{method.name} on a network of this size is solved in sparse form, which takes {wrong}")


def _lacking(method: Maximiser, prior: Prior, starts: int) -> str:
    """What a sparse fit takes in the place of what was asked; empty where it does that."""
    wrong = ""
    if getattr(method, "trajectory", "") != "marginal":
        wrong = 'trajectory="marginal" alone'
    elif prior.correlation:
        wrong = "a prior without correlations"
    elif getattr(method, "form", "") == PRODUCTS and not isinstance(prior, (Gaussian, Flat)):
        wrong = "precisions that are given (MAP() with Gaussian() or Flat())"
    elif not (method.integrates(prior) if hasattr(method, "integrates") else isinstance(prior, (Gaussian, Flat))):
        wrong = (
            "precisions that are integrated or given (EA() with Horseshoe() or ARD(rate=0.5), MAP() with Gaussian())"
        )
    elif starts > 1:
        wrong = "one start"
    elif not (exact() or isinstance(prior, (Gaussian, Flat))):
        wrong = "exact variances, of sparsax, to integrate precisions: install probcal[sparse], or take MAP()"
    return wrong


@dataclass(frozen=True, eq=False)
class SparseLikelihood:
    """The likelihood of a sparse system as a propagation reads it."""

    model: Model
    system: SparseSystem
    pairs: np.ndarray  # (B, p, p) where the entries of the pairs of the blocks are, -1 of none

    @property
    def z(self) -> np.ndarray:
        """Biases (M,) of the point."""
        return np.asarray(self.system.point.z)

    def entries(self, sites: Blocks) -> np.ndarray:
        """Entries of the joint precision with sites."""
        whole, p = self.system.entries.copy(), self.pairs.shape[1]
        upper = np.triu(np.ones((p, p), bool))[None] & (self.pairs >= 0)
        np.add.at(whole, self.pairs[upper], sites.precision[upper])
        return whole

    def marginals(self, members: np.ndarray, sites: Blocks) -> BlockMarginals:
        """Marginals of the blocks by the selected inverse, and the variances (n,) of all variables."""
        joint, M = self.system.joint, len(self.z)
        factor = joint.factor(self.entries(sites), np.zeros(M))
        entries = factor.inverse_entries()
        covariance = joint.block_values(members, self.pairs, entries)
        right, inner = np.zeros(M + 1), np.append(self.z, 0.0)[members]
        right[members] = sites.pull - np.einsum("bij,bj->bi", sites.precision, inner)
        mean = self.z + factor.solve(joint.of_biases(self.system.pull + right[:M]))[joint.states :]
        return BlockMarginals(mean, covariance, entries[joint.places.diagonal])

    def at(self, z: np.ndarray) -> SparseLikelihood:
        """The system at other biases (M,), every track following."""
        moved = self.system.moved(self.model, z - self.z)
        return replace(self, system=system_at(self.model, self.system.joint, moved))


@dataclass(frozen=True, eq=False)
class SparsePosterior(Posterior):
    """Marginals of the biases and of the states, by the sparse form: no covariance of all biases is held."""

    system: SparseSystem
    entries: np.ndarray  # of the joint precision, those of sites in it
    alpha: np.ndarray  # (M,) what a prior adds to them
    variance: np.ndarray  # (n,) of all variables
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
        pairs = zip(self.states, self.system.joint.state_values(self.variance), strict=True)
        return [Tracks(x, np.sqrt(np.maximum(own, 0.0))) for x, own in pairs]

    def draws(self, key: jax.Array, keep: tuple[str, ...]) -> Draws:
        """Draws of the biases from the Gaussian with their means, sds and correlations, few where they are many."""
        self.check_kept(keep)
        count = CHAINS * int(np.clip(NUMBERS // (CHAINS * len(self.alpha)), 2, MOST))
        rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))
        drawn = self.system.joint.factor(self.entries, self.alpha).draw(rng, count)[:, self.system.joint.states :]
        normal = drawn / np.sqrt(self.variance[self.system.joint.states :])
        z = (self.summary.mean + self.summary.sd * normal).reshape(CHAINS, -1, drawn.shape[1])
        levels = np.zeros((*z.shape[:2], 0))
        return Draws(z, levels, [], np.arange(z.shape[1]), [], [])

    def check_kept(self, keep: tuple[str, ...]) -> None:
        """Raise `InputError` for draws of what would take too much room."""
        if {"states", "replicas"} & set(keep):
            raise InputError(
                "fit(save=...): a fit in sparse form keeps no draws of states or replicas; leave save out, or give"
                ' form="dense"'
            )

    def log_prior(self, draws: Draws) -> np.ndarray | None:
        """None: it takes as much room as the draws."""
        return None

    @property
    def pull(self) -> np.ndarray:
        """Linear term (M,) of the log-likelihood of z about zero, trajectories integrated."""
        at, model = self.system, self.problem.model
        z = jnp.asarray(at.point.z)
        return np.asarray(at.information(model, z)) + at.pull

    @property
    def attrs(self) -> Mapping[str, float]:
        """The limit of inclusion, how many directions are weak, and the error of an evidence that is estimated."""
        estimated = {} if self.evidence_error is None else {"log_evidence_error": self.evidence_error}
        return {"rope": ROPE, "sparse": 1.0, "weak": float(self.weak)} | estimated


def sparse_answer(method: Maximiser, problem: Problem, prior: Prior, start: Point, context: Context) -> Answer:
    """The answer of `EA` or `MAP` in sparse form; raises `FitError` where a flat prior leaves no interval."""
    model = problem.model
    joint = JointPrecision.of(model, products=getattr(method, "form", "") == PRODUCTS)
    integrated = hasattr(method, "integrates") and method.integrates(prior)
    prior_first = prior.precision(problem.labels, problem.surveyed)
    first = np.asarray(prior_first.alpha)
    declared = np.ones_like(first) if integrated else first

    def told(k: int, value: float) -> bool:
        context.monitor.tell(method.name, min(k, method.iterations), method.iterations, value, bound=True)
        return bool(context.monitor.stopped)

    try:
        mode = find_sparse_mode(
            model, joint, start, declared, min(STEPS, method.iterations), 1e-2 * method.tolerance, told
        )
        evidence, error = _evidence(mode, problem, declared)
        posterior, settled = (
            _integrated(problem, prior, mode, evidence, prior_first, context.key, told) if integrated
            else (_gaussian(problem, prior, mode, (evidence, error), first), True)
        )  # fmt: skip
    except MemoryError:
        if joint.members is not None:
            raise FitError(
                f"memory does not hold {joint.states} state entries and {model.biases} biases, not even without a"
                " factor: take fewer sensors or a shorter time"
            ) from None
        if getattr(method, "form", "") == "auto" and isinstance(prior, (Gaussian, Flat)):
            return sparse_answer(replace(cast("Any", method), form=PRODUCTS), problem, prior, start, context)
        raise FitError(
            f"the sparse factor of {joint.states} state entries and {model.biases} biases does not fit in memory:"
            f' MAP(form="{PRODUCTS}") makes none; or take fewer sensors or a shorter time'
        ) from None
    except np.linalg.LinAlgError:
        raise diverged(problem, joint, start, declared) from None
    square = float(mean_square(model, posterior.point))
    return conclude_at(
        problem, method, prior, posterior, mode.trace, square, len(mode.trace), converged=mode.converged and settled,
        refused=mode.refused, evidence=evidence, stopped=context.monitor.stopped,
    )  # fmt: skip


def diverged(problem: Problem, joint: JointPrecision, point: Point, alpha: np.ndarray) -> FitError:
    """What to say where the precision at a point, with prior precisions alpha (M,), is not positive definite."""
    silent = ", ".join(_untold(problem, joint, point, alpha)[:NAMED])
    why = f"no row tells {silent}" if silent else "the information matrix is singular"
    return FitError(f"The fit diverged: {why}; the estimate is invalid. Use a prior, or fix some biases.")


def _untold(problem: Problem, joint: JointPrecision, point: Point, alpha: np.ndarray) -> list[str]:
    """Labels of the biases of which neither a row at a point nor a prior of precisions alpha (M,) says anything."""
    information = joint.within(joint.values(problem.model, linearise_rows(problem.model, point), point.levels))
    nothing = np.flatnonzero(information.diagonal() + alpha == 0)
    return [problem.labels[m] for m in nothing]


def sparse_climb(problem: Problem, form: str) -> SideClimb:
    """To the marginal mode in a sparse form, with its log evidence, or without a factor its log marginal density.

    An estimated log determinant of the biases would blur what tells the sides apart; reflected it is nearly the same.
    """
    scales, products = np.ones(problem.model.biases), form == PRODUCTS
    joint: JointPrecision | None = None

    def mode(point: Point) -> tuple[Point, float]:
        nonlocal joint
        joint = JointPrecision.of(problem.model, products=products) if joint is None else joint
        try:
            found = find_sparse_mode(problem.model, joint, point, scales, STEPS, 1e-3)
            worth = -found.value if products else _evidence(found, problem, scales)[0]
            return found.system.point, worth
        except (np.linalg.LinAlgError, FitError):  # not positive definite, or conjugate gradients did not end
            return point, -np.inf

    return SideClimb(mode, lambda _, evidence: evidence, HELD)


def _evidence(mode: SparseMode, problem: Problem, alpha: np.ndarray) -> tuple[float, float]:
    """Log evidence at a mode under precisions alpha (M,), trajectories and biases integrated by Laplace's formula.

    And its standard error, 0 where the log determinant is exact.
    """
    at, joint = mode.system, mode.system.joint
    whole, error = mode.factor.log_determinant()
    volume = whole - float(at.solved.logdet) + joint.correction(problem.model, at.point.levels)
    log_prior = 0.5 * float(np.sum(np.log(np.where(alpha > 0, alpha, 1.0))))
    return -mode.value + log_prior - 0.5 * volume, 0.5 * error


def _gaussian(
    problem: Problem, prior: Prior, mode: SparseMode, evidence: tuple[float, float], alpha: np.ndarray
) -> SparsePosterior:
    """The Gaussian at a mode; `evidence` is its logarithm and the standard error of that."""
    joint, z = mode.system.joint, np.asarray(mode.system.point.z)
    if joint.exact:
        entries, members = mode.factor.inverse_entries(), blocks_of(problem.model)
        blocks = SensorBlocks(len(z), members, joint.block_values(members, joint.pairs(members), entries))
        variance, error = entries[joint.places.diagonal], np.zeros(joint.places.size)
    else:  # entries off the diagonal are not estimated
        variance, error = mode.factor.inverse_diagonal()
        blocks = SensorBlocks(len(z), np.arange(len(z))[:, None], variance[joint.states :, None, None])
    own = variance[joint.states :]
    half = HALF * np.sqrt(own)
    gamma = np.clip(1.0 - alpha * own, 0.0, 1.0)
    declared = blocks if prior.proper else blocks.under_scales()
    summary = Summary(
        "Laplace", "given", z, None, z - half, z + half, gamma, alpha, None, np.zeros(0),
        evidence[0] if prior.proper else None, told_columns(declared) | _errors(error, variance, mode.system),
        blocks=blocks,
    )  # fmt: skip
    at = mode.system
    found = open_directions(
        problem, at.point, declared, unheld_directions(problem, mode.system, mode.factor) if prior.proper else ()
    )
    estimated = evidence[1] if prior.proper and joint.members is not None else None
    return SparsePosterior(
        problem, prior, at.point, summary, at, at.entries, alpha, variance, declared, *found, estimated
    )  # fmt: skip


def unheld_directions(problem: Problem, system: SparseSystem, factor: Factor) -> tuple[Direction, ...]:
    """Rigid motions and common shifts that the data at a system leave to the prior in its factor."""
    joint = system.joint
    return open_together(problem, system.point, lambda columns: factor.solve(joint.of_biases(columns))[joint.states :])


def declared_blocks(problem: Problem, system: SparseSystem) -> SensorBlocks:
    """What a prior of the declared scales leaves of the biases of each sensor, at a system."""
    M, joint, members = problem.model.biases, system.joint, blocks_of(problem.model)
    factor = system.factor(np.ones(M))
    if joint.exact:
        return SensorBlocks(M, members, joint.block_values(members, joint.pairs(members), factor.inverse_entries()))
    variance, _ = factor.inverse_diagonal()  # entries off the diagonal are not estimated
    return SensorBlocks(M, np.arange(M)[:, None], variance[joint.states :, None, None])


def open_directions(
    problem: Problem, point: Point, declared: SensorBlocks, together: tuple[Direction, ...]
) -> tuple[tuple[Direction, ...], int]:
    """All that the data leave to the prior: of many sensors first, then of each; and how many there are."""
    alone, count = open_alone(problem, point, declared.members, declared.covariance, NAMED)
    return (*together, *alone), len(together) + count


def told_columns(declared: SensorBlocks) -> dict[str, np.ndarray]:
    """A column with the share that data narrow each bias, of its declared scale."""
    return {"contraction": np.clip(1.0 - declared.variance, 0.0, 1.0)}


def _errors(error: np.ndarray, variance: np.ndarray, system: SparseSystem) -> dict[str, np.ndarray]:
    """A column with the share of each sd by which it may be wrong, where variances are estimated."""
    if system.joint.exact:
        return {}
    states = system.joint.states
    return {"sd_error": 0.5 * error[states:] / variance[states:]}


def _integrated(
    problem: Problem, prior: Prior, mode: SparseMode, evidence: float, first: Precision, key: jax.Array, told: Any
) -> tuple[SparsePosterior, bool]:
    """The marginals that a hierarchy makes of the likelihood, this taken anew at their mean."""
    form = Form(problem.model.biases, hierarchy_of(prior, problem))
    if not form.hierarchy.learnt:  # every bias has a survey
        return _gaussian(problem, prior, mode, (evidence, 0.0), np.asarray(first.alpha)), True
    members = blocks_of(problem.model)
    likelihood = SparseLikelihood(problem.model, mode.system, mode.system.joint.pairs(members))
    together = unheld_directions(problem, mode.system, mode.factor)
    work = Propagation.of(form, first, likelihood, members, key)
    work.run(told)
    return _mixture(problem, prior, work, evidence, together), work.settled


def _mixture(
    problem: Problem, prior: Prior, work: Propagation, evidence: float, together: tuple[Direction, ...]
) -> SparsePosterior:
    """The marginals where a propagation ended."""
    swept, found, begun, likelihood = work.swept, work.found, work.begun, work.likelihood
    assert swept is not None
    assert found is not None
    assert begun is not None
    assert isinstance(likelihood, SparseLikelihood)
    mean, own, system = work.mean, work.variance, likelihood.system
    declared = SensorBlocks(len(mean), work.members, begun.covariance)
    tail, first = 0.5 * (1.0 - INTERVAL), np.asarray(work.first.alpha)
    lower, upper = (np.asarray(quantile(swept.means, swept.sds, share)) for share in (tail, 1.0 - tail))
    alpha = np.clip((1 - swept.gamma) / np.maximum(own, 1e-300), *PRECISION_BOUNDS)
    alpha = np.where(held(prior, problem), first, alpha)
    summary = Summary(
        "mixture", "integrated", mean, None, lower, upper, swept.gamma, alpha, None,
        np.zeros(0), evidence, told_columns(declared), SensorBlocks(len(mean), work.members, swept.covariance),
    )  # fmt: skip
    point = system.moved(problem.model, mean - np.asarray(system.point.z))
    return SparsePosterior(
        problem, prior, point, summary, system, likelihood.entries(work.sites), np.zeros_like(first), found.whole,
        declared, *open_directions(problem, point, declared, together),
    )  # fmt: skip
