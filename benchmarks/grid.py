"""The sixteen radars of `models/self_configuring_grid.py`, configured from detections without names.

    uv run python benchmarks/grid.py --runs 5

Printed for every run: error of places and headings at the start (`register_tracks` of the sensors' own tracks) and
after the fit, the stated sds; rms z, how often 89 % intervals hold, objects, rounds, seconds of the start and of the
fit.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np

import probcal as pc
from probcal.inference.configure import registered

sys.path.insert(0, str(Path(__file__).parents[1] / "models"))
import self_configuring_grid as grid


def rms(values):
    """Root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def main():
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=5)
    chosen = parser.parse_args()
    method = pc.SelfConfiguration(pc.MAP(), start="tracks", cut=60.0)
    found = []
    for run in range(chosen.runs):
        problem = grid.problem(run=run)
        true = np.array([grid.truth(run=run).biases[label] for label in problem.labels])
        place = np.array(["position" in label for label in problem.labels])
        begun = time.perf_counter()
        z, _, _ = registered(problem, method)
        start = z * problem.scales - true
        between = time.perf_counter()
        tree = pc.fit(problem, method, prior=pc.Gaussian())
        took = time.perf_counter() - between
        group = tree["calibration"].to_dataset()
        off, sd = group["mean"].values - true, group["sd"].values
        held = np.mean((group["lower"].values < true) & (true < group["upper"].values))
        bound = [rms(sd[place]), rms(np.rad2deg(sd[~place]))]
        row = [rms(start[place]), rms(np.rad2deg(start[~place])), rms(off[place]), rms(np.rad2deg(off[~place])), *bound]
        row += [rms(off / sd), held, tree.attrs["objects"], tree.attrs["rounds"], between - begun, took]
        found.append(row)
        print(run, tree.attrs["status"], " ".join(f"{value:.3f}" for value in row), flush=True)
    mean = np.mean(found, 0)
    start, fit, stated = (f"{mean[k]:.2f} m, {mean[k + 1]:.3f} deg" for k in (0, 2, 4))
    print(f"\n{chosen.runs} runs: start {start}; fit {fit}; stated sd {stated}; rms z {mean[6]:.2f}; 89 % hold")
    print(f"{mean[7]:.2f}; objects {mean[8]:.1f}; rounds {mean[9]:.1f}; {mean[10]:.0f} and {mean[11]:.0f} s")


if __name__ == "__main__":
    main()
