"""Expectation propagation on a Gaussian likelihood: precisions integrated where biases are many.

A Gaussian site stands for the priors of the biases of each sensor (a block), which its own data tell apart worst: what
is left open between a place and an offset has several answers under a sparse prior. Sites are renewed, all at once,
until the moments of every block agree with those that the prior gives (Minka 2001; Seeger 2008); these are found by
Gibbs sweeps within the blocks. Any engine gives the marginals of blocks.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal import linalg
from probcal.gaussian.engine import Engine, Expansion, Factors, Group
from probcal.gaussian.mode import Point
from probcal.inference.hierarchy import Phi
from probcal.inference.loop import Pause, Task, Trace
from probcal.inference.posed import Form
from probcal.linalg import invert, without_negative
from probcal.priors import Precision

ROUNDS, SURE, CLOSE, DAMPING = 10, 2, 0.15, 0.7  # rounds, those not yet averaged, sds (rms) of a move, share of a site
BURN, KEPT, EVERY = 100, 100, 5  # sweeps in a round: before, whose Gaussians are kept, and from one to the next
NEAR, AGAIN = 0.5, 0.05  # sds (rms) by which the mean may lie from the point of the likelihood, or this is taken anew
MINUS = 0.5  # share of the precision of a cavity that a site may take away
LEAST = 1e-9  # precision of a cavity
SPIKE = 1e-8  # variance of a bias that is never in


class Blocks(NamedTuple):
    """Gaussians of the biases of each sensor by themselves, in natural form: B blocks of p biases at most."""

    precision: Any  # (B, p, p); 1 on the diagonal where a block has fewer
    pull: Any  # (B, p)


class BlockChain(NamedTuple):
    """The state of the sweeps of one chain."""

    z: jax.Array  # (M,)
    phi: Phi


class BlocksSwept(NamedTuple):
    """The results of sweeps over cavities times prior."""

    mean: Any  # (B, p)
    covariance: Any  # (B, p, p)
    gamma: Any  # (M,)
    means: Any  # (KEPT, M) of single sweeps given their hyper-parameters
    sds: Any  # (KEPT, M)


class BlockMarginals(NamedTuple):
    """Marginals of the biases under a likelihood and sites."""

    mean: np.ndarray  # (M,)
    covariance: np.ndarray  # (B, p, p) of each block; 1 on the diagonal where a block has fewer


@dataclass(frozen=True, eq=False)
class BiasLikelihood:
    """The Gaussian likelihood of the biases at a point, by what any engine gives."""

    engine: Engine
    here: Expansion
    prior: Factors  # of the biases that no hierarchy governs
    marginal: bool = True  # whether the determinant of the trajectories belongs to it; not at a joint mode

    @property
    def z(self) -> np.ndarray:
        """Biases (M,) of the point."""
        return np.asarray(self.here.point.z)

    def marginals(self, members: np.ndarray, sites: Blocks) -> BlockMarginals:
        """Marginals of blocks of members (B, p); raises `numpy.linalg.LinAlgError` where there are none."""
        factors, here = self.with_sites(members, sites), self.here
        if not np.isfinite(here.log_det(factors).value):
            raise np.linalg.LinAlgError("the precision of the biases is not positive definite")
        score = np.asarray(here.score() if self.marginal else here.slope()) + factors.pull(self.z)
        covariance = np.asarray(here.marginals(factors, members))
        return BlockMarginals(self.z + np.asarray(here.solve(factors, score)), covariance)

    def with_sites(self, members: np.ndarray, sites: Blocks) -> Factors:
        """The prior of what no hierarchy governs, and the sites of blocks of members (B, p)."""
        return self.prior + Factors((Group(members, sites.precision, sites.pull),))

    def expand(self, point: Point) -> Expansion:
        """The posterior with every track at its mode for the biases of a point."""
        return self.engine.settled(self.here.model, point)

    def at(self, z: np.ndarray) -> BiasLikelihood:
        """The likelihood at other biases (M,), every track at its mode; as it is where there is none there."""
        there = self.expand(self.here.moved(z - self.z))
        return replace(self, here=there) if np.isfinite(np.asarray(there.score())).all() else self


@partial(jax.jit, static_argnames="form")
def sweep_blocks(
    form: Form, first: Precision, members: jax.Array, cavity: Blocks, chain: BlockChain, key: jax.Array
) -> tuple[BlockChain, BlocksSwept]:
    """Gibbs sweeps over the hyper-parameters of all biases and the biases of each block, given its cavity (B, p, p).

    The prior is exact, with all that biases share; moments are those of the Gaussians given
    hyper-parameters. The cavities hold the prior of what no hierarchy governs.
    """
    kind, M = form.hierarchy, form.biases
    learnt, (B, p) = jnp.asarray(kind.learnt, int), members.shape
    updates, eye = kind.updates(), jnp.eye(p)[None]
    spiked = jnp.asarray(kind.spiked, int)
    governed = jnp.zeros(M + 1, bool).at[spiked].set(True)[members]
    toggles = np.array([np.isin(np.arange(p), pair) for k in (1, 2) for pair in combinations(range(p), k)])

    def of_members(values: jax.Array, filling: Any) -> jax.Array:
        """Values (M,) of the biases as (B, p)."""
        return jnp.append(values, filling)[members]

    def of_biases(values: jax.Array) -> jax.Array:
        """Values (B, p) of the members as (M,)."""
        return jnp.zeros(M + 1, values.dtype).at[members].set(values)[:M]

    def given(alpha: jax.Array, active: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Root (B, p, p) of the covariances of the blocks and its product with the pull, of what is active (B, p)."""
        precision = cavity.precision + eye * alpha[:, :, None]
        root = jax.vmap(linalg.inverse_cholesky)(jnp.where(linalg.outer(active), precision, eye))
        return root, jnp.einsum("bij,bj->bi", root, jnp.where(active, cavity.pull, 0.0))

    def include(phi: Phi, key: jax.Array) -> Phi:
        """Inclusions after moves of one or two members of each block, its biases integrated out."""
        share = kind.share(phi)
        odds = of_members(jnp.zeros(M).at[spiked].set(jnp.log(share) - jnp.log1p(-share)), 0.0)
        alpha = of_members(kind.alpha(phi, jnp.zeros(M)), 0.0)

        def weight(active: jax.Array) -> jax.Array:
            root, half = given(alpha, active)
            own = jnp.log(jnp.diagonal(root, axis1=1, axis2=2)) + 0.5 * half**2
            slabs = jnp.where(active & governed, odds + 0.5 * jnp.log(jnp.where(governed, alpha, 1.0)), 0.0)
            return jnp.sum(own + slabs, 1)

        def move(carry: tuple[jax.Array, jax.Array], turn: Any) -> tuple[Any, None]:
            (active, old), (toggle, draw) = carry, turn
            other = active ^ (toggle[None] & governed)
            new = weight(other)
            takes = jnp.log(draw) < new - old
            return (jnp.where(takes[:, None], other, active), jnp.where(takes, new, old)), None

        active = of_members(kind.active(phi, M), True)
        draws = jax.random.uniform(key, (len(toggles), B))
        (active, _), _ = jax.lax.scan(move, (active, weight(active)), (jnp.asarray(toggles), draws))
        return phi | {"included": of_biases(active)[spiked]}

    def one(carry: tuple[BlockChain, Any], k: jax.Array) -> tuple[tuple[BlockChain, Any], None]:
        (z, phi), (count, mean, second, gamma, means, sds) = carry
        keys = jax.random.split(jax.random.fold_in(key, k), len(updates) + 2)
        for update, own in zip(updates, keys, strict=False):
            phi = update(phi, z[learnt], own)
        if kind.spiked:
            phi = include(phi, keys[-2])
        alpha, active = kind.alpha(phi, first.alpha), of_members(kind.active(phi, M), True)
        root, half = given(of_members(kind.alpha(phi, jnp.zeros(M)), 0.0), active)
        middle = jnp.where(active, jnp.einsum("bji,bj->bi", root, half), 0.0)
        covariance = jnp.where(linalg.outer(active), root.mT @ root, 0.0)
        noise = jnp.einsum("bji,bj->bi", root, jax.random.normal(keys[-1], half.shape))
        variance = of_biases(jnp.diagonal(covariance, axis1=1, axis2=2))
        on = (k >= BURN) * 1.0
        slot = jnp.maximum(k - BURN, 0) // EVERY
        inside = of_biases(active) & (variance > 0)
        sums = (
            count + on, mean + on * middle,
            second + on * (covariance + linalg.outer(middle)),
            gamma + on * jnp.where(inside, jnp.clip(1.0 - alpha * variance, 0.0, 1.0), 0.0),
            means.at[slot].set(of_biases(middle)), sds.at[slot].set(jnp.sqrt(variance)),
        )  # fmt: skip
        return (BlockChain(of_biases(jnp.where(active, middle + noise, 0.0)), phi), sums), None

    blank = (
        jnp.zeros(()), jnp.zeros((B, p)), jnp.zeros((B, p, p)), jnp.zeros(M), jnp.zeros((KEPT, M)), jnp.zeros((KEPT, M))
    )  # fmt: skip
    (chain, sums), _ = jax.lax.scan(one, (chain, blank), jnp.arange(BURN + EVERY * KEPT))
    count, mean, second, gamma, means, sds = sums
    mean = mean / count
    covariance = second / count - linalg.outer(mean) + SPIKE * eye
    return chain, BlocksSwept(mean, covariance, gamma / count, means, sds)


class PropagationState(NamedTuple):
    """The state of a propagation between two rounds; arrays are empty before the first."""

    point: Point  # of the likelihood
    sites: Blocks
    before: Blocks
    chain: BlockChain
    swept: BlocksSwept
    begun: Any  # (B, p, p)
    settled: Any


@dataclass(eq=False)
class Propagation(Task):
    """The state of a propagation: the likelihood, the sites in place of priors, the moments of
    both."""

    form: Form
    first: Precision  # the prior of what no hierarchy governs, which the likelihood counts
    likelihood: BiasLikelihood
    members: np.ndarray  # (B, p) biases of each block, M of none
    key: jax.Array
    sites: Blocks
    before: Blocks  # those of the last marginals
    chain: BlockChain
    swept: BlocksSwept
    begun: Any  # (B, p, p) covariances of the first round, under the declared scales
    settled: bool = False  # whether the means came to rest

    name: ClassVar[str] = "expectation propagation"
    iterations: ClassVar[int] = ROUNDS

    @property
    def biases(self) -> int:
        """Number of the biases."""
        return self.form.biases

    @classmethod
    def of(cls, form: Form, first: Precision, likelihood: BiasLikelihood, members: np.ndarray, key: jax.Array) -> Any:
        """The beginning: biases of their declared scales."""
        precision = np.eye(members.shape[1])[None] * np.isin(members, form.hierarchy.learnt)[:, :, None]
        sites, none = Blocks(precision, np.zeros(members.shape)), np.zeros(0)
        chain = BlockChain(jnp.asarray(none), jax.tree.map(lambda leaf: jnp.asarray(leaf[-1]), form.hierarchy.begin(2)))
        swept = BlocksSwept(*[none] * 5)
        return cls(form, first, likelihood, members, key, sites, sites, chain, swept, none)

    @property
    def factors(self) -> Factors:
        """The prior of what no hierarchy governs, and the sites of the last marginals."""
        return self.likelihood.with_sites(self.members, self.before)

    def of_biases(self, values: np.ndarray) -> np.ndarray:
        """Values (B, p) of the members as (M,)."""
        found = np.zeros(self.form.biases + 1)
        found[self.members] = values
        return found[:-1]

    @property
    def mean(self) -> np.ndarray:
        """Means (M,) of likelihood and prior."""
        return self.of_biases(self.swept.mean)

    @property
    def variance(self) -> np.ndarray:
        """Variances (M,) of likelihood and prior."""
        return self.of_biases(np.diagonal(self.swept.covariance, axis1=1, axis2=2))

    def _marginals(self) -> BlockMarginals:
        """Marginals with the sites; those that take more away than the rest gives are cut to nothing."""
        try:
            return self.likelihood.marginals(self.members, self.sites)
        except np.linalg.LinAlgError:
            self.sites = self.sites._replace(precision=without_negative(self.sites.precision, LEAST))
            return self.likelihood.marginals(self.members, self.sites)

    def round(self, turn: int) -> float:
        """Renew all sites; the root mean square of how far the means moved, in sds."""
        found = self._marginals()
        self.before = self.sites
        precision = invert(found.covariance)
        middle = np.append(found.mean, 0.0)[self.members]
        cavity = Blocks(
            without_negative(precision - self.sites.precision, LEAST),
            np.einsum("bij,bj->bi", precision, middle) - self.sites.pull,
        )
        if turn == 0:
            self.begun, self.chain = found.covariance, self.chain._replace(z=jnp.asarray(found.mean))
        own = jax.random.fold_in(self.key, 1 + turn)
        self.chain, swept = sweep_blocks(self.form, self.first, self.members, cavity, self.chain, own)
        self.swept = swept = jax.device_get(swept)
        wanted = invert(swept.covariance)
        new = Blocks(wanted - cavity.precision, np.einsum("bij,bj->bi", wanted, swept.mean) - cavity.pull)
        floor = -MINUS * cavity.precision  # what is left of a cavity stays positive
        there = np.isin(self.members, self.form.hierarchy.learnt)  # a site is of the biases that it governs alone
        positive = without_negative(new.precision - floor, LEAST) + floor
        precision = np.where(linalg.outer(there), positive, 0.0)
        new = Blocks(precision, np.where(there, new.pull, 0.0))
        share = min(DAMPING, 1.0 / max(turn - SURE, 1))  # later rounds are averaged: sweeps are noisy
        self.sites = Blocks(*(share * a + (1 - share) * b for a, b in zip(new, self.sites, strict=True)))
        off = self.of_biases((swept.mean - middle) / np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2)))
        return float(np.sqrt(np.mean(off**2)))

    @property
    def far(self) -> float:
        """Sds (rms) by which the mean lies from the point of the likelihood."""
        return float(np.sqrt(np.mean((self.mean - self.likelihood.z) ** 2 / self.variance)))

    def init(self) -> PropagationState:
        """The state before the first round."""
        point = self.likelihood.here.point
        return PropagationState(point, self.sites, self.before, self.chain, self.swept, self.begun, self.settled)

    def resume(self, state: PropagationState) -> None:
        """Stand where a state says; the likelihood is made anew where it is of another point."""
        here = self.likelihood.here
        if state.point is not here.point:
            self.likelihood = replace(self.likelihood, here=self.likelihood.engine.at(here.model, state.point))
        self.sites, self.before, self.chain, self.swept, self.begun, settled = state[1:]
        self.settled = bool(settled)

    def step(self, state: PropagationState, count: int, pause: Pause) -> tuple[PropagationState, Trace]:
        """A round; before it the likelihood is taken anew at the mean where this has moved."""
        self.resume(state)
        if count and self.far >= AGAIN:
            self.likelihood = self.likelihood.at(self.mean)
        off = self.round(count)
        self.settled = bool(count >= SURE and off < CLOSE and self.far < NEAR)
        precision = self.of_biases(np.diagonal(self.sites.precision, axis1=1, axis2=2))
        return self.init(), Trace(np.array([off]), self.mean[None], precision[None])

    def ended(self, state: PropagationState, trace: Trace) -> bool:
        """True where the means came to rest."""
        return bool(state.settled)
