"""Severe numerics for every test: rank promotion raises, warnings are errors; x64 stays off as for a user.

The tests compile hundreds of small kernels and run each once: they ask XLA for quick compilation, drop compiled
kernels after each file, and share them between workers, notebooks and command lines through a folder of the run.
"""

import atexit
import os
import shutil
import tempfile
from pathlib import Path

os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true")
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:  # set here, inherited by workers and subprocesses
    os.environ["JAX_COMPILATION_CACHE_DIR"] = tempfile.mkdtemp(prefix="probcal-kernels-")
    atexit.register(shutil.rmtree, os.environ["JAX_COMPILATION_CACHE_DIR"], ignore_errors=True)
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.1")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "0")

import jax
import pytest
from hypothesis import settings

MOST_MAPS = 20_000

settings.register_profile("probcal", deadline=None, max_examples=10, derandomize=True, print_blob=False)
settings.load_profile("probcal")


@pytest.fixture(scope="session", autouse=True)
def severe_numerics():
    before = jax.config.jax_numpy_rank_promotion
    jax.config.update("jax_numpy_rank_promotion", "raise")
    assert not jax.config.jax_enable_x64, "tests run as a user would: the package enters float64 by itself"
    yield
    jax.config.update("jax_numpy_rank_promotion", before)


@pytest.fixture(scope="module", autouse=True)
def few_kernels():
    yield
    jax.clear_caches()


@pytest.fixture(autouse=True)
def few_maps():
    """Every compiled kernel takes memory maps, of which a process has 65530: past them XLA fails without a word."""
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > MOST_MAPS:
        jax.clear_caches()
