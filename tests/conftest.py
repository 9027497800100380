"""Severe numerics for every test: rank promotion raises, warnings are errors; x64 stays off as for a user."""

import jax
import pytest
from hypothesis import settings

settings.register_profile("probcal", deadline=None, max_examples=10, derandomize=True, print_blob=False)
settings.load_profile("probcal")


@pytest.fixture(scope="session", autouse=True)
def severe_numerics():
    before = jax.config.jax_numpy_rank_promotion
    jax.config.update("jax_numpy_rank_promotion", "raise")
    assert not jax.config.jax_enable_x64, "tests run as a user would: the package enters float64 by itself"
    yield
    jax.config.update("jax_numpy_rank_promotion", before)
