"""Simulated recordings with their truth, and truth read from files; truth is used for scoring only."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from probcal.errors import InputError, check_known
from probcal.files import AnyPath, write_whole
from probcal.labels import NOBODY, coordinates, listed, unescaped
from probcal.lazy import pd
from probcal.linalg import library
from probcal.model import rows
from probcal.model.sampled import path
from probcal.network import Network
from probcal.noise import Bernoulli, Heard
from probcal.problem import Epochs, Problem
from probcal.sensor import Channel
from probcal.table import Table, csv_text, header, name_as_text, numbers, read_table, unit_factor
from probcal.types import float64

Key = int | jax.Array


def as_key(key: Key) -> jax.Array:
    """A jax key from a seed, as `jax.random.key` makes it but without a kernel, or a key."""
    if not isinstance(key, (int, np.integer)):
        return key
    try:
        low, high = np.array([key], "<i8").view("<u4")
    except OverflowError:
        raise InputError(f"key={key}: a seed is a whole number below 2**63") from None
    return jax.random.wrap_key_data(jax.device_put(np.array([high, low])), impl="threefry2x32")


def chance_of(key: jax.Array) -> np.random.Generator:
    """NumPy's generator seeded by a key: draws on the host, which need no kernel."""
    return np.random.default_rng(np.asarray(jax.random.key_data(key)))


def standard_normals(key: jax.Array, shapes: Sequence[tuple[int, ...]]) -> list[Any]:
    """Standard normal draws of some shapes, on the host but where the key is traced."""
    if library(key) is not np:
        return [jax.random.normal(jax.random.fold_in(key, r), shape) for r, shape in enumerate(shapes)]
    return list(map(chance_of(key).standard_normal, shapes))


def derived_keys(key: jax.Array, numbers: Sequence[int] = (0, 1)) -> list[jax.Array]:
    """Keys of a key and each number, made on the host, where they need no kernel."""
    seed, kind = np.asarray(jax.random.key_data(key)).tolist(), jax.random.key_impl(key)
    words = [np.random.SeedSequence((*seed, number)).generate_state(len(seed)) for number in numbers]
    return [jax.random.wrap_key_data(jax.device_put(own), impl=kind) for own in words]


@dataclass(frozen=True, eq=False)
class Truth:
    """The known truth: tracks (columns time, [target], position_x, ...) and biases by label.

    `tracks` is a path or a DataFrame, in s and m where its headers state no unit; without a column target it is the
    track of a single one. Raises `InputError` naming file, row and column.

    >>> Truth(biases={"sonar_1.range_offset": 8.0}).biases
    {'sonar_1.range_offset': 8.0}
    """

    tracks: pd.DataFrame | AnyPath | None = None
    biases: Mapping[str, float] = field(default_factory=dict)
    source: str = field(default="", init=False, repr=False)  # name of the table of the tracks

    def __post_init__(self):
        if self.tracks is not None:
            table = read_table(self.tracks)
            object.__setattr__(self, "tracks", _tracks(table))
            object.__setattr__(self, "source", table.source)
        if not isinstance(self.biases, Mapping):
            raise InputError(f"truth: biases is {type(self.biases).__name__}; give a mapping from label to value")
        for label, value in self.biases.items():
            if not isinstance(value, (int, float, np.number)) or not np.isfinite(value):
                raise InputError(f'truth: bias "{label}" is {value!r}; give a finite number')

    def check_targets(self, names: Iterable[str]) -> None:
        """Raise `InputError` where the tracks do not say of which of several targets they are."""
        if not isinstance(self.tracks, pd.DataFrame) or "target" in self.tracks:
            return
        targets = list(dict.fromkeys(map(str, names)))
        if len(targets) > 1:
            raise InputError(
                f'truth {self.source} has no column "target", by which {len(targets)} targets'
                f" ({listed(targets, 3)}) are told apart; add it"
            )

    def positions(self, time: np.ndarray, target: np.ndarray, dimension: int) -> np.ndarray:
        """True positions (E, d) at times and targets (E,), interpolated; NaN outside the recorded track.

        Raises `InputError` for several targets where the tracks do not name theirs.
        """
        self.check_targets(target)
        found = np.full((len(time), dimension), np.nan)
        if not isinstance(self.tracks, pd.DataFrame):
            return found
        columns = coordinates()[:dimension]
        if columns[-1] not in self.tracks:
            raise InputError(f'truth: the tracks have no column "{columns[-1]}", the network is {dimension}-D')
        for name in np.unique(target):
            own = _track_of(self.tracks, name)
            if len(own):
                rows, known = target == name, own["time"].to_numpy(float)
                found[rows] = _interpolated(time[rows], known, own[columns].to_numpy(float))
        return found

    def track(self, target: str, time: np.ndarray) -> pd.DataFrame | None:
        """State of a target at times (E,), interpolated, one column a component; NaN outside its track, None without.

        A track of a single row is that of a target which does not move.
        """
        if not isinstance(self.tracks, pd.DataFrame):
            return None
        track = _track_of(self.tracks, target)
        if not len(track):
            return None
        values = track.drop(columns=["time", "target"], errors="ignore").apply(pd.to_numeric, errors="coerce")
        values = values.dropna(axis=1)
        known = track["time"].to_numpy(float)
        return pd.DataFrame(_interpolated(time, known, values.to_numpy(float)), columns=values.columns)


@dataclass(frozen=True, eq=False)
class Simulation:
    """A simulated table (columns of `probcal.table`) and its truth."""

    table: pd.DataFrame
    truth: Truth

    def write(self, path: AnyPath) -> list[Path]:
        """Write PATH and, beside it, PATH's `.tracks.csv` and `.biases.csv`; returns the files."""
        path = Path(path)
        biases = pd.DataFrame(self.truth.biases.items(), columns=["bias", "value"])
        tables: Any = zip([path, *_beside(path)], [self.table, self.truth.tracks, biases], strict=True)
        return [write_whole(target, csv_text(frame)) for target, frame in tables]


def _track_of(tracks: pd.DataFrame, target: str) -> pd.DataFrame:
    """Rows of the track of a target in order of time."""
    named = "target" in tracks
    own = tracks[tracks["target"].map(name_as_text) == target] if named else tracks
    return own.sort_values("time", kind="stable")


def _interpolated(time: np.ndarray, known: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Values (E, k) at times (E,) between those (K, k) at known ones (K,), NaN outside; one alone holds for ever."""
    if len(known) == 1:
        return np.repeat(values, len(time), 0)
    inside = (time >= known[0] - 1e-9) & (time <= known[-1] + 1e-9)
    found = np.stack([np.interp(time, known, column) for column in values.T], 1)
    return np.where(inside[:, None], found, np.nan)


def truth_beside(path: AnyPath) -> Truth | None:
    """Truth that `Simulation.write` left beside a table, or None."""
    tracks, biases = _beside(Path(path))
    values = _biases_of(read_table(biases)) if biases.exists() else {}
    there = tracks if tracks.exists() else None
    return Truth(there, values) if there or biases.exists() else None


def _beside(path: Path) -> tuple[Path, Path]:
    return path.with_suffix(".tracks.csv"), path.with_suffix(".biases.csv")


def _columns(table: Table, **wanted: str) -> pd.DataFrame:
    """A truth with the wanted columns as floats in the wanted units, without gaps."""
    names, units = header(table)
    frame = table.frame.set_axis(names, axis=1)
    for name, unit in wanted.items():
        check_known(name, names, f'truth {table.source} has no column "{name}"')
        values, there = numbers(table, frame[name], name)
        blank = np.flatnonzero(~there)
        if len(blank):
            raise InputError(f'truth {table.where(blank[0])} column "{name}" is blank; drop the row')
        frame = frame.assign(**{name: values * unit_factor(table, name, units[name], unit)})
    return frame


def _tracks(table: Table) -> pd.DataFrame:
    """True tracks with times in s and positions in m."""
    third = {"position_z": "m"} if "position_z" in header(table)[0] else {}
    return _columns(table, time="s", position_x="m", position_y="m", **third)


def _biases_of(table: Table) -> dict[str, float]:
    """True biases by label, from columns bias and value."""
    frame = _columns(table, value="1")
    check_known("bias", frame.columns, f'truth {table.source} has no column "bias"')
    return dict(zip(frame["bias"].astype(str).map(unescaped), frame["value"].tolist(), strict=True))


@float64
def simulate(
    network: Network,
    motion: Any,
    time: Any,
    *,
    key: Key = 0,
    share: float = 1.0,
    biases: Mapping[str, float] | None = None,
    tracks: Mapping[str, Any] | None = None,
    schedule: pd.DataFrame | None = None,
    missing: float = 0.0,
    outliers: float = 0.0,
    outlier_scale: float = 10.0,
) -> Simulation:
    """Simulate every sensor seeing every target at each time (T,) in s (or the rows of a `schedule`).

    Biases are drawn from their scales, a `share` of them non-zero, unless given by label. `tracks` maps
    target names to positions (T, d) or to frames with state columns; what they leave out is drawn from the
    motion, and rows by a free clock see their spline. `missing` data are left blank, `outliers` get `outlier_scale`
    times the noise on top.

    >>> again = simulate(network, motion, np.arange(60.0), key=0, share=0.2, missing=0.1)
    >>> again.table.columns.tolist()
    ['time', 'sensor', 'range', 'azimuth']
    """
    for name, value in (("share", share), ("missing", missing), ("outliers", outliers)):
        if not 0 <= value <= 1:
            raise InputError(f"simulate: {name}={value} must lie between 0 and 1")
    time = np.asarray(time, float)
    if time.ndim != 1 or not (np.diff(time) > 0).all():
        raise InputError("simulate: time must be one increasing column")
    tracks = {str(name): track for name, track in (tracks or {}).items()}
    keys = jax.random.split(as_key(key), 6)
    targets = list(tracks) if tracks else [str(name) for name in motion] if isinstance(motion, Mapping) else ["target"]
    plan = _plan(network, time, targets) if schedule is None else schedule.reset_index(drop=True)
    problem = Problem(network, motion, blank(network, plan))
    z = _biases(problem, share, biases, keys[0])
    problem, tracks = _by_clock(problem, z, time, tracks)
    states = [_states(problem, r, tracks, keys[1]) for r in range(len(problem.epochs))]
    columns = {name: np.full(len(plan), np.nan) for name in network.channel_names}
    for b, (block, data, r, index) in enumerate(problem.model.each_block(problem.row_index)):
        seed = jax.random.split(jax.random.fold_in(keys[2], b), 3)
        drawn = np.array(_drawn(block, data, states[r], z, np.zeros(len(problem.levels)), seed[0]))
        drawn = _spoil(block, data, drawn, outliers, outlier_scale, seed[1])
        gone = _random(jax.random.uniform, seed[2], drawn.shape) < missing
        for c, (name, channel) in enumerate(block.type.expand(network.dimension)):
            columns[name][index] = np.where(gone[:, c], np.nan, channel.turned(drawn[:, c]))
    table = plan[["time", "sensor", *(["target"] if "target" in plan else [])]].assign(**columns)
    table = table[~table[list(columns)].isna().all(axis=1)].reset_index(drop=True)
    if any(placed.detection is not None for placed in network.sensors):
        table = _detections(problem, table, plan, columns, states, z, keys[3])
    parts = [
        pd.DataFrame(np.asarray(x), columns=list(e.components)).assign(time=e.time, target=e.target)
        for _, x, e in problem.model.each_layout(states, problem.epochs)
    ]
    track = pd.concat(parts, ignore_index=True)
    track = track[["time", "target", *(c for c in track.columns if c not in ("time", "target"))]]
    track = track[track["target"] != NOBODY].reset_index(drop=True)
    return Simulation(table, Truth(track, dict(zip(problem.labels, (z * problem.scales).tolist(), strict=True))))


def _random(law: Callable[..., jax.Array], key: jax.Array, shape: tuple[int, ...]) -> np.ndarray:
    """Numbers of a law in a shape: the first of a power of two, so that few sizes are compiled."""
    size = math.prod(shape)
    return np.array(law(key, (max(256, 1 << (size - 1).bit_length()),)))[:size].reshape(shape)


def _detections(
    problem: Problem, table: pd.DataFrame, plan: pd.DataFrame, columns: Mapping[str, np.ndarray],
    states: list[np.ndarray], z: np.ndarray, key: jax.Array,
) -> pd.DataFrame:  # fmt: skip
    """The table as the sensors report it: some targets missed, false detections, no names, a blank row for nothing."""
    network, rng = problem.network, np.random.default_rng(np.asarray(jax.random.bits(key, (4,))))
    placed = {s.name: s for s in network.sensors}
    kept = np.ones(len(plan), bool)
    for block, data, r, index in problem.model.each_block(problem.row_index):
        told = [placed[str(name)].detection for name in plan["sensor"].to_numpy()[index]]
        chance = np.array([1.0 if own is None else own.chance for own in told])
        for view in {own.view for own in told if own is not None and own.view is not None}:
            seen = rows.look(block, data, jnp.asarray(states[r]), jnp.asarray(z), view)
            mine = np.array([own is not None and own.view == view for own in told])
            chance = np.where(mine, chance * np.asarray(seen, float), chance)
        kept[index] = rng.uniform(size=len(index)) < chance
    detects = plan["sensor"].map(lambda name: placed[str(name)].detection is not None).to_numpy(bool)
    measured = pd.DataFrame(columns)
    there = measured.notna().any(axis=1).to_numpy()
    named = [column for column in ("time", "sensor", "target") if column in plan]
    found = plan.loc[there & kept & ~detects, named].join(measured)
    reported = plan.loc[there & kept & detects, ["time", "sensor"]].join(measured)
    parts = [found, reported]
    for (time, name), _ in plan[detects].groupby(["time", "sensor"], sort=False):
        own, kind = placed[str(name)].detection, placed[str(name)].type
        assert own is not None
        count = rng.poisson(own.rate)
        false = {"time": np.full(count, time), "sensor": np.full(count, name, object)}
        for channel, declared in kind.expand(network.dimension):
            pair = own.within(channel, declared.unit, declared.period)
            if pair is None and own.rate:
                raise InputError(
                    f'simulate: sensor "{name}" has false detections of "{channel}", but nothing tells where; say it in'
                    f' Detection(..., limits={{"{channel}": (low, high)}})'
                )
            low, high = pair or (0.0, 0.0)
            false[channel] = declared.turned(rng.uniform(low, high, size=count))
        parts.append(pd.DataFrame(false))
        if not count and not ((reported["time"] == time) & (reported["sensor"] == name)).any():
            parts.append(pd.DataFrame({"time": [time], "sensor": [name]}))
    whole = pd.concat([part for part in parts if len(part)], ignore_index=True)
    whole = whole.iloc[rng.permutation(len(whole))].sort_values("time", kind="stable").reset_index(drop=True)
    return whole[[*(c for c in table.columns if c in whole)]]


@partial(jax.jit, static_argnums=0)
def _drawn(
    block: rows.Block, data: rows.Rows, states: jax.Array, z: jax.Array, levels: jax.Array, key: jax.Array
) -> jax.Array:
    """The values (N, C) that reach the sensors of a block, drawn around the predicted ones."""
    return rows.sample(block, data, rows.predict(block, data, states, z), levels, key, "emit")


def _plan(network: Network, time: np.ndarray, targets: list[str]) -> pd.DataFrame:
    sensors = [placed.name for placed in network.sensors]
    grid = pd.MultiIndex.from_product([targets, time, sensors], names=["target", "time", "sensor"])
    plan = grid.to_frame(index=False)[["time", "sensor", "target"]]
    detects = any(placed.detection is not None for placed in network.sensors)  # whose rows would lose the name
    return plan if detects or targets != ["target"] else plan.drop(columns="target")


def blank(network: Network, plan: pd.DataFrame) -> pd.DataFrame:
    """The plan with every channel of its sensors filled with 0, or what is heard, so that all rows exist."""
    own = {s.name: dict(s.type.expand(network.dimension)) for s in network.sensors}
    filled = {
        name: [_legal(own[sensor][name]) if name in own.get(sensor, ()) else np.nan for sensor in plan["sensor"]]
        for name in network.channel_names
    }
    return plan.assign(**filled)


def _legal(channel: Channel) -> float:
    """A value that a table may hold."""
    return max(channel.noise.known() + 1.0, 0.0) if isinstance(channel.noise, Heard) else 0.0


def _biases(problem: Problem, share: float, given: Mapping[str, float] | None, key: jax.Array) -> np.ndarray:
    draw, chosen = jax.random.split(key)
    shape = (len(problem.labels),)
    z = _random(jax.random.normal, draw, shape)
    zero = _random(jax.random.uniform, chosen, shape) >= share
    z[zero & np.array([bias.kind == "scale" and bias.zeros != "none" for bias in problem.biases], bool)] = 0.0
    if given is not None:
        z[:] = 0.0
        for label, value in given.items():
            check_known(label, problem.labels, f'simulate: no bias is called "{label}"')
            m = problem.labels.index(label)
            z[m] = value / problem.scales[m]
    return z


def _states(problem: Problem, r: int, tracks: Mapping[str, Any], key: jax.Array) -> np.ndarray:
    """The vectors (E, n) that rows read: drawn from the motion, with given components inserted."""
    part, epochs = problem.model.recursions[r], problem.epochs[r]
    noise = np.asarray(problem.model.draw_noises(key, r, 1))[:, :, 0]
    F, L, drift = (np.asarray(a) for a in (part.F, part.L, part.drift))
    states: Any = np.zeros_like(noise)
    for e in range(len(noise)):
        states[e] = F[e] @ states[e - 1] + drift[e] + L[e] @ noise[e]  # of the first the one before is zero
    sampled = problem.model.sampled[r]
    if sampled is not None:
        seed = jax.random.fold_in(jax.random.fold_in(key, r), 1)
        others = path(sampled, part.first, part.dt, seed, np.zeros(len(problem.levels)))
        states = np.asarray(problem.model.vectors(r, sampled.whole(states, others)))
    times = {name: epochs.time[epochs.target == name] for name in tracks}
    frames = {}
    for name, track in tracks.items():
        if len(at := times[name]):
            given = track(at) if callable(track) else track
            frames[name] = _frame(given, problem.network.dimension, len(at), name)
    return on_tracks(epochs, states, frames)


def on_tracks(epochs: Epochs, states: np.ndarray, tracks: Mapping[str, pd.DataFrame]) -> np.ndarray:
    """States (E, n) with the tracks put over them: by target, a frame of state columns with one row an epoch.

    A velocity that a track does not state is the difference of its positions; what it leaves out stays.
    """
    states = states.copy()
    for name, frame in tracks.items():
        mine = np.flatnonzero(epochs.target == name)
        for j, component in enumerate(epochs.components):
            if component in frame:
                states[mine, j] = frame[component].to_numpy(float)
            elif (position := component.replace("velocity", "position")) in frame and len(mine) > 1:
                states[mine, j] = np.gradient(frame[position].to_numpy(float), epochs.time[mine])
    return states


def _by_clock(
    problem: Problem, z: np.ndarray, time: np.ndarray, tracks: Mapping[str, Any]
) -> tuple[Problem, Mapping[str, Any]]:
    """The problem with its rows where their clocks put them, and then the tracks as functions of time."""
    if not problem.clocks.any():
        return problem, tracks
    splines = {name: _spline(time, own, name) if len(own) > 1 else own for name, own in tracks.items()}
    return problem.retimed(z), splines


def _spline(time: np.ndarray, track: Any, name: str) -> Callable[[np.ndarray], pd.DataFrame]:
    """A track given at times (T,), as a function of other times: its spline, and the velocity of this."""
    from scipy.interpolate import CubicSpline  # loaded where a track is read between its times

    frame = _frame(track, np.shape(track)[-1], len(time), name)
    curves = {str(column): CubicSpline(time, frame[column].to_numpy(float)) for column in frame}
    slopes = {c.replace("position", "velocity"): curve.derivative() for c, curve in curves.items() if "position" in c}
    return lambda at: pd.DataFrame({name: curve(at) for name, curve in (slopes | curves).items()})


def _frame(track: Any, dimension: int, epochs: int, name: str) -> pd.DataFrame:
    if not isinstance(track, pd.DataFrame):
        array = np.atleast_2d(np.asarray(track, float))
        if array.shape[1] != dimension:
            raise InputError(f'simulate: track "{name}" has shape {array.shape}, expected (times, {dimension})')
        track = pd.DataFrame(array, columns=coordinates()[:dimension])
    if len(track) != epochs:
        raise InputError(f'simulate: track "{name}" has {len(track)} positions for {epochs} epochs')
    return track


def _spoil(
    block: rows.Block, data: rows.Rows, value: np.ndarray, share: float, scale: float, key: jax.Array
) -> np.ndarray:
    """The sensor reports, a fraction as outliers: more noise, or a wrong yes-or-no answer."""
    pick, size = jax.random.split(key)
    hit = _random(jax.random.uniform, pick, value.shape) < share
    extra = scale * np.asarray(data.std) * _random(jax.random.normal, size, value.shape)
    for c, channel in enumerate(block.channels):
        wrong = 1 - value[:, c] if isinstance(channel.noise, Bernoulli) else value[:, c] + extra[:, c]
        value[:, c] = np.where(hit[:, c], wrong, value[:, c])
        if channel.period is not None:
            value[:, c] = (value[:, c] + channel.period / 2) % channel.period - channel.period / 2
        value[:, c] = channel.noise.reported(value[:, c])
    return value
