"""Places of targets that stand still, integrated: rings and pairs of places against a grid, and where it is left be."""

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from scipy.special import logsumexp

import probcal as pc
from probcal.gaussian.mode import find_mode
from probcal.gaussian.places import places_of, tilt_of
from probcal.inference.fit import calibrate
from probcal.modes import automatic_start
from probcal.priors import Precision
from probcal.results.modes import rivals

ANCHORS = np.array([(0.0, 0.0), (40.0, 0.0), (0.0, 40.0)])
STD, OFFSET, CENTRE, SPREAD = 1.0, 6.0, np.array([15.0, 12.0]), 10.0


@pc.sensor(range=pc.Channel("m", std=STD))
def anchor(target, pose, *, offset=pc.Bias("m", OFFSET, shared="type")):
    """Distance with an offset that all anchors have in common."""
    return dict(range=jnp.sqrt(jnp.sum((target.position - pose.position) ** 2) + 1e-6) + offset)


def tags(seed, hears, at=CENTRE, spread=SPREAD):
    """Network, motion and table of tags at unknown places of which each is heard by some of the anchors."""
    rng = np.random.default_rng(seed)
    offset, rows, motion = OFFSET * rng.standard_normal(), [], {}
    for k, count in enumerate(hears):
        place = at + spread * rng.standard_normal(2)
        motion[f"t{k}"] = pc.Target(pc.Static(), {"position": (tuple(at), spread)})
        for a in rng.permutation(len(ANCHORS))[:count]:
            told = np.linalg.norm(place - ANCHORS[a]) + offset + STD * rng.standard_normal()
            rows.append(dict(time=0.0, sensor=f"a{a}", target=f"t{k}", range=told))
    network = pc.Network([anchor.on(pc.Node(f"a{k}", tuple(place))) for k, place in enumerate(ANCHORS)])
    table = pd.DataFrame(rows)
    return network, motion, table


def on_a_grid(table, offsets):
    """Log posterior density of the offset with every place summed over a grid."""
    axes = [np.linspace(c - 5 * SPREAD, c + 5 * SPREAD, 501) for c in CENTRE]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2)
    prior = -0.5 * ((grid - CENTRE) ** 2).sum(1) / SPREAD**2
    far = {f"a{k}": np.linalg.norm(grid - place, axis=1) for k, place in enumerate(ANCHORS)}
    log_p = -0.5 * (offsets / OFFSET) ** 2
    for _, own in table.groupby("target"):
        for k, offset in enumerate(offsets):
            off = [far[row.sensor] + offset - row.range for row in own.itertuples()]
            log_p[k] += logsumexp(prior - 0.5 * sum(e**2 for e in off) / STD**2)
    return log_p - logsumexp(log_p)


def mode(table):
    """Mode and sd there of the offset, from a grid."""
    offsets = np.linspace(-3 * OFFSET, 3 * OFFSET, 181)
    best = offsets[np.argmax(on_a_grid(table, offsets))]
    offsets = best + np.linspace(-0.3, 0.3, 13)
    square, linear, _ = np.polyfit(offsets - best, on_a_grid(table, offsets), 2)
    return best - linear / (2 * square), (-2 * square) ** -0.5


def offset(world, engine="auto"):
    """Mean and sd of the offset under MAP."""
    tree = pc.fit(pc.Problem(*world), method=pc.MAP(engine=engine), prior=pc.Gaussian())
    assert tree.attrs["status"] == "converged"
    drawn = tree.posterior["bias"]
    return float(drawn.mean()), float(drawn.std())


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "engine"), [(0, "dense"), (0, "cholmod"), (1, "cholmod"), (2, "cholmod")])
def test_tags_that_one_or_two_hear_are_integrated(seed, engine, monkeypatch):
    """Rings and pairs of places: MAP is the mode of a grid, from which Laplace's formula is far."""
    world = tags(seed, hears=[1, 2] * 8)
    middle, sd = mode(world[-1])
    found, spread = offset(world, engine)
    monkeypatch.setattr(pc.MAP, "integrates_places", False)
    plain, _ = offset(world, engine)
    print(f"grid {middle:.3f} +- {sd:.3f}, MAP {found:.3f} +- {spread:.3f}, Laplace {plain:.3f}")
    assert abs(found - middle) < 0.1 * sd
    assert 0.9 < spread / sd < 1.1
    assert abs(plain - middle) > 0.5 * sd, "the scene tells the two apart"


def consistent(problem, z=None):
    """The point with trajectories at their mode at these biases, or at the mode of all."""
    model = problem.model
    start = automatic_start(problem)
    if z is not None:
        start = start._replace(z=jnp.asarray(z))
    flat = Precision(jnp.zeros(model.biases))
    return find_mode(model, start, flat, 200, 1e-10, joint=z is None).point


@pytest.mark.ci
def test_the_slope_is_that_of_the_height():
    """Central differences of what is added, over the offset."""
    problem = pc.Problem(*tags(3, hears=[1, 2, 3]))
    with jax.enable_x64(True):
        here = consistent(problem)
        still = places_of(problem.model, here)
        below, at, above = (
            tilt_of(problem.model, consistent(problem, np.asarray(here.z) + step), still) for step in (-1e-3, 0, 1e-3)
        )
    rise = (float(above.height) - float(below.height)) / 2e-3
    assert rise == pytest.approx(float(at.slope[0]), rel=0.02, abs=0.02)


@pytest.mark.ci
def test_an_integral_that_is_lost_adds_nothing(monkeypatch):
    """A number that is not finite leaves Laplace's formula, and no message of LAPACK."""
    problem = pc.Problem(*tags(3, hears=[1, 2, 3]))
    monkeypatch.setattr("probcal.gaussian.places._gain", lambda *_: (0.0, np.zeros(1), np.full((1, 1), np.nan)))
    with jax.enable_x64(True):
        here = consistent(problem)
        assert tilt_of(problem.model, here, places_of(problem.model, here)) is None


@pytest.mark.ci
def test_a_linear_problem_gains_nothing():
    """Where the places are Gaussian what is added is zero, and so are its slope and its curvature."""

    @pc.sensor(seen=pc.Channel("m", std=STD))
    def axis(target, pose, *, offset=pc.Bias("m", OFFSET)):
        return dict(seen=target.position[0] + 0.5 * target.position[1] - pose.position[0] + offset)

    network = pc.Network([axis.on(pc.Node(f"a{k}", tuple(place))) for k, place in enumerate(ANCHORS)])
    rng = np.random.default_rng(0)
    rows = [dict(time=0.0, sensor=f"a{k}", target=f"t{k % 2}", seen=20 * rng.standard_normal()) for k in range(3)]
    motion = {f"t{k}": pc.Target(pc.Static(), {"position": (tuple(CENTRE), SPREAD)}) for k in range(2)}
    problem = pc.Problem(network, motion, pd.DataFrame(rows))
    with jax.enable_x64(True):
        here = consistent(problem)
        still = places_of(problem.model, here)
        assert all(bool(jnp.all(own.on)) for own in still), "seen from few poses, they are integrated"
        found = tilt_of(problem.model, here, still)
    for name in ("height", "slope", "curvature"):
        np.testing.assert_allclose(getattr(found, name), 0.0, atol=2e-3, err_msg=name)


@pytest.mark.ci
def test_a_tag_that_all_hear_well_is_left_to_laplace():
    """Where many see a place sharply there is nothing to add, nor where the target moves or is known."""
    rng = np.random.default_rng(0)
    places = {f"a{k}": 80 * rng.random(2) for k in range(7)}
    network = pc.Network([anchor.on(pc.Node(name, tuple(own))) for name, own in places.items()])
    place = np.array([30.0, 35.0])
    rows = [
        dict(time=t, sensor=name, range=np.linalg.norm(place - own) + 2.0 + rng.standard_normal())
        for name, own in places.items()
        for t in range(4)
    ]
    prior = {"position": ((40.0, 40.0), 20.0)}
    moving = pc.Target(pc.ConstantVelocity(std=0.1), prior | {"velocity": ((0.0, 0.0), 1.0)})
    for target in (pc.Target(pc.Static(), prior), moving):
        problem = pc.Problem(network, target, pd.DataFrame(rows))
        with jax.enable_x64(True):
            still = places_of(problem.model, consistent(problem))
        assert still is None or not any(bool(jnp.any(own.on)) for own in still)


def line_of_anchors(seed=3):
    """Ten tags heard by two known nodes and a loose one, which stands 6 m above their line and is stated on it."""
    rng = np.random.default_rng(seed)
    stated = {"a0": (0.0, 0.0), "a1": (40.0, 0.0), "a2": (20.0, 0.0)}
    true, rows = stated | {"a2": (21.0, 6.0)}, []
    for k in range(10):
        place = np.array([rng.uniform(0, 40), rng.uniform(4, 30) * (1 if k % 3 else -1)])
        for name, own in true.items():
            told = np.linalg.norm(place - own) + 0.3 * rng.standard_normal()
            rows.append(dict(time=0.0, sensor=name, target=f"t{k}", range=told))
    loose = {"a2": {"scale": {"position": 5.0}}}
    network = pc.Network([anchor.on(pc.Node(name, own, **loose.get(name, {}))) for name, own in stated.items()])
    motion = pc.Target(pc.Static(), {"position": ((20.0, 0.0), 20.0)})
    return pc.Problem(network, motion, pd.DataFrame(rows), fix=["*.offset"])


@pytest.mark.slow
def test_the_other_side_is_seen_where_places_are_integrated():
    problem = line_of_anchors()
    tree = pc.assess(problem, pc.fit(problem, pc.MAP()))
    assert tree.attrs["places"] == "integrated"
    gain = rivals(tree)["gain"].values
    assert np.abs(gain).max() < 0.01
    assert tree["verdict"]["verdict"].sel(bias_label="a2.position_y") == "weak"


@pytest.mark.slow
def test_a_tag_that_many_rows_place_to_a_hair_is_integrated_around_its_mode():
    """Heavy-tailed noise far from the place hides it: a search by slopes alone ended on its way there."""

    @pc.sensor(range=pc.Channel("m", std=0.05, noise=pc.StudentT(4)))
    def ranger(target, pose, *, offset=pc.Bias("m", 1.0)):
        return dict(range=jnp.sqrt(jnp.sum((target.position - pose.position) ** 2) + 1e-6) + offset)

    nodes = [pc.Node(f"a{k}", (30.0 * np.cos(k), 30.0 * np.sin(k))) for k in range(7)]
    network = pc.Network([ranger.on(node) for node in nodes])
    motion = pc.Target(pc.Static(), {"position": ((0.0, 0.0), 400.0)})
    rng, rows = np.random.default_rng(0), []
    for k, place in enumerate([(11.0, -7.0), (-13.0, 4.0), (3.0, 21.0)]):
        for n, node in enumerate(nodes):
            told = np.linalg.norm(np.asarray(node.position) - place) + 0.05 * rng.standard_t(4, 60)
            rows += [dict(time=0.01 * r, sensor=f"a{n}", target=f"t{k}", range=v) for r, v in enumerate(told)]
    problem = pc.Problem(network, motion, pd.DataFrame(rows))
    tree, answer = calibrate(problem, pc.MAP())
    assert tree.attrs["status"] == "converged"
    with jax.enable_x64(True):
        still = [one._replace(on=jnp.ones_like(one.on)) for one in places_of(problem.model, answer.posterior.point)]
        tilt = tilt_of(problem.untilted.model, answer.posterior.point, tuple(still))
    assert tilt is not None
    assert abs(float(tilt.height)) < 0.5  # of three places that are nearly Gaussian


@pytest.mark.ci
def test_a_tag_beyond_the_reach_of_its_start_is_no_crash():
    network = pc.Network([anchor.on(pc.Node(f"a{k}", tuple(place))) for k, place in enumerate(ANCHORS)])
    place = np.array([8.0, 6.0])
    rows = [dict(time=0.0, sensor=f"a{k}", target="t", range=np.linalg.norm(place - a)) for k, a in enumerate(ANCHORS)]
    problem = pc.Problem(network, pc.Target(pc.Static(), {"position": ((0.0, 0.0), 1.0)}), pd.DataFrame(rows))
    tree = pc.fit(problem, pc.MAP())
    assert np.isfinite(tree["calibration"]["mean"].values).all()
