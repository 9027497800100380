"""Large networks: seconds, memory and coverage of a fit, in the form that is chosen or in another.

    uv run python benchmarks/large.py --side 25 50 100
    uv run python benchmarks/large.py --side 32 --targets 1 --reach 1e5     (every radar sees every epoch)
    uv run python benchmarks/large.py --side 25 --targets 3 --epochs 250 --method gibbs
    uv run python benchmarks/large.py --side 100 --drift 5      (three of them drift: does `assess` say so?)
    uv run python benchmarks/large.py --side 3 --targets 1 --epochs 111112 --reach 1e5 --save fit.nc   (few, many rows)

Radars of `models/large_network.py` on a square of so many along each edge, one line each: rows, biases, form, seconds
of building and of the fit (compiled anew), share of biases that 89 % intervals hold, rms z, the most memory of the
process so far; then the exponent of seconds over rows between the smallest and the largest. One square in a process
says what memory it takes.
"""

import argparse
import resource
import sys
import time
from pathlib import Path

import numpy as np

import probcal as pc

sys.path.insert(0, str(Path(__file__).parents[1] / "models"))
import large_network

METHODS = {"ea": (pc.EA, None), "map": (pc.MAP, pc.Gaussian()), "gibbs": (pc.Gibbs, None)}


def drifted(problem, metres):
    """The problem with three radars' ranges longer in the second half, of those that hear most; and which biases."""
    table = problem.measurements.table.frame.copy()
    late = table["time"] >= table["time"].median()
    heard = table.groupby(["sensor", late]).size().unstack(fill_value=0).min(axis=1)
    chosen = heard.sort_values(ascending=False, kind="stable").index[:30:10].tolist()
    table.loc[table["sensor"].isin(chosen) & late, "range"] += metres
    motion = large_network.ConstantVelocity(large_network.DRIVE)
    return pc.Problem(problem.network, motion, table), [f"{name}.range_offset" for name in chosen]


def main():
    """Fit and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--side", type=int, nargs="+", default=[25, 50, 100])
    parser.add_argument("--targets", type=int, help="by default as many as keep the rows of a radar alike")
    parser.add_argument("--epochs", type=int, default=1000)
    parser.add_argument("--reach", type=float, default=large_network.REACH)
    parser.add_argument("--method", choices=METHODS, default="ea")
    parser.add_argument("--engine", default="auto")
    parser.add_argument("--save", type=Path, help="write the fit, to say how large its file is")
    parser.add_argument("--drift", type=float, help="assess the fit, three radars' ranges so many m longer later on")
    chosen = parser.parse_args()
    kind, prior = METHODS[chosen.method]
    method, found = pc.Gibbs() if kind is pc.Gibbs else kind(engine=chosen.engine), []
    for side in chosen.side:
        targets = chosen.targets or max(1, round(20 * (side / 100) ** 2))
        given = {"side": side, "targets": targets, "epochs": chosen.epochs, "reach": chosen.reach}
        truth = large_network.truth(**given)
        begun = time.perf_counter()
        problem = large_network.problem(**given)
        if chosen.drift is not None:
            problem, drifting = drifted(problem, chosen.drift)
        built = time.perf_counter() - begun
        begun = time.perf_counter()
        tree = pc.fit(problem, method, prior=prior)
        took = time.perf_counter() - begun
        group = tree["calibration"].to_dataset()
        true = np.array([truth.biases[label] for label in problem.labels])
        held = np.mean((group["lower"].values <= true) & (true <= group["upper"].values))
        z = np.sqrt(np.mean(((group["mean"].values - true) / group["sd"].values) ** 2))
        rows, form = len(problem.measurements.time), "sparse" if "block" in group else "dense"
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
        print(
            f"{side} x {side}: {rows} rows, {len(true)} biases, {form}: built {built:.1f} s, fit {took:.1f} s,"
            f" {tree.attrs['status']}; 89 % hold {held:.3f}, rms z {z:.2f}; {peak:.1f} GB",
            flush=True,
        )
        if chosen.drift is not None:
            begun = time.perf_counter()
            verdicts = pc.assess(problem, tree)["verdict"].to_dataset()["verdict"].to_series()
            named = verdicts.index[verdicts == "drifting"].tolist()
            words = ", ".join(f"{word} {count}" for word, count in verdicts.value_counts().items())
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
            print(f"assessed in {time.perf_counter() - begun:.1f} s, {peak:.1f} GB: {words}")
            print(f"made to drift: {', '.join(drifting)}; called so: {', '.join(named) or 'none'}", flush=True)
        if chosen.save:
            print(f"{pc.save(tree, chosen.save).stat().st_size / 1e6:.1f} MB of fit.nc", flush=True)
        found.append((rows, took))
    if len(found) > 1:
        (few, short), (many, long) = found[0], found[-1]
        print(f"seconds grow with rows to the power of {np.log(long / short) / np.log(many / few):.2f}")


if __name__ == "__main__":
    main()
