"""A target whose path is known or reported."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from probcal.errors import InputError, check_known
from probcal.geometry import slopes
from probcal.labels import AXES
from probcal.lazy import pd
from probcal.motion.base import GAUSSIAN, Component
from probcal.motion.components import ConstantVelocity, blocks
from probcal.noise import Level, check_driven


@dataclass(frozen=True, eq=False)
class Known(Component):
    """A target whose path is known or reported (a surveyed walk, ADS-B, AIS): interpolated, not searched for.

    `track` is a DataFrame with the columns time, position_x, position_y[, position_z] and, where known, velocity_x,
    ... (or a pair of arrays, times (T,) in s and positions (T, d) in m); without velocities they are its differences.
    `std` is that of the reported position on each axis in m, drawn anew at every epoch; 0 takes it
    as exact. `noise=StudentT(4)` allows for outliers of the report; all axes of an epoch share its
    latent scale.

    >>> Known(([0.0, 10.0], [(0.0, 0.0), (50.0, 0.0)]), std=0.02).std
    0.02
    """

    memoryless = True
    timed = True
    driven: ClassVar[str] = "position"
    next_order = (
        "its reports as rows of a sensor with biases, sensors.position.on(Node(...)), and ConstantVelocity(std)"
    )

    track: Any
    std: Level = 0.0
    noise: Any = GAUSSIAN
    time: np.ndarray = field(init=False, repr=False)  # (T,)
    state: np.ndarray = field(init=False, repr=False)  # (T, 2d) positions, velocities

    def __post_init__(self):
        check_driven(self, "Known:")
        time, position, velocity = _track(self.track)
        if time.ndim != 1 or position.ndim != 2 or len(position) != len(time) or position.shape[1] not in (2, 3):
            raise InputError(
                f"Known: time has shape {time.shape} and position {position.shape}; give (T,) and (T, 2 or 3)"
            )
        if not len(time) or not (np.diff(time) > 0).all():
            raise InputError("Known: time must increase; give one track a target, sorted by time")
        if velocity is None:
            velocity = slopes(time, position)
        state = np.concatenate([position, velocity], 1)
        if not (np.isfinite(time).all() and np.isfinite(state).all()):
            raise InputError("Known: time, position and velocity must be finite; drop the gaps")
        object.__setattr__(self, "time", time)
        object.__setattr__(self, "state", state)

    names = ConstantVelocity.names

    def transition(self, dt: Any, dimension: int) -> Any:
        """Zero, shape (E, 2d, 2d): every epoch is known by itself."""
        return np.zeros((len(dt), 2 * dimension, 2 * dimension))

    def noise_factor(self, dt: Any, dimension: int) -> Any:
        """Identity for the position, nothing for the velocity, shape (E, 2d, d); no column where std is 0."""
        factor = blocks([[1.0], [0.0]], dimension, dt)
        return factor[:, :, :0] if self.std == 0 else factor

    def means(self, time: np.ndarray, dimension: int) -> np.ndarray:
        """The track at each time, shape (E, 2d); raises `InputError` outside it."""
        if self.state.shape[1] != 2 * dimension:
            raise InputError(f"the known track is {self.state.shape[1] // 2}-D, the network {dimension}-D")
        outside = (time < self.time[0] - 1e-9) | (time > self.time[-1] + 1e-9)
        if outside.any():
            raise InputError(
                f"time {time[outside][0]:g} is outside its known track, which runs from {self.time[0]:g}"
                f" to {self.time[-1]:g}; drop the rows or extend the track"
            )
        return np.stack([np.interp(time, self.time, column) for column in self.state.T], 1)


def _track(given: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Times (T,), positions (T, d) and velocities (T, d), where given, of a frame or a pair of arrays."""
    if not isinstance(given, pd.DataFrame):
        try:
            time, position = (np.asarray(part, float) for part in given)
        except (TypeError, ValueError):
            raise InputError(
                "Known: give a DataFrame with the columns time, position_x, position_y, or a pair (time, position)"
            ) from None
        return time, position, None
    axes = AXES if "position_z" in given else AXES[:2]
    wanted = ["time", *(f"position_{axis}" for axis in axes)]
    if any(column.startswith("velocity_") for column in map(str, given.columns)):
        wanted += [f"velocity_{axis}" for axis in axes]
    for column in wanted:
        check_known(column, given.columns, f'Known: the track has no column "{column}"')
    try:
        values = given[wanted].to_numpy(float)
    except (TypeError, ValueError):
        raise InputError(f"Known: the columns {', '.join(wanted)} of the track must hold numbers") from None
    d = len(axes)
    return values[:, 0], values[:, 1 : 1 + d], values[:, 1 + d :] if len(wanted) > 1 + d else None
