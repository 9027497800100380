"""The command line as a user meets it: the main job on a small model, bad input, nothing half-written."""

import os
import shutil

import committed
import numpy as np
import pandas as pd
import pytest
import xarray as xr
from committed import MODEL, ROWS
from matplotlib import image
from terminal import INSTALLED, call

import probcal
from probcal.cli.models import load_model, load_problem, load_truth, on_network, prior_named
from probcal.cli.options import network_file
from probcal.inference import METHODS
from probcal.results.read import each_track

SMALL = """
from probcal import Bias, Channel, ConstantVelocity, Network, Node, Problem, sensor
from probcal.geometry import norm

@sensor(range=Channel("m", std=STD))
def gauge(target, pose, *, range_offset=Bias("m", SCALE)):
    return dict(range=norm(target.position - pose.position) + range_offset)

def network():
    return Network([gauge.on(Node(f"gauge_{k}", p)) for k, p in enumerate([(0, 0), (50, 0), (0, 50)])])

def problem(data=None):
    return Problem(network(), ConstantVelocity(0.5), data)
"""
LINES = ["time,sensor,range", *(f"{t},gauge_{k},{20 + t + 5 * k}" for t in range(4) for k in range(3))]


@pytest.fixture
def model(tmp_path):
    path = tmp_path / "small.py"
    path.write_text(SMALL.replace("STD", "1.0").replace("SCALE", "2.0"))
    return path


@pytest.fixture
def rows(tmp_path):
    path = tmp_path / "rows.csv"
    path.write_text("\n".join(LINES) + "\n")
    return path


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """The main job on the committed table: its folder, exit code and what it printed."""
    folder = tmp_path_factory.mktemp("fitted") / "fit"
    return folder, *call("fit", MODEL, ROWS, "--out", folder)


def test_the_main_job_writes_a_table_a_report_and_a_tree(fitted):
    folder, code, out, err = fitted
    assert code == 0, err
    assert out.splitlines()[0].split()[-2:] == ["status", "verdict"]
    assert "position RMSE before" in out, "the truth stands beside the table"
    assert "estimated gauge.range_std" in out
    assert sorted(path.name for path in folder.glob("[!.]*")) == [
        "fit.nc", "network.csv", "report.html", "summary.csv",
    ]  # fmt: skip
    summary = pd.read_csv(folder / "summary.csv")
    assert list(summary.columns[:8]) == ["bias", "unit", "scale", "mean", "sd", "lower", "upper", "gamma"]
    assert summary.columns[-2:].tolist() == ["verdict", "reason"]
    assert "a.range_offset" not in summary["bias"].tolist(), "what is fixed is no row"
    for label in summary["bias"]:
        assert label in out
        assert label in (folder / "report.html").read_text().replace("<wbr>", "")
    tree = probcal.load(folder)
    assert tree.attrs["model"] == "small"
    assert tree.attrs["prior"] == "Horseshoe"
    assert set(tree["truth"]["bias_label"].values) >= set(summary["bias"])


def test_a_fit_has_the_structure_of_the_committed_one(fitted):
    """Where this fails, a fit writes something else than the readers are tested on: see `committed.py`."""
    assert committed.structure(probcal.load(fitted[0])) == committed.structure(committed.tree("ea"))


def test_a_fit_starts_from_the_network_of_another_and_its_truth_counts_from_there(fitted, tmp_path):
    folder, module = fitted[0], load_model(MODEL)
    _, problem = load_problem(MODEL, ROWS)
    monday = on_network(problem, network_file(folder))
    wanted = probcal.with_calibration(problem.network, probcal.load(folder))
    assert (monday.network.stated, monday.network.biases) == (wanted.stated, wanted.biases)
    assert (monday.fixed, monday.epoch, monday.labels) == (problem.fixed, problem.epoch, problem.labels)
    assert on_network(problem, None) is problem
    old, new = (load_truth(module, MODEL, ROWS, p, network=problem.network).biases for p in (problem, monday))
    assert old == load_truth(module, MODEL, ROWS, problem).biases
    moved = [label for label in old if label in wanted.stated and old[label] != new[label]]
    assert len(moved) > 4
    for label in old:
        stated = [network.stated.get(label, 0.0) for network in (problem.network, wanted)]
        assert stated[0] + old[label] == pytest.approx(stated[1] + new[label], abs=1e-12)
    for command, text in (
        (("fit", MODEL, ROWS, "--network", tmp_path), "network.csv: there is no such file; give the folder of a valid"),
        (("check", MODEL, ROWS, "--network", ROWS), f"{ROWS} is no file of write_network"),
        (
            ("track", MODEL, ROWS, "--calibration", folder, "--network", folder),
            f"{folder}: the fit started from another network; give --network as that fit had it",
        ),
    ):
        code, _, err = call(*command)
        assert (code, text in err, err.count("\n")) == (2, True, 1), err
    other = probcal.load(folder)
    other.attrs["network"] = "another"
    with pytest.raises(probcal.InputError, match="started from different networks; give both one --network"):
        probcal.changes(probcal.load(folder), other)


@pytest.mark.ci
def test_a_network_file_goes_from_fit_to_fit_to_track(fitted, tmp_path):
    """The second fit counts its biases from the first; tracks follow only where they are given the same network."""
    begin = ("--network", fitted[0])
    code, out, err = call("fit", MODEL, ROWS, *begin, "--out", tmp_path / "two")
    assert code == 0, err
    first, second = probcal.load(fitted[0]), probcal.load(tmp_path / "two")
    assert second.attrs["position_rmse_before"] == pytest.approx(first.attrs["position_rmse_after"], rel=0.05)
    assert second.attrs["coverage"] > 0.5
    done = call("track", MODEL, ROWS, *begin, "--calibration", tmp_path / "two", "--out", tmp_path / "t.csv")
    assert done[0] == 0, done[2]
    assert f"after {second.attrs['position_rmse_after']:.3f} m" in done[1]
    code, _, err = call("track", MODEL, ROWS, "--calibration", tmp_path / "two", "--out", tmp_path / "t.csv")
    assert (code, "the fit started from another network" in err) == (2, True)
    third = on_network(load_problem(MODEL, ROWS)[1], network_file(tmp_path / "two")).network
    assert third.stated == probcal.with_calibration(
        on_network(load_problem(MODEL, ROWS)[1], network_file(fitted[0])).network, second
    ).stated  # fmt: skip
    code, out, err = call("check", MODEL, ROWS, *begin)
    assert (code, "without a survey" in out) == (0, True), err


@pytest.mark.slow
def test_a_sampler_writes_the_structure_of_the_committed_one_and_says_what_its_chains_are_worth(tmp_path):
    sizes = ["--chains", "2", "--draws", "60", "--warmup", "50"]
    code, out, err = call("fit", MODEL, ROWS, "--method", "collapsed", *sizes, "--out", tmp_path / "fit")
    assert "2 x 60 draws" in out
    assert code == 1
    assert "effective draws" in err, "so few draws are not called converged"
    frame = pd.read_csv(tmp_path / "fit" / "summary.csv")
    assert {"r_hat", "ess", "ess_tail", "inclusion", "contraction"} <= set(frame.columns)
    assert not (tmp_path / "fit" / "draws").exists(), "the draws are in fit.nc"
    assert committed.structure(probcal.load(tmp_path / "fit")) == committed.structure(committed.tree("collapsed"))


def test_without_an_assessment_there_is_no_verdict(tmp_path):
    code, out, err = call("fit", MODEL, ROWS, "--no-assess", "--out", tmp_path / "fit")
    assert code == 0, err
    assert "verdict" not in out
    assert "verdict" not in pd.read_csv(tmp_path / "fit" / "summary.csv").columns
    assert "verdict" not in probcal.load(tmp_path / "fit").children


@pytest.mark.ci
@pytest.mark.parametrize("name", ["ea", "collapsed"])
def test_a_report_is_written_from_a_saved_fit(name, tmp_path):
    shutil.copy(committed.DATA / f"{name}.nc", tmp_path / "fit.nc")
    code, out, err = call("report", tmp_path)
    assert code == 0, err
    assert "report.html" in out
    page = (tmp_path / "report.html").read_text().replace("<wbr>", "")
    for text in ("c.position_x", "b.heading", "gauge.range_std", "Values of the drifting biases over time"):
        assert text in page


def test_a_saved_calibration_is_applied_to_other_data(tmp_path):
    code, out, err = call("track", MODEL, ROWS, "--calibration", committed.DATA / "ea.nc", "--out", tmp_path / "t.csv")
    assert code == 0, err
    tracks, tree = pd.read_csv(tmp_path / "t.csv"), committed.tree("ea")
    assert f"after {tree.attrs['position_rmse_after']:.3f} m" in out
    assert tracks.columns[:4].tolist() == ["time", "target", "position_x", "position_x_sd"]
    assert len(tracks) == 16
    found = tree.probcal.tracks()["position_y"].to_numpy()
    assert tracks["position_y"].to_numpy() == pytest.approx(found, abs=1e-3)
    tree.attrs["status"] = "at bound"
    probcal.save(tree, tmp_path / "bad.nc")
    code, _, err = call("track", MODEL, ROWS, "--calibration", tmp_path / "bad.nc", "--out", tmp_path / "t.csv")
    assert code == 2
    assert "the fit ended at bound, its estimate is invalid; fit again first" in err


@pytest.mark.ci
def test_track_follows_the_fit_in_fixed_biases_levels_and_with_sensors_missing():
    done, table = committed.tree("ea"), pd.read_csv(ROWS)
    built, motion = load_model(MODEL).network(), probcal.ConstantVelocity(0.5)
    whole = probcal.Problem(built, motion, table)  # in which nothing is fixed and the noise level is a guess
    again = probcal.track(whole, done)
    for (_, new), (_, old) in zip(each_track(again), each_track(done), strict=True):
        np.testing.assert_allclose(new["mean"].values, old["mean"].values, rtol=1e-3, atol=1e-3)
        ratio = new["sd"].values / old["sd"].values  # each is widened by draws that know an sd to 6 %
        np.testing.assert_allclose(ratio, 1.0, atol=0.12)
    part = probcal.Problem(built, motion, table[table["sensor"] != "c"])
    assert len(probcal.track(part, done).probcal.tracks()) == 16
    with pytest.raises(probcal.InputError, match='no row of sensor "c"'):
        probcal.fit(part, probcal.MAP())


@pytest.mark.ci
def test_a_check_says_what_the_data_determine_and_draws_it(tmp_path):
    code, out, err = call("check", MODEL, ROWS, "--out", tmp_path / "check")
    assert code == 0, err
    for words in (
        f"{len(pd.read_csv(ROWS))} rows of 3 sensors, 2 target(s), 16 epochs",
        "another pass",
        "one more gauge at",
        "a survey of",
    ):
        assert words in out
    frame = pd.read_csv(tmp_path / "check" / "check.csv")
    assert list(frame.columns) == ["bias", "unit", "scale", "kind", "sd", "share", "verdict"]
    assert list(frame["bias"]) == list(committed.tree("ea")["calibration"]["bias_label"].values)
    assert image.imread(tmp_path / "check" / "check.png").shape[0] > 300
    with xr.open_datatree(tmp_path / "check" / "check.nc", engine="h5netcdf") as tree:
        assert tree.attrs["status"] in ("determined", "weak")


def test_a_scenario_is_simulated_with_its_truth_and_twice_the_same(tmp_path):
    for name in ("one", "two"):
        code, out, err = call("simulate", MODEL, "--seed", 3, "--out", tmp_path / f"{name}.csv")
        assert code == 0, err
        assert f"({len(pd.read_csv(tmp_path / f'{name}.csv'))} rows)" in out
    for suffix in (".csv", ".tracks.csv", ".biases.csv"):
        assert (tmp_path / f"one{suffix}").read_text() == (tmp_path / f"two{suffix}").read_text()
    assert pd.read_csv(tmp_path / "one.csv").columns.tolist() == pd.read_csv(ROWS).columns.tolist()


def test_fixing_a_bias_takes_it_out_of_the_problem():
    _, problem = load_problem(MODEL, ROWS, ["b.*"])
    assert not [label for label in problem.labels if label.startswith("b.")]
    assert "c.range_offset" in problem.labels
    assert problem.fixed["b.position_x"] == 0.0


def test_a_prior_that_is_none_is_refused(model, rows):
    model.write_text(model.read_text() + '\nPRIOR = "ard"\n')
    code, _, err = call("fit", model, rows)
    assert code == 2
    assert "PRIOR is 'ard'; give a prior of probcal, such as Horseshoe()" in err


def test_a_model_may_bring_its_prior(model):
    model.write_text(model.read_text() + '\nfrom probcal import ARD\nPRIOR = ARD(by="node")\n')
    module = load_model(model)
    for method, name, wanted in (
        ("ea", (), probcal.ARD(by="node")),
        ("ea", ("ard",), probcal.ARD()),
        ("map", (), None),
        ("ea", ("*.delay=gaussian",), probcal.ARD(by="node", kinds={"*.delay": probcal.Gaussian()})),
        ("ea", ("ard", "*.delay=gaussian"), probcal.ARD(kinds={"*.delay": probcal.Gaussian()})),
        ("map", ("*.delay=laplace",), probcal.Laplace(kinds={"*": probcal.Gaussian(), "*.delay": probcal.Laplace()})),
    ):
        assert prior_named(module, *METHODS[method], name) == wanted
    assert prior_named(load_model(MODEL), *METHODS["ea"]) is None
    kinds = {"*.delay": probcal.Gaussian()}
    module.PRIOR = kinds
    assert prior_named(module, *METHODS["ea"]) == probcal.Horseshoe(kinds=kinds)


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
    "duplicate row": (lambda t: t + t.splitlines()[1] + "\n", 'has a second "range" at time 0 (first in row 2); keep one, or name two targets in the column "target"'),
    "empty table": (lambda t: t.splitlines()[0] + "\n", "bad.csv has no rows"),
    "empty file": (lambda t: "", "bad.csv is not a CSV table"),
    "one row": (lambda t: "\n".join(t.splitlines()[:2]) + "\n", "bad.csv has one measured row only"),
    "sensor without rows": (lambda t: "\n".join(r for r in t.splitlines() if "gauge_2" not in r), 'bad.csv has no row of sensor "gauge_2"'),
    "no sensor column": (lambda t: t.replace("sensor", "sensr", 1), 'bad.csv has no column "sensor"; did you mean "sensr"?'),
    "zero std": (lambda t: t.replace("range", "range,range_std", 1).replace("\n", ",0\n").replace("_std,0", "_std"), 'column "range_std": std is 0; it must be positive'),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_a_bad_table_gets_one_sentence_and_code_2(name, model, rows, tmp_path):
    change, text = BAD[name]
    code, out, err = call("fit", model, edit(rows, change), "--out", tmp_path / "fit")
    assert code == 2
    assert text in err
    assert err.count("\n") == 1
    assert out == ""
    assert not list((tmp_path / "fit").iterdir())


def test_binary_garbage_is_refused(model, tmp_path):
    path = tmp_path / "garbage.csv"
    path.write_bytes(os.urandom(4000))
    code, _, err = call("fit", model, path)
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
def test_a_bad_model_gets_one_sentence_and_code_2(text, message, tmp_path):
    path = tmp_path / "model.py"
    path.write_text(text)
    code, _, err = call("fit", path)
    assert code == 2
    assert message in err
    assert err.count("\n") == 1


def test_other_bad_arguments(model, rows, tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("")
    for name in ("...csv", "fits.csv.csv", " .csv", "a\x1bb.csv"):
        (tmp_path / name).write_bytes(rows.read_bytes())
    cases = [
        (("fit", tmp_path / "none.py"), "no such model file"),
        (("fit", model, tmp_path / "none.csv"), "no such file"),
        (("fit", model, rows, "--out", blocked / "fit"), "cannot be written"),
        (("fit", model, rows, "--method", "eaa"), 'did you mean "ea"?'),
        (("fit", model, rows, "--prior", "gausian"), 'did you mean "gaussian"?'),
        (("fit", model, rows, "--align", "scale"), '--align "scale": give rigid or similarity'),
        (("fit", model, rows, "--align", "rigid"), "there is no truth to lay the answer on; put one beside"),
        (("fit", model, rows, "--epoch", "-1"), "--epoch -1: give a positive number from 1e-12 to 1e+12 in size"),
        (("watch", model, rows, "--jumps", "1e-320"), "--jumps 9.99989e-321: give a positive number"),
        (("watch", model, rows, "--within=-inf"), "--within -inf: give a positive number"),
        (("watch", model, rows, "--every", "1e22"), "--every 1e+22: give 0 or a positive number"),
        (("watch", model, rows, "--every", "nan"), "--every nan: give 0 or a positive number"),
        (("levels", "none.wav", "--out", tmp_path / "a.csv", "--start=-1e99"), "--start -1e+99: give a number from"),
        (("watch", model, rows, "--walk", "*=inf"), '--walk "*=inf": write PATTERN=STD, the positive'),
        (("fit", model, rows, tmp_path / "...csv", "--out", tmp_path / "days"), 'cannot be fitted into a folder ".."'),
        (("fit", model, rows, tmp_path / "fits.csv.csv", "--out", tmp_path / "days"), 'into a folder "fits.csv" of'),
        (
            ("fit", model, rows, tmp_path / " .csv", "--out", tmp_path / "days"),
            'has the blank name " "; give it letters',
        ),
        (
            ("fit", model, rows, tmp_path / "a\x1bb.csv", "--out", tmp_path / "days"),
            "has control characters in its name",
        ),
        (("fit", model, rows, "--prior", "gaussian"), "EA does not take the prior Gaussian; it takes: laplace"),
        (("fit", model, rows, "--fix", "gauge_9.*"), 'no bias is called "gauge_9.*"'),
        (("fit", model, rows, "--fix", "*"), "no free bias"),
        (("fit", model, rows, "--set", "sped=1"), "problem() has no argument sped; it takes the data alone"),
        (("fit", model, rows, "--set", "speed"), '--set "speed": write name=value'),
        (("check", model, rows, "--set", "a=1", "--set", "a=2"), "--set a: it is given twice; write a=value,value"),
        (("track", model, rows), "track needs --calibration DIR"),
        (("track", model, rows, "--calibration", tmp_path), "is not a fit written by probcal"),
        (("report", tmp_path), "is not a fit written by probcal"),
        (("simulate", model), "defines no scenario()"),
    ]
    for arguments, text in [case for case in cases if case[0][0] in INSTALLED]:
        code, _, err = call(*arguments)
        assert code == 2, arguments
        assert text in err
        assert err.count("\n") == 1
    for count in (("fit", model, "--starts"), ("track", model, "--particles"), ("fit", model, "--chains")):
        code, _, err = call(*count, 10**23)
        assert code == 2, count
        assert "Invalid value" in err


@pytest.mark.ci
def test_arguments_of_a_model_come_from_the_command_line(rows, tmp_path):
    path = tmp_path / "wide.py"
    text = SMALL.replace("STD", "1.0").replace("SCALE", "2.0")
    text = text.replace("data=None):", "data=None, *, motion=9.0, places=(), name=''):").replace("(0.5)", "(motion)")
    path.write_text(text + "\ndef truth(data=None, motion=0.0):\n    seen.append(motion)\n\nseen = []\n")
    given = {"motion": 0.25, "places": (3, 4), "name": "a"}
    module, problem = load_problem(path, rows, (), given)
    assert "0.25" in repr(problem.motion)
    load_truth(module, path, rows, problem, given)
    assert module.seen == [0.25], "the truth takes those that it has"
    with pytest.raises(probcal.InputError, match=r"has no argument motio; did you mean .motion"):
        load_problem(path, rows, (), {"motio": 1})
    given = ("--set", "motion=0.25", "--set", "places=3,4", "--set", "name=a")
    code, _, err = call("fit", path, rows, *given, "--method", "map", "--no-assess", "--out", tmp_path / "fit")
    assert code in (0, 1), err
    assert probcal.load(tmp_path / "fit").attrs["set"] == "motion=0.25, places=(3, 4), name=a"


def test_a_fit_that_fails_to_be_written_leaves_nothing_behind(tmp_path, monkeypatch):
    def broken(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(xr.DataTree, "to_netcdf", broken)
    with pytest.raises(OSError, match="No space"):
        probcal.save(committed.tree("ea"), tmp_path / "fit.nc")
    assert not list(tmp_path.glob("*fit.nc*"))


def test_the_recording_of_a_model_is_taken_where_none_is_given(model, rows):
    model.write_text(model.read_text().replace("data=None", f"data={str(rows)!r}"))
    assert load_problem(model, None)[1].measurements.table.source == "rows.csv"


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (["--method", "collapsed", "--resume"], "--resume needs --out, the folder of the run to go on with"),
        (
            ["--method", "map", "--draws", "10"],
            '--draws: "map" draws no chains; take mcmc, collapsed, nuts, gibbs or svi',
        ),
        (
            ["--method", "svi", "--effective", "10"],
            '--effective is not for the method "svi"; leave it out, or take mcmc',
        ),
    ],
)
def test_options_of_samplers_are_checked(options, text, model, rows):
    code, _, err = call("fit", model, rows, *options)
    assert code == 2
    assert text in err


def test_draws_of_states_and_replicas_are_saved_where_asked_for(fitted, tmp_path):
    code, _, err = call("fit", MODEL, ROWS, "--no-assess", "--save", "states,predictive", "--out", tmp_path / "fit")
    assert code == 0, err
    for folder, wanted in ((fitted[0], set()), (tmp_path / "fit", {"state", "posterior_predictive"})):
        tree = probcal.load(folder)
        assert {"state", "posterior_predictive"} & {*tree["track/car"].data_vars, *tree.children} == wanted
