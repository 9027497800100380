"""The PHD filter beside that of Stone Soup, on the same detections with the same numbers.

    uv run --with stonesoup python benchmarks/phd.py --runs 5
    uv run python benchmarks/phd.py --scenes 300

Five objects in a square of 2 km, seen by a sensor of positions (5 m) in 60 scans, 90 % detection, 20 false ones a scan.
Both filters start with 5 objects expected undetected (sd 600 m), drop components up to 1e-5, merge within a squared
Mahalanobis distance of 4 and keep 32. Printed: seconds and those of the processor (ours compiled, the best of five, the
first call and the whole verb beside it; Stone Soup's with detections gated at 5 sd, and ungated), the mean number and
GOSPA with a cut of 30 m. Stone Soup's reducer cuts merged weights at 1; its last line leaves them whole. Without Stone
Soup its lines are left out.

With `--scenes` it counts instead: scenes of 25 scans drawn from the model of the filters, three objects (a Poisson
number) to begin with, which stay and none comes, or which stay for 50 s while one comes in 20 s. Printed are the mean
error of the number over scenes and scans, its standard error, and mean squares.
"""

import argparse
import datetime
import importlib.util
import time

import jax
import numpy as np
import pandas as pd

import probcal as pc
from probcal.tracking.entry import asked
from probcal.tracking.phd import LEAST, filter_intensity

SCANS, OBJECTS, PROBABILITY, CLUTTER, STD = 60, 5, 0.9, 20.0, 5.0
HALF, SPREAD, SPEED, DRIVE = 1000.0, 600.0, 12.0, 0.3
BIRTHS, LIFETIME, MOST, PRUNE, MERGE = 0.02, 600.0, 32, 1e-5, 4.0
CUT = 30.0
COUNTED = (  # births a second, lifetime in s, probability of detection, false detections a scan
    (1e-4, 1e6, 0.999, 2.0), (1e-4, 1e6, 0.9, 0.01), (1e-4, 1e6, 0.95, 2.0), (1e-4, 1e6, 0.9, 5.0),
    (0.05, 50.0, 0.95, 2.0), (0.05, 50.0, 0.9, 5.0),
)  # fmt: skip
PEERS = (  # name, Mahalanobis distance of the gate, whether weights are cut at 1
    ("Stone Soup, gated", 5.0, True),
    ("Stone Soup, ungated", 1e9, True),
    ("Stone Soup, gated, merged weights kept", 5.0, False),
)


@pc.sensor(x=pc.Channel("m", std=STD), y=pc.Channel("m", std=STD))
def fix(target, pose):
    """Where a target is from the node."""
    line = target.position - pose.position
    return dict(x=line[0], y=line[1])


def scene(seed):
    """True places (SCANS, OBJECTS, 2), and the detections (n, 2) of every scan."""
    rng = np.random.default_rng(seed)
    place, speed = rng.uniform(-600.0, 600.0, (OBJECTS, 2)), rng.uniform(-8.0, 8.0, (OBJECTS, 2))
    true, told = [], []
    for k in range(SCANS):
        if k:
            one, two = DRIVE * rng.standard_normal((2, OBJECTS, 2))
            place, speed = place + speed + (one + two / np.sqrt(3.0)) / 2.0, speed + one
        seen = place[rng.uniform(size=OBJECTS) < PROBABILITY]
        false = rng.uniform(-HALF, HALF, (rng.poisson(CLUTTER), 2))
        true.append(place)
        told.append(rng.permutation(np.concatenate([seen + STD * rng.standard_normal(seen.shape), false])))
    return true, told


def heaviest(weight, place):
    """Places of as many components as their weights add up to, none lighter than 0.05: the peaks of `phd_filter`."""
    chosen = np.argsort(-weight)[: round(float(weight.sum()))]
    return place[chosen[weight[chosen] >= LEAST]]


def ours(told, kind, update):
    """Seconds of the first call, the best of five, of the processor and of the whole verb; numbers, places by scan."""
    rows = [(float(k), "a", *place) for k, places in enumerate(told) for place in places]
    seen = pc.Detection(PROBABILITY, clutter=CLUTTER, limits={"x": (-HALF, HALF), "y": (-HALF, HALF)})
    network = pc.Network([fix.on(pc.Node("a", (0.0, 0.0)), detection=seen)])
    start = {"position": ((0.0, 0.0), SPREAD), "velocity": ((0.0, 0.0), SPEED)}
    table = pd.DataFrame(rows, columns=["time", "sensor", "x", "y"])
    problem = pc.Problem(network, pc.Target(pc.ConstantVelocity(DRIVE), start), table)
    told_of = dict(objects=float(OBJECTS), births=BIRTHS, lifetime=LIFETIME, most=MOST)
    with jax.enable_x64(True):
        _, watch, views, known, chances, cloud = asked("benchmark", problem, None, None, sensors=(), **told_of)
        took, busy = [], []
        for _ in range(6):
            begun, worked = time.perf_counter(), time.process_time()
            found = jax.block_until_ready(
                filter_intensity(
                    watch, views, known, chances, cloud, MOST, kind=kind, update=update, prune=PRUNE, merge=MERGE
                )
            )
            took.append(time.perf_counter() - begun)
            busy.append(time.process_time() - worked)
    after = jax.device_get(found.after)
    pc.phd_filter(problem, kind=kind, update=update, **told_of)
    begun = time.perf_counter()
    pc.phd_filter(problem, kind=kind, update=update, **told_of)
    verb = time.perf_counter() - begun
    places = [heaviest(w, m) for w, m in zip(after.weight, after.mean[:, :, :2], strict=True)]
    return took[0], min(took[1:]), min(busy[1:]), verb, after.weight.sum(1), (after.weight > 0).sum(1).mean(), places


def theirs(told, gate, cut=True):
    """Seconds of Stone Soup's filter, numbers, and places by scan; its reducer cuts merged weights at 1."""
    from stonesoup.hypothesiser.distance import DistanceHypothesiser
    from stonesoup.hypothesiser.gaussianmixture import GaussianMixtureHypothesiser
    from stonesoup.measures import Mahalanobis
    from stonesoup.mixturereducer.gaussianmixture import GaussianMixtureReducer
    from stonesoup.models.measurement.linear import LinearGaussian
    from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
    from stonesoup.predictor.kalman import KalmanPredictor
    from stonesoup.types.detection import Detection
    from stonesoup.types.state import TaggedWeightedGaussianState
    from stonesoup.updater.kalman import KalmanUpdater
    from stonesoup.updater.pointprocess import PHDUpdater

    motion = CombinedLinearGaussianTransitionModel([ConstantVelocity(DRIVE**2)] * 2)
    sensor = LinearGaussian(4, (0, 2), STD**2 * np.eye(2))
    single = KalmanUpdater(sensor)
    stays = float(np.exp(-1.0 / LIFETIME))
    updater = PHDUpdater(
        single, clutter_spatial_density=CLUTTER / (2 * HALF) ** 2, prob_detection=PROBABILITY, prob_survival=stays
    )
    near = DistanceHypothesiser(KalmanPredictor(motion), single, Mahalanobis(), missed_distance=gate)
    hypothesiser = GaussianMixtureHypothesiser(near, order_by_detection=True)

    class Whole(GaussianMixtureReducer):
        def merge_components(self, *pair):
            merged = super().merge_components(*pair)
            merged.weight = sum(part.weight for part in pair)
            return merged

    reducer = (GaussianMixtureReducer if cut else Whole)(
        prune_threshold=PRUNE, pruning=True, merge_threshold=MERGE, merging=True, max_number_components=MOST
    )
    begin = datetime.datetime(2020, 1, 1)
    when = [begin + datetime.timedelta(seconds=k) for k in range(SCANS)]
    detections = [
        [Detection(place[:, None], timestamp=t, measurement_model=sensor) for place in places]
        for places, t in zip(told, when, strict=True)
    ]
    covariance = np.diag([SPREAD**2, SPEED**2] * 2)
    parts, hidden, sums, places = [], float(OBJECTS), [], []
    begun, worked = time.perf_counter(), time.process_time()
    for k, (found, now) in enumerate(zip(detections, when, strict=True)):
        if k:
            hidden = hidden * stays + BIRTHS
        birth = TaggedWeightedGaussianState(np.zeros((4, 1)), covariance, timestamp=now, weight=hidden, tag="birth")
        hypotheses = hypothesiser.hypothesise([*parts, birth], found, now)
        updated = updater.update(hypotheses)
        parts = reducer.reduce(list(updated))
        hidden *= 1.0 - PROBABILITY
        sums.append(sum(float(part.weight) for part in parts))
        weight, mean = (np.array([np.ravel(get(p)) for p in parts], float) for get in (_weight, _mean))
        places.append(heaviest(weight[:, 0], mean[:, [0, 2]]))
    return time.perf_counter() - begun, time.process_time() - worked, np.array(sums), len(parts), places


def _weight(part):
    return part.weight


def _mean(part):
    return part.mean


def drawn(rng, births, lifetime, probability, clutter, scans=25, slots=24):
    """Detections (scans, slots, 2), which are there (the same), and the true numbers (scans,), as the filters think."""
    y, there, number = np.zeros((scans, slots, 2)), np.zeros((scans, slots, 2)), np.zeros(scans)
    place, speed = np.zeros((2, 0, 2))
    for k in range(scans):
        if k:
            stay = rng.uniform(size=len(place)) < np.exp(-1.0 / lifetime)
            place, speed = place[stay], speed[stay]
            one, two = DRIVE * rng.standard_normal((2, len(place), 2))
            place, speed = place + speed + (one + two / np.sqrt(3.0)) / 2.0, speed + one
        more = rng.poisson(births if k else 3.0)
        place = np.concatenate([place, 100.0 * rng.standard_normal((more, 2))])
        speed = np.concatenate([speed, 6.0 * rng.standard_normal((more, 2))])
        seen = place[rng.uniform(size=len(place)) < probability]
        false = rng.uniform(-300.0, 300.0, (rng.poisson(clutter), 2))
        told = np.concatenate([seen + STD * rng.standard_normal(seen.shape), false])[:slots]
        y[k, : len(told)], there[k, : len(told)], number[k] = told, 1.0, len(place)
    return y, there, number


def counts(scenes):
    """Print how well both filters count objects of scenes from their own model."""
    print("| births, lifetime, detection, clutter | filter | mean error | its se | mean square | variance stated |")
    print("|---|---|---|---|---|---|")
    for births, lifetime, probability, clutter in COUNTED:
        rng = np.random.default_rng(0)
        columns = zip(*(drawn(rng, births, lifetime, probability, clutter) for _ in range(scenes)), strict=True)
        y, there, true = (np.stack(column) for column in columns)
        seen = pc.Detection(probability, clutter=clutter, limits={"x": (-300.0, 300.0), "y": (-300.0, 300.0)})
        network = pc.Network([fix.on(pc.Node("a", (0.0, 0.0)), detection=seen)])
        start = {"position": ((0.0, 0.0), 100.0), "velocity": ((0.0, 0.0), 6.0)}
        rows = [(float(k), "a", *place) for k in range(y.shape[1]) for place in y[0, k]]
        table = pd.DataFrame(rows, columns=["time", "sensor", "x", "y"])
        problem = pc.Problem(network, pc.Target(pc.ConstantVelocity(DRIVE), start), table)
        with jax.enable_x64(True):
            _, watch, views, known, chances, cloud = asked(
                "benchmark", problem, None, None, objects=3.0, births=births, lifetime=lifetime, most=MOST, sensors=()
            )
            rows = watch.scans.epoch.rows[0]
            for kind in ("phd", "cphd"):

                def go(y, mask, kind=kind, watch=watch, rows=rows, rest=(views, known, chances, cloud)):
                    epoch = watch.scans.epoch._replace(rows=(rows._replace(y=y, mask=mask),))
                    found = filter_intensity(
                        watch._replace(scans=watch.scans._replace(epoch=epoch)), *rest, MOST, kind=kind
                    )
                    return found.count, found.spread

                count, spread = jax.device_get(jax.jit(jax.vmap(go))(y, there))
                each = (count - true).mean(1)
                print(f"| {births:g}, {lifetime:g} s, {probability:g}, {clutter:g} | {kind} | {each.mean():+.3f} |"
                      f" {each.std() / np.sqrt(scenes):.3f} | {((count - true) ** 2).mean():.3f} |"
                      f" {spread.mean():.3f} |", flush=True)  # fmt: skip


def main():
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--scenes", type=int, default=0)
    chosen = parser.parse_args()
    if chosen.scenes:
        counts(chosen.scenes)
        return
    peer = importlib.util.find_spec("stonesoup") is not None
    if not peer:
        print("Stone Soup is not installed, so that only our filters run: uv run --with stonesoup python ...")
    lines = {}
    for seed in range(chosen.runs):
        true, told = scene(seed)
        for kind, update in (("phd", "extended"), ("phd", "cubature"), ("cphd", "extended")):
            first, best, busy, verb, number, kept, places = ours(told, kind, update)
            lines.setdefault(f"probcal {kind} {update}", []).append(
                (number, kept, places, true, best, busy, first, verb)
            )
        for name, gate, cut in PEERS if peer else ():
            took, busy, number, kept, places = theirs(told, gate, cut)
            lines.setdefault(name, []).append((number, kept, places, true, took, busy, took, took))
    print(
        "\n| filter | s | processor s | first call | verb | number | rms error | components | GOSPA | missed, false |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|")
    for name, runs in lines.items():
        took = [np.median([run[i] for run in runs]) for i in range(4, 8)]
        number = np.array([run[0][10:] for run in runs])
        score = [pc.gospa(run[2][10:], run[3][10:], cut=CUT) for run in runs]
        far, missed, false = (np.mean([getattr(s, k) for s in score]) for k in ("distance", "missed", "false"))
        print(f"| {name} | {took[0]:.3f} | {took[1]:.3f} | {took[2]:.1f} | {took[3]:.2f} | {number.mean():.3f} |"
              f" {np.sqrt(np.mean((number - OBJECTS) ** 2)):.2f} | {np.mean([run[1] for run in runs]):.1f} |"
              f" {far:.2f} m | {missed:.2f}, {false:.2f} |")  # fmt: skip
    own = lines["probcal phd extended"]
    for name in [name for name in lines if name.startswith("Stone")]:
        wall, busy = ([b[i] / a[i] for a, b in zip(own, lines[name], strict=True)] for i in (4, 5))
        apart = [np.abs(a[0] - b[0]).mean() for a, b in zip(own, lines[name], strict=True)]
        ratios = [f"{np.median(v):.0f} ({min(v):.0f} to {max(v):.0f})" for v in (wall, busy)]
        print(f"{name}: {ratios[0]} times as long, {ratios[1]} times the processor's seconds;"
              f" numbers {np.mean(apart):.3f} apart by scan")  # fmt: skip


if __name__ == "__main__":
    main()
