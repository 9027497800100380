"""Do words keep their promise? Statuses, verdicts and warnings of fits whose truth is known, right models and wrong.

uv run python benchmarks/verdicts.py --runs 100 --case beacons --case noise-halved

One line a case: how fits ended; share of 89 % intervals that hold the truth, of all and of the non-zero biases; share
of the biases called `determined` that lie beyond 4 sd; share of those with gamma above 0.9 that are called so; share of
runs with a warning, and of what kind.
"""

import argparse
import sys
from collections import Counter
from pathlib import Path

import numpy as np

from probcal import ConstantVelocity, Network, Node, Problem, Target, assess, simulate
from probcal.errors import FitError
from probcal.inference.fit import calibrate
from probcal.sensors import doa

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


NAMES = ("beacons", "clocks", "pass", "bearings")
NOISES = {"beacons": 0.1, "clocks": 0.05, "pass": 0.05, "bearings": 0.03, "signal": 0.05}
NOTES = ("gain", "loo", "motion")  # kinds of findings that warn of nothing; smooth paths are not drawn from a motion
RIGHT = {f"{name} own path": own(name, 0.3, noise) for name, noise in NOISES.items()}
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
MIRRORS = {name: right(name, 0.5) for name in ("line", "ceiling", "beside")}
CASES = RIGHT | SMOOTH | MIRRORS | WRONG


def one(case, run):
    """What one run says: status, and (off in sd, held, non-zero, gamma, verdict) of its biases; kinds of findings."""
    problem, truth = CASES[case](run)
    try:
        tree, _ = calibrate(problem, key=run)
    except FitError:
        return "refused", None, []
    tree = assess(problem, tree)
    group = tree["calibration"].to_dataset()
    true = np.array([truth.biases.get(str(label), 0.0) for label in group["bias_label"].values])
    off = np.abs(group["mean"].values - true) / group["sd"].values
    held = (group["lower"].values <= true) & (true <= group["upper"].values)
    said = tree["finding"].to_dataset()
    pairs = zip(said["kind"].values.tolist(), said["subject"].values.tolist(), strict=True)
    kinds = list(dict.fromkeys("motion" if subject.startswith("motion.") else kind for kind, subject in pairs))
    told = group["gamma"].values > PULLED
    return tree.attrs["status"], (off, held, true != 0, told, tree["verdict"]["verdict"].values.astype(str)), kinds


def line(case, runs):
    """The line of a case."""
    statuses, kinds, warned, parts = Counter(), Counter(), 0, []
    for run in range(runs):
        status, part, found = one(case, run)
        statuses[str(status)] += 1
        kinds.update(found)
        warned += bool(set(found) - set(NOTES)) or status != "converged"
        parts += [] if part is None else [part]
    if not parts:
        return f"| {case} | refused {runs} | | | | 100 % |"
    off, held, nonzero, told, word = (np.concatenate(column) for column in zip(*parts, strict=True))
    called = word == "determined"
    far = f"{100 * (off[called] > FAR).mean():.1f} % of {called.sum()}" if called.any() else "none called"
    right = f"{100 * called[told].mean():.0f} % of {told.sum()}" if told.any() else "none told"
    ended = ", ".join(f"{name} {count}" for name, count in statuses.most_common())
    named = ", ".join(f"{name} {count}" for name, count in kinds.most_common())
    cover = f"{held.mean():.2f} / {held[nonzero].mean():.2f}"
    return f"| {case} | {ended} | {cover} | {far} | {right} | {100 * warned / runs:.0f} % ({named}) |"


def main():
    """Print the table."""
    ask = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    ask.add_argument("--runs", type=int, default=100)
    ask.add_argument("--case", action="append", choices=["right", "smooth", "mirrors", "wrong", *CASES])
    given = ask.parse_args()
    head = ("case", "ended", "held", "determined beyond 4 sd", "gamma > 0.9 determined", "runs with a warning")
    print(f"| {' | '.join(head)} |", "|---" * len(head) + "|", sep="\n", flush=True)
    groups = {"right": RIGHT, "smooth": SMOOTH, "mirrors": MIRRORS, "wrong": WRONG}
    asked = [name for case in given.case or groups for name in groups.get(case, [case])]
    for case in asked:
        print(line(case, given.runs), flush=True)


if __name__ == "__main__":
    main()
