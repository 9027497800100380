"""The sixteen radars of `models/self_configuring_grid.py`, configured from detections without names.

    uv run python benchmarks/grid.py --runs 5
    uv run python benchmarks/grid.py --runs 20 --beliefs

Printed for every run: rms error of places and headings of the beliefs (`propagate_beliefs`) after the tree and at the
end, iterations, edges, sensors not placed and of several poses, seconds of the tree and of an iteration; then after
the fit, with the stated sds and those of the same fit with names known; mean square of z, how often 89 % intervals
hold, objects, rounds; seconds in all. With `--beliefs` no fit is made; `--messages kernel` and `--terms quad` choose
others.
"""

import argparse
import resource
import sys
import time
from pathlib import Path

import numpy as np

import probcal as pc
from probcal.tracking.groups import belief_group

sys.path.insert(0, str(Path(__file__).parents[1] / "models"))
import self_configuring_grid as grid


def rms(values):
    """Root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def errors(off, place):
    """Errors of places in m and of headings in deg."""
    return [rms(off[place]), rms(np.rad2deg(off[~place]))]


def named(run, labels):
    """Sds of the same fit where every row names its object, without false and missed detections left out."""
    table = grid.scenario(run, named=True).table
    start = pc.Target(pc.ConstantVelocity(grid.NOISE), grid.START)
    tree = pc.fit(pc.Problem(grid.network(named=True), start, table), pc.MAP(), prior=pc.Gaussian())
    return tree["calibration"]["sd"].sel(bias_label=list(labels)).values


def told(own, labels, true, place):
    """Errors of the beliefs after the tree and at the end; iterations, edges, not placed, rivals, and seconds."""
    mean, tree = own["mean"].sel(bias_label=labels), (own["phase"] == "tree").values
    first, last = (mean.isel(iteration=k).values - true for k in (np.flatnonzero(tree)[-1], -1))
    seconds = own["seconds"].values
    steps = np.diff(seconds)[tree[:-1].sum() :]
    return [
        *errors(first, place), *errors(last, place), own.sizes["iteration"], own.sizes["edge"],
        int((~own["placed"]).sum()), int((own["rivals"] > 0).sum()), seconds[tree][-1], np.median(steps),
    ]  # fmt: skip


def main():
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--beliefs", action="store_true")
    parser.add_argument("--messages", default="gaussian")
    parser.add_argument("--terms", default="dual")
    chosen = parser.parse_args()
    method = pc.SelfConfiguration(pc.MAP(), start="beliefs")
    found = []
    for run in range(chosen.first, chosen.first + chosen.runs):
        problem = grid.problem(run=run)
        true = np.array([grid.truth(run=run).biases[label] for label in problem.labels])
        place = np.array(["position" in label for label in problem.labels])
        begun = time.perf_counter()
        if chosen.beliefs:
            own = belief_group(pc.propagate_beliefs(problem, messages=chosen.messages, terms=chosen.terms))
        else:
            tree = pc.fit(problem, method, prior=pc.Gaussian())
            own = tree["belief"].to_dataset()
        took = time.perf_counter() - begun
        row = told(own, list(problem.labels), true, place)
        if not chosen.beliefs:
            group = tree["calibration"].to_dataset()
            off, sd = group["mean"].values - true, group["sd"].values
            held = np.mean((group["lower"].values < true) & (true < group["upper"].values))
            row += [*errors(off, place), *errors(sd, place), *errors(named(run, problem.labels), place)]
            row += [np.mean((off / sd) ** 2), held, tree.attrs["objects"], tree.attrs["rounds"]]
            print(tree.attrs["status"], end=" ")
        found.append([*row, took])
        print(run, " ".join(f"{value:.3f}" for value in found[-1]), flush=True)
    mean, runs = np.mean(found, 0), len(found)
    pair = [f"{mean[k]:.2f} m, {mean[k + 1]:.3f} deg" for k in (0, 2)]
    print(f"\n{runs} runs: tree {pair[0]}; end {pair[1]} after {mean[4]:.1f} iterations (most", end=" ")
    print(f"{max(row[4] for row in found):.0f}), {mean[5]:.0f} edges; not placed {mean[6]:.1f}, rivals {mean[7]:.1f};")
    print(
        f"tree {mean[8]:.1f} s, then {mean[9]:.2f} s an iteration, {1e3 * mean[9] / mean[5]:.1f} ms an edge;", end=" "
    )
    print(f"in all {mean[-1]:.0f} s; peak {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6:.1f} GB")
    if not chosen.beliefs:
        fit, stated, known = (f"{mean[k]:.2f} m, {mean[k + 1]:.3f} deg" for k in (10, 12, 14))
        error = np.std([row[17] for row in found], ddof=1) / np.sqrt(runs) if runs > 1 else np.nan
        print(f"fit {fit}; stated sd {stated}; sd with names {known}; rms z {np.sqrt(mean[16]):.2f};", end=" ")
        print(f"89 % hold {mean[17]:.3f} ± {error:.3f}; objects {mean[18]:.2f}; rounds {mean[19]:.1f}")


if __name__ == "__main__":
    main()
