"""Relations that hold on nonlinear networks whatever the numbers: shift, rotate, rename, split, permute.

Estimates are compared in z (units of the prior scale) to 1e-6, where sds are of order 0.1 to 1. The biases
compared are checked not to be near zero, and the mode is searched from the start prior alone.
"""

from dataclasses import dataclass, replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from bent import WORLDS, turn
from hypothesis import given, settings
from hypothesis import strategies as st
from worlds import resting

import probcal
from probcal import Bias, Channel, sensor
from probcal.gaussian.dense import DenseEngine
from probcal.gaussian.linearised import laplace
from probcal.gaussian.mode import find_mode
from probcal.geometry import norm
from probcal.modes.recognise import seen_directions
from probcal.priors import Precision

TOLERANCE = 1e-6  # in z, and in metres for tracks of sd near one metre
AXES = "xyz"


worlds = pytest.mark.parametrize(
    "name", ["plane", *(pytest.param(n, marks=pytest.mark.ci) for n in ("waves", "space"))]
)
few = settings(max_examples=8)
angles = st.floats(-4.0, 4.0)
lengths = st.floats(-500.0, 500.0)


@dataclass(frozen=True)
class Estimate:
    """What is compared: biases by label (in z), states by (target, time, component), log evidence."""

    mean: dict
    sd: dict
    states: dict
    state_sd: dict
    evidence: float


@jax.jit
def solved(model, start):
    """Whether the mode was reached, its point, covariance and evidence, and the variance of every state."""
    alone = Precision(jnp.ones(model.biases))
    mode = find_mode(model, start, alone, 500, 1e-11)
    found = laplace(model, mode.point, alone)
    variances = DenseEngine().at(model, mode.point).variances(found.covariance)
    return mode.converged, mode.point, found.covariance, found.evidence, variances


def estimate(problem):
    """The joint mode and its Laplace moments, searched from the start prior: no grid, no truth, no seed."""
    with jax.enable_x64(True):
        found = solved(problem.model, resting(problem))
    converged, point, covariance, evidence, variances = jax.tree.map(np.asarray, found)
    assert converged
    value, sd = {}, {}
    for x, variance, epochs in zip(point.states, variances, problem.epochs, strict=True):
        for e, (time, target) in enumerate(zip(epochs.time, epochs.target, strict=True)):
            for k, component in enumerate(epochs.components):
                value[str(target), float(time), component] = float(x[e, k])
                sd[str(target), float(time), component] = float(np.sqrt(variance[e, k]))
    z, z_sd = point.z, np.sqrt(np.diag(covariance))
    assert np.abs(z).max() > 0.3, "nothing to compare: every bias is near zero"
    assert z_sd.min() > 1e3 * TOLERANCE, "a tolerance wider than the quantity"
    means, sds = (dict(zip(problem.labels, values, strict=True)) for values in (z, z_sd))
    return Estimate(means, sds, value, sd, float(evidence))


@cache
def base(name):
    """A world, its simulated table (some cells blank) and its estimate."""
    world = WORLDS[name]()
    true = {"r0.range_offset": 25.0, "r1.range_offset": -25.0, "r1.position_x": 12.0, "r1.heading": 0.25}
    biases = true if name == "pair" else None  # else drawn from their scales
    time = np.array(world.time)
    table = probcal.simulate(world.network(), world.motion(), time, key=5, biases=biases, missing=0.1).table
    return world, table, estimate(world.problem(table))


def same(found, expected, tolerance=TOLERANCE):
    assert found.keys() == expected.keys()
    worst = max(found, key=lambda key: abs(found[key] - expected[key]))
    a, b = found[worst], expected[worst]
    assert abs(a - b) < tolerance, f"{worst}: {a} against {b}"


def same_estimate(found, expected):
    same(found.mean, expected.mean)
    same(found.sd, expected.sd)
    same(found.states, expected.states)
    same(found.state_sd, expected.state_sd)
    assert found.evidence == pytest.approx(expected.evidence, abs=1e-6)


@worlds
@few
@given(shift=st.floats(-1e5, 1e5))
def test_shifting_time_changes_nothing(name, shift):
    world, table, expected = base(name)
    found = estimate(world.problem(table.assign(time=table["time"] + shift)))
    states = {(k, round(t - shift, 6), c): v for (k, t, c), v in found.states.items()}
    spread = {(k, round(t - shift, 6), c): v for (k, t, c), v in found.state_sd.items()}
    same_estimate(replace(found, states=states, state_sd=spread), expected)


@worlds
@few
@given(angle=angles, shift=st.tuples(lengths, lengths, lengths))
def test_moving_and_turning_the_world(name, angle, shift):
    """Tracks and position biases turn with the world; every scalar bias, its sd and the evidence stay."""
    world, table, expected = base(name)
    shift = np.array(shift[: len(world.nodes[0]["position"])])
    found = estimate(world.moved(angle, shift).problem(table))
    same(vectors(found.mean, 0.0, 0.0), vectors(expected.mean, angle, 0.0))
    same(vectors(found.states, 0.0, 0.0), vectors(expected.states, angle, shift))
    scalar = [label for label in expected.sd if label[-2:] not in ("_x", "_y")]
    same({k: found.sd[k] for k in scalar}, {k: expected.sd[k] for k in scalar})
    assert found.evidence == pytest.approx(expected.evidence, abs=1e-6)


def vectors(values, angle, shift):
    """Turn every vector (keys that end in _x, _y, _z) of a dict by angle and shift its positions."""
    turned = dict(values)
    for key in values:
        text = key if isinstance(key, str) else key[-1]
        if not text.endswith("_x"):
            continue
        keys = [k for k in (with_axis(key, a) for a in AXES) if k in values]
        vector = turn([values[k] for k in keys], angle)
        vector = vector + shift if text == "position_x" else vector
        turned |= dict(zip(keys, vector, strict=True))
    return turned


def with_axis(key, axis):
    return key[:-1] + axis if isinstance(key, str) else (*key[:-1], key[-1][:-1] + axis)


@pytest.mark.parametrize("name", ["plane", pytest.param("space", marks=pytest.mark.ci)])
@few
@given(data=st.data())
def test_whole_turns_change_nothing(name, data):
    world, table, expected = base(name)
    turns = data.draw(st.lists(st.integers(-3, 3), min_size=len(table), max_size=len(table)))
    turned = table.assign(azimuth=table["azimuth"] + 2 * np.pi * np.array(turns))
    same_estimate(estimate(world.problem(turned)), expected)


@worlds
@few
@given(seed=st.integers(0, 1000))
def test_the_order_of_rows_changes_nothing(name, seed):
    world, table, expected = base(name)
    same_estimate(estimate(world.problem(table.sample(frac=1, random_state=seed))), expected)


@worlds
@few
@given(seed=st.integers(0, 1000))
def test_renaming_and_reordering(name, seed):
    """Nodes, sensors and targets renamed, sensors of a type reordered: results follow the names."""
    world, table, expected = base(name)
    random = np.random.default_rng(seed)
    own = sorted({n["name"] for n in world.nodes} | {s for _, _, s in world.placed} | set(world.starts))
    shuffled = random.permutation([f"q{k}" for k in range(len(own))])
    names = dict(zip(own, (str(n) for n in shuffled), strict=True))
    kinds = list(dict.fromkeys(kind for kind, _, _ in world.placed))
    placed = []
    for kind in kinds:  # the order of types is the order of compiled blocks; it stays
        mine = [p for p in world.placed if p[0] is kind]
        placed += [mine[k] for k in random.permutation(len(mine))]
    renamed = table.assign(sensor=table["sensor"].map(names))
    if "target" in table:
        renamed["target"] = table["target"].map(names)
    other = replace(world, placed=tuple(placed), names=names)
    found = estimate(other.problem(renamed.sample(frac=1, random_state=seed)))
    shared = {kind.name for kind in kinds}
    back = {new: old for old, new in names.items()}

    def label(text):
        owner, bias = text.split(".")
        return text if owner in shared else f"{back[owner]}.{bias}"

    same({label(k): v for k, v in found.mean.items()}, expected.mean)
    same({label(k): v for k, v in found.sd.items()}, expected.sd)
    same({(back[k], t, c): v for (k, t, c), v in found.states.items()}, expected.states)
    assert found.evidence == pytest.approx(expected.evidence, abs=1e-6)


def test_a_header_unit_equals_the_channels_own():
    """Degrees, kilometres and milliseconds in the header against radians, metres and seconds."""
    world, table, expected = base("plane")
    written = table.assign(azimuth=np.rad2deg(table["azimuth"]))
    written = written.assign(range=table["range"] / 1e3, time=table["time"] * 1e3)
    written = written.rename(columns={"azimuth": "azimuth [deg]", "range": "range [km]", "time": "time [ms]"})
    same_estimate(estimate(world.problem(written)), expected)


@pytest.mark.ci
def test_splitting_a_row_into_its_channels_changes_nothing():
    world, table, expected = base("pair")
    parts = [table.assign(azimuth=np.nan), table.assign(range=np.nan)]
    split = pd.concat(parts, ignore_index=True)
    same_estimate(estimate(world.problem(split)), expected)


@pytest.mark.ci
def test_a_blank_row_equals_no_row():
    """Rows without values at times of their own: the epochs appear, nothing else changes."""
    world, table, expected = base("pair")
    blank = table.iloc[[0, 1]].assign(range=np.nan, azimuth=np.nan)
    blank.loc[blank.index[0], "time"] = 2.5
    blank.loc[blank.index[1], ["time", "sensor"]] = [7.25, "r1"]
    found = estimate(world.problem(pd.concat([table, blank], ignore_index=True)))
    same(found.mean, expected.mean)
    same(found.sd, expected.sd)
    new = {time for _, time, _ in found.states} - {time for _, time, _ in expected.states}
    assert new == {2.5, 7.25}
    same({k: v for k, v in found.states.items() if k[1] not in new}, expected.states)
    same({k: v for k, v in found.state_sd.items() if k[1] not in new}, expected.state_sd)
    assert found.evidence == pytest.approx(expected.evidence, abs=1e-6)


def test_a_row_of_weight_zero_moves_no_start():
    table = pd.DataFrame({"time": np.arange(8.0), "sensor": ["r0", "r1"] * 4, "range": 40.0, "azimuth": 0.5})
    absurd = table.iloc[:2].assign(time=[2.5, 9.0], range=1e4, azimuth=1.5, weight=0.0)
    network, motion = WORLDS["pair"]().network(), probcal.ConstantVelocity(1.0)
    plain, more = (probcal.Problem(network, motion, rows) for rows in (table, pd.concat([table, absurd])))
    assert more.extent == plain.extent
    np.testing.assert_array_equal(more.model.recursions[0].L[0], plain.model.recursions[0].L[0])
    for found, told in zip(seen_directions(more), seen_directions(plain), strict=True):
        np.testing.assert_array_equal(found.time, told.time)


@sensor(range=Channel("km", std=0.01), azimuth=Channel("deg", std=10.0, wrap=True))
def radar_km(target, pose, *, range_offset=Bias("km", 0.01)):
    """The catalogue's radar with its range in kilometres and its angle in degrees."""
    line = target.position - pose.position
    angle = jnp.arctan2(line[1], line[0]) - pose.heading
    return {"range": norm(line) / 1e3 + range_offset, "azimuth": jnp.rad2deg(angle)}


@pytest.mark.ci
def test_units_of_a_declaration():
    """Ranges and offsets in km, angles in degrees: the same z, tracks in metres."""
    world, table, expected = base("pair")
    placed = tuple((radar_km, on, name) for _, on, name in world.placed)
    written = table.assign(range=table["range"] / 1e3, azimuth=np.rad2deg(table["azimuth"]))
    problem = replace(world, placed=placed).problem(written)
    assert {b.unit for b in problem.biases} == {"m", "rad", "km"}
    found = estimate(problem)
    same(found.mean, expected.mean)
    same(found.sd, expected.sd)
    same(found.states, expected.states)
    counts = table[["range", "azimuth"]].notna().sum()
    jacobian = counts["range"] * np.log(1e3) - counts["azimuth"] * np.log(180 / np.pi)
    assert found.evidence == pytest.approx(expected.evidence + jacobian, abs=1e-6)


@pytest.mark.ci
def test_the_fit_as_a_whole():
    """`fit` with its automatic start: a moved and turned world in shuffled rows has the same calibration."""
    world, table, expected = base("pair")
    method = probcal.MAP(tolerance=1e-9, trajectory="joint")
    for angle, shift in ((0.0, 0.0), (1.1, 300.0), (-2.5, -80.0)):
        problem = world.moved(angle, np.array([shift, -shift])).problem(table.sample(frac=1, random_state=1))
        group = probcal.fit(problem, method)["calibration"].to_dataset()
        z = dict(zip(problem.labels, (group["mean"] / group["scale"]).values, strict=True))
        same(vectors(z, 0.0, 0.0), vectors(expected.mean, angle, 0.0))
