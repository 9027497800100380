"""The search of a mode: one rule for the length of a step, one for its damping, one for the end.

`search_step` is a quasi-Newton step of the biases on an objective; `climb_on_host` and
`climb_traced` repeat it. `halved` shortens a step inside a compiled search whose values cost little.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from probcal.linalg import invert, library

HALVINGS = 12  # lengths of a step that are tried, each half of the one before, the last 0
KEPT = 8  # secants
# share of the promised rise that a step must bring: half a step does along what motion noise fixes
ENOUGH = 0.1
LEAST_CURVED = 0.05  # share of its curvature so far that a secant must show
LEAST_DAMPED = 0.25  # part of a damped step that is tried at least: more damping shortens it too
SHORT = 0.5  # part of a step from which the damping falls again
DAMPING = 1e10  # damping at which a search gives up
ROUNDING = 1e-12  # of the density: what a step that promises less cannot show
SMALL = 1e-9  # of the density: what no part of a step that promises less can show
# nats (0.014 sd) that a slope may promise in vain: tracks that settle slowly leave that uncertain
NOTHING = 1e-4


quiet = np.errstate(over="ignore", invalid="ignore")  # of the host: a number that is not finite is no better one


class Objective(Protocol):
    """A negative log density of the biases, by expansions at points; these have a `point`."""

    def expand(self, point: Any) -> Any:
        """The expansion at a point, its tracks settled first."""

    def moved(self, at: Any, dz: Any) -> Any:
        """The point with the biases moved by dz (M,)."""

    def value(self, at: Any) -> Any:
        """The negative log density."""

    def slope(self, at: Any) -> Any:
        """Slope (M,) of the log density."""

    def solve(self, at: Any, right: Any, damping: Any) -> Any:
        """The inverse of precision + damping, times right (M,); not finite where there is none."""


class Search(NamedTuple):
    """The state of a search."""

    at: Any  # the best expansion so far
    value: Any  # negative log density there
    begun: Any  # that at the start
    slope: Any  # (M,) of the log density there
    moves: Any  # (K, M) steps of the secants, the last ones taken, zeros of none
    changes: Any  # (K, M) by how much the slope fell along each
    step: Any  # (M,) the step that is being tried
    promised: Any  # the rise that the whole of it promises
    share: Any  # the part of it that is tried, 1, 1/2, ...
    damping: Any
    taken: Any  # number of points that were better, the start with them
    count: Any  # number of directions
    converged: Any
    done: Any

    @classmethod
    def begin(cls, at: Any, biases: int) -> "Search":
        """The state before the first look, `at` an expansion of any numbers."""
        zero, none, pairs = np.zeros(()), np.zeros(biases), np.zeros((KEPT, biases))
        no, count = np.zeros((), bool), np.zeros((), int)
        return cls(at, zero, zero, none, pairs, pairs, none, zero, np.ones(()), zero, count, count, no, no)


def search_step(objective: Objective, s: Search, at: Any, tolerance: Any) -> Search:
    """The search after a look at an expansion: a direction from there, or a shorter or more damped
    step."""
    value = objective.value(at)
    better = (s.value - value >= ENOUGH * s.share * s.promised) & (value <= s.value)
    s = branch(better | (s.taken == 0), partial(_taken, objective), _refused, s, at, value)
    return branch((s.share == 1) & ~s.done, partial(_directed, objective, tolerance), lambda s: s, s)


@quiet
def climb_on_host(
    objective: Objective, start: Any, biases: int, iterations: int, tolerance: float,
    told: Callable[[int, float], bool] | None = None, search: Search | None = None,
) -> tuple[Search, np.ndarray, np.ndarray]:  # fmt: skip
    """Search from a start until a step promises less than the tolerance.

    Returns the search, and log density and biases at the start and after every step. It ends too
    where `told`, called with the number of steps and the log density, says so; the `search` that
    was stopped goes on from there.
    """
    s = Search.begin(None, biases) if search is None else search
    trace, places = list[float](), list[np.ndarray]()
    while True:
        at = objective.expand(objective.moved(s.at, s.share * s.step) if s.taken else start)
        before, s = s.taken, search_step(objective, s._replace(at=s.at if s.taken else at), at, tolerance)
        if s.taken > before:
            trace.append(-float(s.value))
            places.append(np.asarray(s.at.point.z))
            if told is not None and s.taken > 1 and told(int(s.taken) - 1, trace[-1]):
                break
        if s.done or s.count > iterations:
            break
    return s, np.array(trace), np.array(places).reshape(-1, biases)


def climb_traced(objective: Objective, start: Any, biases: int, iterations: int, tolerance: Any) -> Search:
    """The same inside a compiled function; expansions are pytrees."""

    def body(s: Search) -> Search:
        moved = objective.moved(s.at, s.share * s.step)
        point = jax.tree.map(lambda new, old: jnp.where(s.taken == 0, old, new), moved, start)
        return search_step(objective, s, objective.expand(point), tolerance)

    return jax.lax.while_loop(
        lambda s: ~s.done & (s.count <= iterations), body, Search.begin(zeros_from(objective.expand, start), biases)
    )


def damped_on(damping: Any, share: Any) -> Any:
    """The damping after a step of which a part was taken, 0 where none was."""
    xp = library(damping, share)
    damping = xp.where(share >= SHORT, 0.1 * damping, grown(damping))
    return xp.where(damping < 1e-6, 0.0, damping)


def grown(damping: Any) -> Any:
    """More damping."""
    return library(damping).maximum(10.0 * damping, 1e-3)


def branch(condition: Any, yes: Callable[..., Any], no: Callable[..., Any], *given: Any) -> Any:
    """One branch or the other, by a `cond` where the condition is traced."""
    if library(condition) is np:
        return (yes if condition else no)(*given)
    return jax.lax.cond(condition, yes, no, *given)


def looped(on: Callable[[Any], Any], step: Callable[[Any], Any], state: Any) -> Any:
    """The state after steps while it is to go on, by a `while_loop` where it is traced.

    The host calls kernels that other parts of a fit use too.
    """
    if library(*jax.tree.leaves(state)) is not np:
        return jax.lax.while_loop(on, step, state)
    while on(state):
        state = step(state)
    return state


def _taken(objective: Objective, s: Search, at: Any, value: Any) -> Search:
    """The search at a better point, without a direction."""
    xp, slope = library(s.share), objective.slope(at)
    move, change = xp.asarray(at.point.z) - xp.asarray(s.at.point.z), s.slope - slope
    before = s.share * (move @ s.slope) - s.damping * (move @ move)  # of the curvature so far, along the move
    curved = (s.taken > 0) & (move @ change > LEAST_CURVED * xp.maximum(before, 0.0))
    moves, changes = (
        xp.where(curved, xp.concatenate([kept[1:], own[None]]), kept)
        for kept, own in ((s.moves, move), (s.changes, change))
    )
    return s._replace(
        at=at, value=value, begun=xp.where(s.taken == 0, value, s.begun), slope=slope, moves=moves, changes=changes,
        share=xp.ones(()), damping=damped_on(s.damping, s.share), taken=s.taken + 1,
    )  # fmt: skip


def _refused(s: Search, *_: Any) -> Search:
    """The search with half the step, or more damping where that was tried often enough, soon where it
    is damped.

    A step that promised less than the rounding of the density, and shows nothing, is the end; one that promised
    `NOTHING` is where no part of it shows anything.
    """
    xp = library(s.share)
    spent = s.share <= xp.where(s.damping > 0, LEAST_DAMPED, 2.0 * 0.5**HALVINGS)
    shown = xp.where(spent, xp.maximum(NOTHING, SMALL * abs(s.value)), ROUNDING * abs(s.value))
    found = (s.promised <= shown) & (s.damping <= 1.0)
    damping = xp.where(spent, grown(s.damping), s.damping)
    share = xp.where(spent, 1.0, 0.5 * s.share)
    return s._replace(share=share, damping=damping, converged=found, done=found | (damping > DAMPING))


def _directed(objective: Objective, tolerance: Any, s: Search) -> Search:
    """The search with a direction: damping grows until the precision is positive definite."""
    xp = library(s.share)

    def more(state: Any) -> Any:
        damping = xp.where(state[2], s.damping, grown(state[1]))
        step = _direction(objective, s, damping)
        return step, damping, xp.zeros((), bool)

    def lacking(state: Any) -> Any:
        step, damping, fresh = state
        return fresh | (~(xp.isfinite(step).all() & (s.slope @ step >= 0)) & (damping <= DAMPING))

    step, damping, _ = looped(lacking, more, (s.step, s.damping, xp.ones((), bool)))
    promised = 0.5 * s.slope @ step
    converged = (promised <= tolerance) & (damping <= 1.0) & xp.isfinite(s.value)
    return s._replace(
        step=step, promised=promised, damping=damping, count=s.count + 1, converged=converged,
        done=converged | ~xp.isfinite(s.value + promised),
    )  # fmt: skip


def _direction(objective: Objective, s: Search, damping: Any) -> Any:
    """The step (M,) of L-BFGS around a solve (Nocedal, Wright 2006, algorithm 7.4).

    Its two loops are solves with a triangular matrix of the secants. Damping is a curvature of its
    own, so secants have it too.
    """
    xp, changes = library(s.share), s.changes + damping * s.moves
    both = xp.triu(s.moves @ changes.T)
    own = xp.diagonal(both)
    inverse = invert(both + xp.diag(xp.where(own > 0, 0.0, 1.0)))
    share = inverse @ (s.moves @ s.slope)
    step = objective.solve(s.at, s.slope - share @ changes, damping)
    return step + (inverse.T @ (own * share - changes @ step)) @ s.moves


def zeros_from(function: Callable[..., Any], *given: Any) -> Any:
    """Zeros in the form of what a function gives, with which a traced loop begins."""
    return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(function, *given))


def halved(value: Callable[[Any], tuple[Any, Any]], bound: Any) -> tuple[Any, Any, Any]:
    """Halve a step until its value does not exceed the bound; `value` gives it for a fraction, and the point there.

    The bound is an array; each entry has a step length of its own. Returns the fractions of the
    step, 0 where none would do, their values, and the point.
    """
    xp = library(bound)

    def shorter(state: Any) -> Any:
        share, before, tries, _ = state
        share = xp.where((tries == 0) | (before <= bound), share, xp.where(tries < HALVINGS - 1, 0.5 * share, 0.0))
        found, point = value(share)
        return share, xp.asarray(found), tries + 1, point

    def worse(state: Any) -> Any:
        return (state[2] == 0) | ((~(state[1] <= bound)).any() & (state[2] < HALVINGS))

    one = xp.ones_like(bound)
    share, found, _, point = looped(
        worse, shorter, (one, bound, np.zeros((), int), None if xp is np else zeros_from(value, one)[1])
    )
    return share, found, point


def between(a: Any, b: Any, share: Any) -> Any:
    """The pytree a + share (b - a), a itself where the share is 0, whatever b is."""
    return jax.tree.map(lambda p, q: jnp.where(share == 0, p, p + share * (q - p)), a, b)


def chosen(first: jax.Array, one: Any, other: Any) -> Any:
    """One pytree or the other."""
    if library(first) is np:
        return one if first else other
    return jax.tree.map(lambda a, b: jnp.where(first, a, b), one, other)
