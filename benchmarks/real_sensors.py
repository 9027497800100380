"""Faults of real sensors, simulated from the model with known truth: one function per situation.

    uv run python benchmarks/real_sensors.py labels --runs 50 --jobs 8 --seed 0

A situation is a function with `@situation`: it takes a seed and one of its variants and returns a
dictionary. The variants are summed up in one line each: a pair (hits, of) becomes a fraction with its
counts, a word the count of each word, a number its median.
"""

import argparse
import itertools
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np

SITUATIONS = {}


def situation(*variants, name=""):
    """Register a function (seed, *variant) -> dictionary under its name, with the variants that it takes."""

    def register(function):
        SITUATIONS[name or function.__name__.replace("_", "-")] = (function, variants)
        return function

    return register


def one(name, variant, seed):
    """One run of a situation; an error of the fit counts as a word."""
    from probcal import FitError

    try:
        return SITUATIONS[name][0](seed, *variant)
    except FitError:
        return {"outcome": "refused"}


def line(variant, runs):
    """The runs of one variant in one line."""
    told = []
    for key in dict.fromkeys(key for run in runs for key in run):
        values = [run[key] for run in runs if key in run]
        if isinstance(values[0], str):
            told.append(f"{key} " + ", ".join(f"{word} {count}" for word, count in Counter(values).most_common()))
        elif isinstance(values[0], tuple):
            hits, of = np.sum(values, 0)
            told.append(f"{key} {hits / max(of, 1):.3f} ({hits:g} of {of:g})")
        else:
            told.append(f"{key} {np.nanmedian(values):.3g}")
    return f"{' '.join(map(str, variant)):28} {len(runs):3} runs: {'; '.join(told)}"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", choices=[*SITUATIONS, "all"])
    parser.add_argument("--runs", type=int, default=50)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="variants whose line contains this text")
    args = parser.parse_args()
    seeds = range(args.seed, args.seed + args.runs)
    with ProcessPoolExecutor(args.jobs, get_context("spawn")) as pool:
        for name in SITUATIONS if args.name == "all" else [args.name]:
            print(name, flush=True)
            variants = [v for v in SITUATIONS[name][1] if args.only in " ".join(map(str, v))]
            pending = [(v, [pool.submit(one, name, v, seed) for seed in seeds]) for v in variants]
            for variant, futures in pending:
                print(" ", line(variant, [future.result() for future in futures]), flush=True)


# Exchanged labels: seven nodes around a target, of which some carry the place of another.

KINDS = ("ranges", "arrivals", "differences", "bearings")
NOISES = ("Normal()", "StudentT(4)", "Mixture(0.1, 10)")
EXCHANGED = ("pair", "cycle")  # two labels exchanged, three moved on by one
PLACES = ((0, 0), (95, 10), (120, 80), (60, 130), (-20, 110), (-40, 40), (45, 60))  # m
MOVED = 1.0  # sd of the error of a surveyed place in m
FOUND = 4.0  # of these sd, within which a place is found


def labelled(kind, noise, exchanged, seed, epochs=40):
    """A problem and its truth: surveyed places of seven nodes, of which some carry the label of another."""
    import probcal as pc
    from probcal import noise as families
    from probcal.geometry import bearing, norm

    family, rng = eval(f"families.{noise}", {"families": families}), np.random.default_rng(seed)

    @pc.sensor(range=pc.Channel("m", std=0.5, noise=family))
    def ranges(target, pose):
        return dict(range=norm(target.position - pose.position))

    @pc.sensor(arrival=pc.Channel("m", std=0.5, noise=family))
    def arrivals(target, pose):
        return dict(arrival=norm(target.position - pose.position) + target.emission)

    @pc.sensor(difference=pc.Channel("m", std=0.5, noise=family))
    def differences(target, first, second):
        return dict(difference=norm(target.position - second.position) - norm(target.position - first.position))

    @pc.sensor(azimuth=pc.Channel("rad", std=0.01, noise=family, wrap=True))
    def bearings(target, pose):
        return dict(azimuth=bearing(target.position - pose.position))

    carried = np.arange(len(PLACES))
    if exchanged:
        chosen = rng.choice(len(PLACES), {"pair": 2, "cycle": 3}[exchanged], replace=False)
        carried[chosen] = np.roll(chosen, 1)
    surveyed = np.array(PLACES, float)
    true = surveyed[carried] + MOVED * rng.standard_normal(surveyed.shape)
    nodes = [pc.Node(f"n{k}", place, scale={"position": MOVED}) for k, place in enumerate(surveyed)]
    if kind == "differences":
        placed = [differences.on(nodes[0], node, name=f"d{k}") for k, node in enumerate(nodes) if k]
    else:
        placed = [{"ranges": ranges, "arrivals": arrivals, "bearings": bearings}[kind].on(node) for node in nodes]
    motion = pc.ConstantVelocity(1.0)
    motion = motion + pc.White("emission", "m", 100.0) if kind == "arrivals" else motion
    t, network = np.arange(float(epochs)), pc.Network(placed)
    a, b = rng.uniform(0, 2 * np.pi, 2)
    path = np.stack([40 + 70 * np.sin(0.13 * t + a), 60 + 60 * np.sin(0.19 * t + b)], 1)
    biases = {f"n{k}.position_{x}": true[k, i] - surveyed[k, i] for k in range(len(PLACES)) for i, x in enumerate("xy")}
    run = pc.simulate(network, motion, t, key=seed, biases=biases, tracks={"target": path}, missing=0.1)
    return pc.Problem(network, motion, run.table), run.truth


@situation(*itertools.product(KINDS, NOISES, EXCHANGED))
def labels(seed, kind, noise, exchanged):
    """Exchanged labels: the true places are found, or the fit does not call itself converged."""
    import probcal as pc

    problem, truth = labelled(kind, noise, exchanged, seed)
    tree = pc.fit(problem)
    found, true = tree["calibration"]["mean"].to_series(), truth.biases
    off = max(abs(found[label] - true[label]) for label in problem.labels)
    status = tree.attrs["status"]
    outcome = f"{'found' if off < FOUND * MOVED else 'WRONG' if status == 'converged' else 'wrong'}, {status}"
    return {"outcome": outcome, "largest error in m": off}


@situation(*itertools.product(KINDS, NOISES), name="labels-sound")
def labels_sound(seed, kind, noise):
    """Every label is right: no fit is a misfit, and the intervals of the places hold what they say."""
    import probcal as pc

    problem, truth = labelled(kind, noise, "", seed)
    tree = pc.fit(problem)
    group, true = tree["calibration"], np.array([truth.biases[label] for label in problem.labels])
    held = (group["lower"].values <= true) & (true <= group["upper"].values)
    return {"outcome": tree.attrs["status"], "places within 89 %": (int(held.sum()), len(held))}


if __name__ == "__main__":
    main()
