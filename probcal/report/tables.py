"""Tables of a report: every bias, levels, fixed biases, optima, outliers, objects, checks; sentences beside them."""

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np
import xarray as xr

from probcal.report.words import bias_frame, fixed, number, rounded, said_once
from probcal.results.modes import started
from probcal.results.read import frame_of, outliers
from probcal.results.schema import EVIDENCES, held_biases
from probcal.status import INVALID

BIASES = 400  # of the table of all: the others are in summary.csv
EXTRA = {"r_hat": "r_hat", "ess_tail": "ess tail", "ess": "ess"}  # of samplers
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
    frame = bias_frame(tree)
    frame = frame.iloc[np.sort(np.argsort(-frame["far"].to_numpy(), kind="stable")[:BIASES])]

    def rounded_by_sd(name: str) -> list[str]:
        return [rounded(value, sd) for value, sd in zip(frame[name], frame["sd"], strict=True)]

    ends = zip(rounded_by_sd("lower"), rounded_by_sd("upper"), strict=True)
    texts = {"unit": frame["unit"], "status": frame["status"]}
    numbers = {
        "scale": [number(value) for value in frame["scale"]],
        "mean": rounded_by_sd("mean"),
        "sd": rounded_by_sd("sd"),
        "interval": [f"{lower} to {upper}" for lower, upper in ends],
        "gamma": [fixed(value, 3) for value in frame["gamma"]],
    }
    columns = ["bias", "unit", *numbers, "status"]
    if "verdict" in tree.children:
        texts |= {"verdict": frame["verdict"], "reason": said_once(frame.index, frame["reason"])}
        columns += ["verdict", "reason"]
    for name, title in EXTRA.items():
        if name in frame:
            numbers[title] = [number(value, 4) for value in frame[name]]
            columns.append(title)
    if frame["true"].notna().any():
        known = frame["true"].notna()
        numbers["true value"] = np.where(known, rounded_by_sd("true"), "").tolist()
        columns.append("true value")
    cells = [[(str(cell), name in texts) for cell in (texts | numbers)[name]] for name in columns[1:]]
    tints = dict.fromkeys(INVALID, "bad") | {"pruned": "pruned"}
    rows = zip(frame.index, frame["status"], zip(*cells, strict=True), strict=True)
    return columns, [{"label": label, "cells": own, "colour": tints.get(ended, "")} for label, ended, own in rows]


def weighted(tree: xr.DataTree) -> bool:
    """True if some data count less than others."""
    return "residual" in tree.children and bool((tree["residual"]["weight"] < 1).any())


def directions(tree: xr.DataTree) -> list[str]:
    """Sentences of the weak directions."""
    if "direction" not in tree.children:
        return []
    frame = frame_of(tree, "direction", "sentence", "information")
    return frame.sort_values("information", kind="stable")["sentence"].tolist()


def tables(tree: xr.DataTree) -> list[dict[str, Any]]:
    """All tables behind that of the biases: title, columns, rows of texts."""
    return [table for maker in (_of_fit, _of_scans, _of_data) for table in maker(tree)]


def _table(title: str, columns: Mapping[str, Iterable[str]], most: int = CHECKED) -> dict[str, Any]:
    """A table of columns of texts; of many rows the first."""
    rows = list(zip(*columns.values(), strict=True))
    more = f", the first {most}" if len(rows) > most else ""
    return {"title": title + more, "columns": list(columns), "rows": rows[:most]}


def _of_fit(tree: xr.DataTree) -> Iterator[dict[str, Any]]:
    """Tables of the noise levels and of the biases that were fixed."""
    if "level" in tree.children:
        frame = frame_of(tree, "level", "std", "guess")
        columns = {"level": frame.index} | {name: map(number, frame[name]) for name in frame}
        yield _table("Unknown noise levels", columns)
    if fixed_ := held_biases(tree):
        values = [number(value, 6) for value in fixed_.values()]
        yield _table("Fixed biases", {"bias": fixed_, "value": values}, most=len(values))


def _of_scans(tree: xr.DataTree) -> Iterator[dict[str, Any]]:
    """Tables of the objects that nobody named and of what each sensor detected, of objects and falsely."""
    if {"object", "association"} <= set(tree.children):
        held = frame_of(tree, "association").groupby("track")["weight"].sum()
        found = frame_of(tree, "object").groupby("track", sort=False)
        spans = found.agg(first=("time", "min"), last=("time", "max"), existence=("existence", "max"))
        columns = {
            "object": spans.index.astype(str),
            "first time, s": [number(value, 6) for value in spans["first"]],
            "last time, s": [number(value, 6) for value in spans["last"]],
            "largest existence": [fixed(value, 2) for value in spans["existence"]],
            "detections": [f"{held.get(name, 0.0):.1f}" for name in spans.index],
        }
        yield _table(f"Objects: {len(spans)} in the detections", columns)
    if {"detection", "constant_data"} <= set(tree.children):
        stated = frame_of(tree, "constant_data", "detection_probability", "clutter")
        frame = frame_of(tree, "detection").join(stated)
        frame = frame[frame["scans"] > 0]
        false = (frame["detections"] - frame["of_objects"]) / frame["scans"]
        columns = {
            "sensor": frame.index.astype(str),
            "scans": frame["scans"].astype(int).astype(str),
            "detections": frame["detections"].astype(int).astype(str),
            "share of objects": [fixed(value, 2) for value in frame["of_objects"] / frame["detections"]],
            "false a scan": map(number, false),
            "declared clutter": map(number, frame["clutter"]),
            "looks": [f"{value:.0f}" for value in frame["looks"]],
            "share of looks detected": [fixed(value, 2) for value in frame["of_objects"] / frame["looks"]],
            "declared probability": map(number, frame["detection_probability"]),
        }
        yield _table("Detections by sensor", columns)


def _of_data(tree: xr.DataTree) -> Iterator[dict[str, Any]]:
    """Tables of the optima of several starts, of the data that count least, and of the checks of an assessment."""
    if (optima := started(tree)) is not None:
        score = optima.attrs["objective"]
        columns: dict[str, Any] = {
            "start": optima["start"].values.astype(str),
            "status": optima["status"].values,
            EVIDENCES.get(score, score): [number(value, 7) for value in optima["objective"].values],
            "largest difference, in scales": [number(value) for value in optima["far"].values],
        }
        yield _table("Optima of several starts", columns, most=optima.sizes["mode"])
    if weighted(tree) and len(listed := outliers(tree)):
        numbers = {name: [number(value, 6) for value in listed[name]] for name in ("time", "residual/std", "weight")}
        texts: dict[str, Any] = {name: listed[name].astype(str) for name in ("row", "sensor", "target", "channel")}
        title = f"Outlying data: {len(listed)} of {tree['residual'].sizes['datum']} count less than half"
        yield _table(title, texts | numbers, most=LISTED)
    for name, (title, keys, wanted) in CHECKS.items():
        if name in tree.children:
            group = tree[name].to_dataset()
            subjects = zip(*(group[key].values.astype(str) for key in keys), strict=True)
            limits = zip(group["lower"].values, group["upper"].values, strict=True)
            numbers = {
                text: [number(value, 4) for value in group[own].values] for own, text in wanted.items() if own in group
            }
            columns = {keys[-1]: [".".join(subject) for subject in subjects]} | numbers
            columns["limits"] = [f"{number(lower)} to {number(upper)}" for lower, upper in limits]
            yield _table(title, columns)
