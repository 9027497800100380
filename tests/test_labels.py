"""Labels of sensors that were exchanged: robust noise does not hide them, and the true places are found."""

import re
from copy import copy
from functools import cache

import jax
import numpy as np
import pytest
from scipy import stats

import probcal as pc
from probcal.gaussian.information import rejected
from probcal.gaussian.mode import Point
from probcal.geometry import norm
from probcal.inference.ending import misfit_sentence
from probcal.misfit import rejection_text
from probcal.modes import optima
from probcal.modes.swaps import swaps
from probcal.noise import AdditiveNoise, Bernoulli, Censored, Mixture, Normal, StudentT
from probcal.types import float64

PLACES = np.array([(0, 0), (95, 10), (120, 80), (60, 130), (-20, 110), (-40, 40), (45, 60)], float)
EPOCHS = 15
TIME = np.arange(float(EPOCHS))
PATH = np.stack([40 + 60 * np.sin(0.3 * TIME), 60 + 50 * np.cos(0.4 * TIME)], 1)


@pc.sensor(range=pc.Channel("m", std=0.5, noise=StudentT(4)))
def gauge(target, pose):
    return dict(range=norm(target.position - pose.position))


@cache
def world(carried, epochs=EPOCHS):
    """Seven gauges, each at the place that another one is stated at; the true biases."""
    nodes = [pc.Node(f"n{k}", place, scale={"position": 1.0}) for k, place in enumerate(PLACES)]
    network, motion = pc.Network([gauge.on(node) for node in nodes]), pc.ConstantVelocity(1.0)
    shift = PLACES[list(carried)] - PLACES
    biases = {f"n{k}.position_{x}": shift[k, i] for k in range(7) for i, x in enumerate("xy")}
    tracks = {"target": PATH[:epochs]}
    run = pc.simulate(network, motion, TIME[:epochs], key=0, biases=biases, tracks=tracks)
    problem = pc.Problem(network, motion, run.table)
    return problem, np.array([biases[label] for label in problem.labels])


SOUND, PAIR, CYCLE = (0, 1, 2, 3, 4, 5, 6), (0, 3, 2, 1, 4, 5, 6), (0, 3, 1, 2, 4, 5, 6)


@pytest.mark.parametrize("df", [1.5, 4.0])
def test_a_student_t_expects_the_fraction_of_its_distribution(df):
    assert abs(StudentT(df).rejects - 2 * stats.t.sf(np.sqrt(df), df)) < 1e-9


def test_the_quadrature_of_another_family_agrees_with_it():
    assert abs(AdditiveNoise.rejects.fget(StudentT(4.0)) - StudentT(4.0).rejects) < 1e-3


@pytest.mark.parametrize("family", [Mixture(0.1, 10.0), Mixture(0.2, 4.0, delay=6.0)], ids=repr)
def test_a_mixture_expects_the_fraction_that_is_drawn(family):
    with jax.enable_x64(True):
        zero, one = np.zeros(40_000), np.ones(40_000)
        relied = jax.jit(lambda key: family.reliance(family.sample(key, zero, one), zero, one, None))
        low = np.asarray(relied(jax.random.key(0))) < 0.5
    assert abs(family.rejects - low.mean()) < 0.006


@pytest.mark.parametrize("family", [Normal(), Censored(-90.0), Bernoulli()], ids=repr)
def test_a_family_without_heavy_tails_rejects_nothing(family):
    assert family.rejects == 0.0


def there(problem, z):
    """The point of the true path at biases z."""
    (part,) = problem.model.recursions
    path = PATH[: len(part.drift)]
    states = np.c_[path, np.zeros_like(path)]
    return Point((states,), (np.zeros(part.drift.shape),), np.asarray(z), np.zeros(0))


@float64
def test_sensors_whose_labels_were_exchanged_are_rejected():
    problem, true = world(PAIR)
    assert not rejected(problem, there(problem, true))
    stated = there(problem, 0.0 * true)
    found = {one.sensor: one for one in rejected(problem, stated)}
    assert set(found) == {"n1", "n3"}
    assert found["n1"].data == EPOCHS
    assert 0.6 * EPOCHS < found["n1"].below <= EPOCHS
    said = misfit_sentence(problem, stated, 1.0)
    assert said.startswith("The robust noise gives less than half weight to most data of n")
    assert re.search("where 1[23]% is expected. Check whether labels of sensors are exchanged", said)


@float64
def test_a_std_that_is_too_small_for_all_sensors_rejects_none():
    """It is a wider noise, not a gross error of one: four times too small, then forty times."""
    problem, true = world(SOUND)
    point, wide = there(problem, true), copy(problem)
    (predicted,), (measured,) = problem.model.predict(point), problem.model.values
    for times, count in ((4.0, 0), (40.0, 7)):
        wide.model = problem.model.with_values([predicted + times * (measured - predicted)])
        assert len(rejected(wide, point)) == count


@float64
def test_few_data_show_no_rejection():
    """All of four data may lie far off where a place takes up two of them: of 15 they may not."""
    few, _ = world(PAIR, epochs=4)
    assert not rejected(few, there(few, np.zeros(14)))


@pytest.mark.ci
@float64
def test_exchanged_labels_are_found_under_robust_noise():
    """The mode at the stated labels rejects both sensors; the best start has them exchanged."""
    problem, true = world(PAIR)
    found = optima(problem)[0].point
    assert np.abs(np.asarray(found.z) - true).max() < 3.0


def test_what_is_not_rejected_is_not_said():
    assert rejection_text([]) == ""


def test_exchanges_follow_each_other_to_a_cycle():
    problem, true = world(CYCLE)
    first = swaps(problem)["n1", "n3"]
    assert np.abs(swaps(problem, first)["n2", "n3"] * problem.scales - true).max() < 1e-9


@pytest.mark.ci
@pytest.mark.parametrize("carried", [PAIR, CYCLE], ids=["pair", "cycle"])
def test_exchanged_labels_end_at_bound_under_robust_noise(carried):
    problem, true = world(carried)
    tree = pc.fit(problem)
    assert tree.attrs["status"] == "at bound"
    assert np.abs(tree["calibration"]["mean"].values - true).max() < 3.0


@pytest.mark.ci
def test_a_prior_that_forbids_the_exchange_ends_in_a_misfit():
    problem, _ = world(PAIR)
    tree = pc.fit(problem, pc.MAP())
    assert tree.attrs["status"] == "misfit"
    assert "n3.range (15 of 15)" in tree.attrs["message"]
    assert pc.fit(world(SOUND)[0], pc.MAP()).attrs["status"] == "converged"


@pytest.mark.ci
def test_tracks_at_a_calibration_name_sensors_that_were_exchanged_since():
    calibrated = pc.fit(world(SOUND)[0], pc.MAP())
    assert "robust noise" not in pc.track(world(SOUND)[0], calibrated).attrs["message"]
    assert "n3.range (15 of 15)" in pc.track(world(PAIR)[0], calibrated).attrs["message"]
