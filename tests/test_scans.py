"""Epochs in parallel beside epochs one after the other: every array that the recursion leaves, and a whole fit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import worlds

import probcal as pc
from probcal.gaussian import recursion as rec
from probcal.gaussian import scans


def drawn(seed, n, u, wide):
    """Transitions, noise factors, information and columns of three targets that follow each other, 13 epochs."""
    rng = np.random.default_rng(seed)
    E, m = 13, 3
    F = np.eye(n) + 0.3 * rng.standard_normal((E, n, n)) / n
    L = 0.3 * np.tril(rng.standard_normal((E, n, n)))
    L[:, :, -1] *= rng.integers(0, 2, (E, 1))  # noise that does not reach all of the state
    for first in (0, 5, 6):
        F[first], L[first] = 0.0, wide * np.eye(n)
    root = rng.standard_normal((E, u, u)) * rng.integers(0, 2, (E, 1, 1))  # epochs without data
    root[8:10, :, -1] = 0.0  # fewer data than entries
    used = tuple(range(u))
    J = np.zeros((E, n, n))
    J[:, :u, :u] = root @ root.transpose(0, 2, 1)
    b = np.zeros((E, n, m))
    b[:, :u] = root @ rng.standard_normal((E, u, m))
    return (*map(jnp.asarray, (F, L, J, b, rng.standard_normal((E, n, m)))), used)


def everything(F, L, J, b, c, used):
    """What the recursion makes of a problem; roots as what they are roots of."""
    gain = rec.gains(F, L, J, used)
    smooth, free = rec.smooth(F, gain, b, c), rec.smooth(F, gain, c, free=True)
    states, noises = rec.covariances(F, L, gain)
    return {
        "predicted": gain.predicted @ gain.predicted.mT, "updated": gain.updated @ gain.updated.mT, "gain": gain.gain,
        "back": gain.back, "drive": gain.drive, "logdet": gain.logdet, "states": smooth.states, "free": free.states,
        "noises": smooth.noises, "covariance": states, "of noises": noises, "joint": rec.respond(gain, states, b),
        "path": rec.trajectory(F, L, c, b),
    }  # fmt: skip


@pytest.mark.parametrize(
    ("n", "u", "wide"),
    [(4, 2, 1.0), pytest.param(4, 4, 1.0, marks=pytest.mark.ci), pytest.param(6, 3, 1e4, marks=pytest.mark.ci)],
)
def test_epochs_in_parallel_leave_what_one_after_the_other_do(n, u, wide, monkeypatch):
    """To 1e-9 of the largest entry; where starts are ten thousand wide, to 1e-6."""
    with jax.enable_x64(True):
        given, found = drawn(n + u, n, u, wide), {}
        for parallel in (False, True):
            monkeypatch.setattr(scans, "PARALLEL", parallel)
            found[parallel] = jax.jit(lambda *arrays: everything(*arrays, given[-1]))(*given[:-1])
            found[parallel] = jax.device_get(found[parallel])
    for name, wanted in found[False].items():
        size = np.abs(wanted).max()
        np.testing.assert_allclose(
            found[True][name] / size, wanted / size, atol=1e-9 if wide == 1.0 else 1e-6, err_msg=name
        )


def test_it_follows_the_backend_unless_told(monkeypatch):
    assert not scans.in_parallel()
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert scans.in_parallel()
    monkeypatch.setattr(scans, "PARALLEL", False)
    assert not scans.in_parallel()


@pytest.mark.slow
def test_a_fit_with_epochs_in_parallel_is_the_same(monkeypatch):
    """Means and sds of all biases to 1e-8 sds."""
    problem, _ = worlds.linear("plane")
    found = {}
    for parallel in (False, True):
        monkeypatch.setattr(scans, "PARALLEL", parallel)
        jax.clear_caches()
        group = pc.fit(problem, pc.MAP(), prior=pc.Gaussian(), start=worlds.resting(problem))["calibration"]
        found[parallel] = group["mean"].values, group["sd"].values
    jax.clear_caches()
    np.testing.assert_allclose(found[True][0] / found[False][1], found[False][0] / found[False][1], atol=1e-8)
    np.testing.assert_allclose(found[True][1], found[False][1], rtol=1e-8)
