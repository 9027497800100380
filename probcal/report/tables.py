"""Tables of a report: every bias, levels, fixed biases, optima, outliers, objects, checks; sentences beside them."""

from typing import Any

import numpy as np
import xarray as xr

from probcal.report.words import NONE, number, rounded, said_once, true_values
from probcal.results.read import outliers
from probcal.results.schema import EVIDENCES, evidence_in
from probcal.status import INVALID

BIASES = 400  # of the table of all: the others are in summary.csv
EXTRA = {"r_hat": "r_hat", "ess_bulk": "ess bulk", "ess_tail": "ess tail", "ess": "ess"}  # of samplers
LISTED = 20  # outlying data in the table
CHECKED = 60  # rows of a table of checks, objects or sensors
# group of an assessment -> title, what a row is, and its columns with what they are called
CHECKS: dict[str, tuple[str, tuple[str, ...], dict[str, str]]] = {
    "sensor_check": (
        "Sensors: innovations, and what the other sensors say of each",
        ("sensor",),
        {"data": "data", "nis": "NIS", "elpd": "elpd left out", "difference": "gain by calibration, nats",
         "rest_nis": "NIS given the rest", "pareto_k": "Pareto k"},
    ),
    "target_check": (
        "Targets: innovations, and what the other targets say of each",
        ("target",),
        {"data": "data", "nis": "NIS", "elpd": "elpd left out", "rest_nis": "NIS given the rest",
         "pareto_k": "Pareto k"},
    ),
    "channel_check": (
        "Channels: whiteness and predictive checks",
        ("sensor", "channel"),
        {"data": "data", "nis": "NIS", "mean": "mean", "autocorrelation": "lag-1 correlation",
         "white": "Ljung-Box p", "p_misfit": "predictive p, misfit", "p_mean": "predictive p, mean"},
    ),
}  # fmt: skip


def biases(tree: xr.DataTree) -> tuple[list[str], list[dict[str, Any]]]:
    """Column names and one row a bias, cells with a mark for text."""
    group = tree["calibration"].to_dataset()
    with np.errstate(invalid="ignore", divide="ignore"):
        far = np.nan_to_num(np.abs(group["mean"].values / group["sd"].values), nan=np.inf)
    shown = np.sort(np.argsort(-far, kind="stable")[:BIASES])
    extra = [name for name in EXTRA if name in group]
    known = true_values(tree)
    columns = ["bias", "unit", "scale", "mean", "sd", "interval", "gamma", "status"]
    judged = tree["verdict"].to_dataset() if "verdict" in tree.children else None
    columns += ["verdict", "reason"] if judged is not None else []
    columns += [EXTRA[name] for name in extra] + (["true value"] if known else [])
    table = {str(name): group[name].values for name in (*group.data_vars, "unit") if group[name].ndim == 1}
    rows = []
    labels = group["bias_label"].values.tolist()
    reasons = judged["reason"].values.tolist() if judged is not None else [""] * len(labels)
    said = dict(
        zip(
            shown.tolist(),
            said_once([labels[k] for k in shown], [reasons[k] for k in shown]),
            strict=True,
        )
    )
    for k in shown.tolist():
        label = labels[k]
        one = {name: values[k] for name, values in table.items()}
        sd, status = float(one["sd"]), str(one["status"])
        mean, lower, upper, spread = (rounded(float(one[n]), sd) for n in ("mean", "lower", "upper", "sd"))
        cells = [(str(one["unit"]), True), (number(one["scale"]), False), (mean, False)]
        cells += [(spread, False), (f"{lower} to {upper}", False), (_gamma(float(one["gamma"])), False)]
        cells += [(status, True)]
        if judged is not None:
            cells += [(str(judged["verdict"].values[k]), True), (said[k], True)]
        cells += [(number(one[name], 4), False) for name in extra]
        if known:
            cells.append((rounded(known[label], sd) if label in known else "", False))
        colour = "bad" if status in INVALID else "pruned" if status == "pruned" else ""
        rows.append({"label": label, "cells": cells, "colour": colour})
    return columns, rows


def _gamma(value: float) -> str:
    return f"{value:.3f}" if np.isfinite(value) else NONE


def _levels(tree: xr.DataTree) -> dict[str, Any] | None:
    """Table of the estimated noise levels."""
    if "level" not in tree.children:
        return None
    group = tree["level"].to_dataset()
    names = group["level"].values.tolist()
    pairs = zip(names, group["std"].values, group["guess"].values, strict=True)
    rows = [[name, number(std), number(guess)] for name, std, guess in pairs]
    return {"title": "Unknown noise levels", "columns": ["level", "std", "guess"], "rows": rows}


def _fixed(tree: xr.DataTree) -> dict[str, Any] | None:
    """Table of the biases that were fixed."""
    group = tree["constant_data"].to_dataset() if "constant_data" in tree.children else xr.Dataset()
    if "fixed" not in group:
        return None
    pairs = zip(group["fixed_label"].values.tolist(), group["fixed"].values, strict=True)
    return {
        "title": "Fixed biases",
        "columns": ["bias", "value"],
        "rows": [[k, number(v, 6)] for k, v in pairs],
    }


def _optima(tree: xr.DataTree) -> dict[str, Any] | None:
    """Table of the optima that several starts led to, the reported one first."""
    if "optimum" not in tree.children:
        return None
    group = tree["optimum"].to_dataset()
    scale = tree["calibration"].to_dataset()["scale"].values
    apart = np.abs((group["bias"].values - group["bias"].values[0]) / scale).max(1)
    score = evidence_in(group) or "objective"
    rows = [
        [str(start), str(status), number(value, 7), number(far)]
        for start, status, value, far in zip(
            group["start"].values, group["status"].values, group[score].values, apart, strict=True
        )
    ]
    columns = ["start", "status", EVIDENCES.get(score, score), "largest difference, in scales"]
    return {"title": "Optima of several starts", "columns": columns, "rows": rows}


def weighted(tree: xr.DataTree) -> bool:
    """Whether some data count less than others."""
    group = tree["residual"].to_dataset() if "residual" in tree.children else xr.Dataset()
    return "weight" in group and bool((group["weight"] < 1).any())


def _outliers(tree: xr.DataTree) -> dict[str, Any] | None:
    """Table of the data that count least, where the noise has heavy tails."""
    if not weighted(tree) or not len(listed := outliers(tree)):
        return None
    names = ["row", "sensor", "target", "channel"]
    rows = [
        [*texts, *(number(value, 6) for value in numbers)]
        for texts, numbers in zip(
            listed[names].head(LISTED).astype(str).to_numpy().tolist(),
            listed[["time", "residual/std", "weight"]].head(LISTED).to_numpy(float),
            strict=True,
        )
    ]
    count, total = len(listed), tree["residual"].sizes["datum"]
    title = f"Outlying data: {count} of {total} count less than half" + (
        f", the first {LISTED}" if count > LISTED else ""
    )
    columns = [*names, "time", "residual/std", "weight"]
    return {"title": title, "columns": columns, "rows": rows}


def _checked(tree: xr.DataTree, name: str) -> dict[str, Any] | None:
    """Table of one group of checks, the columns that it holds, limits as an interval."""
    title, keys, wanted = CHECKS[name]
    if name not in tree.children:
        return None
    group = tree[name].to_dataset()
    columns: dict[str, Any] = {text: group[column].values for column, text in wanted.items() if column in group}
    columns["limits"] = list(zip(group["lower"].values, group["upper"].values, strict=True))
    dim = group["nis"].dims[0]
    rows = [
        [".".join(str(group[key].values[k]) for key in keys)]
        + [
            f"{number(v[k][0])} to {number(v[k][1])}" if text == "limits" else number(v[k], 4)
            for text, v in columns.items()
        ]
        for k in range(min(group.sizes[dim], CHECKED))
    ]
    left = group.sizes[dim] - len(rows)
    return {"title": title + (f", the first {CHECKED}" if left else ""), "columns": [keys[-1], *columns], "rows": rows}


def _objects(tree: xr.DataTree) -> dict[str, Any] | None:
    """Table of the objects that nobody named: when each was there, how surely, and how often it was detected."""
    if not {"object", "association"} <= set(tree.children):
        return None
    held = tree["association"].to_dataset().to_dataframe().groupby("track")["weight"].sum()
    found = tree["object"].to_dataset().to_dataframe().groupby("track", sort=False)
    spans = found.agg(first=("time", "min"), last=("time", "max"), existence=("existence", "max"))
    rows = [
        [str(name), number(first, 6), number(last, 6), f"{existence:.2f}", f"{held.get(name, 0.0):.1f}"]
        for name, first, last, existence in spans.head(CHECKED).itertuples()
    ]
    title = f"Objects: {len(spans)} in the detections" + (f", the first {CHECKED}" if len(spans) > CHECKED else "")
    columns = ["object", "first time, s", "last time, s", "largest existence", "detections"]
    return {"title": title, "columns": columns, "rows": rows}


def _share(value: float) -> str:
    return f"{value:.2f}" if np.isfinite(value) else NONE


def _detections(tree: xr.DataTree) -> dict[str, Any] | None:
    """Table of what each sensor detected, of objects and falsely, beside what it is declared to."""
    if not {"detection", "constant_data"} <= set(tree.children):
        return None
    stated = tree["constant_data"].to_dataset()
    group = tree["detection"].to_dataset().assign(stated[["detection_probability", "clutter"]])
    frame = group.to_dataframe()
    frame = frame[frame["scans"] > 0]
    rows = []
    for name, own in frame.head(CHECKED).iterrows():
        with np.errstate(invalid="ignore", divide="ignore"):
            share = np.divide(own["of_objects"], own["detections"])
            false = np.divide(own["detections"] - own["of_objects"], own["scans"])
            seen = np.divide(own["of_objects"], own["looks"])
        clutter, probability = (number(own[column]) for column in ("clutter", "detection_probability"))
        rows.append(
            [str(name), str(int(own["scans"])), str(int(own["detections"])), _share(share), number(false), clutter,
             f"{own['looks']:.0f}", _share(seen), probability]
        )  # fmt: skip
    title = "Detections by sensor" + (f", the first {CHECKED}" if len(frame) > CHECKED else "")
    columns = [
        "sensor", "scans", "detections", "share of objects", "false a scan", "declared clutter", "looks",
        "share of looks detected", "declared probability",
    ]  # fmt: skip
    return {"title": title, "columns": columns, "rows": rows}


def noted(tree: xr.DataTree) -> list[str]:
    """Sentences of an assessment."""
    return tree["finding"].to_dataset()["sentence"].values.tolist() if "finding" in tree.children else []


def directions(tree: xr.DataTree) -> list[str]:
    """Sentences of the weak directions."""
    if "direction" not in tree.children:
        return []
    group = tree["direction"].to_dataset()
    order = np.argsort(group["information"].values, kind="stable")
    return [str(sentence) for sentence in group["sentence"].values[order]]


def tables(tree: xr.DataTree) -> list[dict[str, Any]]:
    """All tables behind that of the biases: title, columns, rows of texts."""
    found = (
        _levels(tree), _fixed(tree), _objects(tree), _detections(tree), _optima(tree), _outliers(tree),
        *(_checked(tree, name) for name in CHECKS),
    )  # fmt: skip
    return [table for table in found if table]
