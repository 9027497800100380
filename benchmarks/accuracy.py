"""Accuracy over the real recordings: uncalibrated, GTSAM (robust), EA and full Bayes, each against what is known.

    uv run --with gtsam python benchmarks/accuracy.py
    uv run --with gtsam python benchmarks/accuracy.py --only plaza flight

Printed is a Markdown table: position RMSE against the reference over the epochs that this covers, rms error of the
surveyed biases over their declared scales, the share of those that 89 % intervals hold, seconds (compiling too), and
how it ended, or why there is no answer. Every method runs in a process of its own, which is stopped after `--limit`
seconds. The recordings lie beside the project.
"""

import argparse
import importlib
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import numpy as np
from by_gtsam import RefusedError, solve
from scipy.stats import norm

import probcal as pc
from probcal.modes import automatic_start
from probcal.modes.grid import grid_start

sys.path.insert(0, str(Path(__file__).parents[1] / "models"))

DATA = Path(__file__).parents[2] / "shared" / "data"
WIDE = norm.ppf(0.945)  # sds on each side of an interval of 89 %
LINE = "| {} | {} | {} | {} | {} | {} | {} |"
HEAD = ("recording", "method", "position RMSE, m", "bias error", "89 % hold", "s", "ended")
SAMPLER = pc.Collapsed(chains=2, warmup=100, draws=600, patience=4)


@dataclass(frozen=True)
class Case:
    """A recording as one model reads it; without a `path` the model has it."""

    model: str
    path: str | None = None
    given: dict[str, Any] = field(default_factory=dict)
    prior: bool = True  # whether EA takes the PRIOR of the model


CASES = {
    "plaza": Case("plaza"),
    "plaza-free": Case("plaza_free"),
    "sflab": Case("sflab", "sflab_mic_toa/dataset_1_exp2.mat", prior=False),
    "sflab-swap-5-8": Case("sflab", "sflab_mic_toa/dataset_1_exp2.mat", {"swap": (5, 8)}, prior=False),
    "sflab-swap-1-4": Case("sflab", "sflab_mic_toa/dataset_1_exp2.mat", {"swap": (1, 4)}, prior=False),
    "robots": Case("robots", "mrclam/MRCLAM_Dataset6"),
    "robots-turned": Case("robots", "mrclam/MRCLAM_Dataset6", {"turn": {"robot_2": np.deg2rad(5.0)}}),
    "beacons": Case("bearing_beacons", "roh_bearing"),
    "beacons-any-north": Case("bearing_beacons", "roh_bearing", {"heading": "any"}),
    "office": Case("ble_office", "ble_rss"),
    "flight": Case("tdoa_flight", "uwb_tdoa"),
    "flight-swap-3-4": Case("tdoa_flight", "uwb_tdoa", {"swap": (3, 4)}),
    "receivers": Case("receivers", "mlat_locards/set_1.csv"),
    "harbour": Case("harbour", "autoferry_radar/scenario16_detections.json"),
}


@dataclass(frozen=True)
class Score:
    """One row of the table; None is what cannot be said."""

    ended: str
    place: float | None = None
    bias: float | None = None
    held: float | None = None
    seconds: float | None = None


def rmse(problem: pc.Problem, truth: pc.Truth, states: Any) -> float | None:
    """Position RMSE in m of states (E, n) of each recursion over the epochs that the truth covers."""
    squares = []
    for epochs, x in zip(problem.epochs, states, strict=True):
        start, stop = epochs.position
        true = truth.positions(epochs.time, epochs.target, stop - start)
        known = np.isfinite(true).all(1)
        squares.append(((np.asarray(x)[known, start:stop] - true[known]) ** 2).sum(1))
    found = np.concatenate(squares)
    return float(np.sqrt(found.mean())) if len(found) else None


def surveyed(problem: pc.Problem, truth: pc.Truth) -> tuple[np.ndarray, np.ndarray]:
    """Which biases were surveyed, and their true values in scales."""
    known = [m for m, label in enumerate(problem.labels) if label in truth.biases]
    return np.array(known, int), np.array([truth.biases[problem.labels[m]] / problem.scales[m] for m in known])


def plain(problem: pc.Problem, truth: pc.Truth, case: Case) -> Score:
    """No bias at all."""
    if problem.scans is not None:
        raise RefusedError("its detections name no target")
    begun = time.perf_counter()
    with jax.enable_x64(True):
        point = grid_start(problem, np.zeros(problem.model.biases), 100)
    took = time.perf_counter() - begun
    known, true = surveyed(problem, truth)
    bias = float(np.sqrt(np.mean(true**2))) if len(known) else None
    return Score("tracked", rmse(problem, truth, point.states), bias, None, took)


def by_gtsam(problem: pc.Problem, truth: pc.Truth, case: Case) -> Score:
    """Huber noise, Gaussian priors, the automatic start."""
    found = solve(problem, automatic_start(problem))
    known, true = surveyed(problem, truth)
    bias = held = None
    if len(known):
        off = np.abs(found.z[known] - true)
        bias = float(np.sqrt(np.mean(off**2)))
        held = None if found.sd is None else float(np.mean(off <= WIDE * found.sd[known]))
    return Score(found.status, rmse(problem, truth, found.states), bias, held, found.seconds)


def by_probcal(method: Any) -> Callable[..., Score]:
    """A fit by a method of this library, under the prior of the model where the method takes it."""

    def run(problem: pc.Problem, truth: pc.Truth, case: Case) -> Score:
        prior = getattr(importlib.import_module(case.model), "PRIOR", None) if case.prior else None
        said = "" if prior is None else "prior of the model"
        if prior is not None and not method.takes(prior):
            prior, said = None, "prior Horseshoe, since it does not take that of the model"
        begun = time.perf_counter()
        tree = pc.fit(problem, method, prior=prior)
        took = time.perf_counter() - begun
        found = pc.scores(tree, truth)
        reason = "" if tree.attrs["status"] in ("converged", "iterations spent") else shortened(tree.attrs["message"])
        ended = ": ".join(part for part in (tree.attrs["status"], reason) if part)
        ended = "; ".join(part for part in (ended, said) if part)
        ran = tree.attrs.get("method", "")
        if ran and ran != tree.attrs.get("requested", ran):
            ended += f"; {ran} took over"
        place = found.get("position_rmse_after")
        return Score(ended, place, found.get("bias_rmse"), found.get("coverage"), took)

    return run


METHODS: dict[str, Callable[..., Score]] = {
    "uncalibrated": plain,
    "GTSAM, Huber": by_gtsam,
    "EA": by_probcal(pc.EA()),
    "full Bayes": by_probcal(SAMPLER),
}


def shortened(text: str, most: int = 150) -> str:
    """The first sentences of a text, in one line that fits a cell."""
    line = " ".join(str(text).split()).replace("|", "/")
    return line if len(line) <= most else line[: most - 3].rsplit(" ", 1)[0] + " ..."


def scored(run: Callable[..., Score], problem: pc.Problem, truth: pc.Truth, case: Case) -> Score:
    """The score of a method, or in words why it has none."""
    begun = time.perf_counter()
    try:
        return run(problem, truth, case)
    except (pc.InputError, RefusedError) as error:
        return Score(f"refused: {shortened(str(error))}")
    except ImportError as error:
        return Score(f"not run: {shortened(str(error))} (uv run --with gtsam)")
    except (RuntimeError, ArithmeticError, ValueError, np.linalg.LinAlgError) as error:
        return Score(f"failed: {type(error).__name__}: {shortened(str(error))}", seconds=time.perf_counter() - begun)


def row(name: str, method: str, score: Score) -> str:
    """A row of the table; what is no number is a dash."""

    def cell(value: float | None, form: str) -> str:
        return "–" if value is None or not np.isfinite(value) else format(value, form)

    numbers = cell(score.place, ".3f"), cell(score.bias, ".3f"), cell(score.held, ".2f"), cell(score.seconds, ".1f")
    return LINE.format(name, method, *numbers, score.ended)


def apart(name: str, method: str, data: Path, limit: float) -> str:
    """The row of a method that runs in a process of its own."""
    command = [sys.executable, __file__, "--here", "--only", name, "--methods", method, "--data", str(data)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=limit)
    except subprocess.TimeoutExpired:
        return row(name, method, Score(f"no answer within {limit:g} s"))
    found = [line for line in done.stdout.splitlines() if line.startswith(f"| {name} |")]
    if found:
        return found[0]
    last = done.stderr.strip().splitlines()[-1:] or ["it said nothing"]
    return row(name, method, Score(f"failed (exit {done.returncode}): {shortened(last[0])}"))


def missing(case: Case, data: Path) -> str | None:
    """Why a recording is left out, None where it is not."""
    if not hasattr(importlib.import_module(case.model), "truth"):
        return f"nobody knows the truth (`models/{case.model}.py` has none)"
    return None if case.path is None or (data / case.path).exists() else f"the recording {case.path} is not here"


def main() -> None:
    """Every recording by every method."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=CASES, default=list(CASES), metavar="NAME", help=", ".join(CASES))
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS), metavar="METHOD")
    parser.add_argument("--limit", type=float, default=240, help="seconds of one method, its start and compiling too")
    parser.add_argument("--data", type=Path, default=DATA, help="where the recordings lie")
    parser.add_argument("--here", action="store_true", help="in this process, without a limit")
    chosen = parser.parse_args()
    print(LINE.format(*HEAD))
    print("|" + "---|" * len(HEAD))
    left_out = []
    for name in chosen.only:
        case = CASES[name]
        if reason := missing(case, chosen.data):
            left_out.append(f"- {name}: left out, {reason}")
            continue
        if not chosen.here:
            for method in chosen.methods:
                print(apart(name, method, chosen.data, chosen.limit), flush=True)
            continue
        module, path = importlib.import_module(case.model), None if case.path is None else chosen.data / case.path
        problem, truth = (make(path, **case.given) for make in (module.problem, module.truth))
        for method in chosen.methods:
            print(row(name, method, scored(METHODS[method], problem, truth, case)), flush=True)
    if left_out:
        print("\n" + "\n".join(left_out))


if __name__ == "__main__":
    main()
