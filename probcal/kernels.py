"""Compiled kernels: kept in a folder between processes, and dropped before memory maps run out in
one of them.

What is kept is what XLA made of a kernel; a process traces and lowers it again, a third of a main job with kept
kernels. Executables kept whole (`jax.experimental.serialize_executable`) crash on CPUs with jaxlib 0.12, and lowered
forms (`jax.export`) saved a tenth of the main job and need another library: neither is used.
"""

import os
import threading
import time
from functools import cache
from pathlib import Path

import jax
import platformdirs
from jax.experimental.compilation_cache import compilation_cache

MAPS = Path("/proc/self/maps")
LIMIT = Path("/proc/sys/vm/max_map_count")
SHARE = 0.3  # of the limit above which all kernels are dropped
PAUSE = 1.0  # s between two looks

KEPT = 10**9  # bytes of kernels that stay in the user's cache folder, the latest ones

_looked = [0.0]
_looking = threading.Lock()


@cache
def keep_kernels() -> None:
    """From the first call on, keep every kernel that jax compiles in the user's cache folder.

    Nothing changes where jax has a folder already (`JAX_COMPILATION_CACHE_DIR`), where its cache is
    off, where `PROBCAL_NO_CACHE` is set, and where the folder cannot be written.
    """
    off = os.environ.get("PROBCAL_NO_CACHE") or not jax.config.jax_enable_compilation_cache
    if off or jax.config.jax_compilation_cache_dir:
        return
    folder = platformdirs.user_cache_path("probcal") / "kernels"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return
    if not os.access(folder, os.W_OK):
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_compilation_cache_max_size", KEPT)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)
    compilation_cache.reset_cache()  # jax decides once per process, when it first compiles


def maps() -> int:
    """Memory maps of this process, 0 where the system does not say."""
    try:
        return MAPS.read_bytes().count(b"\n")
    except OSError:
        return 0


def limit() -> int:
    """The number of memory maps a process may have; the usual 65530 where the system does not say."""
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
