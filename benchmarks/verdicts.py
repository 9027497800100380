"""Do words keep their promise? Statuses, verdicts and warnings of fits whose truth is known, right models and wrong.

uv run python benchmarks/verdicts.py --runs 100 --case beacons --case noise-halved
uv run python benchmarks/verdicts.py --runs 200 --case own --file runs.jsonl
uv run python benchmarks/verdicts.py --runs 25 --case faults

One row a case: how fits ended; share of 89 % intervals that hold the truth, of all and of the non-zero biases; share of
the biases called `determined` that lie beyond 4 sd; share of those with gamma above 0.9 that are called so; share of
runs with a warning, and of what kind. Then how many of what is called `determined`, and of the coordinates of tracks,
lie within 2, 3 and 4 sd. Of `faults` that move a bias by 5 sd: how often they are named. Of paths
drawn from their motion: false alarms by kind. Last, seconds of each check; the first pays for what all ask.
"""

import argparse
import json
import sys
from collections import Counter
from dataclasses import replace
from functools import partial
from pathlib import Path
from time import perf_counter
from unittest.mock import patch

import jax.numpy as jnp
import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.signal import lfilter
from scipy.stats import beta

from probcal import (
    MAP,
    Bias,
    Channel,
    ConstantVelocity,
    Gaussian,
    Network,
    Node,
    Problem,
    RandomWalk,
    Target,
    assess,
    fit,
    sensor,
    simulate,
)
from probcal.analysis.checks import CHECKS
from probcal.cli.models import load_problem, load_truth
from probcal.errors import FitError
from probcal.geometry import norm
from probcal.inference.fit import calibrate
from probcal.labels import coordinates
from probcal.results.read import each_track
from probcal.sensors import doa
from probcal.status import Status

sys.path.insert(0, str(Path(__file__).parents[1] / "models"))
import networks
import radars

STATED = {"position": ((-600.0, 1000.0), 50.0), "velocity": ((20.0, 0.0), 5.0)}  # start of `compact`
FAR, PULLED = 4.0, 0.9  # sd of a wrong answer, gamma of a bias that the data tell


def right(name, share):
    """A network of `models/networks.py`, everything as declared."""
    return lambda run: networks.setting(run, name, share)


def own(name, share, noise):
    """The same with a path that is drawn from its motion, so that every warning is a false one."""
    return lambda run: networks.own_path(name, run, share, noise)


def scene(name, share):
    """A scenario of `models/radars.py`."""
    return lambda run: radars.setting(run, scenario=name, share=share)


def beacons(run, change=None, noise=0.5, path=None, outliers=0.0):
    """Six beacons, a third of the biases non-zero; the table changed, the noise or the path not as declared."""
    placed, drawn = networks.recording("beacons", run, 0.3)
    if path is not None or outliers:
        time = 0.5 * np.arange(100)
        route = path(time) if path else np.stack([40 + 30 * np.cos(time / 7), 22 + 16 * np.sin(time / 4.5)], 1)
        drawn = simulate(
            placed, networks.motion("beacons"), time, key=run,
            biases=drawn.truth.biases, tracks={"target": route}, outliers=outliers,
        )  # fmt: skip
    table = drawn.table.copy()
    if change:
        change(table)
    return Problem(placed, ConstantVelocity(noise), table), drawn.truth


def stated(value):
    def change(table):
        table["range_std"] = value

    return change


def added(of):
    def change(table):
        mine = table["sensor"] == "b1"
        table.loc[mine, "range"] += of(table["time"][mine])

    return change


def late(table):
    mine = table["sensor"] == "b3"
    values = table.loc[mine, "range"].to_numpy()
    table.loc[mine, "range"] = np.r_[values[:1], values[:-1]]


def leaping(time):
    return np.stack(
        [40 + 30 * np.cos(time / 7) + 6 * np.sign(np.sin(time / 3)), 22 + 16 * np.sin(time / 4.5)], 1
    )  # jumps of 12 m


def directions(run, places, free, path, motion):
    """Direction finders, the first one known; biases drawn at their scales."""
    network = Network([doa.on(Node(f"d{k}", place, scale=free if k else None)) for k, place in enumerate(places)])
    time = np.arange(float(len(path)))
    drawn = simulate(network, motion, time, key=run, share=1.0, tracks={"target": path})
    return Problem(network, motion, drawn.table), drawn.truth


@sensor(range=Channel("m", std=0.035))
def slant(target, pose, *, range_offset=Bias("m", 0.2)):
    """Range to a target whose height is a state of its own."""
    return dict(range=jnp.hypot(norm(target.position - pose.position), target.height - pose.height) + range_offset)


def heights(run, targets=1):
    """Four anchors nearly in a plane; offsets and heights that hardly change, drawn from their priors."""
    places = [(-3, -3, 1.54), (3, -3, 1.60), (-3, 3, 1.66), (3, 3, 1.58)]
    network = Network([slant.on(Node(f"a{k}", place[:2], height=place[2])) for k, place in enumerate(places)])
    start = {"position": ((0, 0), 1.5), "velocity": ((0, 0), 0.2)}
    motion = Target(ConstantVelocity(0.05) + RandomWalk("height", "m", 0.003, (1.6, 0.7)), start)
    motion = {f"tag{k}": motion for k in range(targets)} if targets > 1 else motion
    made = simulate(network, motion, np.arange(0, 40, 0.1), key=run)
    return Problem(network, motion, made.table), made.truth


def compact(run, start=None):
    """An array of 20 m and a target at 1 km, its start not declared unless given."""
    time = np.arange(60.0)
    path = np.stack([-600 + 20 * time, 1000 + 0 * time], 1)
    places = [(0, 0), (20, 0), (20, 20), (0, 20)]
    return directions(run, places, {"heading": np.deg2rad(3)}, path, Target(ConstantVelocity(0.3), start or {}))


def anchored(scale):
    """Five direction finders, one of them known: only the motion tells the size of the scene."""

    def make(run):
        time = np.arange(80.0)
        path = np.stack([100 + 80 * np.cos(time / 12), 75 + 50 * np.sin(time / 7)], 1)
        places = [(0, 0), (200, 0), (200, 150), (0, 150), (100, -40)]
        free = {"position": scale, "heading": np.deg2rad(3)}
        return directions(run, places, free, path, ConstantVelocity(0.5))

    return make


def wrong_of(sensor, column, change):
    """Readings of one sensor that a function of them, their times, a size and a generator makes wrong."""

    def wrong(table, size, rng):
        mine = table["sensor"] == sensor
        values, time = (table.loc[mine, name].to_numpy() for name in (column, "time"))
        table = table.copy()
        table.loc[mine, column] = change(values, time, size, rng)
        return table

    return wrong


def correlated(table, size, rng):
    """Two sensors that share an error with a memory of 5 rows."""
    mine = table["sensor"].isin(["m3", "m4"])
    noise = lfilter([1.0], [1.0, -np.exp(-0.2)], rng.standard_normal(table["time"].nunique()))
    at = np.searchsorted(np.unique(table["time"]), table["time"])
    return table.assign(arrival=table["arrival"] + np.where(mine, size * noise[at], 0.0))


def half_on(values, time, size, rng):
    """A jump halfway."""
    return values + size * (time > np.median(time))


def some(values, time, size, rng):
    """A twentieth of the readings too large."""
    return values + size * (rng.random(len(values)) < 0.05)


def smooth(values):
    """Readings without their noise, nearly, so that a fault leaves that as it is."""
    return gaussian_filter1d(values, 4.0, mode="nearest")


def delayed(values, time, size, rng):
    """Each reading that of a time before."""
    return values - size * np.gradient(smooth(values), time)


def stretched(values, time, size, rng):
    """Readings too large in proportion."""
    return values + size * smooth(values)


def apart(problem, other):
    """By how many sds a bias moves at most from one problem to another, and how many the data tell."""
    one, other = (fit(own, MAP(), prior=Gaussian()) for own in (problem, other))
    before, after = (tree["calibration"]["mean"].values for tree in (one, other))
    moved, scale = np.abs(after - before) / one["calibration"]["sd"].values, problem.scales
    prior = 0.5 * np.sum((before**2 - after**2) / scale**2)
    fall = one.attrs["log_evidence"] - other.attrs["log_evidence"] + prior
    return float(moved.max()), float(np.sqrt(max(2.0 * fall, 0.0)))


def faulty(network, wrong, unit=None):
    """An own path without and with a fault.

    Given a size to begin with, that of the fault is such that a bias moves by `MOVED` sd under a Gaussian prior, or the
    data tell it by `TOLD`, whichever is less.
    """

    def make(run):
        problem, truth = networks.own_path(network, run, 0.3, NOISES[network])
        table, size = problem.measurements.table.frame, unit

        def changed(size):
            return problem.rebuild(wrong(table, size, np.random.default_rng(run)))

        for _ in range(3 if unit else 0):
            moved, told = apart(problem, changed(size))
            size *= np.clip(min(MOVED / max(moved, 1e-9), TOLD / max(told, 1e-9)), 0.1, 10.0)
        return changed(size), truth, problem

    return make


NAMES = ("beacons", "clocks", "pass", "bearings")
MOVED, TOLD = 5.0, 12.0  # sd by which a fault moves a bias, and by which the data tell it at most
NOISES = {"beacons": 0.1, "clocks": 0.05, "pass": 0.05, "bearings": 0.03, "signal": 0.05}
NOTES = ("gain", "loo", "motion")  # kinds of findings that warn of nothing; smooth paths are not drawn from a motion
RIGHT = {f"{name} own path": own(name, 0.3, noise) for name, noise in NOISES.items()}
RIGHT["heights own path"] = heights
RIGHT |= {f"{name} {share:g}": scene(name, share) for name in ("C1", "C2") for share in (0.3, 1.0)}
SMOOTH = {f"{name} {share:g}": right(name, share) for name in NAMES for share in (0.3, 1.0)}
WRONG = {
    "noise-halved": lambda run: beacons(run, stated(0.5)),
    "noise-doubled": lambda run: beacons(run, stated(2.0)),
    "outliers": lambda run: beacons(run, outliers=0.1),
    "motion-20-times-less": lambda run: beacons(run, noise=0.02),
    "motion-20-times-more": lambda run: beacons(run, noise=10.0),
    "leaps": lambda run: beacons(run, path=leaping),
    "oscillating": lambda run: beacons(run, added(lambda time: 3 * np.sin(time / 8))),
    "drifting": lambda run: beacons(run, added(lambda time: 0.08 * time)),
    "late": lambda run: beacons(run, late),
    "compact": compact,
    "compact-stated": lambda run: compact(run, STATED),
    "anchored-10": anchored(10.0),
    "anchored-30": anchored(30.0),
    "signal": right("signal", 0.3),
}
FAULTS = {  # a case, and the kinds of finding that name what is wrong
    "a beacon drifts": (
        faulty("beacons", wrong_of("b1", "range", lambda y, t, a, _: y + a * t / t.max()), 1.0), "drifting",
    ),
    "a beacon jumps halfway": (faulty("beacons", wrong_of("b1", "range", half_on), 1.0), "drifting"),
    "a beacon goes to and fro": (
        faulty("beacons", wrong_of("b1", "range", lambda y, t, a, _: y + a * np.sin(t / 4)), 0.5),
        "drifting whiteness widened",
    ),
    "a beacon is late": (faulty("beacons", wrong_of("b3", "range", delayed), 0.2), "slope"),
    "a twentieth of a beacon's ranges too long": (
        faulty("beacons", wrong_of("b1", "range", some), 3.0), "outliers",
    ),
    "azimuths off by the sine of the direction": (
        faulty("pass", wrong_of("r1", "azimuth", lambda y, t, a, _: y + a * np.sin(y)), 0.01), "slope",
    ),
    "ranges off in proportion": (
        faulty("pass", wrong_of("r1", "range", stretched), 0.02), "slope",
    ),
    "azimuths the other way round": (faulty("pass", wrong_of("r1", "azimuth", lambda y, *_: -y)), "recoded"),
    "a heading that jumps halfway": (faulty("pass", wrong_of("r1", "azimuth", half_on), 0.02), "drifting"),
    "two clocks that share an error": (faulty("clocks", correlated, 0.3), "drifting whiteness widened"),
    "noise of a beacon twice the declared": (
        faulty("beacons", wrong_of("b1", "range", lambda y, t, a, rng: y + np.sqrt(3) * rng.standard_normal(len(y)))),
        "level nis",
    ),
}  # fmt: skip
MIRRORS = {name: right(name, 0.5) for name in ("line", "ceiling", "beside")}
CASES = RIGHT | SMOOTH | MIRRORS | WRONG | {name: make for name, (make, _) in FAULTS.items()}
OWN = [name for name in RIGHT if name.endswith("own path")]
RECORDED = {
    "plaza": None, "plaza_free": None, "robots": "mrclam/MRCLAM_Dataset6", "sflab": "sflab_mic_toa/dataset_1_exp2.mat",
    "tdoa_flight": "uwb_tdoa", "ble_office": "ble_rss", "bearing_beacons": "roh_bearing",
}  # fmt: skip
GROUPS = {
    "own": OWN,
    "right": [*RIGHT],
    "smooth": [*SMOOTH],
    "mirrors": [*MIRRORS],
    "wrong": [*WRONG],
    "faults": [*FAULTS],
}
GROUPS["recordings"] = [f"recording {name}" for name in RECORDED]
SETTLED = [str(status) for status in Status if status.settled]
DISTANCES = (2.0, 3.0, 4.0)  # sd
WITHIN = [f"within {sd:g} sd, %" for sd in DISTANCES]
MODELS = Path(networks.__file__).parent
SHARED = MODELS.parent.parent / "shared" / "data"


def recorded(name, data):
    """A recording and the truth beside it, as its model file declares them."""

    def make(run):
        path = None if data is None else SHARED / data
        module, problem = load_problem(MODELS / f"{name}.py", path)
        return problem, load_truth(module, MODELS / f"{name}.py", path, problem)

    return make


RECORDINGS = {f"recording {name}": recorded(name, data) for name, data in RECORDED.items()}
CASES |= RECORDINGS


def one(case, run):
    """One run as plain data: lists of its biases; counts of the coordinates of its tracks, as `beyond`."""
    problem, truth, *clean = CASES[case](run)
    said = {"case": case, "run": run}
    try:
        tree, _ = calibrate(problem, key=run)
    except FitError:
        return said | {"status": "refused", "kinds": [], "tracks": [0, 0, 0, 0]}
    seconds = dict.fromkeys(CHECKS, 0.0)
    said["apart"] = [apart(own, problem) for own in clean]
    with patch.dict(
        CHECKS, {name: replace(own, function=partial(timed, seconds, name, own)) for name, own in CHECKS.items()}
    ):
        tree = assess(problem, tree)
    findings = tree["finding"].to_dataset()
    said["sentences"] = findings["sentence"].values.tolist()
    pairs = zip(findings["kind"].values.tolist(), findings["subject"].values.tolist(), strict=True)
    kinds = list(dict.fromkeys("motion" if subject.startswith("motion.") else kind for kind, subject in pairs))
    said |= {
        "status": tree.attrs["status"],
        "kinds": kinds,
        "seconds": seconds,
        "tracks": beyond(positions_off(tree, truth)).tolist(),
    }
    group = tree["calibration"].to_dataset().assign(word=tree["verdict"]["verdict"])
    true = np.array([truth.biases.get(str(label), np.nan) for label in group["bias_label"].values])
    group = group.isel(bias_label=np.isfinite(true))
    true = true[np.isfinite(true)]
    columns = {
        "off": np.abs(group["mean"].values - true) / group["sd"].values,
        "held": (group["lower"].values <= true) & (true <= group["upper"].values),
        "nonzero": true != 0,
        "told": group["gamma"].values > PULLED,
        "word": group["word"].values.astype(str),
    }
    return said | {name: column.tolist() for name, column in columns.items()}


def timed(seconds, name, check, case):
    """What a check finds, its seconds kept."""
    began = perf_counter()
    found = check(case)
    seconds[name] = round(perf_counter() - began, 4)
    return found


def positions_off(tree, truth):
    """Error of each coordinate of each position, in sd."""
    off = [np.zeros(0)]
    for name, track in each_track(tree):
        axes = coordinates(track["component"].values.tolist())
        at = track["time"].values
        true = truth.positions(at, np.full(len(at), name), len(axes)) if truth.tracks is not None else np.nan
        mean, sd = (track[of].sel(component=axes).values for of in ("mean", "sd"))
        with np.errstate(divide="ignore", invalid="ignore"):
            off.append((np.abs(mean - true) / np.where(sd > 0, sd, np.nan)).ravel())
    return np.concatenate(off)


def beyond(off):
    """Number of errors, and of those above 2, 3 and 4 sd."""
    return np.array([np.isfinite(off).sum(), *((off > sd).sum() for sd in DISTANCES)])


def made(case, run, kept, file):
    """One run, from the file of runs if it is there, else made and added to it."""
    if (case, run) not in kept:
        kept[case, run] = one(case, run)
        if file:
            with file.open("a") as lines:
                lines.write(json.dumps(kept[case, run]) + "\n")
    return kept[case, run]


def columns(runs, *names):
    """Lists of biases of all runs that have an answer, laid end to end."""
    return [np.concatenate([np.array(run[name]) for run in runs if name in run] or [np.zeros(0)]) for name in names]


def row_of_words(case, runs):
    """The row of a case in the table of words."""
    statuses = Counter(run["status"] for run in runs)
    kinds = Counter(kind for run in runs for kind in run["kinds"])
    warned = sum(bool(set(run["kinds"]) - set(NOTES)) or run["status"] != "converged" for run in runs)
    if set(statuses) == {"refused"}:
        return f"| {case} | refused {len(runs)} | | | | 100 % |"
    off, held, nonzero, told, word = columns(runs, "off", "held", "nonzero", "told", "word")
    called, nonzero, told = word == "determined", nonzero.astype(bool), told.astype(bool)
    far = f"{100 * (off[called] > FAR).mean():.1f} % of {called.sum()}" if called.any() else "none called"
    right = f"{100 * called[told].mean():.0f} % of {told.sum()}" if told.any() else "none told"
    ended = ", ".join(f"{name} {count}" for name, count in statuses.most_common())
    named = ", ".join(f"{name} {count}" for name, count in kinds.most_common())
    cover = f"{held.mean():.2f} / {held[nonzero].mean():.2f}" if nonzero.any() else "truth not known"
    return f"| {case} | {ended} | {cover} | {far} | {right} | {100 * warned / len(runs):.0f} % ({named}) |"


def row_of_reliability(case, runs):
    """Share of what is called determined, and of the tracks of settled fits, within 2, 3 and 4 sd of the truth."""
    off, word = columns(runs, "off", "word")
    biases = beyond(off[word == "determined"])
    tracks = np.sum([run["tracks"] for run in runs if run["status"] in SETTLED] or [np.zeros(4, int)], 0)

    def cells(counts):
        shares = [f"{100 - 100 * count / counts[0]:.1f}" if counts[0] else "" for count in counts[1:]]
        return " | ".join([f"{counts[0]}", *shares])

    return f"| {case} | {len(runs)} | {cells(biases)} | {cells(tracks)} |"


def row_of_power(case, runs):
    """How often a fault is named by a finding of its kind, and by any; what it does to the biases and the data."""
    kinds, count = set(FAULTS[case][1].split()), len(runs)
    named = sum(bool(kinds & set(run["kinds"])) for run in runs)
    warned = sum(bool(set(run["kinds"]) - set(NOTES)) or run["status"] != "converged" for run in runs)
    moved, told = np.median([pair for run in runs for pair in run.get("apart", [])], 0)
    return (
        f"| {case} | {', '.join(sorted(kinds))} | {named} of {count} | {warned} of {count} | {moved:.1f} | {told:.1f} |"
    )


def rows_of_seconds(runs):
    """Median and largest seconds of each check over simulated fits and recordings."""
    for name in CHECKS:
        cells = []
        for recorded in (False, True):
            own = [run["seconds"][name] for run in runs if "seconds" in run and (run["case"] in RECORDINGS) == recorded]
            cells += [f"{np.median(own):.2f}", f"{np.max(own):.2f}"] if own else ["", ""]
        yield f"| {name} | {' | '.join(cells)} |"


def rows_of_rates(runs):
    """False alarms by kind of finding among settled fits of right models, with 95 % intervals."""
    settled = [run for run in runs if run["status"] in SETTLED]
    kinds = Counter(kind for run in settled for kind in run["kinds"] if kind not in NOTES)
    kinds["any of these"] = sum(bool(set(run["kinds"]) - set(NOTES)) for run in settled)
    rows, count = [], len(settled)
    for kind, hits in sorted(kinds.items(), key=lambda pair: (pair[0] == "any of these", -pair[1])):
        lower = beta.ppf(0.025, hits, count - hits + 1) if hits else 0.0
        upper = beta.ppf(0.975, hits + 1, count - hits) if hits < count else 1.0
        rows.append(
            f"| {kind} | {hits} of {count} | {100 * hits / count:.1f} | {100 * lower:.1f} to {100 * upper:.1f} |"
        )
    return rows


def table(title, head, rows):
    """Print a table as its rows come."""
    print(f"\n{title}\n", f"| {' | '.join(head)} |", "|---" * len(head) + "|", sep="\n", flush=True)
    for row in rows:
        print(row, flush=True)


def main():
    """Print the tables."""
    ask = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    ask.add_argument("--runs", type=int, default=100, help="runs of each case; a recording has one")
    ask.add_argument("--case", action="append", choices=[*GROUPS, *CASES])
    ask.add_argument("--file", type=Path, help="a file of runs, a line each: those in it are not made again")
    given = ask.parse_args()
    asked = [name for case in given.case or GROUPS for name in GROUPS.get(case, [case])]
    lines = given.file.read_text().splitlines() if given.file and given.file.exists() else []
    kept = {(run["case"], run["run"]): run for run in map(json.loads, lines)}
    found = dict[str, list]()

    def words():
        for case in asked:
            numbers = range(1 if case in RECORDINGS else given.runs)
            found[case] = [made(case, run, kept, given.file) for run in numbers]
            yield row_of_words(case, found[case])

    head = ("case", "ended", "held", "determined beyond 4 sd", "gamma > 0.9 determined", "runs with a warning")
    table("What the words say", head, words())
    head = ("case", "runs", "determined", *WITHIN, "coordinates of tracks", *WITHIN)
    table("What they are worth", head, (row_of_reliability(case, runs) for case, runs in found.items()))
    own_paths = [run for case, runs in found.items() if case in OWN for run in runs]
    if own_paths:
        head = ("finding", "fits", "%", "95 % interval")
        table("False alarms, all own paths together", head, rows_of_rates(own_paths))
    faults = [case for case in found if case in FAULTS]
    if faults:
        head = ("fault", "finding", "named", "any warning", "moves a bias by, sd", "told by the data, sd")
        table("Power", head, (row_of_power(case, found[case]) for case in faults))
    head = ("check", "simulated, median", "largest", "recordings, median", "largest")
    table("Seconds", head, rows_of_seconds([run for runs in found.values() for run in runs]))


if __name__ == "__main__":
    main()
