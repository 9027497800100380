"""From the coordinates of a file to metres: longitude and latitude, projected coordinates, or metres already."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from probcal.errors import InputError
from probcal.geodesy import LocalFrame
from probcal.lazy import Later

if TYPE_CHECKING:
    import pyproj
else:
    pyproj = Later("pyproj")

LOCAL = "local"  # states that coordinates are the metres of the network already
WGS84 = "EPSG:4326"
Projection = Callable[[np.ndarray], np.ndarray]


def projection(crs: Any, frame: LocalFrame | None) -> Projection:
    """Map of points (n, 2 or 3) of a coordinate reference system, x or longitude first, to metres of the same shape.

    Without `crs` points are metres, or with a frame longitude and latitude; projected ones are metres without a frame.
    """
    if crs is None and frame is not None:
        crs = WGS84
    if crs is None or crs == LOCAL:
        return lambda points: points
    try:
        system = pyproj.CRS.from_user_input(crs)
    except pyproj.exceptions.CRSError:
        raise InputError(f'crs "{crs}" is not known; give one as "EPSG:25832", or "{LOCAL}" for metres') from None
    if frame is None:
        if system.is_geographic:
            raise InputError(
                f"the roads are in longitude and latitude ({system.name}); give frame=LocalFrame(latitude, longitude)"
            )
        scale = system.axis_info[0].unit_conversion_factor if system.axis_info else 1.0
        return lambda points: points * np.where(np.arange(points.shape[1]) < 2, scale, 1.0)
    degrees = pyproj.Transformer.from_crs(system, WGS84, always_xy=True)

    def to_frame(points: np.ndarray) -> np.ndarray:
        longitude, latitude = degrees.transform(points[:, 0], points[:, 1])
        if not (np.isfinite(longitude).all() and np.isfinite(latitude).all()):
            raise InputError(f"some points are outside the area of {system.name}; check crs")
        return frame.to_local(latitude, longitude, points[:, 2] if points.shape[1] == 3 else None)

    return to_frame
