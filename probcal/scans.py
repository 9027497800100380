"""Scans: what one sensor reported at one time of objects that it does not name; and rows with names put to them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from probcal.errors import InputError
from probcal.lazy import pd
from probcal.network import Network
from probcal.table import Measurements, Table, header


@dataclass(frozen=True, eq=False)
class Scans:
    """Every scan in time order: time (K,) in s, number of its sensor (K,), and the scan (N,) of each row, -1 of none.

    A row without a measured value is no detection, but says that its sensor looked.
    """

    time: np.ndarray
    sensor: np.ndarray
    of_row: np.ndarray
    detected: np.ndarray  # (N,) whether a row is a detection

    def __len__(self) -> int:
        return len(self.time)

    @property
    def count(self) -> np.ndarray:
        """Number of detections of each scan (K,)."""
        return np.bincount(self.of_row[self.detected], minlength=len(self))


def scans_of(data: Measurements) -> Scans:
    """The scans of the rows that name no target."""
    mine = np.flatnonzero(data.detection)
    keys, number = np.unique(np.stack([data.time[mine], data.sensor[mine]]), axis=1, return_inverse=True)
    of_row = np.full(len(data.time), -1)
    of_row[mine] = number
    return Scans(keys[0], keys[1].astype(int), of_row, data.detection & data.measured.any(1))


def detection_limits(network: Network, data: Measurements) -> np.ndarray:
    """Low and high (S, channels, 2) of the false detections of every sensor; NaN where it has no such channel.

    Raises `InputError` naming sensor and channel where nothing tells them.
    """
    found = np.full((len(network.sensors), len(data.channels), 2), np.nan)
    for s, placed in enumerate(network.sensors):
        if placed.detection is None:
            continue
        for name, channel in placed.type.expand(network.dimension):
            j = data.channels.index(name)
            pair = placed.detection.within(name, channel.unit, channel.period)
            if pair is None:
                told = data.value[(data.sensor == s) & data.measured[:, j], j]
                if len(told) < 2 or np.ptp(told) == 0:
                    raise InputError(
                        f'sensor "{placed.name}": its rows do not tell where false detections of "{name}" lie; say it,'
                        f' as in Detection(..., limits={{"{name}": (low, high)}})'
                    )
                pair = float(told.min()), float(told.max())
            found[s, j] = pair
    return found


def assigned_rows(data: Measurements, tracks: Any) -> Table:
    """The table with names put to its detections: `tracks` has columns row, track and, where not certain, weight.

    A row may be of several tracks, each with its weight; what is of none is left out. Rows that name their target stay.
    Raises `InputError` naming what is wrong.
    """
    table = data.table
    names, _ = header(table)
    tracks = pd.DataFrame(tracks)
    for column in ("row", "track"):
        if column not in tracks:
            raise InputError(f'assigned: the tracks have no column "{column}"; give row, track[, weight]')
    row = tracks["row"].to_numpy()
    if row.dtype.kind not in "iu" or (len(row) and not (row.min() >= 0 and row.max() < len(data.time))):
        raise InputError(f"assigned: row counts the rows of the table from 0 to {len(data.time) - 1}")
    named = np.flatnonzero(~data.detection[row])
    if len(named):
        raise InputError(f"assigned: {table.where(row[named[0]])} names its target; only detections are assigned")
    weight = tracks["weight"].to_numpy(float) if "weight" in tracks else np.ones(len(row))
    total = np.bincount(row, weight, len(data.time)) if len(row) else np.zeros(len(data.time))
    if not (np.isfinite(weight).all() and (weight >= 0).all() and (total <= 1 + 1e-6).all()):
        raise InputError("assigned: the weights of a row lie between 0 and 1 and add up to 1 at most")
    frame = table.frame.set_axis(names, axis=1)
    kept = np.flatnonzero(~data.detection)
    whole = np.concatenate([kept, row])
    target = np.concatenate([np.array(data.target_names, object)[data.target[kept]], tracks["track"].astype(str)])
    counts = np.concatenate([data.weight[kept], np.minimum(weight, 1.0) * data.weight[row]])
    order = np.argsort(data.time[whole], kind="stable")
    result = table.frame.iloc[whole[order]].reset_index(drop=True)
    if "target" in frame:
        result[table.frame.columns[names.index("target")]] = target[order]
    else:
        result.insert(1, "target", target[order])
    result["weight"] = counts[order]
    return Table(result, table.source, table.lines[whole[order]], table.word)
