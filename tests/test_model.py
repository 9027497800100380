"""The numpyro model: the same density as the package's own coordinates, prior draws, and numpyro's own NUTS on it."""

import subprocess
import sys

import arviz as az
import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import pandas as pd
import pytest
import reference
import xarray as xr
from jax.flatten_util import ravel_pytree
from numpyro.infer import MCMC, NUTS, SVI, Predictive, Trace_ELBO, init_to_value
from numpyro.infer.autoguide import AutoMultivariateNormal, AutoNormal
from numpyro.infer.util import log_density
from worlds import posed_of, resting, small, two_motions

import probcal
from probcal import (
    ARD,
    Bias,
    Channel,
    ConstantVelocity,
    Flat,
    Gaussian,
    Horseshoe,
    InputError,
    Laplace,
    Network,
    Node,
    Problem,
    StudentT,
    Target,
    Unknown,
    numpyro_model,
    sensor,
)
from probcal.gaussian.frame import place
from probcal.gaussian.mode import factors
from probcal.inference.coordinates import Free, parts
from probcal.priors import BernoulliGaussian

FALSE_ALARM = 1e-6  # of each statistical test
radar, fix = probcal.sensors.radar, probcal.sensors.position


@sensor(
    range=Channel("m", std=Unknown(3.0), noise=StudentT(4.0)),
    azimuth=Channel("rad", std=0.02, wrap=True),
)
def robust(target, pose, *, range_offset=Bias("m", 5.0)):
    line = pose.local(target.position)
    return {"range": jnp.hypot(line[0], line[1]) + range_offset, "azimuth": jnp.arctan2(line[1], line[0])}


CASES = {
    "horseshoe": (Horseshoe(), {}),
    "gaussian": (Gaussian(correlation={"b.position_*": 0.6}), {}),
    "laplace": (Laplace(), {}),
    "ard": (ARD(rate=0.5, by="owner"), {}),
    "flat": (Flat(correlation={"b.position_*": -0.3}), {}),
    "levels and Student-t": (Horseshoe(), {"kind": robust}),
    "two recursions": (Gaussian(), {"motion": two_motions}),
}


OFTEN = ("horseshoe",)


@pytest.mark.parametrize("case", [pytest.param(c, marks=[] if c in OFTEN else pytest.mark.slow) for c in CASES])
def test_its_density_is_that_of_the_samplers(case):
    """log p of the frame's coordinates = log p of the model's sites + log |d sites / d coordinates|, to a constant."""
    prior, settings = CASES[case]
    problem = small(**settings)
    several = len(problem.model.recursions) > 1
    names = [f"noise_{r}" for r in range(2)] if several else ["noise"]
    with jax.enable_x64(True):
        form, posed = posed_of(problem, prior)
        model, M = numpyro_model(problem, prior=prior), form.biases
        eps = tuple(jnp.zeros_like(x) for x in posed.frame.point.states)
        phi = jax.jit(lambda key: form.hierarchy.relax(form.hierarchy.draw(key)))(jax.random.key(0))
        flat, back = ravel_pytree(Free(phi, jnp.zeros_like(posed.frame.theta), eps))

        def sites(x):
            free = back(x)
            found = parts(form, posed, free)
            point = place(posed.model, posed.frame, found.theta, free.eps)
            given = {"z": found.theta[:M], **dict(zip(names, point.noises, strict=True))} | dict(found.phi)
            return given | ({"level": found.theta[M:]} if problem.levels else {})

        @jax.jit
        def both(x):
            jacobian = jax.jacrev(lambda x: ravel_pytree(sites(x))[0])(x)
            return parts(form, posed, back(x)).density, log_density(model, (), {}, sites(x))[0], jacobian

        gaps, spread = [], []
        for seed in range(4):
            x = flat + 0.5 * np.random.default_rng(seed).standard_normal(flat.shape)
            own, theirs, jacobian = both(x)
            gaps.append(float(own - theirs) - np.linalg.slogdet(np.asarray(jacobian))[1])
            spread.append(float(own))
    assert np.ptp(spread) > 1.0, "the points must tell the densities apart"
    np.testing.assert_allclose(gaps, gaps[0], rtol=0, atol=1e-6 * np.ptp(spread))


def linear(seed=3):
    """A linear network with its naive form: two places, each measuring where a target is."""
    nodes = [Node("a", (0.0, 1.0), 0.4, scale=2.0), Node("b", (5.0, -2.0), -1.3, survey=0.5)]
    network = Network([fix.on(node) for node in nodes])
    motion = Target(ConstantVelocity(0.8), start={"position": ((1.0, -1.0), 1.0), "velocity": (0.3, 1.5)})
    random = np.random.default_rng(seed)
    rows = [
        {"time": t, "sensor": placed.name, "target": "target"} for t in (0.0, 1.0, 2.5) for placed in network.sensors
    ]
    table = pd.DataFrame(rows)
    table[["position_x", "position_y"]] = 2.0 * random.standard_normal((len(rows), 2))
    table.loc[1, "position_y"] = np.nan
    return network, motion, table


def test_prior_draws_have_the_moments_of_the_declaration():
    network, motion, table = linear()
    problem = Problem(network, motion, table)
    naive = reference.Linear(network, motion, table)
    naive.data, observed = [], naive.data  # the prior: nothing is measured
    prior = reference.dense(naive, np.ones(4))
    with jax.enable_x64(True):
        model, D = numpyro_model(problem, prior=Gaussian()), 4000
        drawn = Predictive(model, num_samples=D)(jax.random.key(5), observed=False)
        free = Predictive(model, num_samples=2)(jax.random.key(5))
    drawn = {name: np.asarray(values) for name, values in drawn.items()}
    np.testing.assert_allclose(drawn["bias"], drawn["z"] * problem.scales)
    np.testing.assert_array_equal(free["y_position"][0], problem.model.rows[0].y)  # conditioned by default
    mean, sd = prior.states
    width = 6.0 / np.sqrt(D)  # normal quantile of FALSE_ALARM over fewer than 100 comparisons
    states = drawn["state"].reshape(D, -1)
    assert (np.abs(states.mean(0) - mean) < width * sd).all()
    assert (np.abs(states.std(0) / sd - 1) < width).all()
    y = drawn["y_position"]
    order = {(d.epoch, tuple(d.G)): d for d in observed}
    assert len(order) == len(observed)
    A = np.array([[*d.G, *np.eye(3)[d.epoch].repeat(4) * np.tile(d.H, 3)] for d in observed])
    wide = np.sqrt(np.einsum("ij,jk,ik->i", A, prior.covariance, A) + np.array([d.std**2 for d in observed]))
    centre = A @ prior.mean + np.array([d.offset for d in observed])
    there = np.asarray(problem.model.rows[0].mask) > 0
    flat = y[:, there]
    assert (np.abs(flat.mean(0) - centre) < width * wide).all()
    assert (np.abs(flat.std(0) / wide - 1) < width).all()


@pytest.mark.slow
def test_numpyros_own_sampler_finds_the_exact_posterior():
    network, motion, table = linear()
    problem = Problem(network, motion, table)
    exact = reference.dense(reference.Linear(network, motion, table), np.ones(4))
    mean, covariance = exact.z
    with jax.enable_x64(True):
        run = MCMC(NUTS(numpyro_model(problem, prior=Gaussian())), num_warmup=300, num_samples=1500, progress_bar=False)
        run.run(jax.random.key(0))
        z = np.asarray(run.get_samples()["z"])
    sd = np.sqrt(np.diag(covariance))
    effective = numpyro.diagnostics.effective_sample_size(z[None])
    assert effective.min() > 300
    assert (np.abs(z.mean(0) - mean) < 5.5 * sd / np.sqrt(effective)).all()
    assert (np.abs(z.std(0) / sd - 1) < 5.5 / np.sqrt(effective)).all()


@pytest.mark.ci
def test_other_data_take_the_place_of_the_tables():
    problem = small()
    with jax.enable_x64(True):
        model, y = numpyro_model(problem, prior=Gaussian()), problem.model.rows[0].y
        seeded = numpyro.handlers.seed(model, jax.random.key(0))
        mask = np.asarray(problem.model.rows[0].mask)
        same = log_density(seeded, (), {}, {})[0]
        blank = np.where(mask > 0, y, np.nan)
        assert log_density(seeded, ({"y_radar": blank},), {}, {})[0] == same
        found = numpyro.handlers.trace(seeded).get_trace({"y_radar": y.at[0].set(jnp.nan)})["y_radar"]
        by_datum = found["fn"].log_prob(found["value"])
        assert by_datum.shape == y.shape
        assert (by_datum[0] == 0).all()
        assert (np.asarray(by_datum)[1:][mask[1:] == 0] == 0).all()
        assert found["fn"].sample(jax.random.key(1), (3, 2)).shape == (3, 2, *y.shape)
        with pytest.raises(InputError, match='no observed site is called "y_rader"; did you mean "y_radar"'):
            seeded({"y_rader": y})
        with pytest.raises(InputError, match=r'data\["y_radar"\] has shape \(3,\), its rows'):
            seeded({"y_radar": np.zeros(3)})


@pytest.mark.slow
def test_autoguides_and_log_likelihoods_of_numpyro_take_it():
    problem = small()
    with jax.enable_x64(True), jax.numpy_rank_promotion("allow"):  # numpyro's guides promote ranks
        model = numpyro_model(problem)
        guide = AutoNormal(model)
        svi = SVI(model, guide, numpyro.optim.Adam(0.01), Trace_ELBO())
        fitted = svi.run(jax.random.key(0), 50, progress_bar=False)
        drawn = guide.sample_posterior(jax.random.key(1), fitted.params, sample_shape=(3,))
        likely = numpyro.infer.log_likelihood(model, drawn)["y_radar"]
        again = Predictive(model, drawn)(jax.random.key(2), observed=False)["y_radar"]
    assert float(fitted.losses[-1]) < float(fitted.losses[0])
    assert drawn["z"].shape == (3, len(problem.labels))
    mask = np.asarray(problem.model.rows[0].mask)
    assert likely.shape == again.shape == (3, *mask.shape)
    assert ((np.asarray(likely) != 0) == (mask > 0)).all()
    assert np.isfinite(np.asarray(again)).all()


def sites(model, values):
    """Values of the latent sites and of the states of a model at values of its latent sites."""

    @jax.jit
    def traced(values):
        seeded = numpyro.handlers.substitute(numpyro.handlers.seed(model, jax.random.key(0)), values)
        trace = numpyro.handlers.trace(seeded).get_trace()
        latent = {k: v["value"] for k, v in trace.items() if v["type"] == "sample" and not v["is_observed"]}
        return latent, {k: v["value"] for k, v in trace.items() if k.startswith("state")}

    return traced(values)


STARTED = ("gaussian", "two recursions", "horseshoe", "ard", "levels and Student-t", "flat")


@pytest.mark.parametrize("case", [pytest.param(c, marks=[] if c == STARTED[0] else pytest.mark.ci) for c in STARTED])
def test_a_start_has_every_latent_site_and_the_trajectories_of_its_point(case):
    prior, settings = CASES[case]
    problem = small(**settings)
    model = numpyro_model(problem, prior=prior)
    random, noises, states = np.random.default_rng(0), [], []
    for part in problem.model.recursions:
        F, drift, u = np.asarray(part.F), np.asarray(part.drift), random.standard_normal(part.drift.shape)
        x = np.zeros_like(u)
        with jax.enable_x64(True):
            L = np.asarray(factors(part, jnp.zeros(len(problem.levels))))
        for k in range(len(x)):
            x[k] = F[k] @ x[k - 1] + drift[k] + L[k] @ u[k]
        noises.append(u)
        states.append(x)
    with jax.enable_x64(True):
        point = resting(problem)._replace(
            noises=tuple(map(jnp.asarray, noises)), states=tuple(map(jnp.asarray, states))
        )
        found = model.start(point)
        latent, reached = sites(model, found)
    assert {name: value.shape for name, value in found.items()} == {k: v.shape for k, v in latent.items()}
    for own, expected in zip(reached.values(), states, strict=True):
        np.testing.assert_allclose(own, expected, rtol=0, atol=1e-9 * np.abs(expected).max())
    assert all(np.isfinite(value).all() for value in found.values())


@pytest.mark.parametrize("case", [pytest.param(c, marks=[] if c in OFTEN else pytest.mark.ci) for c in STARTED])
def test_every_site_has_dims_and_every_bias_its_label(case):
    prior, settings = CASES[case]
    problem = small(**settings)
    model = numpyro_model(problem, prior=prior)
    dims, coords = model.dims, model.coords
    assert dims["bias"] == dims["z"] == ["bias_label"]
    assert coords["bias_label"] == list(problem.labels)
    assert set(model.hierarchy.hyper()) <= set(dims)
    assert coords["level_label"] == [level.label for level in problem.levels]
    for site, data in zip(model.sites, problem.model.rows, strict=True):
        assert tuple(len(coords[name]) for name in dims[site]) == data.y.shape
    if isinstance(prior, Horseshoe):
        assert dims["local_scale"] == ["governed_label"]
        assert coords["governed_label"] == np.array(problem.labels)[~problem.surveyed].tolist()


def tree_of(problem, z, held=None):
    """As much of a fit's tree as a start is made of."""
    labels, scales = list(problem.labels), problem.scales
    values = {"mean": ("bias_label", z * scales), "covariance": (("bias_label", "bias_label_other"), np.eye(len(z)))}
    group = xr.Dataset(values, {"bias_label": labels, "bias_label_other": labels})
    fixed = xr.Dataset({"fixed": ("fixed_label", [0.0])}, {"fixed_label": [held]}) if held else xr.Dataset()
    return xr.DataTree.from_dict({"calibration": group, "constant_data": fixed})


@pytest.mark.ci
def test_a_start_takes_the_biases_of_a_fit():
    problem = small()
    z = np.linspace(-1.0, 1.0, len(problem.labels))
    found = numpyro_model(problem, prior=Gaussian()).start(tree_of(problem, z))
    np.testing.assert_allclose(found["z"], z, rtol=1e-12)
    assert np.abs(found["noise"]).max() < 10.0


@pytest.mark.slow
def test_numpyros_kernels_and_guides_agree_with_the_samplers_from_a_start():
    """Rangers whose target has no declared start; ArviZ labels the draws, which agree within Monte Carlo error."""
    places = {"a": (0.0, 0.0), "b": (100.0, 10.0), "c": (90.0, 80.0), "d": (-10.0, 70.0)}
    nodes = [Node(name, place, scale={"position": 3.0} if name > "b" else {}) for name, place in places.items()]
    network = Network([probcal.sensors.ranger.on(node) for node in nodes])
    start = {"position": ((30.0, 40.0), 1.0), "velocity": ((3.0, -1.0), 0.5)}
    drawn = probcal.simulate(network, Target(ConstantVelocity(1.0), start), np.arange(8.0), key=1)
    problem = Problem(network, ConstantVelocity(1.0), drawn.table)
    own = az.extract(probcal.fit(problem, probcal.NUTS(draws=500), prior=Gaussian(), key=1), var_names="bias").values
    mean, sd = own.mean(1), own.std(1)
    model = numpyro_model(problem, prior=Gaussian())
    with jax.enable_x64(True), jax.numpy_rank_promotion("allow"):
        init = init_to_value(values=model.start())
        run = MCMC(NUTS(model, init_strategy=init), num_warmup=500, num_samples=1000, progress_bar=False)
        run.run(jax.random.key(0))
        tree = az.from_numpyro(run, dims=model.dims, coords=model.coords)
    bias = tree["posterior"]["bias"].sel(bias_label=list(problem.labels))
    effective = az.ess(tree, var_names=["bias"])["bias"].values
    assert effective.min() > 300
    width = 5.5 * np.sqrt(1 / effective + 1 / 300)
    assert (np.abs(bias.values.mean((0, 1)) - mean) < width * sd).all()
    assert (np.abs(bias.values.std((0, 1)) / sd - 1) < width).all()
    assert tree["posterior"]["state"].dims == ("chain", "draw", "epoch", "component")
    assert set(az.summary(tree, var_names=["bias"]).index) == {f"bias[{label}]" for label in problem.labels}


@pytest.mark.slow
def test_a_guide_of_full_rank_from_a_start_has_the_moments_of_the_posterior():
    problem = small()
    own = az.extract(probcal.fit(problem, probcal.NUTS(draws=500), prior=Gaussian(), key=1), var_names="bias").values
    model = numpyro_model(problem, prior=Gaussian())
    with jax.enable_x64(True), jax.numpy_rank_promotion("allow"):
        guide = AutoMultivariateNormal(model, init_loc_fn=init_to_value(values=model.start()), init_scale=0.01)
        svi = SVI(model, guide, numpyro.optim.ClippedAdam(0.005), Trace_ELBO(num_particles=4))
        found = svi.run(jax.random.key(0), 6000, progress_bar=False)
        tree = az.from_numpyro_svi(svi, svi_result=found, dims=model.dims, coords=model.coords)
    bias = tree["posterior"]["bias"].sel(bias_label=list(problem.labels)).values
    assert (np.abs(bias.mean(0) - own.mean(1)) < 0.25 * own.std(1)).all()
    np.testing.assert_allclose(bias.std(0) / own.std(1), 1.0, atol=0.15)


def test_what_it_refuses():
    problem = small()
    with pytest.raises(InputError, match=r"start: the fit holds b\.position_x fixed; give the Problem of this"):
        numpyro_model(problem, prior=Gaussian()).start(tree_of(problem, np.zeros(len(problem.labels)), "b.position_x"))
    with pytest.raises(InputError, match="BernoulliGaussian has no density that numpyro could take"):
        numpyro_model(problem, prior=BernoulliGaussian())
    with pytest.raises(InputError, match=r"runs in double precision only: call numpyro\.enable_x64"):
        numpyro.handlers.seed(numpyro_model(problem), 0)()


@pytest.mark.ci
def test_numpyro_is_whole_after_arviz_has_put_a_lazy_one_in_its_place():
    code = "import arviz_base, probcal, numpyro; numpyro.distributions.distribution.Unit"
    subprocess.run([sys.executable, "-c", code], check=True)
