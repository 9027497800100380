"""Two radars that name no target: objects and biases together, beside the same recordings with names.

    uv run python benchmarks/objects.py --runs 10

Four objects cross the field of two radars (90 % detection, three false ones a scan, 40 scans each); the second stands
displaced and turned, drawn anew for every run from the declared scales. Printed: objects found, each bias by
`SelfConfiguration(EA())` without names and by `EA()` with them, how often 89 % intervals hold the truth, and seconds.
"""

import argparse
import time

import numpy as np

import probcal as pc
from probcal.geometry import bearing, norm

TIME = np.arange(40.0)
SCALE = {"position": 30.0, "heading": 0.05}
START = {"position": ((300.0, 300.0), 1500.0), "velocity": ((0.0, 0.0), 12.0)}


@pc.sensor(range=pc.Channel("m", std=5.0), azimuth=pc.Channel("rad", std=0.01, wrap=True))
def radar(target, pose):
    """Range and azimuth in the node's own axes."""
    line = pose.local(target.position)
    return dict(range=norm(line), azimuth=bearing(line))


def network(detection):
    """The first radar known, the second within its scales."""
    nodes = [pc.Node("west", (0.0, 0.0)), pc.Node("east", (1000.0, 0.0), scale=SCALE)]
    return pc.Network([radar.on(node, detection=detection) for node in nodes])


def main():
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--objects", type=int, default=4)
    chosen = parser.parse_args()
    report = pc.Detection(0.9, clutter=3.0, view=pc.Sector(range=3000.0))
    found = {"without names": [], "with names": []}
    for run in range(chosen.runs):
        rng = np.random.default_rng(run)
        names = [f"t{k}" for k in range(chosen.objects)]
        paths = {n: rng.uniform(-800, 1500, 2) + np.outer(TIME, rng.uniform(-15, 15, 2)) for n in names}
        east, north = SCALE["position"] * rng.standard_normal(2)
        turn = SCALE["heading"] * rng.standard_normal()
        true = {"east.position_x": east, "east.position_y": north, "east.heading": turn}
        motion = dict.fromkeys(paths, pc.ConstantVelocity(0.5))
        target = pc.Target(pc.ConstantVelocity(0.5), START)
        for label, detection, method in (
            ("without names", report, pc.SelfConfiguration(pc.EA())),
            ("with names", None, pc.EA()),
        ):
            table = pc.simulate(network(detection), motion, TIME, tracks=paths, biases=true, key=run).table
            begun = time.perf_counter()
            tree = pc.fit(pc.Problem(network(detection), target, table), method)
            took = time.perf_counter() - begun
            group = tree["calibration"].to_dataset()
            for name, value in true.items():
                own = group.sel(bias_label=name)
                inside = float(own["lower"]) < value < float(own["upper"])
                z = (float(own["mean"]) - value) / float(own["sd"])
                found[label].append((name, z, inside, float(own["sd"]), took, tree.attrs.get("objects", 0)))
            last = found[label][-3:]
            print(run, label, tree.attrs["status"], tree.attrs.get("objects", ""), tree.attrs.get("rounds", ""),
                  " ".join(f"{z:+.2f}" for _, z, *_ in last), f"{took:.1f} s", flush=True)  # fmt: skip
    print(f"\n{chosen.runs} runs, {chosen.objects} objects\n")
    print("| rows | rms z | 89 % hold | median sd: x, y in m, heading in rad | runs with all objects | s |")
    print("|---|---|---|---|---|---|")
    for label, rows in found.items():
        z, inside, took = (np.array([row[k] for row in rows]) for k in (1, 2, 4))
        sds = [np.median([row[3] for row in rows if row[0] == name]) for name in true]
        right = np.mean([row[5] == chosen.objects for row in rows]) if label == "without names" else 1.0
        print(f"| {label} | {np.sqrt(np.mean(z**2)):.2f} | {inside.mean():.2f} |"
              f" {sds[0]:.2f}, {sds[1]:.2f}, {sds[2]:.5f} | {right:.2f} | {np.median(took):.1f} |")  # fmt: skip


if __name__ == "__main__":
    main()
