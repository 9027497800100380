"""Diffuse starts and precise data, up to (start / std)^2 = 1e18: against an orthogonal factorisation of all rows.

The reference stacks the prior of the whitened noises and the whitened data and takes Householder's QR in the widest
floating point that NumPy has; nothing of probcal's recursion or linear algebra is used. The recursion may lose
eps start / std, never its square: `LOSS` times that ratio bounds what is lost, 1e-6 at 1e18.
"""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
import worlds
from contracts import only

import probcal
from probcal import Bias, Channel, ConstantVelocity, Network, Node, Problem, geometry, sensor
from probcal.errors import InputError
from probcal.gaussian import recursion as rec

LOSS = 1e-15
EPOCHS, STD, SCALE = 12, 0.01, 0.1  # of data and of biases, in metres
WIDE = np.longdouble


def eliminate(columns, count):
    """The triangle that Householder reflections make of the first `count` columns, and the rest below it."""
    left = columns.astype(WIDE)
    for j in range(count):
        v = left[j:, j].copy()
        v[0] += np.copysign(np.sqrt(v @ v), v[0])
        left[j:] -= np.outer(v, (2 / (v @ v)) * (v @ left[j:]))
    return left[:count], left[count:, count:]


def inverse(upper):
    """Inverse of an upper triangle."""
    n = len(upper)
    found = np.zeros_like(upper)
    for j in reversed(range(n)):
        found[j] = (np.eye(n)[j] - upper[j, j + 1 :] @ found[j + 1 :]) / upper[j, j]
    return found


def response(F, L):
    """States (E n, E n) by whitened noises."""
    E, n, _ = F.shape
    found = np.zeros((E, n, E, n), WIDE)
    for k in range(E):
        found[k] = np.einsum("ij,jkl->ikl", F[k].astype(WIDE), found[k - 1]) if k else 0.0
        found[k, :, k] += L[k]
    return found.reshape(E * n, E * n)


@cache
def system(d, ratio, together, walk):
    """Motion, whitened rows of ranges with an offset each, and noises where they are linearised."""
    rng = np.random.default_rng(d)
    n, start = 2 * d, STD * np.sqrt(ratio)
    F, L = np.zeros((2, EPOCHS, n, n))
    L[0] = np.diag([start] * d + [0.01 * start] * d)
    F[1:] = np.kron([[1, 1], [0, 1]], np.eye(d))
    L[1:] = walk * np.kron(np.linalg.cholesky([[1 / 3, 1 / 2], [1 / 2, 1]]), np.eye(d))
    line = rng.normal(size=(EPOCHS, d + 2, d)) * 0.05 + rng.normal(size=(d + 2, d))
    H = np.zeros((EPOCHS, d + 2, n))
    H[:, :, :d] = line / np.linalg.norm(line, axis=2, keepdims=True) / STD
    B = np.broadcast_to(5.0 * np.eye(d + 2), (EPOCHS, d + 2, d + 2))
    if not together:
        seen = (np.arange(EPOCHS)[:, None] % (d + 2) == np.arange(d + 2))[:, :, None]
        H, B = H * seen, B * seen
    return F, L, H, B, rng.normal(size=(EPOCHS, d + 2)) * H.any(2), 0.3 * rng.normal(size=(EPOCHS, n))


def reference(F, L, H, B, y, u):
    """The linear problem solved: what `recursion` returns, and the square of what no unknown explains."""
    E, n, _ = F.shape
    size, M = E * n, B.shape[2]
    follow = response(F, L)
    rows = np.einsum("esi,eij->esj", H.astype(WIDE), follow.reshape(E, n, size)).reshape(-1, size)
    prior = np.hstack([np.eye(size), np.zeros((size, M)), -u.reshape(-1, 1)])
    data = np.hstack([rows, B.reshape(-1, M), y.reshape(-1, 1)])
    above, below = eliminate(np.vstack([prior, data]), size)
    spread = inverse(above[:, :size])
    solved = spread @ above[:, size:]
    states, roots = follow @ solved[:, M], follow @ spread
    return {
        "logdet": 2 * np.sum(np.log(np.abs(np.diag(above)))),
        "information": below[:, :M].T @ below[:, :M],
        "score": below[:, M] @ below[:, :M],
        "square": below[:, M] @ below[:, M],
        "states": states.reshape(E, n),
        "noises": u + solved[:, M].reshape(E, n),
        "response": (follow @ solved[:, :M]).reshape(E, n, M),
        "covariances": np.stack([root @ root.T for root in roots.reshape(E, n, size)]),
        "spread": np.stack([root @ root.T for root in spread.reshape(E, n, size)]),
        "forced": roots @ (roots.T @ np.ones(size)),
    }


@jax.jit
def recursion(F, L, H, B, y, u):
    """The same by the recursion, from rows compressed by epoch."""
    d = F.shape[1] // 2
    J, b, cross = H.mT @ H, H.mT @ y[:, :, None], H.mT @ B
    gain = rec.gains(F, L, J, tuple(range(d)))
    drift = jnp.pad(-(L @ u[:, :, None]), ((0, 0), (0, 0), (0, B.shape[2])))
    alone, new = rec.innovate(F, gain, jnp.concatenate([b, cross], 2), drift)
    whole = jnp.sum(new.mT @ new - alone.mT @ alone, 0)
    smoothed, response = rec.smooth(F, gain, b, drift[:, :, :1]), rec.smooth(F, gain, cross)
    covariances, spread = rec.covariances(F, L, gain)
    return {
        "logdet": gain.logdet,
        "information": jnp.sum(B.mT @ B, 0) + whole[1:, 1:],
        "score": jnp.sum(B.mT @ y[:, :, None], 0)[:, 0] + whole[1:, 0],
        "states": smoothed.states[:, :, 0],
        "noises": smoothed.noises[:, :, 0],
        "response": response.states,
        "covariances": covariances,
        "spread": spread,
        "forced": rec.respond(gain, covariances, jnp.ones_like(b)).reshape(-1),
        "free": rec.smooth(F, gain, jnp.ones_like(b), free=True).states.reshape(-1),
    }


@pytest.mark.parametrize("walk", [0.0, 0.01, 100.0])
@pytest.mark.parametrize("together", [True, False], ids=["together", "one at a time"])
@pytest.mark.parametrize("ratio", [1e8, 1e14, 1e18], ids="{:.0e}".format)
@pytest.mark.parametrize("d", [2, 3])
def test_recursion(d, ratio, together, walk):
    """All that the recursion returns, each in units of its posterior sd."""
    rows = system(d, ratio, together, walk)
    expected = reference(*rows)
    with jax.enable_x64(True):
        found = jax.tree.map(np.asarray, recursion(*rows))
    sd = np.sqrt(np.diagonal(expected["covariances"], axis1=1, axis2=2))
    width = np.sqrt(np.diagonal(np.linalg.inv((expected["information"] + np.eye(d + 2)).astype(float))))
    units = {
        "logdet": 1.0, "information": 1 / np.outer(width, width), "score": 1 / width, "states": sd, "noises": 1.0,
        "response": sd[:, :, None], "covariances": sd[:, :, None] * sd[:, None, :], "spread": 1.0,
        "forced": sd.reshape(-1) * np.max(np.abs(expected["forced"]) / sd.reshape(-1)),
    }  # fmt: skip
    for name, unit in units.items():
        lost = np.abs((found[name] - expected[name]) / unit).max()
        assert lost <= 3 * LOSS * np.sqrt(ratio), (name, float(lost))
    if ratio <= 1e8:  # beyond, a force on a state that is hardly known yet is a large number
        np.testing.assert_allclose(found["free"], expected["forced"].astype(float), rtol=1e-6)


@sensor(range=Channel("m", std=STD))
def ranging(target, pose, *, offset=Bias("m", SCALE)):
    return {"range": geometry.norm(target.position - pose.position) + offset}


@cache
def constellation(d, extent):
    """Stations, their ranges (epoch, station) to one target, the offsets of these, and the problem."""
    rng = np.random.default_rng(d)
    stations = extent * np.array([[0, 0, 0], [1, 0, 0.2], [0, 1, 0.5], [1, 1, 0], [0.4, 0.6, 1]])[: d + 2, :d]
    time = np.arange(float(EPOCHS))
    path = extent * np.stack([0.2 + 0.02 * time, 0.35 + 0.1 * np.sin(time / 5), 0.3 + 0.01 * time], 1)[:, :d]
    offset = SCALE * rng.normal(size=d + 2)
    measured = np.linalg.norm(path[:, None] - stations[None], axis=2) + offset
    measured = measured + STD * rng.normal(size=measured.shape)
    names = [f"s{k}" for k in range(d + 2)]
    table = {"time": np.repeat(time, d + 2), "sensor": names * EPOCHS, "range": measured.reshape(-1)}
    network = Network([ranging.on(Node(name, place)) for name, place in zip(names, stations, strict=True)])
    return stations, measured, offset, Problem(network, ConstantVelocity(extent / 500), pd.DataFrame(table))


@pytest.mark.ci
@pytest.mark.parametrize("extent", [1e4, 1e6], ids="{:.0e}".format)
@pytest.mark.parametrize("d", [2, pytest.param(3, marks=pytest.mark.ci)])
def test_fit(d, extent):
    """Ranges of 1 cm over 1000 km converge: offsets, their sds and the evidence are those of the factorised problem."""
    stations, measured, offset, problem = constellation(d, extent)
    tree = probcal.fit(problem, probcal.MAP())
    assert tree.attrs["status"] == "converged"
    assert "singular" not in tree.attrs["message"]
    part = problem.model.recursions[0]
    F, L, prior = (np.asarray(array) for array in (part.F, part.L, part.drift))
    assert L[0].max() >= 10 * extent
    mean, sd = (tree["calibration"][name].values for name in ("mean", "sd"))
    prior, states = prior.astype(WIDE), only(tree)["mean"].values.astype(WIDE)
    for k in range(1, EPOCHS):
        prior[k] += F[k].astype(WIDE) @ prior[k - 1]
    line = states[:, None, :d] - stations[None]
    length = np.sqrt(np.sum(line**2, 2))
    H = np.pad(line / length[:, :, None], ((0, 0), (0, 0), (0, d))) / STD
    B = np.broadcast_to(np.eye(d + 2) * SCALE / STD, (EPOCHS, d + 2, d + 2))
    y = (measured - length) / STD + np.einsum("esi,ei->es", H, states - prior)
    expected = reference(F, L, H, B, y, np.zeros((EPOCHS, 2 * d)))
    matrix = (expected["information"] + np.eye(d + 2)).astype(float)
    solved = np.linalg.solve(matrix, expected["score"].astype(float))
    evidence = -0.5 * (expected["square"] - expected["score"] @ solved + expected["logdet"])
    evidence += -0.5 * np.linalg.slogdet(matrix)[1] - measured.size * np.log(STD * np.sqrt(2 * np.pi))
    assert tree.attrs["log_evidence"] == pytest.approx(float(evidence), abs=1e-6)
    np.testing.assert_allclose(mean / SCALE, solved, rtol=0, atol=1e-5 * (sd / SCALE).min())
    np.testing.assert_allclose(sd / SCALE, np.sqrt(np.diag(np.linalg.inv(matrix))), rtol=1e-6)
    spread = np.sqrt(np.diagonal(expected["covariances"], axis1=1, axis2=2))
    assert (only(tree)["sd"].values >= spread * (1 - 1e-6)).all()
    assert (np.abs(mean - offset) < 4.0 * sd).all()


def spread(survey):
    """Three nodes that know their own places to so many metres and see one target."""
    nodes = [Node(f"n{k}", place, survey=survey) for k, place in enumerate([(0.0, 0.0), (90.0, 5.0), (30.0, 70.0)])]
    network, times = Network([probcal.sensors.position.on(node) for node in nodes]), np.arange(4.0)
    path = np.stack([10.0 + 4.0 * times, 20.0 + 2.0 * times], 1)
    run = probcal.simulate(network, ConstantVelocity(1.0), times, key=0, biases={}, tracks={"target": path})
    return Problem(network, ConstantVelocity(1.0), run.table)


def test_a_start_is_wider_than_the_nodes_are_known_and_no_scale_is_lost_in_rounding():
    for survey, start in ((1.0, 10 * spread(1.0).extent), (1e4, 5e4), (1e6, 5e6)):
        area = spread(survey).area
        assert area.wide * area.extent == pytest.approx(start)
    with pytest.raises(InputError, match="noise of its sensors: more than the rounding of numbers allows"):
        spread(1e12)


@pytest.mark.ci
@pytest.mark.parametrize("survey", [1e4, 1e6])
def test_the_start_of_a_target_does_not_hold_a_network_that_nothing_else_holds(survey):
    problem = spread(survey)
    group = probcal.fit(problem, probcal.MAP(), start=worlds.resting(problem))["calibration"].to_dataset()
    along = [m for m, bias in enumerate(problem.biases) if bias.axis == 0]
    shift = np.sqrt(group["covariance"].values[np.ix_(along, along)].mean())
    assert shift == pytest.approx(survey / np.sqrt(3), rel=8e-3)
    assert group["gamma"].values == pytest.approx(2 / 3, abs=5e-3)
