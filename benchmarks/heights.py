"""Are offsets that trade with heights in their intervals? Before and after mixtures, by draws from the model itself.

uv run python benchmarks/heights.py --runs 24 --targets 1
uv run python benchmarks/heights.py --runs 24 --targets 3

Four anchors nearly in a plane range tags of unknown height for 40 s; offsets, heights and paths are drawn from their
priors, and the same priors are fitted. Shares of the 89 % intervals that hold the truth, of offsets and of the heights
of tracks: of one Gaussian, and of the answer; offsets more than 3 sd off; median and longest seconds of each.
"""

import argparse
from time import perf_counter
from unittest.mock import patch

import numpy as np
from verdicts import heights

from probcal import MAP, Gaussian, fit
from probcal.inference import solve


def looked_at(problem, truth):
    """The offsets and heights in their intervals, the offsets beyond 3 sd, and seconds of the fit."""
    begun = perf_counter()
    tree = fit(problem, MAP(), prior=Gaussian())
    seconds, own = perf_counter() - begun, tree["calibration"].to_dataset()
    true = np.array([truth.biases[str(label)] for label in own["bias_label"].values])
    offsets = (own["lower"].values < true) & (true < own["upper"].values)
    rows = truth.tracks if "target" in truth.tracks else truth.tracks.assign(target="target")
    tracks = []
    for name, node in tree["track"].children.items():
        track = node.to_dataset().sel(component="height")
        off = track["mean"].values - rows[rows["target"] == name].sort_values("time")["height"].values
        tracks.append(np.abs(off) < 1.598 * track["sd"].values)
    return offsets, np.concatenate(tracks), np.abs(own["mean"].values - true) > 3 * own["sd"].values, seconds


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=24)
    parser.add_argument("--targets", type=int, default=1)
    given = parser.parse_args()
    print("| answer | offsets held, % | heights held, % | offsets beyond 3 sd, % | seconds, median | longest |")
    print("|:--|--:|--:|--:|--:|--:|")
    drawn = [heights(run, given.targets) for run in range(given.runs)]
    looked_at(*drawn[0])  # compiles
    for name, function in (("one Gaussian", lambda answer, *_: answer), ("as fitted", solve.profiled)):
        with patch.object(solve, "profiled", function):
            found = [looked_at(*own) for own in drawn]
        shares = [100 * np.mean(np.concatenate([one[k] for one in found])) for k in range(3)]
        seconds = [one[3] for one in found]
        print(f"| {name} | {' | '.join(f'{s:.0f}' for s in shares)} | {np.median(seconds):.1f} | {max(seconds):.1f} |")


if __name__ == "__main__":
    main()
