"""The scores of a saved fit by a truth: position and bias error, coverage."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from probcal.errors import checked
from probcal.labels import NOBODY, coordinates
from probcal.lazy import xr
from probcal.results.alignment import align as laid_on
from probcal.results.read import each_target, frame_of

if TYPE_CHECKING:
    from probcal.simulate import Truth


def position_rmse(tree: xr.DataTree, truth: Truth, *, align: str | None = None) -> tuple[float, float] | None:
    """Root mean square position error in m without and with calibration, over the epochs that the truth covers.

    With `align` ("rigid", "similarity") each is first laid on the truth, which may live in another frame then.
    """
    before, after, true = _met(tree, truth)
    if not len(true):
        return None
    if align is not None:
        before, after = (laid_on(places, true, align)(places) for places in (before, after))
    first, second = (rms(np.linalg.norm(places - true, axis=1)) for places in (before, after))
    return first, second


def _true(name: str, track: xr.Dataset, truth: Truth) -> np.ndarray:
    """True positions (E, d) at the epochs of a track, NaN where the truth does not cover them."""
    times = track["time"].values
    return truth.positions(times, np.full(len(times), name), len(coordinates(track["component"].values)))


def _met(tree: xr.DataTree, truth: Truth) -> list[np.ndarray]:
    """Positions (N, d) without and with calibration and true ones, of every epoch that the truth covers."""
    pairs, tracks = [], list(each_target(tree))
    truth.check_targets(name for name, _ in tracks)
    for name, track in tracks:
        true = _true(name, track, truth)
        known = np.isfinite(true).all(1)
        own = track.sel(component=coordinates(track["component"].values))
        pairs.append([places[known] for places in (own["before"].values, own["mean"].values, true)])
    return [np.concatenate(parts) for parts in zip(*pairs, strict=True)] or [np.zeros((0, 0))] * 3


@checked
def scores(tree: xr.DataTree, truth: Truth, *, align: str | None = None) -> dict[str, float]:
    """Scores by name: position RMSE before and after, normalised bias RMSE and coverage of the intervals.

    A truth whose tracks live in another frame is met by `align`, "rigid" or "similarity": the tracks are laid on it
    first, and the scores say so (`position_rmse_after_rigid`). Raises `InputError` for another kind.

    >>> bool(scores(tree, run.truth)["position_rmse_after"] < 1.0)
    True
    """
    found: dict[str, float] = {}
    positions, suffix = position_rmse(tree, truth, align=align), "" if align is None else f"_{align}"
    if positions is not None:
        found |= {f"position_rmse_before{suffix}": positions[0], f"position_rmse_after{suffix}": positions[1]}
    if "calibration" in tree.children and len(known := judged_by(tree, truth.biases)):
        found |= {"bias_rmse": rms(known["error"]), "coverage": float(known["inside"].mean())}
    return found


def judged_by(tree: xr.DataTree, true: Mapping[str, float]) -> Any:
    """One row a bias whose true value is known: `true`, its `error` in scales, whether the interval has it `inside`."""
    frame = frame_of(tree, "calibration", "mean", "scale", "lower", "upper")
    frame["true"] = [true.get(label, np.nan) for label in frame.index]
    frame["error"] = (frame["mean"] - frame["true"]) / frame["scale"]
    frame["inside"] = frame["true"].between(frame["lower"], frame["upper"])
    return frame.dropna(subset="true")


def rms(values: Any) -> float:
    """Root of the mean square of some values."""
    return float(np.sqrt(np.mean(np.square(values))))


@checked
def add_scores(tree: xr.DataTree, truth: Truth, *, align: str | None = None) -> xr.DataTree:
    """Add what a truth says of a fit: `scores` as attributes, true biases (group `truth`), true tracks (`true`).

    Returns the tree. Reports and maps show it then. True tracks that live in another frame are shown in that of the
    answer, by the inverse of their `align`. Raises `InputError` as `scores` does.

    >>> add_scores(tree, run.truth)["truth/bias"].sel(bias_label="sonar_1.range_offset").item()
    8.0
    """
    found = scores(tree, truth, align=align)
    # take out what another truth said, or this one otherwise aligned
    for name in [str(name) for name in tree.attrs]:
        if name.startswith("position_rmse_") or name in ("bias_rmse", "coverage"):
            del tree.attrs[name]
    if "truth" in tree.children:
        del tree["truth"]
    for node in tree["track"].children.values() if "track" in tree.children else ():
        if "true" in node.data_vars:
            node.dataset = node.to_dataset(inherit=False).drop_vars("true")
    tree.attrs.update(found)
    labels = tree["calibration"].to_dataset()["bias_label"].values if "calibration" in tree.children else ()
    known = {label: float(value) for label, value in truth.biases.items() if label in labels}
    if known:
        tree["truth"] = xr.DataTree(
            xr.Dataset({"bias": ("bias_label", list(known.values()))}, {"bias_label": list(known)})
        )
    if "track" not in tree.children:
        return tree
    _, after, true = _met(tree, truth)
    frame = None if align is None or not len(true) else laid_on(after, true, align)
    for node in tree["track"].children.values() if len(true) else ():
        track = node.to_dataset(inherit=False)
        if node.attrs["target"] == NOBODY:
            continue
        places = _true(str(node.attrs["target"]), track, truth)
        columns = np.full(track["mean"].shape, np.nan)
        located = np.isin(track["component"], coordinates(track["component"].values))
        columns[:, located] = places if frame is None else frame.back(places)
        node["true"] = xr.DataArray(columns, dims=("time", "component"))
    return tree
