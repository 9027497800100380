"""The command line as a user meets it: the main job, bad input, nothing half-written."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pandas as pd
import pytest
import xarray as xr

import probcal

ROOT = Path(__file__).parents[1]
PLAZA = ROOT / "models" / "plaza.py"
RADARS = ROOT / "models" / "radars.py"

SMALL = """
import numpy as np
from probcal import Bias, Channel, ConstantVelocity, Network, Node, Problem, sensor, simulate
from probcal.geometry import norm

@sensor(range=Channel("m", std=STD))
def gauge(target, pose, *, range_offset=Bias("m", SCALE)):
    return dict(range=norm(target.position - pose.position) + range_offset)

def network():
    return Network([gauge.on(Node(f"gauge_{k}", p)) for k, p in enumerate([(0, 0), (50, 0), (0, 50)])])

def problem(data=None):
    return Problem(network(), ConstantVelocity(0.5), data)

def scenario(key=0):
    path = np.stack([np.linspace(5, 40, 12), 10 + 20 * np.sin(np.linspace(0, 3, 12))], 1)
    return simulate(network(), ConstantVelocity(0.5), np.arange(12.0), key, tracks={"target": path})
"""


def run(*arguments, cwd=None):
    command = [sys.executable, "-m", "probcal.cli", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, cwd=cwd, timeout=300)


def call(monkeypatch, capsys, *arguments):
    """The command in this process: exit code, stdout, stderr."""
    from probcal import cli

    monkeypatch.setattr(sys, "argv", ["probcal", *map(str, arguments)])
    with pytest.raises(SystemExit) as caught:
        cli.main()
    out = capsys.readouterr()
    return caught.value.code or 0, out.out, out.err


@pytest.fixture
def model(tmp_path):
    path = tmp_path / "small.py"
    path.write_text(SMALL.replace("STD", "1.0").replace("SCALE", "2.0"))
    return path


@pytest.fixture
def rows(model, tmp_path, monkeypatch, capsys):
    assert call(monkeypatch, capsys, "simulate", model, "--seed", 3, "--out", tmp_path / "rows.csv")[0] == 0
    return tmp_path / "rows.csv"


def test_plaza_is_calibrated_from_the_command_line(tmp_path):
    done = run("fit", PLAZA, "--out", tmp_path / "fit")
    assert done.returncode == 0, done.stderr
    line = next(row for row in done.stdout.splitlines() if row.startswith("position RMSE"))
    before, after = (float(word) for word in line.split() if word[0].isdigit())
    assert 3.5 < before < 5.0
    assert after <= 0.45
    summary = pd.read_csv(tmp_path / "fit" / "summary.csv").set_index("bias")
    assert list(summary.reset_index().columns[:8]) == ["bias", "unit", "scale", "mean", "sd", "lower", "upper", "gamma"]
    gps = {"beacon_1": 0.0697, "beacon_6": 0.0689, "beacon_0": 0.0687, "beacon_5": 0.0693}
    for beacon, scale in gps.items():
        row = summary.loc[f"{beacon}.range_scale"]
        assert abs(row["mean"] - scale) < 0.008
        assert row["gamma"] > 0.99
    assert np.isfinite(summary.select_dtypes("number").to_numpy()).all()
    html = (tmp_path / "fit" / "report.html").read_text()
    assert "beacon_5.range_scale" in html
    again = run("report", tmp_path / "fit")
    assert again.returncode == 0, again.stderr
    tracked = run("track", PLAZA, "--calibration", tmp_path / "fit", "--out", tmp_path / "tracks.csv")
    assert tracked.returncode == 0, tracked.stderr
    assert "after 0.42" in tracked.stdout
    tracks = pd.read_csv(tmp_path / "tracks.csv")
    assert len(tracks) == 1816
    assert (tracks["position_x_sd"] > 0).all()


def test_freed_beacons_end_at_bound_and_name_the_dilation(monkeypatch, capsys):
    code, out, err = call(monkeypatch, capsys, "fit", ROOT / "models" / "plaza_free.py")
    assert code == 1
    assert "at bound" in out
    for word in (
        "estimate is invalid",
        "beacon_5.range_scale",
        "dilation",
        "translation",
        "anchor the positions of two nodes",
    ):
        assert word in err


def test_check_names_what_freed_beacons_leave_open(tmp_path):
    done = run("check", ROOT / "models" / "plaza_free.py", "--out", tmp_path / "check")
    assert done.returncode == 1, done.stderr
    for words in (
        "translation of all nodes along x",
        "all nodes move 1 m north together",
        "dilation: all positions grow or shrink together",
        "distances from the centre grow together and the range scales with them",
        "rotation",
        "another pass",
    ):
        assert words in done.stdout
    frame = pd.read_csv(tmp_path / "check" / "check.csv")
    assert list(frame.columns) == ["bias", "unit", "scale", "kind", "sd", "share", "verdict"]
    assert len(frame) == 16
    assert (tmp_path / "check" / "check.png").stat().st_size > 10_000
    tree = xr.open_datatree(tmp_path / "check" / "check.nc", engine="h5netcdf")
    assert tree.attrs["status"] == "open"
    tree.close()


def test_check_of_what_is_only_weak_ends_with_0(model, rows, monkeypatch, capsys):
    code, out, _ = call(monkeypatch, capsys, "check", model, rows)
    assert code == 0
    assert "hardly determine" in out
    code, out, _ = call(monkeypatch, capsys, "check", model, rows, "--fix", "gauge_0.range_offset")
    assert code == 0
    assert "gauge_0.range_offset" not in out


def test_simulate_fit_track_report_of_a_small_model(model, rows, tmp_path, monkeypatch, capsys):
    code, out, _ = call(monkeypatch, capsys, "fit", model, rows, "--method", "map", "--out", tmp_path / "fit")
    assert code == 0
    assert "position RMSE before" in out  # the truth stands beside the simulated table
    tree = probcal.load(tmp_path / "fit")
    assert tree.attrs["prior"] == "Gaussian"
    assert set(tree["truth"]["bias_label"].values) == {f"gauge_{k}.range_offset" for k in range(3)}
    assert not [p for p in (tmp_path / "fit").iterdir() if p.name.startswith(".")]
    code, out, _ = call(monkeypatch, capsys, "simulate", model, "--seed", 3, "--out", tmp_path / "again.csv")
    assert (tmp_path / "again.csv").read_text() == rows.read_text()


def test_fixing_a_bias_takes_it_out_of_the_table(model, rows, monkeypatch, capsys):
    code, out, _ = call(monkeypatch, capsys, "fit", model, rows, "--fix", "gauge_0.*", "--method", "map")
    assert code == 0
    assert "gauge_0.range_offset" not in out
    assert "gauge_1.range_offset" in out


def edit(rows, change):
    """A copy of the simulated table with its text changed."""
    path = rows.with_name("bad.csv")
    path.write_text(change(rows.read_text()))
    return path


def cell(text, line, column, value):
    lines = text.splitlines()
    parts = lines[line - 1].split(",")
    parts[column] = value
    lines[line - 1] = ",".join(parts)
    return "\n".join(lines) + "\n"


BAD = {
    "unknown sensor": (lambda t: cell(t, 5, 1, "gage_1"), 'bad.csv row 5: sensor "gage_1" is not in the network; did you mean "gauge_1"?'),
    "unknown channel": (lambda t: t.replace("range", "rage", 1), 'bad.csv column "rage" is not a channel of the network; did you mean "range"?'),
    "nan time": (lambda t: cell(t, 4, 0, ""), 'bad.csv row 4 column "time": nan is not a finite time'),
    "infinite time": (lambda t: cell(t, 4, 0, "inf"), 'bad.csv row 4 column "time": inf is not a finite time'),
    "infinite measurement": (lambda t: cell(t, 6, 2, "inf"), 'bad.csv row 6 column "range": the value is infinite'),
    "text in a channel": (lambda t: cell(t, 6, 2, "abc"), 'bad.csv row 6 column "range": "abc" is no number'),
    "unknown unit": (lambda t: t.replace("range", "range [mm2]", 1), 'bad.csv column "range": unit "mm2" is not known; did you mean "mm"?'),
    "wrong unit": (lambda t: t.replace("range", "range [deg]", 1), 'bad.csv column "range": unit "deg" is no length'),
    "duplicate row": (lambda t: t + t.splitlines()[1] + "\n", 'has a second "range" at time 0 (first in row 2); keep one'),
    "empty table": (lambda t: t.splitlines()[0] + "\n", "bad.csv has no rows"),
    "empty file": (lambda t: "", "bad.csv is not a CSV table"),
    "one row": (lambda t: "\n".join(t.splitlines()[:2]) + "\n", "bad.csv has one measured row only"),
    "sensor without rows": (lambda t: "\n".join(r for r in t.splitlines() if "gauge_2" not in r), 'bad.csv has no row of sensor "gauge_2"'),
    "no sensor column": (lambda t: t.replace("sensor", "sensr", 1), 'bad.csv has no column "sensor"; did you mean "sensr"?'),
    "zero std": (lambda t: t.replace("range", "range,range_std", 1).replace("\n", ",0\n").replace("_std,0", "_std"), 'column "range_std": std is 0; it must be positive'),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_a_bad_table_gets_one_sentence_and_code_2(name, model, rows, tmp_path, monkeypatch, capsys):
    change, text = BAD[name]
    code, out, err = call(monkeypatch, capsys, "fit", model, edit(rows, change), "--out", tmp_path / "fit")
    assert code == 2
    assert text in err
    assert err.count("\n") == 1
    assert out == ""
    assert not list((tmp_path / "fit").iterdir())


def test_binary_garbage_is_refused(model, tmp_path, monkeypatch, capsys):
    path = tmp_path / "garbage.csv"
    path.write_bytes(os.urandom(4000))
    code, _, err = call(monkeypatch, capsys, "fit", model, path)
    assert code == 2
    assert err.startswith("probcal: garbage.csv ")
    assert err.count("\n") == 1


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (SMALL.replace("STD", "-1.0").replace("SCALE", "2.0"), "std is -1: it must be positive"),
        (SMALL.replace("STD", "0.0").replace("SCALE", "2.0"), "std is 0: it must be positive"),
        (SMALL.replace("STD", "1.0").replace("SCALE", "0.0"), "scale=0.0): the scale must be positive"),
        ("x = 1\n", "defines no problem()"),
        ("def problem(data=None):\n    return 3\n", "problem() returned int; return a probcal.Problem with a network"),
        ("from probcal import Network\ndef problem(data=None):\n    return Network([])\n", "the network has no sensor"),
        ("def problem(data=None)\n", "cannot be loaded: SyntaxError"),
        ("def problem(data=None):\n    return 1 / 0\n", "problem() failed with ZeroDivisionError"),
    ],
)
def test_a_bad_model_gets_one_sentence_and_code_2(text, message, tmp_path, monkeypatch, capsys):
    path = tmp_path / "model.py"
    path.write_text(text)
    code, _, err = call(monkeypatch, capsys, "fit", path)
    assert code == 2
    assert message in err
    assert err.count("\n") == 1


def test_other_bad_arguments(model, rows, tmp_path, monkeypatch, capsys):
    blocked = tmp_path / "file"
    blocked.write_text("")
    cases = [
        (("fit", tmp_path / "none.py"), "no such model file"),
        (("fit", model, tmp_path / "none.csv"), "no such file"),
        (("fit", model, rows, "--out", blocked / "fit"), "cannot be written"),
        (("fit", model, rows, "--method", "eaa"), 'did you mean "ea"?'),
        (("fit", model, rows, "--prior", "gausian"), 'did you mean "gaussian"?'),
        (("fit", model, rows, "--prior", "gaussian"), "EA does not take the prior Gaussian; it takes: ard"),
        (("fit", model, rows, "--fix", "gauge_9.*"), 'no bias is called "gauge_9.*"'),
        (("fit", model, rows, "--fix", "*"), "no free bias"),
        (("track", model, rows), "track needs --calibration DIR"),
        (("track", model, rows, "--calibration", tmp_path), "is not a fit written by probcal"),
        (("report", tmp_path), "is not a fit written by probcal"),
        (("simulate", PLAZA), "defines no scenario()"),
    ]
    for arguments, text in cases:
        code, _, err = call(monkeypatch, capsys, *arguments)
        assert code == 2, arguments
        assert text in err
        assert err.count("\n") == 1


def test_a_fit_that_fails_to_be_written_leaves_nothing_behind(model, rows, tmp_path, monkeypatch):
    tree = probcal.fit(probcal.Problem(*_parts(model), rows), probcal.MAP())

    def broken(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(type(tree), "to_netcdf", broken)
    with pytest.raises(OSError, match="No space"):
        probcal.save(tree, tmp_path / "fit.nc")
    assert not list(tmp_path.glob("*fit.nc*"))


def _parts(model):
    from probcal.cli.models import load_model

    return load_model(model).network(), probcal.ConstantVelocity(0.5)


def test_a_model_may_bring_its_prior(tmp_path, model, monkeypatch, capsys):
    model.write_text(model.read_text() + '\nfrom probcal import ARD\nPRIOR = ARD(by="node")\n')
    assert call(monkeypatch, capsys, "simulate", model, "--out", tmp_path / "rows.csv")[0] == 0
    for extra, wanted in (((), "by='node'"), (("--prior", "ard"), "by=None"), (("--method", "map"), "Gaussian")):
        order = ("fit", model, tmp_path / "rows.csv", "--no-assess", "--out", tmp_path / "out", *extra)
        code, _, err = call(monkeypatch, capsys, *order)
        assert code in (0, 1), err
        assert wanted in probcal.load(tmp_path / "out").attrs["settings"]


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (["--method", "collapsed", "--resume"], "--resume needs --out, the folder of the run to go on with"),
        (["--method", "map", "--draws", "10"], '--draws: "map" draws no chains; take collapsed, nuts or svi'),
    ],
)
def test_options_of_samplers_are_checked(options, text, model, rows, monkeypatch, capsys):
    code, _, err = call(monkeypatch, capsys, "fit", model, rows, *options)
    assert code == 2
    assert text in err


def test_a_sampler_prints_and_writes_what_its_chains_are_worth(model, rows, tmp_path, monkeypatch, capsys):
    sizes = ["--chains", "2", "--draws", "60", "--warmup", "50"]
    code, out, err = call(
        monkeypatch,
        capsys,
        "fit",
        model,
        rows,
        "--method",
        "collapsed",
        *sizes,
        "--no-assess",
        "--out",
        tmp_path / "fit",
    )
    assert "2 x 60 draws" in out
    assert code == 1
    assert "effective draws" in err, "so few draws are not called converged"
    frame = pd.read_csv(tmp_path / "fit" / "summary.csv")
    assert {"r_hat", "ess", "ess_tail", "inclusion", "contraction"} <= set(frame.columns)
    assert not (tmp_path / "fit" / "draws").exists(), "the draws are in fit.nc"


def test_kernels_are_kept_in_the_cache_folder_of_the_user_unless_jax_has_one(tmp_path, monkeypatch):
    from probcal.cli.kernels import keep_kernels

    cache = ("jax_compilation_cache_dir", "jax_compilation_cache_max_size")
    least = ("jax_persistent_cache_min_compile_time_secs", "jax_persistent_cache_min_entry_size_bytes")
    before = {name: getattr(jax.config, name) for name in (*cache, *least)}
    assert before[cache[0]], "the tests share one"
    keep_kernels()
    assert jax.config.jax_compilation_cache_dir == before[cache[0]]
    (tmp_path / "file").write_text("no folder")
    try:
        for home, kept in ((tmp_path / "cache", True), (tmp_path / "file", False)):
            jax.config.update(cache[0], None)
            monkeypatch.setenv("XDG_CACHE_HOME", str(home))
            keep_kernels()
            assert bool(jax.config.jax_compilation_cache_dir) == kept
            assert (home / "probcal" / "kernels").is_dir() == kept
    finally:
        for name, value in before.items():
            jax.config.update(name, value)


def test_draws_of_states_and_replicas_are_saved_where_asked_for(model, rows, tmp_path, monkeypatch, capsys):
    for words, wanted in (((), set()), (("--save", "states,predictive"), {"state", "posterior_predictive"})):
        order = ("fit", model, rows, "--method", "map", "--no-assess", "--out", tmp_path / "fit", *words)
        assert call(monkeypatch, capsys, *order)[0] == 0
        tree = probcal.load(tmp_path / "fit")
        assert {"state", "posterior_predictive"} & {*tree["posterior"].data_vars, *tree.children} == wanted
