"""Associations, objects and biases sampled together, against the sum over all associations."""

from functools import cache, partial
from itertools import product
from types import SimpleNamespace

import jax
import numpy as np
import pandas as pd
import pytest

import probcal as pc
from probcal.errors import InputError
from probcal.geometry import bearing, norm
from probcal.inference.hierarchy import hierarchy_of
from probcal.inference.mixed import mixing
from probcal.results.read import apply, summary
from probcal.tracking.sampler.associations import SWEEP, begun_at, matched, run_pass, run_passes, scene_of, split_r_hat
from probcal.tracking.sampler.moves import ALL_SCANS, ONE_SCAN, SWAP, TRACK, draw_scan, log_scan
from probcal.tracking.sampler.sampled import Association, fitted

CHANCE, CLUTTER, SIZE = 0.8, 0.6, 12.0  # of detection; false ones a scan; of the interval that they fill
STD, SHIFT, START, SPEED, DRIVE = 0.4, 1.0, 3.0, 1.5, 0.3
OBJECTS, SLOTS = 1.5, 2
CHAINS, DRAWS, WARMUP = 4, 700, 50
SIGMAS = 5.0  # of the Monte Carlo error: 1e-6 a comparison, 1e-4 for all of a scene


@pc.sensor(height=pc.Channel("m", std=STD))
def ruler(target, pose, *, shift=pc.Bias("m", SHIFT)):
    """Height above the node."""
    return dict(height=target.position[1] - pose.position[1] + shift)


def problem_of(scans):
    """A problem of scans (time, sensor, heights); the shift of the first sensor is known."""
    rows = [
        {"time": t, "sensor": f"ruler_{s}", "height": y}
        for t, s, heights in scans for y in (heights or [None])
    ]  # fmt: skip
    seen = pc.Detection(CHANCE, clutter=CLUTTER, limits={"height": (-SIZE / 2, SIZE / 2)})
    network = pc.Network([ruler.on(pc.Node(s, (0.0, 0.0)), name=f"ruler_{s}", detection=seen) for s in "ab"])
    start = {"position": ((0.0, 0.0), START), "velocity": ((0.0, 0.0), SPEED)}
    motion = pc.Target(pc.ConstantVelocity(DRIVE), start)
    return pc.Problem(network, motion, pd.DataFrame(rows), fix="ruler_a.shift")


PLAIN = [
    (0.0, "a", [1.0, -2.1]), (0.0, "b", [1.6, -1.4, 4.0]), (1.0, "a", []), (1.0, "b", [2.7, 0.3, -2.6]),
    (2.0, "a", [3.3, -3.2]),
]  # fmt: skip
CROSSING = [
    (0.0, "a", [0.6, -0.6]), (0.0, "b", [1.4, 0.1, 5.5]), (1.0, "a", []), (1.0, "b", [0.8, 0.6, -4.1]),
    (2.0, "a", [0.5, -0.7]),
]  # fmt: skip


# all associations, naively


def log_normal(y, C):
    return -0.5 * (y @ np.linalg.solve(C, y) + np.linalg.slogdet(C)[1] + len(y) * np.log(2 * np.pi))


def arrangements(present, count):
    """Every choice of a detection, or None, for each slot that is present, no detection taken twice."""
    each = [[None, *range(count)] if there else [None] for there in present]
    for choice in product(*each):
        taken = [d for d in choice if d is not None]
        if len(set(taken)) == len(taken):
            yield choice


def weighed(scans, slots=SLOTS):
    """Every association, its log weight, and mean and variance of the shift of b, by one dense Gaussian each."""
    t = np.array([time for time, *_ in scans]) - scans[0][0]
    early, late = np.minimum.outer(t, t), np.maximum.outer(t, t)
    track = START**2 + SPEED**2 * np.outer(t, t) + DRIVE**2 * early**2 * (3 * late - early) / 6
    found = []
    for present in product([False, True], repeat=slots):
        n = sum(present)
        prior = np.log(OBJECTS**n) - np.sum(np.log(np.arange(1, n + 1)))  # Poisson
        prior -= np.log(len([p for p in product([0, 1], repeat=slots) if sum(p) == n]))  # which slots
        for whole in product(*[list(arrangements(present, len(heights))) for _, _, heights in scans]):
            pairs = [(s, k, d) for k, choice in enumerate(whole) for s, d in enumerate(choice) if d is not None]
            total = sum(len(heights) for *_, heights in scans)
            weight = prior + len(pairs) * np.log(CHANCE) + (n * len(scans) - len(pairs)) * np.log(1 - CHANCE)
            weight += (total - len(pairs)) * np.log(CLUTTER / SIZE)
            mean, variance = 0.0, SHIFT**2
            if pairs:
                s, k, d = (np.array(column) for column in zip(*pairs, strict=True))
                y = np.array([scans[j][2][i] for j, i in zip(k, d, strict=True)])
                b = np.array([scans[j][1] == "b" for j in k], float)
                C = np.where(np.equal.outer(s, s), track[np.ix_(k, k)], 0.0) + STD**2 * np.eye(len(y))
                C += SHIFT**2 * np.outer(b, b)
                gain = SHIFT**2 * np.linalg.solve(C, b)
                weight, mean, variance = weight + log_normal(y, C), gain @ y, SHIFT**2 - SHIFT**2 * gain @ b
            found.append((present, whole, weight, mean, variance))
    return found


@cache
def enumerated(name):
    """The exact posterior of a scene."""
    scans = {"plain": PLAIN, "crossing": CROSSING}[name]
    found = weighed(scans)
    weight = np.array([w for *_, w, _, _ in found])
    p = np.exp(weight - weight.max())
    D = max(len(heights) for *_, heights in scans)
    choice = np.array(
        [[[D if d is None else d for d in of] for of in zip(*whole, strict=True)] for _, whole, *_ in found]
    )
    return SimpleNamespace(
        scans=scans, a=Association(choice, np.array([present for present, *_ in found])), weight=weight,
        p=p / p.sum(), mean=np.array([m for *_, m, _ in found]), variance=np.array([v for *_, v in found]), D=D,
    )  # fmt: skip


def exchanged(a):
    """Whether the object that is high at first is the low one at the end (of the crossing scene), or None is clear."""
    first, last = a.choice[..., 0], a.choice[..., 4]
    both = (first < 2).all(-1) & (last < 2).all(-1)
    return both & (first == last).all(-1), both & (first != last).all(-1)


def sampled(name, schedule, draws=DRAWS, *, prior=None, key=1):
    """Draws of a schedule of moves, even chains from nothing, odd ones from the likeliest association."""
    e, prior = enumerated(name), pc.Gaussian() if prior is None else prior
    problem = problem_of(e.scans)
    with jax.enable_x64(True):
        scene, views, _ = scene_of(problem, prior, OBJECTS, np.zeros(1))
        begin = [0, int(np.argmax(e.p))] * (CHAINS // 2)
        hierarchy, first = hierarchy_of(prior, problem), Association(e.a.choice[begin], e.a.present[begin])
        chains = begun_at(first, 1, hierarchy, jax.random.key(key))
        found = run_passes(scene, views, hierarchy, chains, schedule, WARMUP + draws, jax.random.key(key))
    return jax.tree.map(lambda leaf: leaf[:, WARMUP:], found)


def of_interest(e, a):
    """What is compared of associations: the number of objects, which rows belong together, and who changed places."""
    there = np.array([(k, d) for k, (_, _, heights) in enumerate(e.scans) for d in range(len(heights))])
    each = (a.choice[..., there[:, 0]] == there[:, 1]).astype(float)  # (..., T, R)
    pairs = np.einsum("...tr,...ts->...rs", each, each)[..., *np.triu_indices(len(there))]
    number = a.present.sum(-1)[..., None] == np.arange(SLOTS + 1)
    return np.concatenate([number, pairs, np.stack(exchanged(a), -1)], -1).astype(float)


def compared(e, p, kept):
    """Draws (C, N, Q) of what is compared, and the exact expectations (Q,) and sds under weights p."""
    of, z2 = of_interest(e, e.a), e.variance + e.mean**2
    mean = np.concatenate([p @ of, [p @ e.mean, p @ z2]])
    square = np.concatenate([p @ of, [p @ z2, p @ (3 * e.variance**2 + 6 * e.variance * e.mean**2 + e.mean**4)]])
    drawn = np.concatenate([of_interest(e, kept.a), kept.z, kept.z**2], 2)
    return drawn, mean, np.sqrt(np.maximum(square - mean**2, 0.0))


def errors(drawn, mean, sd):
    """By how many Monte Carlo errors the means of draws (C, N, Q) are off; what is all but sure is within 0.01."""
    off = drawn.mean((0, 1)) - mean
    unsure = sd > 0.1
    assert (np.abs(off[~unsure]) < 0.01).all()
    with np.errstate(invalid="ignore", divide="ignore"):  # r_hat of what is 0 or 1
        ess = mixing(drawn[..., unsure])["ess"]
    return off[unsure] / sd[unsure] * np.sqrt(ess)


# against these


@pytest.mark.ci
@pytest.mark.parametrize("name", ["plain", "crossing"])
def test_density_of_every_association_is_that_of_a_dense_gaussian(name):
    e = enumerated(name)
    with jax.enable_x64(True):
        scene, views, _ = scene_of(problem_of(e.scans), pc.Gaussian(), OBJECTS, np.zeros(1))
        density, z, variance = jax.device_get(all_fitted(scene, views, jax.device_put(e.a)))
    np.testing.assert_allclose(density - density[0], e.weight - e.weight[0], atol=1e-8)
    np.testing.assert_allclose(z[:, 0], e.mean, atol=1e-9)
    np.testing.assert_allclose(variance[:, 0, 0], e.variance, rtol=1e-9)


@partial(jax.jit, static_argnames="views")
def all_fitted(scene, views, a):
    """Density, mean and covariance of the biases of many associations."""

    def one(a):
        fit = fitted(scene, views, a)
        return fit.density, fit.z, fit.biases.covariance()

    return jax.lax.map(one, a, batch_size=256)


def test_one_scan_is_drawn_exactly():
    """Three slots, one of them absent from some pairs, four detections; 34 frequencies of 20,000: false alarm 2e-5."""
    ratio = np.random.default_rng(1).normal(0.0, 1.5, (3, 4))
    ratio[1, 2] = -np.inf
    whole = list(arrangements([True] * 3, 4))
    choice = np.array([[4 if d is None else d for d in own] for own in whole])
    weight = np.array([np.exp(sum(ratio[t, d] for t, d in enumerate(own) if d is not None)) for own in whole])

    @jax.jit
    def both(ratio, choice, key):
        drawn = jax.vmap(partial(draw_scan, ratio))(jax.random.split(key, 20_000))
        return jax.vmap(partial(log_scan, ratio))(choice), drawn

    with jax.enable_x64(True):
        density, drawn = jax.device_get(both(ratio, choice, jax.random.key(2)))
    p = weight / weight.sum()
    np.testing.assert_allclose(np.exp(density), p, atol=1e-12)
    found = np.array([(drawn == own).all(1).mean() for own in choice])
    assert found.sum() == 1.0
    assert (np.abs(found - p) <= SIGMAS * np.sqrt(p / 20_000) + 1e-4).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["plain", "crossing"])
def test_draws_have_the_posterior_of_all_associations(name):
    """Some 40 expectations of 2800 draws within 5 Monte Carlo errors: false alarm 2e-5."""
    e, kept = enumerated(name), sampled(name, SWEEP)
    assert np.abs(errors(*compared(e, e.p, kept))).max() < SIGMAS
    assert kept.taken[:, :, SWEEP.index(ALL_SCANS)].mean() > 0.999, "where all is linear this is a Gibbs step"
    if name == "crossing":  # each identity of the objects behind the crossing is there
        bounced, crossed = (side.mean(1) for side in exchanged(kept.a))
        assert bounced.min() > 0.1
        assert crossed.min() > 0.5


@pytest.mark.slow
@pytest.mark.parametrize(
    "schedule",
    [
        pytest.param((TRACK,) * 5, id="tracks alone"),
        pytest.param((TRACK, TRACK, ONE_SCAN, ONE_SCAN, ONE_SCAN), id="scan by scan"),
        pytest.param((SWAP, TRACK, ALL_SCANS, TRACK, ALL_SCANS), id="no single scan", marks=pytest.mark.slow),
    ],
)
def test_draws_are_right_with_moves_left_out(schedule):
    """What can reach every association has the same posterior; false alarm 2e-5 each."""
    e, kept = enumerated("crossing"), sampled("crossing", schedule)
    assert np.abs(errors(*compared(e, e.p, kept))).max() < SIGMAS


@pytest.mark.ci
def test_one_kernel_serves_every_association_and_recording_of_a_form():
    for name in ("plain", "crossing"):
        sampled(name, SWEEP, 1)
    size = run_pass._cache_size()
    sampled("plain", (SWAP, TRACK, SWAP, TRACK, SWAP), 1)
    sampled("crossing", SWEEP, 120)
    assert run_pass._cache_size() == size


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind",
    [
        pytest.param(ALL_SCANS, marks=pytest.mark.slow),
        *(pytest.param(kind, marks=pytest.mark.slow) for kind in (ONE_SCAN, SWAP, TRACK)),
    ],
)
def test_a_move_alone_leaves_exact_draws_as_they_are(kind):
    """200 chains begin at draws of the enumerated posterior and move 250 times; 5 errors of their means: 2e-5."""
    e, chains = enumerated("crossing"), 200
    problem = problem_of(e.scans)
    drawn = np.random.default_rng(2).choice(len(e.p), chains, p=e.p)
    with jax.enable_x64(True):
        scene, views, _ = scene_of(problem, pc.Gaussian(), OBJECTS, np.zeros(1))
        known = hierarchy_of(pc.Gaussian(), problem)
        first = begun_at(Association(e.a.choice[drawn], e.a.present[drawn]), 1, known, jax.random.key(0))
        fits = jax.device_get(all_fitted(scene, views, first.at.a))
        root = np.sqrt(fits[2])
        first = first._replace(at=first.at._replace(density=fits[0], z=fits[1], root=root))
        kept = run_passes(scene, views, known, first, (kind,) * 5, 50, jax.random.key(4))
    assert 0.1 < kept.taken.mean() <= 1.0
    draws, mean, sd = compared(e, e.p, kept)
    unsure = sd > 0.1
    each = draws.mean(1)[:, unsure]
    error = np.maximum(each.std(0), 1e-9) / np.sqrt(chains)
    assert np.abs((each.mean(0) - mean[unsure]) / error).max() < SIGMAS


@pytest.mark.slow
def test_a_prior_with_hyper_parameters_is_integrated():
    """A Laplace density of the shift, by sums over a grid; false alarm 2e-5."""
    e, s = enumerated("plain"), np.linspace(-8.0, 8.0, 4001)
    prior = np.exp(-np.sqrt(2.0) * np.abs(s) / SHIFT) / (np.sqrt(2.0) * SHIFT)
    ratio = prior / (np.exp(-0.5 * (s / SHIFT) ** 2) / np.sqrt(2 * np.pi * SHIFT**2))
    given = np.exp(-0.5 * (s[None] - e.mean[:, None]) ** 2 / e.variance[:, None]) * ratio[None]
    given *= (s[1] - s[0]) / np.sqrt(2 * np.pi * e.variance)[:, None]
    p = e.p * given.sum(1)
    p /= p.sum()
    kept = sampled("plain", SWEEP, prior=pc.Laplace())
    draws, mean, sd = compared(e, p, kept)
    first, second = ((e.p[:, None] * given * s[None] ** k).sum() / (e.p @ given.sum(1)) for k in (1, 2))
    fourth = (e.p[:, None] * given * s[None] ** 4).sum() / (e.p @ given.sum(1))
    mean[-2:], sd[-2:] = (first, second), np.sqrt([second - first**2, fourth - second**2])
    assert np.abs(errors(draws, mean, sd)).max() < SIGMAS


@pytest.mark.slow
def test_with_bent_sensors_draws_have_the_density_that_is_declared():
    """Range and azimuth with a view, Laplace's formula: frequencies against that density; false alarm 2e-5."""

    @pc.sensor(range=pc.Channel("m", std=5.0), azimuth=pc.Channel("rad", std=0.02, wrap=True))
    def radar(target, pose):
        line = pose.local(target.position)
        return dict(range=norm(line), azimuth=bearing(line))

    rng = np.random.default_rng(5)
    places = {"west": np.zeros(2), "east": np.array([300.0, 0.0])}
    rows = []
    for t, name in ((0.0, "west"), (0.0, "east"), (1.0, "west"), (2.0, "east")):
        for x in ((100.0 + 8.0 * t, 120.0), (104.0 + 4.0 * t, 120.0 + 9.0 * t)):
            line = np.array(x) - places[name] + np.array([3.0, -6.0]) * (name == "east")
            rows.append({"time": t, "sensor": name, "range": np.hypot(*line) + rng.normal(0.0, 5.0),
                         "azimuth": np.arctan2(line[1], line[0]) + rng.normal(0.0, 0.02)})  # fmt: skip
    seen = pc.Detection(0.85, clutter=0.3, view=pc.Sector(range=400.0))
    nodes = [pc.Node("west", places["west"]), pc.Node("east", places["east"], scale={"position": 8.0, "heading": 0.03})]
    network = pc.Network([radar.on(node, detection=seen) for node in nodes])
    start = {"position": ((120.0, 120.0), 30.0), "velocity": ((0.0, 0.0), 8.0)}
    problem = pc.Problem(network, pc.Target(pc.ConstantVelocity(1.0), start), pd.DataFrame(rows))
    whole = [
        (present, choice)
        for present in product([False, True], repeat=SLOTS)
        for choice in product(*[list(arrangements(present, 2))] * 4)
    ]
    choice = np.array([[[2 if d is None else d for d in of] for of in zip(*own, strict=True)] for _, own in whole])
    a = Association(choice, np.array([present for present, _ in whole]))
    with jax.enable_x64(True):
        scene, views, _ = scene_of(problem, pc.Gaussian(), OBJECTS, np.zeros(3))
        density, mean, covariance = jax.device_get(all_fitted(scene, views, jax.device_put(a)))
        first = Association(a.choice[[0, -1, 0, -1]], a.present[[0, -1, 0, -1]])
        hierarchy = hierarchy_of(pc.Gaussian(), problem)
        chains = begun_at(first, 3, hierarchy, jax.random.key(0))
        kept = run_passes(scene, views, hierarchy, chains, SWEEP, WARMUP + DRAWS, jax.random.key(6))
    kept = jax.tree.map(lambda leaf: leaf[:, WARMUP:], kept)
    assert 0.5 < kept.taken[:, :, SWEEP.index(ALL_SCANS)].mean() < 0.9999
    p = np.exp(density - density.max())
    e = SimpleNamespace(scans=[(None, None, [0, 1])] * 4 + [(None, None, [])], a=a)
    pad = Association(np.concatenate([a.choice, np.full((*a.choice.shape[:2], 1), 2)], 2), a.present)
    of = of_interest(e, pad)[:, :-2]
    p /= p.sum()
    kept_pad = Association(
        np.concatenate([kept.a.choice, np.full((*kept.a.choice.shape[:3], 1), 2)], 3), kept.a.present
    )
    drawn = np.concatenate([of_interest(e, kept_pad)[..., :-2], kept.z], 2)
    exact = np.concatenate([p @ of, p @ mean])
    variance = p @ (np.diagonal(covariance, axis1=1, axis2=2) + mean**2) - (p @ mean) ** 2
    sd = np.sqrt(np.concatenate([(p @ of) * (1 - p @ of), variance]))
    assert np.abs(errors(drawn, exact, sd)).max() < SIGMAS


# the verb


@pytest.mark.slow
def test_associations_objects_and_biases_are_sampled_together():
    """Which rows belong together, by the public verb, within 5 Monte Carlo errors: false alarm 1e-5."""
    e = enumerated("crossing")
    problem = problem_of(e.scans)
    tree = pc.sample_associations(problem, objects=OBJECTS, most=SLOTS, draws=900, warmup=WARMUP, key=7)
    assert tree.attrs["status"] == "converged"
    assert tree["posterior"]["bias"].dims == ("chain", "draw", "bias_label")
    number = e.a.present.sum(1)
    assert abs(tree.attrs["objects"] - e.p @ number) < 0.05
    own = summary(tree)
    assert abs(own["mean"][0] - e.p @ e.mean) < 0.05
    assert abs(own["sd"][0] - np.sqrt(e.p @ (e.variance + e.mean**2) - (e.p @ e.mean) ** 2)) < 0.02
    pairs = of_interest(e, e.a)[:, SLOTS + 1 : -2]
    found = tree["together"]["probability"].values[np.triu_indices(10)]
    assert tree["together"]["row"].values.tolist() == [0, 1, 2, 3, 4, 6, 7, 8, 9, 10], "row 5 is blank"
    exact = e.p @ pairs
    error = np.sqrt(exact * (1 - exact) / 1200) + 1e-3  # at least half of the draws count as independent
    assert (np.abs(found - exact) < SIGMAS * error).all()
    group = tree["association"].to_dataset().to_dataframe()
    assert group.groupby("row")["probability"].sum().max() <= 1 + 1e-9
    each = np.diagonal(tree["together"]["probability"].values)
    listed = group.groupby("row")["probability"].sum().reindex(tree["together"]["row"].values, fill_value=0.0)
    np.testing.assert_allclose(listed, each, atol=0.02)
    assert float(tree["object"]["probability"].sum()) == pytest.approx(tree.attrs["objects"])
    assert problem.assigned({"row": [0], "track": ["track_0"]}).measurements.target_names == ("track_0",)
    again = apply(problem, tree)
    assert abs(again.z[0] - own["mean"][0] / SHIFT) < 1e-12
    other = pc.sample_associations(problem, objects=OBJECTS, most=SLOTS, draws=900, warmup=WARMUP, key=8, start=tree)
    assert abs(summary(other)["mean"][0] - e.p @ e.mean) < 0.05, "where a search begins changes nothing"


@pytest.mark.ci
def test_few_draws_are_said_not_to_have_converged():
    e = enumerated("crossing")
    tree = pc.sample_associations(problem_of(e.scans), objects=OBJECTS, most=SLOTS, draws=10, warmup=0, key=1)
    assert tree.attrs["status"] == "not converged"
    assert "effective draws of" in tree.attrs["message"]
    assert "All 2 objects are there in" in tree.attrs["message"]


def test_chains_that_disagree_on_a_number_have_no_good_r_hat():
    """Where ranks of whole numbers say nothing."""
    rng = np.random.default_rng(0)
    assert split_r_hat(np.repeat([[2.0], [3.0]], 50, 1)) == np.inf
    assert split_r_hat(np.full((2, 50), 2.0)) == 1.0
    assert split_r_hat(rng.integers(0, 2, (4, 500)).astype(float)) < 1.01
    assert split_r_hat(rng.integers(0, 2, (4, 500)) + 0.3 * np.arange(4)[:, None]) > 1.1


def test_slots_are_matched_from_draw_to_draw():
    """Two tracks under exchanged numbers, one of them not always there."""
    choice = np.array([[[0, 1, 0], [1, 0, 1]], [[1, 0, 1], [0, 1, 0]], [[2, 2, 2], [0, 1, 2]]])
    there = np.array([[True, True], [True, True], [False, True]])
    found = matched(Association(choice, there), np.zeros(3), 2)
    np.testing.assert_array_equal(found.choice[:, 0], [[0, 1, 0], [0, 1, 0], [0, 1, 2]])
    np.testing.assert_array_equal(found.choice[:, 1], [[1, 0, 1], [1, 0, 1], [2, 2, 2]])
    np.testing.assert_array_equal(found.present, [[True, True], [True, True], [True, False]])


@pytest.mark.parametrize(
    ("change", "settings", "said"),
    [
        (None, {"most": 9}, "sample_associations(most=9): give 1 to 8 objects at most"),
        (None, {"draws": 0}, "take 1 or more draws and chains, warmup 0 or more"),
        (None, {"objects": -1.0}, "sample_associations(objects=-1.0): give a positive number"),
        (None, {"prior": pc.Flat()}, "associations are weighed by evidence, which needs a density"),
        (None, {"prior": pc.BernoulliGaussian()}, "associations are weighed by evidence, which needs a density"),
        (lambda table: table.iloc[[0, 2, 6]].assign(target="one"), {}, "no row leaves its target open, nothing is"),
        (lambda table: table.assign(target=["one", *[None] * 10]), {}, "1 rows name their target; give the detections"),
        (lambda table: pd.concat([table.assign(time=table["time"] + t) for t in range(60)]), {},
         "600 detections and most=4 make 2400 pairs, of which 1 to 2000 are sampled"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said(change, settings, said):
    problem = problem_of(PLAIN)
    if change is not None:
        table = change(problem.measurements.table.frame).reset_index(drop=True)
        motion = {"one": problem.motion, "object": problem.motion}
        problem = pc.Problem(problem.network, motion, table, fix=problem.fixed)
    with pytest.raises(InputError) as caught:
        pc.sample_associations(problem, **settings)
    assert said in str(caught.value)


def test_levels_and_rates_that_are_not_known_are_refused():
    problem = problem_of(PLAIN)
    table = problem.measurements.table
    motion = pc.Target(pc.ConstantVelocity(pc.Unknown(0.3)), {"position": (0.0, 3.0), "velocity": (0.0, 1.0)})
    with pytest.raises(InputError, match="noise levels must be known and the motion Gaussian"):
        pc.sample_associations(pc.Problem(problem.network, motion, table, fix=problem.fixed))
    seen = pc.Detection(CHANCE, clutter=pc.Unknown(1.0), limits={"height": (-6.0, 6.0)})
    network = pc.Network([ruler.on(pc.Node(s, (0.0, 0.0)), name=f"ruler_{s}", detection=seen) for s in "ab"])
    with pytest.raises(InputError, match="must be known; give numbers, such as SelfConfiguration finds"):
        pc.sample_associations(pc.Problem(network, problem.motion, table))
