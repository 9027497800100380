"""The state of an online filter as bytes, so that a killed one goes on where it was."""

from __future__ import annotations

import io
import json
from collections import Counter
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from probcal.errors import InputError
from probcal.inference.arrivals import CarriedTarget
from probcal.inference.online import Jump, Online
from probcal.lazy import Later
from probcal.model.motions import Area
from probcal.online.belief import Augmented, JumpCandidates, Slots
from probcal.types import float64

if TYPE_CHECKING:
    import pandas as pd
else:
    pd = Later("pandas")

VERSION = 3


def pack_state(online: Online, beside: dict[str, Any]) -> bytes:
    """Everything that a filter knows, and what the caller keeps beside it (JSON)."""
    arrivals, arrays = online.arrivals, dict[str, Any]()
    for name in ("belief", "end"):
        found = getattr(online, name, None)
        if found is not None:
            leaves = [found.mean, found.root, *found.candidates, *(leaf for own in found.slots for leaf in own)]
            arrays |= {f"{name}_{k}": np.asarray(leaf) for k, leaf in enumerate(leaves)}
    if online.cloud is not None:
        arrays |= {f"cloud_{k}": np.asarray(leaf) for k, leaf in enumerate(jax.tree.leaves(online.cloud))}
    if arrivals.tried is not None:
        arrays["tried"] = arrivals.tried
    area = arrivals.area
    said = {
        "version": VERSION,
        "labels": None if arrivals.template is None else list(arrivals.template.labels),
        "method": repr(online.method),
        "counts": dict(arrivals.counts),
        "doubts": {name: int(count) for name, count in online.doubts.items()},
        "targets": {n: [k.recursion, k.slot, k.time, list(map(list, k.keys))] for n, k in arrivals.targets.items()},
        "origin": arrivals.origin,
        "starts": arrivals.starts,
        "area": None if area is None else [area.dimension, area.centre.tolist(), area.extent, area.wide],
        "duration": arrivals.duration,
        "frames": {n: _columns(f) for n, f in _frames(online).items()},
        "points": [[t, n, x.tolist(), z.tolist()] for (t, n), (x, z) in online.points.items()],
        "log_evidence": online.log_evidence,
        "epochs": online.epochs,
        "time": online.time,
        "walked": online.walked,
        "since": online.since,
        "jumps": [list(jump) for jump in online.jumps],
        "beside": beside,
    }
    packed = io.BytesIO()
    np.savez(packed, said=np.frombuffer(json.dumps(said).encode(), np.uint8), **arrays)
    return packed.getvalue()


@float64
def unpack_state(online: Online, content: bytes, source: str) -> dict[str, Any]:
    """Bring a fresh filter of the same network and settings to a snapshot; what was kept beside it.

    Raises `InputError` where the snapshot is damaged, or of another network or other settings.
    """
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as file:
            arrays = dict(file.items())
        said = json.loads(arrays.pop("said").tobytes())
        version = said["version"]
    except Exception as error:  # whatever NumPy and zipfile say of foreign bytes
        raise InputError(f"{source} is no checkpoint of probcal watch ({error}); move it away to begin anew") from None
    if version != VERSION or said["method"] != repr(online.method):
        raise InputError(
            f"{source} is the checkpoint of other settings, {said['method']}; give those, or another --out"
        )
    arrivals = online.arrivals
    arrivals.counts, arrivals.origin = Counter(said["counts"]), said["origin"]
    online.doubts = Counter(said["doubts"])
    arrivals.targets = {
        n: CarriedTarget(r, slot, time, tuple((a, b, c) for a, b, c in keys))
        for n, (r, slot, time, keys) in said["targets"].items()
    }
    arrivals.starts = {
        g: {part: (tuple(m) if isinstance(m, list) else m, sd) for part, (m, sd) in own.items()}
        for g, own in said["starts"].items()
    }
    if said["area"] is not None:
        d, middle, extent, wide = said["area"]
        arrivals.area, arrivals.duration = Area(d, np.array(middle), extent, wide), said["duration"]
        arrivals.tried = arrays.pop("tried")
    frames = {n: None if own is None else pd.DataFrame(own) for n, own in said["frames"].items()}
    arrivals.samples = frames["samples"]
    online.pending, online.recent, online.lately = frames["pending"], frames["recent"], frames["lately"]
    if arrivals.samples is not None:
        arrivals.rebuild()
        if list(arrivals.template.labels) != said["labels"]:  # type: ignore[union-attr]
            raise InputError(f"{source} is the checkpoint of a network with other biases; give another --out")
        online.belief, online.end = _belief(arrays, "belief"), _belief(arrays, "end")
    online.points = {(t, n): (np.array(x), np.array(z)) for t, n, x, z in said["points"]}
    online.log_evidence, online.time, online.walked = said["log_evidence"], said["time"], said["walked"]
    online.epochs = said["epochs"]
    online.since, online.jumps = said["since"], [Jump(*own) for own in said["jumps"]]
    if online.belief is not None:
        online.prepare()
    if online.cloud is not None:
        leaves = [arrays[f"cloud_{k}"] for k in range(sum(key.startswith("cloud_") for key in arrays))]
        online.cloud = jax.tree.unflatten(jax.tree.structure(online.cloud), leaves)
    return said["beside"]


def _frames(online: Online) -> dict[str, pd.DataFrame | None]:
    held = {name: getattr(online, name) for name in ("pending", "recent", "lately")}
    return {"samples": online.arrivals.samples, **held}


def _columns(frame: pd.DataFrame | None) -> dict[str, list[Any]] | None:
    return None if frame is None else {str(name): frame[name].tolist() for name in frame}


def _belief(arrays: dict[str, Any], name: str) -> Augmented:
    leaves: list[Any] = [arrays[f"{name}_{k}"] for k in range(sum(key.startswith(f"{name}_") for key in arrays))]
    slots = tuple(Slots(*leaves[k : k + 4]) for k in range(6, len(leaves), 4))
    return Augmented(leaves[0], leaves[1], slots, JumpCandidates(*leaves[2:6]))
