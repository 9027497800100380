"""The lidars and radars of `models/sapient.py`, configured from detections without names.

    uv run python benchmarks/sapient.py --start beliefs --runs 5

Printed for every run and sensor: error in place (m) and heading (deg), and their stated sds; then status, share of
89 % intervals that hold, rms z, objects (three walk), rounds and seconds. Of all runs: the worst errors, and how many
have every sensor within 1.5 m and 2 deg, which is what the paper reports for its recording.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np

import probcal as pc
from probcal.tracking.selfconfig import STARTS

sys.path.insert(0, str(Path(__file__).parents[1] / "models"))
import sapient

WITHIN = (1.5, 2.0)  # m and deg


def by_sensor(labels, values):
    """Place (S,) in m and heading (S,) in deg of each sensor but the anchor, from values by label (M,)."""
    told = dict(zip(labels, values, strict=True))
    own = [f"sensor_{k + 1}" for k in range(1, len(sapient.PLACES))]
    place = [np.hypot(told[f"{name}.position_x"], told[f"{name}.position_y"]) for name in own]
    return np.array(place), np.array([abs(np.rad2deg(told[f"{name}.heading"])) for name in own])


def main():
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--start", choices=STARTS, default="beliefs")
    parser.add_argument("--iterations", type=int, default=50)
    chosen = parser.parse_args()
    method = pc.SelfConfiguration(pc.MAP(), start=chosen.start, iterations=chosen.iterations)
    worst = []
    for run in range(chosen.first, chosen.first + chosen.runs):
        problem = sapient.problem(run=run)
        true = np.array([sapient.truth(run=run).biases[label] for label in problem.labels])
        begun = time.perf_counter()
        tree = pc.fit(problem, method, prior=pc.Gaussian())
        took = time.perf_counter() - begun
        group = tree["calibration"].to_dataset()
        off, sd = group["mean"].values - true, group["sd"].values
        turned = [label.endswith("heading") for label in problem.labels]
        off = np.where(turned, np.angle(np.exp(1j * off)), off)
        low, high = (group[name].values - group["mean"].values for name in ("lower", "upper"))
        held = np.mean((low < -off) & (-off < high))
        place, heading = by_sensor(problem.labels, off)
        place_sd, heading_sd = by_sensor(problem.labels, sd)
        for k, (m, deg, m_sd, deg_sd) in enumerate(zip(place, heading, place_sd, heading_sd, strict=True)):
            print(f"  sensor {k + 2}: {m:.3f} m, {deg:.3f} deg (sd {m_sd:.3f}, {deg_sd:.3f})")
        print(
            f"run {run}: {tree.attrs['status']}; worst {place.max():.3f} m, {heading.max():.3f} deg; 89 % hold"
            f" {held:.2f}, rms z {np.sqrt(np.mean((off / sd) ** 2)):.2f}; {tree.attrs['objects']} objects,"
            f" {tree.attrs['rounds']} rounds, {took:.0f} s",
            flush=True,
        )
        if tree.attrs["status"] != "converged":
            print(f"  {tree.attrs['message']}", flush=True)
        worst.append((place.max(), heading.max()))
    worst = np.array(worst)
    good = np.sum((worst <= WITHIN).all(1))
    within = f"within {WITHIN[0]} m and {WITHIN[1]} deg"
    print(f"\nstart={chosen.start}: every sensor {within} in {good} of {len(worst)} runs")


if __name__ == "__main__":
    main()
