"""EA against full Bayes on every recording: does MCMC arrive, and how far is EA from it?

    uv run python benchmarks/full_bayes.py --out bayes
    uv run python benchmarks/full_bayes.py --out bayes --case plaza robots --limit 600

Each case is fitted by EA as printed (ARD), and by EA and full Bayes with one prior: that of the model where both take
it, else a horseshoe. Fits are kept in OUT/CASE, so that the same command goes on where it was stopped. It prints two
Markdown tables. The first says how long full Bayes took and how well it mixed. The second says how far each EA is from
it: means in posterior sds, sds as ratios, gammas (each the median, then the worst bias), and the share of the true
biases that 89 % intervals hold, of this EA and of full Bayes. OUT/agreement.png shows every bias. Recordings that are
not there are left out.
"""

import argparse
import importlib
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

import probcal as pc
from probcal.inference.methods import METHODS
from probcal.priors import ARD

sys.path.insert(0, str(Path(__file__).parents[1] / "models"))

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
EAS = {"as printed": pc.EA.as_printed(), "integrated": pc.EA()}
COLOURS = {"as printed": "#d95f02", "integrated": "#1b6ca8"}
Made = tuple[pc.Problem, Any, Any]  # problem, truth or None, prior or None
ARRIVAL = ("case", "biases, rows", "sampler", "status", "least ess", "of", "largest r_hat", "divergences", "s", "cpu s")
AGREEMENT = ("case", "EA", "mean off by, sd", "sd over that of full Bayes", "gamma off by", "89 % hold")


def module(name: str, recording: str = "", **given: Any) -> Callable[[], Made]:
    """A model by its file, with its own data or a recording beside the project."""

    def make() -> Made:
        model = importlib.import_module(name)
        arguments = [DATA / recording] if recording else []
        if recording and not arguments[0].exists():
            raise FileNotFoundError(f"the recording {recording} is not here")
        truth = getattr(model, "truth", lambda *_, **__: None)(*arguments, **given)
        return model.problem(*arguments, **given), truth, getattr(model, "PRIOR", None)

    return make


def simulated(model: str, **given: Any) -> Callable[[], Made]:
    """Run 0 of a setting: its problem and truth."""
    return lambda: (*importlib.import_module(model).setting(run=0, **given), None)


CASES = {
    "plaza": module("plaza"),
    "plaza-free": module("plaza_free"),
    "robots": module("robots", "mrclam/MRCLAM_Dataset6"),
    "beacons": module("bearing_beacons", "roh_bearing"),
    "office": module("ble_office", "ble_rss"),
    "sflab": module("sflab", "sflab_mic_toa/dataset_1_exp2.mat"),
    "flight": module("tdoa_flight", "uwb_tdoa"),
    "receivers": module("receivers", "mlat_locards/set_1.csv"),
    "C1": simulated("radars", scenario="C1", share=0.3),
    "C2": simulated("radars", scenario="C2", share=0.3),
    "thesis": module("thesis"),
    "microphones": module("microphones"),
}
CASES |= {f"networks-{kind}": simulated("networks", network=kind) for kind in importlib.import_module("networks").NAMES}
RECORDED = list(CASES)[:8]


def fits(name: str, method: Any, out: Path, limit: float | None) -> dict[str, xr.DataTree]:
    """The fits of a case by EA as printed, EA and full Bayes; those that are kept are loaded."""
    problem, truth, prior = CASES[name]()
    found = dict[str, xr.DataTree]()
    for label, own in (EAS | {"full Bayes": method}).items():
        file = out / name / f"{label.replace(' ', '-')}.nc"
        if not file.exists():
            both = prior is not None and prior.dense and method.takes(prior) and pc.EA().takes(prior)
            given = ARD() if label == "as printed" else prior if both else pc.Horseshoe()
            limited = limit if label == "full Bayes" else None
            began, spent = time.perf_counter(), time.process_time()
            tree = pc.fit(problem, own, prior=given, key=0, limit=limited)
            tree.attrs |= {"wall": time.perf_counter() - began, "processor": time.process_time() - spent}
            file.parent.mkdir(parents=True, exist_ok=True)
            pc.save(tree if truth is None else pc.add_scores(tree, truth), file)
        found[label] = pc.load(file)
    return found


def arrival(name: str, tree: xr.DataTree) -> str:
    """The line of a case: how long full Bayes took, and how well it mixed."""
    group, stats = tree["calibration"].to_dataset(), tree["sample_stats"].to_dataset()
    worst = group["bias_label"].values[int(group["ess"].values.argmin())]
    least = float(group["ess"].min())
    size = f"{group.sizes['bias_label']}, {tree['observed_data'].sizes['datum']}"
    diverged = int(stats["diverging"].sum()) if "diverging" in stats else 0
    cells = (tree.attrs["method"], tree.attrs["status"], f"{least:.0f}", worst, f"{float(group['r_hat'].max()):.3f}")
    spent = f"{diverged} | {tree.attrs['wall']:.0f} | {tree.attrs['processor']:.0f}"
    return f"| {name} | {size} | {' | '.join(cells)} | {spent} |"


def apart(ea: xr.DataTree, full: xr.DataTree) -> xr.Dataset:
    """The differences of an EA from full Bayes per bias: `mean` in sds of the latter, `sd` as a ratio, `gamma`."""
    a, b = (tree["calibration"].to_dataset()[["mean", "sd", "gamma"]] for tree in (ea, full))
    return xr.Dataset(
        {"mean": (a["mean"] - b["mean"]) / b["sd"], "sd": a["sd"] / b["sd"], "gamma": a["gamma"] - b["gamma"]}
    )


def agreement(name: str, label: str, ea: xr.DataTree, full: xr.DataTree) -> str:
    """The line of an EA of a case: medians, and the bias that is worst."""
    off = apart(ea, full)
    size = {
        "mean": np.abs(off["mean"]),
        "sd": np.abs(np.log(np.maximum(off["sd"], 1e-9))),
        "gamma": np.abs(off["gamma"]),
    }
    cells = []
    for quantity, own in size.items():
        worst = own["bias_label"].values[int(own.values.argmax())]
        middle = own.median() if quantity != "sd" else off["sd"].median()
        cells.append(f"{float(middle):.2f}, {float(off[quantity].sel(bias_label=worst)):.2f} {worst}")
    held = ", ".join(f"{tree.attrs['coverage']:.2f}" for tree in (ea, full) if "coverage" in tree.attrs) or "–"
    return f"| {name} | {label} | {' | '.join(cells)} | {held} |"


def picture(found: dict[str, dict[str, xr.DataTree]]) -> Figure:
    """Every bias of every case: how far the means of both EAs are from full Bayes, and their sds."""
    figure = Figure(figsize=(10, 0.45 * len(found) + 1.6), layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    for place, trees in enumerate(found.values()):
        for label, shift in (("as printed", 0.17), ("integrated", -0.17)):
            off = apart(trees[label], trees["full Bayes"])
            given = {
                "color": COLOURS[label],
                "alpha": 0.6,
                "s": 22,
                "linewidths": 0,
                "label": label if not place else None,
            }
            at = np.full(off.sizes["bias_label"], place - shift)
            axes[0].scatter(np.clip(off["mean"], -4, 4), at, **given)
            axes[1].scatter(np.clip(off["sd"], 0.05, 4), at, **given)
    axes[0].set(xlabel="mean, from that of full Bayes, in its sds", xlim=(-4.2, 4.2))
    axes[0].axvspan(-0.5, 0.5, color="0.92", zorder=0)
    axes[1].set(xlabel="sd over that of full Bayes", xscale="log", xlim=(0.045, 4.5))
    axes[1].set_xticks([0.05, 0.1, 0.25, 0.5, 1, 2, 4], ["≤ 0.05", "0.1", "0.25", "0.5", "1", "2", "4"])
    axes[1].axvspan(0.8, 1.25, color="0.92", zorder=0)
    mixed = {name: trees["full Bayes"].attrs["status"] == "converged" for name, trees in found.items()}
    axes[0].set_yticks(range(len(found)), [name if mixed[name] else f"{name} (not mixed)" for name in found])
    axes[0].invert_yaxis()
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=2, frameon=False)
    return figure


def main() -> None:
    """Fit what is not kept, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder that keeps the fits")
    parser.add_argument("--case", nargs="+", choices=CASES, default=RECORDED, metavar="NAME", help=", ".join(CASES))
    samplers = [name for name, (own, _) in METHODS.items() if not own.climbs]
    parser.add_argument("--method", default="mcmc", choices=samplers, help="of full Bayes")
    parser.add_argument("--limit", type=float, default=300, help="seconds of full Bayes")
    given = parser.parse_args()
    found, lines = dict[str, dict[str, xr.DataTree]](), []
    print(f"| {' | '.join(ARRIVAL)} |\n|{'---|' * len(ARRIVAL)}", flush=True)
    for name in given.case:
        try:
            found[name] = fits(name, METHODS[given.method][0], given.out, given.limit)
        except (FileNotFoundError, pc.InputError, pc.FitError) as error:
            print(f"| {name} | {error} |{' |' * (len(ARRIVAL) - 2)}", flush=True)
            continue
        print(arrival(name, found[name]["full Bayes"]), flush=True)
        lines += [agreement(name, label, found[name][label], found[name]["full Bayes"]) for label in EAS]
    print(f"\n| {' | '.join(AGREEMENT)} |\n|{'---|' * len(AGREEMENT)}", *lines, sep="\n")
    if found:
        picture(found).savefig(given.out / "agreement.png", dpi=110)


if __name__ == "__main__":
    main()
