"""SVI: guides are what they say, linear problems exact, against NUTS on a radar network, what it refuses."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from worlds import linear, resting, small

from probcal import NUTS, SVI, Gaussian, Horseshoe, InputError
from probcal.gaussian.mode import smooth_tracks
from probcal.inference.guides import GuideParameters, Structured
from probcal.inference.method import Context
from probcal.inference.pose import pareto_khat
from probcal.inference.posterior import facts_of_steps
from probcal.modes import automatic_start
from probcal.status import CHAINS, judge

ALARM = 5.0  # standard errors: a right sampler fails one comparison in a million


@pytest.fixture(autouse=True)
def double():
    with jax.enable_x64(True):
        yield


@pytest.mark.ci
def test_a_guide_knows_its_density_and_its_slope():
    """Against the change of variables by automatic differentiation, and the derivative of the density by x."""
    guide, size, keys = Structured(3), 5, jax.random.split(jax.random.key(0), 4)
    rest = jax.tree.map(lambda a: 0.7 * jax.random.normal(keys[0], a.shape), guide.first(size, keys[1]))
    fitted = GuideParameters(jax.random.normal(keys[2], (size,)), 0.3 * jnp.arange(size) - 0.5, rest)
    n = jax.random.normal(keys[3], (1, size))
    by_n = jax.jacfwd(lambda n: guide.place(fitted, n[None])[0])(n[0])
    unit = -0.5 * np.sum(np.asarray(n) ** 2) - 0.5 * size * np.log(2 * np.pi)
    expected = unit - np.linalg.slogdet(np.asarray(by_n))[1]
    np.testing.assert_allclose(guide.log_density(fitted, n)[0], expected)
    slope = jax.grad(lambda n: guide.log_density(fitted, n[None])[0])(n[0])
    np.testing.assert_allclose(guide.slope(fitted, n)[0], np.linalg.solve(np.asarray(by_n).T, slope))


def test_pareto_khat_is_that_of_the_large_weights():
    heavy = -0.8 * np.log(np.random.default_rng(0).uniform(size=4000))  # weights u^-0.8
    assert abs(pareto_khat(heavy) - 0.8) < 0.15
    assert pareto_khat(-heavy) < 0.0
    assert pareto_khat(np.append(heavy, -np.inf)) == np.inf
    assert pareto_khat(np.zeros(100)) == 0.0


def sample(problem, method, prior, start, seed):
    """The draws of a sampler, and how the run went."""
    context = Context(jax.random.key(seed))
    task = method.task(problem, prior, start, context)
    return task.run(context.run(task)[1])


def solved(name, method, prior):
    """A linear case by a method, and its exact posterior."""
    problem, naive = linear(name)
    start = smooth_tracks(problem.model, resting(problem))
    return sample(problem, method, prior, start, 4), reference.dense(naive, np.ones(len(naive.labels)))


def test_linear_problems_are_exact():
    run, exact = solved("plane", SVI(chains=2, warmup=50, draws=1000), Gaussian())
    count = run.z.shape[0] * run.z.shape[1]
    for drawn, mean, sd in ((run.z, exact.z[0], np.sqrt(np.diag(exact.z[1]))), (run.states[0], *exact.states)):
        flat = drawn.reshape(count, -1)
        assert (np.abs(flat.mean(0) - mean) < ALARM * sd / np.sqrt(count)).all()
        assert (np.abs(flat.std(0) / sd - 1) < ALARM / np.sqrt(2 * count)).all()
    # no gradient where the guide is exact: it stays, and p / q is the evidence at every draw
    np.testing.assert_allclose(run.draws.stats["log_weight"], exact.evidence, atol=1e-5)
    np.testing.assert_allclose(run.draws.stats["elbo"][:, -1], exact.evidence, atol=1e-5)


@pytest.mark.parametrize(("khat", "status"), [(0.69, "converged"), (0.7, "not converged"), (np.inf, "not converged")])
def test_a_guide_that_does_not_fit_has_not_converged(khat, status, monkeypatch):
    """The same run, judged by a k-hat on either side of the limit."""
    monkeypatch.setattr("probcal.inference.posterior.pareto_khat", lambda _: khat)
    run, _ = solved("plane", SVI(chains=2, warmup=50, draws=1000), Gaussian())
    problem = linear("plane")[0]
    ended, message = judge(CHAINS, facts_of_steps(problem, Gaussian(), run))
    assert str(ended) == status
    assert ("it stands for the posterior" in message) == (status == "converged")
    assert ("it does not fit the posterior; fit with NUTS() or Collapsed()" in message) == (status != "converged")


@pytest.mark.slow
def test_determined_biases_have_the_sds_of_nuts():
    problem = small(scans=20)
    start = automatic_start(problem)
    exact = sample(problem, NUTS(chains=2, warmup=200, draws=400), Horseshoe(), start, 0)
    found = sample(problem, SVI(chains=2), Horseshoe(), start, 1)
    determined = exact.draws.gamma.mean((0, 1)) > 0.5
    assert determined.sum() >= 2
    sd = exact.z.std((0, 1))
    assert (np.abs(found.z.std((0, 1)) / sd - 1)[determined] < 0.15).all()
    assert (np.abs(found.z.mean((0, 1)) - exact.z.mean((0, 1))) < 0.25 * sd).all()
    assert pareto_khat(found.draws.stats["log_weight"].ravel()) < 0.7
    bound = found.draws.stats["elbo"]
    assert (bound[:, -1] > bound[:, 0] + 1.0).all()
    np.testing.assert_allclose(bound[:, -1], found.draws.stats["log_weight"].mean(1), atol=0.5)


def test_what_it_refuses():
    for wrong in ({"warmup": 0}, {"rate": 0.0}, {"particles": 0}):
        with pytest.raises(InputError, match="at least one step of at least one particle is needed"):
            SVI(**wrong)
