"""Rows that an earlier calibration has counted, which a stream that goes on from it must not count again."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from probcal.lazy import pd, xr
from probcal.table import Measurements

if TYPE_CHECKING:
    from probcal.network import Network

COUNTED = "the calibration has counted this row"
STREAMS = "streams_counted"  # attribute of a tree: a list of `Stream` as JSON
MICRO = 1e6  # steps per second to which times are compared: dates have this many


class Stream(NamedTuple):
    """The rows of one recording that a calibration has counted."""

    first: int  # key of the first row
    last: float  # s, time of the last row
    origin: str  # the date of time 0; empty where times are no dates
    epoch: float  # s, to whole multiples of which times are rounded; 0 for none


@dataclass(frozen=True, eq=False)
class Counted:
    """The rows that a calibration has counted: keys of data in its tree, and recordings known by their first row."""

    keys: np.ndarray
    origin: str
    epoch: float
    streams: tuple[Stream, ...]

    @classmethod
    def of(cls, tree: xr.DataTree) -> Counted:
        """Read the tree of a fit, or of a stream; one without data has counted no rows."""
        if "observed_data" not in tree.children:
            return cls(np.zeros(0, np.uint64), "", 0.0, ())
        data = tree["observed_data"].to_dataset()
        origin, epoch = str(tree.attrs.get("time_origin", "")), float(tree.attrs.get("epoch", 0.0))
        columns = [data[name].values for name in ("sensor", "channel", "target", "time", "y")]
        keys = _keys(*columns)
        if STREAMS in tree.attrs:
            streams = tuple(Stream(*own) for own in json.loads(tree.attrs[STREAMS]))
        else:
            row = pd.factorize(data["row"].values, sort=True)[0]
            streams = (Stream(int(keys[row == 0].min()), float(columns[3].max()) + epoch / 2, origin, epoch),)
        return cls(np.unique(keys), origin, epoch, streams)

    def rows(self, data: Measurements, network: Network, origin: str) -> np.ndarray:
        """True if each row (N,) has a datum of the tree; `origin` is the date of time 0 of these rows."""
        shift = _shift(origin, self.origin)
        if shift is None:
            return np.zeros(len(data.time), bool)
        row, keys = _row_keys(data, data.measured, network, shift, self.epoch)
        return np.bincount(row[np.isin(keys, self.keys)], minlength=len(data.time)) > 0

    def until(self, data: Measurements, network: Network, row: int, origin: str) -> float:
        """The time in s up to which a recording with this first row is counted; -inf where none has it."""
        last = -np.inf
        for stream in self.streams:
            shift = _shift(origin, stream.origin)
            if shift is not None and first_key(data, network, row, shift, stream.epoch) == stream.first:
                last = max(last, stream.last - shift + 1 / MICRO)
        return last


def _row_keys(
    data: Measurements, chosen: np.ndarray, network: Network, shift: float, epoch: float
) -> tuple[np.ndarray, np.ndarray]:
    """Row and key of each `chosen` datum, its time moved by `shift` s and rounded to multiples of `epoch` s."""
    row, column = np.nonzero(chosen)
    time = data.time[row] + shift
    time = np.round(time / epoch) * epoch if epoch else time
    sensors, channels, targets = (
        np.array(names, object) for names in ([s.name for s in network.sensors], data.channels, data.target_names)
    )
    keys = _keys(sensors[data.sensor[row]], channels[column], targets[data.target[row]], time, data.value[row, column])
    return row, keys


def first_key(data: Measurements, network: Network, row: int, shift: float = 0.0, epoch: float = 0.0) -> int:
    """The key of one row with a measured value: the least of those of its data."""
    chosen = np.zeros_like(data.measured)
    chosen[row] = data.measured[row]
    return int(_row_keys(data, chosen, network, shift, epoch)[1].min())


def _keys(sensor: Any, channel: Any, target: Any, time: np.ndarray, value: np.ndarray) -> np.ndarray:
    """A number of 63 bits for each datum; the odds that two of 10^6 data have the same are 5e-8."""
    names = [np.asarray(column, object) for column in (sensor, channel, target)]
    ticks = np.rint(time * MICRO) + 0.0  # no -0
    frame = pd.DataFrame(dict(zip("abcde", [*names, ticks, value + 0.0], strict=True)))
    return pd.util.hash_pandas_object(frame, index=False).to_numpy() >> np.uint64(1)


def _shift(origin: str, other: str) -> float | None:
    """Seconds from one date to another, that times since the former are since the latter; None for a date and none."""
    if not origin or not other:
        return None if origin or other else 0.0
    return float((pd.Timestamp(origin) - pd.Timestamp(other)).total_seconds())
