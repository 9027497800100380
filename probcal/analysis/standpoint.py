"""The points where information is taken: the automatic start, a truth, or draws from the motion."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from probcal.errors import InputError, check_known
from probcal.gaussian import recursion as rec
from probcal.gaussian.choose import choose
from probcal.gaussian.mode import Point, factors
from probcal.model.trajectories import States
from probcal.modes import automatic_start
from probcal.modes.grid import grid_start, track_mode
from probcal.problem import Problem, check_linear
from probcal.simulate import Truth, on_tracks
from probcal.types import float64


def check_free(problem: Problem) -> None:
    """Raise `InputError` for a problem without free biases, or of a motion without linear form."""
    check_linear(problem)
    if not problem.labels:
        raise InputError("every bias of the problem is fixed or none is declared; free one of them")


@float64
def standpoint(problem: Problem, point: Point | None, truth: Truth | None) -> Point:
    """The point where a problem is looked at: a given one, that of a truth, else the automatic start."""
    if point is not None or truth is None:
        if point is None and not choose(problem.model).cheap:
            return grid_start(problem)
        return automatic_start(problem) if point is None else point
    z, states = true_point(problem, truth)
    one = tuple(x[0] for x in states)
    return Point(one, tuple(jnp.zeros_like(x) for x in one), z[0], jnp.zeros(len(problem.levels)))


def true_biases(problem: Problem, truth: Truth) -> jax.Array:
    """True biases z (M,), 0 where the truth is silent."""
    for label in truth.biases:
        check_known(label, problem.network.labels, f'the truth names the bias "{label}", which the network lacks')
    return jnp.asarray([truth.biases.get(b.label, 0.0) / b.scale for b in problem.biases], float)


def true_point(problem: Problem, truth: Truth | None) -> tuple[jax.Array, States]:
    """The point of a truth: z (1, M) and states (1, E, n); where it says nothing of a target, the automatic start."""
    given = Truth() if truth is None else truth
    z, states = true_biases(problem, given), draw_states(problem, 1, None)
    missing = [np.isnan(true).all(1) for true in true_states(problem, given)]
    if any(gone.any() for gone in missing):
        start = standpoint(problem, None, None)
        start = start if truth is None else track_mode(problem, start._replace(z=z))
        z = start.z
        states = problem.model.each(
            lambda _, gone, found, mean: jnp.where(gone[None, :, None], found[None], mean),
            missing,
            start.states,
            states,
        )
    return z[None], on_tracks_of(problem, given, states)


def draw_states(problem: Problem, count: int, key: jax.Array | None) -> States:
    """Trajectories (D, E, n) of each recursion drawn from the motion, or its means where there is no key."""
    check_linear(problem)
    found = []
    for r, part in enumerate(problem.model.recursions):
        shape = (*part.drift.shape, count)
        noise = jnp.zeros(shape) if key is None else problem.model.draw_noises(key, r, count)
        L = factors(part, jnp.zeros(len(problem.levels)))
        found.append(jnp.moveaxis(rec.trajectory(part.F, L, part.drift[:, :, None], noise), 2, 0))
    return tuple(found)


def true_states(problem: Problem, truth: Truth) -> list[np.ndarray]:
    """The states (E, n) of each recursion from the true tracks, else NaN; whole targets only."""
    truth.check_targets(problem.measurements.target_names)
    found = []
    for epochs in problem.epochs:
        known = np.isfinite(truth.positions(epochs.time, epochs.target, problem.network.dimension)).all(1)
        frames = {}
        for name, mine in epochs.members.items():
            track = truth.track(name, epochs.time[mine])
            if track is None:
                continue
            if not known[mine].all():
                gap = epochs.time[mine][~known[mine]][0]
                raise InputError(f'the true track of "{name}" does not reach time {gap:g}; extend it or drop the rows')
            frames[name] = track
        found.append(on_tracks(epochs, np.full((len(known), len(epochs.components)), np.nan), frames))
    return found


def on_tracks_of(problem: Problem, truth: Truth, states: Sequence[jax.Array]) -> States:
    """Trajectories (D, E, n) with the true tracks put over them."""
    return tuple(
        jnp.where(np.isfinite(true)[None], np.nan_to_num(true)[None], x)
        for true, x in zip(true_states(problem, truth), states, strict=True)
    )
