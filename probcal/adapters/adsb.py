"""ADS-B: the positions that aircraft report, from state logs in CSV as OpenSky writes them."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from probcal.adapters.shared import check_frame, instant, reports
from probcal.errors import InputError, nearest
from probcal.files import AnyPath
from probcal.geodesy import LocalFrame
from probcal.lazy import pd
from probcal.table import Table, name_as_text, numbers, read_table, split_header, unit_factor

ALSO = {  # quantity -> names in files of OpenSky, its API, and others; unit that counts where a header states none
    "target": ("icao24", "hex", "icao", "target"),
    "latitude": ("lat", "latitude"),
    "longitude": ("lon", "lng", "longitude"),
    "speed": ("velocity", "groundspeed", "speed"),
    "course": ("heading", "true_track", "track"),
    "climb": ("vertrate", "vertical_rate"),
}
UNITS_OF = {
    "latitude": "deg", "longitude": "deg", "speed": "m/s", "course": "deg", "climb": "m/s", "altitude": "m",
}  # fmt: skip
ALTITUDES = {"geoaltitude": ("geoaltitude", "geo_altitude"), "baroaltitude": ("baroaltitude", "baro_altitude")}
POSITION_TIME = ("lastposupdate", "time_position")  # when the position was received, which a log repeats until the next
TRUE = ("true", "1", "1.0", "t", "yes")


def read_adsb(
    source: AnyPath | pd.DataFrame,
    frame: LocalFrame,
    *,
    dimension: int = 3,
    sensor: str = "adsb",
    columns: Sequence[str] = ("position", "speed", "course"),
    altitude: str = "geoaltitude",
    start: Any = None,
) -> pd.DataFrame:
    """Positions that aircraft report by ADS-B, as a table: time (s), sensor, target (ICAO 24), the asked for columns.

    `source` is a state log in CSV or a DataFrame with the columns of OpenSky: time (Unix seconds or ISO), icao24, lat,
    lon (degrees), velocity (m/s over ground), heading (degrees clockwise from true north), vertrate (m/s), geoaltitude
    (m above the ellipsoid) and baroaltitude (m of the standard atmosphere; take it by `altitude` only where hundreds
    of metres do not matter); a header may state another unit (`velocity [km/h]`). A log repeats a position until the
    next arrives: where it says when it arrived (`lastposupdate`), that is the time. Rows on the ground count; rows
    without position or, in 3-D, altitude are left out and counted in `.attrs["left_out"]`. `columns`, `start` and what
    takes the table are those of `read_ais`; velocities in 3-D have a z. Raises `InputError` naming file and column.

    >>> import pandas as pd
    >>> import probcal.adapters as adapters
    >>> log = pd.DataFrame({"time": [0, 10], "icao24": "3c6444", "lat": [48.0, 48.01], "lon": 11.0})
    >>> frame = adapters.read_adsb(log, LocalFrame(48.0, 11.0), dimension=2, columns="position")
    >>> frame["position_y"].round().tolist()
    [0.0, 1112.0]
    """
    check_frame("read_adsb", frame)
    if dimension not in (2, 3):
        raise InputError(f"read_adsb: dimension is {dimension!r}; give 2 or 3")
    if altitude not in ALTITUDES:
        raise InputError(f'read_adsb: altitude is "{altitude}"{nearest(str(altitude), ALTITUDES)}')
    table = read_table(source)
    names = dict(reversed([(split_header(column)[0].lower(), column) for column in table.frame.columns]))
    known = {quantity: _column(names, also) for quantity, also in ALSO.items()}
    known["altitude"] = _column(names, ALTITUDES[altitude])
    for quantity, wanted in (("target", "icao24"), ("latitude", "lat"), ("longitude", "lon"), ("altitude", altitude)):
        if known[quantity] is None and (quantity != "altitude" or dimension == 3):
            also = "; give dimension=2 for positions without heights" if quantity == "altitude" else ""
            raise InputError(
                f'{table.source} is no state log of aircraft: it has no column "{wanted}"{nearest(wanted, names)}{also}'
            )
    if _column(names, ("time", *POSITION_TIME)) is None:
        raise InputError(f'{table.source}: a state log needs a column "time", in Unix seconds{nearest("time", names)}')
    values = {quantity: _numbers(table, known[quantity], unit) for quantity, unit in UNITS_OF.items()}
    stamps, timed = _stamps(table, names)
    target = table.frame[known["target"]]
    place = ["latitude", "longitude", *(["altitude"] if dimension == 3 else [])]
    there = np.isfinite([values[name] for name in place]).all(axis=0)
    fine = there & (np.abs(values["latitude"]) <= 90) & (np.abs(values["longitude"]) <= 180)
    named = target.notna().to_numpy()
    kept = np.flatnonzero(fine & timed & named)
    left = {
        "without a position": int((~fine).sum()), "without a time": int((fine & ~timed).sum()),
        "without a name": int((fine & timed & ~named).sum()),
    }  # fmt: skip
    motion = [values[name][kept] for name in ("speed", "course", *(["climb"] if dimension == 3 else []))]
    if known["climb"] is None and dimension == 3:
        motion[2] = np.zeros(len(kept))
    return reports(
        table.source, stamps[kept], [name_as_text(name).lower() for name in target.iloc[kept]],
        [values[name][kept] for name in place], motion, frame,
        sensor=sensor, columns=columns, start=start, left_out=left,
    )  # fmt: skip


def _column(names: dict[str, Any], also: Sequence[str]) -> Any:
    """The column of a file that has one of some names, None where none has."""
    return next((names[name] for name in also if name in names), None)


def _numbers(table: Table, column: Any, unit: str) -> np.ndarray:
    """Cells in a unit, NaN where blank or where there is no such column."""
    if column is None:
        return np.full(len(table.frame), np.nan)
    value, there = numbers(table, table.frame[column], str(column))
    return np.where(there, value * unit_factor(table, str(column), split_header(column)[1], unit), np.nan)


def _stamps(table: Table, names: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Instants (N,) of the positions in ns, and which rows have one."""
    found, timed = np.zeros(len(table.frame), np.int64), np.zeros(len(table.frame), bool)
    for name in (*POSITION_TIME, "time"):
        if name not in names:
            continue
        column = table.frame[names[name]]
        for row in np.flatnonzero(~timed & column.notna().to_numpy()):
            cell = column.iloc[row]
            with suppress(TypeError, ValueError):
                cell = float(cell)
            found[row], timed[row] = instant(cell, f'{table.where(int(row))} column "{names[name]}"'), True
    return found, timed
