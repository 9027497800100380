"""A window of epochs that is linearised again until it rests, and its smoothed states: fixed-lag smoothing.

Forward the filter, backward the smoother of Bryson and Frazier in the form that needs no inverse of a covariance
(Bierman 1977, X): given the biases each target is smoothed alone, in the dimension of its state. Over a window that
holds all epochs this is Gauss-Newton on the joint density of states and biases, so that the filter ends where the
batch fit does.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from probcal.model.epochs import Epoch
from probcal.model.model import Model
from probcal.stream.filters.belief import ADMIT, DECIDE, HOLD, Augmented, KeptDatum
from probcal.stream.filters.filtering import EpochStep, FilterForm, FilterGiven, RowPoints, epoch_step, window_evidence

HALVE = 6  # passes after which a point goes half of its way only
FIRM = 4  # passes after which the data that are held back stay the same


class Window(NamedTuple):
    """Epochs of a window (W leading, those that pad it last), the seconds before each, and points that are known."""

    epochs: Epoch
    elapsed: jax.Array  # (W,)
    points: RowPoints  # (W,) leading


class SmoothedStates(NamedTuple):
    """States of a window given all of its rows."""

    x: tuple[jax.Array, ...]  # (W, n) of each recursion
    sd: tuple[jax.Array, ...]  # (W, n)


class WindowPass(NamedTuple):
    """The results of a window."""

    beliefs: Augmented  # at the end of each segment, leading
    smoothed: SmoothedStates
    points: RowPoints  # (W,) leading: where the rows were linearised
    data: tuple[KeptDatum, ...]  # (W, D) of each recursion, without their arrays
    log_evidence: jax.Array  # (S,) of each segment
    passes: jax.Array  # ()
    moved: jax.Array  # () by how many sd a point moved in the last pass


def run_forward(
    form: FilterForm, model: Model, given: FilterGiven, belief: Augmented, window: Window, segments: int
) -> tuple[Augmented, EpochStep]:
    """Beliefs at the end of each segment (S leading) and what each epoch leaves (W leading)."""

    def one(b: Augmented, inputs: tuple) -> tuple[Augmented, EpochStep]:
        return epoch_step(form, model, given, b, *inputs)

    def segment(b: Augmented, inputs: tuple) -> tuple[Augmented, tuple[Augmented, EpochStep]]:
        after, left = jax.lax.scan(one, b, inputs)
        return after, (after, left)

    W = window.elapsed.shape[0]
    parts = jax.tree.map(lambda leaf: leaf.reshape(segments, W // segments, *leaf.shape[1:]), tuple(window))
    _, (beliefs, left) = jax.lax.scan(segment, belief, parts)
    return beliefs, jax.tree.map(lambda leaf: leaf.reshape(W, *leaf.shape[2:]), left)


def without_arrays(kept: KeptDatum) -> KeptDatum:
    """Data without the arrays that only the smoother needs."""
    return kept._replace(hx=kept.hx[..., :0], gain=kept.gain[..., :0], g=kept.g[..., :0], moved=kept.moved[..., :0])


def last(beliefs: Augmented) -> Augmented:
    """The belief at the end of the last segment."""
    return jax.tree.map(lambda leaf: leaf[-1], beliefs)


def smooth_window(window: Window, steps: EpochStep, end: Augmented) -> SmoothedStates:
    """States given all rows of a window, the biases as they stand at its end."""
    xs: list[jax.Array] = []
    sds: list[jax.Array] = []
    for r, slots in enumerate(end.slots):
        T, n, M = slots.B.shape

        def back(carry: tuple, inputs: tuple, r: int = r) -> tuple:
            epoch, after, kept = inputs
            adjoint, weight = carry
            target, mine = epoch.target[r], epoch.recursion == r
            lam, big = adjoint[target], weight[target]  # (n, 1 + M), (n, n) of the rows that come later
            P = after.R @ after.R.T
            line = jnp.concatenate([after.m[:, None], after.B], 1) - P @ lam
            x = line[:, 0] + line[:, 1:] @ end.mean
            own = jnp.maximum(jnp.diagonal(P - P @ big @ P), 0.0)
            sd = jnp.sqrt(own + jnp.sum((line[:, 1:] @ end.root) ** 2, 1))

            def row(carry: tuple, own: tuple) -> tuple:
                lam, big = carry
                hx, gain, c, g = own
                lam = lam - hx[:, None] * (gain @ lam)[None, :]
                lam = lam + hx[:, None] * jnp.concatenate([-c[None], g])[None, :]
                turned = big - hx[:, None] * (gain @ big)[None, :]
                big = turned - (turned @ gain)[:, None] * hx[None, :] + hx[:, None] * hx[None, :]
                return (lam, big), None

            (lam, big), _ = jax.lax.scan(row, (lam, big), (kept.hx, kept.gain, kept.c, kept.g), reverse=True)
            F = epoch.move[r].F
            adjoint = jnp.where(mine, adjoint.at[target].set(F.T @ lam), adjoint)
            weight = jnp.where(mine, weight.at[target].set(F.T @ big @ F), weight)
            return (adjoint, weight), (jnp.where(mine, x, 0.0), jnp.where(mine, sd, 0.0))

        start = jnp.zeros((T, n, 1 + M)), jnp.zeros((T, n, n))
        x: jax.Array
        sd: jax.Array
        _, (x, sd) = jax.lax.scan(back, start, (window.epochs, steps.after[r], steps.kept[r]), reverse=True)
        xs.append(x)
        sds.append(sd)
    return SmoothedStates(tuple(xs), tuple(sds))


@partial(jax.jit, static_argnames=("form", "segments"))
def run_window(
    form: FilterForm,
    model: Model,
    given: FilterGiven,
    belief: Augmented,
    window: Window,
    most: int,
    tolerance: float,
    segments: int,
) -> WindowPass:
    """Filter and smooth a window, linearised again about what it found until no point moves by `tolerance` sd.

    At most `most` passes; with one the filter is the plain one, and nothing is linearised again.
    """
    there = window.epochs.recursion >= 0

    def passed(points: RowPoints) -> tuple[Augmented, EpochStep, SmoothedStates]:
        beliefs, steps = run_forward(form, model, given, belief, window._replace(points=points), segments)
        return beliefs, steps, smooth_window(window, steps, last(beliefs))

    def body(carry: tuple) -> tuple:
        k, points, _, _ = carry
        beliefs, steps, found = passed(points)
        firm = k + 1 >= FIRM
        verdict = tuple(
            jnp.where((before == DECIDE) & firm, jnp.where(kept.held, HOLD, ADMIT), before).astype(jnp.int8)
            for before, kept in zip(points.verdict, steps.kept, strict=True)
        )
        end = last(beliefs)
        spread = jnp.sqrt(jnp.sum(end.root**2, 1))
        share = jnp.where(k < HALVE, 1.0, 0.5)
        known = points.there
        off = end.mean[None, :] - points.z
        z = points.z + jnp.where(known[:, None], share, 1.0) * off
        moves = [jnp.max(jnp.where(known[:, None], jnp.abs(off) / spread[None, :], 0.0), initial=0.0)]
        xs = []
        for old, new, sd in zip(points.x, found.x, found.sd, strict=True):
            xs.append(jnp.where(known[:, None], old + share * (new - old), new))
            off = jnp.abs(new - old) / jnp.where(sd > 0, sd, 1.0)
            moves.append(jnp.max(jnp.where(known[:, None] & (sd > 0), off, 0.0), initial=0.0))
        fresh = jnp.any(there & ~known)
        moved = jnp.where(fresh, jnp.inf, jnp.max(jnp.stack(moves)))
        left = (beliefs, found, tuple(without_arrays(kept) for kept in steps.kept), _evidence(steps, segments))
        return k + 1, RowPoints(tuple(xs), z, there, verdict), moved, left

    shapes = jax.eval_shape(lambda points: body((0, points, 0.0, None))[3], window.points)
    nothing = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)
    first = (jnp.zeros((), int), window.points, jnp.full((), jnp.inf), nothing)
    count, points, moved, left = jax.lax.while_loop(lambda c: (c[0] < most) & (c[2] > tolerance), body, first)
    return WindowPass(left[0], left[1], points, left[2], left[3], count, moved)


def _evidence(steps: EpochStep, segments: int) -> jax.Array:
    W = steps.x[0].shape[0]
    parts = jax.tree.map(lambda leaf: leaf.reshape(segments, W // segments, *leaf.shape[1:]), steps.kept)
    return jax.vmap(window_evidence)(parts)


@partial(jax.jit, static_argnames="form")
def run_plain(
    form: FilterForm, model: Model, given: FilterGiven, belief: Augmented, window: Window
) -> tuple[Augmented, EpochStep, tuple[jax.Array, jax.Array]]:
    """The plain filter over a stack of epochs; of each epoch mean and sd of its target, its data, and the biases.

    The biases are means and variances (W, M).
    """

    def one(b: Augmented, inputs: tuple) -> tuple[Augmented, tuple[EpochStep, tuple[jax.Array, jax.Array]]]:
        after, left = epoch_step(form, model, given, b, *inputs)
        left = left._replace(after=(), kept=tuple(without_arrays(kept) for kept in left.kept))
        return after, (left, (after.mean, jnp.sum(after.root**2, 1)))

    end, (steps, biases) = jax.lax.scan(one, belief, tuple(window))
    return end, steps, biases
