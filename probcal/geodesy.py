"""The local frame of places given by latitude and longitude."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from probcal.errors import InputError
from probcal.lazy import Later

if TYPE_CHECKING:
    import pyproj
else:
    pyproj = Later("pyproj")

EQUATOR, FLATTENING = 6378137.0, 1 / 298.257223563  # WGS84: radius in m
GEODETIC = ("latitude", "longitude", "height")


@dataclass(frozen=True)
class LocalFrame:
    """Local frame in m: x east, y north of an origin in degrees (WGS84), `height` in m above the ellipsoid.

    With heights it is the topocentric frame of the origin, z up: exact in space, so that a line of sight is straight
    over any distance. Without, it is the azimuthal equidistant map at the origin's height: distances from the origin
    are true, those across it grow by (d / R)^2 / 6, which is 4 cm a km at d = 100 km.

    >>> bool(abs(LocalFrame(48.0, 11.0).to_local([48.001], [11.0])[0, 1] - 111.2) < 0.1)  # a thousandth of a degree
    True
    """

    latitude: float
    longitude: float
    height: float = 0.0

    def __post_init__(self):
        check_place("LocalFrame", self.latitude, self.longitude, self.height)
        for name in GEODETIC:
            object.__setattr__(self, name, float(getattr(self, name)))

    @cached_property
    def _maps(self) -> dict[int, Any]:
        """Transformers between longitude and latitude (and height) and the frame, by dimension."""
        a, b = EQUATOR + self.height, EQUATOR * (1 - FLATTENING) + self.height
        origin = f"+lat_0={self.latitude!r} +lon_0={self.longitude!r}"
        space = f"+step +proj=cart +ellps=WGS84 +step +proj=topocentric +ellps=WGS84 {origin} +h_0={self.height!r}"
        return {
            2: pyproj.Transformer.from_pipeline(f"+proj=aeqd {origin} +a={a!r} +b={b!r}"),
            3: pyproj.Transformer.from_pipeline(f"+proj=pipeline {space}"),
        }

    def to_local(self, latitude: Any, longitude: Any, height: Any = None) -> np.ndarray:
        """Positions in m, shape (..., 2) or with heights (..., 3), of places in degrees and m."""
        check_place("LocalFrame.to_local", latitude, longitude, 0.0 if height is None else height)
        given = (longitude, latitude) if height is None else (longitude, latitude, height)
        places = np.broadcast_arrays(*(np.array(part, float) for part in given))
        return np.stack(self._maps[len(places)].transform(*places), -1)

    def to_geodetic(self, position: Any) -> tuple[np.ndarray, ...]:
        """Latitude and longitude in degrees, of positions (..., 3) also height in m: the inverse of `to_local`."""
        position = np.array(position, float)
        if position.shape[-1:] not in ((2,), (3,)) or not np.isfinite(position).all():
            raise InputError("LocalFrame.to_geodetic: positions must be finite metres of shape (..., 2) or (..., 3)")
        parts = np.moveaxis(position, -1, 0)
        found = self._maps[len(parts)].transform(*parts, direction="INVERSE")
        longitude, latitude, *height = (np.asarray(part) for part in found)
        return (latitude, longitude, *height)

    def axes(self, latitude: Any, longitude: Any) -> np.ndarray:
        """Axes east, north and up at places in degrees, as rows in this frame, shape (..., 3, 3).

        `velocity @ axes` takes a velocity (east, north, up) at the place into the frame.
        """
        return earth_axes(latitude, longitude) @ earth_axes(self.latitude, self.longitude).T


def check_place(what: str, latitude: Any, longitude: Any, height: Any) -> None:
    """Raise `InputError`, in the name of `what`, for places that are none on Earth."""
    try:
        phi, lam, h = (np.asarray(part, float) for part in (latitude, longitude, height))
    except (TypeError, ValueError):
        raise InputError(f"{what}: latitude, longitude and height must be numbers") from None
    if not ((np.abs(phi) <= 90).all() and (np.abs(lam) <= 360).all()):
        raise InputError(f"{what}: latitude must lie between -90 and 90 degrees, longitude between -360 and 360")
    if not (np.abs(h) <= EQUATOR).all():
        raise InputError(f"{what}: height must be metres above the ellipsoid, between -{EQUATOR:.0f} and {EQUATOR:.0f}")


def earth_axes(latitude: Any, longitude: Any) -> np.ndarray:
    """Axes east, north and up at places in degrees, as rows in earth-centred coordinates, shape (..., 3, 3)."""
    phi, lam = np.broadcast_arrays(np.deg2rad(latitude), np.deg2rad(longitude))
    east = np.stack([-np.sin(lam), np.cos(lam), np.zeros_like(lam)], -1)
    north = np.stack([-np.sin(phi) * np.cos(lam), -np.sin(phi) * np.sin(lam), np.cos(phi)], -1)
    up = np.stack([np.cos(phi) * np.cos(lam), np.cos(phi) * np.sin(lam), np.sin(phi)], -1)
    return np.stack([east, north, up], -2)
