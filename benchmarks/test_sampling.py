"""Samplers on C1 (ten radars, 100 scans) beside plain numpyro on the same posterior; compilation apart.

`extra_info` holds the smallest effective sample size and effective draws a second, warm-up included. The plain way is
what a user writes by hand: non-centred scales and trajectory, NUTS, one call. Run with
`uv run --group bench pytest benchmarks/test_sampling.py --benchmark-only -n 0`.
"""

import sys
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

from probcal import NUTS, SVI, BernoulliGaussian, Collapsed, Horseshoe
from probcal.inference.method import Context
from probcal.inference.mixed import mixing
from probcal.modes import automatic_start
from probcal.types import float64

sys.path.insert(0, str(Path(__file__).parent.parent / "models"))

import radars

PRIOR = Horseshoe(expected=0.3 / 1.3, slab_scale=1.0, slab_df=4.0)  # tau ~ HalfCauchy(0.3), c^2 ~ InverseGamma(2, 2)
SHARE = 0.4
METHODS = {
    "collapsed": (Collapsed(draws=1000, patience=1), PRIOR),
    "collapsed-spike": (Collapsed(patience=1), BernoulliGaussian()),
    "nuts": (NUTS(), PRIOR),
    "svi": (SVI(), PRIOR),
}


@float64
def posed():
    problem, _ = radars.setting(0, SHARE)
    return problem, automatic_start(problem)


@float64
def drawn(problem, start, method, prior, seed):
    context = Context(jax.random.key(seed))
    task = method.task(problem, prior, start, context)
    return task.run(context.run(task)[1])


@pytest.mark.parametrize("name", list(METHODS))
def test_c1(benchmark, name):
    problem, start = posed()
    method, prior = METHODS[name]
    drawn(problem, start, replace(method), prior, 0)  # compiles
    run = benchmark.pedantic(drawn, (problem, start, method, prior, 1), rounds=3)
    found = mixing(run.z)
    benchmark.extra_info["min_ess"] = round(float(found["ess"].min()))
    benchmark.extra_info["min_ess_per_s"] = round(float(found["ess"].min() / benchmark.stats.stats.mean), 1)
    benchmark.extra_info["r_hat"] = round(float(found["r_hat"].max()), 4)


def plain(problem):
    """The same posterior by hand: C1 has one target, one scan a second, radars with four biases each."""
    block, data = problem.model.blocks[0], problem.model.rows[0]
    part = problem.model.recursions[0]
    from probcal.model import rows

    biases = problem.model.biases

    def model():
        local = numpyro.sample("local", dist.HalfCauchy(jax.numpy.ones(biases)))
        tau = numpyro.sample("tau", dist.HalfCauchy(0.3))
        slab = numpyro.sample("slab", dist.InverseGamma(2.0, 2.0))
        unit = numpyro.sample("unit", dist.Normal(jax.numpy.zeros(biases), 1.0))
        z = numpyro.deterministic("z", unit * tau * jax.numpy.sqrt(slab * local**2 / (slab + tau**2 * local**2)))
        noise = numpyro.sample("noise", dist.Normal(jax.numpy.zeros(part.drift.shape), 1.0).to_event(2))
        source = jax.numpy.einsum("eij,ej->ei", part.L, noise) + part.drift

        def step(x, epoch):
            x = epoch[0] @ x + epoch[1]
            return x, x

        _, states = jax.lax.scan(step, jax.numpy.zeros(source.shape[1]), (part.F, source))
        predicted = rows.predict(block, data, states, z)
        numpyro.factor("y", rows.log_likelihood(block, data, predicted, jax.numpy.zeros(0)).sum())

    return model


@pytest.mark.parametrize("draws", [600])
def test_c1_plain_numpyro(benchmark, draws):
    problem, _ = posed()

    @float64
    def run():
        kernel = numpyro.infer.NUTS(plain(problem), target_accept_prob=0.9)
        chains = numpyro.infer.MCMC(
            kernel, num_warmup=draws, num_samples=draws, num_chains=2, chain_method="sequential", progress_bar=False
        )
        chains.run(jax.random.PRNGKey(0))
        return np.asarray(chains.get_samples(group_by_chain=True)["z"])

    found = mixing(benchmark.pedantic(run, rounds=1))
    benchmark.extra_info["min_ess"] = round(float(found["ess"].min()))
    benchmark.extra_info["min_ess_per_s"] = round(float(found["ess"].min() / benchmark.stats.stats.mean), 3)
    benchmark.extra_info["r_hat"] = round(float(found["r_hat"].max()), 4)
