"""`compare`: fits of the same data side by side."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from probcal.analysis import compare
from probcal.analysis.compare import chosen_pair, fits_by_name
from probcal.cli.files import can_plot, say_written, write_csv
from probcal.diagnostics import comparison_rows
from probcal.files import Outputs
from probcal.results.io import load, save
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
    for sentence in comparison["finding"].to_dataset()["sentence"].values:
        print(f"- {sentence}")
    if outputs is not None:
        with outputs.writing():
            _write(comparison, fits, drawn, outputs.folder)
    return 1 if any(tree.attrs["status"] in INVALID for tree in fits.values()) else 0


def estimates_text(comparison: xr.DataTree) -> str:
    """One row a bias: unit, true value, then of each method mean and sd, gamma, and the distance to the first."""
    estimate, pair = comparison["estimate"].to_dataset(), comparison["pair"].to_dataset()
    labels, (first, *_) = estimate["bias_label"].values.tolist(), estimate["estimator"].values.tolist()
    columns: list[tuple[str, list[str]]] = [("bias", labels), ("unit", estimate["unit"].values.tolist())]
    if "truth" in comparison.children:
        true = comparison["truth"].to_dataset()["bias"].to_series().to_dict()
        columns.append(("true", [f"{true[label] + 0.0:.4g}" if label in true else "" for label in labels]))
    for name in estimate["estimator"].values.tolist():
        mine = estimate.sel(estimator=name)
        moments = zip(mine["mean"].values, mine["sd"].values, strict=True)
        columns.append((name, [f"{mean:.3g} \N{PLUS-MINUS SIGN} {sd:.2g}" for mean, sd in moments]))
        columns.append(("gamma", [f"{value:.3f}" for value in mine["gamma"].values]))
        beside = (pair["first"] == first) & (pair["second"] == name)
        for distance in pair["wasserstein"].values[beside.values]:
            columns.append(("distance", [f"{value:.3f}" for value in distance]))
    frame = pd.DataFrame(np.array([values for _, values in columns], dtype=object).T, columns=[n for n, _ in columns])
    note = f"distance: Wasserstein distance to {first}, in scales"
    return f"{frame.to_string(index=False, justify='right')}\n{note}"


def methods_text(comparison: xr.DataTree) -> str:
    """One row a method: status, scores, prediction, evidence and cost, a cell empty where it does not apply."""

    def number(value: str, form: str, error: str = "") -> Callable[[dict[str, Any]], str]:
        def shown(at: dict[str, Any]) -> str:
            tail = f" \N{PLUS-MINUS SIGN} {at[error]:{form}}" if error in at else ""
            return f"{at[value]:{form}}{tail}" if value in at else ""

        return shown

    def covered(suffix: str) -> Callable[[dict[str, Any]], str]:
        return lambda at: f"{at[f'covered{suffix}']}/{at[f'known{suffix}']}" if f"known{suffix}" in at else ""

    columns: dict[str, Callable[[dict[str, Any]], str]] = {
        "status": lambda at: at["status"], "bias_rmse": number("bias_rmse", ".3f"), "coverage": covered(""),
        "non-zero": covered("_nonzero"), "elpd": number("elpd", ".1f", "elpd_se"),
        "difference": number("elpd_difference", ".2f", "elpd_difference_se"), "bad k": number("bad_k", ".1%"),
        **{title: number(name, ".1f", f"{name}_se") for name, title in EVIDENCES.items()},
        "r_hat": number("largest_r_hat", ".3f"),
        "ess": number("smallest_ess", ".0f"), "ess/s": number("ess_per_second", ".3g"),
        "seconds": number("seconds", ".3g"),
    }  # fmt: skip
    names = comparison["estimate"].to_dataset()["estimator"].values.tolist()
    attrs = [{str(k): value for k, value in comparison[f"method/{name}"].attrs.items()} for name in names]
    frame = pd.DataFrame({"method": names} | {title: [cell(at) for at in attrs] for title, cell in columns.items()})
    frame = frame.loc[:, (frame != "").any()]
    return frame.to_string(index=False, justify="right")


def _write(comparison: xr.DataTree, fits: dict[str, xr.DataTree], pairs: list[tuple[str, str]], out: Path) -> None:
    files = [out / "compare.nc", out / "compare.csv"]
    save(comparison, files[0])
    write_csv(comparison_rows(comparison), files[1])
    if can_plot():
        from probcal.plots import draw_compare  # the plot packages are an extra

        files.append(out / "compare.png")
        draw_compare(comparison, fits, files[-1], pairs)
    say_written(files)
