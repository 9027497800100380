"""The sixteen radars of `models/self_configuring_grid.py`, configured from detections without names.

    uv run python benchmarks/grid.py --runs 5
    uv run python benchmarks/grid.py --runs 20 --beliefs

Printed for every run: error of places and headings of the beliefs (`propagate_beliefs`) after the tree and at the end,
iterations and seconds; then after the fit, with the stated sds and those of the same fit with names known; rms z, how
often 89 % intervals hold, objects, rounds, seconds. With `--beliefs` no fit is made; `--messages kernel` and `--terms
quad` choose others.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np

import probcal as pc

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


def main():
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--beliefs", action="store_true")
    parser.add_argument("--messages", default="gaussian")
    parser.add_argument("--terms", default="dual")
    chosen = parser.parse_args()
    method = pc.SelfConfiguration(pc.MAP(), start="beliefs")
    found = []
    for run in range(chosen.runs):
        problem = grid.problem(run=run)
        true = np.array([grid.truth(run=run).biases[label] for label in problem.labels])
        place = np.array(["position" in label for label in problem.labels])
        begun = time.perf_counter()
        beliefs = pc.propagate_beliefs(problem, messages=chosen.messages, terms=chosen.terms)
        between = time.perf_counter()
        tree_phase = beliefs.trace[beliefs.trace["phase"] == "tree"].groupby("bias")["mean"].last()
        first = tree_phase.reindex(problem.labels).to_numpy() - true
        row = [*errors(first, place), *errors(beliefs.z * problem.scales - true, place), beliefs.iterations]
        row += [len(beliefs.apart), len(beliefs.rivals), between - begun]
        if not chosen.beliefs:
            between = time.perf_counter()
            tree = pc.fit(problem, method, prior=pc.Gaussian())
            took = time.perf_counter() - between
            group = tree["calibration"].to_dataset()
            off, sd = group["mean"].values - true, group["sd"].values
            held = np.mean((group["lower"].values < true) & (true < group["upper"].values))
            row += [*errors(off, place), *errors(sd, place), *errors(named(run, problem.labels), place), rms(off / sd)]
            row += [held, tree.attrs["objects"], tree.attrs["rounds"], took]
            print(tree.attrs["status"], end=" ")
        found.append(row)
        print(run, " ".join(f"{value:.3f}" for value in row), flush=True)
    mean = np.mean(found, 0)
    pair = [f"{mean[k]:.2f} m, {mean[k + 1]:.3f} deg" for k in (0, 2)]
    print(f"\n{chosen.runs} runs: tree {pair[0]}; end {pair[1]} after {mean[4]:.1f} iterations (most", end=" ")
    print(f"{max(row[4] for row in found):.0f}); apart {mean[5]:.1f}, rivals {mean[6]:.1f}; {mean[7]:.0f} s")
    if not chosen.beliefs:
        fit, stated, known = (f"{mean[k]:.2f} m, {mean[k + 1]:.3f} deg" for k in (8, 10, 12))
        print(f"fit {fit}; stated sd {stated}; sd with names {known}; rms z {mean[14]:.2f}; 89 % hold {mean[15]:.2f};")
        print(f"objects {mean[16]:.1f}; rounds {mean[17]:.1f}; {mean[18]:.0f} s with the beliefs")


if __name__ == "__main__":
    main()
