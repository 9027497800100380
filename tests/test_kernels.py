"""Kernels are shared by all that computes the same, and never fill the memory maps of a process."""

import os
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import worlds
import xarray as xr

from probcal import (
    EA,
    EM,
    EMEA,
    MAP,
    Bias,
    Channel,
    Cubature,
    InputError,
    LeastSquares,
    Network,
    Node,
    Problem,
    Static,
    assess,
    fit,
    kernels,
    sensor,
    sensors,
)
from probcal.geometry import norm
from probcal.modes.grid import grid_start
from probcal.priors import Gaussian
from probcal.types import float64

OTHERS = (EA(), EA(engine="superlu"), LeastSquares(), EM(Cubature()))
PRUNING = (EA(precisions="maximised"), EMEA(iterations=12))  # the climbs of MAP and EM, which drop biases beside it


def gauge(factor=1.0, scale=1.0, name="gauge", values=(0.0, 1.0, 2.0)):
    """A sensor type declared anew at every call."""
    table = np.asarray(values)

    def read(target, pose, *, shift=Bias("m", scale)):
        line = norm(target.position - pose.position)
        return {"range": factor * line + shift + jnp.interp(line, table, table)}

    read.__name__ = name
    return sensor(range=Channel("m", std=1.0))(read)


def position():
    """The position sensor of the catalogue, declared anew at every call."""

    @sensor(position=Channel("m", std=5.0, per_axis=True))
    def position(target, pose):
        return dict(position=pose.local(target.position))

    return position


@contextmanager
def counted():
    """A list with an entry that is true for every kernel made meanwhile."""
    made = []

    def count(event, duration, **_):
        made.append(event == "/jax/core/compile/backend_compile_duration")

    jax.monitoring.register_event_duration_secs_listener(count)
    try:
        yield made
    finally:
        jax.monitoring.unregister_event_duration_listener(count)


def test_types_that_compute_the_same_are_equal():
    assert gauge() == gauge()
    assert hash(gauge()) == hash(gauge())
    assert gauge() is not gauge()


@pytest.mark.parametrize(
    "other",
    [
        gauge(factor=1.05),
        gauge(factor=1.0 + 1e-15),
        gauge(scale=2.0),
        gauge(name="other"),
        gauge(values=(0.0, 1.0, 3.0)),
    ],
    ids=["factor", "last digit", "scale", "name", "constant array"],
)
def test_types_that_differ_in_anything_are_not(other):
    assert other != gauge()
    assert other.fingerprint != gauge().fingerprint


def test_a_network_knows_equal_types_as_one():
    network = Network([gauge().on(Node("a", (0.0, 0.0))), gauge().on(Node("b", (9.0, 0.0)))])
    assert len(network.types) == 1
    assert network.labels == ("a.shift", "b.shift")


def test_a_sensor_declared_again_compiles_nothing_new(kept_kernels):
    """As a model file loaded twice, or a sensor declared in a function: the second fit makes no kernel at all."""

    def solve():
        network, motion, table, _ = worlds.plane()
        places = [position().on(placed.nodes[0]) for placed in network.sensors]
        problem = Problem(Network(places), motion, table)
        return fit(problem, MAP(), prior=Gaussian(), start=worlds.resting(problem))

    first = solve()
    with counted() as made:
        second = solve()
        assert sum(made) == 0
        jax.jit(lambda x: x + 1.25)(jnp.ones(3))
        assert sum(made) > 0, "what is counted is kernels"
    np.testing.assert_array_equal(first["calibration"]["mean"], second["calibration"]["mean"])


@pytest.mark.parametrize(
    "method",
    [
        MAP(), *(pytest.param(own, marks=pytest.mark.ci) for own in OTHERS),
        *(pytest.param(own, marks=pytest.mark.slow) for own in PRUNING),
    ],
    ids=lambda own: f"{own.name} {own.engine}",
)  # fmt: skip
def test_a_padded_problem_has_the_answer_of_the_plain_one(method, monkeypatch):
    problem = worlds.small(motion=worlds.two_motions, scans=9)
    padded = fit(problem, method, key=1)
    monkeypatch.setattr(Problem, "padded", lambda self: self)
    plain = fit(problem, method, key=1)
    assert padded["calibration"].to_dataset().sizes == plain["calibration"].to_dataset().sizes
    for group in ("calibration", *(f"track/{name}" for name in plain["track"].children)):
        xr.testing.assert_allclose(padded[group].to_dataset(), plain[group].to_dataset(), rtol=1e-4, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("motion", [worlds.two_motions, lambda start: Static()], ids=["two motions", "static"])
def test_a_start_from_the_grid_is_not_moved_by_padding(motion):
    problem = worlds.small(motion=motion, scans=9)
    starts = [float64(grid_start)(own, None, 0) for own in (problem.padded(), problem)]
    for long, short in zip(*(start.states for start in starts), strict=True):
        np.testing.assert_allclose(np.asarray(long)[: len(short)], short, rtol=1e-6, atol=1e-6)


def test_a_recording_of_about_the_same_length_compiles_nothing(kept_kernels):
    """Neither its fit nor what is asked of it."""
    problem = worlds.small(motion=worlds.two_motions, scans=11)
    shorter = problem.select(np.arange(len(problem.measurements.time) - 3))
    assess(problem, fit(problem, MAP()))
    with counted() as made:
        assess(shorter, fit(shorter, MAP()))
    assert sum(made) == 0


def test_the_catalogue_has_no_two_types_alike():
    found = [value for value in vars(sensors).values() if hasattr(value, "fingerprint")]
    assert len({kind.fingerprint for kind in found}) == len(found) > 20


def test_a_function_that_computes_something_else_at_every_call_is_refused():
    random = np.random.default_rng(0)

    @sensor(range=Channel("m", std=1.0))
    def restless(target, pose):
        return {"range": target.position[0] + random.normal()}

    with pytest.raises(InputError, match="computes something else at every call"):
        Network([restless.on(Node("a", (0.0, 0.0)))])


SETTINGS = (
    "jax_compilation_cache_dir", "jax_compilation_cache_max_size", "jax_persistent_cache_min_compile_time_secs",
    "jax_persistent_cache_min_entry_size_bytes",
)  # fmt: skip


def test_kernels_are_kept_in_the_cache_folder_of_the_user_unless_something_speaks_against_it(tmp_path, monkeypatch):
    keep = kernels.keep_kernels.__wrapped__  # once per process otherwise
    before = {name: getattr(jax.config, name) for name in SETTINGS}
    assert before[SETTINGS[0]], "the tests share one"
    keep()
    assert {name: getattr(jax.config, name) for name in SETTINGS} == before
    (tmp_path / "file").write_text("no folder")
    try:
        for home, off, kept in (("cache", "", True), ("file", "", False), ("off", "1", False)):
            jax.config.update(SETTINGS[0], None)
            monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / home))
            monkeypatch.setenv("PROBCAL_NO_CACHE", off)
            keep()
            assert bool(jax.config.jax_compilation_cache_dir) == kept
            assert (tmp_path / home / "probcal" / "kernels").is_dir() == kept
    finally:
        for name, value in before.items():
            jax.config.update(name, value)


SESSION = """
import jax
hits = []
jax.monitoring.register_event_listener(lambda event, **_: hits.append(event == "/jax/compilation_cache/cache_hits"))
jax.jit(lambda x: x + 1)(1.0)  # jax decides on its cache when it first compiles
import probcal
print(jax.config.jax_compilation_cache_dir)
network = probcal.Network([probcal.sensors.ranger.on(probcal.Node("mast", (0.0, 0.0)))])
probcal.simulate(network, probcal.ConstantVelocity(1.0), [0.0, 1.0])
print(sum(hits))
"""


@pytest.mark.ci
def test_a_second_session_reads_the_kernels_of_the_first(tmp_path):
    """Also where jax has compiled before the first verb; importing the package changes nothing."""
    home = {key: value for key, value in os.environ.items() if not key.startswith(("JAX_", "PROBCAL_"))}
    folder = Path("probcal", "kernels")

    def session(name, **changes):
        environment = home | {"XDG_CACHE_HOME": str(tmp_path / name)} | changes
        done = subprocess.run([sys.executable, "-c", SESSION], env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        at_import, hits = done.stdout.split()
        assert at_import == changes.get("JAX_COMPILATION_CACHE_DIR", "None")
        return int(hits)

    assert session("kept") == 0
    made = len(list((tmp_path / "kept" / folder).glob("*-cache")))
    assert made > 10
    assert session("kept") >= made
    session("off", PROBCAL_NO_CACHE="1")
    session("own", JAX_COMPILATION_CACHE_DIR=str(tmp_path / "elsewhere"))
    assert not (tmp_path / "off").exists()
    assert not (tmp_path / "own").exists()


def test_kernels_are_dropped_before_the_maps_run_out(monkeypatch):
    dropped = []
    monkeypatch.setattr(kernels.jax, "clear_caches", lambda: dropped.append(True))
    monkeypatch.setattr(kernels, "PAUSE", 0.0)
    monkeypatch.setattr(kernels, "limit", lambda: 10**9)
    kernels.drop_if_many()
    assert not dropped
    monkeypatch.setattr(kernels, "limit", lambda: 1)
    kernels.drop_if_many()
    assert dropped or kernels.maps() == 0


def test_a_system_that_says_nothing_of_its_maps_is_no_obstacle(monkeypatch, tmp_path):
    monkeypatch.setattr(kernels, "MAPS", tmp_path / "maps")
    monkeypatch.setattr(kernels, "LIMIT", tmp_path / "limit")
    assert kernels.maps() == 0
    assert kernels.limit() == 65530
