"""Samplers: each kernel leaves its target alone, linear problems are exact, both samplers agree, results are whole."""

import itertools
from dataclasses import replace
from functools import cache

import arviz as az
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from contracts import check_tree
from scipy import stats
from worlds import LINEAR, linear, resting

import probcal
from probcal import ARD, MCMC, NUTS, SVI, BernoulliGaussian, Collapsed, Flat, Gaussian, Horseshoe, InputError, Laplace
from probcal.analysis.assess import assess
from probcal.gaussian.frame import frame_at, log_weight, place, unit_normals, volume
from probcal.gaussian.information import at_levels
from probcal.gaussian.linearised import laplace
from probcal.gaussian.mode import factors, find_mode, smooth_tracks
from probcal.inference.collapsed import CollapsedState, hmc_step
from probcal.inference.draws import inverse_gaussian, slice_step
from probcal.inference.hierarchy import hierarchy_of
from probcal.inference.mixed import mixing
from probcal.inference.pose import pareto_khat
from probcal.inference.posed import Form, Posed, conditional, update_inclusions, whiten
from probcal.modes import automatic_start
from probcal.priors import Precision
from probcal.results.read import each_track

PRIORS = [ARD(shape=2.0, rate=0.7), ARD(by="node", rate=0.5), Laplace(), Horseshoe()]
ALARM = 1e-4  # rate at which a right sampler fails one of these tests, for each comparison


# one kernel each, where every operation alone would be one
PLACE, DRIVING, VOLUME = jax.jit(place), jax.jit(unit_normals), jax.jit(volume)
WEIGHT, CONDITIONAL = jax.jit(log_weight), jax.jit(conditional, static_argnums=0)


@pytest.fixture(autouse=True)
def double():
    with jax.enable_x64(True):
        yield


@cache
def made(name, prior):
    problem, naive = linear(name)
    point = smooth_tracks(problem.model, resting(problem))
    posed = Posed(problem.model, frame_at(problem.model, point),
                  prior.precision(problem.labels, problem.surveyed))  # fmt: skip
    return problem, Form(problem.model.biases, hierarchy_of(prior, problem)), posed, naive


def same_law(a, b):
    """Two independent samples of one law, by Kolmogorov and Smirnov at the stated rate."""
    assert stats.ks_2samp(np.asarray(a), np.asarray(b)).pvalue > ALARM


def test_inverse_gaussian_draws_have_their_law():
    draw = jax.jit(inverse_gaussian)
    for mean, shape in ((0.3, 2.0), (5.0, 2.0), (1e4, 2.0)):
        drawn = draw(jax.random.key(0), np.full(20000, mean), shape)
        assert stats.kstest(np.asarray(drawn), stats.invgauss(mean / shape, scale=shape).cdf).pvalue > ALARM


def test_slice_steps_leave_a_density_alone():
    keys = jax.random.split(jax.random.key(1), 20000)
    start = jax.jit(jax.vmap(lambda k: jnp.log(jax.random.gamma(k, 0.7))))(keys)
    move = jax.jit(jax.vmap(lambda k, x: slice_step(jax.random.fold_in(k, 1), x, lambda t: 0.7 * t - jnp.exp(t))))
    moved = move(keys, start)
    assert stats.kstest(np.exp(np.asarray(moved)), stats.gamma(0.7).cdf).pvalue > ALARM
    assert np.corrcoef(start, moved)[0, 1] < 0.5, "it moves"


@pytest.mark.slow
@pytest.mark.parametrize("prior", [*PRIORS, BernoulliGaussian()], ids=lambda p: f"{type(p).__name__}-{p}"[:24])
def test_updates_leave_the_joint_prior_of_scales_and_biases_alone(prior):
    """phi from its prior and z given phi; phi updated given z must have the prior's law again (Geweke 2004)."""
    _problem, form, _, _ = made("plane", prior)
    kind = form.hierarchy

    def one(key):
        keys = jax.random.split(key, 3)
        phi = kind.draw(keys[0])
        active = kind.active(phi, form.biases)[jnp.asarray(kind.learnt)]
        z = active * jax.random.normal(keys[1], active.shape) / jnp.sqrt(kind.governed(phi))
        new = phi
        for k, update in enumerate(kind.updates()):
            new = update(new, z, jax.random.fold_in(keys[2], k))
        return phi, new, z

    phi, new, _z = jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(2), 8000))
    again = jax.jit(jax.vmap(kind.draw))(jax.random.split(jax.random.key(3), 8000))
    for name in kind.hyper():
        fresh = again[name]
        for k in range((np.ndim(fresh[0]) and fresh.shape[1]) or 1):
            old, after = (np.asarray(a).reshape(8000, -1)[:, k] for a in (fresh, new[name]))
            same_law(np.log(old), np.log(after))
    assert any(not np.array_equal(phi[name], new[name]) for name in kind.hyper()), "something was updated"
    known = kind.hyper()
    for name, values in kind.relax({n: phi[n][0] for n in known}).items():
        back, _ = kind.constrain(kind.relax({n: phi[n][0] for n in known}))
        np.testing.assert_allclose(back[name], phi[name][0], rtol=1e-9, err_msg=str(values))


def test_inclusions_have_their_exact_probabilities():
    prior = BernoulliGaussian(share=0.3, slab=1.5)
    problem, form, posed, linear = made("plane", prior)
    learnt = form.hierarchy.learnt
    alpha = np.where(problem.surveyed, 1.0, 1 / 1.5**2)
    assert list(problem.labels) == list(linear.labels)
    total, share = {}, np.zeros(len(learnt))
    for pattern in itertools.product([False, True], repeat=len(learnt)):
        spread = 1 / alpha
        spread[list(learnt)] *= pattern
        odds = np.prod(np.where(pattern, 0.3, 0.7))
        total[pattern] = reference.dense(linear, np.diag(spread)).evidence + np.log(odds)
    weight = np.exp(np.array(list(total.values())) - max(total.values()))
    share = (np.array(list(total)) * (weight / weight.sum())[:, None]).sum(0)
    phi = form.hierarchy.draw(jax.random.key(0))

    def step(phi, key):
        keys = jax.random.split(key)
        phi = update_inclusions(form, posed, phi, keys[0], backwards=False)
        phi = update_inclusions(form, posed, phi, keys[1], backwards=True)
        return phi, phi["included"]

    _, drawn = jax.jit(lambda phi, keys: jax.lax.scan(step, phi, keys))(phi, jax.random.split(jax.random.key(1), 6000))
    drawn = np.asarray(drawn, float)
    ess = az.ess(az.convert_to_datatree({"x": drawn[None]}))["x"].values
    error = np.sqrt(np.maximum(share * (1 - share), 1e-4) / ess)
    assert np.all(np.abs(drawn.mean(0) - share) < 4.5 * error), (drawn.mean(0), share)
    assert 0.02 < share.min() < share.max() < 0.999, "the case decides something"


@pytest.mark.parametrize(
    "name", ["plane", *(pytest.param(name, marks=pytest.mark.slow) for name in ("extras", "space", "mixed"))]
)
def test_a_frame_is_exact_on_linear_problems(name):
    problem, form, posed, linear = made(name, Gaussian())
    rng = np.random.default_rng(4)
    theta = posed.frame.theta + 3 * rng.standard_normal(posed.frame.theta.shape)
    eps = tuple(2 * rng.standard_normal(x.shape) for x in posed.frame.point.states)
    weight = WEIGHT(problem.model, posed.frame, theta, eps)
    assert abs(float(weight)) < 1e-8 * max(1.0, abs(float(posed.frame.log_likelihood(theta))))
    exact = reference.dense(linear, np.ones(len(linear.labels)))
    order = [list(problem.labels).index(label) for label in linear.labels]
    found = CONDITIONAL(form, posed, {})
    np.testing.assert_allclose(np.asarray(found.mean)[order], exact.z[0], rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(np.asarray(found.variance)[order], np.diag(exact.z[1]), rtol=1e-7)
    point = PLACE(problem.model, posed.frame, theta, eps)
    for part, x, u in zip(problem.model.recursions, point.states, point.noises, strict=True):
        before = np.concatenate([np.zeros_like(x[:1]), x[:-1]])
        made_of = np.einsum("eij,ej->ei", part.F, before) + part.drift + np.einsum("eij,ej->ei", part.L, u)
        np.testing.assert_allclose(x, made_of, rtol=1e-8, atol=1e-8)


@pytest.mark.slow
def test_a_frame_follows_its_levels():
    """At any levels the track of a linear problem has the frame's law, exactly where its loops are known."""
    network, motion, table, _ = LINEAR["plane"]()
    unknown = probcal.Target(probcal.ConstantVelocity(probcal.Unknown(0.8)), motion.start)
    kind = network.types[0]
    channels = {name: replace(channel, std=probcal.Unknown(1.0)) for name, channel in kind.channels.items()}
    placed = replace(kind, channels=channels)
    network = probcal.Network([placed.on(s.nodes[0]) for s in network.sensors])
    problem = probcal.Problem(network, unknown, table.filter(regex="^(?!.*_std)"))
    start = resting(problem)._replace(levels=jnp.zeros(len(problem.levels)))
    frame = frame_at(problem.model, smooth_tracks(problem.model, start))
    keys = jax.random.split(jax.random.key(9), 200)

    @jax.jit
    def spread(theta):
        def one(key):
            eps = tuple(jax.random.normal(key, x.shape) for x in frame.point.states)
            return log_weight(problem.model, frame, theta, eps)

        return jnp.std(jax.lax.map(one, keys))

    @jax.jit
    def slopes(theta, e):
        return jax.jacfwd(
            lambda e: jnp.concatenate([u.ravel() for u in place(problem.model, frame, theta, (e,)).noises])
        )(e)

    H = len(problem.levels)
    assert H == 2
    for step in np.concatenate([np.zeros((1, H)), np.eye(H), -3 * np.eye(H), 0.25 * np.eye(H), -1.3 * np.eye(H)]):
        theta = frame.theta.at[-H:].add(step)
        assert spread(theta) < (1e-6 if np.all(step == np.round(step)) else 0.1)
        eps = tuple(jax.random.normal(keys[0], x.shape) for x in frame.point.states)
        point = PLACE(problem.model, frame, theta, eps)
        for again, e in zip(DRIVING(problem.model, frame, point), eps, strict=True):
            np.testing.assert_allclose(again, e, rtol=1e-7, atol=1e-7)
        for part, x, u in zip(problem.model.recursions, point.states, point.noises, strict=True):
            before = np.concatenate([np.zeros_like(x[:1]), x[:-1]])
            made_of = np.einsum("eij,ej->ei", part.F, before) + part.drift
            made_of += np.einsum("eij,ej->ei", factors(part, point.levels), u)
            np.testing.assert_allclose(x, made_of, rtol=1e-8, atol=1e-8)

        slope = slopes(theta, eps[0]).reshape(eps[0].size, -1)
        assert np.linalg.slogdet(slope)[1] == pytest.approx(float(VOLUME(problem.model, frame, theta)), abs=1e-8)


def test_whitening_has_the_derivative_of_its_value():
    rng = np.random.default_rng(5)
    root, alpha = rng.standard_normal((20, 20)), rng.uniform(size=20) + 0.1
    matrix, (pull, eta, turn) = root @ root.T, rng.standard_normal((3, 20))

    @jax.jit
    def value(alpha, eta):
        theta, volume = whiten(matrix, alpha, pull, eta)
        return jnp.sum(jnp.sin(theta)) + 0.3 * volume

    slopes = jax.jit(jax.grad(value, (0, 1)))(alpha, eta)
    for k, slope in enumerate(slopes):
        step = [1e-6 * turn if j == k else 0.0 for j in range(2)]
        ends = [float(value(alpha + s * step[0], eta + s * step[1])) for s in (1, -1)]
        assert (ends[0] - ends[1]) / 2e-6 == pytest.approx(float(np.asarray(slope) @ turn), rel=1e-5)


@cache
def fitted(name, method, prior, key=0):
    problem, naive = linear(name)
    tree = probcal.fit(problem, method, prior=prior, start=resting(problem), key=key)
    return problem, tree, naive


def check_exact(tree, exact, labels):
    """Means and variances of the biases within their Monte Carlo error, at 4.5 standard errors."""
    z = tree["posterior"]["bias"].sel(bias_label=list(labels)).values / (
        tree["calibration"]["scale"].sel(bias_label=list(labels)).values
    )
    ess = mixing(z)["ess"]
    mean, sd = exact[0], np.sqrt(np.diag(exact[1]))
    assert np.all(np.abs(z.mean((0, 1)) - mean) < 4.5 * sd / np.sqrt(ess))
    squares = mixing(((z - mean) / sd) ** 2)["ess"]
    assert np.all(np.abs(z.std((0, 1)) / sd - 1) < 4.5 / np.sqrt(2 * np.minimum(squares, ess)))


SMALL = {
    "collapsed": Collapsed(draws=1000, sweeps=1, warmup=50),
    "nuts": NUTS(draws=600, warmup=300),
}

SPIKE = Collapsed(draws=100, warmup=50)


@pytest.mark.parametrize(
    ("name", "method"),
    [
        ("plane", "collapsed"), pytest.param("plane", "nuts", marks=pytest.mark.ci),
        *(pytest.param(*pair, marks=pytest.mark.slow) for pair in (("mixed", "collapsed"), ("extras", "nuts"))),
    ],
)  # fmt: skip
def test_a_linear_problem_has_its_exact_posterior(name, method):
    _problem, tree, linear = fitted(name, SMALL[method], Gaussian())
    exact = reference.dense(linear, np.ones(len(linear.labels)))
    check_exact(tree, exact.z, linear.labels)
    assert tree.attrs["approximate"] == "exact"
    if method == "collapsed":
        assert np.allclose(tree["sample_stats"]["acceptance_rate"], 1.0), "the collapse is exact here"
    states = np.concatenate([track["sd"].values.ravel() for _, track in each_track(tree)])
    assert np.isfinite(states).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    "prior",
    [Horseshoe(), *(pytest.param(p, marks=pytest.mark.slow) for p in (ARD(shape=2.0, rate=0.7), Laplace()))],
    ids=lambda p: type(p).__name__,
)
def test_both_samplers_draw_from_one_posterior(prior):
    """Collapsed and joint agree on means, spreads and hyper-parameters of a linear problem."""
    _, one, _ = fitted("plane", replace(SMALL["collapsed"], sweeps=5), prior)
    _, two, _ = fitted("plane", SMALL["nuts"], prior)
    for name in ("bias", "gamma"):
        a, b = (t["posterior"][name].values for t in (one, two))
        error = np.sqrt(a.var((0, 1)) / mixing(a)["ess"] + b.var((0, 1)) / mixing(b)["ess"])
        assert np.all(np.abs(a.mean((0, 1)) - b.mean((0, 1))) < 4.5 * error + 1e-9), name
    quantiles = [np.percentile(t["posterior"]["bias"].values, [10, 50, 90], axis=(0, 1)) for t in (one, two)]
    scale = one["calibration"]["sd"].values
    assert np.abs(quantiles[0] - quantiles[1]).max() < 0.25 * scale.max()
    assert two["sample_stats"]["diverging"].sum() == 0


def test_what_a_spike_keeps_out_has_no_part_in_a_swing(monkeypatch):
    """An excluded bias may be given any momentum: it stays at 0 and leaves the energy alone."""
    _, form, posed, _ = made("plane", BernoulliGaussian())
    phi = form.hierarchy.draw(jax.random.key(0)) | {"included": jnp.zeros(len(form.hierarchy.learnt), bool)}
    given = CONDITIONAL(form, posed, phi)
    out = ~np.asarray(given.active)
    assert out.any()
    eps = tuple(jnp.ones_like(x) for x in posed.frame.point.states)
    theta = jnp.where(given.active, given.mean, 0.0)
    weight = WEIGHT(posed.model, posed.frame, theta, eps)
    normal = jax.random.normal

    def pushed(key, shape, dtype=float):
        drawn = normal(key, shape, dtype)
        return jnp.where(out, 1e3, drawn) if shape == theta.shape else drawn

    monkeypatch.setattr(jax.random, "normal", pushed)
    chain = CollapsedState(theta, eps, phi, weight, jax.random.key(1))
    move = jax.jit(lambda key: hmc_step(posed, chain, given, key))
    ends = [move(jax.random.key(k)) for k in range(5)]
    assert all((np.asarray(end[0])[out] == 0).all() for end in ends)
    moved = [not np.array_equal(end[1][0], eps[0]) for end in ends]
    assert np.mean(moved) > 0.5, "their kinetic energy counts against no move"


@pytest.mark.parametrize(
    ("chains", "draws"),
    [pytest.param(1, 1, marks=pytest.mark.ci), *(pytest.param(*n, marks=pytest.mark.slow) for n in ((1, 3), (2, 10)))],
)
def test_a_run_of_few_draws_has_numbers_and_can_be_assessed(chains, draws):
    problem, tree, _ = fitted("plane", Collapsed(chains=chains, draws=draws, warmup=0), Gaussian())
    assert tree.attrs["status"] == "not converged"
    out = assess(problem, tree)
    for name, group in out.children.items():
        for values in group.to_dataset().data_vars.values():
            led = (name, values.name) != ("mode", "objective")  # by a start, without which there is none
            assert values.dtype.kind in "USbO" or np.isfinite(values.values).all() or not led, (name, values.name)
    assert (tree["calibration"]["sd"] > 0).all()
    assert set(out["verdict"]["verdict"].values) <= {"weak", "prior only", "drifting", "conflicting"}
    assert any("PSIS-LOO and power scaling are left out" in text for text in out["finding"]["sentence"].values)
    assert "elpd" not in out["datum_check"].data_vars
    assert "sensitivity" not in out.children


@pytest.mark.slow
def test_the_tree_of_a_sampler_is_whole_and_arviz_reads_it():
    _, tree, _ = fitted("plane", SPIKE, BernoulliGaussian(), key=3)
    for group in tree.children.values():
        for name, values in group.data_vars.items():
            assert values.dtype.kind in "USbO" or np.isfinite(values.values).all(), name
    labels = tree["calibration"]["bias_label"].values.tolist()
    frame = az.summary(tree, var_names="bias")
    assert len(frame) == len(labels)
    table = probcal.summary(tree)
    assert {"r_hat", "ess", "ess_tail", "inclusion", "included", "contraction"} <= set(table.columns)
    out = tree["posterior"]["included"].values
    assert np.array_equal(out.mean((0, 1)), table.set_index("bias")["included"][tree["posterior"]["governed_label"]])
    shares = tree["posterior"]["bias"].sel(bias_label=tree["posterior"]["governed_label"].values).values == 0
    assert np.array_equal(shares, ~out.astype(bool)), "a bias is zero exactly where it is out"
    fitted.cache_clear()
    again = fitted("plane", SPIKE, BernoulliGaussian(), key=3)[1]
    assert np.array_equal(again["posterior"]["bias"], tree["posterior"]["bias"]), "a seed gives its draws"


@pytest.mark.slow
def test_the_draws_of_a_sampler_are_assessed():
    problem, tree, _ = fitted("plane", SPIKE, BernoulliGaussian(), key=3)
    assert "verdict" in probcal.assess(problem, tree).children


def test_a_constant_quantity_counts_as_mixed():
    draws = np.random.default_rng(0).standard_normal((4, 50, 2))
    draws[:, :, 1] = 0.0
    found = mixing(draws)
    assert found["r_hat"][1] == 1.0
    assert found["ess"][1] == 200
    assert all(np.isfinite(values).all() for values in found.values())


def test_wrong_settings_are_refused():
    with pytest.raises(InputError, match="a sampler needs a proper hyper-prior"):
        hierarchy_of(ARD(), linear("plane")[0])
    with pytest.raises(InputError, match="target is in"):
        NUTS(target=1.5)
    with pytest.raises(InputError, match=r"Collapsed\(patience=0\): it must be at least 1"):
        Collapsed(patience=0)
    text = r"MCMC\(effective=201\): give a number from 1 to the 200 draws that 2 chains keep, or more draws"
    with pytest.raises(InputError, match=text):
        MCMC(chains=2, draws=100, effective=201)
    with pytest.raises(InputError, match=r"MCMC\(effective=0\): give a number"):
        MCMC(effective=0)
    with pytest.raises(InputError, match="it must be at least"):
        Collapsed(draws=0)
    with pytest.raises(InputError, match="chains are the most"):
        Collapsed(chains=10**6)
    with pytest.raises(InputError, match="with warm-up; 10,000,000 in all are the most"):
        NUTS(draws=10**12)
    with pytest.raises(InputError, match="it must lie between 0 and 1, or be None"):
        BernoulliGaussian(share=1.5)
    with pytest.raises(InputError, match="give a positive number"):
        BernoulliGaussian(slab=0.0)
    with pytest.raises(InputError, match="NUTS does not take the prior BernoulliGaussian"):
        fitted("plane", NUTS(), BernoulliGaussian())


@pytest.mark.ci
def test_a_flat_prior_on_a_determined_problem_is_the_likelihood():
    problem, tree, linear = fitted("plane", Collapsed(draws=500, sweeps=1), Flat())
    broad = np.where([label in set(np.array(problem.labels)[problem.surveyed]) for label in linear.labels], 1.0, 1e-9)
    check_exact(tree, reference.dense(linear, broad).z, linear.labels)


def test_the_evidence_integrates_every_hyper_parameter():
    """The exact evidence of a Gaussian prior to rounding, and the sum over all patterns of a spike and slab."""
    problem, naive = linear("plane")
    start = resting(problem)
    exact = reference.dense(naive, np.ones(len(naive.labels))).evidence
    found = probcal.log_evidence(problem, prior=Gaussian(), start=start)
    assert found.value == pytest.approx(exact, rel=1e-10)
    assert found.error < 1e-8
    prior, total = BernoulliGaussian(share=0.1, slab=3.0), []
    learnt = ~np.array([label in set(np.array(problem.labels)[problem.surveyed]) for label in naive.labels])
    for pattern in itertools.product([False, True], repeat=int(learnt.sum())):
        spread = np.ones(len(naive.labels))
        spread[learnt] *= 9.0 * np.array(pattern)
        total.append(reference.dense(naive, np.diag(spread)).evidence + np.log(np.where(pattern, 0.1, 0.9)).sum())
    found = probcal.log_evidence(problem, prior=prior, start=start)
    assert abs(found.value - np.logaddexp.reduce(total)) < 4.5 * found.error + 1e-6
    assert found.khat == 0.0
    with pytest.raises(InputError, match="a flat prior has no evidence"):
        probcal.log_evidence(problem, prior=Flat())


def test_khat_is_that_of_the_heavy_right_tail():
    """Weights that are Pareto of shape k have k-hat k; their inverses have none to speak of."""
    uniform = np.random.default_rng(0).uniform(size=20000)
    for k in (0.3, 0.9):
        assert pareto_khat(-k * np.log(uniform)) == pytest.approx(k, abs=0.15)
    assert pareto_khat(0.9 * np.log(uniform)) < 0.0
    assert pareto_khat(np.zeros(100)) == 0.0
    assert pareto_khat(np.array([0.0, -np.inf])) == np.inf


@pytest.mark.parametrize(
    ("method", "prior"),
    [
        pytest.param(Collapsed(draws=60), ARD(by="node", rate=0.5), marks=pytest.mark.slow),
        *(
            pytest.param(method, prior, marks=pytest.mark.slow)
            for method in (Collapsed(draws=60), NUTS(draws=60, warmup=100), SVI(draws=60, warmup=200))
            for prior in (Flat(), Gaussian(), Laplace(), ARD(rate=0.5), Horseshoe(), BernoulliGaussian())
            if method.takes(prior)
        ),
    ],
    ids=lambda v: type(v).__name__,
)
def test_every_prior_gives_a_whole_tree(method, prior):
    problem, tree, _ = fitted("plane", method, prior)
    check_tree(tree, problem)
    assert tree.attrs["prior"] == type(prior).__name__


@pytest.mark.slow
def test_a_process_noise_hardly_known_keeps_its_lower_tail():
    """One straight track: the level is known within a factor of 2.5; shares below exact quantiles, by quadrature.

    With 400 effective draws a share lies within three of its standard errors of the right one but for 0.3 % each.
    """
    kind = probcal.sensors.position
    kind = replace(kind, channels={"position": replace(kind.channels["position"], std=5.0)})
    nodes = [probcal.Node("a", (0.0, 0.0)), probcal.Node("b", (5.0, 0.0), scale=1.0)]
    network = probcal.Network([kind.on(node) for node in nodes])
    start = {"position": (0.0, 20.0), "velocity": (0.0, 1.0)}
    table = probcal.simulate(
        network, probcal.Target(probcal.ConstantVelocity(0.02), start), np.arange(30.0), key=2
    ).table  # fmt: skip
    unknown = probcal.Target(probcal.ConstantVelocity(probcal.Unknown(0.3, 5.0)), start)
    problem = probcal.Problem(network, unknown, table)
    point = automatic_start(problem)
    prior = Precision(jnp.ones(len(problem.labels)))
    grid = jnp.linspace(-9.0, 2.5, 400)

    def evidence(level):
        found = find_mode(problem.model, at_levels(problem.model, point, level[None]), prior, 2, 1e-9)
        return laplace(problem.model, found.point, prior).evidence

    value = np.asarray(jax.lax.map(evidence, grid))
    mass = np.cumsum(np.exp(value - value.max()))
    tree = probcal.fit(problem, NUTS(draws=600), prior=Gaussian(), key=1, start=point)
    drawn = np.log(tree["posterior"]["level"].values.ravel() / 0.3)
    assert tree.attrs["status"] == "converged", tree.attrs["message"]
    for share in (0.01, 0.05, 0.25, 0.5, 0.75, 0.95):
        quantile = np.interp(share * mass[-1], mass, grid)
        assert abs((drawn < quantile).mean() - share) < 0.15 * np.sqrt(share * (1 - share))
