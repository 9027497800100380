"""Studies: the same fits as one by one, and scenarios C1 and C2 against the figures of the trial (runs 0 to 7)."""

import sys
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
import xarray as xr
from worlds import heights

import probcal
from probcal import EA, EMEA, MAP, Flat, load_study, study
from probcal.cli import names
from probcal.cli.options import parse_values
from probcal.diagnostics import study_table
from probcal.errors import InputError
from probcal.inference.fit import calibrate
from probcal.inference.method import State
from probcal.inference.run import stepped
from probcal.plots import plot_study
from probcal.status import Status
from probcal.studies.study import ORACLE

sys.path.insert(0, str(Path(__file__).parents[1] / "models"))
import radars

# mean normalised RMS over runs 0-7: EM-EA, EA, MAP that knows the zeros
TRIAL = {
    ("C1", 0.1): (0.089, 0.091, 0.028),
    ("C1", 0.3): (0.153, 0.142, 0.072),
    ("C1", 0.6): (0.238, 0.235, 0.139),
    ("C2", 0.1): (0.157, 0.171, 0.066),
    ("C2", 0.3): (0.263, 0.265, 0.148),
    ("C2", 0.6): (0.410, 0.391, 0.233),
}


def check(scenario, shares, runs):
    found = study(radars.setting, {"scenario": [scenario], "share": shares}, runs=runs)
    mean = found["bias_rmse"].mean("run").sel(scenario=scenario)
    for share in shares:
        for method, figure in zip(("em-ea", "ea", "oracle"), TRIAL[scenario, share], strict=True):
            assert mean.sel(share=share, estimator=method) < 1.15 * figure, (scenario, share, method)
            assert mean.sel(share=share, estimator="ml") > 2 * mean.sel(share=share, estimator=method)
    return found


class Lost:
    """A method whose objective is lost at every step."""

    def iterate(self, model, prior, given, state):
        return state._replace(objective=jnp.array(jnp.nan), done=jnp.array(False))


def test_a_climb_that_has_lost_its_objective_ends():
    blank = State(*[None] * len(State._fields))
    state = blank._replace(objective=jnp.array(-jnp.inf), done=jnp.array(False))
    model = SimpleNamespace(with_mixing=lambda _: None)
    once = stepped(Lost(), model, None, None, state)
    assert not once.done
    assert stepped(Lost(), model, None, None, once).done


@pytest.mark.slow
def test_c1_at_one_share_reproduces_the_trial_and_equals_single_fits():
    found = check("C1", (0.3,), 8)
    assert (found["status"].sel(estimator=["ea", "em-ea", "oracle"]) != "at bound").all()
    problem, truth = radars.setting(5, share=0.3, scenario="C1")
    for name, method, prior in (("ea", EA(), None), ("em-ea", EMEA(), None), ("ml", MAP(), Flat())):
        tree = probcal.fit(problem, method, prior=prior)
        one = found.sel(scenario="C1", share=0.3, estimator=name, run=5)
        group = tree["calibration"].to_dataset()
        z = group["mean"].values / problem.scales
        np.testing.assert_allclose(one["error"].values + one["true"].values, z, atol=1e-6)
        np.testing.assert_allclose(one["gamma"].values, group["gamma"].values, atol=1e-6)
        scores = probcal.scores(tree, truth)
        assert float(one["bias_rmse"]) == pytest.approx(scores["bias_rmse"], abs=1e-6)
        assert float(one["position_rmse"]) == pytest.approx(scores["position_rmse_after"], abs=1e-5)
        assert float(one["coverage"]) == pytest.approx(scores["coverage"])
        assert str(one["status"].values) == tree.attrs["status"]
    table = study_table(found)
    assert list(table["method"]) == ["ml", "em-ea", "ea", "oracle"]
    assert table["runs"].tolist() == [8] * 4
    assert (table[[str(status) for status in Status]].sum(axis=1) == 8).all()


@pytest.mark.ci
def test_each_fit_of_a_study_is_that_of_fit_alone():
    """Of run 7 a bias lies beyond ten scales on the way and comes back; of run 8 maximum likelihood diverges."""
    methods = {"ml": (MAP(), Flat()), "ea-printed": EA.as_printed()}
    found = study(radars.setting, {"scenario": ["C2"]}, methods, runs=[7, 8]).sel(scenario="C2")
    assert found["status"].sel(estimator="ml").values.tolist() == ["converged", "diverged"]
    for run in found["run"].values:
        problem, _ = radars.setting(run, scenario="C2")
        for name, value in methods.items():
            method, prior = value if isinstance(value, tuple) else (value, None)
            answer = calibrate(problem, method, prior=prior)[1]
            one, alone = found.sel(estimator=name, run=run), answer.posterior.summary
            np.testing.assert_allclose(
                one["error"] + one["true"], alone.mean, atol=1e-6 * max(1, abs(alone.mean).max())
            )
            np.testing.assert_allclose(one["sd"], alone.sd, rtol=1e-5)  # of fits that diverge: rounding grows
            assert (str(one["status"].values), int(one["iterations"])) == (str(answer.status), answer.iterations)


@pytest.mark.ci
def test_runs_that_survey_other_nodes_keep_their_own_priors():
    def setting(run, own=True):
        problem, truth = heights(run)
        problem.surveyed = np.arange(2) == (run if own else 0)
        return problem, truth

    both, alone, other = (
        study(partial(setting, own=own), {}, {"ea": EA(precisions="maximised")}, runs=runs)["sd"].sel(run=1)
        for own, runs in ((True, [0, 1]), (True, [1]), (False, [1]))
    )
    np.testing.assert_array_equal(both, alone)
    assert (both != other).all()


@pytest.mark.slow
def test_a_study_whose_fits_are_more_than_one_climb_runs_them_as_fit_does():
    @probcal.sensor(range=probcal.Channel("m", std=1.0))
    def anchor(target, pose, *, offset=probcal.Bias("m", 6.0, shared="type")):
        return {"range": jnp.sqrt(jnp.sum((target.position - pose.position) ** 2) + 1e-6) + offset}

    places = {"a0": (0.0, 0.0), "a1": (40.0, 0.0), "a2": (0.0, 40.0)}
    network = probcal.Network([anchor.on(probcal.Node(name, place)) for name, place in places.items()])
    heard = [("t0", "a0", 21.0), ("t0", "a1", 35.0), ("t1", "a1", 30.0), ("t2", "a0", 18.0), ("t2", "a2", 33.0)]
    table = pd.DataFrame(heard, columns=["target", "sensor", "range"]).assign(time=0.0)
    motion = probcal.Target(probcal.Static(), {"position": ((15.0, 12.0), 10.0)})
    problem, truth = probcal.Problem(network, motion, table), probcal.Truth(biases={"anchor.offset": 0.0})
    found = study(lambda run, k: (problem, truth), {"k": [0]}, {"map": MAP()}, runs=1).isel(k=0, run=0, estimator=0)
    tree, _ = calibrate(problem, MAP())
    mean = tree["calibration"]["mean"].values / problem.scales
    np.testing.assert_allclose(found["error"].values, mean, atol=1e-6)
    assert tree.attrs["places"] == "integrated"


def test_values_of_settings():
    assert parse_values("share=0:1:0.25") == ("share", [0, 0.25, 0.5, 0.75, 1.0])
    assert parse_values("scenario=C1,C2") == ("scenario", ["C1", "C2"])
    assert parse_values("K=25,50") == ("K", [25, 50])
    for text, wanted in (
        ("share", "write name=value"),
        ("=1", "write name=value"),
        ("share=1,,2", "write name=value"),
        ("share=1:0:0.1", "the step does not lead from 1 to 0"),
        ("share=0:1:0", "the step does not lead"),
        ("share=0:inf:1", "the step does not lead"),
    ):
        with pytest.raises(InputError, match=wanted):
            parse_values(text)


ERRORS = [
    (lambda: study(heights, {}, ["eaa"]), 'method "eaa" is not known; did you mean "ea"'),
    (lambda: study(heights, {"size": []}, ["ea"]), "give at least one run, one method and one value"),
    (lambda: study(heights, {"size": "12"}, ["ea"]), "the values of size are '12'; give a list of values"),
    (lambda: study(heights, {"size": 2}, ["ea"]), "the values of size are 2; give a list of values"),
    (lambda: study(heights, {"size": [1, 1]}, ["ea"]), "a value of size is given twice; give every value once"),
    (lambda: study(heights, {"size": [(1, 2)]}, ["ea"]), "the values of size must be numbers or texts"),
    (lambda: study(heights, {"sd": [1]}, ["ea"]), 'a setting cannot be called "sd"'),
    (lambda: study(heights, {}, ["ea"], runs=[1, 1]), "a run is given twice"),
    (lambda: study(heights, {}, ["em"], scheduler=8786), 'scheduler is 8786; give "local", the address of a dask'),
    (lambda: study(heights, {}, {"a": "ea"}), "study: method \"a\" is 'ea'; give a method such as EA()"),
    (lambda: study(heights, {}, {"a": (MAP(), probcal.Horseshoe())}), "MAP does not take the prior Horseshoe"),
    (lambda: study(lambda run: heights(run)[0], {}, ["ea"]), "must return a pair, the Problem and its Truth"),
    (lambda: study(lambda run: (heights(run)[0], probcal.Truth()), {}, ["ea"]), 'does not name the bias "n0.shift"'),
]
LATE = (lambda: study(heights, {"size": [1, 2]}, ["em"], runs=1), "the settings have different biases")  # after a fit


@pytest.mark.parametrize(
    ("call", "text"),
    [*ERRORS, pytest.param(*LATE, marks=pytest.mark.slow)],
    ids=[text[:40] for _, text in (*ERRORS, LATE)],
)
def test_errors_of_studies(call, text):
    with pytest.raises(InputError) as error:
        call()
    assert text in str(error.value)


@pytest.mark.ci
def test_a_study_is_resumed_with_the_same_numbers(tmp_path):
    """Stopped, taken up for more runs, a file lost; an edited model is refused."""
    whole = study(heights, {}, ["em", "ml"], runs=25)

    def stop(at):
        if at.done >= 20:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        study(heights, {}, ["em", "ml"], runs=21, store=tmp_path, progress=stop)
    assert 20 <= int((load_study(tmp_path)["status"] != "").sum()) < 42
    seen = []
    for lost in ("error/c/0/0/0", "status/c/0/2"):
        again = study(heights, {}, ["em", "ml"], runs=25, store=tmp_path, resume=True, progress=seen.append)
        xr.testing.assert_equal(again, whole)
        xr.testing.assert_identical(again, load_study(tmp_path))
        (tmp_path / "fits.zarr" / lost).unlink()
    assert seen[-1][:4] == ("fits", 50, 50, None)
    with pytest.raises(InputError, match="the list of methods has changed since the run there began"):
        study(heights, {}, ["em"], runs=25, store=tmp_path, resume=True)
    with pytest.raises(InputError, match=r"holds the fits of a study already; give --resume"):
        study(heights, {}, ["em", "ml"], runs=25, store=tmp_path)

    def edited(run, size=2):
        return heights(run + 1, size)

    with pytest.raises(InputError, match=r"gives another problem than .* began: the model has changed"):
        study(edited, {}, ["em", "ml"], runs=25, store=tmp_path, resume=True)
    fresh = study(edited, {}, ["em", "ml"], runs=2, store=tmp_path, overwrite=True)
    assert fresh["error"].sel(run=0).equals(whole["error"].sel(run=1).assign_coords(run=0))


@pytest.mark.ci
def test_a_study_without_a_number_has_no_picture():
    found = study(heights, {}, ["em"], runs=2)
    with pytest.raises(InputError, match="no setting of the study is a number"):
        plot_study(found)
    assert "sd" not in study_table(found.isel(run=[0]))


@pytest.mark.slow
@pytest.mark.parametrize("scenario", ["C1", "C2"])
def test_trial_is_reproduced_at_three_shares(scenario):
    found = check(scenario, (0.1, 0.3, 0.6), 8)
    if scenario == "C2":  # where ML runs away it says so
        ml = found.sel(estimator="ml")
        assert (ml["status"].values[ml["bias_rmse"].values > 5] == "diverged").all()


def test_a_setting_that_is_no_function_is_refused():
    problem, _ = heights(0, size=2)
    with pytest.raises(InputError, match=r"study: setting is of type Problem; give a function setting\(run, "):
        study(problem, {})


def test_the_command_line_names_the_oracle():
    assert names.ORACLE == ORACLE
