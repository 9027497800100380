"""Online calibration: its speed beside Stone Soup, what its intervals hold, jumps, and where it ends.

    uv run --with stonesoup python benchmarks/online.py speed 5 20
    uv run python benchmarks/online.py coverage --runs 200
    uv run python benchmarks/online.py jumps --runs 100
    uv run python benchmarks/online.py end

Radars stand on a ring of 3 km and see targets within it once a second: range (10 m) and azimuth (3 deg). Each has an
unknown heading (3 deg) and range offset (10 m).

`speed`: rows a second of `Online.update` by chunks, compiled before, beside an extended Kalman filter of Stone Soup
whose state is the target and all biases: the same rows, start and priors, Jacobians written by hand and, with
`--numerical`, its own by differences. Both take turns, the best of some counts. With rows of a scan at once Stone Soup
linearises each at what those before it left, so that the ends differ a little; `--apart` gives each row its own time.
Then the delay of single rows.
`coverage`: streams drawn from the model's own priors, two targets, 30 % of the data missing. A standard error counts
runs, not intervals. Where headings walk the truth is that of the last second.
`jumps`: a heading jumps by two scales in the middle of a stream; other streams have none and count false alarms.
`end`: the filter beside the joint mode of the batch on `models/radars.py`.
"""

import argparse
import datetime
import importlib.util
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import probcal as pc
from probcal.cli.models import load_problem
from probcal.results.answer import HALF
from probcal.sensors import radar
from probcal.stream.online import AugmentedFilter, Jumps, Online

RING, RANGE, AZIMUTH = 3000.0, 10.0, np.deg2rad(3.0)
HEADING, OFFSET = np.deg2rad(3.0), 10.0  # scales of the biases
START = {"position": ((0.0, 0.0), 500.0), "velocity": ((0.0, 0.0), 15.0)}
DRIVE = 1.0  # m s^-3/2
WALK = np.deg2rad(0.3)  # of a heading, over one second
MISSING = 0.3
MODEL = Path(__file__).parent.parent / "models" / "radars.py"
CHANNELS = {"range": pc.Channel("m", std=RANGE), "azimuth": pc.Channel("rad", std=AZIMUTH, wrap=True)}


def places(N: int) -> np.ndarray:
    """Places (N, 2) on the ring."""
    turn = 2 * np.pi * np.arange(N) / N
    return RING * np.stack([np.cos(turn), np.sin(turn)], 1)


def ring(N: int) -> pc.Network:
    """The radars."""
    kind = replace(radar, channels=CHANNELS)
    return pc.Network([kind.on(pc.Node(f"r{n}", at, scale={"heading": HEADING})) for n, at in enumerate(places(N))])


def target(drive: float = DRIVE) -> pc.Target:
    """What moves, with its start."""
    return pc.Target(pc.ConstantVelocity(drive), start=START)


def drawn(N: int, T: int, names: tuple[str, ...], key: int, missing: float = MISSING) -> pc.Simulation:
    """A stream of T s from the priors."""
    return pc.simulate(ring(N), {n: target() for n in names}, np.arange(float(T)), key=key, missing=missing)


def circling(N: int, rows: int, apart: bool) -> pd.DataFrame:
    """Rows of one target that goes round for ever, so that long streams stay in the ring."""
    rng = np.random.default_rng(0)
    scan, n = np.divmod(np.arange(rows), N)
    t = scan + (n / N if apart else 0.0)
    path = np.stack([900 * np.sin(t / 60), 700 * np.sin(t / 43 + 0.5)], 1)
    line = path - places(N)[n]
    heading, offset = HEADING * rng.standard_normal(N), OFFSET * rng.standard_normal(N)
    ranges = np.hypot(*line.T) + offset[n] + RANGE * rng.standard_normal(rows)
    azimuths = np.arctan2(line[:, 1], line[:, 0]) - heading[n] + AZIMUTH * rng.standard_normal(rows)
    azimuths = (azimuths + np.pi) % (2 * np.pi) - np.pi
    names = [f"r{k}" for k in n]
    return pd.DataFrame({"time": t, "sensor": names, "target": "t", "range": ranges, "azimuth": azimuths})


def chunks(table: pd.DataFrame, size: int) -> Iterator[pd.DataFrame]:
    """A table in parts of so many rows."""
    for k in range(0, len(table), size):
        yield table.iloc[k : k + size]


def ours(N: int, table: pd.DataFrame, lag: int, size: int) -> tuple[float, Online]:
    """Rows a second of a filter behind its first chunk, and the filter at the end."""
    online = Online(ring(N), target(), AugmentedFilter(lag=lag))
    first, *others = chunks(table, size)
    online.update(first)
    begun = time.perf_counter()
    for part in others:
        online.update(part)
    return (len(table) - len(first)) / (time.perf_counter() - begun), online


# Stone Soup


def transition(N: int) -> Any:
    """Constant velocity of the target, biases that stay: matrices made once for each step of time."""
    from stonesoup.models.base import GaussianModel, LinearModel, TimeVariantModel
    from stonesoup.models.transition.base import TransitionModel

    made: dict[float, tuple[np.ndarray, np.ndarray]] = {}

    class Augmented(LinearModel, GaussianModel, TransitionModel, TimeVariantModel):
        """State x, vx, y, vy, headings, offsets."""

        @property
        def ndim_state(self) -> int:
            return 4 + 2 * N

        def of(self, interval: datetime.timedelta) -> tuple[np.ndarray, np.ndarray]:
            dt = interval.total_seconds()
            if dt not in made:
                F, Q = np.eye(self.ndim_state), np.zeros((self.ndim_state, self.ndim_state))
                for k in (0, 2):
                    F[k, k + 1] = dt
                    Q[k : k + 2, k : k + 2] = DRIVE**2 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
                made[dt] = F, Q
            return made[dt]

        def matrix(self, time_interval: datetime.timedelta, **_: Any) -> np.ndarray:
            return self.of(time_interval)[0]

        def covar(self, time_interval: datetime.timedelta, **_: Any) -> np.ndarray:
            return self.of(time_interval)[1]

    return Augmented()


def measurements(N: int, numerical: bool) -> list[Any]:
    """The radars: azimuth and range with the biases read from the state."""
    from stonesoup.base import Property
    from stonesoup.models.measurement.nonlinear import NonLinearGaussianMeasurement
    from stonesoup.types.angle import Bearing
    from stonesoup.types.array import StateVector, StateVectors

    class Biased(NonLinearGaussianMeasurement):
        """A radar whose heading and range offset are in the state."""

        place: np.ndarray = Property(doc="where it stands")
        number: int = Property(doc="which one it is")

        @property
        def ndim_meas(self) -> int:
            return 2

        def function(self, state: Any, noise: Any = False, **_: Any) -> Any:
            x = state.state_vector
            dx, dy = x[0] - self.place[0], x[2] - self.place[1]
            azimuth, ranges = np.arctan2(dy, dx) - x[4 + self.number], np.hypot(dx, dy) + x[4 + N + self.number]
            if x.shape[1] == 1:
                return StateVector([Bearing(float(np.ravel(azimuth)[0])), float(np.ravel(ranges)[0])])
            return StateVectors([[Bearing(a) for a in np.ravel(azimuth)], np.ravel(ranges)])

        def written(self, state: Any, **_: Any) -> np.ndarray:
            x = state.state_vector
            dx, dy = float(x[0, 0] - self.place[0]), float(x[2, 0] - self.place[1])
            square = dx**2 + dy**2
            H = np.zeros((2, 4 + 2 * N))
            H[0, [0, 2, 4 + self.number]] = -dy / square, dx / square, -1.0
            H[1, [0, 2, 4 + N + self.number]] = dx / square**0.5, dy / square**0.5, 1.0
            return H

    class Written(Biased):
        jacobian = Biased.written

    noise, mapping = np.diag([AZIMUTH**2, RANGE**2]), (0, 2)
    kind = Biased if numerical else Written
    return [
        kind(ndim_state=4 + 2 * N, mapping=mapping, noise_covar=noise, place=at, number=n)
        for n, at in enumerate(places(N))
    ]


def theirs(N: int, table: pd.DataFrame, numerical: bool) -> tuple[float, np.ndarray, np.ndarray]:
    """Rows a second of Stone Soup's filter, detections made before; means, sds (2 N,) of the biases at the end."""
    from stonesoup.predictor.kalman import ExtendedKalmanPredictor
    from stonesoup.types.angle import Bearing
    from stonesoup.types.array import StateVector
    from stonesoup.types.detection import Detection
    from stonesoup.types.hypothesis import SingleHypothesis
    from stonesoup.types.prediction import Prediction
    from stonesoup.types.state import GaussianState
    from stonesoup.updater.kalman import ExtendedKalmanUpdater

    models, origin = measurements(N, numerical), datetime.datetime(2026, 1, 1)
    motion = transition(N)
    predictor, updater = ExtendedKalmanPredictor(motion), ExtendedKalmanUpdater(force_symmetric_covariance=True)
    seen = [
        Detection(
            StateVector([Bearing(azimuth), ranges]),
            timestamp=origin + datetime.timedelta(seconds=t),
            measurement_model=models[int(name[1:])],
        )
        for t, name, ranges, azimuth in table[["time", "sensor", "range", "azimuth"]].itertuples(index=False)
    ]
    spread = [START["position"][1], START["velocity"][1]] * 2 + [HEADING] * N + [OFFSET] * N
    begun = time.perf_counter()
    state: Any = GaussianState(np.zeros((4 + 2 * N, 1)), np.diag(np.square(spread)), timestamp=origin)
    for one in seen:
        if one.timestamp > state.timestamp:
            before = predictor.predict(state, timestamp=one.timestamp)
        else:  # rows of one scan: nothing moved
            before = Prediction.from_state(state, transition_model=motion)
        state = updater.update(SingleHypothesis(before, one))
    rate = len(seen) / (time.perf_counter() - begun)
    return rate, np.ravel(state.state_vector)[4:].astype(float), np.sqrt(np.diag(state.covar))[4:]


# what is measured


def speed(chosen: argparse.Namespace) -> None:
    """Rows a second beside Stone Soup, and the delay of single rows."""
    there = importlib.util.find_spec("stonesoup") is not None
    ways = ("written", "numerical")[: there + (there and chosen.numerical)]
    for N in chosen.radars:
        table = circling(N, chosen.rows, chosen.apart)
        names = [f"r{n}.heading" for n in range(N)] + [f"r{n}.range_offset" for n in range(N)]
        rates: dict[Any, list[float]] = {}
        ends: dict[Any, tuple[np.ndarray, np.ndarray]] = {}
        for turn in range(1 + chosen.times):
            for lag in (0, 32):
                rate, online = ours(N, table, lag, chosen.chunk)
                found = online.biases.loc[names]
                ends[lag] = found["mean"].to_numpy(), found["sd"].to_numpy()
                rates.setdefault(lag, []).extend([rate] if turn else [])  # compiled at the first turn
            for way in ways if turn else ():
                rate, *ends[way] = theirs(N, table, way == "numerical")
                rates.setdefault(way, []).append(rate)
        best = {way: max(own) for way, own in rates.items()}
        print(f"{N} radars, {len(table):,} rows, {'each at a time of its own' if chosen.apart else 'scans'}:")
        for lag in (0, 32):
            print(f"  lag {lag}: {best[lag]:,.0f} rows/s" + _beside(lag, best, ends))
        for way in ways:
            print(f"  Stone Soup, Jacobians {way}: {best[way]:,.0f} rows/s", flush=True)
        for lag in (0, 32):
            print(f"  a row at a time, lag {lag}: {delays(N, table, lag, chosen.single)}", flush=True)


def _beside(lag: int, best: dict[Any, float], ends: dict[Any, tuple[np.ndarray, np.ndarray]]) -> str:
    if "written" not in ends:
        return ""
    (mean, sd), (other, spread) = ends[lag], ends["written"]
    ratios = ", ".join(f"{best[lag] / best[way]:.0f}" for way in ("written", "numerical") if way in best)
    off, apart = np.abs(mean - other) / sd, np.abs(sd / spread - 1.0)
    return f", {ratios} times Stone Soup; means differ by {off.max():.1e} sd, sds by {apart.max():.1e}"


def delays(N: int, table: pd.DataFrame, lag: int, rows: int) -> str:
    """Milliseconds of `update` with one row: the first, median and 95 % of the later half, and of the processor."""
    online, took, busy = Online(ring(N), target(), AugmentedFilter(lag=lag)), [], []
    for part in chunks(table.iloc[:rows], 1):
        begun, worked = time.perf_counter(), time.process_time()
        online.update(part)
        took.append(1e3 * (time.perf_counter() - begun))
        busy.append(1e3 * (time.process_time() - worked))
    late, alone = took[rows // 2 :], np.median(busy[rows // 2 :])
    return (
        f"median {np.median(late):.1f} ms ({alone:.1f} ms of the processor), 95 % below"
        f" {np.quantile(late, 0.95):.1f} ms, the first {took[0]:.0f} ms"
    )


def walking(run: pc.Simulation, N: int, seed: int) -> tuple[pd.DataFrame, dict[str, float]]:
    """A stream whose headings walk from their first values on, and the biases at its end."""
    rng = np.random.default_rng(seed)
    seconds = int(run.table["time"].max()) + 1
    steps = WALK * rng.standard_normal((seconds, N))
    steps[0] = 0.0
    walk = np.cumsum(steps, 0)
    at = run.table["time"].to_numpy(int), run.table["sensor"].str[1:].to_numpy(int)
    turned = run.table["azimuth"].to_numpy() - walk[at]
    table = run.table.assign(azimuth=(turned + np.pi) % (2 * np.pi) - np.pi)
    moved = {f"r{n}.heading": run.truth.biases[f"r{n}.heading"] + walk[-1, n] for n in range(N)}
    return table, dict(run.truth.biases) | moved


def coverage(chosen: argparse.Namespace) -> None:
    """Share of 89 % intervals that hold, and rms z, method by method."""
    N, T = chosen.radars[0], chosen.seconds
    walk = {"*.heading": WALK}
    cases: tuple[tuple[str, AugmentedFilter, tuple[str, ...]], ...] = (
        ("lag 0, extended", AugmentedFilter(lag=0), ("a", "b")),
        ("lag 32, extended", AugmentedFilter(), ("a", "b")),
        ("lag 0, cubature", AugmentedFilter("cubature", lag=0), ("a", "b")),
        ("lag 0, unscented", AugmentedFilter("unscented", lag=0), ("a", "b")),
        ("walking headings, lag 0", AugmentedFilter(lag=0, walk=walk), ("a", "b")),
        ("walking headings, lag 32", AugmentedFilter(walk=walk), ("a", "b")),
        ("walking headings, lag 0, one target", AugmentedFilter(lag=0, walk=walk), ("a",)),
        ("walking headings, taken to stay, lag 0", AugmentedFilter(lag=0), ("a", "b")),
    )
    begun, z = time.perf_counter(), {name: [] for name, *_ in cases}
    for run in range(chosen.runs):
        streams = {names: drawn(N, T, names, chosen.seed + run) for names in {own[2] for own in cases}}
        for name, method, names in cases:
            table, true = streams[names].table, streams[names].truth.biases
            if "walking" in name:
                table, true = walking(streams[names], N, chosen.seed + run)
            online = Online(ring(N), {n: target() for n in names}, method)
            online.update(table)
            found = online.biases
            z[name].append((found["mean"] - pd.Series(true)[found.index]) / found["sd"])
    print(f"{chosen.runs} streams of {T} s, {N} radars, {time.perf_counter() - begun:.0f} s:")
    for name, own in z.items():
        whole = np.array([run.to_numpy() for run in own])
        heading = own[0].index.str.endswith("heading")
        print(f"  {name}: {_held(whole)}; headings {_held(whole[:, heading])}, offsets {_held(whole[:, ~heading])}")


def _held(z: np.ndarray) -> str:
    """Share within 89 % intervals and rms of z (runs, biases), with standard errors over runs."""
    held, square = (np.abs(z) < HALF).mean(1), (z**2).mean(1)
    error = [own.std(ddof=1) / np.sqrt(len(own)) for own in (held, square)]
    rms = np.sqrt(square.mean())
    return f"{100 * held.mean():.1f} ± {100 * error[0]:.1f} %, rms z {rms:.2f} ± {error[1] / (2 * rms):.2f}"


def jumps(chosen: argparse.Namespace) -> None:
    """Jumps that are found, when, and false alarms in an hour, for two lags."""
    for lag in chosen.lags:
        method = AugmentedFilter(chosen.by, lag, jumps=Jumps(chosen.alarms))
        found = [_jumping(chosen, method, run) for run in range(chosen.runs)]
        right = [own for own in found if own[0] is not None]
        held = [abs(j.size - size) < HALF * j.sd for j, _, size, *_ in right]
        print(f"lag {lag}, {chosen.by}, {chosen.runs} jumps by two scales, updates of {chosen.step:g} s:")
        before, after = np.sum([own[3:] for own in found], 0)
        print(f"  found {len(right) / len(found):.1%}; said to jump besides: {before} before it, {after} after it")
        if right:
            late, bound = np.array([[j.found - at, j.bound] for j, at, *_ in right]).T
            began = np.array([j.since - at for j, at, *_ in right])
            print(f"  delay: median {np.median(late):.1f} s, 95 % below {np.quantile(late, 0.95):.1f} s")
            print(f"  `bound` after `since`: median {np.median(bound):.1f} s; `since` off by {np.median(began):+.1f} s")
            print(f"  sizes within their 89 % intervals: {np.mean(held):.1%}", flush=True)
        alarms = [len(_stream(chosen, method, drawn(5, chosen.quiet, ("a", "b"), 10**6 + run).table).jumps)
                  for run in range(chosen.streams)]  # fmt: skip
        hours = chosen.streams * chosen.quiet / 3600
        print(f"  false alarms: {sum(alarms)} in {hours:.1f} h, stated at most {chosen.alarms * hours:.1f}", flush=True)


def _stream(chosen: argparse.Namespace, method: AugmentedFilter, table: pd.DataFrame) -> Online:
    """A filter after a stream that came by some seconds at a time."""
    online = Online(ring(5), {n: target() for n in ("a", "b")}, method)
    for _, part in table.groupby(table["time"] // chosen.step):
        online.update(part)
    return online


def _jumping(chosen: argparse.Namespace, method: AugmentedFilter, run: int) -> tuple[Any, float, float, int, int]:
    """The jump that was found of the one that is there, or None; when it was, its size, others before and after it."""
    T = chosen.seconds
    stream, at, size = drawn(5, T, ("a", "b"), run), T / 2 - 0.5, 2 * HEADING
    mine = (stream.table["sensor"] == "r2") & (stream.table["time"] > at)
    turned = stream.table["azimuth"] - size * mine
    online = _stream(chosen, method, stream.table.assign(azimuth=(turned + np.pi) % (2 * np.pi) - np.pi))
    right = [j for j in online.jumps if j.label == "r2.heading" and j.found > at]
    early = sum(j.found < at for j in online.jumps)
    return (right[0] if right else None), at, size, early, len(online.jumps) - early - min(len(right), 1)


def end(chosen: argparse.Namespace) -> None:
    """Where the filter ends, beside the batch."""
    module, problem = load_problem(MODEL, None)
    table = module.scenario().table
    tree = pc.fit(problem, method=pc.MAP(trajectory="joint"), prior=pc.Gaussian())
    batch = tree["calibration"].to_dataset()
    mean, sd = (pd.Series(batch[name].values, batch["bias_label"].values) for name in ("mean", "sd"))
    print(f"batch: {tree.attrs['status']}, {len(mean)} biases")
    for lag in (0, 32, 64, 128):
        online = Online(problem.network, problem.motion, AugmentedFilter(lag=lag))
        news = online.update(table)
        found = online.biases
        off = ((found["mean"] - mean) / sd).abs()
        apart = (found["sd"] / sd - 1.0).abs()
        print(
            f"lag {lag}: means differ by {off.max():.1e} sd (median {off.median():.1e}), sds by {apart.max():.1e};"
            f" {news.passes} passes, {'settled' if news.settled else 'not settled'}",
            flush=True,
        )


def main() -> None:
    """One of the four."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    verbs = parser.add_subparsers(required=True)

    def verb(function: Callable[[argparse.Namespace], None], **numbers: float) -> argparse.ArgumentParser:
        own = verbs.add_parser(function.__name__, help=(function.__doc__ or "").split("\n")[0])
        own.set_defaults(run=function)
        for name, value in numbers.items():
            own.add_argument(f"--{name}", type=type(value), default=value)
        return own

    own = verb(speed, rows=20_000, chunk=5_000, times=4, single=600)
    own.add_argument("radars", nargs="*", type=int, default=[5, 20])
    own.add_argument("--apart", action="store_true", help="each row at a time of its own")
    own.add_argument("--numerical", action="store_true", help="Stone Soup with its own Jacobians too")
    own = verb(coverage, runs=200, seconds=60, seed=0)
    own.add_argument("radars", nargs="*", type=int, default=[5])
    own = verb(jumps, runs=100, seconds=240, step=2.0, alarms=0.1, streams=20, quiet=600)
    own.add_argument("--lags", nargs="*", type=int, default=[0, 32])
    own.add_argument("--by", default="extended", help="linearisation")
    verb(end)
    chosen = parser.parse_args()
    chosen.run(chosen)


if __name__ == "__main__":
    main()
