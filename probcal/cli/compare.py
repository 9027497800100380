"""`compare`: fits of the same data side by side."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import xarray as xr

from probcal import plots
from probcal.analysis import compare
from probcal.analysis.compare import chosen_pair, fits_by_name
from probcal.cli.files import say_findings, write_result
from probcal.diagnostics import comparison_rows
from probcal.files import Outputs
from probcal.results.io import load
from probcal.results.read import known_truth, listed_in
from probcal.results.schema import EVIDENCES
from probcal.status import INVALID


def run(
    folders: Sequence[Path],
    names: Sequence[str] | None,
    pairs: Sequence[tuple[str, str]],
    outputs: Outputs | None,
) -> int:
    """Put fits of the same data side by side: estimates, distances, gamma, coverage, prediction, evidence, cost."""
    fits = fits_by_name([load(path) for path in folders], names)
    drawn = [chosen_pair(fits, pair) for pair in pairs]
    comparison = compare(fits)
    print(estimates_text(comparison))
    print(methods_text(comparison))
    say_findings(comparison)
    if outputs is not None:
        rows = comparison_rows(comparison)
        write_result(outputs, comparison, rows, lambda path: plots.draw_compare(comparison, fits, path, drawn))
    return 1 if any(tree.attrs["status"] in INVALID for tree in fits.values()) else 0


def estimates_text(comparison: xr.DataTree) -> str:
    """One row a bias: unit, true value, then of each method mean and sd, gamma, and the distance to the first."""
    estimate, pair = comparison["estimate"].to_dataset(), comparison["pair"].to_dataset()
    labels, names = estimate["bias_label"].values.tolist(), estimate["estimator"].values.tolist()
    first = names[0]
    columns = [("bias", labels), ("unit", estimate["unit"].values.tolist())]
    if len(true := known_truth(comparison)):
        columns.append(("true", [f"{true[label] + 0.0:.4g}" if label in true else "" for label in labels]))
    for name in names:
        one = estimate.sel(estimator=name)
        moments = zip(one["mean"].values, one["sd"].values, strict=True)
        columns.append((name, [f"{mean:.3g} \N{PLUS-MINUS SIGN} {sd:.2g}" for mean, sd in moments]))
        columns.append(("gamma", [f"{value:.3f}" for value in one["gamma"].values]))
        of_pair = (pair["first"] == first) & (pair["second"] == name)
        for distance in pair["wasserstein"].values[of_pair.values]:
            columns.append(("distance", [f"{value:.3f}" for value in distance]))
    titles, cells = zip(*columns, strict=True)
    frame = pd.DataFrame(dict(enumerate(cells))).set_axis(titles, axis=1)
    note = f"distance: Wasserstein distance to {first}, in scales"
    return f"{frame.to_string(index=False, justify='right')}\n{note}"


# columns of the table of methods: title -> attribute of a method, its form, and that of its standard error if any
MEASURES = {
    "elpd": ("elpd", ".1f", "elpd_se"),
    "difference": ("elpd_difference", ".2f", "elpd_difference_se"),
    "bad k": ("bad_k", ".1%", ""),
    **{title: (name, ".1f", f"{name}_se") for name, title in EVIDENCES.items()},
    "r_hat": ("largest_r_hat", ".3f", ""),
    "ess": ("smallest_ess", ".0f", ""),
    "ess/s": ("ess_per_second", ".3g", ""),
    "seconds": ("seconds", ".3g", ""),
}


def methods_text(comparison: xr.DataTree) -> str:
    """One row a method: status, scores, prediction, evidence and cost, a cell empty where it does not apply."""
    rows = []
    for name in listed_in(comparison, "estimate", "estimator"):
        at = comparison[f"method/{name}"].attrs
        row = {"method": name, "status": at["status"], "bias_rmse": _measure(at, "bias_rmse", ".3f")}
        for title, suffix in (("coverage", ""), ("non-zero", "_nonzero")):
            known = f"known{suffix}"
            row[title] = f"{at[f'covered{suffix}']}/{at[known]}" if known in at else ""
        rows.append(row | {title: _measure(at, *measure) for title, measure in MEASURES.items()})
    frame = pd.DataFrame(rows)
    return frame.loc[:, (frame != "").any()].to_string(index=False, justify="right")


def _measure(at: Mapping[Any, Any], name: str, form: str, error: str = "") -> str:
    """A number of a method with its standard error, empty where it has none."""
    tail = f" \N{PLUS-MINUS SIGN} {at[error]:{form}}" if error in at else ""
    return f"{at[name]:{form}}{tail}" if name in at else ""
