"""The profile of fits: its phases add up, and the functions that it wraps exist."""

import json
import sys
import time
from pathlib import Path

import pytest
from committed import MODEL, ROWS
from terminal import call

from probcal.cli import fit

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
import phases

TRACING, LOWERING, COMPILING = phases.WORK


def totals(clock):
    """Return the seconds per phase; of nested phases the innermost counts."""
    clock.charge()
    found = dict.fromkeys(phases.PHASES, 0.0)
    for (path, _), (seconds, _) in clock.spent.items():
        found[path.rsplit("/", 1)[-1]] += seconds
    return found


def test_phases_and_the_work_of_jax_nest_and_add_up():
    begun = time.time()
    clock = phases.Clock(begun)
    clock.enter("climb")
    with clock.within("precisions"):
        clock.begin(TRACING)
        clock.begin(COMPILING)  # a constant that is computed while a function is traced
        time.sleep(0.02)
        clock.end(COMPILING)
        clock.end(TRACING)
    clock.begin("another event")
    clock.end(LOWERING)  # of one that was never begun
    time.sleep(0.01)
    clock.charge()
    spent = {key: seconds for key, (seconds, _) in clock.spent.items()}
    assert spent["climb/precisions", "compiling"] >= 0.02
    assert spent["climb/precisions", "tracing"] < 0.02
    assert spent["climb", "running"] >= 0.01
    assert sum(spent.values()) == pytest.approx(time.time() - begun, abs=0.01)


def test_a_row_has_every_column_and_the_reason_of_a_failure():
    spent = [["climb", "running", 2.0, 1.0], ["climb/precisions", "compiling", 3.0, 4.0]]
    functions = {"probcal/a.py:f": [3.0, 4.0], "probcal/a.py:g": [1.0, 5.0]}
    found = dict(spent=spent, kernels=7, HLO=90, memory=0.5, bytes=2e6, exit=0, functions=functions, wrong="")
    cells = dict(zip(phases.HEAD, phases.row("one", found).strip("| ").split(" | "), strict=True))
    assert cells["all"] == "5.0 / 5.0"
    assert (cells["climb"], cells["precisions"], cells["modes"]) == ("2.0 / 1.0", "3.0 / 4.0", "–")
    assert (cells["compiling"], cells["running"], cells["HLO"]) == ("3.0 / 4.0", "2.0 / 1.0", "90")
    own, whole = phases.functions({"one": found}, 1)
    assert own == "- own: probcal/a.py:f, 3.0 s, 60.0%"
    assert whole == "- with what it calls: probcal/a.py:g, 5.0 s, 100.0%"
    lost = phases.row("two", {"wrong": "stopped after 5 s"})
    assert lost.count("|") == phases.row("one", found).count("|")
    assert lost.endswith("| stopped after 5 s |")


def test_instructions_are_counted_before_xla_optimises(tmp_path):
    for number, text in enumerate(["a = 1\nb = 2\n}", "a = 1\n"]):
        (tmp_path / f"module_{number}.jit_f{number}.before_optimizations.txt").write_text(text)
    (tmp_path / "module_0.jit_f0.after_optimizations.txt").write_text("a = 1\n" * 9)
    assert phases.kernel_sizes(tmp_path) == [(2, "jit_f0"), (1, "jit_f1")]


def test_the_model_of_every_fit_exists():
    assert all((phases.MODELS / f"{case.model}.py").is_file() for case in phases.CASES.values())
    assert set(phases.QUICK) <= set(phases.CASES)


@pytest.mark.ci
def test_the_phases_of_a_fit_cover_the_command(tmp_path):
    before, begun = fit.shown, time.time()
    clock = phases.Clock(begun)
    with phases.timed_phases(clock):
        code, _, err = call("fit", MODEL, ROWS, "--out", tmp_path)
    assert code == 0, err
    assert fit.shown is before
    found, took = totals(clock), time.time() - begun
    assert sum(found.values()) == pytest.approx(took, abs=0.1)
    assert [name for name, seconds in found.items() if not seconds] == ["objects"]
    assert found["other"] < 0.2 * took


@pytest.mark.ci
def test_a_process_writes_its_measurements(tmp_path):
    """The recording is missing, so that the command ends before it fits."""
    case = phases.Case("plaza", "no_such_recording.csv")
    assert phases.missing(case, tmp_path) == "the recording no_such_recording.csv is not here"
    found = phases.measured(case, tmp_path, 60, tmp_path)
    assert found["exit"] == 2
    assert json.dumps(found["spent"])
    assert not found["wrong"]
    assert (found["kernels"], found["HLO"], found["bytes"]) == (0, 0, 0)
    assert any(name.startswith("probcal/") for name in found["functions"])
