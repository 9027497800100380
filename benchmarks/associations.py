"""Biases with associations sampled, beside soft association by rounds and rows with names.

    uv run python benchmarks/associations.py --runs 8
    uv run python benchmarks/associations.py --runs 8 --scans 4 --probability 0.6 --clutter 3 --range 1200 --spread 100

Two radars (unless asked otherwise 90 % detection, one false detection a scan, 10 scans each); the second stands
displaced and turned. Two objects begin `--spread` m (sd) about one place, at `--speed` m/s (sd), and move as declared;
places, biases and noise are drawn anew for every run from what is declared, so that 89 % intervals hold 89 % where all
is right. Printed for each bias: the mean over its sd from the truth by `sample_associations`, by
`SelfConfiguration(MAP())`, and by `MAP()` with names; and seconds. `--scale` multiplies the scales of the biases.
"""

import argparse
import time

import numpy as np
import pandas as pd

import probcal as pc
from probcal.errors import FitError, InputError
from probcal.geometry import bearing, norm

SCALE = {"position": 30.0, "heading": 0.05}
METHODS = ("sampled", "in rounds", "with names")


@pc.sensor(range=pc.Channel("m", std=5.0), azimuth=pc.Channel("rad", std=0.01, wrap=True))
def radar(target, pose):
    """Range and azimuth in the node's own axes."""
    line = pose.local(target.position)
    return dict(range=norm(line), azimuth=bearing(line))


def network(detection, times):
    """The first radar known, the second within its scales."""
    scale = {name: times * value for name, value in SCALE.items()}
    nodes = [pc.Node("west", (0.0, 0.0)), pc.Node("east", (1000.0, 0.0), scale=scale)]
    return pc.Network([radar.on(node, detection=detection) for node in nodes])


def scene(run, chosen):
    """The same rows without names, false ones among them, and with names, and the true biases."""
    report = pc.Detection(chosen.probability, clutter=chosen.clutter, view=pc.Sector(range=chosen.range))
    start = {"position": ((400.0, 600.0), chosen.spread), "velocity": ((0.0, 0.0), chosen.speed)}
    target, rng = pc.Target(pc.ConstantVelocity(0.5), start), np.random.default_rng(run)
    drawn = pc.simulate(
        network(None, chosen.scale), {"one": target, "two": target}, np.arange(float(chosen.scans)), key=run
    )
    told = (drawn.table["range"] < chosen.range) & (rng.uniform(size=len(drawn.table)) < chosen.probability)
    named = drawn.table[told].reset_index(drop=True)
    false = []
    for t in range(chosen.scans):
        for name in ("west", "east"):
            seen = ((named["time"] == t) & (named["sensor"] == name)).any()
            count = rng.poisson(chosen.clutter)
            places = [(rng.uniform(0.0, chosen.range), rng.uniform(-np.pi, np.pi)) for _ in range(count)]
            places += [] if seen or count else [(np.nan, np.nan)]  # a scan in which nothing was detected
            false += [{"time": t, "sensor": name, "range": r, "azimuth": a} for r, a in places]
    whole = pd.concat([named.drop(columns="target"), pd.DataFrame(false)], ignore_index=True).sample(
        frac=1.0, random_state=run
    )
    whole = whole.sort_values("time", kind="stable", ignore_index=True)
    return (
        pc.Problem(network(report, chosen.scale), target, whole),
        pc.Problem(network(None, chosen.scale), target, named),
        drawn.truth.biases,
    )


def fitted(name, free, labelled, run, draws):
    """The tree of one method, and its seconds."""
    begun = time.perf_counter()
    if name == "sampled":
        tree = pc.sample_associations(free, objects=2.0, most=3, draws=draws, warmup=100, key=run)
    elif name == "in rounds":
        tree = pc.fit(free, pc.SelfConfiguration(pc.MAP(), objects=2.0), prior=pc.Gaussian())
    else:
        tree = pc.fit(labelled, pc.MAP(), prior=pc.Gaussian())
    return tree, time.perf_counter() - begun


def main():
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=8)
    parser.add_argument("--spread", type=float, default=500.0)
    parser.add_argument("--speed", type=float, default=12.0)
    parser.add_argument("--scans", type=int, default=10)
    parser.add_argument("--probability", type=float, default=0.9)
    parser.add_argument("--clutter", type=float, default=1.0)
    parser.add_argument("--range", type=float, default=3000.0)
    parser.add_argument("--scale", type=float, default=1.0)
    parser.add_argument("--draws", type=int, default=400)
    parser.add_argument("--again", action="store_true", help="time each once more, compiled")
    chosen = parser.parse_args()
    found = {name: [] for name in METHODS}
    for run in range(chosen.runs):
        free, labelled, true = scene(run, chosen)
        for name in METHODS:
            try:
                tree, took = fitted(name, free, labelled, run, chosen.draws)
            except (FitError, InputError) as error:  # nothing is confirmed, or only by one sensor
                print(run, name, error, flush=True)
                continue
            group, own = tree["calibration"].to_dataset(), []
            for label, value in true.items():
                one = group.sel(bias_label=label)
                z = (float(one["mean"]) - value) / float(one["sd"])
                own.append((z, float(one["lower"]) < value < float(one["upper"]), float(one["sd"])))
            again = fitted(name, free, labelled, run, chosen.draws)[1] if chosen.again else np.nan
            found[name].append((own, tree.attrs.get("objects", 2), took, again))
            mixed = f"r_hat {group['r_hat'].max():.3f} ess {group['ess'].min():.0f}" if "r_hat" in group else ""
            said = f"{tree.attrs['status']}, {tree.attrs.get('objects', 2):.2f} objects, {took:.1f} s, {again:.1f} s"
            print(run, name, " ".join(f"{z:+.2f}" for z, *_ in own), said, mixed, flush=True)
    print(f"\n{vars(chosen)}\n")
    print("| association | runs | rms z | largest | 89 % hold | median sd: x, y, heading | objects | s, compiled |")
    print("|---|---|---|---|---|---|---|---|")
    for name, runs in found.items():
        z, inside, sd = (np.array([[row[k] for row in own] for own, *_ in runs], float) for k in range(3))
        number, took, again = (np.array([one[k] for one in runs], float) for k in (1, 2, 3))
        sds, seconds = np.median(sd, 0), f"{np.median(took):.1f}, {np.median(again):.1f}"
        print(f"| {name} | {len(runs)} | {np.sqrt(np.mean(z**2)):.2f} | {np.abs(z).max():.1f} | {inside.mean():.2f} |"
              f" {sds[0]:.2f}, {sds[1]:.2f}, {sds[2]:.5f} | {number.mean():.2f} | {seconds} |")  # fmt: skip


if __name__ == "__main__":
    main()
