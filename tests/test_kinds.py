"""Priors by kind of bias: by declaration, by pattern, and what they are equal to."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from contracts import close
from worlds import linear, resting

import probcal
from probcal import (
    ARD,
    EA,
    MAP,
    BernoulliGaussian,
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
    fit,
    sensor,
)
from probcal.inference import calibrate
from probcal.inference.hierarchy import Product, held, hierarchy_of, learnt_groups
from probcal.inference.methods import choose_prior
from probcal.priors import Precision, as_prior, by_kind
from probcal.sensor import ZEROS


@cache
def kind(zeros):
    """A range with a delay whose kind is declared."""

    @sensor(range=Channel("m", std=0.5))
    def echo(target, pose, *, delay=Bias("m", 2.0, zeros=zeros)):
        return {"range": probcal.geometry.norm(target.position - pose.position) + delay}

    return echo


@cache
def stated():
    """The fit whose delays are Gaussian by a pattern."""
    return fit(ranges(), prior={"*.delay": Gaussian()})


@cache
def ranges(zeros="expected", angle=0.0):
    """Four receivers whose places and delays have biases, in a world that is turned; the rows are the same."""
    corners = np.array([(0.0, 0.0), (100.0, 0.0), (0.0, 100.0), (100.0, 100.0)])

    def network(angle):
        nodes = [Node(f"n{k}", at, scale={"position": 5.0}) for k, at in enumerate(turned(corners, angle))]
        return Network([kind(zeros).on(node) for node in nodes])

    drawn = probcal.simulate(network(0.0), ConstantVelocity(1.0), np.arange(12.0), key=1)
    return Problem(network(angle), ConstantVelocity(1.0), drawn.table)


def turned(places, angle):
    """Places (N, 2) about the origin by an angle."""
    c, s = np.cos(angle), np.sin(angle)
    return places @ np.array([[c, s], [-s, c]])


def numbers(tree):
    """Mean, sd and interval of every bias."""
    return tree["calibration"].to_dataset()[["mean", "sd", "lower", "upper"]].to_array().values


def test_a_mixture_of_gaussians_is_one_gaussian():
    """On a linear world, bit for bit: the answer, its evidence and its covariance."""
    problem, start = linear("plane")[0], resting(linear("plane")[0])
    half = {"a.*": Gaussian(), "*_y": Gaussian()}
    one, other = (calibrate(problem, MAP(), prior=prior, start=start)[0] for prior in (Gaussian(), half))
    assert np.array_equal(numbers(one), numbers(other))
    assert one.attrs["log_evidence"] == other.attrs["log_evidence"]
    assert other.attrs["prior"] == "Gaussian; Gaussian of a.*; Gaussian of *_y"


@pytest.mark.parametrize(
    "prior", [Horseshoe(), ARD(rate=0.5), BernoulliGaussian(), Laplace()], ids=lambda p: type(p).__name__
)
def test_one_pattern_for_all_is_that_prior(prior):
    """The hierarchy, and with it every kernel and number, is that of the prior alone, whatever was declared."""
    for zeros in ZEROS:
        chosen = choose_prior(EA(), {"*": prior})
        assert hierarchy_of(chosen, ranges(zeros)) == hierarchy_of(prior, ranges())
        assert np.array_equal(learnt_groups(chosen, ranges(zeros)), learnt_groups(prior, ranges()))
        assert chosen.title(ranges(zeros).biases) == type(prior).__name__


def test_kinds_that_are_gaussian_are_left_out_of_the_hierarchy():
    """By declaration and by pattern alike; the first precision is that of the declared scale."""
    declared, stated = ranges("none"), ranges()
    by_pattern = choose_prior(EA(), {"*.delay": Gaussian()}, stated.labels)
    delays = np.array([label.endswith("delay") for label in stated.labels])
    for prior, problem in ((Horseshoe(), declared), (by_pattern, stated)):
        assert np.array_equal(held(prior, problem), delays)
        assert hierarchy_of(prior, problem).learnt == tuple(np.flatnonzero(~delays))
        assert np.asarray(prior.precision(problem.labels, problem.surveyed).alpha).tolist() == [1.0] * len(delays)
        assert prior.title(problem.biases) == f"Horseshoe; Gaussian of {'delay' if problem is declared else '*.delay'}"
    assert np.array_equal(hierarchy_of(Horseshoe(), declared).group, hierarchy_of(by_pattern, stated).group)


@pytest.mark.parametrize("prior", [Gaussian(), Flat()], ids=lambda p: type(p).__name__)
def test_gaussian_and_flat_take_all_kinds_alike(prior):
    one, other = (prior.precision(ranges(z).labels, ranges(z).surveyed).alpha for z in ("none", "expected"))
    assert np.array_equal(one, other)
    assert not held(prior, ranges("none")).any()
    assert prior.title(ranges("none").biases) == type(prior).__name__


@pytest.mark.ci
def test_the_declaration_and_the_pattern_give_one_answer():
    """Delays without zeros: the places alone are under the horseshoe, and a fit says so."""
    declared = fit(ranges("none"))
    assert np.array_equal(numbers(declared), numbers(stated()))
    assert declared.attrs["prior"] == "Horseshoe; Gaussian of delay"
    assert "Gaussian(correlation=(), kinds=())" in stated().attrs["settings"]
    scales = stated()["posterior"]["local_scale"]
    assert scales.coords["precision_group"].values.tolist() == [f"n{k}.position_x" for k in range(4)]


def test_the_axes_of_a_position_share_a_scale_by_default():
    """In the plane and, by `by=None`, not."""
    labels, group = ranges().labels, hierarchy_of(Horseshoe(), ranges()).group
    assert group[labels.index("n1.position_x")] == group[labels.index("n1.position_y")]
    assert len(set(group)) == 8
    assert len(set(hierarchy_of(Horseshoe(by=None), ranges()).group)) == len(labels)


@pytest.mark.slow
def test_the_answer_turns_with_the_world():
    """Places turned by one radian, the same ranges: biases turn by a radian, within the errors of the sweeps."""
    one, other = (fit(ranges(angle=angle))["calibration"].to_dataset() for angle in (0.0, 1.0))
    delays = [label for label in ranges().labels if label.endswith("delay")]
    pairs = [[f"n{k}.position_{x}" for x in "xy"] for k in range(4)]
    away = np.abs(other["mean"] - one["mean"]).sel(bias_label=delays)
    assert (away < 0.1 * one["sd"].sel(bias_label=delays)).all()
    for pair in pairs:
        wanted = turned(one["mean"].sel(bias_label=pair).values[None], 1.0)[0]
        away = np.abs(other["mean"].sel(bias_label=pair).values - wanted)
        assert (away < 0.1 * float(one["sd"].sel(bias_label=pair).min())).all()


@pytest.mark.ci
def test_every_bias_without_zeros_is_the_gaussian_fit():
    """Nothing is left for the hierarchy."""
    found, wanted = fit(ranges(), EA(tolerance=1e-6), prior={"*.*": Gaussian()}), fit(ranges(), MAP())
    close(numbers(found), numbers(wanted), 1e-6)
    assert found.attrs["precisions"] == "given"


@pytest.mark.ci
def test_maximised_precisions_hold_a_gaussian_kind():
    """ARD leaves the delays at their declared scale; two sparse priors are refused."""
    found = fit(ranges("none"), EA(precisions="maximised"))
    table = found["calibration"].to_dataset()
    delays = [label for label in ranges().labels if label.endswith("delay")]
    assert (table["precision"].sel(bias_label=delays) == 1.0).all()
    close(table["gamma"].sel(bias_label=delays), 1 - (table["sd"] / table["scale"]).sel(bias_label=delays) ** 2)


PHI = {
    "*.delay": ARD(rate=0.5, by="component"),
    "n0.position_*": BernoulliGaussian(),
    "n1.*": BernoulliGaussian(slab=None),
}


@pytest.mark.ci
def test_a_product_has_hyper_parameters_of_its_own():
    """Names, sizes and dimensions; what each part does is what it does alone."""
    problem = ranges()
    prior = choose_prior(EA(), PHI, problem.labels)
    found = hierarchy_of(prior, problem)
    assert isinstance(found, Product)
    assert sorted(found.learnt) == list(range(problem.model.biases))
    with jax.enable_x64(True):
        phi = found.draw(jax.random.key(0))
        assert set(phi) == {
            "included", "local_scale", "global_scale", "slab_variance", "alpha_delay", "share_n0_position", "share_n1",
            "slab_precision_n1",
        }  # fmt: skip
        assert set(found.begin(2)) == set(phi)
        alpha = np.asarray(found.alpha(phi, jnp.ones(problem.model.biases)))
        at = dict(zip(problem.labels, alpha, strict=True))
        assert at["n0.delay"] == at["n2.delay"] == pytest.approx(float(phi["alpha_delay"][0]))
        assert at["n1.delay"] == at["n1.position_x"] == pytest.approx(float(phi["slab_precision_n1"]))
        assert at["n0.position_x"] == 1.0
        shares = dict(zip([problem.labels[m] for m in found.spiked], np.asarray(found.share(phi)), strict=True))
        assert shares["n0.position_y"] == phi["share_n0_position"]
        assert shares["n1.delay"] == phi["share_n1"]
        back, density = found.constrain({n: found.relax(phi)[n] for n in found.hyper()})
        assert np.isfinite(density)
        for name, value in back.items():
            close(value, phi[name])
    given = found.variables(problem.labels, {name: np.asarray(value)[None, None] for name, value in phi.items()})
    assert given["included_n1"][0] == ("governed_label_n1",)
    assert given["included_n1"][2] == {"governed_label_n1": ["n1.position_x", "n1.position_y", "n1.delay"]}
    assert given["local_scale"][2] == {"precision_group": ["n2.position_x", "n3.position_x"]}


@pytest.mark.ci
def test_a_fit_with_three_kinds_is_saved_and_read_back(tmp_path):
    found = fit(ranges(), prior=PHI)
    probcal.save(found, tmp_path / "fit.nc")
    again = probcal.load(tmp_path / "fit.nc")
    assert again.attrs["prior"] == found.attrs["prior"]
    assert again["posterior"]["share_n1"].dims == ("chain", "draw")
    assert again["posterior"]["included_n1"].coords["governed_label_n1"].values.tolist()[2] == "n1.delay"
    compared = probcal.compare([found, stated()])
    assert found.attrs["prior"] in str(compared)


@pytest.mark.slow
def test_samplers_agree_with_integration_under_kinds():
    """Collapsed chains and the mixture of EA, within a quarter sd."""
    prior = {"*.delay": Gaussian(), "*.position_*": Horseshoe(by="vector")}
    one = fit(ranges(), prior=prior)["calibration"].to_dataset()
    for method in (probcal.Collapsed(), probcal.NUTS()):
        other = fit(ranges(), method, prior=prior)["calibration"].to_dataset()
        assert (np.abs(one["mean"] - other["mean"]) < 0.3 * one["sd"]).all()
        assert (np.abs(np.log(other["sd"] / one["sd"])) < 0.3).all()


def test_a_learnt_kind_has_a_hierarchy_of_its_own():
    """The prior of the fit, its share of zeros learnt; ARD and Laplace share nothing that could be learnt."""
    problem = ranges("learnt")
    found = hierarchy_of(Horseshoe(), problem)
    assert [name for name, _ in found.pieces] == ["", "delay"]
    assert [one.prior.expected for _, one in found.pieces] == [0.2, 0.5]
    spike = hierarchy_of(BernoulliGaussian(share=0.1), problem)
    assert [(one.prior.share, one.prior.slab) for _, one in spike.pieces] == [(0.1, 1.0), (None, None)]
    for prior in (ARD(rate=0.5), Laplace()):
        assert hierarchy_of(prior, problem) == hierarchy_of(prior, ranges())
    assert not hierarchy_of(Gaussian(), problem).learnt


def test_the_last_pattern_counts_and_the_star_is_the_rest():
    prior = by_kind(Horseshoe(), {"*.position_*": Gaussian(), "*": ARD(rate=1.0), "n0.*": Laplace()})
    parts, part = prior.parts(ranges().biases)
    named = [parts[k] for k in part]
    labels = ranges().labels
    assert named[labels.index("n0.position_x")] == ("n0.*", Laplace())
    assert named[labels.index("n1.position_x")] == ("*.position_*", Gaussian())
    assert named[labels.index("n1.delay")] == ("*", ARD(rate=1.0))
    assert by_kind(Gaussian(), {}) == Gaussian()
    assert by_kind(Flat(), {"*": Flat(), "a": Gaussian()}) == Flat(kinds={"a": Gaussian()})


def test_correlations_of_kinds_are_those_of_the_fit():
    """A Gaussian kind may be correlated under a sparse prior; its coupling is that of the Gaussian alone."""
    labels, none = ["a.x", "b.x", "a.y"], np.zeros(3, bool)
    mixed = by_kind(Horseshoe(), {"*.x": Gaussian(correlation={"*.x": 0.5})}).precision(labels, none)
    alone = Gaussian(correlation={"*.x": 0.5}).precision(labels, none)
    coupled = jax.jit(Precision.coupled)
    assert np.array_equal(coupled(mixed), coupled(alone))
    assert np.array_equal(mixed.alpha, alone.alpha)


WRONG = [
    (lambda: Bias("m", 1.0, zeros="never"), "Bias('m', zeros='never'): zeros is one of expected, none, learnt"),
    (lambda: Node("a", (0.0, 0.0), survey=Bias("m", 1.0, zeros="none")), "a survey of position takes no zeros"),
    (lambda: fit(ranges(), prior={"*.dely": Gaussian()}), 'prior "*.dely" matches no bias; did you mean'),
    (lambda: fit(ranges(), prior={"n0.*": Gaussian(), "*.*": Horseshoe()}), 'prior "n0.*" governs no bias, as later'),
    (lambda: fit(ranges(), prior={"*.delay": Flat()}), "the prior of \"*.delay\" is Flat"),
    (lambda: fit(ranges(), prior={"*.delay": "gaussian"}), "the prior of \"*.delay\" is 'gaussian': give one such as"),
    (lambda: Gaussian(kinds={"*.delay": Horseshoe()}), 'Gaussian(kinds=...) has a sparse prior of "*.delay": give'),
    (lambda: fit(ranges(), MAP(), prior={"*.delay": Horseshoe()}), "MAP does not take the prior Horseshoe; it takes"),
    (lambda: fit(ranges(), probcal.NUTS(), prior={"*.delay": BernoulliGaussian()}), "NUTS does not take the prior B"),
    (
        lambda: fit(ranges(), EA(precisions="maximised"), prior={"*.position_*": ARD(by="vector")}),
        "EA maximises the precisions of one sparse prior: give the other kinds Gaussian(), or take",
    ),
    (lambda: as_prior(3, Gaussian()), "the prior is 3; give a prior itself, such as Horseshoe() or Gaussian(), or a"),
]  # fmt: skip


@pytest.mark.parametrize(("wrong", "text"), WRONG, ids=range(len(WRONG)))
def test_what_is_wrong_is_said(wrong, text):
    with pytest.raises(InputError) as error:
        wrong()
    assert text in str(error.value)
    assert "\n" not in str(error.value)
