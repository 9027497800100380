"""Fits whose dense form does not fit: the marginal mode by sparse factors, precisions integrated by propagation.

`EA()` and `MAP()` come here by themselves (`form="auto"`): where the matrices of the dense form take more than 240 MB.
What needs the whole covariance of the biases is not there; variances and gamma of each are.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal import linalg
from probcal.errors import FitError, InputError
from probcal.inference.ending import conclude_at
from probcal.inference.hierarchy import Phi, hierarchy_of
from probcal.inference.integrate import quantile
from probcal.inference.posed import Form
from probcal.inference.progress import Progress
from probcal.model.model import Model
from probcal.priors import PRECISION_BOUNDS, BernoulliGaussian, Flat, Gaussian, Precision, Prior
from probcal.problem import Problem
from probcal.results.answer import HALF, Answer, Draws, Posterior, Summary, Tracks
from probcal.results.schema import INTERVAL, ROPE
from probcal.smoothing.cholesky import Factor, exact
from probcal.smoothing.information import mean_square
from probcal.smoothing.joint import JointPrecision, missing, prefers_sparse
from probcal.smoothing.mode import Point
from probcal.smoothing.sparse_mode import SparseMode, SparseSystem, find_sparse_mode, system_at

if TYPE_CHECKING:
    from probcal.inference.run import Context, Maximiser

CHAINS, NUMBERS, MOST = 4, 400_000, 250  # of the draws of all biases that a tree holds, and draws of a chain
STEPS = 60  # of the climb
ROUNDS, SURE, CLOSE, DAMPING = 10, 2, 0.15, 0.7  # rounds, those not yet averaged, sds (rms) of a move, share of a site
BURN, KEPT, EVERY = 100, 100, 5  # sweeps in a round: before, whose Gaussians are kept, and from one to the next
NEAR, AGAIN = 0.5, 0.05  # sds (rms) by which the mean may lie from the point of the likelihood, or this is taken anew
MINUS = 0.5  # share of the precision of a cavity that a site may take away
LEAST = 1e-9  # precision of a cavity
FORMS = ("auto", "dense", "sparse")


def takes_sparse(method: Maximiser, problem: Problem) -> bool:
    """Whether a method is to solve a problem in its sparse form; raises `InputError` where that was asked in vain."""
    form = getattr(method, "form", "dense")
    lacks = missing(problem.model)
    if form == "sparse" and lacks:
        raise InputError(f'{method.name}(form="sparse") does not take {lacks}: give form="dense"')
    return bool(form == "sparse" or (form == "auto" and not lacks and prefers_sparse(problem.model)))


def check_sparse(method: Maximiser, prior: Prior, starts: int) -> None:
    """Raise `InputError` naming what a sparse fit does not do."""
    wrong = ""
    if getattr(method, "trajectory", "") != "marginal":
        wrong = 'trajectory="marginal" alone'
    elif prior.correlation:
        wrong = "a prior without correlations"
    elif not (method.integrates(prior) if hasattr(method, "integrates") else isinstance(prior, (Gaussian, Flat))):
        wrong = (
            "precisions that are integrated or given (EA() with Horseshoe() or ARD(rate=0.5), MAP() with Gaussian())"
        )
    elif isinstance(prior, BernoulliGaussian):
        wrong = "a prior that puts no bias at exactly zero"
    elif starts > 1:
        wrong = "one start"
    elif not (exact() or isinstance(prior, (Gaussian, Flat))):
        wrong = "exact variances, of sparsax, to integrate precisions: install probcal[sparse], or take MAP()"
    if wrong:
        raise InputError(f"{method.name} on a network of this size is solved in sparse form, which takes {wrong}")


class Blocks(NamedTuple):
    """Gaussians of the biases of each sensor by themselves, in natural form: B blocks of p biases at most."""

    precision: Any  # (B, p, p); 1 on the diagonal where a block has fewer
    pull: Any  # (B, p)


class BlockChain(NamedTuple):
    """Where the sweeps of one chain stand."""

    z: jax.Array  # (M,)
    phi: Phi


class BlocksSwept(NamedTuple):
    """What sweeps say of cavities times prior."""

    mean: Any  # (B, p)
    covariance: Any  # (B, p, p)
    gamma: Any  # (M,)
    means: Any  # (KEPT, M) of single sweeps given their hyper-parameters
    sds: Any  # (KEPT, M)


@partial(jax.jit, static_argnames="form")
def sweep_blocks(
    form: Form, first: Precision, members: jax.Array, cavity: Blocks, chain: BlockChain, key: jax.Array
) -> tuple[BlockChain, BlocksSwept]:
    """Gibbs sweeps over the hyper-parameters of all biases and the biases of each block, given its cavity (B, p, p).

    The prior is exact, with all that biases share; moments are those of the Gaussians given hyper-parameters.
    """
    learnt, M = jnp.asarray(form.hierarchy.learnt, int), form.biases
    updates = form.hierarchy.updates()

    def given(phi: Phi) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Root (B, p, p) of the covariances of the blocks, their means (B, p), and precisions (M,) of the biases."""
        alpha = form.hierarchy.alpha(phi, first.alpha)
        own = jnp.append(alpha, 0.0)[members]
        eye = jnp.eye(members.shape[1])[None]
        root = jax.vmap(linalg.inverse_cholesky)(cavity.precision + eye * own[:, :, None])
        return root, jnp.einsum("bji,bjk,bk->bi", root, root, cavity.pull), alpha

    def spread_out(values: jax.Array) -> jax.Array:
        """Values (B, p) of the members as (M,)."""
        return jnp.zeros(M + 1).at[members].set(values)[:M]

    def one(carry: tuple[BlockChain, Any], k: jax.Array) -> tuple[tuple[BlockChain, Any], None]:
        (z, phi), (count, mean, second, gamma, means, sds) = carry
        keys = jax.random.split(jax.random.fold_in(key, k), len(updates) + 1)
        for update, own in zip(updates, keys, strict=False):
            phi = update(phi, z[learnt], own)
        root, middle, alpha = given(phi)
        drawn = middle + jnp.einsum("bji,bj->bi", root, jax.random.normal(keys[-1], middle.shape))
        covariance = root.mT @ root
        variance = spread_out(jnp.diagonal(covariance, axis1=1, axis2=2))
        on = (k >= BURN) * 1.0
        slot = jnp.maximum(k - BURN, 0) // EVERY
        sums = (
            count + on, mean + on * middle,
            second + on * (covariance + middle[:, :, None] * middle[:, None, :]),
            gamma + on * jnp.clip(1.0 - alpha * variance, 0.0, 1.0),
            means.at[slot].set(spread_out(middle)), sds.at[slot].set(jnp.sqrt(variance)),
        )  # fmt: skip
        return (BlockChain(spread_out(drawn), phi), sums), None

    B, p = members.shape
    blank = (
        jnp.zeros(()), jnp.zeros((B, p)), jnp.zeros((B, p, p)), jnp.zeros(M), jnp.zeros((KEPT, M)), jnp.zeros((KEPT, M))
    )  # fmt: skip
    (chain, sums), _ = jax.lax.scan(one, (chain, blank), jnp.arange(BURN + EVERY * KEPT))
    count, mean, second, gamma, means, sds = sums
    mean = mean / count
    covariance = second / count - mean[:, :, None] * mean[:, None, :]
    return chain, BlocksSwept(mean, covariance, gamma / count, means, sds)


@dataclass(eq=False)
class Propagation:
    """Expectation propagation around a sparse Gaussian likelihood, with a Gaussian site for the priors of each block.

    A block is the biases of one sensor, which its own data tell apart worst: what is left open between a place and an
    offset has several answers under a sparse prior, and its moments are found by sweeps within the block.
    """

    model: Model
    form: Form
    first: Precision
    system: SparseSystem
    sites: Blocks
    members: np.ndarray  # (B, p) biases of each block, M of none
    pairs: np.ndarray  # (B, p, p) where the entries of their covariances are, -1 of none
    key: jax.Array
    chain: BlockChain | None = None
    swept: BlocksSwept | None = None
    variance: np.ndarray = field(default_factory=lambda: np.zeros(0))  # (n,) of all variables

    @property
    def entries(self) -> np.ndarray:
        """Entries of the joint precision with the sites."""
        whole, p = self.system.entries.copy(), self.members.shape[1]
        upper = np.triu(np.ones((p, p), bool))[None] & (self.pairs >= 0)
        np.add.at(whole, self.pairs[upper], self.sites.precision[upper])
        return whole

    def factor(self) -> Factor:
        """The joint precision with the sites, factorised."""
        return self.system.joint.factor(self.entries, np.zeros(self.form.biases))

    def of_blocks(self, values: np.ndarray) -> np.ndarray:
        """Values (B, p) of the members as (M,)."""
        found = np.zeros(self.form.biases + 1)
        found[self.members] = values
        return found[:-1]

    def round(self, turn: int) -> float:
        """Renew all sites; the root mean square of how far the means moved, in sds."""
        joint, M, z = self.system.joint, self.form.biases, np.asarray(self.system.point.z)
        factor = self.factor()
        entries = factor.inverse_entries()
        self.variance = entries[joint.places.diagonal]
        none = self.members == M
        eye = np.eye(self.members.shape[1])[None]
        covariance = np.where(self.pairs >= 0, entries[self.pairs], eye * none[:, None])
        inner = np.append(z, 0.0)[self.members]
        right = self.of_blocks(self.sites.pull - np.einsum("bij,bj->bi", self.sites.precision, inner))
        mean = z + factor.solve(joint.of_biases(self.system.pull + right))[joint.states :]
        precision = np.linalg.inv(covariance)
        middle = np.append(mean, 0.0)[self.members]
        cavity = Blocks(
            _positive(precision - self.sites.precision), np.einsum("bij,bj->bi", precision, middle) - self.sites.pull
        )
        if self.chain is None:
            self.chain = BlockChain(jnp.asarray(mean), self.form.hierarchy.begin(jax.random.fold_in(self.key, 0)))
        own = jax.random.fold_in(self.key, 1 + turn)
        self.chain, swept = sweep_blocks(self.form, self.first, self.members, cavity, self.chain, own)
        self.swept = swept = jax.device_get(swept)
        tilted = np.linalg.inv(swept.covariance)
        new = Blocks(tilted - cavity.precision, np.einsum("bij,bj->bi", tilted, swept.mean) - cavity.pull)
        floor = -MINUS * cavity.precision  # what is left of a cavity stays positive
        new = new._replace(precision=_positive(new.precision - floor) + floor)
        share = min(DAMPING, 1.0 / max(turn - SURE, 1))  # later rounds are averaged: sweeps are noisy
        self.sites = Blocks(*(share * a + (1 - share) * b for a, b in zip(new, self.sites, strict=True)))
        off = self.of_blocks((swept.mean - middle) / np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)))
        return float(np.sqrt(np.mean(off**2)))

    def run(self, told: Callable[[int, float], Any]) -> bool:
        """Rounds until the means move by less than `CLOSE` sds in the root mean square; whether that was reached.

        Between rounds the likelihood is taken anew at the mean.
        """
        for turn in range(ROUNDS):
            off = self.round(turn)
            told(turn, off)
            assert self.swept is not None
            moved = self.of_blocks(self.swept.mean) - np.asarray(self.system.point.z)
            far = np.sqrt(np.mean(moved**2 / self.variance[self.system.joint.states :]))
            if turn >= SURE and off < CLOSE and far < NEAR:
                return True
            if turn + 1 < ROUNDS and far >= AGAIN:
                point = self.system.moved(self.model, moved)
                self.system = system_at(self.model, self.system.joint, point)
        return False


def _positive(matrices: np.ndarray) -> np.ndarray:
    """Symmetric matrices (B, p, p) with eigenvalues that are not negative."""
    values, vectors = np.linalg.eigh(0.5 * (matrices + matrices.transpose(0, 2, 1)))
    return np.einsum("bik,bk,bjk->bij", vectors, np.maximum(values, LEAST), vectors)


@dataclass(frozen=True, eq=False)
class SparsePosterior(Posterior):
    """Marginals of the biases and of the states, by the sparse form: no covariance of all biases is held."""

    system: SparseSystem
    entries: np.ndarray  # of the joint precision, those of sites in it
    alpha: np.ndarray  # (M,) what a prior adds to them
    variance: np.ndarray  # (n,) of all variables

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
        if {"states", "replicas"} & set(keep):
            raise InputError(
                "fit(save=...): a fit in sparse form keeps no draws of states or replicas; leave save out, or give"
                ' form="dense"'
            )
        count = CHAINS * int(np.clip(NUMBERS // (CHAINS * len(self.alpha)), 2, MOST))
        rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))
        drawn = self.system.joint.factor(self.entries, self.alpha).draw(rng, count)[:, self.system.joint.states :]
        normal = drawn / np.sqrt(self.variance[self.system.joint.states :])
        z = (self.summary.mean + self.summary.sd * normal).reshape(CHAINS, -1, drawn.shape[1])
        levels = np.zeros((*z.shape[:2], 0))
        return Draws(z, levels, [], np.arange(z.shape[1]), [], [])

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
        """The limit of inclusion."""
        return {"rope": ROPE, "sparse": 1.0}


def sparse_answer(method: Maximiser, problem: Problem, prior: Prior, start: Point, context: Context) -> Answer:
    """The answer of `EA` or `MAP` in sparse form; raises `FitError` where a flat prior leaves no interval."""
    model, joint = problem.model, JointPrecision.of(problem.model)
    integrated = hasattr(method, "integrates") and method.integrates(prior)
    prior_first = prior.precision(problem.labels, problem.surveyed)
    first = np.asarray(prior_first.alpha)
    declared = np.ones_like(first) if integrated else first

    def told(k: int, value: float) -> None:
        if context.progress is not None:
            context.progress(Progress(method.name, min(k, method.iterations), method.iterations, value))

    try:
        mode = find_sparse_mode(
            model, joint, start, declared, min(STEPS, method.iterations), 1e-2 * method.tolerance, told
        )
        evidence = _evidence(mode, problem, declared)
        posterior, settled = (
            _integrated(problem, prior, mode, evidence, prior_first, context.key, told) if integrated
            else (_gaussian(problem, prior, mode, evidence, first), True)
        )  # fmt: skip
    except np.linalg.LinAlgError:
        raise FitError(
            "The fit diverged: the information matrix is singular; the estimate is invalid. Use a prior, or fix some"
            " biases."
        ) from None
    square = float(mean_square(model, posterior.point))
    return conclude_at(
        problem, method, prior, posterior, mode.trace, square, len(mode.trace), converged=mode.converged and settled,
        refused=mode.refused, evidence=evidence,
    )  # fmt: skip


def _evidence(mode: SparseMode, problem: Problem, alpha: np.ndarray) -> float:
    """Log evidence at a mode under precisions alpha (M,), trajectories and biases integrated by Laplace's formula."""
    at, joint = mode.system, mode.system.joint
    volume = mode.factor.log_determinant() - float(at.solved.logdet)
    volume += joint.correction(problem.model, at.point.levels)
    return -mode.value + 0.5 * float(np.sum(np.log(np.where(alpha > 0, alpha, 1.0)))) - 0.5 * volume


def _gaussian(problem: Problem, prior: Prior, mode: SparseMode, evidence: float, alpha: np.ndarray) -> SparsePosterior:
    """The Gaussian at a mode."""
    variance, error = mode.factor.inverse_diagonal()
    z, own = np.asarray(mode.system.point.z), variance[mode.system.joint.states :]
    half = HALF * np.sqrt(own)
    gamma = np.clip(1.0 - alpha * own, 0.0, 1.0)
    summary = Summary(
        "Laplace", "given", z, None, z - half, z + half, gamma, alpha, None, np.zeros(0),
        evidence if prior.proper else None, _errors(error, variance, mode.system), variance=own,
    )  # fmt: skip
    at = mode.system
    return SparsePosterior(problem, prior, at.point, summary, at, at.entries, alpha, variance)


def _errors(error: np.ndarray, variance: np.ndarray, system: SparseSystem) -> dict[str, np.ndarray]:
    """A column with the share of each sd by which it may be wrong, where variances are estimated."""
    if exact():
        return {}
    states = system.joint.states
    return {"sd_error": 0.5 * error[states:] / variance[states:]}


def _integrated(
    problem: Problem, prior: Prior, mode: SparseMode, evidence: float, first: Precision, key: jax.Array, told: Any
) -> tuple[SparsePosterior, bool]:
    """The marginals that a hierarchy makes of the likelihood, this taken anew at their mean."""
    form = Form(problem.model.biases, hierarchy_of(prior, problem))
    if not form.hierarchy.learnt:  # every bias has a survey
        return _gaussian(problem, prior, mode, evidence, np.asarray(first.alpha)), True
    members, pairs = mode.system.joint.blocks(problem.model)
    eye = np.eye(members.shape[1])[None] * (members < form.biases)[:, :, None]
    sites = Blocks(np.broadcast_to(eye, pairs.shape).copy(), np.zeros(members.shape))
    work = Propagation(problem.model, form, first, mode.system, sites, members, pairs, key)
    settled = work.run(told)
    return _mixture(problem, prior, work, evidence), settled


def _mixture(problem: Problem, prior: Prior, work: Propagation, evidence: float) -> SparsePosterior:
    """The marginals where a propagation ended."""
    swept, system = work.swept, work.system
    assert swept is not None
    mean = work.of_blocks(swept.mean)
    own = work.of_blocks(np.diagonal(swept.covariance, axis1=1, axis2=2))
    tail, first = 0.5 * (1.0 - INTERVAL), np.asarray(work.first.alpha)
    lower, upper = (np.asarray(quantile(swept.means, swept.sds, share)) for share in (tail, 1.0 - tail))
    alpha = np.clip((1 - swept.gamma) / np.maximum(own, 1e-300), *PRECISION_BOUNDS)
    summary = Summary(
        "mixture", "integrated", mean, None, lower, upper, swept.gamma, np.where(problem.surveyed, first, alpha), None,
        np.zeros(0), evidence, variance=own,
    )  # fmt: skip
    point = system.moved(problem.model, mean - np.asarray(system.point.z))
    return SparsePosterior(problem, prior, point, summary, system, work.entries, np.zeros_like(first), work.variance)
