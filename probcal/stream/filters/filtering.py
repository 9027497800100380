"""The filter epoch by epoch: what an epoch makes of a belief, and what it leaves for the smoother."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from probcal.model.epochs import Epoch
from probcal.model.model import Model
from probcal.model.sigma import cubature, unscented
from probcal.stream.filters.belief import (
    Augmented,
    KeptDatum,
    Slots,
    WhiteRow,
    moved_on,
    not_estimated,
    one,
    put,
    seen,
    walked,
)
from probcal.stream.filters.linearising import About, centre, linearised, regressed

RULES = {"extended": None, "unscented": unscented, "cubature": cubature}  # names of the linearisations


@dataclass(frozen=True)
class FilterForm:
    """The static part: what kernels are compiled for."""

    by: str = "extended"
    walks: bool = False  # whether some biases walk
    considers: bool = False  # whether some are not estimated
    plain: bool = False  # whether points are known of states alone: rows are linearised at the biases of the belief
    odds: float = 0.0  # probability of a datum that the model holds back


class FilterGiven(NamedTuple):
    """The quantities that stay the same over a stream."""

    levels: jax.Array  # (H,) log factors of the noise levels
    walk: jax.Array  # (M,) standard deviation of the step of each bias over a second
    considered: jax.Array  # (M,) whether a bias is not estimated


class RowPoints(NamedTuple):
    """The points at which the rows of epochs are linearised; if none, the belief is used."""

    x: tuple[jax.Array, ...]  # (n,) of each recursion
    z: jax.Array  # (M,)
    there: jax.Array  # ()
    verdict: tuple[jax.Array, ...]  # (D,) of the data of each recursion: DECIDE, ADMIT or HOLD


class EpochStep(NamedTuple):
    """The results of one epoch per recursion; all zero if the epoch belongs to another."""

    x: tuple[jax.Array, ...]  # (n,) filtered mean of its target
    sd: tuple[jax.Array, ...]  # (n,)
    after: tuple[Slots, ...]  # its target after the rows of this epoch
    kept: tuple[KeptDatum, ...]  # (D,) of each of its data, one block after another


def epoch_step(
    form: FilterForm,
    model: Model,
    given: FilterGiven,
    belief: Augmented,
    epoch: Epoch,
    elapsed: jax.Array,
    points: RowPoints,
) -> tuple[Augmented, EpochStep]:
    """Belief after an epoch, `elapsed` s after the one before; one that pads a stack (recursion -1) changes nothing."""
    if form.walks:
        std = given.walk * jnp.sqrt(jnp.maximum(elapsed, 0.0))
        belief = jax.lax.cond(elapsed > 0, lambda b: walked(b, std), lambda b: b, belief)
    parts = []
    for r in range(len(belief.slots)):

        def own(b: Augmented, r: int = r) -> tuple[Augmented, Any]:
            return _epoch(form, model, given, b, epoch, r, points)

        belief, part = either(epoch.recursion == r, own, belief)
        parts.append(part)
    return belief, EpochStep(*(tuple(column) for column in zip(*parts, strict=True)))


def either(there: jax.Array, function: Any, belief: Any) -> tuple[Any, Any]:
    """Applies a function to a belief if it is to be called, else returns the belief and zeros."""
    shapes = jax.eval_shape(lambda b: function(b)[1], belief)
    nothing = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)
    return jax.lax.cond(there, function, lambda b: (b, nothing), belief)


def _epoch(
    form: FilterForm, model: Model, given: FilterGiven, belief: Augmented, epoch: Epoch, r: int, points: RowPoints
) -> tuple[Augmented, tuple[jax.Array, jax.Array, Slots, KeptDatum]]:
    """An epoch of recursion r."""
    target, rule = epoch.target[r], RULES[form.by]
    before = moved_on(one(belief.slots[r], target), epoch.move[r])
    middle = centre(belief, before)
    z = middle.z if form.plain else jnp.where(points.there, points.z, middle.z)
    at = About(jnp.where(points.there, points.x[r], middle.x), z)

    def by_derivatives() -> list[WhiteRow]:
        return linearised(model, epoch, r, at, given.levels, form.odds)

    blocks = by_derivatives() if rule is None else jax.lax.cond(
        points.there, by_derivatives, lambda: regressed(model, epoch, r, belief, before, given.levels, rule, form.odds)
    )  # fmt: skip
    rows = jax.tree.map(lambda *parts: jnp.concatenate(parts), *blocks)._replace(verdict=points.verdict[r])
    if form.considers:
        belief, kept = _considering(given, _with(belief, r, target, before), rows, r, target)
        mine = one(belief.slots[r], target)
    else:

        def use(carry: tuple[Augmented, Slots], row: WhiteRow) -> tuple[tuple[Augmented, Slots], KeptDatum]:
            after, own, kept = seen(*carry, row)
            return (after, own), kept

        (core, mine), kept = _scanned(use, (belief._replace(slots=()), before), rows)
        belief = _with(core._replace(slots=belief.slots), r, target, mine)
    reach = mine.B @ belief.root
    sd = jnp.sqrt(jnp.sum(mine.R**2, 1) + jnp.sum(reach**2, 1))
    lead, slope = rows.leading()
    kept = kept._replace(lead=lead, slope=slope)
    return belief, (mine.m + mine.B @ belief.mean, sd, mine._replace(shift=mine.shift[:, :0]), kept)


def _scanned(use: Any, carry: Any, rows: WhiteRow) -> tuple[Any, KeptDatum]:
    """Updates a carry by the data of an epoch, one after another; missing data change nothing."""

    def each(carry: Any, row: WhiteRow) -> tuple[Any, KeptDatum]:
        return either(jnp.any(row.hx != 0) | jnp.any(row.hz != 0), lambda old: use(old, row), carry)

    return jax.lax.scan(each, carry, rows)


def _considering(
    given: FilterGiven, belief: Augmented, rows: WhiteRow, r: int, target: jax.Array
) -> tuple[Augmented, KeptDatum]:
    """The belief after the data of an epoch where some biases are not estimated: it touches every target."""

    def use(b: Augmented, row: WhiteRow) -> tuple[Augmented, KeptDatum]:
        after, mine, kept = seen(b, one(b.slots[r], target), row)
        return not_estimated(_with(after, r, target, mine), kept, given.considered), kept

    return _scanned(use, belief, rows)


def _with(belief: Augmented, r: int, target: jax.Array, own: Slots) -> Augmented:
    slots = tuple(put(s, target, own) if k == r else s for k, s in enumerate(belief.slots))
    return belief._replace(slots=slots)


def window_evidence(kept: tuple[KeptDatum, ...]) -> jax.Array:
    """Log density of all data given those before, up to the constants of their noises."""
    total = jnp.zeros(())
    for own in kept:
        used = own.variance > 0
        total -= 0.5 * jnp.sum(jnp.where(used, own.innovation**2 + jnp.log(jnp.where(used, own.variance, 1.0)), 0.0))
    return total
