"""One contract for all engines: at one point every member of an expansion agrees with that of every other."""

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import worlds
from reference import Naive, NaiveEngine
from sparse_worlds import drawn, drawn_in_space, loud

import probcal as pc
from probcal.errors import InputError
from probcal.gaussian.choose import ENGINES as CALLED
from probcal.gaussian.engine import Factors, Group, evidence, noise_score
from probcal.gaussian.jointly import Variables, covariance_times
from probcal.gaussian.linearised import laplace
from probcal.gaussian.mode import find_tracks
from probcal.inference.fit import calibrate
from probcal.model.model import Tilt
from probcal.modes import automatic_start
from probcal.types import float64

EXACT = ("dense", "cholmod", pytest.param("superlu", marks=pytest.mark.ci))
REFUSED = ("states", "noises", "predicted", "leverages", "noise_score")  # by an engine that estimates


WORLDS = ("flat", *(pytest.param(name, marks=pytest.mark.ci) for name in ("space", "loud", "correlated", "placed")))


@cache
def expanded(name):
    """A model, a point whose tracks are at their mode, and the factors of a prior, of sites and of a survey."""
    if name == "loud":
        problem = loud()
    else:  # three targets in 2-D, one of which rests; two in 3-D with mixed sensors
        problem = (drawn_in_space if name == "space" else drawn)()[0]
        run = pc.simulate(problem.network, problem.motion, np.arange(7.0), key=1)
        rows = run.table.sample(frac=0.7, random_state=1)  # at times of their own
        rows.loc[rows.index[::9], rows.columns[3:].intersection(["azimuth"])] = np.nan
        problem = pc.Problem(problem.network, problem.motion, rows)
    with jax.enable_x64(True):
        M, rng = problem.model.biases, np.random.default_rng(5)
        model = problem.model
        if name == "placed":  # what integrated places add
            root = rng.standard_normal((M, M))
            model = model.with_tilt(Tilt(np.zeros(M), np.array(0.4), rng.standard_normal(M), root @ root.T / M))
        point = automatic_start(problem)
        point = find_tracks(model, point._replace(z=point.z + 0.1 * rng.standard_normal(M)), 50, 1e-13)
        prior = pc.Gaussian(correlation={"*.position_x": 0.5} if name == "correlated" else ())
        factors = Factors.of(prior.precision(problem.labels, problem.surveyed))
        members = np.stack([np.arange(M), np.roll(np.arange(M), 1)], 1)[:3]
        site = np.broadcast_to(np.array([[2.0, 0.5], [0.5, 1.0]]), (3, 2, 2))
        sites = Factors((Group(members, jnp.asarray(site), jnp.asarray(rng.standard_normal((3, 2)))),))
        return problem, model, point, factors + sites


@cache
def at(engine, name):
    """An expansion at the point of a world."""
    with jax.enable_x64(True):
        _, model, point, _ = expanded(name)
        return (NaiveEngine() if engine == "naive" else CALLED[engine]()).at(model, point)


def agree(one, other, tolerance=1e-8):
    """Trees of arrays agree to a share of the largest entry of each."""
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        a, b = np.asarray(a), np.asarray(b)
        assert a.shape == b.shape
        np.testing.assert_allclose(a, b, rtol=tolerance, atol=tolerance * max(np.abs(b).max(initial=0.0), 1e-12))


def responses_of(own, factors, M):
    """The joint covariance times two slopes by states and biases."""
    rng = np.random.default_rng(8)
    states = tuple(jnp.asarray(rng.standard_normal((*part.drift.shape, 2))) for part in own.model.recursions)
    slopes = Variables(states, jnp.asarray(rng.standard_normal((M, 2))))
    return own.respond(factors, slopes) if isinstance(own, Naive) else covariance_times(own, factors, slopes)


MEMBERS = {  # what each is asked with
    "density": lambda own, *_: own.density(),
    "slope": lambda own, *_: own.slope(),
    "log_det": lambda own, factors, *_: own.log_det(factors).value,
    "solve": lambda own, factors, M: (own.solve(factors, np.eye(M)), own.solve(factors, np.ones(M))),
    "apply": lambda own, _, M: (own.apply(np.eye(M)), own.apply(np.ones(M))),
    "moved": lambda own, _, M: own.moved(0.1 * np.arange(M)),
    "marginals": lambda own, factors, M: own.marginals(factors, np.array([[0, 1, M], [M - 1, 2, 0]])),
    "states": lambda own, factors, _: own.states(factors),
    "held_states": lambda own, *_: own.held_states,
    "noises": lambda own, factors, _: own.noises(factors),
    "predicted": lambda own, factors, _: own.predicted(factors),
    "leverages": lambda own, factors, _: own.leverages(factors),
    "noise_score": lambda own, factors, _: noise_score(own, factors),
    "respond": lambda own, factors, M: responses_of(own, factors, M),
}  # fmt: skip


def test_what_rounding_leaves_below_zero_is_no_information():
    """A target in a sensor: the information loses its digits, the variances stay those of a prior."""
    with jax.enable_x64(True):
        whole, M = at("dense", "flat"), expanded("flat")[1].biases
        worse = whole.information().copy()
        worse[0, 0] -= 3.0 * np.trace(worse)
        lost = replace(whole, eliminated=whole.eliminated._replace(information=jnp.asarray(worse)), _kept=[])
        variance = np.asarray(lost.marginals(Factors.alone(np.ones(M)), np.arange(M)[:, None]))
        assert (variance > 0.0).all()
        assert (variance <= 1.0 + 1e-9).all()


@pytest.mark.ci
def test_a_third_engine_runs_fit_and_assess():
    """A stranger's class with the members of `Engine`: answer and verdicts are those of the dense one."""
    problem, trees = worlds.small(scans=8), []
    for engine in ("dense", NaiveEngine()):
        tree, _ = float64(calibrate)(problem, pc.MAP(engine=engine), prior=pc.Gaussian())
        trees.append(pc.assess(problem, tree))
    one, other = (tree["calibration"].to_dataset() for tree in trees)
    off = np.abs(one["mean"] - other["mean"]) / one["sd"]
    assert off.max() < 0.02
    np.testing.assert_allclose(other["sd"], one["sd"], rtol=0.02)
    assert trees[1].attrs["log_evidence"] == pytest.approx(trees[0].attrs["log_evidence"], abs=1e-3)
    one, other = (tree["verdict"]["verdict"].values.tolist() for tree in trees)
    assert other == one
    one, other = (tree["halves"]["t"].values for tree in trees)
    np.testing.assert_allclose(other, one, atol=0.02)


def test_the_old_word_for_an_engine_says_the_new_one():
    for given in ({"form": "matrix-free"}, {"engine": "matrix-free"}):
        (word,) = given
        with pytest.warns(FutureWarning, match=rf'MAP\({word}="matrix-free"\) is MAP\(engine="iterative"\) now'):
            assert pc.MAP(**given).engine == "iterative"
    with pytest.warns(FutureWarning, match='is EA\\(engine="(cholmod|superlu)"\\) now'):
        pc.EA(engine="sparse")


@pytest.mark.parametrize("name", WORLDS)
@pytest.mark.parametrize("member", MEMBERS)
@pytest.mark.parametrize("engine", EXACT)
def test_every_member_of_an_engine_is_that_of_the_naive_one(engine, member, name):
    with jax.enable_x64(True):
        _, model, _, factors = expanded(name)
        ask = MEMBERS[member]
        agree(*(ask(at(own, name), factors, model.biases) for own in (engine, "naive")))


@pytest.mark.ci
@pytest.mark.parametrize("engine", [*EXACT, "iterative"])
def test_a_curvature_of_many_biases_is_a_diagonal(engine):
    """Integrated places: what many biases have is as if it stood on the diagonal of a matrix."""
    with jax.enable_x64(True):
        _, model, point, factors = expanded("flat")
        M, rng = model.biases, np.random.default_rng(6)
        own, slope = 1.0 + rng.random(M), rng.standard_normal(M)
        tilts = (Tilt(np.zeros(M), np.array(0.4), slope, curvature) for curvature in (own, np.diag(own)))
        one, other = (CALLED[engine]().at(model.with_tilt(tilt), point) for tilt in tilts)
        agree(*([at.density(), at.score(), at.solve(factors, np.eye(M)), at.apply(np.eye(M))] for at in (one, other)))


@pytest.mark.ci
@pytest.mark.parametrize("name", WORLDS)
def test_an_engine_without_a_factor_solves_estimates_and_refuses(name):
    """Solves to the tolerance of conjugate gradients, estimates within 5 standard errors, the rest in one sentence."""
    with jax.enable_x64(True):
        _, model, _, factors = expanded(name)
        own, naive = at("iterative", name), at("naive", name)
        for member in MEMBERS.keys() - {*REFUSED, "log_det"}:
            agree(*(MEMBERS[member](one, factors, model.biases) for one in (own, naive)), 1e-6)
        found = own.log_det(factors)
        assert abs(found.value - naive.log_det(factors).value) < 5 * found.error
        assert 0 < found.error < 1.0
        found, wanted = own.spread(factors), np.diag(naive.solve(factors, np.eye(model.biases)))
        assert (np.abs(found.biases - wanted) < 5 * found.error).all()
        assert (found.error < 0.2 * wanted).all()
        for member in REFUSED:
            with pytest.raises(InputError, match="without a factor of the biases variances"):
                MEMBERS[member](own, factors, model.biases)


@pytest.mark.ci
@pytest.mark.parametrize("name", WORLDS)
@pytest.mark.parametrize("engine", [*EXACT, "iterative"])
def test_the_score_is_the_slope_of_the_density(engine, name):
    with jax.enable_x64(True):
        agree(at(engine, name).score(), at("naive", name).score(), 1e-4)


@pytest.mark.ci
@pytest.mark.parametrize("name", WORLDS)
@pytest.mark.parametrize("engine", [*EXACT, "naive"])
def test_deviations_have_the_covariance_of_the_biases_and_states(engine, name):
    with jax.enable_x64(True):
        _, model, _, factors = expanded(name)
        own, M, count = at(engine, name), model.biases, 4000
        found = own.deviations(factors, jax.random.key(3), count)
        z, covariance = np.asarray(found.z), np.asarray(own.solve(factors, np.eye(M)))
        sd = np.sqrt(np.diag(covariance))
        np.testing.assert_allclose(z.mean(0) / sd, 0.0, atol=5 / count**0.5)
        np.testing.assert_allclose(np.cov((z / sd).T), covariance / np.outer(sd, sd), atol=8 / count**0.5)
        for drawn_, spread in zip(found.states, own.states(factors), strict=True):
            own_sd = np.sqrt(np.maximum(np.diagonal(np.asarray(spread), axis1=1, axis2=2), 0.0))
            np.testing.assert_allclose(np.asarray(drawn_).std(0), own_sd, rtol=6 / (2 * count) ** 0.5, atol=1e-9)


@pytest.mark.ci
@pytest.mark.parametrize("name", ["flat", "space", "loud", "correlated"])
@pytest.mark.parametrize("engine", EXACT)
def test_the_evidence_is_that_of_laplaces_formula(engine, name):
    with jax.enable_x64(True):
        problem, model, point, _ = expanded(name)
        prior = pc.Gaussian(correlation={"*.position_x": 0.5} if name == "correlated" else ())
        prior = prior.precision(problem.labels, problem.surveyed)
        found = evidence(at(engine, name), prior)
        assert found.error == 0
        np.testing.assert_allclose(found.value, float(laplace(model, point, prior).evidence), rtol=1e-10, atol=1e-8)
