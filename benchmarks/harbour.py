"""The harbour recordings: biases of each scenario, and how near its tracks come to the boats before and after.

    uv run python benchmarks/harbour.py ../shared/data/autoferry_radar --scenarios 2 3 4 16

Printed: status, biases, and GOSPA (cut 20 m) with its parts of the objects tracked with and without each calibration.
"""

import argparse
import sys
from pathlib import Path

import numpy as np

import probcal as pc

sys.path.insert(0, str(Path(__file__).parents[1] / "models"))
import harbour


def near(objects, truth):
    """GOSPA every second: tracks of existence above one half, against the antennas of the boats."""
    path, boats = objects.path[objects.path["existence"] > 0.5], truth.tracks
    instants = np.arange(5.0, path["time"].max(), 1.0)

    def at(frame, name, t):
        return [
            [np.interp(t, own["time"], own[f"position_{axis}"]) for axis in "xy"]
            for _, own in frame.groupby(name)
            if own["time"].min() - 0.6 <= t <= own["time"].max() + 0.6
        ]

    return pc.gospa([at(path, "track", t) for t in instants], [at(boats, "target", t) for t in instants])


def main():
    """Fit every scenario, then track every one with every calibration."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scenarios", type=int, nargs="+", default=[2, 3, 4, 16])
    chosen = parser.parse_args()
    files = {k: chosen.folder / f"scenario{k}_detections.json" for k in chosen.scenarios}
    problems = {k: harbour.problem(file) for k, file in files.items()}
    found = {}
    for k, problem in problems.items():
        tree = pc.fit(problem, pc.SelfConfiguration(pc.EA()))
        found[k] = tree["calibration"].to_dataset().sel(bias_label=list(problem.labels))
        print(k, tree.attrs["status"], len(problem.scans), "scans", flush=True)
        print(pc.summary(tree)[["bias", "mean", "sd"]].to_string(index=False))
    for k, problem in problems.items():
        truth = harbour.truth(files[k])
        print(f"scenario {k}, as stated:", near(pc.track_objects(problem), truth))
        for other, group in found.items():
            z = group["mean"].values / problem.scales
            print(f"scenario {k}, calibrated on {other}:", near(pc.track_objects(problem, z), truth), flush=True)


if __name__ == "__main__":
    main()
