"""What a scan says of one Gaussian: its rows seen from a state, the state after each, and objects not seen before.

Trackers of objects without names share these (Bernoulli tracks, intensities).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from probcal import linalg
from probcal.association.scan import Scan, View, Watch, detected
from probcal.model.model import Model

STEPS = 10  # of the search for the state that explains one detection
TINY = 1e-30


class Chances(NamedTuple):
    """Of objects: undetected ones at the start, new ones and their lifetime in s."""

    undetected: jax.Array  # () mean number at the first scan
    births: jax.Array  # () mean number a second
    lifetime: jax.Array  # () mean, in s


class Biases(NamedTuple):
    """Biases and noise levels at which scans are read, and how uncertain the biases are."""

    z: jax.Array  # (M,)
    covariance: jax.Array  # (M, M)
    levels: jax.Array  # (H,)


class SlotRows(NamedTuple):
    """Every slot of a scan seen from one state: log density at it, score and information by the state."""

    log_density: jax.Array  # (D,)
    score: jax.Array  # (D, n)
    information: jax.Array  # (D, n, n)


def rows_from(model: Model, scan: Scan, x: jax.Array, at: Biases) -> SlotRows:
    """Every slot seen from a state, with what the uncertainty of the biases adds to the noise of each channel."""
    lins = model.linearise_at(scan.epoch, (x[None],), at.z, at.levels)
    told = model.log_likelihood_at(scan.epoch, (x[None],), at.z, at.levels)
    whole = jnp.pad(at.covariance, (0, 1))
    density, score, information = [], [], []
    for lin, part, data, seen in zip(lins, told, model.rows, scan.epoch.rows, strict=True):
        own = data.bias[seen.sensor]  # (D, p)
        wide = jnp.einsum("dcp,dpq,dcq->dc", lin.bias, whole[own[:, :, None], own[:, None, :]], lin.bias)
        there = lin.weight > 0
        share = 1.0 / (1.0 + lin.weight * wide)  # of the information that is left
        off = jnp.where(there, lin.score**2 / jnp.where(there, lin.weight, 1.0), 0.0)
        density.append(jnp.sum(part + 0.5 * off * (1.0 - share) + 0.5 * jnp.log(share), 1))
        score.append(jnp.einsum("dc,dcn->dn", lin.score * share, lin.state))
        information.append(jnp.einsum("dcm,dc,dcn->dmn", lin.state, lin.weight * share, lin.state))
    return SlotRows(*(jnp.concatenate(parts) for parts in (density, score, information)))


def updated(rows: SlotRows, mean: jax.Array, covariance: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Log evidence (D,) of every slot under a Gaussian state, and the state's mean (D, n) and covariance after it.

    The extended update in information form, which takes rows with missing channels and any noise family.
    """
    n = len(mean)
    root = linalg.factor(covariance)
    half = jnp.eye(n)[None] + jnp.einsum("mi,dmk,kj->dij", root, rows.information, root)
    lower = linalg.semi_cholesky(half)
    pull = jnp.einsum("mi,dm->di", root, rows.score)
    alone = linalg.forward(lower, pull[:, :, None])[:, :, 0]
    logdet = 2.0 * jnp.sum(jnp.log(jnp.diagonal(lower, axis1=1, axis2=2)), 1)
    # at the linearised optimum: density at the mean, plus half the squared pull, less the volume
    evidence = rows.log_density + 0.5 * jnp.sum(alone**2, 1) - 0.5 * logdet
    inverse = jax.vmap(lambda w: linalg.inverse_and_logdet(w)[0])(half)
    moved = mean[None] + jnp.einsum("ni,dij,dj->dn", root, inverse, pull)
    spread = jnp.einsum("ni,dij,mj->dnm", root, inverse, root)
    return evidence, moved, spread


def births(
    watch: Watch, scan: Scan, views: tuple[View, ...], cloud: jax.Array, known: Biases
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Log evidence (D,), mean and covariance of an object never seen before behind each slot, and the share in view.

    The best of a cloud of states (G, n), whitened, is where a damped Gauss-Newton search begins; the start of the
    motion is its prior, and the evidence is Laplace's.
    """
    model, n = watch.model, len(watch.mean)

    def at(u: jax.Array) -> jax.Array:
        return watch.mean + watch.root @ u

    seen = jax.vmap(lambda u: detected(model, scan, views, at(u), known.z))(cloud)

    def density(u: jax.Array) -> jax.Array:
        return rows_from(model, scan, at(u), known).log_density

    told = jax.vmap(density)(cloud)  # (G, D)
    best = cloud[jnp.argmax(told - 0.5 * jnp.sum(cloud**2, 1)[:, None], 0)]

    def of(slot: jax.Array, u: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        def value(u: jax.Array) -> jax.Array:
            return density(u)[slot] - 0.5 * jnp.sum(u**2)

        def slopes(u: jax.Array) -> tuple[jax.Array, jax.Array]:
            rows = rows_from(model, scan, at(u), known)
            W = jnp.eye(n) + watch.root.T @ rows.information[slot] @ watch.root
            return watch.root.T @ rows.score[slot] - u, W

        def go(_: int, state: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array, jax.Array]:
            u, f, damping = state
            g, W = slopes(u)
            tried = u + linalg.solve_positive(W + damping * jnp.diag(jnp.diagonal(W)), g)
            new = value(tried)
            better = new >= f
            return (
                jnp.where(better, tried, u), jnp.where(better, new, f),
                jnp.where(better, 0.1 * damping, jnp.maximum(10.0 * damping, 1e-2)),
            )  # fmt: skip

        u, f, _ = jax.lax.fori_loop(0, STEPS, go, (u, value(u), jnp.zeros(())))
        inverse, logdet = linalg.inverse_and_logdet(slopes(u)[1])
        return f - 0.5 * logdet, at(u), watch.root @ inverse @ watch.root.T

    evidence, mean, covariance = jax.vmap(of)(jnp.arange(told.shape[1]), best)
    probability = jax.vmap(lambda x: detected(model, scan, views, x, known.z))(mean)
    return evidence + jnp.log(jnp.maximum(probability, TINY)), mean, covariance, jnp.mean(seen)
