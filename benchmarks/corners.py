"""What does process noise with heavy tails buy where targets go straight and then turn? Paired runs, and recordings.

uv run python benchmarks/corners.py --runs 100
uv run python benchmarks/corners.py --recordings

Runs: the beacons of `models/networks.py` and a target that turns five times, level of the process noise unknown; one
line a family. Recordings: those with motion, as their models declare it and with `noise=StudentT(4)`; some lie beside
the project only.
"""

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from probcal import Problem, StudentT, assess
from probcal.inference.fit import calibrate
from probcal.motion import LinearMotion
from probcal.results.scores import position_rmse

sys.path.insert(0, str(Path(__file__).parents[1] / "models"))
import networks
import plaza
import sflab
import tdoa_flight

DATA = Path(__file__).parents[2] / "shared" / "data"


def run(number, tails):
    """What one run says: errors of biases and track, shares held, whether the motion is named, status, seconds."""
    problem, truth = networks.setting(number, "corners", 0.3, tails)
    began = time.perf_counter()
    tree, _ = calibrate(problem, key=number)
    seconds = time.perf_counter() - began
    group = tree["calibration"].to_dataset()
    true = np.array([truth.biases.get(label, 0.0) for label in problem.labels])
    held = (group["lower"].values <= true) & (true <= group["upper"].values)
    error = float(np.sqrt(np.mean(((group["mean"].values - true) / problem.scales) ** 2)))
    findings = assess(problem, tree)["finding"]
    return {
        "error": error, "track": position_rmse(tree, truth)[1], "held": held.mean(),
        "nonzero": held[true != 0].mean(), "motion": "motion" in findings["kind"].values,
        "converged": tree.attrs["status"] == "converged", "seconds": seconds,
    }  # fmt: skip


def simulated(runs):
    """The table of the simulated runs."""
    print("| process noise | bias error, scales | track, m | over Gaussian: biases, tracks | held, all / non-zero |"
          " motion named | converged | median s |\n|---|---|---|---|---|---|---|---|", flush=True)  # fmt: skip
    base = None
    for tails in networks.TAILS:
        found = [run(number, tails) for number in range(runs)]
        column = {name: np.array([one[name] for one in found], float) for name in found[0]}
        base = column if base is None else base
        ratios = [np.log(column[name] / base[name]) for name in ("error", "track")]
        told = ", ".join(f"{np.exp(r.mean()):.3f} +- {r.std() / np.sqrt(runs):.3f}" for r in ratios)
        spread = column["error"].std() / np.sqrt(runs)
        cells = [
            tails, f"{column['error'].mean():.3f} +- {spread:.3f}", f"{column['track'].mean():.3f}", told,
            f"{column['held'].mean():.2f} / {np.nanmean(column['nonzero']):.2f}",
            f"{100 * column['motion'].mean():.0f} %", f"{100 * column['converged'].mean():.0f} %",
            f"{np.median(column['seconds']):.2f}",
        ]  # fmt: skip
        print(f"| {' | '.join(cells)} |", flush=True)


def heavy(problem):
    """The problem with heavy tails in the noise of velocities."""
    motion = problem.motion if isinstance(problem.motion, LinearMotion) else LinearMotion((problem.motion,))
    parts = [replace(c, noise=StudentT(4.0)) if hasattr(c, "noise") else c for c in motion.components]
    return Problem(problem.network, LinearMotion(tuple(parts)), problem.measurements.table)


def recordings():
    """The table of the recordings."""
    flight, sounds = DATA / "uwb_tdoa", DATA / "sflab_mic_toa" / "dataset_1_exp2.mat"
    cases = {"plaza": (plaza.problem, plaza.truth, None)}
    if sounds.exists():
        cases["sflab"] = (lambda: sflab.problem(sounds), lambda: sflab.truth(sounds), None)
    if flight.exists():
        cases["flight"] = (
            lambda: tdoa_flight.problem(flight), lambda: tdoa_flight.truth(flight), tdoa_flight.PRIOR
        )  # fmt: skip
    print("| recording | process noise | status | track, m | level | motion named | s |\n|---|---|---|---|---|---|---|")
    for name, (make, truth, prior) in cases.items():
        for word, problem in (("as declared", make()), ("Student-t, 4", heavy(make()))):
            began = time.perf_counter()
            tree, _ = calibrate(problem, prior=prior)
            seconds = time.perf_counter() - began
            findings = assess(problem, tree)["finding"].to_dataset()
            named = findings["sentence"].values[findings["kind"].values == "motion"].tolist()
            level = dict(tree["level"]["std"].to_series().round(3)) if "level" in tree.children else "known"
            error = position_rmse(tree, truth())[1]
            cells = [
                name,
                word,
                tree.attrs["status"],
                f"{error:.3f}",
                level,
                "; ".join(named) or "no",
                f"{seconds:.0f}",
            ]
            print(f"| {' | '.join(map(str, cells))} |", flush=True)


def main():
    """Print the tables that are asked for."""
    ask = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    ask.add_argument("--runs", type=int, default=0)
    ask.add_argument("--recordings", action="store_true")
    given = ask.parse_args()
    if given.runs:
        simulated(given.runs)
    if given.recordings:
        recordings()


if __name__ == "__main__":
    main()
