"""Compiled kernels of this process: every one takes memory maps, of which the system allows a limited number."""

import threading
import time
from pathlib import Path

import jax

MAPS = Path("/proc/self/maps")
LIMIT = Path("/proc/sys/vm/max_map_count")
SHARE = 0.3  # of the limit above which all kernels are dropped
PAUSE = 1.0  # s between two looks

_looked = [0.0]
_looking = threading.Lock()


def maps() -> int:
    """Memory maps of this process, 0 where the system does not say."""
    try:
        return MAPS.read_bytes().count(b"\n")
    except OSError:
        return 0


def limit() -> int:
    """How many memory maps a process may have; the usual 65530 where the system does not say."""
    try:
        return int(LIMIT.read_text())
    except (OSError, ValueError):
        return 65530


def drop_if_many() -> None:
    """Drop all compiled kernels before the memory maps run out, past which XLA fails without a word.

    Called where a fit ends: a process that solves problem after problem of different forms never dies of them.
    """
    with _looking:
        if time.monotonic() - _looked[0] < PAUSE:
            return
        _looked[0] = time.monotonic()
        if maps() > SHARE * limit():
            jax.clear_caches()
