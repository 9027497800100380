"""Distances between sets of objects: OSPA and generalised OSPA, with what is missed and what is false."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from probcal.errors import InputError


class Gospa(NamedTuple):
    """Means over instants: GOSPA in m, and of its parts the error in place in m, and objects missed and false."""

    distance: float
    place: float
    missed: float
    false: float
    ospa: float


def gospa(found: Any, true: Any, cut: float = 20.0) -> Gospa:
    """GOSPA (order 2, alpha 2) of places against true ones, instant by instant; both are lists of arrays (n, d) in m.

    A pair further apart than `cut` counts as one object missed and one false (Rahmathullah, Garcia-Fernandez, Svensson
    2017); OSPA (Schuhmacher, Vo, Vo 2008) with the same cut comes with it. Raises `InputError` for lists that differ in
    length, and a cut that is not positive.

    >>> gospa([[(0.0, 0.0), (90.0, 0.0)]], [[(3.0, 4.0)]])
    Gospa(distance=15.0, place=5.0, missed=0.0, false=1.0, ospa=14.577379737113251)
    """
    from scipy.optimize import linear_sum_assignment

    if len(found) != len(true) or not len(true):
        raise InputError(f"gospa: {len(found)} instants found, {len(true)} true; give the same instants, one or more")
    if not cut > 0:
        raise InputError(f"gospa(cut={cut}): the cut is a distance in m above 0")
    rows = []
    for mine, own in zip(found, true, strict=True):
        x, y = (np.asarray(v, float).reshape(len(v), -1 if len(v) else 1) for v in (mine, own))
        n, m = len(x), len(y)
        square = np.zeros((n, m))
        if n and m:
            square = np.minimum(((x[:, None] - y[None]) ** 2).sum(2), cut**2)
        pairs = linear_sum_assignment(square)
        near = square[pairs] < cut**2
        placed = float(square[pairs][near].sum())
        missed, false = m - near.sum(), n - near.sum()
        ospa = np.sqrt((square[pairs].sum() + cut**2 * abs(n - m)) / max(n, m, 1))
        distance = np.sqrt(placed + 0.5 * cut**2 * (missed + false))
        rows.append((distance, np.sqrt(placed / max(near.sum(), 1)), missed, false, ospa))
    return Gospa(*(float(v) for v in np.mean(rows, 0)))
