"""Starts and directions in numbers: which start reaches the best optimum, and how near the bounds the answers come.

    uv run python benchmarks/starts.py models        share of random starts and of the automatic one, model by model
    uv run python benchmarks/starts.py array --runs 200
    uv run python benchmarks/starts.py filters --runs 100
    uv run python benchmarks/starts.py swaps SHARED_DATA

Each prints a table; seeds are the run numbers.
"""

import argparse
import importlib
import itertools
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "models"))

RANDOM = 10  # random starts of a model
SAME = 1.0  # nats under the best within which a start has reached it
STD = np.deg2rad(1.0)
SHIPPED = {  # model, and what of `shared/data` it needs
    "plaza": None, "plaza_free": None, "radars": None, "microphones": None, "networks": None, "thesis": None,
    "doa_array": None, "rss_field_trial": None, "sflab": "sflab_mic_toa/dataset_1_exp2.mat", "robots":
    "mrclam/MRCLAM_Dataset6", "receivers": "mlat_locards/set_1.csv", "bearing_beacons": "roh_bearing",
    "ble_office": "ble_rss", "tdoa_flight": "uwb_tdoa",
}  # fmt: skip


def one_model(name, data):
    """Costs at the declared scales that the automatic start and random ones reach: seconds, and share at the best."""
    from probcal.gaussian.mode import find_mode
    from probcal.modes import optima
    from probcal.modes.grid import grid_start
    from probcal.priors import Precision

    with jax.enable_x64(True):
        problem = importlib.import_module(name).problem(data)
        scales = Precision(jnp.ones(problem.model.biases))

        def reached(point):
            mode = find_mode(problem.model, point, scales, 100, 1e-3)
            return float(mode.cost)

        begun = time.perf_counter()
        found = optima(problem)
        cold = time.perf_counter() - begun
        automatic = [reached(one.point) for one in found]
        rng = np.random.default_rng(0)
        drawn = [reached(grid_start(problem, rng.standard_normal(problem.model.biases)))
                 for _ in range(RANDOM)]  # fmt: skip
    best = np.nanmin([*automatic, *drawn])
    share = np.mean([cost < best + SAME for cost in drawn])
    return name, len(problem.labels), len(found), cold, min(automatic) - best, share


def models(args):
    """One row a model: optima of the automatic start, seconds of it cold, nats it misses, share of random starts."""
    print(f"{'model':18} biases optima   cold s  nats above the best  share of {RANDOM} random starts at the best")
    chosen = args.only or SHIPPED
    for name in chosen:
        data = None if SHIPPED[name] is None else Path(args.data) / SHIPPED[name]
        if data is not None and not data.exists():
            print(f"{name:18} its recording is not here")
            continue
        name, biases, count, cold, above, share = one_model(name, data)
        print(f"{name:18} {biases:6} {count:6} {cold:8.1f}  {above:19.2f}  {share:8.2f}", flush=True)


def one_array(run, space):
    """Errors of the automatic start and of the batch fit of one run of the array, and the bound of each bias."""
    import doa_array

    import probcal
    from probcal import EA
    from probcal.modes import optima

    problem, truth = doa_array.problem(run=run, space=space), doa_array.truth(run=run, space=space)
    true = np.array([truth.biases[label] for label in problem.labels])
    angle = np.array(["heading" in label for label in problem.labels])

    def off(value):
        error = value - true
        return np.where(angle, (error + np.pi) % (2 * np.pi) - np.pi, error)

    with jax.enable_x64(True):
        start = off(np.asarray(optima(problem)[0].point.z) * problem.scales)
    tree = probcal.fit(problem, EA())
    group = tree["calibration"].to_dataset().sel(bias_label=list(problem.labels))
    error, sd = off(group["mean"].values), group["sd"].values
    inside = (group["lower"].values <= group["mean"].values - error) & (
        group["mean"].values - error <= group["upper"].values
    )
    bound = probcal.bounds(problem, kind="parametric", truth=truth)["bias"]["sd"].to_series()
    return start, error, sd, inside, bound.reindex(problem.labels).to_numpy(), angle, tree.attrs["status"]


def array(args):
    """The five sensors of the DOA paper from random headings."""
    with ProcessPoolExecutor(2, get_context("spawn")) as pool:
        found = list(pool.map(one_array, range(args.runs), itertools.repeat(args.space), chunksize=5))
    angle = found[0][5]
    start, error, bound = (np.array([f[k] for f in found]) for k in (0, 1, 4))
    right = (np.abs(error[:, angle]) < np.deg2rad(5.0)).all(1) & (np.abs(error[:, ~angle]) < 30.0).all(1)
    print(f"{args.runs} runs, {'space' if args.space else 'plane'}: right (5 deg, 30 m) {right.mean():.3f}")
    print(f"statuses {dict(zip(*np.unique([f[6] for f in found], return_counts=True), strict=True))}")
    for name, mine, unit in (("heading [deg]", angle, np.rad2deg(1)), ("place [m]", ~angle, 1.0)):
        of = [np.sqrt(np.mean(x[right][:, mine] ** 2)) * unit for x in (start, error, bound)]
        inside = np.mean([f[3][mine] for f, r in zip(found, right, strict=True) if r])
        print(f"{name}: RMSE of the start {of[0]:.3f}, of the fit {of[1]:.3f}, bound {of[2]:.3f}")
        print(f"{name}: 89 % intervals hold {inside:.3f}")


def cartesian(t, angles, std, distance, spread, speed):
    """The plain filter: state place and velocity, started at a guessed distance along the first bearing."""
    x = np.array([distance * np.cos(angles[0]), distance * np.sin(angles[0]), 0.0, 0.0])
    along, across = np.array([np.cos(angles[0]), np.sin(angles[0])]), np.array([-np.sin(angles[0]), np.cos(angles[0])])
    P = np.zeros((4, 4))
    P[:2, :2] = spread**2 * np.outer(along, along) + (distance * std) ** 2 * np.outer(across, across)
    P[2:, 2:] = speed**2 * np.eye(2)
    places = [x[:2]]
    for k in range(1, len(t)):
        F = np.kron(np.array([[1.0, t[k] - t[k - 1]], [0.0, 1.0]]), np.eye(2))
        x, P = F @ x, F @ P @ F.T
        r = x[0] ** 2 + x[1] ** 2
        H = np.array([-x[1], x[0], 0.0, 0.0]) / r
        K = P @ H / (H @ P @ H + std**2)
        x = x + K * ((angles[k] - np.arctan2(x[1], x[0]) + np.pi) % (2 * np.pi) - np.pi)
        P = (np.eye(4) - np.outer(K, H)) @ P @ (np.eye(4) - np.outer(K, H)).T + std**2 * np.outer(K, K)
        places.append(x[:2])
    return np.array(places)


def filters(args):
    """Case of the paper (10, 10) m/s, T = 1 s, 40 bearings of 1 deg; the range guessed wrong by a factor."""
    from probcal.doa import bearing_track

    t = np.arange(40.0)
    path = np.array([-200.0, 100.0]) + np.outer(t, [10.0, 10.0])
    true = np.unwrap(np.arctan2(path[:, 1], path[:, 0]))
    print("guess / range   share of runs whose last direction or shape is lost: Cartesian, modified polar, smoother")
    for factor in (0.03, 0.1, 0.3, 1.0, 3.0, 10.0):
        lost = np.zeros(3)
        for run in range(args.runs):
            noisy = true + STD * np.random.default_rng(run).standard_normal(40)
            guess = factor * np.linalg.norm(path[0])
            runs = [
                cartesian(t, noisy, STD, guess, 0.5 * guess, 15.0),
                bearing_track(t, noisy, STD, distance=guess, smooth=False).place,
                bearing_track(t, noisy, STD, distance=guess).place,
            ]
            for k, found in enumerate(runs):
                found = found[-30:]
                own = found / np.linalg.norm(found, axis=1).mean()
                want = path[-30:] / np.linalg.norm(path[-30:], axis=1).mean()
                lost[k] += not np.linalg.norm(own - want, axis=1).max() < 0.3  # of the mean range, up to scale
        print(f"{factor:13.1f}   {lost[0] / args.runs:.2f} {lost[1] / args.runs:.2f} {lost[2] / args.runs:.2f}")


def swaps(args):
    """Every pair of the microphones, and some of the anchors, exchanged: errors of the fit by default."""
    import sflab
    import tdoa_flight

    import probcal
    from probcal import EA
    from probcal.results.modes import rivals

    sound = Path(args.data) / SHIPPED["sflab"]
    flight = Path(args.data) / SHIPPED["tdoa_flight"]
    cases = [(sflab, sound, pair, "mic_", 1) for pair in itertools.combinations(range(1, 9), 2)]
    cases += [(tdoa_flight, flight, pair, "anchor_", 0) for pair in ((3, 4), (1, 3), (0, 2), (1, 6), (0, 5), (2, 7))]
    for model, data, pair, prefix, first in cases:
        problem, truth = model.problem(data, pair), model.truth(data, pair)
        begun = time.perf_counter()
        tree = probcal.fit(problem, EA(), prior=model.PRIOR)
        mean = tree["calibration"]["mean"].to_series()
        axes = "xyz"[: problem.network.dimension]
        labels = [[f"{prefix}{n}.position_{a}" for a in axes] for n in range(first, 8 + first)]
        error = [np.linalg.norm([mean[name] - truth.biases[name] for name in node]) for node in labels]
        others = rivals(tree).sizes["mode"]
        of_the_two = max(error[n - first] for n in pair)
        print(f"{model.__name__} {pair}: {tree.attrs['status']}, largest error {max(error):.2f} m")
        seconds = time.perf_counter() - begun
        print(f"  of the two {of_the_two:.2f} m, {others} other answers, {seconds:.1f} s", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("models", "array", "filters", "swaps"))
    parser.add_argument("data", nargs="?", default=str(Path(__file__).parents[2] / "shared" / "data"))
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--space", action="store_true")
    parser.add_argument("--only", nargs="*")
    args = parser.parse_args()
    globals()[args.what](args)


if __name__ == "__main__":
    main()
