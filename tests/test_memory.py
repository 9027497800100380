"""Noise with a memory: a state for each sensor and target, exact against a dense Gaussian."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from scipy import stats
from worlds import resting

from probcal import (
    MAP,
    Bias,
    Censored,
    Channel,
    ConstantVelocity,
    Gaussian,
    Known,
    LeastSquares,
    Network,
    Node,
    Problem,
    StudentT,
    Target,
    Unknown,
    fit,
    sensor,
    simulate,
)
from probcal.errors import InputError
from probcal.gaussian.linearised import laplace
from probcal.gaussian.mode import find_mode
from probcal.noise import Bernoulli, Memory
from probcal.priors import Precision

MEMORY, WHITE, EAST, SCALE = Memory(0.3, 2.0), 0.1, 0.2, 0.5


@sensor(height=Channel("m", std=WHITE, memory=MEMORY), east=Channel("m", std=EAST))
def level(target, pose, *, shift=Bias("m", SCALE)):
    place = target.position - pose.position
    return {"height": place[1] + shift, "east": place[0]}


@sensor(north=Channel("m", std=EAST))
def plain(target, pose, *, shift=Bias("m", SCALE)):
    return {"north": target.position[1] - pose.position[1] + shift}


def gathered(dimension):
    """Rows of three sensors at times of their own on two known targets, some cells missing; the problem of them."""
    rng, rows = np.random.default_rng(3), []
    none = (0.0,) * dimension
    network = Network([level.on(Node("a", none)), level.on(Node("b", none)), plain.on(Node("c", none))])
    tracks = {name: (np.array([0.0, 20.0]), rng.normal(size=(2, dimension))) for name in ("one", "two")}
    for target in tracks:
        for name, own in (("a", 0.0), ("b", 0.3), ("c", 0.0)):
            for t in np.sort(rng.uniform(0, 20, 12)) if own == 0.0 else np.arange(0.0, 12.0):
                rows.append((t, name, target, *rng.normal(size=3)))
    table = pd.DataFrame(rows, columns=["time", "sensor", "target", "height", "east", "north"])
    table.loc[table["sensor"] == "c", ["height", "east"]] = np.nan
    table.loc[table["sensor"] != "c", "north"] = np.nan
    table.loc[rng.random(len(table)) < 0.2, "height"] = np.nan
    table = table.dropna(how="all", subset=["height", "east", "north"]).sort_values("time", kind="stable")
    motion = {name: Target(Known(track)) for name, track in tracks.items()}
    return Problem(network, motion, table), table, tracks


def dense(table, tracks):
    """Log density of all data: known paths, Gaussian offsets, white and remembered noise, as one covariance."""
    data = table.melt(["time", "sensor", "target"], ["height", "east", "north"], "channel").dropna()
    time, sensors, targets, channel = (data[name].to_numpy() for name in ("time", "sensor", "target", "channel"))
    axis = np.where(channel == "east", 0, 1)
    mean = [np.interp(t, tracks[own][0], tracks[own][1][:, a]) for t, own, a in zip(time, targets, axis, strict=True)]
    same = sensors[:, None] == sensors
    shifted = channel != "east"
    K = SCALE**2 * (same & shifted[:, None] & shifted)
    held = same & (targets[:, None] == targets) & (channel == "height")[:, None] & (channel == "height")
    K = K + held * MEMORY.std**2 * np.exp(-np.abs(time[:, None] - time) / MEMORY.time)
    K = K + np.diag(np.where(channel == "height", WHITE, EAST) ** 2)
    return stats.multivariate_normal.logpdf(data["value"].to_numpy(), np.array(mean), K), K, data, np.array(mean)


@pytest.mark.ci
@pytest.mark.parametrize("dimension", [2, 3])
def test_evidence_and_offsets_are_those_of_the_dense_covariance(dimension):
    problem, table, tracks = gathered(dimension)
    expected, K, data, mean = dense(table, tracks)
    with jax.enable_x64(True):
        prior = Precision(jnp.ones(problem.model.biases))
        point = find_mode(problem.model, resting(problem), prior, 30, 1e-12).point
        found = laplace(problem.model, point, prior)
        z = np.asarray(point.z)
    assert float(found.evidence) == pytest.approx(expected, rel=1e-9)
    own = [(data["sensor"] == label.split(".")[0]) & (data["channel"] != "east") for label in problem.labels]
    cross = SCALE**2 * np.stack(own).astype(float)
    gain = cross @ np.linalg.inv(K)
    np.testing.assert_allclose(z * SCALE, gain @ (data["value"].to_numpy() - mean), rtol=1e-6, atol=1e-8)
    spread = SCALE**2 * np.eye(len(own)) - gain @ cross.T
    np.testing.assert_allclose(np.asarray(found.covariance) * SCALE**2, spread, rtol=1e-6, atol=1e-9)


def test_draws_have_the_memory_and_the_size():
    """Residuals of known paths at 0.5 s: their variance, and their correlation 0.5 and 5 s apart."""
    network = Network([level.on(Node(f"a{k}", (0.0, 0.0))) for k in range(20)])
    time = np.arange(0.0, 400.0, 0.5)
    path = Known(([0.0, 400.0], [(0.0, 0.0), (0.0, 0.0)]))
    biases = {f"a{k}.shift": 0.0 for k in range(20)}
    table = simulate(network, path, time, key=0, biases=biases).table
    wide = table.pivot(index="time", columns="sensor", values="height").to_numpy()
    whole = MEMORY.std**2 + WHITE**2
    assert np.mean(wide**2) == pytest.approx(whole, rel=0.05)  # 20 * 400 / 4 independent: sd 3 %
    for lag, apart in ((1, 0.5), (10, 5.0)):
        own = np.mean(wide[lag:] * wide[:-lag])
        assert own == pytest.approx(MEMORY.std**2 * np.exp(-apart / MEMORY.time), abs=0.1 * MEMORY.std**2)
    east = table.pivot(index="time", columns="sensor", values="east").to_numpy()
    assert abs(np.mean(east[1:] * east[:-1])) < 0.05 * EAST**2, "a channel without a memory has none"


@cache
def recorded(memory, std):
    """Ten minutes of five sensors with offsets, their remembered noise 0.3 m: the problem with unknown levels."""
    network = Network([level.on(Node(f"a{k}", (10.0 * k, 0.0))) for k in range(5)])
    start = {"position": ((0.0, 0.0), 5.0), "velocity": ((0.0, 0.0), 1.0)}
    motion = Target(ConstantVelocity(0.05), start)
    run = simulate(network, motion, np.arange(0.0, 120.0, 0.5), key=4)

    @sensor(height=Channel("m", std=std, memory=memory), east=Channel("m", std=EAST))
    def again(target, pose, *, shift=Bias("m", SCALE)):
        place = target.position - pose.position
        return {"height": place[1] + shift, "east": place[0]}

    other = Network([again.on(Node(f"a{k}", (10.0 * k, 0.0))) for k in range(5)])
    return Problem(other, motion, run.table), run


@pytest.mark.slow
def test_the_levels_of_white_and_remembered_noise_are_learnt_apart():
    problem, run = recorded(Memory(Unknown(0.1), 2.0), Unknown(0.2))
    assert [own.label for own in problem.levels] == ["again.height_memory_std", "again.height_std"]
    tree = fit(problem, MAP(), prior=Gaussian())
    found = tree["level"].to_dataset()["std"].to_series()
    # 300 independent of the remembered part: sd 4 %; 1200 of the white one
    assert found["again.height_memory_std"] == pytest.approx(MEMORY.std, rel=0.2)
    assert found["again.height_std"] == pytest.approx(WHITE, rel=0.2)
    assert "a0.height_memory" in tree["track/target"].component.values
    calibration = tree["calibration"].to_dataset()
    for label, value in run.truth.biases.items():
        own = calibration.sel(bias_label=label)
        assert abs(float(own["mean"]) - value) < 4 * float(own["sd"])
    free = fit(problem, LeastSquares())
    assert np.isfinite(free["calibration"].to_dataset()["mean"].values).all()


def test_each_sensor_may_remember_at_its_own_level():
    problem, _ = recorded(Memory(Unknown(0.1, by="sensor"), 2.0), 0.1)
    assert [own.label for own in problem.levels] == [f"a{k}.height_memory_std" for k in range(5)]


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: Memory(0.3, 0.0), r"Memory\(time=0.0\): the correlation time must be positive"),
        (lambda: Memory(-0.3, 1.0), "Memory: std is -0.3: it must be positive"),
        (lambda: Channel("m", memory=2.0), r"memory=2.0\): give Memory\(std, time\)"),
        (lambda: Channel("1", noise=Bernoulli(), memory=MEMORY), "with noise that is additive"),
        (lambda: Channel("dB", noise=Censored(-90.0), memory=MEMORY), "a floor has no memory"),
    ],
)
def test_a_memory_that_is_none_is_refused(make, says):
    with pytest.raises(InputError, match=says):
        make()


def test_noise_with_a_memory_may_have_heavy_tails():
    assert Channel("m", noise=StudentT(4), memory=MEMORY).memory == MEMORY
