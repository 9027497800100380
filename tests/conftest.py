"""Severe numerics for every test, kernels kept between runs, and a budget of kernels.

Rank promotion raises and warnings are errors; x64 stays off as for a user. What a test costs is what it compiles:
XLA is asked for quick compilation, kernels are kept in a folder that every run shares (`.pytest_cache/kernels`), tests
of one world run in one worker, and a whole default run that makes more kernels than BUDGET fails.
"""

import os
from collections import Counter
from pathlib import Path

os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true")
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(__file__).parents[1] / ".pytest_cache" / "kernels"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.1")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "0")

import jax
import pytest
from hypothesis import settings
from xdist.scheduler import LoadFileScheduling

from probcal import kernels
from probcal.gaussian import choose
from probcal.wings import WingMissing, installed

BUDGET = 2450  # kernels of a whole default run, all workers together (some 2350, by which takes which file)
kernels.SHARE = 0.6  # of the memory maps that a process may have: a test needs less than the rest
KERNELS = Path(__file__).parents[1] / ".pytest_cache" / "kernels"
MOST_BYTES = 1_000_000_000  # of kernels kept there
TOGETHER = {  # files that share worlds run in one worker, one after the other; these begin, the longest first
    "test_exact.py": "linear", "test_methods.py": "linear", "test_samplers.py": "linear", "test_svi.py": "linear",
    "test_drift.py": "linear", "test_kernels.py": "linear", "test_metamorphic.py": "bent", "test_bounds.py": "bent",
    "test_degenerate.py": "linear", "test_sparse.py": "sparse", "test_segments.py": "sparse",
    "test_notebooks.py": "notebooks", "test_kills.py": "kills", "test_endtoend.py": "commands",
    "test_wings.py": "wings",
}  # fmt: skip
NEEDS = {  # the wings that all tests of a file need; it is not collected where one is missing
    "../README.md": "adapters doa particles roads rss stream studies tracking",
    "test_adapters_files.py": "adapters",
    "test_adapters_ros.py": "adapters",
    "test_adapters_stone_soup.py": "adapters",
    "test_association.py": "tracking",
    "test_association_sampler.py": "tracking",
    "test_beliefs.py": "tracking",
    "test_cluster.py": "studies",
    "test_doa.py": "doa",
    "test_fits.py": "studies",
    "test_gate.py": "stream",
    "test_online.py": "stream",
    "test_particle_methods.py": "particles roads",
    "test_particles.py": "particles",
    "test_phd.py": "tracking",
    "test_registration.py": "tracking",
    "test_roads.py": "roads",
    "test_rss.py": "rss",
    "test_sbc.py": "studies",
    "test_self_configuration.py": "tracking",
    "test_studies.py": "studies",
    "test_watch.py": "stream",
}


def missing(wings):
    """Those of some wings that are not installed.

    A single test in a file of the core names its wings by the marker `needs`, or is skipped when it asks for a name.
    """
    return [wing for wing in wings if not installed(f"probcal.{wing}")]


collect_ignore = [file for file, wings in NEEDS.items() if missing(wings.split())]
compiled: Counter[str] = Counter()  # kernels by test file, of this process and of the workers that have ended
running = ["elsewhere"]  # the file whose test runs

settings.register_profile("probcal", deadline=None, max_examples=10, derandomize=True, print_blob=False)
settings.load_profile("probcal")


def count(event, duration, **_):
    """Every kernel that jax makes in this process, be it compiled or read from the folder."""
    compiled[running[0]] += event == "/jax/core/compile/backend_compile_duration"


def pytest_runtest_logstart(nodeid, location):
    running[0] = nodeid.split("::", 1)[0].rsplit("/", 1)[-1]


def pytest_configure(config):
    jax.monitoring.register_event_duration_secs_listener(count)
    if not hasattr(config, "workerinput"):
        trim(KERNELS, MOST_BYTES)


def trim(folder, most):
    """Delete the kernels not used for longest until the others fit."""
    files = [(path.stat(), path) for path in folder.glob("*")] if folder.exists() else []
    left = sum(stat.st_size for stat, _ in files)
    for stat, path in sorted(files, key=lambda pair: pair[0].st_mtime):
        if left <= most:
            break
        path.unlink(missing_ok=True)
        left -= stat.st_size


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call():
    """A test that asks for a public name of a wing that is not installed is skipped."""
    try:
        return (yield)
    except WingMissing as gone:
        pytest.skip(str(gone))


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    for item in items:
        if item.path.name == "README.md":
            item.add_marker("ci")
        if item.get_closest_marker("slow"):  # the later of two tiers counts
            item.own_markers = [mark for mark in item.own_markers if mark.name != "ci"]
            if item.get_closest_marker("ci"):
                raise pytest.UsageError(f"{item.nodeid} is slow and its module ci: mark the others of it one by one")
        needed = [wing for mark in item.iter_markers("needs") for wing in mark.args]
        if gone := missing(needed):
            item.add_marker(pytest.mark.skip(reason=f"wings not installed: {', '.join(gone)}"))
    order = list(TOGETHER)
    items.sort(key=lambda item: order.index(item.path.name) if item.path.name in TOGETHER else len(order))


class ByWorld(LoadFileScheduling):
    """Files are handed to workers whole, and those that share a world together."""

    def _split_scope(self, nodeid):
        name = nodeid.split("::", 1)[0].rsplit("/", 1)[-1]
        return TOGETHER.get(name, name)


def pytest_xdist_make_scheduler(config, log):
    return ByWorld(config, log) if config.getvalue("dist") == "loadfile" else None


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node, error):
    compiled.update(getattr(node, "workeroutput", {}).get("kernels", {}))


def whole(config):
    """Whether a run is that of `pytest` without a choice of tests."""
    return (
        config.args_source is pytest.Config.ArgsSource.TESTPATHS
        and not config.option.keyword
        and config.option.markexpr == DEFAULT
    )


DEFAULT = "not slow and not ci"


@pytest.hookimpl(tryfirst=True)
def pytest_sessionfinish(session):
    config = session.config
    if hasattr(config, "workerinput"):
        config.workeroutput["kernels"] = dict(compiled)
    elif whole(config) and compiled.total() > BUDGET and session.exitstatus == 0:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def pytest_terminal_summary(terminalreporter, config):
    made = compiled.total()
    if config.option.collectonly:
        return
    terminalreporter.write_line(f"kernels: {made} of {BUDGET}" if whole(config) else f"kernels: {made}")
    if whole(config) and made > BUDGET:
        terminalreporter.write_line(
            "The default run compiles more than its budget: share a world of tests/worlds.py, evaluate without jit, or"
            " mark what is long with `slow` or `ci`. Files that compile most: "
            + ", ".join(f"{name} {number}" for name, number in compiled.most_common(12)),
            red=True,
        )


@pytest.fixture(scope="session", autouse=True)
def severe_numerics():
    before = jax.config.jax_numpy_rank_promotion
    jax.config.update("jax_numpy_rank_promotion", "raise")
    assert not jax.config.jax_enable_x64, "tests run as a user would: the package enters float64 by itself"
    yield
    jax.config.update("jax_numpy_rank_promotion", before)


@pytest.fixture(autouse=True)
def few_maps():
    """Every compiled kernel takes memory maps, of which a process has a limited number."""
    yield
    kernels.drop_if_many()


@pytest.fixture
def kept_kernels(monkeypatch):
    """No kernel is dropped inside a test that counts them, however many this process has compiled before."""
    monkeypatch.setattr(kernels, "maps", lambda: 0)


@pytest.fixture
def library(request, monkeypatch):
    """The name of a sparse engine, which is the one that is chosen."""
    if request.param == "cholmod":
        pytest.importorskip("sparsax", reason="sparsax is an extra")
    monkeypatch.setattr(choose, "has_cholmod", lambda: request.param == "cholmod")
    return request.param
