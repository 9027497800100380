"""First guess of the times of clocks: the lags at which the rows of each clock agree best with the others'."""

from collections.abc import Callable, Iterator

import numpy as np

from probcal.gaussian.choose import choose
from probcal.gaussian.draws import residuals
from probcal.gaussian.mode import Point
from probcal.modes.automatic import Optimum, polished
from probcal.modes.grid import follow_states, grid_start
from probcal.problem import Problem

SPAN = 4.0  # scales to either side within which the offset of a clock is looked for
MOST = 24  # lags to either side
EPOCHS = 800  # of a part of the recording in which lags are tried: more cost time and add little
STEPS = 5  # Gauss-Newton steps by which a lag is judged
GAIN = 3.0  # nats by which a lag must fit better
EXPLAINED = 2.0  # mean square of the standardised residuals of a clock above which its lags are tried
ROUNDS = 8  # of taking the rows where the mode puts them
CLOSE = 0.01  # of its scale: change of a clock that ends them


def first_times(problem: Problem, stopped: Callable[[], bool] = lambda: False) -> Problem:
    """The problem with its rows taken by clocks that the data tell, as they are stated where it is too large for that.

    In a part of the recording, the offset of the clock whose rows are explained worst is moved over a grid of lags as
    fine as the track turns, all biases following by a few joint steps; then that of the next. A drifting clock has a
    part around each of its steps.
    """
    problem = problem.retimed(problem.first_z)
    if not choose(problem.model).cheap:
        return problem
    for rows, columns in _parts(problem):
        part = problem if rows.all() else problem.select(rows)
        best = polished(part, grid_start(part))
        tried = set[int]()
        while (m := _worst(best, columns, tried)) is not None and not stopped():
            tried.add(m)
            found = min((_moved(best, m, value) for value in _lags(best, m)), key=lambda one: one.value, default=best)
            if found.value < best.value - GAIN:
                best, tried = found, {m}
        z = problem.first_z
        z[columns] = np.asarray(best.point.z)[columns]
        problem = problem.retimed(z)
    return problem


def settled_times(problem: Problem, point: Point) -> tuple[Problem, Point]:
    """The problem with its rows taken where the joint mode near a point puts them, and that mode."""
    for _ in range(ROUNDS):
        found = polished(problem, point)
        far = np.abs(problem.retimed(found.point.z).first_z - problem.first_z).max(initial=0.0)
        problem, point = taken_there(problem, found.point)
        if far < CLOSE:
            break
    return problem, point


def taken_there(problem: Problem, point: Point) -> tuple[Problem, Point]:
    """The problem with its rows taken where a point puts them, and the point there, near the same states."""
    later = problem.retimed(point.z)
    if later is problem:
        return problem, point
    followed = follow_states(later, problem.reordered(later, point.states))
    return later, followed._replace(z=point.z, levels=point.levels)


def _parts(problem: Problem) -> Iterator[tuple[np.ndarray, list[int]]]:
    """Rows of a part of the recording (N,), and the biases of clocks that are looked for in it."""
    time, count = problem.measurements.time, sum(len(e.time) for e in problem.epochs)
    owners = {node.name for node in problem.network.nodes if node.clocked}
    own = [m for m, b in enumerate(problem.biases) if b.owner in owners and b.component.startswith("time_")]
    middle = float(np.median(time))
    for since in sorted({problem.biases[m].since or -np.inf for m in own}):
        columns = [m for m in own if (problem.biases[m].since or -np.inf) == since]
        away = np.abs(time - (since if np.isfinite(since) else middle))
        yield (away <= np.quantile(away, min(1.0, EPOCHS / count))), columns


def _moved(best: Optimum, m: int, value: float) -> Optimum:
    """The mode that a few steps reach with one bias of a clock moved, its rows taken there."""
    found = polished(*taken_there(best.problem, best.point._replace(z=best.point.z.at[m].set(value))), STEPS)
    problem, point = taken_there(found.problem, found.point)
    return found._replace(problem=problem, point=point)


def _worst(best: Optimum, columns: list[int], tried: set[int]) -> int | None:
    """The bias of the clock, of those not tried, whose rows are explained worst; None where all are explained."""
    problem, model, total = best.problem, best.problem.model, dict[str, list[float]]()
    for block, data, _, square, index in model.each_block(residuals(model, best.point).square, problem.row_index):
        owners = np.array([problem.network.sensors[k].nodes[0].name for k in problem.measurements.sensor[index]])
        if block.type.clocked:
            for name in dict.fromkeys(owners):
                mine = owners == name
                own = total.setdefault(name, [0.0, 0.0])
                own[0] += float(np.asarray(square)[mine].sum())
                own[1] += float((np.asarray(data.mask)[mine] > 0).sum())
    means = {name: square / max(count, 1.0) for name, (square, count) in total.items()}
    left = [m for m in columns if m not in tried and means.get(problem.biases[m].owner, 0.0) > EXPLAINED]
    return max(left, key=lambda m: means[problem.biases[m].owner], default=None)


def _lags(best: Optimum, m: int) -> np.ndarray:
    """Values of bias m, in its scales, at which it is tried: lags within which the track hardly turns."""
    unit = np.zeros(len(best.problem.labels))
    unit[m] = 1.0
    z = np.asarray(best.point.z)
    seconds = float(np.abs(best.problem.lateness(z + unit) - best.problem.lateness(z)).max())
    step = turning_time(best.problem, best.point) / seconds if seconds > 0 else np.inf
    count = int(np.clip(np.ceil(SPAN / step), 1, MOST)) if np.isfinite(step) else 0
    return np.delete(np.linspace(-SPAN, SPAN, 2 * count + 1), count) if count else np.zeros(0)


def turning_time(problem: Problem, point: Point) -> float:
    """Half the time in s within which the velocity of the targets of a point stays alike: how far a clock is followed.

    Targets that go straight on stay alike for as long as they are seen.
    """
    squares, times = [], []
    for _, time, track in problem.tracks(problem.positions(point.states)):
        time, first = np.unique(time, return_index=True)
        if len(time) < 3:
            continue
        velocity = np.gradient(track[first], time, axis=0)
        for lag in np.unique(np.geomspace(1, len(time) - 1, 20).astype(int)):
            change = velocity[lag:] - velocity[:-lag]
            squares.append(np.mean(np.sum(change**2, 1)) / max(np.mean(np.sum(velocity**2, 1)), 1e-300))
            times.append(float(np.median(time[lag:] - time[:-lag])))
    turned = [t for t, s in zip(times, squares, strict=True) if s > 1.0]
    return 0.5 * (min(turned) if turned else max(times, default=np.inf))
