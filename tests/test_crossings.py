"""A node alone on the other side of the path that it hears: found, taken where it fits better, and told of."""

from unittest.mock import patch

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import probcal
from probcal import ARD, EA, MAP, ConstantVelocity, Gaussian, Network, Node, Problem, simulate
from probcal.inference.pruned import GroupEvidence, without_far_modes
from probcal.labels import NODE
from probcal.modes import automatic_start
from probcal.modes.crossings import _parted, crossed_nodes
from probcal.modes.explore import TRIED, Candidate, SideClimb, Sides, explore
from probcal.modes.grid import track_mode
from probcal.modes.reflections import Plane, across
from probcal.plots.interactive import interactive_map, layers
from probcal.plots.map import plot_map
from probcal.plots.scene import scene
from probcal.results.modes import rivals
from probcal.sensors import position, ranger, tdoa

PLACES = [(0, 10), (40, -14), (80, 12), (120, -9), (60, 40), (20, -40), (100, -38)]
FLIGHT = [(0, 0, 60), (120, 0, 6), (0, 120, 4), (120, 120, 64), (60, -20, 2), (60, 140, 62)]


def beside(seed, bend, loose=("b0",), scale=6.0, **biases):
    """Beacons at both sides of a path that bends by so many m, some of them surveyed to 6 m only: the problem."""
    nodes = [Node(f"b{k}", place, scale=scale if f"b{k}" in loose else None) for k, place in enumerate(PLACES)]
    time = np.arange(0, 60, 0.5)
    path = np.stack([-10 + 2.3 * time, bend * np.sin(time / 9)], 1)
    return drawn(Network([ranger.on(node) for node in nodes]), time, path, seed, biases)


def above(seed, climb, kind="tdoa", **biases):
    """Anchors on the ground and on masts, and a drone that flies at their mean height but for some s: the problem."""
    nodes = [Node(f"b{k}", place, scale=20.0 if k == 0 else None) for k, place in enumerate(FLIGHT)]
    pairs = zip(nodes, [*nodes[1:], nodes[0]], strict=True)
    sensors = [tdoa.on(*pair) for pair in pairs] if kind == "tdoa" else [ranger.on(node) for node in nodes]
    time = np.arange(0, 60, 0.5)
    height = 32 + climb * np.exp(-((time - 12) ** 2) / 20)
    path = np.stack([60 + 40 * np.cos(time / 12), 60 + 40 * np.sin(time / 12), height], 1)
    return drawn(Network(sensors), time, path, seed, biases)


def drawn(network, time, path, seed, biases):
    motion = ConstantVelocity(0.5)
    found = simulate(network, motion, time, key=seed, share=0.0, biases=biases, tracks={"target": path})
    return Problem(network, motion, found.table)


def bias(tree, label):
    chosen = tree["calibration"].to_dataset().sel(bias_label=label)
    return float(chosen["mean"]), float(chosen["sd"])


def on_the_wrong_side(problem, label, shift):
    """The automatic start with one bias shifted, tracks smoothed there."""
    with jax.enable_x64(True):
        start, z = automatic_start(problem), np.zeros(len(problem.labels))
        z[problem.labels.index(label)] = shift / problem.scales[problem.labels.index(label)]
        return track_mode(problem, start._replace(z=jnp.asarray(z)))


@pytest.mark.ci
@pytest.mark.parametrize("form", ["dense", "cholmod", pytest.param("iterative", marks=pytest.mark.slow)])
def test_a_node_that_stands_on_the_other_side_is_found(form):
    """The path bends by 4 m, which tells the sides apart; every climb begins on the stated one."""
    problem = beside(0, 4.0, **{"b0.position_y": -20.0})
    tree = probcal.fit(problem, MAP(engine=form), prior=Gaussian())
    mean, sd = bias(tree, "b0.position_y")
    assert abs(mean + 20.0) < 4 * sd < 4.0
    assert tree.attrs["status"] == "converged"


@pytest.mark.slow
@pytest.mark.parametrize("loose", [("b0",), tuple(f"b{k}" for k in range(7))], ids=["one", "all"])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_sides_are_told_apart_by_the_default(seed, loose):
    """Every node loose: the scene may shift, so that EA is sparse; `converged` 16 to 25 m off, before."""
    for shift in (0.0, -20.0):
        problem = beside(seed, 4.0, loose, **{"b0.position_y": shift})
        for start in (None, on_the_wrong_side(problem, "b0.position_y", -20.0 - shift)):
            tree = probcal.fit(problem, start=start)
            mean, sd = bias(tree, "b0.position_y")
            assert abs(mean - shift) < 4 * max(sd, 0.2)
            assert sd < 1.0


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["tdoa", "ranger"])
@pytest.mark.parametrize("shift", [0.0, -56.0])
def test_an_anchor_above_or_below_the_flight_is_found(kind, shift):
    """In 3-D, each row of one node or of two: only the 25 m by which the flight dips tell above from below."""
    problem = above(0, -25.0, kind, **{"b0.position_z": shift})
    tree = probcal.fit(problem)
    mean, sd = bias(tree, "b0.position_z")
    assert abs(mean - shift) < 4 * max(sd, 0.5)
    assert sd < 4.0


@pytest.mark.ci
def test_a_height_alone_is_free():
    """The path is a plane by least squares, tilted a little: 18 sd off, `converged`, where x and y had to move too."""
    problem = above(0, -25.0, "ranger", **{"b0.position_z": -56.0})
    stated = Problem(problem.network, ConstantVelocity(0.5), problem.measurements.table, fix=("b0.position_[xy]",))
    mean, sd = bias(probcal.fit(stated, MAP(), prior=Gaussian()), "b0.position_z")
    assert abs(mean + 56.0) < 4 * sd < 20.0


def test_climbs_that_come_back_are_few():
    """Of a hundred nodes that come back eight are climbed."""
    problem = beside(0, 4.0, **{"b0.position_y": -20.0})
    with jax.enable_x64(True):
        point, climbs = automatic_start(problem), []

        def mode(at):
            climbs.append(at)
            return point, 0.0

        many = (lambda *_: (Candidate(f"n{k}", NODE, point) for k in range(100)),)
        assert explore(problem, point, SideClimb(mode, lambda *_: 0.0), many) == Sides(point, False, ())
        assert len(climbs) == 1 + TRIED


@pytest.mark.slow
def test_nodes_cross_together():
    """Of three on the wrong side those that fit better without the others go in one climb."""
    with jax.enable_x64(True):
        shifts = {f"b{k}.position_y": -2.0 * PLACES[k][1] for k in (0, 1, 2)}
        three = beside(0, 4.0, ("b0", "b1", "b2"), scale=10.0, **shifts)
        first = next(crossed_nodes(three, automatic_start(three))).name
    assert first.endswith("nodes elsewhere beside the paths that they hear")
    tree = probcal.fit(three, MAP(), prior=Gaussian())
    for label, shift in shifts.items():
        mean, sd = bias(tree, label)
        assert abs(mean - shift) < 4 * sd


@pytest.mark.ci
def test_where_nothing_tells_the_sides_apart_both_are_told():
    """A straight path, and a survey of 20 m: one bias is weak, the others stand, and the map shows the other place."""
    problem = beside(1, 0.0, scale=20.0)
    tree = probcal.fit(problem, MAP(), prior=Gaussian())
    assert "Another answer fits as well" in tree.attrs["message"]
    assert "on which side of the path such a node stands" in tree.attrs["message"]
    assert "Survey a position off" not in tree.attrs["message"]
    group = rivals(tree)
    assert group["kind"].values.tolist() == ["node"]
    there, here = float(group["bias"].sel(bias_label="b0.position_y")[0]), bias(tree, "b0.position_y")[0]
    assert here + there == pytest.approx(-20.0, abs=2.0)
    verdicts = probcal.assess(problem, tree)["verdict"].to_dataset()["verdict"].to_series()
    assert verdicts["b0.position_y"] == "weak"
    assert verdicts["b0.position_x"] == "determined"
    shown = scene(tree)
    assert not shown.mirrored
    np.testing.assert_allclose(shown.elsewhere[0, :, 1], [10 + here, 10 + there], atol=1e-9)
    assert "mirror" in layers(shown)
    assert "fits as well" in [text.get_text() for text in plot_map(tree).get_legend().get_texts()]
    assert interactive_map(tree).select({"tags": "mirror"})


@pytest.mark.slow
@pytest.mark.parametrize(
    "method", [probcal.Collapsed(draws=300), probcal.NUTS(warmup=200, draws=200)], ids=["collapsed", "nuts"]
)
@pytest.mark.parametrize("seed", [0, 2])
def test_chains_cross_with_a_node_alone(seed, method):
    """Shares of the draws on each side are those of the evidences, within 0.06."""
    problem = beside(seed, 0.3, scale=20.0)
    gain = rivals(probcal.fit(problem, MAP(trajectory="joint")))["gain"].item()
    tree = probcal.fit(problem, method, prior=Gaussian())
    sampled = tree["sample_stats"].to_dataset()
    assert sampled["crossed"].mean() > 0.2
    lighter = min((sampled["side"].values == k).mean() for k in (0, 1))
    assert abs(lighter - np.exp(gain) / (1 + np.exp(gain))) < 0.06
    assert "The posterior has 2 modes" in tree.attrs["message"]
    assert tree["calibration"]["r_hat"].max() < 1.05
    assert bias(tree, "b0.position_y")[1] > 4.0


@pytest.mark.slow
@pytest.mark.parametrize("bend", [0.0, 2.0])
def test_a_side_that_maximised_precisions_keep_in_is_left(bend):
    """It stood out by 70 sd, `converged`, though the stated place fits better or as well."""
    problem = beside(0, bend, tuple(f"b{k}" for k in range(7)))
    start = on_the_wrong_side(problem, "b0.position_y", -20.0)
    tree = probcal.fit(problem, EA(precisions="maximised"), prior=ARD(shape=4.0), start=start)
    assert abs(bias(tree, "b0.position_y")[0]) < 0.2
    assert tree.attrs["status"] == "converged"


def test_what_must_move_is_free_and_within_reach():
    problem = beside(0, 0.0)
    z, place, members = np.zeros(len(problem.labels)), np.array([0.0, 10.0]), [0, 1]
    level = Plane("", np.zeros(2), np.array([0.0, 1.0]))
    assert across(problem, z, place, members, level).tolist() == pytest.approx([0.0, -20 / 6])
    assert across(problem, z, place, [1], level).tolist() == pytest.approx([-20 / 6])
    assert across(problem, z, place, [0], level) is None  # y is not free
    assert across(problem, z, np.array([0.0, 19.0]), members, level) is None  # 38 m are more than six scales


def test_a_node_surveyed_on_its_side_costs_no_look():
    """Its scale is 1 m, the other side 20 m away."""
    problem = beside(0, 0.0, scale=1.0)
    with jax.enable_x64(True), patch("probcal.modes.crossings._linearised") as looked:
        assert not list(crossed_nodes(problem, automatic_start(problem)))
    assert not looked.called


def test_nodes_of_one_sensor_are_not_moved_together():
    """A ring of pairs, one node after the other, comes apart in two sets; an odd ring in three."""
    for count, sets in ((6, 2), (5, 3)):
        ring = [np.array([[k, (k + 1) % count] for k in range(count)])]
        parted = _parted(ring, list(range(count)))
        assert len(parted) == sets
        assert sorted(k for own in parted for k in own) == list(range(count))
        assert not any((k + 1) % count in own for own in parted for k in own)


@pytest.mark.ci
def test_a_node_crosses_beside_a_sensor_that_reads_no_bias():
    """Two beacons, one of them where it is stated, and positions by a third sensor: no bias is read from its rows."""
    known, loose = Node("known", (0.0, 0.0), 0.0), Node("b0", PLACES[0], scale=6.0)
    network = Network([position.on(known), ranger.on(loose), ranger.on(Node("b1", PLACES[1]))])
    time = np.arange(0, 60, 2.0)
    problem = drawn(network, time, np.stack([-10 + 2.3 * time, 2 * np.sin(time / 9)], 1), 0, {})
    with jax.enable_x64(True):
        found = list(crossed_nodes(problem, automatic_start(problem)))
    assert [one.name for one in found if "b0" in one.name]


def test_the_gain_of_a_group_is_that_of_its_gaussian():
    """Against two Gaussian densities of the estimates of three biases, with and without them."""
    rng = np.random.default_rng(0)
    root = rng.normal(size=(3, 3))
    noise, estimate, alpha = root @ root.T, 2 * rng.normal(size=3), 0.3
    covariance = np.linalg.inv(np.linalg.inv(noise) + alpha * np.eye(3))
    group = GroupEvidence.of(covariance, covariance @ np.linalg.solve(noise, estimate), alpha)
    there, out = (
        stats.multivariate_normal(cov=noise + spread * np.eye(3)).logpdf(estimate) for spread in (1 / alpha, 0.0)
    )
    assert float(group.gain(alpha)) == pytest.approx(there - out)
    assert group.share(alpha, there - out) == pytest.approx(1.0)
    assert group.share(alpha, there - out - 1.0) < 1.0


@pytest.mark.parametrize(("shape", "least"), [(1.0, 1.0), (4.0, (13 + 168**0.5))])
def test_a_bias_stays_from_the_square_that_its_prior_asks_for(shape, least):
    """Of mean over sd: 1 for the flat hyper-prior, 5.1^2 for shape 4, where the best precision ceases to exist."""
    for square, stays in ((0.98 * least, False), (1.02 * least, True)):
        group = GroupEvidence(np.ones(1), np.array([square]))
        assert group.stays(ARD(shape=shape), 1.0) is stays
    assert not GroupEvidence(np.ones(1), np.array([4 * least])).stays(ARD(shape=shape), 0.2)
    assert GroupEvidence(np.ones(1), np.array([1e3])).stays(ARD(shape=shape), 1.0)  # best at the lower bound


@pytest.mark.ci
@pytest.mark.parametrize("evidence", [np.nan, -np.inf])
def test_a_trial_that_ends_nowhere_takes_no_ones_place(evidence):
    """The climb without a group of biases has no evidence: the state stands."""
    problem = beside(0, 0.0, tuple(f"b{k}" for k in range(7)))
    start = on_the_wrong_side(problem, "b0.position_y", -20.0)
    ended = []

    def lost(model, prior, given, state, climb):
        def nowhere(point, alpha, mixing):
            ended.append(state)
            return state._replace(found=state.found._replace(evidence=jnp.asarray(evidence)))

        return without_far_modes(model, prior, given, state, nowhere)

    with patch("probcal.inference.ea.without_far_modes", lost):
        tree = probcal.fit(problem, EA(precisions="maximised"), prior=ARD(shape=4.0), start=start)
    assert ended
    assert np.isfinite(tree.attrs["log_evidence_type_ii"])
