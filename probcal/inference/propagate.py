"""Expectation propagation on a Gaussian likelihood: precisions integrated without sweeps, where biases are many.

The prior of each bias (or group of them) is a finite scale mixture at nodes of what all share; a Gaussian site stands
for it and is renewed, all at once, until the marginals agree with those that the mixture gives (Minka 2001; Seeger
2008). The nodes of what is shared are weighed by their evidence. One round costs one inverse of the biases.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import logsumexp

from probcal import linalg
from probcal.inference.hierarchy import QuadratureNodes
from probcal.inference.posed import Form, Natural

ROUNDS, CLOSE = 60, 1e-4  # rounds at most, and the share of an sd that the means may still move
MOVED = 0.1  # sds by which a mean still moves after all rounds that are no end
DAMPING = 0.6  # share of a new site that is taken
LEAST = 1e-9  # precision of a site or a cavity


class Sites(NamedTuple):
    """Gaussian factors exp(-tau z^2 / 2 + nu z) in the place of the prior of each governed bias."""

    tau: jax.Array  # (L,)
    nu: jax.Array  # (L,)


class Tilted(NamedTuple):
    """Marginals of the governed biases at one node: a mixture of Gaussians each."""

    log_share: jax.Array  # (L, J) log weight of each component
    mean: jax.Array  # (L, J)
    variance: jax.Array  # (L, J)


class Propagated(NamedTuple):
    """Marginals and covariance of the biases, and draws with those marginals and correlations."""

    mean: jax.Array  # (M,)
    covariance: jax.Array  # (M, M)
    gamma: jax.Array  # (M,)
    z: jax.Array  # (D, M)
    settled: jax.Array  # () whether no mean moved much any more at the nodes that count


@partial(jax.jit, static_argnames=("form", "count"))
def propagate(form: Form, known: Natural, nodes: QuadratureNodes, key: jax.Array, count: int) -> Propagated:
    """What a hierarchy makes of a Gaussian likelihood, and `count` draws of it."""
    learnt = jnp.asarray(form.hierarchy.learnt, int)
    group = jnp.asarray(form.hierarchy.group, int)
    held = known.first.alpha.at[learnt].set(0.0)
    base = known.information + known.first.coupled() + jnp.diag(held)

    def solve(sites: Sites) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        pull = known.pull.at[learnt].add(sites.nu)
        covariance, logdet = linalg.inverse_and_logdet(base + jnp.diag(jnp.zeros_like(held).at[learnt].set(sites.tau)))
        mean = covariance @ pull
        return mean, covariance, logdet, pull

    def cavity(mean: jax.Array, covariance: jax.Array, sites: Sites) -> tuple[jax.Array, jax.Array]:
        """Precision and mean (L,) of what all but its own site say of each bias."""
        own = jnp.diagonal(covariance)[learnt]
        precision = jnp.maximum(1.0 / own - sites.tau, LEAST)
        return precision, (mean[learnt] / own - sites.nu) / precision

    def tilt(precision: jax.Array, middle: jax.Array, at: QuadratureNodes) -> tuple[Tilted, jax.Array]:
        """Marginals of cavity and prior, and the log of what each group's prior integrates to."""
        spread = 1.0 / precision[:, None] + at.variance[None]
        own = -0.5 * jnp.log(2 * jnp.pi * spread) - 0.5 * middle[:, None] ** 2 / spread
        joint = jax.ops.segment_sum(own, group, form.hierarchy.count) + at.log_weight[None]
        total = logsumexp(joint, 1)
        share = (joint - total[:, None])[group]
        part = at.variance[None] / spread
        return Tilted(share, middle[:, None] * part, part / precision[:, None]), jnp.sum(total)

    def one(sites: Sites, at: QuadratureNodes) -> tuple[Sites, Any]:
        def renew(state: tuple[Sites, jax.Array, jax.Array]) -> tuple[Sites, jax.Array, jax.Array]:
            sites, _, turn = state
            mean, covariance, _, _ = solve(sites)
            precision, middle = cavity(mean, covariance, sites)
            marginal, _ = tilt(precision, middle, at)
            share = jnp.exp(marginal.log_share)
            centre = jnp.sum(share * marginal.mean, 1)
            spread = jnp.sum(share * (marginal.variance + marginal.mean**2), 1) - centre**2
            spread = jnp.maximum(spread, 1e-300)
            tau = jnp.maximum(1.0 / spread - precision, LEAST)
            nu = centre * (precision + tau) - middle * precision
            off = jnp.max(jnp.abs(centre - mean[learnt]) / jnp.sqrt(jnp.diagonal(covariance)[learnt]))
            mixed = [DAMPING * new + (1 - DAMPING) * old for new, old in zip((tau, nu), sites, strict=True)]
            return Sites(*mixed), off, turn + 1

        def on(state: tuple[Sites, jax.Array, jax.Array]) -> jax.Array:
            return (state[1] > CLOSE) & (state[2] < ROUNDS)

        sites, off, _ = jax.lax.while_loop(on, renew, (sites, jnp.full((), jnp.inf), jnp.zeros((), int)))
        mean, covariance, logdet, pull = solve(sites)
        precision, middle = cavity(mean, covariance, sites)
        marginal, total = tilt(precision, middle, at)
        both = precision + sites.tau
        matched = 0.5 * (
            jnp.log(precision / both) + (middle * precision + sites.nu) ** 2 / both - middle**2 * precision
        )
        evidence = total - jnp.sum(matched) + 0.5 * (pull @ mean - logdet) + at.log_prior
        return sites, (mean, covariance, marginal, evidence, off)

    first = Sites(jnp.ones(len(form.hierarchy.learnt)), jnp.zeros(len(form.hierarchy.learnt)))
    _, (means, covariances, marginals, evidence, offs) = jax.lax.scan(one, first, nodes)
    share = jax.nn.softmax(jnp.where(jnp.isfinite(evidence), evidence, -jnp.inf))
    mean = share @ means
    off = means - mean[None]
    covariance = jnp.tensordot(share, covariances, 1) + off.T @ (share[:, None] * off)
    alpha = 1.0 / jnp.maximum(nodes.variance, 1e-12)
    by_node = jnp.sum(jnp.exp(marginals.log_share) * (1.0 - alpha[:, None] * marginals.variance), 2)
    gamma = (1.0 - held * jnp.diagonal(covariance)).at[learnt].set(share @ by_node)
    z = _draws(form, mean, covariance, marginals, share, key, count)
    settled = jnp.sum(jnp.where(offs < MOVED, share, 0.0)) > 0.5
    return Propagated(mean, covariance, jnp.clip(gamma, 0.0, 1.0), z, settled)


def _draws(
    form: Form, mean: jax.Array, covariance: jax.Array, marginals: Tilted, share: jax.Array, key: jax.Array, count: int
) -> jax.Array:
    """Draws (D, M) that have the marginals, ordered as draws of the covariance are (Iman and Conover 1982)."""
    keys = jax.random.split(key, 4)
    learnt = jnp.asarray(form.hierarchy.learnt, int)
    normal = mean[None] + jax.random.normal(keys[0], (count, len(mean))) @ linalg.factor(covariance).T
    node = jax.random.categorical(keys[1], jnp.log(share), shape=(count,))

    def one(pair: tuple[jax.Array, jax.Array]) -> jax.Array:
        k, own = pair
        at = jax.tree.map(lambda leaf: leaf[k], marginals)
        split = jax.random.split(own)
        pick = jax.random.categorical(split[0], at.log_share, axis=1)
        centre, variance = (jnp.take_along_axis(leaf, pick[:, None], 1)[:, 0] for leaf in (at.mean, at.variance))
        return centre + jnp.sqrt(variance) * jax.random.normal(split[1], centre.shape)

    alone = jax.lax.map(one, (node, jax.random.split(keys[2], count)))
    rank = jnp.argsort(jnp.argsort(normal[:, learnt], 0), 0)
    return normal.at[:, learnt].set(jnp.take_along_axis(jnp.sort(alone, 0), rank, 0))


def nodes_of(form: Form) -> QuadratureNodes:
    """The nodes of a hierarchy as arrays on the device."""
    return jax.tree.map(jnp.asarray, QuadratureNodes(*(np.asarray(part, float) for part in form.hierarchy.nodes())))
