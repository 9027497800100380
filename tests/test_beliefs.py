"""Separable likelihoods and belief propagation over poses: against naive formulas, exact graphs, bad starts."""

from functools import cache

import jax
import numpy as np
import pandas as pd
import pytest

import probcal as pc
from probcal.errors import InputError
from probcal.geometry import bearing, elevation, norm
from probcal.tracking.entry import asked, cloud_of
from probcal.tracking.poses.beliefs import Field, check_rivals
from probcal.tracking.poses.messages import Belief, Edge, Kernels, Normals
from probcal.tracking.poses.search import Peak, Potential, search
from probcal.tracking.poses.separable import first_slot, go_along, partners
from probcal.tracking.poses.vertices import Vertex, graph_of, vertices_of

TIME = np.arange(12.0)
START = {"position": ((0.0, 0.0), 100.0), "velocity": ((0.0, 0.0), 3.0)}
REPORT = pc.Detection(0.9, clutter=0.5, limits={"east": (-500.0, 500.0), "north": (-500.0, 500.0)})
SHIFT = (4.0, -3.0)


@pc.sensor(east=pc.Channel("m", std=1.0), north=pc.Channel("m", std=2.0))
def fix(target, pose):
    """A place relative to the sensor: linear, so that everything has a formula."""
    line = target.position - pose.position
    return dict(east=line[0], north=line[1])


def network(detection=REPORT):
    nodes = [pc.Node("a", (0.0, 0.0)), pc.Node("b", (50.0, 0.0), scale={"position": 5.0})]
    return pc.Network([fix.on(node, detection=detection) for node in nodes])


def motion():
    return pc.Target(pc.ConstantVelocity(0.3), START)


@cache
def drawn(seed=0, objects=2, last=12):
    """Detections of two sensors, the second displaced by SHIFT; drawn with NumPy alone."""
    rng = np.random.default_rng(seed)
    places = {"a": np.zeros(2), "b": np.array([50.0, 0.0]) + SHIFT}
    x, v = rng.normal(0, 100, (objects, 2)), rng.normal(0, 3, (objects, 2))
    rows = []
    for time in np.arange(float(last)):
        for name, place in places.items():
            told = [here - place + rng.normal(0, (1.0, 2.0)) for here in x if rng.uniform() < 0.9]
            told += list(rng.uniform(-500, 500, (rng.poisson(0.5), 2)))
            rows += [(time, name, *one) for one in told] or [(time, name, np.nan, np.nan)]
        a = rng.normal(0, 0.3, (2, objects, 2))
        x, v = x + v + 0.5 * a[0] + a[1] * np.sqrt(1 / 12), v + a[0]
    return pc.Problem(network(), motion(), pd.DataFrame(rows, columns=["time", "sensor", "east", "north"]))


@cache
def graph(terms):
    with jax.enable_x64(True):
        problem = drawn()
        found = asked("test", problem, None, None, objects=3.0, births=0.02, lifetime=600.0, most=8, sensors=())
        return graph_of(found.problem, found.chances, cloud_of(found.watch), 8, 3.0, terms)


POINTS = np.array([[0.0, 0.0], [0.8, -0.6], [0.5, -0.2], [2.0, 2.0]])


# stamps


def test_scans_have_the_latest_partner_that_matches_both_ways():
    """Stamps within two seconds, equal ones too, each way; one partner a scan."""
    one, other = np.array([0.0, 1.0, 2.0, 9.0]), np.array([0.5, 1.0, 1.8, 6.5])
    assert partners(one, other, 2.0, before=False).tolist() == [-1, 1, 2, -1], "9.0 has none within 2 s"
    assert partners(one, other, 2.0, before=True).tolist() == [-1, 0, 2, -1], "strictly before: 0.5, not 1.0"
    assert partners(one, other, 3.0, before=False).tolist() == [-1, 1, 2, -1], "6.5 itself has none of the first"
    assert partners(one, other, 5.0, before=False).tolist() == [-1, 1, 2, 3]
    same = np.arange(4.0)
    assert partners(same, same, 2.0, before=True).tolist() == [-1, 0, 1, 2]


# likelihoods


def log_normal(y, mean, covariance):
    off = y - mean
    return -0.5 * (off @ np.linalg.solve(covariance, off) + np.linalg.slogdet(2 * np.pi * covariance)[1])


def naive(each, shift):
    """The dual term of one direction in a loop; `shift` (2,) is added to what the other knows, seen by the one."""
    total = 0.0
    H = np.eye(2, 4)
    R = np.diag([1.0, 4.0])
    scans = each.scans
    for k in np.flatnonzero(np.asarray(each.used)):
        w, m, P = (np.asarray(leaf)[k] for leaf in each.mixture)
        seen = np.asarray(scans.epoch.rows[0].mask[k]).any(1)
        y = np.asarray(scans.epoch.rows[0].y[k])
        chance = float(scans.probability[k])
        total -= chance * w.sum()
        pose = np.asarray(scans.epoch.rows[0].pose[k, 0, 0])
        for d in np.flatnonzero(seen):
            found = [
                chance * w[j] * np.exp(log_normal(y[d], m[j][:2] + shift - pose, H @ P[j] @ H.T + R))
                for j in range(len(w))
            ]
            total += np.log1p(sum(found) / float(each.background[k, d]))
    return total


@pytest.mark.parametrize("terms", ["dual", pytest.param("quad", marks=pytest.mark.ci)])
def test_likelihoods_are_those_of_a_loop(terms):
    """A linear network: both directions, and of the quad term half of them and its normaliser."""
    found = graph(terms)
    with jax.enable_x64(True):
        potential = found.pair(0, 1, np.zeros(2), np.arange(2))
        values = potential.values(POINTS)
        shifts = 5.0 * POINTS  # of the second sensor
        power = 1.0 if terms == "dual" else 0.5
        for value, shift in zip(values, shifts, strict=True):
            # what the displaced sensor knows moves with it; seen by it, what the other knows moves the other way
            expected = power * sum(naive(t.each, s) for t, s in zip(potential.terms, (shift, -shift), strict=True))
            for each in potential.quad:
                expected -= normalised(each, shift)
            assert value == pytest.approx(expected, rel=1e-9)


def normalised(each, shift):
    """Log of the normaliser in a loop, by the shares of pairs that agree."""
    from probcal.tracking.bernoulli import associate

    H, R = np.concatenate([np.eye(2, 4)] * 2), np.diag([1.0, 4.0, 1.0, 4.0])
    total = 0.0
    for k in np.flatnonzero(np.asarray(each.used)):
        (wa, ma, Pa), (wb, mb, Pb) = ([np.asarray(leaf)[k] for leaf in m] for m in (each.mine, each.theirs))
        logs = np.zeros((len(wa), len(wb)))
        for a in range(len(wa)):
            for b in range(len(wb)):
                A, B = (H @ P @ H.T + R for P in (Pa[a], Pb[b]))
                delta = H @ (ma[a] - mb[b]) - np.tile(shift, 2)
                S = 0.5 * (A + B)
                dets = [np.linalg.slogdet(C)[1] for C in (S, A, B)]
                logs[a, b] = -0.125 * delta @ np.linalg.solve(S, delta) - 0.5 * (dets[0] - 0.5 * (dets[1] + dets[2]))
        share, _ = jax.jit(associate)(wa[:, None] * wb[None] * np.exp(logs) / 0.1)
        total += float(np.sum(np.asarray(share) * logs))
    assert total < 0, "two densities that differ overlap in part"
    return total


def test_slopes_are_those_of_differences():
    """The covariance of a prediction does not depend on the biases of a linear network: slopes are exact."""
    with jax.enable_x64(True):
        potential = graph("dual").pair(0, 1, np.zeros(2), np.arange(2))
        at, h = np.array([0.7, -0.5]), 1e-5
        _, slope, information = potential.expanded(at)
        steps = at + h * np.concatenate([np.eye(2), -np.eye(2)])
        value = potential.values(steps)
    np.testing.assert_allclose(slope, (value[:2] - value[2:]) / (2 * h), rtol=1e-5)
    assert np.linalg.eigvalsh(information).min() > 0


@pytest.mark.ci
def test_the_displaced_sensor_is_found():
    """From three sds away, both terms within four sds of the truth; the sd of the other method is no wider than 3 m."""
    found = pc.propagate_beliefs(drawn())
    assert found.rests
    sd = np.sqrt(np.diagonal(found.covariance))
    assert np.all(np.abs(found.z - np.array(SHIFT) / 5.0) < 4 * sd)
    assert 5.0 * sd.max() < 3.0
    assert found.sensors["by"].tolist() == ["", "a"]
    assert found.edges[["first", "second"]].values.tolist() == [["a", "b"]]
    assert not found.apart
    assert not found.rivals
    one = pc.separable_likelihood(drawn(), "a", "b", [found.z, [9.0, 9.0]])
    assert one[0] > 30.0 > 1.0 > one[1], "far away nothing is in common"


@pytest.mark.slow
def test_the_quad_term_is_no_less_accurate():
    """One object, hardly any clutter, 40 draws: paired squared errors, the quad term's mean lower (false alarm 1 %)."""
    off = []
    for seed in range(40):
        problem = drawn(100 + seed, 1, 30)
        found = [pc.propagate_beliefs(problem, terms=terms, iterations=2).z for terms in ("dual", "quad")]
        off.append([np.sum((5.0 * z - SHIFT) ** 2) for z in found])
    gain = np.subtract(*np.array(off).T)
    assert gain.mean() > -2.4 * gain.std() / np.sqrt(len(gain))
    assert np.sqrt(np.mean(np.array(off)[:, 1])) < 0.6


# frames


@pc.sensor(
    range=pc.Channel("m", std=1.0),
    azimuth=pc.Channel("rad", std=0.01, wrap=True),
    elevation=pc.Channel("rad", std=0.01),
)
def space_radar(target, pose):
    """Range, azimuth and elevation in the node's own axes."""
    line = pose.local(target.position)
    return dict(range=norm(line), azimuth=bearing(line), elevation=elevation(line))


@pytest.mark.ci
def test_what_a_sensor_knows_goes_along_with_it():
    """Wherever it stands in space and however it is turned, it measures the same of what it knows."""
    scale = {"position": 30.0, "heading": 1.0, "pitch": 0.3, "roll": 0.3}
    node = pc.Node("a", (5.0, -3.0, 2.0), heading=0.4, pitch=0.1, roll=-0.2, scale=scale)
    net = pc.Network([space_radar.on(node, detection=pc.Detection(0.9, view=pc.Sector(range=500.0),
                                     limits={"elevation": (-1.5, 1.5)}))])  # fmt: skip
    row = {"time": [0.0, 1.0], "sensor": "a", "range": 80.0, "azimuth": 0.3, "elevation": 0.2}
    start = {"position": ((0.0, 0.0, 0.0), 100.0), "velocity": ((0.0, 0.0, 0.0), 3.0)}
    problem = pc.Problem(net, pc.Target(pc.ConstantVelocity(0.3), start), pd.DataFrame(row))
    with jax.enable_x64(True):
        found = asked("test", problem, None, None, objects=3.0, births=0.02, lifetime=600.0, most=8, sensors=())
        scan = first_slot(jax.tree.map(lambda leaf: leaf[0], found.watch.scans))
        model = found.watch.model

        @jax.jit
        def both(x, z):
            moved = go_along(model, scan, x, z)
            (there,) = model.predict_at(scan.epoch, (moved[None],), z)
            (here,) = model.predict_at(scan.epoch, (x[None],), 0.0 * z)
            return here[0], there[0], moved

        rng = np.random.default_rng(0)
        for _ in range(5):
            x = np.r_[rng.normal(0, 60, 3), rng.normal(0, 3, 3)]
            here, there, moved = both(x, rng.standard_normal(6))
            np.testing.assert_allclose(there, here, atol=1e-9)
            assert np.linalg.norm(moved[3:]) == pytest.approx(np.linalg.norm(x[3:])), "speeds are turned"
            assert np.abs(moved - x).max() > 1.0


# messages, on potentials with a formula


class Quadratic:
    """The log of a Gaussian potential, as a `Potential` is asked for it."""

    def __init__(self, at, middle, information):
        self.at, self.middle, self.information = (
            np.asarray(at),
            np.asarray(middle, float),
            np.asarray(information, float),
        )

    def values(self, theta, width=0.0, missed=1.0):
        off = theta - self.middle
        return -0.5 * np.einsum("li,ij,lj->l", off, self.information, off)

    def expanded(self, theta):
        off = theta - self.middle
        return float(self.values(theta[None])[0]), -self.information @ off, self.information

    def few(self):
        return self

    def apart(self, theta, other):
        return theta - other


def chain(loop):
    """Four vertices of two biases, edges that know differences, and the same as one dense Gaussian."""
    rng = np.random.default_rng(1)
    vertices = [Vertex(str(v), (v,), np.array([2 * v, 2 * v + 1]), False) for v in range(4)]
    pairs = [(0, 1), (1, 2), (2, 3)] + ([(0, 3)] if loop else [])
    edges, H, h = [], np.eye(8), np.zeros(8)
    for u, v in pairs:
        at = np.r_[vertices[u].at, vertices[v].at]
        J = rng.standard_normal((3, 4))
        middle = rng.standard_normal(4)
        edges.append(Edge(u, v, Quadratic(at, middle, J.T @ J)))
        H[np.ix_(at, at)] += J.T @ J
        h[at] += J.T @ J @ middle
    return vertices, edges, np.linalg.inv(H), np.linalg.solve(H, h)


@pytest.mark.parametrize("loop", [False, True], ids=["tree", "loop"])
def test_gaussian_messages_end_at_the_exact_answer(loop):
    """On a tree means and covariances, on a loop the means (Weiss, Freeman 2001)."""
    vertices, edges, covariance, mean = chain(loop)
    passing, z = Normals(vertices, edges), np.zeros(8)
    beliefs = {v: Belief(np.zeros(2), np.eye(2)) for v in range(4)}
    for _ in range(200 if loop else 6):
        moved = passing.step(beliefs, z)
        beliefs = dict(passing.beliefs)
        z = np.concatenate([beliefs[v].mean for v in range(4)])
    assert moved < 1e-9
    np.testing.assert_allclose(z, mean, atol=1e-8)
    for v in range(4):
        own = covariance[2 * v : 2 * v + 2, 2 * v : 2 * v + 2]
        if not loop:
            np.testing.assert_allclose(beliefs[v].covariance, own, atol=1e-9)


def test_kernel_mixtures_end_near_the_exact_answer():
    """A tree: mean over the last rounds within a third of an sd, sds within a factor of 1.5 (fixed seed)."""
    vertices, edges, covariance, mean = chain(False)
    passing, z = Kernels(vertices, edges, np.random.default_rng(0)), np.zeros(8)
    beliefs = {v: Belief(np.zeros(2), np.eye(2)) for v in range(4)}
    means, sds = [], []
    for k in range(30):
        passing.step(beliefs, z)
        beliefs = dict(passing.beliefs)
        if k >= 10:
            means.append(np.concatenate([beliefs[v].mean for v in range(4)]))
            sds.append(np.concatenate([np.sqrt(np.diagonal(beliefs[v].covariance)) for v in range(4)]))
    sd = np.sqrt(np.diagonal(covariance))
    assert np.abs((np.mean(means, 0) - mean) / sd).max() < 0.34
    ratio = np.mean(sds, 0) / sd
    assert ratio.min() > 1 / 1.5
    assert ratio.max() < 1.5


class Peaks(Quadratic):
    """Two maxima of equal height, or of another."""

    def __init__(self, at, places, information, behind=0.0):
        super().__init__(at, places[0], information)
        self.places, self.behind = [np.asarray(p, float) for p in places], behind

    def _parts(self, theta, width):
        W = np.linalg.inv(np.linalg.inv(self.information) + width**2 * np.eye(len(self.at)))
        off = [theta - p for p in self.places]
        return np.stack(
            [50.0 - 0.5 * np.einsum("li,ij,lj->l", o, W, o) - b for o, b in zip(off, (0, self.behind), strict=True)]
        )

    def values(self, theta, width=0.0, missed=1.0):
        return np.logaddexp.reduce([np.zeros(len(theta)), *self._parts(theta, width)], 0)

    def expanded(self, theta):
        parts = self._parts(theta[None], 0.0)[:, 0]
        share = np.exp(parts - self.values(theta[None])[0])
        slope = sum(-s * self.information @ (theta - p) for s, p in zip(share, self.places, strict=True))
        return float(self.values(theta[None])[0]), slope, share.sum() * self.information


@pytest.mark.parametrize("behind", [0.0, 3.0])
def test_a_search_keeps_two_poses_that_explain_as_much(behind):
    information = np.diag([1e4, 4e4, 1e4])
    places = [(1.0, 0.5, -0.3), (-0.6, 1.0, 0.9)]
    with jax.enable_x64(True):
        modes = search(Peaks(np.arange(3), places, information, behind), np.random.default_rng(0))
    assert len(modes) == 2
    order = sorted(modes, key=lambda mode: mode.theta[0], reverse=True)
    for mode, place, height in zip(order, places, (50.0, 50.0 - behind), strict=True):
        np.testing.assert_allclose(mode.theta, place, atol=1e-3)
        whole = np.linalg.inv(np.linalg.inv(information) + np.eye(3))
        exact = height - 0.5 * np.array(place) @ whole @ place - 0.5 * np.linalg.slogdet(np.eye(3) + information)[1]
        assert mode.evidence == pytest.approx(exact, abs=1e-3)


def test_a_rival_that_another_edge_refutes_is_dropped():
    """One edge has two peaks; a second edge to another vertex agrees with both, or with one alone."""
    vertices = [Vertex("a", (0,), np.zeros(0, int), True), Vertex("b", (1,), np.arange(2), False)]
    peaks = Peaks(np.arange(2), [(1.0, 0.0), (-1.0, 0.0)], 1e4 * np.eye(2))
    for other, left in ((np.diag([0.0, 1e4]), 1), (1e4 * np.eye(2), 0)):
        found = Field(type("G", (), {"vertices": vertices}), np.array([1.0, 0.0]))
        found.rivals[1] = [Peak(np.array([-1.0, 0.0]), 1e-4 * np.eye(2), 0.0)]
        check_rivals(found, [Edge(0, 1, peaks), Edge(0, 1, Quadratic(np.arange(2), (1.0, 0.0), other))])
        assert len(found.rivals[1]) == left


def test_a_turn_is_no_other_pose():
    found = graph("dual")
    two_turns = Potential((), np.zeros(2), np.arange(2), np.array([np.inf, 4.0]))
    np.testing.assert_allclose(two_turns.apart(np.array([1.0, 3.9]), np.array([9.0, -0.2])), [-8.0, 0.1])
    assert np.isinf(found.pair(0, 1, np.zeros(2), np.arange(2)).period).all()


# the graph, and what is refused


def test_sensors_on_one_node_are_one_vertex():
    node = pc.Node("a", (0.0, 0.0), scale=5.0)
    net = pc.Network([
        fix.on(node, name="one", detection=REPORT), fix.on(node, name="two", detection=REPORT),
        fix.on(pc.Node("b", (9.0, 0.0)), name="three", detection=REPORT),
    ])  # fmt: skip
    table = {"time": [0.0, 0.0, 0.0], "sensor": ["one", "two", "three"], "east": 1.0, "north": 2.0}
    found = vertices_of(pc.Problem(net, motion(), pd.DataFrame(table)), ["one", "two", "three"])
    assert [(v.name, v.at.tolist(), v.known) for v in found] == [("one and two", [0, 1], False), ("three", [], True)]


@pytest.mark.parametrize(
    ("act", "said"),
    [
        (lambda p: pc.propagate_beliefs(p, messages="smoke"), "messages are gaussian or kernel, terms dual or quad"),
        (lambda p: pc.propagate_beliefs(p, iterations=0), "take 1 or more and a positive number"),
        (lambda p: pc.propagate_beliefs(p, window=0.0), "give seconds above 0, or None"),
        (lambda p: pc.separable_likelihood(p, "a", "c"), '"c" is no sensor with detections'),
        (lambda p: pc.separable_likelihood(p, "a", "b", terms="triple"), "terms are dual or quad"),
        (lambda p: pc.separable_likelihood(p, "a", "b", [0.0]), "separable_likelihood: z has shape (1, 1)"),
    ],
)
def test_what_is_wrong_is_said(act, said):
    with pytest.raises(InputError) as caught:
        act(drawn())
    assert said in str(caught.value)
