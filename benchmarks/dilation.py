"""Does a bearings-only scene keep its size? Log dilation of the fitted places of six surveyed cameras.

uv run python benchmarks/dilation.py --runs 20 --method ea --method ea-printed --method collapsed

Only the motion noise, which is known, tells the size. The data are drawn from the model, the headings from their scale;
one line a method: mean of the log of the scale of the fitted places over the true ones, and its standard error.
"""

import argparse
import sys
from pathlib import Path

import numpy as np

import probcal
from probcal.cli.names import METHODS
from probcal.inference.methods import METHODS as BY_NAME

sys.path.insert(0, str(Path(__file__).parents[1] / "models"))
import networks


def scale(fitted, true):
    """Scale of the similarity that takes true places (nodes, 2) to fitted ones."""
    a, b = fitted - fitted.mean(0), true - true.mean(0)
    a, b = a[:, 0] + 1j * a[:, 1], b[:, 0] + 1j * b[:, 1]
    return abs(np.vdot(b, a) / np.vdot(b, b))


def places(values):
    """Places (nodes, 2) of the cameras at biases by label."""
    shift = [[values[f"c{k}.position_{axis}"] for axis in "xy"] for k in range(len(networks.CAMERAS))]
    return networks.CAMERAS + np.array(shift)


def main():
    """Print the table."""
    ask = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    ask.add_argument("--runs", type=int, default=20)
    ask.add_argument("--method", action="append", choices=list(METHODS))
    given = ask.parse_args()
    print("| method | mean log dilation | standard error | stated network | not converged |\n|---|---|---|---|---|")
    for name in given.method or ["ea", "ea-printed"]:
        found, stated, lost, (method, prior) = [], [], 0, BY_NAME[name]
        for run in range(given.runs):
            problem, truth = networks.setting(run, "bearings", share=1.0)
            tree = probcal.fit(problem, method, prior=prior, key=run)
            lost += tree.attrs["status"] != "converged"
            mean = tree["calibration"]["mean"].to_series().to_dict()
            true = places(truth.biases)
            found.append(np.log(scale(places(mean), true)))
            stated.append(np.log(scale(networks.CAMERAS, true)))
        error = np.std(found, ddof=1) / np.sqrt(len(found))
        print(f"| {name} | {np.mean(found):+.4f} | {error:.4f} | {np.mean(stated):+.4f} | {lost} |", flush=True)


if __name__ == "__main__":
    main()
