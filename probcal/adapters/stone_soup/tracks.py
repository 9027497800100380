"""Tracks of a fit as Stone Soup tracks, and the other way."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from datetime import datetime, timedelta
from typing import Any

import numpy as np

from probcal.adapters.stone_soup.function import Mapped, StateMapping
from probcal.adapters.stone_soup.measurement import (
    EPOCH,
    as_start,
    seconds_since,
    stonesoup,
    timestamp_of,
)
from probcal.errors import InputError, nearest
from probcal.labels import AXES
from probcal.lazy import pd, xr
from probcal.results.read import each_target

POSITION = tuple(f"position_{axis}" for axis in AXES)


def to_tracks(tree: xr.DataTree, *, start: datetime | None = None, mapping: Mapped = None) -> list[Any]:
    """The tracks of a fit as Stone Soup tracks, one a target, whose id it is.

    States are Gaussian with the mean and sd of each component, without correlations, which a fit does not hold; their
    order is that of Stone Soup (position and velocity of each axis in turn, then what else there is), or `mapping`.
    Timestamps count from `start`, by default 1970. Raises `InputError` for a tree without tracks.

    >>> import probcal.adapters as adapters
    >>> tracks = adapters.to_tracks(tree)  # doctest: +SKIP
    """
    start = as_start(start, None) or EPOCH
    types, arrays = stonesoup("types.state"), stonesoup("types.array")
    track = stonesoup("types.track").Track
    found = []
    for name, group in each_target(tree):
        components = [str(c) for c in group["component"].values]
        order = _order(components, mapping)
        mean, sd = group["mean"].values, group["sd"].values
        states = [
            types.GaussianState(
                arrays.StateVector(mean[k, order].tolist()), np.diag(sd[k, order] ** 2),
                timestamp=start + timedelta(seconds=float(time)),
            )
            for k, time in enumerate(group["time"].values)
        ]  # fmt: skip
        found.append(track(states, id=name))
    if not found:
        raise InputError("the tree holds no tracks; give what fit() or track() returned")
    return found


def _order(components: list[str], mapping: Mapped) -> list[int]:
    """The index of each entry of a Stone Soup state among the components of a fit."""
    dimension = sum(name in POSITION for name in components)
    if mapping is not None:
        entries = StateMapping(mapping, dimension).entries
        names = sorted(entries, key=lambda name: entries[name])
        for name in names:
            if name not in components:
                raise InputError(f'the tracks have no component "{name}"{nearest(name, components)}')
        return [components.index(name) for name in names]
    by_axis = [f"{part}_{axis}" for axis in AXES for part in ("position", "velocity", "acceleration")]
    first = [name for name in by_axis if name in components]
    return [components.index(name) for name in [*first, *(name for name in components if name not in first)]]


def from_tracks(tracks: Iterable[Any], *, start: datetime | None = None, mapping: Mapped = None) -> pd.DataFrame:
    """Stone Soup tracks, or true paths, as the table of `tracks`: time (s), target, a column a component and its sd.

    `Truth` and `Known` take it. Targets are called by the `target` of the track's metadata, or its id. `mapping` is
    that of `measurement_model`; by default a state of 2 or 3 numbers is a position, one of 4 or 6 position and velocity
    of each axis in turn. Time counts from `start`, by default the first state. Raises `InputError`.

    >>> import probcal.adapters as adapters
    >>> adapters.from_tracks([])
    Traceback (most recent call last):
    ...
    probcal.errors.InputError: there are no tracks with states; give those of a Stone Soup tracker
    """
    given = list(tracks)
    states = [state for own in given for state in own]
    if not states:
        raise InputError("there are no tracks with states; give those of a Stone Soup tracker")
    start = as_start(start, None) or min(timestamp_of(state, "state") for state in states)
    rows = []
    for own in given:
        metadata = getattr(own, "metadata", None) or {}
        name = str(metadata.get("target") or own.id)
        for state in own:
            mean = state.mean if hasattr(state, "mean") else state.state_vector
            values = np.asarray(mean, float)[:, 0]
            entries = _entries(len(values), mapping)
            row: dict[str, Any] = {"time": seconds_since(timestamp_of(state, "state"), start), "target": name}
            covar = getattr(state, "covar", None)
            sd = None if covar is None else np.sqrt(np.diag(np.asarray(covar, float)))
            for component, i in entries.items():
                row[component] = values[i]
                if sd is not None:
                    row[f"{component}_sd"] = sd[i]
            rows.append(row)
    frame = pd.DataFrame(rows).sort_values(["target", "time"], kind="stable").reset_index(drop=True)
    frame.attrs["start"] = start.isoformat()
    return frame


def _entries(size: int, mapping: Mapped) -> dict[str, int]:
    if mapping is None and size in (2, 3):
        mapping = tuple(range(size))
    elif mapping is None and size not in (4, 6):
        raise InputError(
            f'a state has {size} numbers; say what they are, as in mapping={{"position": (0, 2), "power": 4}}'
        )
    position = mapping["position"] if isinstance(mapping, Mapping) else mapping
    dimension = size // 2 if position is None else np.size(position)
    return StateMapping(mapping, int(dimension), size).entries
