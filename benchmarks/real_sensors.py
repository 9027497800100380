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
from functools import cache
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
    run = pc.simulate(network, motion, t, key=seed, biases=biases, tracks={"target": path})
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


# A warehouse of UWB anchors: the antenna delay of none is zero, two of eight anchors stand elsewhere.

ANCHORS = ((0, 0, 4.5), (20, 0, 6), (40, 0, 4.5), (40, 25, 6), (20, 25, 3), (0, 25, 6), (0, 12.5, 2.5), (40, 12.5, 2.5))
DELAY = 0.15  # sd of the delays in m, declared with a scale of 0.3
LATE = 0.1  # fraction of ranges that come by reflection, 0.3 m and an exponential of 0.8 m late
DECLARED = {  # variants: zeros of the delays, and the prior of the fit
    "former": ("expected", "pc.Horseshoe(by=None)"),  # zeros expected of delays too, every axis by itself
    "expected": ("expected", "pc.Horseshoe()"),
    "none-by-axis": ("none", "pc.Horseshoe(by=None)"),
    "none": ("none", "pc.Horseshoe()"),
    "learnt": ("learnt", "pc.Horseshoe()"),
    "level": ("expected", '{"*.range_offset": pc.ARD(shape=2, rate=2, by="component")}'),
    "spike": ("expected", "pc.BernoulliGaussian()"),
    "learnt-spike": ("learnt", "pc.BernoulliGaussian()"),
    "gaussian": ("none", "pc.Gaussian()"),
}


def ride(rng, rate, seconds=180.0):
    """Times and places (T, 3) in m of a tag on the mast of a forklift that drives along aisles at some 1.5 m/s."""
    t = np.arange(0.0, seconds, 1.0 / rate)
    corners = rng.uniform([3, 3], [37, 22], (40, 2))
    along = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))]
    driven = np.cumsum(np.full(len(t), 1.5 / rate) * (0.6 + 0.4 * np.sin(t / 11)))
    place = np.stack([np.interp(driven, along, column) for column in corners.T], 1)
    window = np.exp(-0.5 * (np.arange(-2.5, 2.5 + 0.5 / rate, 1.0 / rate)) ** 2)
    half = len(window) // 2
    smooth = [np.convolve(np.pad(c, half, mode="edge"), window / window.sum(), "valid")[: len(t)] for c in place.T]
    return t, np.stack([*smooth, 2.2 + 1.2 * np.sin(t / 17) + 0.3 * np.sin(t / 5)], 1)


def displaced(rng):
    """Displacements (8, 3) of the anchors, two of them by 0.4 m, and their delays (8,), in m."""
    shift, moved = np.zeros((len(ANCHORS), 3)), rng.choice(len(ANCHORS), 2, replace=False)
    towards = rng.normal(size=(2, 3)) * [1.0, 1.0, 0.5]
    shift[moved] = 0.4 * towards / np.linalg.norm(towards, axis=1, keepdims=True)
    return shift, rng.normal(0.0, DELAY, len(ANCHORS))


def labelled_biases(shift, delay):
    """True biases by label."""
    true = {f"A{k:02d}.range_offset": delay[k] for k in range(len(delay))}
    return true | {f"A{k:02d}.position_{x}": shift[k, i] for k in range(len(delay)) for i, x in enumerate("xyz")}


def warehouse_of(seed, zeros, noise, rate=10.0):
    """A problem, its true biases by label and the true track: delays, displaced anchors and the ride are drawn."""
    import pandas as pd

    import probcal as pc
    from probcal import noise as families

    @pc.sensor(
        range=pc.Channel("m", std=pc.Unknown(0.1), noise=eval(f"families.{noise}", {"families": families, "pc": pc}))
    )
    def uwb(target, pose, *, range_offset=pc.Bias("m", 0.3, zeros=zeros)):
        return dict(range=pc.geometry.norm(target.position - pose.position) + range_offset)

    rng, stated = np.random.default_rng(seed), np.array(ANCHORS, float)
    shift, delay = displaced(rng)
    t, place = ride(rng, rate)
    rows = []
    for k, own in enumerate(stated + shift):
        late = (rng.random(len(t)) < LATE) * (0.3 + rng.exponential(0.8, len(t)))
        measured = np.linalg.norm(place - own, axis=1) + delay[k] + rng.normal(0, 0.06, len(t)) + late
        there = rng.permutation(len(t)) >= 0.15 * len(t)  # as many in all runs, so that they share their kernels
        rows.append(pd.DataFrame({"time": t, "sensor": f"A{k:02d}", "range": measured})[there])
    network = pc.Network([uwb.on(pc.Node(f"A{k:02d}", at, scale={"position": 0.5})) for k, at in enumerate(stated)])
    table = pd.concat(rows).sort_values(["time", "sensor"])
    return pc.Problem(network, pc.ConstantVelocity(pc.Unknown(1.0)), table), labelled_biases(shift, delay), place


def share_of(inside, chosen):
    """Hits and number of what is chosen, for `line`."""
    return int(inside[chosen].sum()), int(np.sum(chosen))


def kinds(seed, declared, noise, rate=10.0):
    """Coverage of 89 % intervals of all biases, of those that are not zero, and of those called determined."""
    import probcal as pc

    zeros, prior = DECLARED[declared]
    problem, true, place = warehouse_of(seed, zeros, noise, rate)
    tree = pc.fit(problem, pc.MAP() if declared == "gaussian" else pc.EA(), prior=eval(prior, {"pc": pc}))
    tree = pc.assess(problem, tree)
    table = pc.summary(tree).set_index("bias")
    sure = (table["verdict"] == "determined").to_numpy()
    track = pc.tracks(tree)
    found = track[[f"position_{x}" for x in "xyz"]].to_numpy()
    off = np.sqrt(np.mean(np.sum((found - place) ** 2, 1)))
    held = coverage(table["mean"], table["sd"], table["lower"], table["upper"], true, sure)
    return held | {"track rmse in m": float(off), "status": tree.attrs["status"]}


def coverage(mean, sd, lower, upper, true, sure):
    """Biases (M,) whose intervals hold the truth by label: of all, of a kind, and of those called determined."""
    at = np.array([true[label] for label in mean.index])
    inside = ((lower <= at) & (at <= upper)).to_numpy()
    delays = mean.index.str.endswith("range_offset")
    return {
        "all": share_of(inside, np.ones(len(at), bool)), "not zero": share_of(inside, at != 0),
        "delays": share_of(inside, delays), "displaced": share_of(inside, ~delays & (at != 0)),
        "determined": share_of(inside, sure), "determined, not zero": share_of(inside, sure & (at != 0)),
        "determined and beyond 4 sd": share_of((np.abs(mean - at) > 4 * sd).to_numpy(), sure),
        "bias rmse in m": float(np.sqrt(np.mean((mean - at) ** 2))), "width in m": float((upper - lower).median()),
    }  # fmt: skip


LATE_NOISE = 'Mixture(pc.Unknown(0.1), pc.Unknown(8.0), late="exponential")'  # what a user would declare now


@situation(*itertools.product(DECLARED, ("StudentT(4)", "Mixture(0.1, 10, 12)", LATE_NOISE)))
def warehouse(seed, declared, noise):
    """Delays that are never zero, declared so and not, at ten ranges a second of each anchor."""
    return kinds(seed, declared, noise)


@cache
def information():
    """Information of the data about the biases of the warehouse in declared scales, at two ranges a second."""
    import probcal as pc

    return pc.fit(warehouse_of(0, "none", "StudentT(4)", 2.0)[0], pc.MAP())["calibration"]["information"].to_numpy()


@situation(*[(name,) for name in DECLARED], name="warehouse-linear")
def warehouse_linear(seed, declared):
    """The prior alone: a Gaussian likelihood of the biases around their truth, integrated as `EA` does."""
    import jax
    import jax.numpy as jnp
    import pandas as pd

    import probcal as pc
    from probcal.inference.hierarchy import hierarchy_of
    from probcal.inference.integrate import KEPT, begin, moments, run_sweeps
    from probcal.inference.methods import choose_prior
    from probcal.inference.posed import Form, Natural

    zeros, given = DECLARED[declared]
    problem, matrix = warehouse_of(0, zeros, "StudentT(4)", 2.0)[0], information()
    method = pc.MAP() if declared == "gaussian" else pc.EA()
    prior, rng = choose_prior(method, eval(given, {"pc": pc}), problem.labels), np.random.default_rng(seed)
    true = labelled_biases(*displaced(rng))
    z = np.array([true[label] for label in problem.labels]) / problem.scales
    values, axes = np.linalg.eigh(matrix)
    pull = matrix @ z + axes @ (np.sqrt(np.maximum(values, 0.0)) * rng.standard_normal(len(z)))
    with jax.enable_x64(True):
        form = Form(len(z), hierarchy_of(prior, problem))
        first = prior.precision(problem.labels, problem.surveyed)
        known = Natural(jnp.asarray(matrix), jnp.asarray(pull), jnp.zeros(0), first)
        keys = jax.random.split(jax.random.key(seed))
        _, swept = run_sweeps(form, known, begin(form), keys[1], KEPT)
        phi = swept.phi or {"none": jnp.zeros((4, KEPT))}
        found = jax.device_get(moments(form, known, phi))
    sure = 1.0 - np.diagonal(np.linalg.inv(matrix + np.eye(len(z)))) > 0.5
    columns = (found.mean, np.sqrt(np.diagonal(found.covariance)), found.lower, found.upper)
    return coverage(*(pd.Series(c * problem.scales, problem.labels) for c in columns), true, sure)


@situation(*itertools.product(DECLARED, ("StudentT(4)", "Mixture(0.1, 10, 12)")), name="warehouse-2hz")
def warehouse_2hz(seed, declared, noise):
    """The same at two ranges a second of each anchor."""
    return kinds(seed, declared, noise, 2.0)


# Clocks: three scopes that read range and azimuth, or five cameras; the clocks of all but the first are off.

OFFSETS = (1e-3, 5.0)  # s, between which the sizes of offsets lie, their logarithms even
TIMED = ("offset", "rate too", "not declared")
SCENES = ("scopes", "cameras")


def by_clocks(seed, scene, declared):
    """A problem whose rows carry the times of clocks that are off, and its truth."""
    import probcal as pc
    from probcal.geometry import bearing, elevation, norm

    @pc.sensor(range=pc.Channel("m", std=0.5), azimuth=pc.Channel("rad", std=0.003, wrap=True))
    def scope(target, pose):
        line = pose.local(target.position)
        return dict(range=norm(line), azimuth=bearing(line))

    @pc.sensor(azimuth=pc.Channel("rad", std=1e-3, wrap=True), elevation=pc.Channel("rad", std=1e-3, wrap=True))
    def camera(target, pose):
        line = pose.local(target.position)
        return dict(azimuth=bearing(line), elevation=elevation(line))

    rng = np.random.default_rng(seed)
    cameras = scene == "cameras"
    places = (
        [(0, 0, 6), (40, 0, 5), (40, 40, 7), (0, 40, 6), (20, -10, 3)] if cameras else [(0, 0), (400, 0), (200, 300)]
    )
    kind, unit = (camera, 1.0) if cameras else (scope, 10.0)
    free = {"time_offset": 2.0, "heading": 0.02} | ({"time_rate": 2e-3} if "rate" in declared else {})

    def network(free):
        nodes = [pc.Node(f"n{k}", place, scale=free if k else None) for k, place in enumerate(places)]
        return pc.Network([kind.on(node) for node in nodes])

    low, high = np.log(OFFSETS)
    size = np.exp(rng.uniform(low, high, len(places))) * rng.choice([-1.0, 1.0], len(places))
    biases = {f"n{k}.time_offset": float(size[k]) for k in range(1, len(places))}
    biases |= {f"n{k}.heading": float(0.01 * rng.standard_normal()) for k in range(1, len(places))}
    if "rate" in declared:
        biases |= {f"n{k}.time_rate": float(1e-3 * rng.standard_normal()) for k in range(1, len(places))}
    centre = np.mean(places, 0)
    start = {"position": (centre, 6.0 * unit), "velocity": (0.0, 1.0 * unit), "acceleration": (0.0, 0.2 * unit)}
    motion = pc.Target(pc.ConstantAcceleration(0.1 * unit), start=start)
    time = np.arange(0.0, 80.0, 2.0)  # no row is missing, so that all runs share their kernels
    run = pc.simulate(network(free), motion, time, key=seed, biases=biases)
    if declared == "not declared":
        free = {"heading": 0.02}
    return pc.Problem(network(free), motion, run.table), run.truth


@situation(*itertools.product(SCENES, TIMED))
def clocks(seed, scene, declared):
    """Offsets from a millisecond to five seconds: coverage, and any that is determined beyond 4 sd of the truth."""
    import probcal as pc

    problem, truth = by_clocks(seed, scene, declared)
    tree = pc.assess(problem, pc.fit(problem))
    table = pc.summary(tree).set_index("bias")
    at = np.array([truth.biases[label] for label in table.index])
    away = (np.abs(table["mean"] - at) / table["sd"]).to_numpy()
    inside = ((table["lower"] <= at) & (at <= table["upper"])).to_numpy()
    timed = np.array(["time_" in label for label in table.index])
    sure = (table["verdict"] == "determined").to_numpy() & (tree.attrs["status"] == "converged")
    found = {"all": share_of(inside, np.ones(len(at), bool)), "clocks": share_of(inside, timed)}
    track, d = tree["track/target"].to_dataset(), problem.network.dimension
    names = [f"position_{x}" for x in "xyz"[:d]]
    true = truth.positions(track["time"].values, np.full(track.sizes["time"], "target"), d)
    part = track.sel(component=names)
    z = np.abs(part["mean"].values - true) / part["sd"].values
    known = np.isfinite(true)
    return found | {
        "tracks": (int((z[known] < 1.598).sum()), int(known.sum())),
        "determined and beyond 4 sd": share_of(away > 4, sure), "status": tree.attrs["status"],
        "worst in sd": float(away.max()),
    } | ({"sd of an offset in s": float(np.median(table["sd"][timed]))} if timed.any() else {})  # fmt: skip


# Noise of ranges as it is: late by reflection, with a memory, growing with distance.

BEACONS = ((0, 0), (10, 0), (10, 8), (0, 8), (5, 9))  # m
WALK, PACE = 150, 0.2  # epochs, s apart
TRUE_NOISE = {
    "late": 'pc.Channel("m", std=0.05, noise=families.Mixture(0.2, 15.0, late="exponential"))',
    "memory": 'pc.Channel("m", std=0.02, memory=families.Memory(0.05, 2.0))',
    "growing": 'pc.Channel("m", std=families.Grows(0.03, 0.02))',
}
MIXED = 'pc.Channel("m", std=pc.Unknown(0.1), noise=families.Mixture({}, pc.Unknown(8.0), late="exponential"))'
CONSTANT = 'pc.Channel("m", std=pc.Unknown(0.1))'
DECLARED_NOISE = {  # of each: as it may be declared now, and the former declarations
    "late": {
        "learnt": MIXED.format("pc.Unknown(0.1)"),
        "by-sensor": MIXED.format('pc.Unknown(0.1, by="sensor")'),
        "student": 'pc.Channel("m", std=pc.Unknown(0.1), noise=families.StudentT(4.0))',
        "normal": CONSTANT,
    },
    "memory": {
        "memory": 'pc.Channel("m", std=pc.Unknown(0.05), memory=families.Memory(pc.Unknown(0.1), 2.0))',
        "white": CONSTANT,
    },
    "growing": {
        "grows": 'pc.Channel("m", std=families.Grows(pc.Unknown(0.1), pc.Unknown(0.05)))',
        "constant": CONSTANT,
    },
}


def beacons(channel, dimension):
    """A network of five beacons whose ranges have offsets, with the channel of a declaration."""
    import probcal as pc
    from probcal import noise as families

    @pc.sensor(range=eval(channel, {"pc": pc, "families": families}))
    def uwb(target, pose, *, range_offset=pc.Bias("m", 0.3, zeros="none")):
        return dict(range=pc.geometry.norm(target.position - pose.position) + range_offset)

    places = [(*place, 3.0 * (k % 2)) for k, place in enumerate(BEACONS)]
    return pc.Network(
        [uwb.on(pc.Node(f"a{k}", p[:dimension], survey={"position": 0.01})) for k, p in enumerate(places)]
    )


@situation(*((true, name, d) for true, own in DECLARED_NOISE.items() for name in own for d in (2, 3)))
def ranges(seed, true, declared, dimension):
    """Offsets and track where the noise is declared as it is, and as it was declared before; all of it is drawn."""
    import probcal as pc

    middle = (5.0, 4.0, 1.0)[:dimension]
    motion = pc.Target(pc.ConstantVelocity(0.2), {"position": (middle, 2.0), "velocity": ((0.0,) * dimension, 0.5)})
    time = PACE * np.arange(WALK)
    run = pc.simulate(beacons(TRUE_NOISE[true], dimension), motion, time, key=seed, share=1.0)
    network = beacons(DECLARED_NOISE[true][declared], dimension)
    problem = pc.Problem(network, motion, run.table)
    tree = pc.assess(problem, pc.fit(problem, pc.MAP(), prior=pc.Gaussian()))
    group, truth = tree["calibration"].to_dataset(), np.array([run.truth.biases[label] for label in problem.labels])
    inside = (group["lower"].values <= truth) & (truth <= group["upper"].values)
    names = [f"position_{x}" for x in "xyz"[:dimension]]
    track, path = tree["track/target"].to_dataset(), run.truth.tracks[names].to_numpy()
    mean, sd = (track[part].sel(component=names).values for part in ("mean", "sd"))
    held = np.abs(mean - path) < 1.598 * sd  # 89 % of a Gaussian
    best = pc.fit(pc.Problem(beacons(TRUE_NOISE[true], dimension), motion, run.table), pc.MAP(), prior=pc.Gaussian())
    known = best["track/target"].to_dataset()["mean"].sel(component=names).values
    return {
        "offsets": share_of(inside, np.ones(len(truth), bool)),
        "track": share_of(held, np.ones_like(held)),
        "offset rmse in m": float(np.sqrt(np.mean((group["mean"].values - truth) ** 2))),
        "bound": float(np.sqrt(np.mean(best["calibration"].to_dataset()["sd"].values ** 2))),
        "track rmse in m": float(np.sqrt(np.mean((mean - path) ** 2))),
        "noise known": float(np.sqrt(np.mean((known - path) ** 2))),
        "status": tree.attrs["status"],
    }  # fmt: skip


if __name__ == "__main__":
    main()
