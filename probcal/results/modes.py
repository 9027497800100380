"""The group `mode` of a tree: every answer of a fit, the reported one first, and the same of a file of version 3."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from probcal.labels import AXES, SCENE, coordinates
from probcal.lazy import Later
from probcal.results.schema import DIFFERENT, RESULTS_VERSION, evidence_in

if TYPE_CHECKING:
    import xarray as xr
else:
    xr = Later("xarray")

REPORTED = "reported"  # kind of the answer that the rest of the tree describes
AGAIN = "again"  # kind of an answer from a further start that stands before it in the group
REJECTED = "rejected"  # kind of another answer from a further start, far below the reported one or invalid
ELSEWHERE = "found from another start"
LEAST = 0.01  # scales that count as an sd where that is smaller
ROUNDED = 1e-6  # sd within which version 3 wrote one answer twice


class Mode(NamedTuple):
    """One answer of a fit."""

    name: str  # of what was reflected or exchanged
    kind: str  # that, or "scene", "piece", "node", "start": by what it differs from the reported one
    bias: np.ndarray  # (M,) in its unit
    gain: float = np.nan  # evidence or log density less that of the reported one, nats
    status: str = ""  # of the fit from there; empty where it was found only
    start: int = -1  # number of the start that led to it
    objective: float = np.nan  # evidence or log density itself, where a start led to it


def apart(bias: np.ndarray, other: np.ndarray, sd: np.ndarray) -> np.ndarray:
    """Distance (M,) of two answers by bias, in sd."""
    return np.abs(bias - other) / np.maximum(sd, 1e-12)


def unlike(bias: np.ndarray, others: Sequence[Mode], sd: np.ndarray) -> str:
    """The kind of a further answer that no reader shall count: one that stands among others, or a worse one."""
    near = (np.max(apart(bias, other.bias, sd), initial=0.0) <= DIFFERENT for other in others)
    return AGAIN if any(near) else REJECTED


def mode_group(modes: Sequence[Mode], sd: np.ndarray, coords: Mapping[str, Any], attrs: Mapping[str, Any]) -> Any:
    """The variables of some modes; `sd` (M,) are those of the reported one, the first.

    The attribute `same` has the nats within which an answer is as good, `objective` the name of that variable.
    """
    columns = {name: [getattr(own, name) for own in modes] for name in Mode._fields}
    names, bias = columns.pop("name"), np.stack(columns.pop("bias"))
    values: dict[str, Any] = {name: ("mode", np.array(own)) for name, own in columns.items()}
    values["bias"] = (("mode", "bias_label"), bias)
    values["apart"] = (("mode", "bias_label"), np.stack([apart(own, bias[0], sd) for own in bias]))
    return xr.Dataset(values, coords={"mode": names, **coords}, attrs=attrs)


def rivals(tree: xr.DataTree) -> xr.Dataset:
    """The other answers of a fit that fit about as well as the reported one, the best first; `number` is their row."""
    group = tree["mode"].to_dataset()
    group = group.assign(number=("mode", np.arange(group.sizes["mode"])))
    return group.isel(mode=~np.isin(group["kind"].values, (REPORTED, AGAIN, REJECTED)))


def alike(tree: xr.DataTree) -> xr.Dataset:
    """The `rivals` that fit as well."""
    group = rivals(tree)
    return group.isel(mode=group["gain"].values > -group.attrs["same"])


def started(tree: xr.DataTree) -> xr.Dataset | None:
    """The answers of several starts, with `far`, the largest change of a bias there in scales; None of one start."""
    group = tree["mode"].to_dataset()
    from_start = group["start"].values >= 0
    if not from_start.any():
        return None
    scale = tree["calibration"].to_dataset()["scale"].values
    far = np.abs((group["bias"].values - group["bias"].values[0]) / scale).max(1, initial=0.0)
    return group.assign(far=("mode", far)).isel(mode=from_start)


def upgraded(tree: xr.DataTree) -> xr.DataTree:
    """A tree of version 3 in the form of today: its groups `mirror` and `optimum` become the group `mode`."""
    if tree.attrs.get("results_version") != 3:
        return tree
    group = tree["calibration"].to_dataset()
    sd, labels = group["sd"].values, group["bias_label"].values
    least = np.maximum(sd, LEAST * group["scale"].values)
    modes = [Mode(REPORTED, REPORTED, group["mean"].values, 0.0, str(tree.attrs["status"]))]
    attrs: dict[str, Any] = {"same": 0.0, "objective": "objective"}
    if mirrored := "mirror" in tree.children:
        old = tree["mirror"].to_dataset()
        attrs["same"] = old.attrs["same"]
        kinds = old["kind"].values if "kind" in old else np.full(old.sizes["mirror"], SCENE)
        rows = zip(old["mirror"].values, kinds, old["bias"].values, old["gain"].values, strict=True)
        modes += [Mode(str(name), str(kind), bias, float(gain)) for name, kind, bias, gain in rows]
    further = _from_starts(tree["optimum"].to_dataset(), modes, least, attrs) if "optimum" in tree.children else []
    coords = {name: own for name, own in group.coords.items() if own.dims == ("bias_label",)} | {"bias_label": labels}
    found = {"/": mode_group([*modes, *further], sd, coords, attrs)}
    for name, node in tree["mirror/track"].children.items() if mirrored else ():
        own, track = node.to_dataset(inherit=False), tree.children["track"].children[name].to_dataset()
        here = track["mean"].sel(component=coordinates(track["component"].values)).values[None]
        unknown = np.full((len(further), *here.shape[1:]), np.nan)
        places = np.concatenate([here, own["position"].values, unknown])
        where = {"time": own["time"].values, "axis": list(AXES[: here.shape[2]])}
        position = {"position": (("mode", "time", "axis"), places)}
        found[f"track/{name}"] = xr.Dataset(position, coords=where, attrs=own.attrs)
    for name in ("mirror", "optimum"):
        if name in tree.children:
            del tree[name]
    tree["mode"] = xr.DataTree.from_dict(found)
    tree.attrs["results_version"] = RESULTS_VERSION
    return tree


def _from_starts(old: xr.Dataset, modes: list[Mode], sd: np.ndarray, attrs: dict[str, Any]) -> list[Mode]:
    """The answers of a group `optimum` that are none of some modes; those that are one are noted there."""
    attrs["objective"] = evidence_in(old) or "objective"
    scores, found = old[attrs["objective"]].values, list[Mode]()
    for bias, status, start, score in zip(*(old[n].values for n in ("bias", "status", "start")), scores, strict=True):
        known: dict[str, Any] = {"status": str(status), "start": int(start), "objective": float(score)}
        same = (np.max(apart(bias, own.bias, sd), initial=0.0) < ROUNDED and own.start < 0 for own in modes)
        if (k := next((k for k, one in enumerate(same) if one), None)) is not None:
            modes[k] = modes[k]._replace(**known)
        else:
            gain = float(score - scores[0]) if modes[0].start >= 0 else np.nan
            found.append(Mode(ELSEWHERE, unlike(bias, [*modes, *found], sd), bias, gain, **known))
    return found
