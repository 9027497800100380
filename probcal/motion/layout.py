"""The slices of the components of a state in a vector, by name, and the vector of a start."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import is_dataclass, replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from probcal.errors import InputError
from probcal.labels import AXES
from probcal.types import TargetView

Layout = tuple[tuple[str, int, int, bool], ...]  # components of a vector (name, start, stop, one value an axis)
Start = Mapping[str, tuple[Any, float]]  # component -> (mean, std)


def layout_of(components: Iterable[Any], dimension: int) -> Layout:
    """State components as (name, start, stop, per axis)."""
    spans, offset = [], 0
    for component in components:
        for name, per_axis in component.names():
            width = dimension if per_axis else 1
            spans.append((name, offset, offset + width, per_axis))
            offset += width
    return tuple(spans)


def labels_of(layout: Layout, dimension: int) -> tuple[str, ...]:
    """Entries of a state vector by scalar name (`position_x`, `velocity_y`, `power`)."""
    return tuple(
        f"{name}_{axis}" if per_axis else name
        for name, _, _, per_axis in layout
        for axis in (AXES[:dimension] if per_axis else ("",))
    )


def pieces(layout: Layout, state: Any) -> dict[str, Any]:
    """Parts of a state vector (n,) by component name; scalar components are scalars."""
    return {name: state[start:stop] if per_axis else state[start] for name, start, stop, per_axis in layout}


def view(layout: Layout, state: Any, flow: Sequence[Any] = ()) -> TargetView:
    """Read a state vector (n,) by component name, as a sensor function does; `flow` is that of `flow_of`."""
    if not flow:
        return TargetView("the target", pieces(layout, state))
    spans = {name: (start, stop) for name, start, stop, _ in layout}
    dimension = next(stop - start for name, start, stop, _ in layout if name == "position")

    def moved(dt: Any) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for part in flow:
            own = layout_of([part], dimension)
            start = spans[own[0][0]][0]
            F = part.transition(jnp.reshape(dt, (1,)), dimension)[0]
            found |= pieces(own, F @ state[start : start + own[-1][2]])
        return found

    return TargetView("the target", pieces(layout, state), moved)


def flow_of(components: Iterable[Any], dimension: int) -> tuple[Any, ...]:
    """The components whose state goes on otherwise than `TargetView.at` knows, each of unit std.

    They are those that turn, or decay: what has a memory and no constant velocity or acceleration.
    """
    found = []
    for part in components:
        layout, dt = layout_of([part], dimension), 0.7  # s, any that shows the form
        if part.memoryless or getattr(part, "stationary", False):  # noise of sensors is read as it is
            continue
        eye = np.eye(layout[-1][2])
        known = TargetView("the target", {name: eye[start:stop] for name, start, stop, _ in layout}).at(dt)
        same = np.concatenate([getattr(known, name) for name, *_ in layout])
        if not np.allclose(part.transition(np.full(1, dt), dimension)[0], same, atol=1e-12):
            declared = part
            found.append(replace(declared, std=1.0) if is_dataclass(part) and hasattr(part, "std") else part)
    return tuple(found)


def stacked(component: Any, start: Start, dimension: int) -> tuple[np.ndarray, np.ndarray]:
    """Start means and standard deviations (s,) of a component; raises `ValueError` naming one of another length."""
    means, stds = [], []
    for name, per_axis in component.names():
        width = dimension if per_axis else 1
        mean, std = start[name]
        try:
            means.append(np.broadcast_to(np.asarray(mean, float), (width,)))
        except ValueError:
            raise ValueError(f'the start mean of "{name}" must have {width} value(s)') from None
        stds.append(np.full(width, float(std)))
    return np.concatenate(means), np.concatenate(stds)


def check_once(names: Iterable[str], what: str = "component") -> None:
    """Raise `InputError` for a name that stands twice."""
    names = list(names)
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InputError(f'motion: {what} "{twice[0]}" is declared twice')
