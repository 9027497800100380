"""The harbour recordings: biases of each scenario, and how near its tracks come to the boats before and after.

    uv run python benchmarks/harbour.py ../shared/data/autoferry_radar --scenarios 2 3 4 16 [--cameras]

Printed: status, biases, and beside each azimuth the median by which the sensor disagrees with the boats' antennas,
less that of the lidar; then GOSPA (cut 20 m) with its parts of the objects tracked without calibration, by that of the
scenario itself, by those of the others, and by the mean of these. An object counts while it exists more surely
than not and its place is known better than the cut: what cameras alone see has none.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np

import probcal as pc
from probcal.tracking.gospa import Gospa

sys.path.insert(0, str(Path(__file__).parents[1] / "models"))
import harbour

CUT = 20.0  # m
NEAR = np.deg2rad(8.0)  # within which a detection is compared with an antenna


def near(objects, truth):
    """GOSPA every second of tracks that exist and have a place, against the antennas of the boats."""
    path, boats = objects.path, truth.tracks
    path = path[(path["existence"] > 0.5) & (np.hypot(path["position_x_sd"], path["position_y_sd"]) < CUT)]
    instants = np.arange(5.0, boats["time"].max(), 1.0)

    def at(frame, name, t):
        return [
            [np.interp(t, own["time"], own[f"position_{axis}"]) for axis in "xy"]
            for _, own in frame.groupby(name)
            if own["time"].min() - 0.6 <= t <= own["time"].max() + 0.6
        ]

    return pc.gospa([at(path, "track", t) for t in instants], [at(boats, "target", t) for t in instants], cut=CUT)


def disagreement(file, cameras):
    """Median in rad of azimuth measured less that of the nearest antenna, by sensor."""
    rows, ferry = harbour.table(file, cameras).dropna(subset=["azimuth"]), harbour.path(file)
    off = []
    for _, boat in harbour.truth(file).tracks.groupby("target"):
        place = np.stack([np.interp(rows["time"], boat["time"], boat[f"position_{axis}"]) for axis in "xy"], 1)
        line = place - ferry.at(rows["time"].to_numpy())["position"]
        off.append(np.angle(np.exp(1j * (rows["azimuth"] - np.arctan2(line[:, 1], line[:, 0])))))
    off = np.array(off)
    least = np.take_along_axis(off, np.abs(off).argmin(0)[None], 0)[0]
    kept = np.abs(least) < NEAR
    return {name: float(np.median(least[kept & (rows["sensor"] == name)])) for name in rows["sensor"].unique()}


def calibration(tree, problem):
    """Biases z (M,) and their covariance (M, M) of a fit, in the scales of a problem."""
    labels = list(problem.labels)
    group = tree["calibration"].to_dataset().sel(bias_label=labels, bias_label_other=labels)
    return group["mean"].values / problem.scales, group["covariance"].values / np.outer(problem.scales, problem.scales)


def told(found):
    """GOSPA and its parts."""
    return f"{found.distance:.2f} (place {found.place:.2f}, missed {found.missed:.2f}, false {found.false:.2f})"


def main():
    """Fit every scenario, then track every one with every calibration."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scenarios", type=int, nargs="+", default=[2, 3, 4, 16])
    parser.add_argument("--cameras", action="store_true")
    chosen = parser.parse_args()
    files = {k: chosen.folder / f"scenario{k}_detections.json" for k in chosen.scenarios}
    problems = {k: harbour.problem(file, chosen.cameras) for k, file in files.items()}
    found = {}
    for k, problem in problems.items():
        begun = time.perf_counter()
        tree = pc.fit(problem, pc.SelfConfiguration(pc.EA()))
        took = time.perf_counter() - begun
        found[k] = tree
        group, reference = tree["calibration"].to_dataset(), disagreement(files[k], chosen.cameras)
        print(f"{k}: {tree.attrs['status']}, {tree.attrs['objects']} objects in {len(problem.scans)} scans,"
              f" {tree.attrs['rounds']} rounds, {took:.0f} s")  # fmt: skip
        for label, mean, sd in zip(group["bias_label"].values, group["mean"].values, group["sd"].values, strict=True):
            name, _, bias = str(label).partition(".")
            if bias == "range_offset":
                print(f"  {label} {mean:.2f} ± {sd:.2f} m")
            else:
                beside = np.rad2deg(reference[name] - reference["lidar"])
                print(f"  {label} {np.rad2deg(mean):.2f} ± {np.rad2deg(sd):.2f} deg (by the antennas {beside:.2f})")
        print(tree["detection"].to_dataset().to_dataframe().round(1).to_string(), flush=True)
    ways = ("as stated", "by itself", "by the others", "by the mean of the others")
    parts = {name: [] for name in ways}
    for k, problem in problems.items():
        truth = harbour.truth(files[k])

        def judged(way, told_by, *calibration, k=k, problem=problem, truth=truth):
            own = near(pc.track_objects(problem, *calibration), truth)
            parts[way].append(own)
            print(f"scenario {k}, {told_by}: {told(own)}", flush=True)

        judged(ways[0], ways[0])
        numbers = {other: calibration(tree, problem) for other, tree in found.items()}
        for other, pair in numbers.items():
            judged(ways[1 if other == k else 2], f"calibrated on {other}", *pair)
        rest = [pair for other, pair in numbers.items() if other != k]
        if rest:
            z = np.array([pair[0] for pair in rest])
            spread = np.mean([pair[1] for pair in rest], 0) + np.diag(z.var(0))
            judged(ways[3], ways[3], z.mean(0), spread)
    for name, rows in parts.items():
        print(f"mean {name}: {told(Gospa(*np.mean(rows, 0)))}" if rows else "")


if __name__ == "__main__":
    main()
