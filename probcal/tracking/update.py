"""The update of one Gaussian by a scan: rows at a state, the state after each, and new objects.

Trackers of objects without names share these (Bernoulli tracks, intensities).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from probcal import linalg
from probcal.model import rows as waist
from probcal.model.epochs import Seen
from probcal.model.model import Model
from probcal.model.rows import Linearised, Rows
from probcal.tracking.scan import Scan, View, Watch, detected

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
    density, score, information = [], [], []
    for _, data, _, seen, lin, part in model.each_block(scan.epoch.rows, lins, told):
        wide = _biased(data, seen, lin, at)
        there = lin.weight > 0
        share = 1.0 / (1.0 + lin.weight * wide)  # of the information that is left
        off = jnp.where(there, lin.score**2 / jnp.where(there, lin.weight, 1.0), 0.0)
        density.append(jnp.sum(part + 0.5 * off * (1.0 - share) + 0.5 * jnp.log(share), 1))
        score.append(jnp.einsum("dc,dcn->dn", lin.score * share, lin.state))
        information.append(jnp.einsum("dcm,dc,dcn->dmn", lin.state, lin.weight * share, lin.state))
    return SlotRows(*(jnp.concatenate(parts) for parts in (density, score, information)))


def _biased(data: Rows, seen: Seen, lin: Linearised, at: Biases) -> jax.Array:
    """Variance (D, C) that the biases add to each channel of the slots of a block."""
    whole = jnp.pad(at.covariance, (0, 1))
    own = data.bias[seen.sensor]  # (D, p)
    return jnp.einsum("dcp,dpq,dcq->dc", lin.bias, whole[own[:, :, None], own[:, None, :]], lin.bias)


def updated(rows: SlotRows, mean: jax.Array, covariance: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Log evidence (D,) of every slot under a Gaussian state, and the state's mean (D, n) and covariance after it.

    The extended update in information form, which takes rows with missing channels and any noise family.
    """
    n = len(mean)
    root = linalg.factor_and_inverse(covariance)[0]
    half = jnp.eye(n)[None] + jnp.einsum("mi,dmk,kj->dij", root, rows.information, root)
    pull = jnp.einsum("mi,dm->di", root, rows.score)
    return _pulled(rows.log_density, half, pull, mean, root)


def _pulled(
    log_density: jax.Array, half: jax.Array, pull: jax.Array, mean: jax.Array, root: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Evidence, means and covariances by the score (D, n) and precision (D, n, n) of the state whitened by its root."""
    lower = linalg.semi_cholesky(half)
    alone = linalg.forward(lower, pull[:, :, None])[:, :, 0]
    logdet = 2.0 * jnp.sum(jnp.log(jnp.diagonal(lower, axis1=1, axis2=2)), 1)
    # at the linearised optimum: density at the mean, plus half the squared pull, less the volume
    evidence = log_density + 0.5 * jnp.sum(alone**2, 1) - 0.5 * logdet
    inverse = jax.vmap(lambda w: linalg.inverse_and_logdet(w)[0])(half)
    moved = mean[None] + jnp.einsum("ni,dij,dj->dn", root, inverse, pull)
    spread = jnp.einsum("ni,dij,mj->dnm", root, inverse, root)
    return evidence, moved, spread


def updated_by_points(
    model: Model, scan: Scan, mean: jax.Array, covariance: jax.Array, at: Biases
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """As `updated`, with the rows regressed on the state by the cubature rule of third degree.

    Means and covariances of the channels are those over 2 n points (Arasaratnam, Haykin 2009), differences of circular
    channels wrapped about the value predicted at the mean. A family that is not Gaussian counts by its density, its
    score and its expected information at the predicted mean, as in the extended update.
    """
    n = len(mean)
    root = linalg.factor_and_inverse(covariance)[0]
    away = jnp.sqrt(float(n)) * root.T
    points = jnp.concatenate([mean[None] + away, mean[None] - away])
    centres = model.predict_at(scan.epoch, (mean[None],), at.z)
    values = jax.vmap(lambda x: model.predict_at(scan.epoch, (x[None],), at.z))(points)
    lins = model.linearise_at(scan.epoch, (mean[None],), at.z, at.levels)  # its derivatives by the biases
    density, information, pull = [], [], []
    for block, data, _, seen, lin, centre, value in model.each_block(scan.epoch.rows, lins, centres, values):
        here = seen.rows_of(data)
        there = seen.mask > 0
        off = jnp.where(there[None], waist.difference(block, value, centre[None]), 0.0)  # (2 n, D, C)
        middle = jnp.mean(off, 0)
        slope = (off[:n] - off[n:]) / (2.0 * jnp.sqrt(float(n)))
        wide = off - middle[None]
        left = jnp.einsum("sdc,sde->dce", wide, wide) / (2 * n) - jnp.einsum("ndc,nde->dce", slope, slope)
        told = waist.log_likelihood(block, here, centre + middle, at.levels)
        score, weight = waist.weigh(block, here, centre + middle, at.levels, expected=True)
        known = there & (weight > 0)
        variance = jnp.where(known, 1.0 / jnp.where(known, weight, 1.0), 1.0)
        residual = jnp.where(known, score * variance, 0.0)
        pair = (known[:, :, None] & known[:, None, :]).astype(float)
        own = _biased(data, seen, lin, at)
        G = pair * left + jnp.eye(left.shape[1])[None] * (variance + jnp.where(known, own, 0.0))[:, :, None]
        white = jax.vmap(linalg.inverse_cholesky)(G)
        r = jnp.einsum("dce,de->dc", white, residual)
        A = jnp.einsum("dce,nde->dcn", white, slope * known[None])
        volume = jnp.log(jnp.diagonal(white, axis1=1, axis2=2)) + 0.5 * jnp.log(variance)
        density.append(jnp.sum(jnp.where(there, told, 0.0) + 0.5 * (residual**2 / variance - r**2) + volume, 1))
        information.append(jnp.einsum("dcm,dcn->dmn", A, A))
        pull.append(jnp.einsum("dcn,dc->dn", A, r))
    half = jnp.eye(n)[None] + jnp.concatenate(information)
    return _pulled(jnp.concatenate(density), half, jnp.concatenate(pull), mean, root)


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
