"""Road networks, motion on them and beside them, and map matching.

Chi-square tests have a false-alarm rate of 1e-4 each; with the fixed keys here they pass or fail for good.
"""

import json
from functools import cache

import jax
import networkx as nx
import numpy as np
import pandas as pd
import pytest
import shapely
import xarray as xr
from hypothesis import example, given
from hypothesis import strategies as st
from scipy import stats
from scipy.spatial import Delaunay

from probcal import ConstantVelocity, InputError, LocalFrame, RandomWalk, Unknown
from probcal.motion.base import Joint
from probcal.roads import LeavingRoad, Road, RoadNetwork, match_track, read_roads
from probcal.roads.extra import Extra
from probcal.roads.paths import path_table
from probcal.roads.place import draw_place, log_masses

ALARM = 1e-4  # false-alarm rate of a chi-square test
LEGENDRE = np.polynomial.legendre.leggauss(12)
THIRDS = 3  # parts of an edge in a histogram
T_SHAPE = {"west": [(0, 0), (60, 0)], "east": [(60, 0), (110, 0)], "north": [(60, 0), (60, 30), (75, 60)]}
FRAME = LocalFrame(48.0, 11.0)


def planar(seed, oneway=0.3, left_out=0.4):
    """A connected network of nine nodes, with dead ends and one-way edges, no two edges crossing; and turns on it."""
    rng = np.random.default_rng(seed)
    nodes = np.stack(np.meshgrid(range(3), range(3)), -1).reshape(-1, 2) * 50.0 + rng.uniform(-14, 14, (9, 2))
    pairs = sorted(
        {
            tuple(sorted((int(a), int(b))))
            for tri in Delaunay(nodes).simplices
            for a, b in zip(tri, np.roll(tri, 1), strict=True)
        }
    )
    graph = nx.Graph(pairs)
    for k in rng.permutation(len(pairs)):
        if rng.random() < left_out:
            graph.remove_edge(*pairs[k])
            if not nx.is_connected(graph):
                graph.add_edge(*pairs[k])
    lines = {}
    for a, b in graph.edges:
        a, b = (a, b) if rng.random() < 0.5 else (b, a)
        lines[f"{a}{b}"] = [nodes[a], nodes[a] + rng.uniform(0.3, 0.7) * (nodes[b] - nodes[a]), nodes[b]]
    network = RoadNetwork.from_lines(lines, oneway=[name for name in lines if rng.random() < oneway])
    turns = {}
    for e, f in rng.integers(len(lines), size=(12, 2)):
        shared = set(network.ends[e]) & set(network.ends[f][:1] if network.oneway[f] else network.ends[f])
        if e != f and shared:
            turns[network.names[e], network.names[f]] = float(rng.uniform(0.1, 2.0))
    return network, turns


def alongs(network):
    """Points of a quadrature (E, 3 * 12) along every edge, and their weights."""
    unit = np.concatenate([(k + (LEGENDRE[0] + 1) / 2) / THIRDS for k in range(THIRDS)])
    weight = np.tile(LEGENDRE[1] / 2 / THIRDS, THIRDS)
    return network.lengths[:, None] * unit, network.lengths[:, None] * weight


def cells(network, density, speeds):
    """Probability of each third of each edge and each sign of the speed (E, 3, 2), by quadrature of a density."""
    along, weight = alongs(network)
    edge = np.broadcast_to(np.arange(len(along))[:, None], along.shape)
    every = np.broadcast_arrays(edge[..., None], along[..., None], speeds)
    states = dict(zip(("edge", "along", "speed"), (part.reshape(-1) for part in every), strict=True))
    found = np.exp(np.asarray(density(states))).reshape(*along.shape, len(speeds)) * weight[..., None]
    step = speeds[1] - speeds[0]
    back = found[..., speeds < 0].sum(-1) * step
    mass = np.stack([back, found[..., speeds > 0].sum(-1) * step], -1)
    return mass.reshape(len(along), THIRDS, -1, 2).sum(2)


def agree(network, drawn, expected):
    """Draws of states against the probabilities of cells (E, 3, 2), by chi-square."""
    edge, along, speed = (np.asarray(drawn[name]) for name in ("edge", "along", "speed"))
    assert (along >= 0).all()
    assert (along <= network.lengths[edge]).all()
    third = np.minimum((along / network.lengths[edge] * THIRDS).astype(int), THIRDS - 1)
    counts = np.zeros(expected.shape)
    np.add.at(counts, (edge, third, (speed > 0).astype(int)), 1)
    mean = expected * len(edge)
    assert counts[mean < 1e-6].sum() == 0
    small = mean < 8
    counts, mean = (np.append(part[~small], part[small].sum()) for part in (counts, mean))
    keep = mean > 1
    assert stats.chisquare(counts[keep], mean[keep] * counts[keep].sum() / mean[keep].sum()).pvalue > ALARM


def midpoints(most, step):
    """Speeds between -most and most, none of them 0."""
    count = int(np.ceil(most / step))
    return (np.arange(-count, count) + 0.5) * step


@pytest.mark.ci
@given(seed=st.integers(0, 10**6), given_turns=st.booleans(), seconds=st.sampled_from([2.0, 7.0, 14.0]))
@example(seed=3, given_turns=True, seconds=14.0)
def test_steps_on_any_network_sum_to_one_and_agree_with_draws(seed, given_turns, seconds):
    """From a random state, over no junction or many, by either end, dead ends and one-way edges, turns given or not."""
    rng = np.random.default_rng(seed)
    network, turns = planar(seed)
    sd = 14.0 / seconds**1.5 * np.sqrt(3)
    road = Road(network, sd, (0.0, 1.0), turns=turns if given_turns else None, reach=230.0)
    e = int(rng.integers(len(network.names)))
    before = {"edge": e, "along": float(rng.uniform(0, network.lengths[e])), "speed": float(rng.uniform(-9, 9))}
    with jax.enable_x64(True):
        density = jax.jit(jax.vmap(lambda state: road.log_density(before, state, seconds, {})))
        noise = sd * np.sqrt(seconds)
        expected = cells(network, density, midpoints(9 + 8 * noise, noise / 2))
        assert expected.sum() == pytest.approx(1.0, abs=1e-6)
        keys = jax.random.split(jax.random.key(seed), 4000)
        agree(network, jax.jit(jax.vmap(lambda key: road.sample(key, before, seconds, {})))(keys), expected)


@pytest.mark.parametrize("position", [None, ((48.0, 45.0), 12.0), ((48.0, 62.0), 3.5)], ids=str)
def test_the_start_sums_to_one_and_agrees_with_draws(position):
    network, _ = planar(5)
    road = Road(network, 1.0, (1.0, 2.0), position=position)
    with jax.enable_x64(True):
        expected = cells(network, jax.jit(jax.vmap(road.log_initial)), midpoints(20.0, 0.25))
        assert expected.sum() == pytest.approx(1.0, abs=1e-5)
        agree(network, jax.jit(jax.vmap(road.initial))(jax.random.split(jax.random.key(0), 4000)), expected)
        outside = {"edge": 0, "along": float(network.lengths[0]) + 1e-3, "speed": 0.0}
        assert jax.jit(road.log_initial)(outside) == -np.inf
    assert network.oneway.any()
    assert not network.oneway.all()
    turned = expected.sum(1)[network.oneway]
    assert (turned[:, 0] < 0.7 * turned[:, 1]).all()  # forward but for the sd of the speed


def test_draws_on_one_piece_are_truncated_normal():
    """By Kolmogorov and Smirnov, false alarm 1e-4: beside either half, four sd and forty beyond an end."""
    network = RoadNetwork.from_lines({"a": [(0, 0), (100, 0)]})

    @jax.jit
    def draw(mean, std):
        masses = log_masses(network, mean, std)
        keys = jax.random.split(jax.random.key(0), 2000)
        return masses, jax.vmap(lambda key: draw_place(key, network, mean, std, masses)[1])(keys)

    for x, y, std in ((20.0, 3.0, 25.0), (85.0, 3.0, 25.0), (-8.0, 0.0, 2.0), (180.0, 0.0, 2.0), (-80.0, 0.0, 2.0)):
        with jax.enable_x64(True):
            masses, along = (np.asarray(part) for part in draw(np.array([x, y]), std))
        exact = stats.truncnorm(-x / std, (100 - x) / std, x, std)
        assert stats.kstest(along, exact.cdf).pvalue > ALARM
        sides = stats.norm.logsf(
            np.abs([x, 100 - x]) / std
        )  # the tails beyond both ends, or the nearer less the farther
        inside = (
            np.log1p(-np.exp(sides).sum())
            if 0 < x < 100
            else sides.max() + np.log1p(-np.exp(sides.min() - sides.max()))
        )
        assert masses == pytest.approx([inside + stats.norm(0, std).logpdf(y)], rel=1e-9)


def test_a_one_way_edge_is_never_entered_at_its_end():
    """Neither by draws nor by the density, though one already on it may go back."""
    network = RoadNetwork.from_lines(T_SHAPE | {"east": T_SHAPE["east"][::-1]}, oneway="east")
    road = Road(network, 2.0, (0.0, 1.0), reach=90.0)
    before = {"edge": 0, "along": 50.0, "speed": 3.0}
    with jax.enable_x64(True):
        draw = jax.jit(jax.vmap(lambda key, x: road.sample(key, x, 3.0, {}), (0, None)))
        density = jax.jit(lambda x, y: road.log_density(x, y, 3.0, {}))
        keys = jax.random.split(jax.random.key(0), 500)
        assert set(np.asarray(draw(keys, before)["edge"])) == {0, 2}
        assert density(before, {"edge": 1, "along": 49.0, "speed": -3.0}) == -np.inf
        assert 1 in np.asarray(draw(keys, {"edge": 1, "along": 20.0, "speed": -1.0})["edge"])
        assert density({"edge": 1, "along": 20.0, "speed": -1.0}, {"edge": 1, "along": 17.0, "speed": -1.0}) > -20
        assert density(before, {"edge": 0, "along": 60.1, "speed": 3.0}) == -np.inf  # beyond its end


def test_one_long_road_is_constant_velocity_in_one_dimension():
    """Density and moments against the Gaussian of full rank, at a level given by name and at the guess."""
    network = RoadNetwork.from_lines({"long": [(0, 0), (30_000, 40_000)]})
    road = Road(network, Unknown(0.7), (10.0, 1.0)).within(4.0)
    assert road.within(4.0) is road
    before = {"edge": 0, "along": 20_000.0, "speed": -8.0}
    rng = np.random.default_rng(0)
    along, speed = 20_000 - 32 + rng.normal(size=50) * 9, -8 + rng.normal(size=50) * 2
    with jax.enable_x64(True):
        for std, levels in ((0.7, {}), (1.1, {"speed_std": 1.1})):
            block = std**2 * np.array([[64 / 3, 8.0], [8.0, 4.0]])
            exact = stats.multivariate_normal([20_000 - 32, -8], block).logpdf(np.stack([along, speed], 1))
            state = {"edge": np.zeros(50, int), "along": along, "speed": speed}
            found = jax.jit(jax.vmap(lambda x, levels=levels: road.log_density(before, x, 4.0, levels)))(state)
            np.testing.assert_allclose(found, exact, rtol=1e-10)
        draw = jax.jit(jax.vmap(lambda key: road.sample(key, before, 4.0, {"speed_std": 1.1})))
        drawn = draw(jax.random.split(jax.random.key(1), 20_000))
    sample = np.stack([drawn["along"], drawn["speed"]])
    white = np.linalg.solve(np.linalg.cholesky(block), sample - np.array([[20_000 - 32.0], [-8.0]]))
    np.testing.assert_allclose(white.mean(1), 0, atol=4 / np.sqrt(20_000))  # 4 sd: false alarm 1e-4
    np.testing.assert_allclose(np.cov(white), np.eye(2), atol=4 * np.sqrt(2 / 20_000))


def test_paths_of_a_crossing_are_those_by_hand():
    """One T junction: a dead end reflects, two ways on count a half each, and turns weigh them."""
    network = RoadNetwork.from_lines(T_SHAPE)
    north = float(network.lengths[2])
    road = Road(network, 2.0, (0.0, 1.0), reach=70.0)

    def density(before, after, motion=road):
        keys = ("edge", "along", "speed")
        state = [dict(zip(keys, x, strict=True)) for x in (before, after)]
        return float(np.exp(kernels[motion](*state)))

    turned = Road(network, 2.0, (0.0, 1.0), reach=70.0, turns={("west", "east"): 3.0, ("west", "north"): 1.0})
    only = Road(network, 2.0, (0.0, 1.0), reach=40.0, turns={("west", "north"): 1.0})
    kernels = {own: jax.jit(lambda x, y, own=own: own.log_density(x, y, 3.0, {})) for own in (road, turned, only)}

    def normal(d, v, before):
        block = 4.0 * np.array([[9.0, 4.5], [4.5, 3.0]])
        return stats.multivariate_normal([3 * before, before], block).pdf([d, v])

    with jax.enable_x64(True):
        # to the east: over the node, and by way of the dead ends in the west, the east and the north
        west, east = (0, 50.0, 6.0), (1, 12.0, 5.0)
        paths = [(22, 5, 0.5), (10 + 100 - 12, -5, 0.5), (10 + 2 * north + 12, 5, 0.25), (-50 - 60 - 12, -5, 0.5)]
        expected = sum(p * normal(d, o, 6.0) for d, o, p in paths)
        assert density(west, east) == pytest.approx(expected, rel=1e-6)
        # the dead end in the west: there and back on the same edge
        home = (0, 4.0, -3.0)
        expected = normal(2.0, -3.0, -3.0) + normal(-10.0, 3.0, -3.0)
        assert density(home, (0, 6.0, -3.0)) == pytest.approx(expected, rel=1e-6)
        assert density(west, east, turned) / density(west, east) == pytest.approx(1.5, rel=1e-2)
        assert density(west, east, only) < 1e-3 * density(west, east)


def test_paths_of_equal_length_are_one():
    """Round a square block both ways lead to the edge opposite: one path of twice the probability on a grid."""
    square = {
        f"{k}": [(np.cos(a) * 50, np.sin(a) * 50), (np.cos(b) * 50, np.sin(b) * 50)]
        for k, (a, b) in enumerate(zip(np.arange(4) * np.pi / 2, np.arange(1, 5) * np.pi / 2, strict=True))
    }
    spokes = {"in": [(0, 0), (50, 0)], "up": [(0, 50), (0, 90)], "out": [(-50, 0), (-100, 0)]}
    network = RoadNetwork.from_lines(square | spokes)
    table = path_table(network, (), 200.0)
    e, out = network.number("in"), network.number("out")
    slot = list(table.edges[e]).index(out)
    side = 50 * np.sqrt(2)
    at = np.abs(table.shift[e, slot] - (50 + 2 * side)) < 1e-6
    assert at.sum() == 1
    # by the top a half, then at "up" a half, then at the last corner a half; by the bottom one way on at its corner
    assert np.exp(table.log_probability[e, slot][at]) == pytest.approx(0.5 * 0.5 * 0.5 + 0.5 * 1.0 * 0.5)


@pytest.mark.parametrize("d", [2, 3])
def test_position_tangent_and_gradient(d):
    lines = {name: np.array(line, float) for name, line in T_SHAPE.items()}
    if d == 3:
        lines = {name: np.column_stack([line, 0.1 * line.sum(1)]) for name, line in lines.items()}
    network = RoadNetwork.from_lines(lines)
    road = Road(network, 1.0, (5.0, 1.0), position=(np.append([60.0, 10.0], [6.5] * (d - 2)), 4.0), reach=50.0)
    along, _ = alongs(network)
    edge = np.repeat(np.arange(3), along.shape[1])
    state = {"edge": edge, "along": along.ravel(), "speed": np.linspace(-3, 3, edge.size)}
    with jax.enable_x64(True):
        view = jax.jit(jax.vmap(road.view))
        shown = jax.tree.map(np.asarray, view(state))

        @jax.jit
        @jax.vmap
        def slopes(e, a):
            return jax.jacfwd(lambda a: road.view({"edge": e, "along": a, "speed": 0.0})["position"])(a)

        slope = np.asarray(slopes(edge, along.ravel()))
        ends = view({**state, "along": network.lengths[edge]})["position"]
        for name, own in lines.items():
            e = network.names.index(name)
            np.testing.assert_allclose(ends[edge == e][0], own[-1], atol=1e-9)
        grads = jax.jit(jax.grad(lambda a: road.log_initial({"edge": 2, "along": a, "speed": 5.0})))(12.0)
    exact = [
        shapely.LineString(lines[network.names[e]]).interpolate(a) for e, a in zip(edge, along.ravel(), strict=True)
    ]
    if d == 2:
        np.testing.assert_allclose(shown["position"], shapely.get_coordinates(exact), atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(slope, axis=1), 1.0)
    np.testing.assert_allclose(shown["velocity"], state["speed"][:, None] * slope, atol=1e-12)
    tangent = slope[edge == 2][0]
    place = np.asarray(lines["north"][0]) + 12.0 * tangent
    assert float(grads) == pytest.approx(-tangent @ (place - road.position[0]) / 16, rel=1e-9)
    found, gone, away = network.nearest(np.asarray(shown["position"]))
    np.testing.assert_allclose(away, 0, atol=1e-9)
    np.testing.assert_array_equal(found, edge)
    np.testing.assert_allclose(gone, along.ravel(), atol=1e-9)
    beside = np.append([20.0, -7.0], [2.0] * (d - 2))
    assert network.nearest(beside)[2][0] == pytest.approx(7.0 if d == 2 else network.nearest(beside)[2][0])


def test_the_start_in_space_sums_to_one():
    """The integral over bent roads in 3-D, in closed form, against quadrature."""
    lines = {
        name: np.column_stack([np.array(line, float), 0.2 * np.arange(len(line)) * 30])
        for name, line in T_SHAPE.items()
    }
    lines = {name: np.vstack([[60.0, 0.0, 6.0], line[1:]]) if name != "west" else line for name, line in lines.items()}
    network = RoadNetwork.from_lines(lines)
    road = Road(network, 1.0, (1.0, 2.0), position=((52.0, 4.0, 7.0), 6.0))
    with jax.enable_x64(True):
        assert cells(network, jax.jit(jax.vmap(road.log_initial)), midpoints(20.0, 0.25)).sum() == pytest.approx(
            1, abs=1e-6
        )


def test_a_road_composes_and_estimates_on_the_road():
    road = Road(RoadNetwork.from_lines(T_SHAPE), 1.0, (5.0, 1.0), reach=50.0)
    assert isinstance(road + RandomWalk("power", "dB", 0.5, (4.0, 2.0)), Joint)
    assert road.levels == {"speed_std": 1.0}
    states = {"edge": np.array([0, 0, 1, 2]), "along": np.array([10.0, 50.0, 5.0, 6.0]), "speed": np.zeros(4)}
    with jax.enable_x64(True):
        estimate = jax.jit(road.estimate)
        best = estimate(states, np.array([0.1, 0.4, 0.5, 0.0]))  # mean (53.5, 0)
        assert (int(best["edge"]), float(best["along"])) == (0, 50.0)
        best = estimate(states, np.array([0.0, 0.45, 0.55, 0.0]))  # mean (58.25, 0), no weight on the nearest
        assert (int(best["edge"]), float(best["along"])) == (1, 5.0)


def test_the_reach_follows_the_longest_step_and_is_asked_for(monkeypatch):
    network = RoadNetwork.from_lines(T_SHAPE)
    road = Road(network, 0.5, (-10.0, 2.0))
    state = {"edge": 0, "along": 1.0, "speed": 1.0}
    with pytest.raises(InputError, match=r"Road: a density needs to know how far paths lead; give reach= in m, or"):
        road.log_density(state, state, 1.0, {})
    assert road.within(2.0).limit == pytest.approx(2 * (10 + 4 * (2 + 0.5 * np.sqrt(2))) + 6 * 0.5 * np.sqrt(8 / 3))
    assert road.within(2.0).within(8.0).limit > 4 * road.within(2.0).limit
    assert Road(network, 0.5, (0.0, 2.0), reach=33.0).within(8.0).limit == 33.0
    assert Road(network, 0.5, (0.0, 2.0), fastest=30.0).within(2.0).limit == pytest.approx(60 + 3 * np.sqrt(8 / 3))
    grid = {}
    rng = np.random.default_rng(0)
    nodes = np.stack(np.meshgrid(range(8), range(8), indexing="ij"), -1) * 10.0 + rng.uniform(-2, 2, (8, 8, 2))
    for i, j in np.ndindex(8, 8):
        grid |= {f"h{i}{j}": nodes[i : i + 2, j]} if i < 7 else {}
        grid |= {f"v{i}{j}": nodes[i, j : j + 2]} if j < 7 else {}
    monkeypatch.setattr("probcal.roads.paths.LARGEST", 500_000)
    far = Road(RoadNetwork.from_lines(grid), 0.5, (10.0, 1.0), reach=140.0)
    with pytest.raises(InputError, match=r'edge "\w+": \d+ paths lead on within 140 m, more than .* smaller fastest'):
        far.log_density(state, state, 1.0, {})


@cache
def leaving():
    network = RoadNetwork.from_lines(T_SHAPE)
    road = Road(network, 1.5, (4.0, 1.0), reach=80.0)
    off = {"position": ((50.0, 20.0), 8.0), "velocity": ((1.0, -2.0), 1.5)}
    return LeavingRoad(road, 2.0, leave=0.2, join=0.4, on_road=0.6, off_start=off)


NAMES = ("on", "edge", "along", "speed", "position", "velocity")
STATES = {
    "on": dict(zip(NAMES, (1, 0, 40.0, 5.0, np.array([40.0, 0.0]), np.array([5.0, 0.0])), strict=True)),
    "near": dict(zip(NAMES, (0, 0, 0.0, 0.0, np.array([55.0, 9.0]), np.array([2.0, -1.0])), strict=True)),
    "far": dict(zip(NAMES, (0, 0, 0.0, 0.0, np.array([9e3, 9e3]), np.array([2.0, -1.0])), strict=True)),
}


@cache
def leaving_kernels():
    motion = leaving()
    return (
        jax.jit(jax.vmap(lambda key, x: motion.sample(key, x, 2.0, {}), (0, None))),
        jax.jit(jax.vmap(lambda x, y: motion.log_density(x, y, 2.0, {}), (None, 0))),
        jax.jit(jax.grad(lambda x, y, dt: motion.log_density(x, y, dt, {}), argnums=(0, 1), allow_int=True)),
    )


def free(position, velocity):
    """States off the road."""
    n = len(position)
    zero = np.zeros(n)
    return {
        "on": np.zeros(n, int),
        "edge": np.zeros(n, int),
        "along": zero,
        "speed": zero,
        "position": position,
        "velocity": velocity,
    }


@pytest.mark.parametrize("name", STATES)
def test_leaving_roads_agrees_with_draws_and_sums_to_one(name):
    """Mass on the roads by quadrature, off them by importance draws of constant velocity, and the moments there."""
    motion, before, (sample, density, _) = leaving(), STATES[name], leaving_kernels()
    network = motion.road.network

    def on_road(states):
        n = len(states["edge"])
        return density(
            before, {"on": np.ones(n, int), "position": np.zeros((n, 2)), "velocity": np.zeros((n, 2)), **states}
        )

    with jax.enable_x64(True):
        expected = cells(network, on_road, midpoints(30.0, 0.25))
        drawn = jax.tree.map(np.asarray, sample(jax.random.split(jax.random.key(3), 10_000), before))
        mean = np.concatenate([before["position"] + 2 * before["velocity"], before["velocity"]])
        block = 4.0 * np.kron([[8 / 3, 2.0], [2.0, 2.0]], np.eye(2))
        points = stats.multivariate_normal(mean, block).rvs(500, random_state=0)
        off = np.asarray(density(before, free(points[:, :2], points[:, 2:])))
    ratio = np.exp(off - stats.multivariate_normal(mean, block).logpdf(points))
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-9)  # constant velocity times the probability of being off
    assert expected.sum() + ratio[0] == pytest.approx(1.0, abs=1e-5)
    known = {"on": np.exp(-0.4), "far": 0.0}
    assert expected.sum() == pytest.approx(known.get(name, expected.sum()), abs=1e-5)
    on = drawn["on"] == 1
    assert stats.binomtest(int(on.sum()), len(on), min(float(expected.sum()), 1.0)).pvalue > ALARM
    if on.any():
        assert 0.05 < expected.sum() < 0.95
        agree(network, {k: v[on] for k, v in drawn.items()}, expected / expected.sum())
    assert (drawn["along"][~on] == 0).all()
    shown = np.concatenate([drawn["position"], drawn["velocity"]], 1)[~on]
    white = np.linalg.solve(np.linalg.cholesky(block), (shown - mean).T)
    np.testing.assert_allclose(white.mean(1), 0, atol=5 / np.sqrt(len(shown)))
    np.testing.assert_allclose(np.cov(white), np.eye(4), atol=5 * np.sqrt(2 / len(shown)))


def test_the_probability_of_joining_is_that_of_a_road_underfoot():
    """On a long straight road Z s sqrt(2 pi) is 1, beside it exp(-h^2 / (2 s^2))."""
    network = RoadNetwork.from_lines({"long": [(-5e3, 0), (5e3, 0)]})
    motion = LeavingRoad(Road(network, 1.0, (1.0, 1.0), reach=50.0), 2.0, leave=0.1, join=0.3)
    s = 2.0 * 2.0**1.5 / np.sqrt(3)
    with jax.enable_x64(True):
        density = jax.jit(lambda x: motion.log_density(x, x, 2.0, {}))
        for h in (0.0, 3.0):
            x = {**STATES["near"], "position": np.array([7.0, h]), "velocity": np.zeros(2)}
            away = float(density(x))
            cv = stats.multivariate_normal(np.zeros(2), 4.0 * np.array([[8 / 3, 2.0], [2.0, 2.0]])).logpdf
            join = (1 - np.exp(-0.6)) * np.exp(-(h**2) / (2 * s**2))
            assert away == pytest.approx(np.log1p(-join) + 2 * cv([0.0, 0.0]), rel=1e-9)
        lines = {f"{k}": [(0, 0), end] for k, end in enumerate([(5e3, 0), (-5e3, 0), (0, 5e3), (0, -5e3)])}
        cross = Road(RoadNetwork.from_lines(lines), 1.0, (1.0, 1.0), reach=50.0)
        for join in (0.3, 50.0):  # where roads cross there is twice as much road: no more than all, and never all
            motion = LeavingRoad(cross, 2.0, leave=0.1, join=join)
            x = {**STATES["near"], "position": np.zeros(2), "velocity": np.zeros(2)}
            away = float(jax.jit(lambda x, motion=motion: motion.log_density(x, x, 2.0, {}))(x))
            assert away == pytest.approx(max(-2 * join, np.log(1e-12)) + 2 * cv([0.0, 0.0]), rel=1e-4)


def test_leaving_roads_starts_on_or_off_and_has_finite_gradients():
    motion, (_, density, slopes) = leaving(), leaving_kernels()
    with jax.enable_x64(True):
        drawn = jax.tree.map(np.asarray, jax.jit(jax.vmap(motion.initial))(jax.random.split(jax.random.key(0), 2000)))
        begin = np.asarray(jax.jit(jax.vmap(motion.log_initial))(drawn))
        shown = jax.tree.map(np.asarray, jax.jit(jax.vmap(motion.view))(drawn))
        on = drawn["on"] == 1
        assert stats.binomtest(int(on.sum()), 2000, 0.6).pvalue > ALARM
        off = stats.norm((50.0, 20.0), 8.0).logpdf(drawn["position"]).sum(1)
        off += stats.norm((1.0, -2.0), 1.5).logpdf(drawn["velocity"]).sum(1)
        np.testing.assert_allclose(begin[~on], off[~on] + np.log(0.4), rtol=1e-9)
        own = jax.jit(motion.road.log_initial)({k: drawn[k][on][0] for k in ("edge", "along", "speed")})
        assert begin[on][0] == pytest.approx(float(own) + np.log(0.6))
        np.testing.assert_allclose(drawn["position"], shown["position"])
        np.testing.assert_allclose(drawn["velocity"], shown["velocity"])
        afters = [*STATES.values(), {**STATES["on"], "along": -1.0}, {**STATES["on"], "edge": 2, "along": 60.0}]
        for before in STATES.values():
            for after in afters:
                for dt in (2.0, 0.0):
                    grads = slopes(before, after, dt)
                    leaves = [g for tree in grads for g in tree.values() if g.dtype != jax.dtypes.float0]
                    assert all(np.isfinite(g).all() for g in leaves)
        together = jax.tree.map(lambda *x: np.stack([np.asarray(p) for p in x]), *afters)
        assert not np.isnan(density(STATES["near"], together)).any()
    assert motion.levels == {"speed_std": 1.5, "velocity_std": 2.0}
    assert motion.within(3.0).road.longest == 3.0


BOW = {"a": [(0, 0), (100, 0)], "b": [(100, 0), (100, 50)]}
BAD = [
    ({"a": [(0, 0), (10, 0)], "b": [(50, 0), (60, 0)], "c": [(10, 0), (20, 0)]}, {},
     r'the roads are in 2 parts, "b" apart from the others; join them .* or give connected=False'),
    (BOW | {"c": [(100, 0), (100, 0)]}, {}, 'edge "c" has no length; leave it out'),
    (BOW | {"c": [(100, 0), (120, 9), (120, -9), (100, 0)]}, {}, 'edge "c" ends where it starts; split the loop'),
    (BOW | {"c": [(100, 50), (100, 0)]}, {}, 'edge "c" is edge "b" once more; leave one of them out'),
    (BOW | {"c": [(100, 50), (100, 80), (120, 80), (90, 60)]}, {}, 'edge "c" crosses itself; split it where it does'),
    (BOW | {"c": [(100, 50), (60, -30)]}, {}, r'edges "a" and "c" cross at \(75.0, 0.0\) without a node; split both'),
    (BOW | {"c": [(100, 50), (40, 0)]}, {}, r'edge "c" ends on edge "a" at \(40.0, 0.0\), away from its ends;'),
    (BOW | {"c": [(100, 50), (40, 0.005)]}, {}, 'edge "c" ends on edge "a" at'),
    ({"a": [(11.0, 48.0), (11.01, 48.01)]}, {}, 'edge "a" and all others lie within 0.01 m, which looks like lon'),
    ({"a": [(0, 0), (np.nan, 5)]}, {}, 'edge "a" has a point that is not finite'),
    ({"a": [(0, 0), (1,)]}, {}, r'edge "a": its points must be numbers of shape \(k, 2\) or \(k, 3\) in m'),
    ({"a": [(0, 0), (9, 9)], "b": [(9, 9, 9), (20, 9, 9)]}, {}, 'edge "b" is 3-D and edge "a" 2-D; give all points'),
    ({}, {}, "a road network needs at least one edge"),
    (BOW, {"oneway": ["mian"]}, 'oneway: no edge is called "mian"; known: a, b'),
    (BOW, {"bridges": ["c"]}, 'bridges: no edge is called "c"'),
    (BOW, {"snap": 0.0}, r"snap is 0.0; give the distance in m within which two ends are one node"),
]  # fmt: skip


@pytest.mark.parametrize(("lines", "options", "text"), BAD, ids=[text[:40] for *_, text in BAD])
def test_bad_roads_are_refused(lines, options, text):
    with pytest.raises(InputError, match=text):
        RoadNetwork.from_lines(lines, **options)


def test_what_is_no_bad_road_is_taken():
    """Parallel edges, bridges by name and by height, parts where they are allowed, ends that nearly coincide."""
    bent = BOW | {"c": [(0, 0), (50, 20), (100, 0)], "d": [(100.004, 0.003), (150, 0)]}
    network = RoadNetwork.from_lines(bent)
    assert len(network.nodes) == 4
    assert list(RoadNetwork.from_lines(bent, oneway="d").oneway) == [False, False, False, True]
    np.testing.assert_array_equal(network.lines[3][0], network.lines[0][-1])
    crossing = BOW | {"c": [(100, 50), (60, -30)]}
    assert RoadNetwork.from_lines(crossing, bridges="c").bridges == {"c"}
    high = {name: [(x, y, 6.0 * (y > 40 or y < -20)) for x, y in line] for name, line in crossing.items()}
    with pytest.raises(InputError, match=r'edges "a" and "c" cross at'):
        RoadNetwork.from_lines(high | {"c": [(100, 50, 6.0), (75, 0, 0.5), (60, -30, 6.0)]})
    assert RoadNetwork.from_lines(high).dimension == 3
    apart = {"a": [(0, 0), (10, 0)], "b": [(50, 0), (60, 0)]}
    assert len(RoadNetwork.from_lines(apart, connected=False).nodes) == 4
    assert RoadNetwork.from_lines(BOW) != RoadNetwork.from_lines(BOW)  # by identity, so that it can be hashed
    assert hash(network) == hash(network)


ROAD = [
    ({"turns": {("a", "z"): 1.0}}, 'turns: no edge is called "z"'),
    ({"turns": {("c", "b"): 1.0}}, 'turns: no turn leads from edge "c" into edge "b"; leave it out'),
    ({"turns": {("b", "a"): 1.0}}, 'turns: no turn leads from edge "b" into edge "a"'),
    ({"turns": {("a", "b"): -1.0}}, r"turns: the weight of \('a', 'b'\) is -1.0; it must be 0 or a positive number"),
    ({"turns": {("a", "b"): 0.0}}, 'turns: the weights from edge "a" at one end are all 0; give one way on a positive'),
    ({"turns": {"ab": 1.0}}, "turns: 'ab' is no turn; write"),
    (
        {"position": ((50.0, 30.0), 4.0)},
        'Road: position is 30.0 m from the nearest road, edge "a", 7.5 of its sd; move it',
    ),
    ({"position": ((50.0, 30.0, 1.0), 4.0)}, "Road: position has mean .*; give 2 values in m"),
    ({"speed": (1.0, 0.0)}, r"Road: speed is \(1.0, 0.0\): give \(mean, std\)"),
    ({"std": -1.0}, "Road: std is -1: it must be positive"),
    ({"reach": -2.0}, "Road: reach is -2.0; give a positive number, or leave it out"),
    ({"network": 3}, "Road: network is int; give a RoadNetwork"),
]


@pytest.mark.parametrize(("options", "text"), ROAD, ids=[text[:40] for _, text in ROAD])
def test_a_road_that_cannot_be_says_so(options, text):
    network = RoadNetwork.from_lines(BOW | {"c": [(0, 0), (-10, 0)]}, oneway=["a"])
    with pytest.raises(InputError, match=text):
        Road(**{"network": network, "std": 1.0, "speed": (1.0, 1.0), **options})


LEAVING = [
    ({"leave": 0.0}, "LeavingRoad: leave is 0.0; give a positive rate per second"),
    ({"on_road": 0.5}, 'LeavingRoad: off_start states no "position"; give'),
    ({"on_road": 1.5}, "LeavingRoad: on_road is 1.5; give a probability"),
    ({"road": ConstantVelocity(1.0)}, r"LeavingRoad: road is ConstantVelocity; give a Road\("),
]


@pytest.mark.parametrize(("options", "text"), LEAVING, ids=[text[:40] for _, text in LEAVING])
def test_leaving_roads_that_cannot_be_says_so(options, text):
    with pytest.raises(InputError, match=text):
        LeavingRoad(**{"road": leaving().road, "std": 1.0, "leave": 0.1, "join": 0.1, **options})


def geojson(lines, properties=None, **more):
    """GeoJSON text of lines by name."""
    own = properties or {}
    features = [
        {"type": "Feature", "properties": {"name": name, **own.get(name, {})},
         "geometry": {"type": "LineString", "coordinates": np.asarray(line, float).tolist()}}
        for name, line in lines.items()
    ]  # fmt: skip
    return json.dumps({"type": "FeatureCollection", "features": features, **more})


def degrees(lines):
    """Lines in metres of FRAME as longitude and latitude."""
    return {name: np.stack(FRAME.to_geodetic(line)[1::-1], 1) for name, line in lines.items()}


def same(found, expected, atol=1e-5):
    """Networks of the same edges by name, both senses of a two-way edge alike."""
    assert sorted(found.names) == sorted(expected.names)
    for name in expected.names:
        e, f = found.number(name), expected.number(name)
        assert found.oneway[e] == expected.oneway[f]
        line = found.lines[e]
        if not found.oneway[e] and not np.allclose(line[0], expected.lines[f][0], atol=atol):
            line = line[::-1]
        np.testing.assert_allclose(line, expected.lines[f], atol=atol)


def test_geojson_in_degrees_projected_and_in_metres(tmp_path):
    expected = RoadNetwork.from_lines(T_SHAPE, oneway=["north"])
    own = {"north": {"oneway": "yes"}, "west": {"oneway": False}}
    path = tmp_path / "roads.geojson"
    path.write_text(geojson(degrees(T_SHAPE), own))
    same(read_roads(path, frame=FRAME), expected)
    with pytest.raises(InputError, match=r"roads.geojson: the roads are in longitude and latitude .*; give frame="):
        read_roads(path)
    back = {**T_SHAPE, "north": T_SHAPE["north"][::-1]}
    path.write_text(geojson(back, {"north": {"oneway": "-1"}}))
    same(read_roads(path, crs="local"), expected)
    shifted = {name: np.add(line, (6.9e5, 5.3e6)) for name, line in T_SHAPE.items()}
    member = {"crs": {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::25832"}}}
    path.write_text(geojson(shifted, **member))
    metres = read_roads(path)
    same(metres, RoadNetwork.from_lines(shifted), 1e-6)
    path.write_text(geojson(shifted))
    same(read_roads(path, crs="EPSG:25832"), metres, 1e-6)
    framed = read_roads(path, crs="EPSG:25832", frame=LocalFrame(47.8, 11.5))
    np.testing.assert_allclose(framed.lengths, metres.lengths, rtol=1e-3)  # the scale of UTM
    assert np.abs(framed.nodes).max() < 1e5


def test_geojson_of_many_kinds(tmp_path):
    """Several lines of one feature, names that come again, heights, bridges; points are skipped."""
    content = json.loads(
        geojson({"x": [(0, 0), (60, 0)], "over": [(0, 0), (30, 40), (30, -40)]}, {"over": {"bridge": "yes"}})
    )
    many = {"type": "MultiLineString", "coordinates": [[(60, 0), (110, 0)], [(60, 0), (60, 50)]]}
    content["features"] += [
        {"type": "Feature", "properties": {"name": "x"}, "geometry": many},
        {"type": "Feature", "properties": {}, "geometry": {"type": "Point", "coordinates": [5, 5]}},
        {
            "type": "Feature",
            "properties": None,
            "geometry": {"type": "LineString", "coordinates": [(110, 0), (150, 0)]},
        },
    ]
    path = tmp_path / "roads.json"
    path.write_text(json.dumps(content))
    network = read_roads(path, crs="local")
    assert network.names == ("x", "over", "x#2", "x#3", "4")
    assert network.bridges == {"over"}
    path.write_text(geojson({"a": [(0, 0, 1), (60, 0, 2)]}))
    assert read_roads(path, crs="local").dimension == 3
    assert read_roads(path, crs="local", dimension=2).dimension == 2


FILES = [
    ("none.geojson", None, "none.geojson: no such file"),
    ("roads.shp", "", "roads.shp: roads are read from .geojson, .json or .graphml"),
    ("roads.json", " ", "roads.json: the file is empty"),
    ("roads.graphml", "", "roads.graphml: the file is empty"),
    ("roads.json", "{", "roads.json: the file is no JSON"),
    ("roads.graphml", "<graph", "roads.graphml: the file is no GraphML"),
    ("roads.json", "[" * 100_000, "roads.json: the file is no JSON: its lists are nested too deeply"),
    ("roads.json", "1" * 6000, "roads.json: the file is no JSON: Exceeds the limit"),
    ("roads.json", geojson(BOW).replace("0.0", "1" * 400), 'roads.json: edge "a": its points must be numbers'),
    (
        "roads.json",
        geojson({"a": [(0, 0), (1e200, 0)]}),
        'roads.json: edge "a" has a point that is not finite or beyond',
    ),
    (
        "roads.json",
        json.dumps({"type": "Feature", "geometry": {"type": "MultiLineString", "coordinates": 5}}),
        'roads.json: edge "0": its points must be numbers',
    ),
    ("roads.graphml", '<?xml version="1.0" encoding="no such"?><graphml/>', "roads.graphml: the file is no GraphML"),
    ("roads.json", "[1]", "roads.json: the file is no GeoJSON object"),
    ("roads.json", geojson({}), "roads.json: the file has no LineString or MultiLineString feature"),
    ("roads.json", geojson({"a": [(0, 0)]}), 'roads.json: edge "a" has no length'),
    ("roads.json", geojson(BOW, {"b": {"oneway": "perhaps"}}), "edge \"b\": oneway is 'perhaps'; write yes, no or -1"),
    ("roads.json", geojson({"a": [(0, 0, 0), (9, 9, 9)]} | {"b": [(9, 9), (20, 9)]}), "some points have no height"),
]


@pytest.mark.parametrize(("name", "text", "said"), FILES, ids=[said[:40] for *_, said in FILES])
def test_bad_files_are_named(name, text, said, tmp_path):
    if text is not None:
        (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=said):
        read_roads(tmp_path / name, crs="local", dimension=3 if "height" in said else None)
    with pytest.raises(InputError, match='crs "EPSG:1" is not known; give one as "EPSG:25832", or "local" for metres'):
        RoadNetwork.from_graph(osm(), crs="EPSG:1")


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "latin-1"])
def test_the_encoding_of_a_file_is_its_own(encoding, tmp_path):
    """A byte order mark, as Windows writes it; GraphML says its encoding."""
    graph = nx.Graph(start="Süd")
    graph.add_edge("a", "b")
    nx.set_node_attributes(graph, {"a": 0.0, "b": 60.0}, "x")
    nx.set_node_attributes(graph, 0.0, "y")
    nx.write_graphml(graph, path := tmp_path / "roads.graphml")
    text = path.read_text("utf-8").replace("encoding='utf-8'", f"encoding='{encoding.removesuffix('-sig')}'")
    path.write_bytes(text.encode(encoding))
    assert read_roads(path).lengths.tolist() == [60.0]
    if encoding == "utf-8-sig":
        (tmp_path / "roads.json").write_bytes(geojson({"a": [(0, 0), (60, 0)]}).encode(encoding))
        assert read_roads(tmp_path / "roads.json", crs="local").lengths.tolist() == [60.0]


def osm():
    """A MultiDiGraph as osmnx makes them: degrees, lists and geometries of some edges, two directions of most."""
    lines = degrees(T_SHAPE)
    graph = nx.MultiDiGraph(crs="epsg:4326")
    for node, (x, y) in {
        10: lines["west"][0],
        11: lines["west"][1],
        12: lines["east"][1],
        13: lines["north"][2],
    }.items():
        graph.add_node(node, x=x, y=y)
    bend = shapely.LineString(lines["north"])
    graph.add_edge(10, 11, osmid=1, name="west", oneway=False, reversed=False)
    graph.add_edge(11, 10, osmid=1, name="west", oneway=False, reversed=True)
    graph.add_edge(12, 11, osmid=[2, 7], name=["east", "B 11"], oneway=False, reversed=True)
    graph.add_edge(11, 12, osmid=[2, 7], name=["east", "B 11"], oneway=False, reversed=False)
    graph.add_edge(11, 13, osmid=3, name="north", oneway=True, reversed=False, geometry=bend)
    return graph


def test_graphs_as_osmnx_makes_them_and_back(tmp_path):
    """Two directions of an edge are one; through GraphML, whose values are text, and through to_graph, the same."""
    expected = RoadNetwork.from_lines(T_SHAPE, oneway=["north"])
    network = RoadNetwork.from_graph(osm(), frame=FRAME)
    same(network, expected)
    with pytest.raises(InputError, match=r"the roads are in longitude and latitude \(WGS 84\); give frame="):
        RoadNetwork.from_graph(osm())
    graph = network.to_graph()
    assert isinstance(graph, nx.MultiGraph)
    same(RoadNetwork.from_graph(graph), expected)
    text = osm()
    for *_, data in [*text.nodes(data=True), *text.edges(data=True)]:
        data.update(
            {key: str(value) for key, value in data.items() if key != "name"},
            **{"name": data["name"] if isinstance(data.get("name"), str) else "east"} if "name" in data else {},
        )
    nx.write_graphml(text, tmp_path / "roads.graphml")
    same(read_roads(tmp_path / "roads.graphml", frame=FRAME), expected)
    high = nx.Graph([("a", "b")])
    nx.set_node_attributes(high, {"a": (0.0, 0.0, 1.0), "b": (30.0, 40.0, 1.0)}, "pos")
    assert RoadNetwork.from_graph(high).lengths == pytest.approx([50.0])
    lone = nx.DiGraph([("a", "b")])
    nx.set_node_attributes(lone, {"a": (0.0, 0.0), "b": (30.0, 40.0)}, "pos")
    assert RoadNetwork.from_graph(lone).oneway.all()
    lone.edges["a", "b"]["geometry"] = [(30, 40), (20, 10), (0, 0)]  # from its end to its start
    np.testing.assert_array_equal(RoadNetwork.from_graph(lone).lines[0], [(0, 0), (20, 10), (30, 40)])
    del lone.edges["a", "b"]["geometry"]
    lone.add_edge("b", "a")
    assert RoadNetwork.from_graph(lone).oneway.tolist() == [False]


def graph_of(change):
    graph = osm()
    change(graph)
    return graph


GRAPHS = [
    (lambda: 3, "from_graph takes a networkx graph, not int"),
    (lambda: nx.Graph(), "the graph has no edges"),
    (lambda: nx.Graph([("a", "b")]), 'node "a" of the graph has no place; give it the attributes x and y, or pos'),
    (lambda: graph_of(lambda g: g.edges[11, 13, 0].update(geometry="LINE")), 'edge "north": its geometry is no WKT'),
    (lambda: graph_of(lambda g: g.edges[11, 13, 0].update(geometry=[(11.0, 48.0), (11.0, 48.0002)])),
     r'edge "north": its geometry ends \d+.\d m from its node; check them'),
    (lambda: graph_of(lambda g: g.add_edge(13, 13, name="loop")), 'edge "loop" has no length'),
]  # fmt: skip


@pytest.mark.parametrize(("graph", "text"), GRAPHS, ids=[text[:40] for _, text in GRAPHS])
def test_bad_graphs_are_refused(graph, text):
    with pytest.raises(InputError, match=text):
        RoadNetwork.from_graph(graph(), frame=FRAME)


def test_a_missing_package_is_asked_for():
    with pytest.raises(InputError, match=r'road networks need networkx and shapely: pip install "probcal\[roads\]"'):
        _ = Extra("no_such_package").Graph


def drive(seed=0, std=4.0):
    """A noisy drive along the south of two parallel roads 12 m apart, and then up to the north of a side road."""
    lines = {
        "south": [(0, 0), (400, 0)],
        "north": [(0, 12), (400, 12)],
        "link": [(0, 0), (0, 12)],
        "side": [(400, 0), (500, -90)],
    }
    lines["island"] = [(200, 200), (300, 200)]
    network = RoadNetwork.from_lines(lines, oneway=["side"], connected=False)
    true = np.concatenate(
        [np.stack([np.arange(10, 400, 15.0), np.zeros(26)], 1), [(400 + 10 * k, -9 * k) for k in range(1, 9)]]
    )
    noisy = true + np.random.default_rng(seed).normal(0, std, true.shape)
    noisy[10:13, 1] += 9.0  # nearer to the wrong road
    frame = pd.DataFrame({"time": np.arange(len(true)) * 1.0, "target": "car"})
    return network, true, frame.assign(position_x=noisy[:, 0], position_y=noisy[:, 1])


def test_a_noisy_drive_is_matched_to_its_road():
    """Not to the parallel road that is nearer for a while; the rows of another target, far from all, say so."""
    network, true, frame = drive()
    nearer = network.nearest(frame[["position_x", "position_y"]].to_numpy())[0]
    assert (nearer[10:13] == network.number("north")).all()
    lost = pd.DataFrame({"time": [0.0, 1.0], "target": "plane", "position_x": [0.0, 9.0], "position_y": [4e3, 4e3]})
    jump = frame.iloc[:6].assign(target="ghost")
    jump.loc[3, ["position_x", "position_y"]] = 250.0, 210.0  # at a road that no other meets
    found = match_track(
        pd.concat([frame, lost, jump]).sample(frac=1, random_state=0), network, std=5.0, radius=25.0, detour=50.0
    )
    own = found[found["target"] == "car"]
    assert (own["edge"] == ["south"] * 26 + ["side"] * 8).all()
    assert (own["status"] == "matched").all()
    assert own["time"].is_monotonic_increasing
    error = np.linalg.norm(own[["position_x", "position_y"]].to_numpy() - true, axis=1)
    assert error.max() < 15
    away = np.linalg.norm(
        own[["position_x", "position_y"]].to_numpy() - frame[["position_x", "position_y"]].to_numpy(), axis=1
    )
    np.testing.assert_allclose(own["distance"], away)
    plane, ghost = (found[found["target"] == name] for name in ("plane", "ghost"))
    assert plane["edge"].isna().all()
    assert (plane["status"] == "far from roads").all()
    assert plane["along"].isna().all()
    assert list(ghost["status"]) == ["matched"] * 3 + ["unreachable", "matched after a gap", "matched"]
    assert list(found.columns) == ["time", "target", "edge", "along", "position_x", "position_y", "distance", "status"]


def test_matching_drives_as_the_roads_allow():
    """Back along a two-way road and round by another; never back along a one-way road."""
    network, *_ = drive()
    north = [(x, 12.0) for x in range(140, 0, -20)]
    places = {"bus": north + [(x, 0.0) for x in range(20, 160, 20)], "wrong": [(490, -81), (460, -54), (430, -27)]}
    rows = [(float(k), name, *place) for name, own in places.items() for k, place in enumerate(own)]
    frame = pd.DataFrame(rows, columns=["time", "target", "position_x", "position_y"])
    found = match_track(frame, network, std=5.0)
    assert list(found["edge"][:14]) == ["north"] * 7 + ["south"] * 7
    np.testing.assert_allclose(found["distance"][:14], 0, atol=1e-9)
    assert list(found["status"][14:]) == ["unreachable"] * 3


def test_a_track_is_taken_from_a_tree_and_checked():
    network, _, frame = drive()
    values = frame[["position_x", "position_y"]].to_numpy()
    group = xr.Dataset(
        {"mean": (("time", "component"), values)},
        {"time": frame["time"].to_numpy(), "component": ["position_x", "position_y"]},
        {"target": "car"},
    )
    tree = xr.DataTree.from_dict({"track/t0": group})
    pd.testing.assert_frame_equal(match_track(tree, network, std=5.0), match_track(frame, network, std=5.0))
    for bad, text in [
        (frame.drop(columns="position_y"), 'match_track: the track has no column "position_y"'),
        (frame.iloc[:0], "match_track: the track needs rows, each with finite positions"),
        (3, "match_track takes a DataFrame as of probcal.tracks, or a fit, not int"),
    ]:
        with pytest.raises(InputError, match=text):
            match_track(bad, network, std=5.0)
    with pytest.raises(InputError, match=r"match_track: std is 0.0; give a positive number of metres"):
        match_track(frame, network, std=0.0)


def test_points_that_cannot_be_placed_are_refused(tmp_path):
    network = RoadNetwork.from_lines({"a": [(0.0, 0.0), (10.0, 0.0)]})
    with pytest.raises(InputError, match=r"nearest takes finite points of shape \(n, 2\) in m"):
        network.nearest([(0.0, np.nan)])
    graph = nx.MultiDiGraph()
    graph.add_node(1, x=0.0, y=0.0)
    graph.add_node(2, x=9.0, y=0.0)
    graph.add_edge(1, 2)
    with pytest.raises(InputError, match="the graph has nodes without z; give every node one, or dimension=2"):
        RoadNetwork.from_graph(graph, crs="local", dimension=3)
    far = {"type": "LineString", "coordinates": [[1e30, 0.0], [2e30, 0.0]]}
    path = tmp_path / "far.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [{"type": "Feature", "geometry": far}]}))
    with pytest.raises(InputError, match="some points are outside the area of"):
        read_roads(path, crs="EPSG:25832", frame=LocalFrame(47.8, 11.5))
