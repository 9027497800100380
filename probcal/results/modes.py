"""The group `mode` of a tree: every answer of a fit, and the same of a file of version 3."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from probcal.labels import SCENE, coordinates
from probcal.lazy import xr
from probcal.results.schema import DIFFERENT, RESULTS_VERSION, evidence_in

REPORTED = "reported"  # kind of the answer that the rest of the tree describes
AGAIN = "again"  # kind of an answer from a further start that stands before it in the group
REJECTED = "rejected"  # kind of another answer from a further start, far below the reported one or invalid
PART = "part"  # kind of an answer that the reported mixture is of; `gain` is its log weight
ELSEWHERE = "found from another start"
LEAST = 0.01  # scales that count as an sd where that is smaller


class ModeRow(NamedTuple):
    """One answer of a fit."""

    name: str  # of what was reflected or exchanged
    kind: str  # that, or "scene", "piece", "node", "start", "part": by what it differs from the reported one
    bias: np.ndarray  # (M,) in its unit
    gain: float = np.nan  # evidence or log density less that of the reported one, nats
    status: str = ""  # of the fit from there; empty where it was found only
    start: int = -1  # number of the start that led to it
    objective: float = np.nan  # evidence or log density itself; NaN where no start led to it


def apart(bias: np.ndarray, other: np.ndarray, sd: np.ndarray) -> np.ndarray:
    """Distance (M,) of two answers by bias, in sd."""
    return np.abs(bias - other) / np.maximum(sd, 1e-12)


def same_as(bias: np.ndarray, others: Sequence[ModeRow], sd: np.ndarray) -> int | None:
    """The row of the answer that biases came back to."""
    near = (np.max(apart(bias, other.bias, sd), initial=0.0) <= DIFFERENT for other in others)
    return next((k for k, there in enumerate(near) if there), None)


def mode_group(
    modes: Sequence[ModeRow], sd: np.ndarray, coords: Mapping[str, Any], attrs: Mapping[str, Any]
) -> xr.Dataset:
    """The variables of some modes; `sd` (M,) are those of the reported one, the first.

    The attribute `same` has the nats within which an answer is as good, `objective` the name of
    that variable.
    """
    columns = {name: [getattr(own, name) for own in modes] for name in ModeRow._fields}
    names, bias = columns.pop("name"), np.stack(columns.pop("bias"))
    values: dict[str, Any] = {name: ("mode", np.array(own)) for name, own in columns.items()}
    values["bias"] = (("mode", "bias_label"), bias)
    values["apart"] = (("mode", "bias_label"), np.stack([apart(own, bias[0], sd) for own in bias]))
    return xr.Dataset(values, coords={"mode": names, **coords}, attrs=attrs)


def modes_in(tree: xr.DataTree) -> xr.Dataset:
    """The group `mode`; of a tree that is no fit the reported answer without biases."""
    if "mode" in tree.children:
        return tree["mode"].to_dataset()
    alone, none = ModeRow(REPORTED, REPORTED, np.zeros(0)), {"bias_label": np.zeros(0, str)}
    return mode_group([alone], np.zeros(0), none, {"same": 0.0, "objective": ""})


def rivals(tree: xr.DataTree) -> xr.Dataset:
    """The other answers that fit about as well as the reported one; `number` is their row."""
    group = modes_in(tree)
    group = group.assign(number=("mode", np.arange(group.sizes["mode"])))
    return group.isel(mode=~np.isin(group["kind"].values, (REPORTED, AGAIN, REJECTED, PART)))


def alike(tree: xr.DataTree) -> xr.Dataset:
    """The `rivals` that fit as well."""
    group = rivals(tree)
    return group.isel(mode=group["gain"].values > -group.attrs["same"])


def started(tree: xr.DataTree) -> xr.Dataset | None:
    """The answers of several starts; `far` is the largest change of a bias there, in scales."""
    group = modes_in(tree)
    from_start = group["start"].values >= 0
    if not from_start.any():
        return None
    scale = tree["calibration"].to_dataset()["scale"].values
    far = np.abs((group["bias"].values - group["bias"].values[0]) / scale).max(1, initial=0.0)
    return group.assign(far=("mode", far)).isel(mode=from_start)


def upgraded(tree: xr.DataTree) -> xr.DataTree:
    """A tree of version 3 in the form of today: the groups `mirror` and `optimum` become `mode`.

    The answers of its starts stand there as version 3 had them, the reported one once more.
    """
    if tree.attrs.get("results_version") != 3:
        return tree
    group = tree["calibration"].to_dataset()
    mean, sd = group["mean"].values, group["sd"].values
    modes = [ModeRow(REPORTED, REPORTED, mean, 0.0, str(tree.attrs["status"]))]
    attrs, tracks = {"same": 0.0, "objective": "objective"}, dict[str, Any]()
    if "mirror" in tree.children:
        old = tree["mirror"].to_dataset()
        attrs["same"] = old.attrs["same"]
        kinds = old["kind"].values if "kind" in old else [SCENE] * old.sizes["mirror"]
        rows = zip(old["mirror"].values, kinds, old["bias"].values, old["gain"].values, strict=True)
        modes += [ModeRow(str(name), str(kind), bias, float(gain)) for name, kind, bias, gain in rows]
        for target, node in tree["mirror/track"].children.items():
            tracks[f"track/{target}"] = _with_reported(node, tree.children["track"].children[target])
        del tree["mirror"]
    if "optimum" in tree.children:
        old = tree["optimum"].to_dataset()
        name = attrs["objective"] = evidence_in(old) or "objective"
        least = np.maximum(sd, LEAST * group["scale"].values)
        columns = [old[key].values for key in ("bias", "status", "start", name)]
        first = same_as(columns[0][0], modes, least)
        base = np.nan if first is None else modes[first].gain - columns[-1][0]
        for bias, status, start, score in zip(*columns, strict=True):
            kind = REJECTED if same_as(bias, modes, least) is None else AGAIN
            modes.append(ModeRow(ELSEWHERE, kind, bias, float(score + base), str(status), int(start), float(score)))
        del tree["optimum"]
    tracks = {name: own.pad({"mode": (0, len(modes) - own.sizes["mode"])}) for name, own in tracks.items()}
    coords = {"bias_label": group["bias_label"].values}
    tree["mode"] = xr.DataTree.from_dict({"/": mode_group(modes, sd, coords, attrs), **tracks})
    tree.attrs["results_version"] = RESULTS_VERSION
    return tree


def _with_reported(mirrored: xr.DataTree, track: xr.DataTree) -> xr.Dataset:
    """Places of a target in the answers of version 3, those of the reported one first."""
    own, mean = mirrored.to_dataset(inherit=False), track.to_dataset()["mean"]
    here = mean.sel(component=coordinates(mean["component"].values)).values
    places = ("mode", "time", "axis"), np.concatenate([here[None], own["position"].values])
    return xr.Dataset({"position": places}, {name: own[name] for name in ("time", "axis")}, own.attrs)
