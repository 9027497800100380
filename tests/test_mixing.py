"""When draws may be taken, how more are made where they may not, and how chains cross from one side to another."""

import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest

import probcal
from probcal import MCMC, Collapsed, Gaussian, Gibbs, Problem
from probcal.gaussian.frame import frame_at, log_joint, log_weight, unit_normals, volume
from probcal.inference import mcmc, sampling
from probcal.inference.chains import Draw
from probcal.inference.collapsed import CollapsedState
from probcal.inference.hierarchy import hierarchy_of
from probcal.inference.leaps import Place, leap
from probcal.inference.mixed import Effective, effective_draws, mixing, r_hat_limit, weights_of_sides
from probcal.inference.posed import Form, Posed, conditional, log_prior
from probcal.inference.sampling import thinning
from probcal.inference.sides import distances, shifted
from probcal.modes import automatic_start
from probcal.modes.grid import track_mode
from probcal.modes.mirrors import other_sides

sys.path.insert(0, str(Path(__file__).parents[1] / "models"))
import networks
from worlds import plane, resting

WEIGHT, NORMALS = jax.jit(log_weight), jax.jit(unit_normals)
METHOD = Collapsed(chains=2, warmup=50, draws=100, sweeps=1, patience=4)


def made_of(theta, side, **phi):
    """Draws of values (chain, draw, P) on sides (chain, draw), with hyper-parameters."""
    none = np.zeros(0)
    return Draw(theta, phi, none, none, (), none, {"side": side})


def test_chains_that_agree_have_settled_and_others_have_not():
    random = np.random.default_rng(0)
    draws, side = random.normal(size=(4, 500, 3)), np.zeros((4, 500), int)

    def settled(draws, side, count, wanted=0, **phi):
        return effective_draws(made_of(draws, side, **phi), count, wanted).settled

    assert settled(draws, side, 1)
    assert not settled(draws + np.arange(4)[:, None, None], side, 1), "one chain lies apart"
    assert not settled(np.repeat(draws[:, :100], 5, 1), side, 1), "few are effective"
    apart = side + np.arange(4)[:, None] % 2
    assert not settled(draws, apart, 2), "no chain crosses"
    assert settled(draws + 100.0 * (one := random.integers(0, 2, side.shape))[..., None], one, 2), "sides may differ"
    np.testing.assert_allclose(weights_of_sides(apart, 2), [[0.5, 0.5], [0.5 / np.sqrt(3)] * 2])
    assert settled(draws, side, 1, 1000)
    assert not settled(draws, side, 1, 4000), "so many are not effective"
    stuck = np.repeat(np.exp(draws[:, :50, 0]), 10, 1)
    assert settled(draws, side, 1, scale=stuck)
    assert not settled(draws, side, 1, 1000, scale=stuck), "hyper-parameters count where draws are to be effective"


@pytest.mark.parametrize(("warmup", "draws"), [(100, 500), (30, 70), (0, 1), (120, 131)])
def test_a_chain_keeps_as_many_draws_as_asked_at_equal_steps(warmup, draws):
    """Draws are numbered by their step: none is of the warm-up, and of more steps they are as far apart."""
    method, made, chunks, kept = Collapsed(warmup=warmup, draws=draws, patience=16), [], 0, thinning(Collapsed(), 0)
    for thin in (1, 2, 4, 8):
        full = False
        while not full:
            chunks, after = chunks + 1, thinning(method, chunks + 1)
            steps = kept.steps + after.thin * (1 + np.arange(method.chunk))
            made += steps[method.chunk - (after.held - kept.held) :].tolist()
            kept, full = after, after.full(method)
        apart = np.diff(np.array(made)[kept.draws])
        assert (kept.thin, kept.held, len(kept.draws), made[0]) == (thin, len(made), draws, warmup + 1)
        assert np.all(apart >= thin)
        assert np.sum(apart > thin) <= np.log2(thin), "what a chunk has beyond the last draw is left out"


@pytest.mark.parametrize("chains", [2, 4])
def test_r_hat_of_independent_draws_is_beyond_its_limit_in_one_run_of_a_hundred(chains):
    random, runs = np.random.default_rng(3), 300
    worst = [mixing(random.normal(size=(chains, 100, 5))) for _ in range(runs)]
    beyond = sum(np.any(found["r_hat"] > r_hat_limit(found["ess"], chains)) for found in worst)
    assert beyond <= 9, "binomial: 10 of 300 happen in one of 1,000 tests"
    assert np.all(r_hat_limit(np.array([1e6]), chains) == 1.01)


def drawn(method=METHOD, **options):
    network, motion, table, _ = plane()
    problem = Problem(network, motion, table)
    return probcal.fit(problem, method, prior=Gaussian(), start=resting(problem), key=5, **options)


@pytest.mark.slow
def test_what_has_not_mixed_goes_on_with_more_steps_and_is_resumed(tmp_path, monkeypatch):
    assert drawn().attrs["thin"] == 1
    monkeypatch.setattr(sampling, "effective_draws", lambda *_: Effective(1.0, False))
    seen = []
    longer = drawn(progress=seen.append, store=tmp_path)
    assert longer.attrs["thin"] == 4
    assert longer["posterior"].sizes["draw"] == 100
    steps = [(at.done, at.total) for at in seen if at.done]
    assert steps == [(50, 150), (100, 150), (150, 150), (250, 250), (450, 450)]
    again = drawn(store=tmp_path, resume=True)
    assert np.array_equal(again["posterior"]["bias"], longer["posterior"]["bias"])

    short = drawn(progress=stopping(250), store=tmp_path, overwrite=True)
    assert (short.attrs["thin"], short["posterior"].sizes["draw"]) == (2, 100)
    assert np.array_equal(short["posterior"]["bias"][:, 1::2], longer["posterior"]["bias"][:, :50])


def test_mcmc_takes_the_sampler_that_suits(monkeypatch):
    network, motion, table, _ = plane()
    problem, method = Problem(network, motion, table), MCMC(chains=3, warmup=7, draws=90, effective=80)
    sizes = {"chains": 3, "warmup": 7, "draws": 90, "patience": 64, "effective": 80}
    assert method.suited(problem) == Collapsed(**sizes)
    monkeypatch.setattr(mcmc, "choose", lambda model: SimpleNamespace(cheap=False))
    assert method.suited(problem) == Gibbs(**sizes)


@pytest.mark.ci
def test_mcmc_goes_on_until_enough_draws_are_effective(monkeypatch):
    """Of few draws that are kept and more that are to be effective more steps are made; of many it ends early."""
    found = drawn(MCMC(chains=2, warmup=50, draws=200, effective=390))
    assert (found.attrs["requested"], found.attrs["method"], found.attrs["status"]) == (
        "MCMC",
        "Collapsed",
        "converged",
    )
    assert found.attrs["thin"] > 1
    assert found["calibration"]["ess"].min() >= 390
    seen = []
    quick = drawn(MCMC(chains=2, warmup=50, draws=1000, effective=100), progress=seen.append)
    assert quick["posterior"].sizes["draw"] < 500
    left = [at.left for at in seen if at.phase == "draws" and at.done]
    assert left[-1] is not None, "how long it will take is said"
    monkeypatch.setattr(sampling, "effective_draws", lambda *_: Effective(1.0, False))
    slow = drawn(MCMC(chains=2, warmup=0, draws=100, effective=199), progress=stopping(200))
    assert "Interrupted after 100 draws a chain, 2 steps each; --resume goes on." in slow.attrs["message"]
    assert "effective draws of" in slow.attrs["message"]


def stopping(steps):
    def stop(at):
        if at.done >= steps:
            raise KeyboardInterrupt

    return stop


def two_sides():
    """The beacons on a line, posed on both sides of it, and a place on the first."""
    problem, _ = networks.setting(0, "line")
    around = other_sides(problem, automatic_start(problem))
    points = [around.point, around.others[0].point]
    form = Form(problem.model.biases, hierarchy_of(Gaussian(), problem))
    first = Gaussian().precision(problem.labels, problem.surveyed)
    away = distances(problem, points)
    poses = [
        Posed(problem.model, frame_at(problem.model, track_mode(problem, point)), first, (), own)
        for point, own in zip(points, away, strict=True)
    ]
    keys = jax.random.split(jax.random.key(0))
    frame = poses[0].frame
    theta = frame.theta + 0.1 * jax.random.normal(keys[0], frame.theta.shape)
    eps = tuple(jax.random.normal(keys[1], x.shape) for x in frame.point.states)
    return form, poses, Place(theta, eps, {}, WEIGHT(problem.model, frame, theta, eps))


@pytest.mark.ci
def test_a_shift_to_the_other_side_and_back_is_none():
    """An involution whose gain is the difference of the joint densities in biases and process noises."""
    with jax.enable_x64(True):
        form, (here, there), at = two_sides()
        over, gain = jax.jit(shifted, static_argnums=0)(form, here, there, at)
        back, loss = jax.jit(shifted, static_argnums=0)(form, there, here, over)

        @jax.jit
        def density(posed, place):
            whole = log_joint(posed.model, posed.frame, place.theta, place.eps)
            return whole - volume(posed.model, posed.frame, place.theta) + log_prior(form, posed, place.theta, {})

        difference = density(there, over) - density(here, at)
    assert not np.allclose(over.theta, at.theta, atol=0.1) or not np.allclose(over.eps[0], at.eps[0], atol=0.1)
    np.testing.assert_allclose(gain, difference, rtol=1e-8)
    np.testing.assert_allclose(gain, -loss, rtol=1e-8)
    np.testing.assert_allclose(back.theta, at.theta, atol=1e-8)
    np.testing.assert_allclose(back.eps[0], at.eps[0], atol=1e-5)
    np.testing.assert_allclose(back.weight, at.weight, atol=1e-5)


@pytest.mark.ci
def test_a_collapsed_chain_crosses_by_the_ratio_of_the_densities():
    """The gain is the difference of the joint densities and the logarithm of what the map of the biases stretches."""
    with jax.enable_x64(True):
        form, (here, there), at = two_sides()
        chain = CollapsedState(*at, jax.random.key(0))

        @jax.jit
        def crossed(here, there, chain):
            def moved(theta):
                return METHOD.across(form, here, there, chain._replace(theta=theta))[0].theta

            over, gain = METHOD.across(form, here, there, chain)
            ends = [
                log_joint(posed.model, posed.frame, end.theta, end.eps) + log_prior(form, posed, end.theta, {})
                for posed, end in ((there, over), (here, chain))
            ]
            return over, gain, ends[0] - ends[1], jax.jacfwd(moved)(chain.theta)

        over, gain, difference, stretched = crossed(here, there, chain)
    assert not np.allclose(over.theta, at.theta, atol=0.1)
    np.testing.assert_allclose(gain, float(difference) + np.linalg.slogdet(stretched)[1], rtol=1e-8)


def test_where_the_frame_is_exact_every_leap_is_taken():
    network, motion, table, _ = plane()
    problem = Problem(network, motion, table)
    with jax.enable_x64(True):
        posed = Posed(
            problem.model, frame_at(problem.model, track_mode(problem, resting(problem))),
            Gaussian().precision(problem.labels, problem.surveyed),
        )  # fmt: skip
        form = Form(problem.model.biases, hierarchy_of(Gaussian(), problem))
        eps = NORMALS(problem.model, posed.frame, posed.frame.point)
        at = Place(posed.frame.theta, eps, {}, WEIGHT(problem.model, posed.frame, posed.frame.theta, eps))
        move = jax.jit(leap, static_argnums=(0, 4, 5))
        ends = [move(form, posed, at, jax.random.key(k), 4, 1) for k in range(20)]
    assert all(float(rate) == pytest.approx(1.0, abs=1e-6) for _, rate in ends)
    assert all(np.array_equal(end.eps[0], eps[0]) for end, _ in ends), "trajectories keep their coordinates"
    assert len({float(np.asarray(end.theta)[0]) for end, _ in ends}) == 20


def test_a_leap_is_taken_by_the_weight_of_the_posterior():
    """Independent draws of a wrong frame, each leapt 20 times, have the mean of the posterior, not the frame's."""
    network, motion, table, _ = plane()
    problem = Problem(network, motion, table)
    with jax.enable_x64(True):
        form = Form(problem.model.biases, hierarchy_of(Gaussian(), problem))
        right = frame_at(problem.model, track_mode(problem, resting(problem)))
        wrong = right._replace(score=right.score + 0.5 * right.information @ np.ones(right.score.shape))
        posed = Posed(problem.model, wrong, Gaussian().precision(problem.labels, problem.surveyed))
        exact = jax.jit(conditional, static_argnums=0)(form, posed._replace(frame=right), {})
        resting_eps = tuple(np.zeros(x.shape) for x in right.point.states)

        def one(key):
            keys = jax.random.split(key)
            theta = conditional(form, posed, {}).draw(keys[0])
            at = Place(theta, resting_eps, {}, WEIGHT(problem.model, wrong, theta, resting_eps))
            return leap(form, posed, at, keys[1], 20, 1)

        ends, rate = jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(3), 2000))
        error = np.sqrt(np.asarray(exact.variance) / 2000)
    assert 0.2 < np.asarray(rate).mean() < 0.9
    np.testing.assert_array_less(np.abs(np.asarray(ends.theta).mean(0) - np.asarray(exact.mean)), 5 * error)
