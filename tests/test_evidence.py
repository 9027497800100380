"""The evidence with hyper-parameters integrated: against closed forms, quadrature and draws of the prior."""

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from scipy import stats
from scipy.special import logsumexp

from probcal import (
    ARD,
    BernoulliGaussian,
    Bias,
    Channel,
    Gaussian,
    Horseshoe,
    Laplace,
    Network,
    Node,
    Problem,
    RandomWalk,
    Target,
    sensor,
)
from probcal.inference.evidence import PARTICLES, RUNS, combined, effective, log_evidence, resampled
from probcal.inference.hierarchy import GammaPrecision, LaplaceMixture, RegularisedHorseshoe

TIMES = np.arange(5.0)


def shifted(size, std, walk=0.5, spread=1.5, share=1.0):
    """`size` sensors that measure one coordinate, each with its own shift, a share of them not zero.

    Also the rows without the trajectory's mean (N,), their covariance without the shifts (N, N) and the sensor of each.
    """

    @sensor(x=Channel("m", std=std))
    def abscissa(target, pose, *, shift=Bias("m", 1.0)):
        return {"x": target.position[0] + shift}

    network = Network([abscissa.on(Node(f"n{k}", (float(k), 0.0))) for k in range(size)])
    motion = Target(RandomWalk("position", "m", walk, ((0.3, -0.2), spread), per_axis=True))
    when, own = np.divmod(np.arange(len(TIMES) * size), size)
    covariance = (spread**2 + walk**2 * np.minimum.outer(TIMES, TIMES))[np.ix_(when, when)] + std**2 * np.eye(len(own))
    random = np.random.default_rng(5)
    shifts = np.where(random.uniform(size=size) < share, 1.5 * random.standard_normal(size), 0.0)
    rows = shifts[own] + np.linalg.cholesky(covariance) @ random.standard_normal(len(own))
    table = pd.DataFrame({"time": TIMES[when], "sensor": [f"n{k}" for k in own], "target": "target", "x": rows + 0.3})
    return Problem(network, motion, table), rows, covariance, own


def likelihood(rows, covariance, own):
    """Information (K, K), linear term (K,) and height of the log-likelihood of the shifts."""
    B = np.eye(own.max() + 1)[own]
    weighed = np.linalg.solve(covariance, np.column_stack([B, rows]))
    height = -0.5 * (rows @ weighed[:, -1] + np.linalg.slogdet(2 * np.pi * covariance)[1])
    return B.T @ weighed[:, :-1], B.T @ weighed[:, -1], height


def averaged(kind, problem, *of, draws=400_000, chunk=20_000):
    """Log evidence by draws of the hyper-parameters from their prior, and its Monte Carlo error."""
    G, h, height = likelihood(*of)
    size = len(h)
    form = kind[0](kind[1], tuple(range(size)), tuple(range(size)))
    with jax.enable_x64(True):
        phi = jax.vmap(form.draw)(jax.random.split(jax.random.key(9), draws))
        alpha = np.asarray(jax.vmap(lambda one: form.alpha(one, jnp.ones(size)))(phi))
    logs = []
    for part in np.split(alpha, draws // chunk):
        matrix = G + part[:, :, None] * np.eye(size)
        mean = np.linalg.solve(matrix, np.broadcast_to(h[:, None], (chunk, size, 1)))[..., 0]
        logs.append(height + 0.5 * (np.log(part).sum(1) - np.linalg.slogdet(matrix)[1] + mean @ h))
    logs = np.concatenate(logs)
    weight = np.exp(logs - logs.max())
    return logsumexp(logs) - np.log(draws), weight.std() / weight.mean() / np.sqrt(draws)


def apart(prior, rows, covariance, own, std):
    """Log evidence under a prior of shifts that the data see apart: quadrature over what they share and have."""
    size, spread = own.max() + 1, std**2 / len(TIMES)
    means = np.array([rows[own == k].mean() for k in range(size)])
    height = likelihood(rows, covariance, own)[2] + 0.5 * np.sum(means**2 / spread + np.log(2 * np.pi * spread))

    def each(variance):
        return stats.norm.logpdf(means, scale=np.sqrt(spread + variance[:, None]))  # nodes, shifts

    if isinstance(prior, BernoulliGaussian):
        share = (np.arange(4000.0) + 0.5)[:, None] / 4000
        inside, outside = each(np.array([prior.slab**2])), each(np.zeros(1))
        logs = np.logaddexp(np.log(share) + inside, np.log1p(-share) + outside).sum(1)
        return height + logsumexp(logs) - np.log(len(logs))
    width, half = prior.expected / (1 - prior.expected), 0.5 * prior.slab_df
    local, tau, slab = np.linspace(-22, 22, 1201), np.linspace(-12, 6, 145), np.linspace(np.log(0.1), 8, 61)

    def half_cauchy(log):  # density of the logarithm
        return np.log(2 / np.pi) + log - np.log1p(np.exp(2 * log))

    total = np.array([
        [logsumexp(half_cauchy(local)[:, None] + each(1 / (np.exp(-c) + np.exp(-2 * (t + local)))), axis=0).sum()
         for c in slab] for t in tau
    ])  # fmt: skip
    total += size * np.log(local[1] - local[0]) + half_cauchy(tau - np.log(width))[:, None]
    total += stats.invgamma.logpdf(np.exp(slab), half, scale=half * prior.slab_scale**2) + slab
    return height + logsumexp(total) + np.log((tau[1] - tau[0]) * (slab[1] - slab[0]))


def test_estimates_of_runs_are_averaged_with_the_error_of_few():
    logs = np.log([1.0, 2.0, 3.0, 2.0, 1.5, 2.5, 2.0, 2.0])
    value, error = combined(logs - 700.0)
    assert value == pytest.approx(np.log(2.0) - 700.0, rel=1e-14)
    usual = np.exp(logs).std(ddof=1) / 2.0 / np.sqrt(8)
    assert error == pytest.approx(usual * stats.t(7).std(), rel=1e-12)


def test_particles_are_resampled_within_their_run():
    """By systematic resampling each is drawn its expected number of times, rounded up or down."""
    random = np.random.default_rng(0)
    logs = 2.0 * random.standard_normal(RUNS * PARTICLES) + np.repeat(100.0 * np.arange(RUNS), PARTICLES)
    found = resampled({"number": np.arange(RUNS * PARTICLES)}, logs, jax.random.key(0))["number"]
    times = np.bincount(found, minlength=len(logs)).reshape(RUNS, PARTICLES)
    np.testing.assert_array_equal(times.sum(1), PARTICLES)
    weight = np.exp(logs - 100.0 * np.repeat(np.arange(RUNS), PARTICLES)).reshape(RUNS, PARTICLES)
    assert (np.abs(times - PARTICLES * weight / weight.sum(1, keepdims=True)) < 1.0).all()
    assert effective(np.zeros(7) + 3.0) == pytest.approx(7.0)
    assert effective(np.array([0.0, 0.0, -900.0])) == pytest.approx(2.0)


@pytest.mark.ci
@pytest.mark.parametrize(("size", "std"), [(40, 0.03), pytest.param(80, 0.1, marks=pytest.mark.slow)])
def test_many_precisely_known_biases_have_their_exact_evidence(size, std):
    """A Gaussian prior on a linear network: nothing is drawn."""
    problem, *of = shifted(size, std)
    G, h, height = likelihood(*of)
    matrix = G + np.eye(size)
    exact = height + 0.5 * (h @ np.linalg.solve(matrix, h) - np.linalg.slogdet(matrix)[1])
    found = log_evidence(problem, prior=Gaussian())
    assert found.value == pytest.approx(exact, abs=1e-6)
    assert found.error < 1e-6
    assert found.khat == 0.0


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind",
    [(RegularisedHorseshoe, Horseshoe()), (GammaPrecision, ARD(rate=0.5)), (LaplaceMixture, Laplace())],
    ids=lambda kind: type(kind[1]).__name__,
)
def test_scales_are_integrated(kind):
    """Four biases against 4e5 draws of their scales, 12 keys: (value - exact) / error has an rms of one."""
    problem, *of = shifted(4, 0.3)
    exact, own = averaged(kind, problem, *of)
    found = [log_evidence(problem, prior=kind[1], key=k) for k in range(12)]
    ratio = np.array([(one.value - exact) / np.hypot(one.error, own) for one in found])
    print(kind[1], np.round(ratio, 1))
    assert np.abs(ratio).max() < 4.0
    assert 0.4 < np.sqrt(np.mean(ratio**2)) < 1.7
    assert max(one.error for one in found) < 0.2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("prior", "size", "std"), [(Horseshoe(), 40, 0.03), (Horseshoe(), 80, 0.1), (BernoulliGaussian(), 40, 0.1)]
)
def test_scales_of_many_precisely_known_biases_are_integrated(prior, size, std):
    """Biases that a known path keeps apart, a fifth of them not zero, against quadrature: within three errors."""
    problem, *of = shifted(size, std, walk=1e-5, spread=1e-5, share=0.2)
    exact = apart(prior, *of, std)
    for key in range(2):
        found = log_evidence(problem, prior=prior, key=key)
        print(prior, size, key, found.value - exact, found.error)
        assert abs(found.value - exact) < 3.0 * found.error
        assert found.error < 0.6
