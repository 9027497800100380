"""Precisions integrated: against importance sampling on hand-made likelihoods, and what a fit says of them."""

from functools import cache
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import worlds
from contracts import check_tree, close

import probcal
from probcal import ARD, EA, MAP, BernoulliGaussian, Gaussian, Horseshoe, Laplace, fit
from probcal.errors import InputError
from probcal.gaussian.engine import Estimate, Factors, Sampled
from probcal.gaussian.mode import Point
from probcal.inference.ending import uncertain
from probcal.inference.hierarchy import (
    GammaPrecision,
    LaplaceMixture,
    Product,
    RegularisedHorseshoe,
    SpikeAndSlab,
    hierarchy_of,
)
from probcal.inference.integrate import (
    CHAINS,
    KEPT,
    Integrated,
    Integration,
    Moments,
    begin,
    joint_draws,
    likelihood,
    moments,
    pooled,
    run_sweeps,
)
from probcal.inference.posed import Form, Natural
from probcal.inference.propagate import CLOSE, ROUNDS, BiasLikelihood, Propagation
from probcal.modes.grid import track_mode
from probcal.priors import Precision, by_kind

PRIORS = [ARD(shape=1.5, rate=0.5), Laplace(), Horseshoe(), BernoulliGaussian(share=0.4)]
KINDS = {ARD: GammaPrecision, Laplace: LaplaceMixture, Horseshoe: RegularisedHorseshoe, BernoulliGaussian: SpikeAndSlab}
KINDS_OF_BIASES = by_kind(Horseshoe(), {"spiked": BernoulliGaussian(slab=None)})  # of the second and third bias
PRIORS.append(KINDS_OF_BIASES)
SOME = [pytest.param(p, marks=pytest.mark.ci) if isinstance(p, ARD | Laplace) or p.kinds else p for p in PRIORS]
G = np.array([[4.0, 2.5, 0.0], [2.5, 3.0, 0.5], [0.0, 0.5, 9.0]])  # two that trade against each other, one seen well
PULL = np.array([5.0, 2.0, -1.0])
DRAWS = 200_000


def kind_of(prior, group=(0, 1, 2)):
    """The hierarchy of three biases, of which the last two are spiked where the prior has kinds."""
    if not prior.kinds:
        return KINDS[type(prior)](prior, (0, 1, 2), group)
    spiked = SpikeAndSlab(prior.kinds[0][1], (1, 2), (0, 1))
    return Product.of(prior, [("", RegularisedHorseshoe(prior, (0,), (0,))), ("spiked", spiked)])


def name_of(prior):
    return "Product" if prior.kinds else type(prior).__name__


def mixture(prior, matrix=G, pull=PULL, group=(0, 1, 2), key=0):
    """The mixture by Gibbs sweeps: moments and draws."""
    form = Form(3, kind_of(prior, group))
    with jax.enable_x64(True):
        known = Natural(np.asarray(matrix), np.asarray(pull), np.zeros(0), Precision(np.ones(3)))
        _, swept = run_sweeps(form, known, begin(form), jax.random.key(key), KEPT)
        found = jax.tree.map(np.asarray, moments(form, known, swept.phi))
        return found, np.asarray(swept.z), np.asarray(swept.mean)


def weighed(prior):
    """The same by importance sampling: hyper-parameters from their prior, each weighed by its evidence."""
    return weighed_of(PRIORS.index(prior))


@cache
def weighed_of(number):
    kind = kind_of(PRIORS[number])
    with jax.enable_x64(True):

        @jax.jit
        @jax.vmap
        def drawn(key):
            phi = kind.draw(key)
            return kind.alpha(phi, jnp.ones(3)), kind.active(phi, 3)

        alpha, active = jax.tree.map(np.asarray, drawn(jax.random.split(jax.random.key(1), DRAWS)))
    alpha = np.where(active, alpha, 1e9)  # a spike
    covariance = np.linalg.inv(G + np.apply_along_axis(np.diag, 1, alpha))
    mean = covariance @ PULL
    log = 0.5 * (np.log(alpha).sum(1) + np.linalg.slogdet(covariance)[1] + mean @ PULL)
    weight = np.exp(log - log.max())
    weight /= weight.sum()
    middle = weight @ mean
    spread = np.einsum("s,sij->ij", weight, covariance) + (mean - middle).T @ (weight[:, None] * (mean - middle))
    gamma = weight @ np.where(active, 1 - alpha * np.diagonal(covariance, axis1=1, axis2=2), 0.0)
    return middle, spread, gamma


@pytest.mark.parametrize("prior", SOME, ids=name_of)
def test_a_mixture_has_the_moments_of_the_posterior(prior):
    """Three biases, two of them traded: within five Monte Carlo errors of some 400 effective draws, a quarter sd."""
    found, z, mean = mixture(prior)
    middle, spread, gamma = weighed(prior)
    sd = np.sqrt(np.diag(spread))
    np.testing.assert_allclose((found.mean - middle) / sd, 0, atol=0.25)
    np.testing.assert_allclose(found.covariance / np.outer(sd, sd), spread / np.outer(sd, sd), atol=0.2)
    np.testing.assert_allclose(found.gamma, gamma, atol=0.08)
    assert z.shape == (CHAINS, KEPT, 3)
    np.testing.assert_allclose(mean, z.mean((0, 1)), rtol=1e-12)
    inside = ((np.asarray(found.lower) <= z) & (z <= np.asarray(found.upper))).mean((0, 1))
    np.testing.assert_allclose(inside, 0.89, atol=0.05)


def test_sweeps_go_on_without_another_burn_in():
    """A sweep kept second without burn-in is the one kept first after a burn-in of one."""
    form = Form(3, RegularisedHorseshoe(Horseshoe(), (0, 1, 2), (0, 1, 2)))
    with jax.enable_x64(True):
        known = Natural(jnp.asarray(G), jnp.asarray(PULL), jnp.zeros(0), Precision(jnp.ones(3)))
        key = jax.random.key(0)
        chains = begin(form)
        (ends, both), (_, last) = (run_sweeps(form, known, chains, key, 2 - burn, burn) for burn in (0, 1))
    np.testing.assert_array_equal(both.z[:, 1], last.z[:, 0])
    np.testing.assert_array_equal(both.z[:, 1], ends[0])


class HandMade:
    """The expansion of the hand-made likelihood about zero."""

    point = Point((), (), np.zeros(3), np.zeros(0))

    def score(self):
        return PULL

    def log_det(self, factors):
        return Estimate(np.linalg.slogdet(G + factors.matrix(3))[1])

    def solve(self, factors, right):
        return np.linalg.solve(G + factors.matrix(3), right)

    def marginals(self, factors, members):
        covariance = np.eye(4)
        covariance[:3, :3] = np.linalg.inv(G + factors.matrix(3))
        return covariance[members[:, :, None], members[:, None, :]]

    def deviations(self, factors, key, count):
        root = np.linalg.cholesky(np.linalg.inv(G + factors.matrix(3)))
        return Sampled(np.random.default_rng(0).standard_normal((count, 3)) @ root.T, ())


@pytest.mark.parametrize(
    "members",
    [
        pytest.param([[0, 1], [2, 3]], id="block"),
        pytest.param([[0, 3], [1, 3], [2, 3]], id="one", marks=pytest.mark.ci),
    ],
)
@pytest.mark.parametrize("prior", SOME, ids=name_of)
def test_expectation_propagation_agrees_too(prior, members):
    """Without sweeps over all: means within a fifth of an sd, sds within 15 %; less where a block parts the traded."""
    members = np.array(members)
    form = Form(3, kind_of(prior))
    with jax.enable_x64(True):
        first = form.rest(Precision(jnp.ones(3)))  # flat: every bias has a site
        likelihood = BiasLikelihood(SimpleNamespace(cheap=True), HandMade(), Factors.of(first))
        work = Propagation.of(form, first, likelihood, members, jax.random.key(0))
        for turn in range(ROUNDS):
            off = work.round(turn)
        z, blocks = joint_draws(work)
    z, covariance = z.reshape(-1, 3), blocks.matrix()
    assert off < CLOSE
    middle, spread, gamma = weighed(prior)
    sd = np.sqrt(np.diag(spread))
    apart = 1.0 if len(members) == 2 else 1.5
    np.testing.assert_allclose((work.mean - middle) / sd, 0, atol=0.2 * apart)
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)) / sd, 1, atol=0.15 * apart)
    np.testing.assert_allclose(work.swept.gamma, gamma, atol=0.08 * apart)
    np.testing.assert_allclose((z.mean(0) - work.mean) / sd, 0, atol=0.25)  # of 100 Gaussians
    wanted = covariance / np.outer(*[np.sqrt(np.diag(covariance))] * 2)
    np.testing.assert_allclose(np.corrcoef(z.T), wanted, atol=0.12)


@pytest.mark.slow
def test_batches_agree_with_each_other_and_state_their_error():
    """Scatter of four keys: within three of the errors stated, each below 3 %; thinned draws come from all batches."""
    problem, _ = worlds.linear("plane")
    found = [fit(problem, EA(), start=worlds.resting(problem), key=key) for key in range(4)]
    mean, sd = (np.stack([tree["calibration"][name].values for tree in found]) for name in ("mean", "sd"))
    errors = {name: max(tree.attrs[name] for tree in found) for name in ("mean_error", "sd_error")}
    assert all(0 < error < 0.03 for error in errors.values())
    assert (np.ptp(mean / sd.mean(0), axis=0) < 4 * errors["mean_error"]).all()
    assert (np.ptp(sd / sd.mean(0), axis=0) < 4 * errors["sd_error"]).all()


def test_errors_of_pooled_batches_are_stated_where_they_are_large():
    one = Moments(np.zeros(2), np.eye(2), -np.ones(2), np.ones(2), np.ones(2))
    other = one._replace(mean=np.array([0.0, 0.2]), covariance=np.diag([1.0, 1.44]))
    total, mean_error, sd_error = pooled([one, other])
    close(total.mean, [0.0, 0.1], 1e-12)
    close(total.covariance, np.diag([1.0, 1.23]), 1e-12)
    close(mean_error, [0.0, 0.1 / np.sqrt(1.23)], 1e-12)
    close(sd_error, [0.0, 0.1 / np.sqrt(1.23)], 1e-12)
    mixed = Integrated(None, None, total, None, {}, True, mean_error, sd_error)
    assert "up to 0.09 sd of a mean and 9% of an sd, largest for b." in uncertain(("a", "b"), mixed)
    assert uncertain(("a", "b"), mixed._replace(mean_error=0.0, sd_error=0.0)) == ""


def test_one_gaussian_is_a_mixture_of_itself():
    """A spike and slab whose biases are all in: the plain Gaussian, its interval to rounding."""
    kind = SpikeAndSlab(BernoulliGaussian(share=0.5), (0, 1, 2), (0, 1, 2))
    with jax.enable_x64(True):
        known = Natural(jnp.asarray(G), jnp.asarray(PULL), jnp.zeros(0), Precision(jnp.ones(3)))
        phi = {"included": jnp.ones((CHAINS, KEPT, 3), bool)}
        found = jax.tree.map(np.asarray, moments(Form(3, kind), known, phi))
    covariance = np.linalg.inv(G + np.eye(3))
    close(found.mean, covariance @ PULL, 1e-12)
    close(found.covariance, covariance, 1e-12)
    sd = np.sqrt(np.diag(covariance))
    close(found.upper, covariance @ PULL + 1.5981931399228169 * sd, 1e-9)
    close(found.lower, covariance @ PULL - 1.5981931399228169 * sd, 1e-9)
    close(found.gamma, 1 - np.diag(covariance), 1e-12)


@pytest.mark.ci
def test_a_scale_of_a_vector_turns_with_the_world():
    """Two axes that share a local scale: turning the likelihood turns the mean, which one scale an axis would not."""
    turn = np.eye(3)
    turn[:2, :2] = [[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]]
    group = (0, 0, 1)
    plain, z, _ = mixture(Horseshoe(), group=group)
    turned, _, _ = mixture(Horseshoe(), turn @ G @ turn.T, turn @ PULL, group, key=1)
    np.testing.assert_allclose(turn.T @ np.asarray(turned.mean), plain.mean, atol=0.25 * z.std((0, 1)).max())


@pytest.fixture(scope="module")
def plane():
    problem, _ = worlds.linear("plane")
    return problem, fit(problem, EA(), start=worlds.resting(problem))


def test_a_fit_integrates_by_default(plane):
    problem, tree = plane
    check_tree(tree, problem)
    assert tree.attrs["status"] == "converged"
    assert (tree.attrs["prior"], tree.attrs["precisions"], tree.attrs["approximate"]) == (
        "Horseshoe", "integrated", "mixture",
    )  # fmt: skip
    group = tree["calibration"].to_dataset()
    assert ((group["inclusion"] >= 0) & (group["inclusion"] <= 1)).all()
    assert "pruned" not in group["status"].values
    assert {"local_scale", "global_scale", "slab_variance"} <= set(tree["posterior"].data_vars)
    draws = tree["posterior"]["bias"]
    assert np.abs((draws.mean(("chain", "draw")) - group["mean"]) / group["sd"]).max() < 0.4
    assert "log_evidence" not in tree.attrs
    gaussian = fit(problem, MAP(), prior=Gaussian(), start=worlds.resting(problem))
    assert tree.attrs["log_evidence_declared"] == pytest.approx(gaussian.attrs["log_evidence"], rel=1e-9)
    same = fit(problem, EA(), start=worlds.resting(problem))
    np.testing.assert_array_equal(same["calibration"]["mean"], tree["calibration"]["mean"])


def test_the_likelihood_at_a_mode_is_that_of_the_data():
    """On a linear problem, with any prior: what the data say is the same at every point."""
    problem, _ = worlds.linear("plane")
    with jax.enable_x64(True):
        first = Gaussian().precision(problem.labels, problem.surveyed)
        how = Integration(Form(problem.model.biases, hierarchy_of(Horseshoe(), problem)), True)
        start = worlds.resting(problem)
        for z in (start.z, start.z + 1.5):
            point = track_mode(problem, start._replace(z=z))
            known, sound = likelihood(how, problem.model, first, point)
            assert bool(sound)
            mean = np.linalg.solve(np.asarray(known.information + first.matrix()), np.asarray(known.pull))
            expected = fit(problem, MAP(), prior=Gaussian(), start=start)["calibration"]["mean"].values / problem.scales
            np.testing.assert_allclose(mean, expected, atol=1e-8)


def test_a_flat_hyper_prior_is_maximised_and_says_so():
    problem, _ = worlds.linear("plane")
    tree = fit(problem, EA(), prior=ARD(), start=worlds.resting(problem))
    assert tree.attrs["precisions"] == "maximised"
    assert "ARD with a flat hyper-prior has no posterior" in tree.attrs["message"]
    assert "log_evidence_type_ii" in tree.attrs
    asked = fit(problem, EA(precisions="maximised"), start=worlds.resting(problem))
    assert asked.attrs["prior"] == "ARD"
    assert "no posterior" not in asked.attrs["message"]
    np.testing.assert_array_equal(asked["calibration"]["mean"], tree["calibration"]["mean"])


def test_an_estimate_far_beyond_its_scale_is_none():
    problem, _ = worlds.linear("plane")
    table = problem.measurements.table.frame.copy()
    column = next(name for name in table if name not in ("time", "sensor", "target"))
    table.loc[table["sensor"] == table["sensor"].iloc[0], column] += 1e4
    tree = fit(probcal.Problem(problem.network, problem.motion, table), EA())
    assert tree.attrs["status"] in ("at bound", "misfit")


@pytest.mark.parametrize(
    ("ask", "text"),
    [
        (lambda: EA(precisions="both"), 'EA\\(precisions="both"\\): give one of integrated, maximised'),
        (lambda: Horseshoe(by="nod"), 'Horseshoe\\(by="nod"\\).*did you mean "node"'),
        (
            lambda: fit(worlds.linear("plane")[0], EA(precisions="maximised"), prior=Horseshoe()),
            "EA does not take the prior Horseshoe; it takes: ard",
        ),
    ],
)
def test_what_it_refuses(ask, text):
    with pytest.raises(InputError, match=text):
        ask()
