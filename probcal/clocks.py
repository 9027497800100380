"""Rows that were measured at another time than the stated one: sensors read at the time of their node's clock.

The time of a row is free: stated plus `time_offset` plus `time_rate` times the seconds since the first row. It has an
epoch of its own, which `Problem.retimed` moves; `Problem.lateness` is what is left from that epoch to the row.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

from probcal.sensor import SensorType
from probcal.types import RATES

CLOCK = ("time_offset", "time_rate")  # components of a node, in s and s per s


def by_clock(kind: SensorType, *, moving: bool) -> SensorType:
    """The sensor type read at the time of its first node's clock, whatever its function reads.

    A function that reads `pose.time_offset` and moves its target itself, `target.at(pose.time_offset)`, goes on doing
    so. One that does without `at` means something else by it, and is left as it is; so is one that reads no target.
    With `moving` nodes these go on along their paths too.
    """
    own = "time_offset" in kind.pose_components
    if not kind.reads_target or kind.clocked or (own and "at" not in kind.target_components):
        return kind
    path = set(RATES.values()) if moving and not own else set[str]()
    return replace(
        kind,
        function=partial(_late, kind.function, own),
        target_components=kind.target_components | {"at"},
        pose_components=kind.pose_components | {*CLOCK, "time", *path},
        clocked=True,
    )


def _late(
    function: Callable[..., Mapping[str, Any]], own: bool, target: Any, pose: Any, *others: Any, **biases: Any
) -> Mapping[str, Any]:
    """The sensor function at the time of the clock, or with that time told where it moves its target itself."""
    late = pose.time_offset + pose.time_rate * pose.time
    here = {"time": pose.time + late, "time_offset": late}
    if own:
        return function(target, pose.at(0.0, **here), *others, **biases)
    return function(target.at(late), pose.at(late, **here), *(other.at(late) for other in others), **biases)
