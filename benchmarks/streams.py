"""Streams with one fault each, and streams without any: what an online filter makes of them.

    uv run python benchmarks/streams.py faults --runs 2000
    uv run python benchmarks/streams.py faults --seed 17 --runs 1
    uv run python benchmarks/streams.py sound --runs 200 --before ../before

Three or four gauges of range (1 m) and azimuth (0.02 rad) stand at random in a square of 100 m and see passes of a
target once a second. Each has an unknown range offset (2 m), in half of the runs an unknown heading (0.05 rad) too.

`faults`: one or two biases are off by up to two scales; one fault of `FAULTS` begins at a row of the first 70 %. In a
third of the runs the filter is plain (lag 0); in half of them rows come 100 at a time. A run fails where a bias ends
more than 6 sd from its value at the end of the stream, while the filter is not alarmed and has no message. Each failed
run is named with its seed, which repeats it.
`sound`: streams of the right model with biases from their priors: alarms, data left out, coverage of biases and tracks.
`--before` is a worktree of an earlier commit, whose rows a second are measured by turns with those of this one.
"""

import argparse
import json
import os
import subprocess
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import probcal as pc
from probcal.errors import InputError
from probcal.geometry import bearing, elevation, norm
from probcal.noise import Normal, StudentT
from probcal.results.answer import HALF
from probcal.stream.online import AugmentedFilter, Jumps, Online

SIDE = 100.0  # m, of the square of the gauges
STD = {"range": 1.0, "azimuth": 0.02, "elevation": 0.02}  # m, rad
AXES = ("position_x", "position_y", "position_z")
SCALE = {"range_offset": 2.0, "heading": 0.05}  # m, rad
DRIVE = 0.3  # m s^-3/2, of the target
CLOSE, APART = 8.0, 20.0  # m, least distances of a target from a gauge and of two gauges
GAP = 20.0  # s between two passes
CHUNK = 100  # rows that come at once
WRONG = 6.0  # sd
WALK = 0.02  # m, of range offsets that walk, over one second
TURNS = 5  # of the two versions whose speed is measured
TIMED = 6  # streams of a turn, the first to compile


@dataclass
class Stream:
    """Rows in the order in which they come, and what is true."""

    network: pc.Network
    table: pd.DataFrame
    truth: dict[str, float]  # of biases, at the end
    tracks: pd.DataFrame  # time, target, position


def kind_of(dimension: int, noise: Any) -> Any:
    """The type of the gauges."""
    channels = {"range": pc.Channel("m", std=STD["range"], noise=noise)}
    for name in ("azimuth", "elevation")[: dimension - 1]:
        channels[name] = pc.Channel("rad", std=STD[name], noise=noise, wrap=True)

    @pc.sensor(**channels)
    def gauge(target, pose, *, range_offset=pc.Bias("m", SCALE["range_offset"])):
        line = target.position - pose.position
        seen = dict(range=norm(line) + range_offset, azimuth=bearing(line) - pose.heading)
        return seen if dimension == 2 else seen | dict(elevation=elevation(line))

    return gauge


PLANE = kind_of(2, Normal())


def stream(
    rng: np.random.Generator, rows: int, gauges: int, turned: bool, few: bool, kind: Any = PLANE, draw: Any = None
) -> Stream:
    """A stream without a fault: `turned` frees headings; with `few` only one or two biases are not zero.

    `draw` makes noise of unit scale, normal if left out.
    """
    dimension = len(kind.channels)
    while True:
        places = rng.uniform(0.0, SIDE, (gauges, dimension))
        if np.linalg.norm(places[:, None] - places + SIDE * np.eye(gauges)[..., None], axis=2).min() > APART:
            break
    scale = {"heading": SCALE["heading"]} if turned else {}
    network = pc.Network([kind.on(pc.Node(f"g{n}", at, scale=scale)) for n, at in enumerate(places)])
    bias = {label: SCALE[label.split(".")[1]] * rng.standard_normal() for label in network.labels}
    if few:
        off = rng.choice(network.labels, rng.integers(1, 3), replace=False)
        bias = dict.fromkeys(network.labels, 0.0)
        bias |= {label: SCALE[label.split(".")[1]] * rng.uniform(-2.0, 2.0) for label in off.tolist()}
    times, targets, paths = [], [], []
    scans, begun = -(-rows // gauges), 0.0
    while scans > 0:
        length = min(scans, int(rng.integers(20, 61)))
        path = passing(rng, places, length)
        times.append(begun + np.arange(length))
        targets += [f"pass_{len(paths)}"] * length
        paths.append(path)
        begun, scans = begun + length + GAP, scans - length
    t, x = np.concatenate(times), np.concatenate(paths)
    line = x[:, None] - places
    seen = {"range": np.linalg.norm(line, axis=2), "azimuth": np.arctan2(line[..., 1], line[..., 0])}
    seen["range"] += [bias[f"g{n}.range_offset"] for n in range(gauges)]
    seen["azimuth"] -= [bias.get(f"g{n}.heading", 0.0) for n in range(gauges)]
    if dimension == 3:
        seen["elevation"] = np.arctan2(line[..., 2], np.hypot(line[..., 0], line[..., 1]))
    table = pd.DataFrame({
        "time": np.repeat(t, gauges),
        "sensor": np.tile([f"g{n}" for n in range(gauges)], len(t)),
        "target": np.repeat(np.array(targets, object), gauges),
    })  # fmt: skip
    for name, value in seen.items():
        noise = STD[name] * (rng.standard_normal(value.shape) if draw is None else draw(rng, value.shape))
        table[name] = (value + noise).ravel()
        if name != "range":
            table[name] = around(table[name])
    tracks = pd.DataFrame({"time": t, "target": targets, **dict(zip(AXES, x.T, strict=False))})
    return Stream(network, table.head(rows), bias, tracks)


def passing(rng: np.random.Generator, places: np.ndarray, length: int) -> np.ndarray:
    """Positions (length, d) of a target that comes close to no gauge."""
    while True:
        push, rest = DRIVE * rng.standard_normal((2, length, places.shape[1]))
        v = rng.normal(0.0, 1.5, places.shape[1]) + np.cumsum(push, 0)
        x = rng.uniform(0.0, SIDE, places.shape[1]) + np.cumsum(v - push / 2 + rest / np.sqrt(12.0), 0)
        if np.linalg.norm(x[:, None] - places, axis=2).min() > CLOSE:
            return x


def around(angle: Any) -> Any:
    """Angles within half a turn."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


# faults: each changes the stream in place, from a row on, and says what it did


def spread(rng: np.random.Generator, low: float, high: float) -> float:
    """A number between two, uniform in its logarithm."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def signed(rng: np.random.Generator, low: float, high: float) -> float:
    """`spread`, of either sign."""
    return float(rng.choice([-1.0, 1.0])) * spread(rng, low, high)


def column(rng: np.random.Generator) -> str:
    """One of the two channels."""
    return str(rng.choice(["range", "azimuth"]))


def put(own: Stream, name: str, mine: Any, values: Any) -> None:
    """Values in a column of some rows, angles within half a turn."""
    own.table.loc[mine, name] = around(values) if name == "azimuth" else values


def some(rng: np.random.Generator, own: Stream, at: int) -> tuple[np.ndarray, str]:
    """Rows of one gauge or of all, from a row on or from the first one, and their name."""
    names = own.table["sensor"].unique()
    one, whole = str(rng.choice(names)), rng.random() < 0.5
    mine = own.table.index >= (0 if rng.random() < 0.5 else at)
    return (mine, "all") if whole else (mine & (own.table["sensor"] == one), one)


def sentinel(rng: np.random.Generator, own: Stream, at: int) -> str:
    """One cell is a mark for a missing value."""
    name, value = column(rng), float(rng.choice([-9999.0, -999.0, 9999.0, 999999.0, -1.0, 0.0]))
    own.table.loc[at, name] = value
    return f"{name} {value:g}"


def outlier(rng: np.random.Generator, own: Stream, at: int) -> str:
    """One cell is 10 to 1,000 sd off."""
    name, size = column(rng), signed(rng, 10.0, 1000.0)
    put(own, name, at, own.table.loc[at, name] + size * STD[name])
    return f"{name} {size:+.0f} sd"


def units(rng: np.random.Generator, own: Stream, at: int) -> str:
    """Ranges in another unit."""
    mine, who = some(rng, own, at)
    unit, factor = [("mm", 1e3), ("km", 1e-3), ("ft", 1 / 0.3048)][rng.integers(3)]
    own.table.loc[mine, "range"] *= factor
    return f"{unit} of {who}, {mine.sum()} rows"


def angles(rng: np.random.Generator, own: Stream, at: int) -> str:
    """Azimuths of a compass, or of the other sense."""
    mine, who = some(rng, own, at)
    cause, turn = [("compass", np.pi / 2), ("reversed", 0.0)][rng.integers(2)]
    put(own, "azimuth", mine, turn - own.table.loc[mine, "azimuth"])
    return f"{cause} of {who}, {mine.sum()} rows"


def exchanged(rng: np.random.Generator, own: Stream, at: int) -> str:
    """Two gauges change their names."""
    pair = rng.choice(own.table["sensor"].unique(), 2, replace=False).tolist()
    late = own.table.index >= at
    own.table.loc[late, "sensor"] = own.table["sensor"][late].replace(dict(zip(pair, pair[::-1], strict=True)))
    return " and ".join(pair)


def moved(rng: np.random.Generator, own: Stream, at: int, ramp: bool = False) -> str:
    """A bias jumps by 3 to 30 sd of the noise, or gets there by a ramp; a heading may be one that is not declared."""
    name, who, size = column(rng), str(rng.choice(own.table["sensor"].unique())), signed(rng, 3.0, 30.0)
    mine = (own.table.index >= at) & (own.table["sensor"] == who)
    part = np.linspace(0.0, 1.0, mine.sum() + 1)[1:] if ramp else 1.0
    put(own, name, mine, own.table.loc[mine, name] + size * STD[name] * part)
    label, sign = (f"{who}.range_offset", 1.0) if name == "range" else (f"{who}.heading", -1.0)
    if label in own.truth:
        own.truth[label] += sign * size * STD[name]
    return f"{name} of {who} by {size:+.1f} sd in {mine.sum()} rows"


def ramp(rng: np.random.Generator, own: Stream, at: int) -> str:
    """A bias drifts."""
    return moved(rng, own, at, ramp=True)


def clock(rng: np.random.Generator, own: Stream, at: int) -> str:
    """The clock of one gauge is 0.5 to 3 s slow or fast."""
    who, late = str(rng.choice(own.table["sensor"].unique())), float(rng.choice([-1.0, 1.0]) * rng.uniform(0.5, 3.0))
    own.table.loc[(own.table.index >= at) & (own.table["sensor"] == who), "time"] += late
    return f"{who} by {late:+.2f} s"


def stuck(rng: np.random.Generator, own: Stream, at: int) -> str:
    """A gauge repeats its last values for 20 to 200 rows."""
    who, length = str(rng.choice(own.table["sensor"].unique())), int(spread(rng, 20, 200))
    mine = own.table.index[(own.table.index >= at) & (own.table["sensor"] == who)][:length]
    own.table.loc[mine, ["range", "azimuth"]] = own.table.loc[mine[0], ["range", "azimuth"]].to_numpy(float)
    return f"{who} for {len(mine)} rows"


def noise(rng: np.random.Generator, own: Stream, at: int) -> str:
    """The noise of one channel of a gauge is 5 to 30 times as large."""
    name, who, factor = column(rng), str(rng.choice(own.table["sensor"].unique())), spread(rng, 5.0, 30.0)
    mine = (own.table.index >= at) & (own.table["sensor"] == who)
    more = STD[name] * np.sqrt(factor**2 - 1.0) * rng.standard_normal(mine.sum())
    put(own, name, mine, own.table.loc[mine, name] + more)
    return f"{name} of {who} times {factor:.0f} in {mine.sum()} rows"


FAULTS = {
    own.__name__: own for own in (sentinel, outlier, units, angles, exchanged, moved, ramp, clock, stuck, noise)
}  # fmt: skip


def fed(online: Online, table: pd.DataFrame, size: int) -> pd.DataFrame:
    """Filter rows some at a time; their tracks. Rows that cannot be taken are left out, as `probcal watch` does."""
    tracks = [own for k in range(0, len(table), size) for own in taken(online, table.iloc[k : k + size])]
    return pd.concat([*tracks, online.finish().tracks], ignore_index=True)


def taken(online: Online, rows: pd.DataFrame) -> list[pd.DataFrame]:
    """Tracks of rows, or of the halves that can be taken of them."""
    try:
        return [online.update(rows).tracks]
    except InputError:
        half = len(rows) // 2
        return [own for part in (rows.iloc[:half], rows.iloc[half:]) if half for own in taken(online, part)]


def faulty(seed: int) -> dict[str, Any]:
    """The run of a seed: what it was, and what the filter made of it."""
    rng = np.random.default_rng(seed)
    own = stream(rng, int(rng.integers(300, 901)), int(rng.integers(3, 5)), bool(rng.random() < 0.5), few=True)
    lag, size = (0 if rng.random() < 1 / 3 else 32), (CHUNK if rng.random() < 0.5 else len(own.table))
    at = int(rng.integers(0.7 * len(own.table)))
    kind = list(FAULTS)[seed % len(FAULTS)]
    did = FAULTS[kind](rng, own, at)
    online = Online(own.network, pc.ConstantVelocity(DRIVE), AugmentedFilter(lag=lag))
    fed(online, own.table, size)
    found = online.biases
    z = ((found["mean"] - pd.Series(own.truth)[found.index]) / found["sd"]).abs()
    counts = {name: count for name, count in online.counts.items() if name != "rows" and count}
    return {
        "kind": kind, "largest": float(z.max()), "mean": float(z.mean()), "alarmed": bool(online.alarmed),
        "said": bool(online.message), "refused": online.counts["refused"], "message": online.message,
        "run": f"{kind} from row {at} of {len(own.table)}: {did}; {len(own.truth)} biases, lag {lag},"
        f" {size} rows at once; {z.idxmax()} is {z.max():.1f} sd off; {counts}",
    }  # fmt: skip


def faults(chosen: argparse.Namespace) -> None:
    """Streams with one fault: what ends wrong without a word."""
    seeds = [seed for seed in range(chosen.seed, chosen.seed + chosen.runs * len(FAULTS))
             if list(FAULTS)[seed % len(FAULTS)] in (chosen.kinds or FAULTS)][: chosen.runs]  # fmt: skip
    begun, found = time.perf_counter(), []
    for seed in seeds:
        own = faulty(seed)
        wrong = not own["largest"] <= WRONG
        own["failed"] = wrong and not own["alarmed"] and not own["said"]
        own["exit 0"] = wrong and own["said"] and not own["alarmed"]
        own["told"] = wrong and own["alarmed"]
        found.append(own)
        if own["failed"] or chosen.verbose or (own["exit 0"] and chosen.said):
            word = "FAILED" if own["failed"] else "exit 0" if own["exit 0"] else "alarm" if own["alarmed"] else "well"
            print(f"seed {seed}: {word}: {own['run']}\n    {own['message']}", flush=True)
    table = pd.DataFrame(found).assign(runs=1)
    by = table.groupby("kind", sort=False)
    shown = by[["runs", "failed", "exit 0", "told", "said", "alarmed"]].sum().join(by[["mean", "largest"]].mean())
    shown["refused"] = by["refused"].apply(lambda own: (own > 0).sum())
    whole = shown.drop(columns=["mean", "largest"]).sum()
    print(shown.rename(columns={"mean": "mean |z|", "largest": "largest |z|"}).to_string(float_format="{:.2f}".format))
    print(whole.to_frame("all").T.to_string())
    print(f"{time.perf_counter() - begun:.0f} s; failed, exit 0 and told are more than {WRONG:g} sd off")


def heavy(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Noise of four degrees of freedom."""
    return rng.standard_t(4.0, shape)


CASES: dict[str, tuple[float, AugmentedFilter, dict[str, Any]]] = {  # share of the runs, filter, of the stream
    "as it comes": (1.0, AugmentedFilter(), {}),
    "lag 0": (0.5, AugmentedFilter(lag=0), {}),
    "StudentT(4)": (0.25, AugmentedFilter(), {"kind": kind_of(2, StudentT(4.0)), "draw": heavy}),
    "3-D": (0.25, AugmentedFilter(), {"kind": kind_of(3, Normal())}),
    "walk": (0.25, AugmentedFilter(walk={"*.range_offset": WALK}), {}),
    "jumps": (0.25, AugmentedFilter(jumps=Jumps()), {}),
}


def walked(rng: np.random.Generator, own: Stream) -> None:
    """Let range offsets walk."""
    second = own.table["time"].to_numpy(int)
    for name in own.table["sensor"].unique():
        steps = WALK * rng.standard_normal(second.max() + 1)
        steps[0] = 0.0
        mine = (own.table["sensor"] == name).to_numpy()
        own.table.loc[mine, "range"] += np.cumsum(steps)[second[mine]]
        own.truth[f"{name}.range_offset"] += steps.sum()


def sound(chosen: argparse.Namespace) -> None:
    """Streams of the right model: what is said against them, and what their intervals hold."""
    for case in chosen.cases or CASES:
        share, method, drawn = CASES[case]
        runs, said, bias, state, seen, out = int(np.ceil(share * chosen.runs)), list[str](), [], [], 0, 0
        widest = []
        for run in range(runs):
            rng = np.random.default_rng((chosen.seed, run))
            own = stream(rng, chosen.rows, 3, True, few=False, **drawn)
            if method.walk:
                walked(rng, own)
            online = Online(own.network, pc.ConstantVelocity(DRIVE), method)
            tracks = fed(online, own.table, len(own.table))
            found = online.biases
            bias.append(((found["mean"] - pd.Series(own.truth)[found.index]) / found["sd"]).to_numpy())
            both = own.tracks.merge(tracks, on=["time", "target"], suffixes=("", "_mean"))
            places = [name for name in AXES if name in own.tracks]
            off = [(both[f"{name}_mean"] - both[name]) / both[f"{name}_sd"] for name in places]
            state.append(np.concatenate(off))
            seen, out = seen + online.check.seen, out + online.counts["outliers"]
            widest.append(float(online.inflation.max()))
            if online.alarmed or online.message or online.jumps:
                said.append(f"run {run}: {online.message} {len(online.jumps)} jumps")
        print(
            f"{case}: {runs} streams of {chosen.rows} rows; {len(said)} with a message;"
            f" {out} data left out, {seen * method.gate:.1f} expected;"
            f" biases {held(bias)}; tracks {held(state)}; widened {np.mean(np.array(widest) > 1.0):.1%}",
            *said, sep="\n    ", flush=True,
        )  # fmt: skip
    if chosen.before:
        speeds(chosen)


def held(z: list[np.ndarray]) -> str:
    """Share within 89 % intervals and rms of z, run by run, with the standard error over runs."""
    inside = np.array([np.mean(np.abs(own) < HALF) for own in z])
    error = inside.std(ddof=1) / np.sqrt(len(z)) if len(z) > 1 else np.nan
    return f"{100 * inside.mean():.1f} ± {100 * error:.1f} %, rms z {np.sqrt(np.mean(np.concatenate(z) ** 2)):.2f}"


def speeds(chosen: argparse.Namespace) -> None:
    """Rows a second of two versions by turns."""
    here = Path(__file__).resolve().parent.parent
    rates: dict[tuple[str, str], list[float]] = {}
    for _ in range(TURNS):
        for name, folder in (("before", chosen.before.resolve()), ("now", here)):
            command = [sys.executable, __file__, "rate", "--rows", str(chosen.rows)]
            done = subprocess.run(command, env=os.environ | {"PYTHONPATH": str(folder)}, capture_output=True, text=True)
            if done.returncode:
                raise SystemExit(f"{name}: {done.stderr[-2000:]}")
            for way, rate in json.loads(done.stdout).items():
                rates.setdefault((way, name), []).append(rate)
    for way in sorted({way for way, _ in rates}):
        before, now = (float(np.median(rates[way, name])) for name in ("before", "now"))
        print(f"{way}: {before:,.0f} rows/s before, {now:,.0f} now: {now / before - 1:+.1%} (medians of {TURNS} turns)")


def rate(chosen: argparse.Namespace) -> None:
    """Rows a second, as JSON, by lag and by the rows that come at once."""
    rates = {}
    for lag in (0, 32):
        for size in (CHUNK, chosen.rows):
            took = []
            for run in range(TIMED):
                own = stream(np.random.default_rng(run), chosen.rows, 3, True, few=False)
                online = Online(own.network, pc.ConstantVelocity(DRIVE), AugmentedFilter(lag=lag))
                begun = time.perf_counter()
                fed(online, own.table, size)
                took.append(time.perf_counter() - begun)
            rates[f"lag {lag}, {size} rows at once"] = chosen.rows / float(np.median(took[1:]))
    print(json.dumps(rates))


def main() -> None:
    """One of the commands."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    verbs = parser.add_subparsers(required=True)

    def verb(function: Callable[[argparse.Namespace], None], **numbers: int) -> argparse.ArgumentParser:
        own = verbs.add_parser(function.__name__, help=(function.__doc__ or "").split("\n")[0])
        own.set_defaults(run=function)
        for name, value in numbers.items():
            own.add_argument(f"--{name}", type=int, default=value)
        return own

    own = verb(faults, runs=2000, seed=0)
    own.add_argument("--kinds", nargs="*", choices=list(FAULTS), default=[])
    own.add_argument("--verbose", action="store_true", help="name every run")
    own.add_argument("--said", action="store_true", help="name wrong runs with a message too")
    own = verb(sound, runs=200, rows=2700, seed=0)
    own.add_argument("--before", type=Path, help="worktree of an earlier commit, for rows a second")
    own.add_argument("--cases", nargs="*", choices=list(CASES), default=[])
    verb(rate, rows=2700)
    chosen = parser.parse_args()
    warnings.simplefilter("ignore")
    chosen.run(chosen)


if __name__ == "__main__":
    main()
