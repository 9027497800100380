"""The other side of a mirror: found, taken where it fits better, reported where it fits as well, and never made up."""

import sys
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import patch

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import probcal
from probcal import ConstantVelocity, Network, Node, Problem, simulate
from probcal.gaussian import recursion
from probcal.gaussian.information import at_levels
from probcal.gaussian.mode import factors
from probcal.inference import calibrate, solve
from probcal.inference.progress import Monitor
from probcal.modes import automatic_start
from probcal.modes.explore import Mirrored, Sides
from probcal.modes.grid import track_mode
from probcal.modes.mirrors import other_sides
from probcal.modes.reflections import planes, reflect, reflect_nodes
from probcal.plots.map import plot_map
from probcal.results.answer import Answer
from probcal.results.modes import rivals
from probcal.sensors import radar, ranger
from probcal.status import Status

sys.path.insert(0, str(Path(__file__).parents[1] / "models"))
import networks
from contracts import only

PLACES = [(0, 0), (40, 3), (80, -2), (120, 1)]
SCENES = ((3, "cholmod"), (1, "iterative"))  # beside the one of the tests of CI: seeds and engines


def beside(seed, kind=ranger, share=0.3):
    """Beacons hardly off a line, and a target that crosses it twice: the truth, and the path (E, 2)."""
    network = Network([kind.on(Node(f"b{k}", place)) for k, place in enumerate(PLACES)])
    time = np.arange(0, 60, 0.5)
    path = np.stack([-10 + 2.3 * time, 12 * np.sin(time / 9)], 1)
    drawn = simulate(network, ConstantVelocity(0.5), time, key=seed, share=share, tracks={"target": path})
    return Problem(network, ConstantVelocity(0.5), drawn.table), path


def off(states, path):
    return np.abs(np.asarray(states)[:, : path.shape[1]] - path).max()


def on_the_wrong_side(problem, seed):
    """The automatic start with 15 s of the track reflected in the line of the beacons, and smoothed there."""
    with jax.enable_x64(True):
        start = automatic_start(problem)
        first = np.random.default_rng(seed).integers(0, 90)
        mine = np.zeros(120, bool)
        mine[first : first + 30] = True
        (line,) = planes(problem, np.asarray(start.z))
        return track_mode(problem, reflect(problem, start, line, [mine], np.asarray(start.z)))


@pytest.mark.ci
def test_the_other_side_is_found_with_its_nodes():
    problem, _ = networks.setting(0, "line", share=1.0)
    with jax.enable_x64(True):
        point = automatic_start(problem)
        sides = other_sides(problem, point)
    assert len(sides.others) == 1
    assert abs(sides.others[0].gain) < 0.1
    axes = [label.endswith("y") for label in problem.labels]
    np.testing.assert_allclose(sides.others[0].shift[axes], -2 * np.asarray(point.z)[axes], atol=0.05)
    np.testing.assert_allclose(sides.others[0].point.states[0][:, 1], -np.asarray(point.states[0])[:, 1], atol=0.5)


@pytest.mark.ci
def test_a_limit_ends_the_search_for_mirror_images():
    """Beacons on a line have another answer, which is not found in time: the message says that nobody looked."""
    problem, _ = networks.setting(0, "line", share=1.0)
    found = {}
    for slow in ("mirror images", "never"):
        now, phases = [0.0], dict[str, None]()

        def late(at, now=now, phases=phases, slow=slow):
            phases[at.phase] = None
            now[0] = 300.0 * (at.phase == slow)

        monitor = Monitor(late, 300.0, clock=lambda now=now: now[0])
        found[slow], _ = calibrate(problem, probcal.MAP(), monitor=monitor)
    said = "Ended by the limit of 300 s before mirror images were looked at"
    assert [said in tree.attrs["message"] for tree in found.values()] == [True, False]
    assert [rivals(tree).sizes["mode"] for tree in found.values()] == [0, 1]
    assert all(tree.attrs["status"] == "converged" for tree in found.values())
    assert list(phases) == ["start", "climb", "mirror images", "mirror image 1 of 1"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "form"), [("line", "auto"), ("ceiling", "auto"), ("ceiling", "cholmod"), ("ceiling", "iterative")]
)
def test_a_mirror_is_reported_with_its_biases_and_they_are_weak(name, form):
    problem, _ = networks.setting(0, name, share=1.0)
    given = {} if form == "auto" else {"method": probcal.MAP(engine=form), "prior": probcal.Gaussian()}
    tree = probcal.fit(problem, **given)
    assert "Another answer fits as well" in tree.attrs["message"]
    assert "Survey a position off that" in tree.attrs["message"]
    group, axis = rivals(tree), {"line": "y", "ceiling": "z"}[name]
    assert abs(group["gain"].values[0]) < 0.1  # the first is the best
    across = [label for label in problem.labels if label.endswith(f"position_{axis}")]
    own = tree["calibration"]["mean"].sel(bias_label=across).values
    sd = tree["calibration"]["sd"].sel(bias_label=across).values
    there = group["bias"].isel(mode=0).sel(bias_label=across).values
    np.testing.assert_allclose(there, -own, atol=1.5 * sd.max())
    level = {"line": 0.0, "ceiling": 3.0}[name]
    track = only(tree)["mean"].values[:, problem.network.dimension - 1]
    other = tree["mode/track/target"]["position"]
    np.testing.assert_allclose(other.isel(mode=1).sel(axis=axis) - level, level - track, atol=1.0)
    legend = [text.get_text() for text in plot_map(tree).get_legend().get_texts()]
    assert "fits as well" in legend
    verdicts = probcal.assess(problem, tree)["verdict"].to_dataset()
    away = np.abs(own) > 2 * sd
    chosen = verdicts.sel(bias_label=[label for label, far in zip(across, away, strict=True) if far])
    assert away.any()
    assert set(chosen["verdict"].values.tolist()) <= {"weak", "prior only"}
    assert "in an answer that fits as well" in " ".join(chosen["reason"].values.tolist())


@pytest.mark.ci
def test_a_piece_on_the_wrong_side_is_turned():
    problem, path = beside(2)
    start = on_the_wrong_side(problem, 2)
    assert off(start.states[0], path) > 15
    tree = probcal.fit(problem, start=start)
    assert off(only(tree)["mean"].values, path) < 4


@pytest.mark.ci
@pytest.mark.parametrize(
    ("seed", "form"), [(1, "cholmod"), *(pytest.param(*own, marks=pytest.mark.slow) for own in SCENES)]
)
def test_a_scene_on_the_wrong_side_is_turned_in_sparse_form(seed, form):
    """From the whole track reflected, 20 m off at the most: `converged` there, before other sides were looked at."""
    problem, path = beside(seed)
    with jax.enable_x64(True):
        start = automatic_start(problem)
        z = np.asarray(start.z)
        (line,) = planes(problem, z)
        start = track_mode(problem, reflect(problem, start, line, [np.ones(120, bool)], z))
    assert off(start.states[0], path) > 15
    tree = probcal.fit(problem, probcal.MAP(engine=form), prior=probcal.Gaussian(), start=start)
    assert off(only(tree)["mean"].values, path) < 4


@pytest.mark.slow
def test_pieces_are_looked_at_again_where_the_scene_went_over():
    """The scene reflected fits better by 16 nats, and from there a piece of it by 17 more: 21 m off before."""
    problem, path = beside(53)
    start = on_the_wrong_side(problem, 53)
    tree = probcal.fit(problem, probcal.MAP(engine="cholmod"), prior=probcal.Gaussian(), start=start)
    assert off(only(tree)["mean"].values, path) < 4


def crossing(seed):
    """The beacons and two targets on both sides of their line, a third of the rows lost: the problem, and the paths."""
    network = Network([ranger.on(Node(f"b{k}", place)) for k, place in enumerate(PLACES)])
    time = np.arange(0, 60, 0.5)
    paths = {
        "one": np.stack([-10 + 2.3 * time, 12 * np.sin(time / 9)], 1),
        "two": np.stack([130 - 2.3 * time, 20 + 8 * np.sin(time / 7)], 1),
    }
    drawn = simulate(network, ConstantVelocity(0.5), time, key=seed, share=0.3, tracks=paths)
    kept = np.random.default_rng(seed).random(len(drawn.table)) > 0.3
    return Problem(network, ConstantVelocity(0.5), drawn.table[kept]), paths


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "form"), [(2, "dense"), (2, "cholmod"), (2, "iterative"), (44, "dense")])
def test_a_short_piece_of_one_of_two_targets_is_turned(seed, form):
    """Ten seconds at the beginning of a track: planes through other beacons cut long pieces that fit much worse.

    In the second scene eight shorter pieces fit better, and come back when they are polished.
    """
    problem, paths = crossing(seed)
    tree = probcal.fit(problem, probcal.MAP(engine=form), prior=probcal.Gaussian())
    for name, path in paths.items():
        track = tree[f"track/{name}"].to_dataset()
        there = np.round(track["time"].values * 2).astype(int)
        assert off(track["mean"].values, path[there]) < 4


@pytest.mark.ci
@pytest.mark.parametrize(
    ("method", "prior"),
    [
        (probcal.MAP(engine="cholmod"), probcal.Gaussian()),
        (probcal.MAP(engine="iterative"), probcal.Gaussian()),
        (probcal.EA(engine="cholmod"), None),
        (probcal.Gibbs(chains=1, warmup=5, draws=20, patience=1), probcal.Gaussian()),
    ],
    ids=["map", "iterative", "ea", "gibbs"],
)
def test_a_mirror_is_reported_in_sparse_form(method, prior):
    """Nodes on a line, biases free: the other side fits as well to 1e-3 nats, with the places of nodes turned over.

    A node that is many sd away there is called weak: the interval around the one side may miss the truth by all of it.
    """
    problem, _ = networks.setting(0, "line", share=1.0)
    tree = probcal.fit(problem, method, prior=prior)
    assert "Another answer fits as well" in tree.attrs["message"]
    group = rivals(tree)
    across = [label for label in problem.labels if label.endswith("position_y")]
    own = tree["calibration"].to_dataset().sel(bias_label=across)
    assert abs(group["gain"].values[0]) < 1e-3
    there = group["bias"].isel(mode=0).sel(bias_label=across).values
    np.testing.assert_allclose(there, -own["mean"].values, atol=2 * own["sd"].values.max())
    found = probcal.assess(problem, tree)
    away = group["apart"].isel(mode=0).values > 2
    assert away.any()
    judged = found["verdict"].to_dataset()
    assert set(judged["verdict"].values[away].tolist()) <= {"weak", "prior only"}
    assert "in an answer that fits as well" in " ".join(judged["reason"].values[away].tolist())
    assert "mirror" in found["finding"]["kind"].values.tolist()


@pytest.mark.ci
def test_an_answer_outlives_the_memory_that_its_other_side_takes():
    problem, _ = networks.setting(0, "line", share=1.0)

    def refused(*_):
        raise MemoryError

    with patch("probcal.inference.solve.other_sides", refused):
        tree = probcal.fit(problem, probcal.MAP(engine="cholmod"), prior=probcal.Gaussian())
    assert tree.attrs["status"] == "converged"
    assert "Memory did not hold" in tree.attrs["message"]
    assert not rivals(tree).sizes["mode"]


@pytest.mark.slow
def test_nodes_that_span_the_plane_have_no_mirror_in_sparse_form():
    problem, _ = networks.setting(1, "beacons")
    tree = probcal.fit(problem, probcal.MAP(engine="cholmod"), prior=probcal.Gaussian())
    assert not rivals(tree).sizes["mode"]
    assert "nother answer" not in tree.attrs["message"]


@pytest.mark.slow
def test_pieces_of_sixty_pairs_of_tracks_are_turned():
    """60 runs from the automatic start, a third of the rows lost: within 6 m of the paths, or another side is named."""
    lost = []
    for seed in range(60):
        problem, paths = crossing(seed)
        tree = probcal.fit(problem, probcal.MAP(), prior=probcal.Gaussian())
        for name, path in paths.items():
            track = tree[f"track/{name}"].to_dataset()
            there = off(track["mean"].values, path[np.round(track["time"].values * 2).astype(int)])
            if there > 6 and not rivals(tree).sizes["mode"]:
                lost.append((seed, name, there))
    assert not lost


@pytest.mark.slow
def test_pieces_of_fifty_tracks_are_turned():
    """50 runs, share 0.3 of the biases: all within 6 m of the path, or the path's side is reported as fitting as well.

    Where the two are within `NEAR` nats the answer may stand on either.
    """
    lost = []
    for seed in range(50):
        problem, path = beside(seed)
        tree = probcal.fit(problem, start=on_the_wrong_side(problem, seed), key=seed)
        there = off(only(tree)["mean"].values, path)
        if there > 6 and not rivals(tree).sizes["mode"]:
            lost.append((seed, there))
    assert not lost


@pytest.mark.ci
def test_sensors_that_see_the_side_have_no_mirror():
    problem, _ = beside(0, radar)
    with jax.enable_x64(True):
        point = automatic_start(problem)
        sides = other_sides(problem, point)
    assert not sides.moved
    assert not sides.others
    assert sides.point is point


def test_nodes_that_span_the_plane_have_no_mirror():
    problem, _ = networks.setting(1, "beacons")
    with jax.enable_x64(True):
        sides = other_sides(problem, automatic_start(problem))
    assert not sides.moved
    assert not sides.others


@pytest.mark.parametrize("name", ["line", pytest.param("ceiling", marks=pytest.mark.ci)])
def test_two_reflections_are_none(name):
    problem, _ = networks.setting(0, name)
    with jax.enable_x64(True):
        point = automatic_start(problem)
        plane = planes(problem, np.zeros(len(problem.labels)))[0]
        z = 0.3 * np.random.default_rng(0).normal(size=len(problem.labels))
        moved = reflect_nodes(problem, z, plane)
        every = [np.ones(len(epochs.time), bool) for epochs in problem.epochs]
        across = reflect(problem, point, plane, every, moved)
        back = reflect(problem, across, plane, every, reflect_nodes(problem, moved, plane))
    np.testing.assert_allclose(back.z, z, atol=1e-12)
    np.testing.assert_allclose(back.states[0], point.states[0], atol=1e-3)
    d = problem.network.dimension
    place, there = np.asarray(point.states[0])[:, :d], np.asarray(across.states[0])[:, :d]
    np.testing.assert_allclose(plane.distance(there), -plane.distance(place), atol=1e-3)
    assert bool(jnp.isfinite(across.noises[0]).all())


@pytest.mark.ci
def test_a_reflected_track_is_made_of_its_noises_at_any_level():
    problem, _ = networks.setting(0, "line")
    unknown = ConstantVelocity(probcal.Unknown(0.5))
    problem = Problem(problem.network, unknown, problem.measurements.table, fix=networks.FIXED["line"])
    with jax.enable_x64(True):
        point = at_levels(problem.model, automatic_start(problem), jnp.asarray([0.7]))
        line, every = planes(problem, np.asarray(point.z))[0], [np.ones(120, bool)]
        across = reflect(problem, point, line, every, np.asarray(point.z))
        part = problem.model.recursions[0]
        made = recursion.trajectory(
            part.F, factors(part, across.levels), part.drift[:, :, None], across.noises[0][:, :, None]
        )
    np.testing.assert_allclose(made[:, :, 0], across.states[0], atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    "method", [probcal.Collapsed(draws=300), probcal.NUTS(warmup=200, draws=200)], ids=["collapsed", "nuts"]
)
def test_chains_visit_both_sides_by_their_weights(method):
    """A start that favours one side by about 1 nat: shares of the draws within 5 errors of the evidences' ratio."""
    network, time = networks.NETWORKS["line"](), 0.5 * np.arange(60)
    path = np.stack([-10 + 3.8 * time, 15 + 8 * np.sin(time / 4)], 1)
    target = probcal.Target(ConstantVelocity(0.5), {"position": ((-10.0, 1.0), 6.0)})
    biases = {"b1.position_y": 4.0, "b2.position_y": -3.0}
    drawn = simulate(network, ConstantVelocity(0.5), time, key=0, biases=biases, tracks={"target": path})
    problem = Problem(network, target, drawn.table, fix=networks.FIXED["line"])
    gain = rivals(probcal.fit(problem, probcal.MAP(trajectory="joint")))["gain"].item()
    assert -2.5 < gain < -0.4
    tree = probcal.fit(problem, method, prior=probcal.Gaussian())
    stats = tree["sample_stats"].to_dataset()
    assert stats["crossed"].mean() > 0.2
    share = np.exp(gain) / (1 + np.exp(gain))
    lighter = min((stats["side"].values == k).mean() for k in (0, 1))
    assert abs(lighter - share) < 5 * np.sqrt(share * (1 - share) / (0.2 * stats["side"].size))
    assert "The posterior has 2 modes" in tree.attrs["message"]
    assert tree["calibration"]["r_hat"].max() < 1.05
    assert tree["calibration"]["sd"].sel(bias_label="b1.position_y") > 2.0
    verdicts = probcal.assess(problem, tree)["verdict"].to_dataset()
    assert verdicts["verdict"].sel(bias_label="b1.position_y").item() == "weak"
    alike = verdicts.sel(bias_label="b1.position_x")
    assert alike["verdict"].item() == "determined" or tree.attrs["status"] == "not converged"
    assert not any("touches" in text for text in verdicts["reason"].values)  # the target never comes near the line


@dataclass(frozen=True)
class Stub:
    """As much of an answer as a comparison of sides reads; it stands at a number."""

    at: float
    objective: float
    status: Status = Status.CONVERGED
    mirrors: tuple = ()
    message: str = ""
    motion: str = "used"
    optima: tuple = ()
    best: int = 0
    trace: tuple = (0.0,)
    prior = None
    problem = SimpleNamespace(untilted=SimpleNamespace(model=None))
    method: object = None
    interrupted: bool = False
    noted = Answer.noted

    @property
    def posterior(self):
        mean = np.full(1, self.at)
        return SimpleNamespace(sound=True, point=SimpleNamespace(z=mean), summary=SimpleNamespace(mean=mean))


def beside_others(monkeypatch, sides, ends, method=None):
    """What is made of sides (name, place, gain; the best first, where one is better) if fits from places end so."""
    others = tuple(Mirrored(name, gain, SimpleNamespace(z=np.full(1, at)), np.zeros(1)) for name, at, gain in sides[1])
    found = Sides(SimpleNamespace(z=np.zeros(1)), False, others)
    if sides[0]:
        name, at, gain = sides[0]
        found = Sides(SimpleNamespace(z=np.full(1, at)), True, others, name, gain)
    monkeypatch.setattr(solve, "other_sides", lambda *_: found)
    monkeypatch.setattr(solve, "reach", lambda _, a, b: max(float(abs(a.z - b.z)[0]), 0.003))
    monkeypatch.setattr(
        solve, "new", lambda _, point, known, size: all(abs(point.z - o.z)[0] > 0.1 * size for o in known)
    )

    def answer(problem, prior, point, context):
        end = ends[float(point.z[0])]
        if end is None:
            raise probcal.FitError("nothing there")
        return end

    first = Stub(0.0, 100.0, method=method)
    climb = SimpleNamespace(mode=None, _replace=lambda **_: None)
    context = SimpleNamespace(monitor=Monitor())
    monkeypatch.setattr(solve.SideClimb, "on", lambda *_: climb)
    return solve._beside_mirrors(first, SimpleNamespace(answer=answer, engine="dense"), context)


def listed(found):
    return [(other.name, round(other.gain, 6), float(other.shift[0])) for other in found.mirrors]


@pytest.mark.parametrize(("lost", "mentioned"), [(5.0, [("across", -5.0, 4.0)]), (20.0, [])])
def test_a_side_that_the_prior_likes_less_is_mentioned(monkeypatch, lost, mentioned):
    found = beside_others(monkeypatch, (("across", 4.0, 2.0), []), {4.0: Stub(4.0, 100.0 - lost)})
    assert found.at == 0.0
    assert listed(found) == mentioned


def test_the_best_answer_of_the_method_is_taken_and_the_others_are_seen_from_it(monkeypatch):
    """One beside the best side is the place of the answer itself; one comes back there; one is far below."""
    others = [("back", 0.001, -2.0), ("scene", 9.0, 0.0), ("piece", 6.0, -1.0), ("far", 5.0, -5.5)]
    ends = {
        4.0: Stub(4.0, 101.0), 0.001: Stub(0.0, 100.0), 9.0: Stub(9.0, 104.0), 6.0: Stub(1e-5, 100.0),
    }  # fmt: skip
    found = beside_others(monkeypatch, (("across", 4.0, 2.0), others), ends)
    assert found.at == 9.0
    assert found.motion == "used"
    assert listed(found) == [("across", -3.0, -5.0), ("scene", -4.0, -9.0), ("far", -7.5, -4.0)]


def test_an_answer_that_did_not_converge_takes_no_ones_place(monkeypatch):
    ends = {4.0: Stub(4.0, 103.0, Status.NOT_CONVERGED)}
    found = beside_others(monkeypatch, (None, [("across", 4.0, 0.0)]), ends)
    assert found.at == 0.0
    assert listed(found) == [("across", 3.0, 4.0)]


def test_sides_without_a_factor_are_compared_by_their_density(monkeypatch):
    """The evidences differ by what their estimates are off."""
    ends = {4.0: Stub(4.0, 97.0, method=probcal.MAP(engine="iterative"))}
    found = beside_others(monkeypatch, (None, [("across", 4.0, 0.0)]), ends, probcal.MAP(engine="iterative"))
    assert listed(found) == [("across", 0.0, 4.0)]


def test_an_answer_stands_where_no_fit_comes_from_a_better_place(monkeypatch):
    found = beside_others(monkeypatch, (("pieces of tracks", 4.0, 2.0), []), {4.0: None})
    assert found.at == 0.0
    assert found.mirrors == ()
    assert "another place fits better (pieces of tracks), from which no fit came" in found.message


def test_a_further_answer_that_no_fit_confirms_is_kept_as_it_was_found(monkeypatch):
    found = beside_others(monkeypatch, (None, [("across", 4.0, -0.5)]), {4.0: None})
    assert listed(found) == [("across", -0.5, 4.0)]


@pytest.mark.slow
def test_chains_on_two_sides_are_judged_where_the_reported_answer_lies():
    """Not between the sides, where no datum fits."""
    problem, _ = networks.setting(0, "line", share=1.0)
    tree = probcal.fit(problem, probcal.NUTS(chains=2, warmup=50, draws=60), prior=probcal.Gaussian())
    here, there = tree["mode/track/target"]["position"].values[:2, :, 1]
    assert np.ptp(tree["sample_stats"]["side"].values) == 1
    assert np.abs(here).max() > 15.0
    np.testing.assert_allclose(here, -there, atol=1.0)
    assessed = probcal.assess(problem, tree)
    assert set(assessed["verdict"]["verdict"].values) <= {"weak", "determined"}
    assert not any("innovations" in sentence for sentence in assessed["finding"]["sentence"].values)
