"""Trajectories as one value, and the loops over state layouts, blocks and targets, against plain NumPy."""

import pickle

import jax
import numpy as np
import pytest
from worlds import linear, resting, small, two_motions

from probcal.gaussian.mode import Point, driven_states
from probcal.model.trajectories import Trajectories

WORLDS = ("plane", "space", "mixed", "drifting", "two")


@pytest.fixture(autouse=True)
def double_precision():
    with jax.enable_x64(True):
        yield


def problem_of(name):
    """A world; "two" has two targets of different state layouts, seen at different times."""
    if name != "two":
        return linear(name)[0]
    whole = small(motion=two_motions, scans=9)
    return whole.select(np.delete(np.arange(len(whole.measurements.time)), [4, 5, 11]))


def drawn(problem):
    """A point of random states and noises."""
    rng, start = np.random.default_rng(1), resting(problem)
    return jax.tree.map(lambda leaf: rng.normal(size=np.shape(leaf)), start)


@pytest.mark.parametrize("name", WORLDS)
def test_tracks_are_the_rows_of_states_by_the_targets_and_times_of_the_table(name):
    problem = problem_of(name)
    point, data = drawn(problem), problem.measurements
    seen, rows = [], 0
    for target, time, states, place in problem.tracks(point.states, problem.positions(point.states)):
        owner = data.target == data.target_names.index(target)
        static = len(time) < len(np.unique(data.time[owner]))  # a target that rests has one epoch
        assert static or time.tolist() == np.unique(data.time[owner]).tolist()
        layout = next(e for e in problem.epochs if target in e.target)
        columns = [j for j, c in enumerate(layout.components) if c.startswith("position")]
        assert place.tolist() == states[:, columns].tolist()
        seen.append(target)
        rows += len(states)
        r = problem.epochs.index(layout)
        own = [x for x, who in zip(point.states[r], layout.target, strict=True) if who == target]
        assert states.tolist() == np.array(own).tolist()
    assert sorted(seen) == sorted(data.target_names)
    assert rows == sum(len(e.time) for e in problem.epochs)


def test_tracks_take_pytrees_of_arrays():
    problem = problem_of("two")
    parts = {target: part for target, _, part in problem.tracks(problem.model.recursions)}
    assert set(parts) == {"one", "two"}
    for part in parts.values():
        assert part.first.tolist() == [True] + [False] * (len(part.time) - 1)


@pytest.mark.parametrize("name", WORLDS)
def test_sums_by_target_are_those_of_loops(name):
    problem = problem_of(name)
    model, point = problem.model, drawn(problem)
    sums = jax.jit(lambda states: model.by_target(states))(point.states)
    for r, part in enumerate(model.recursions):
        for t in range(model.targets[r]):
            whole = np.asarray(point.states[r])[np.asarray(part.target) == t].sum(0)
            np.testing.assert_allclose(sums[r][t], whole, rtol=1e-12)


@pytest.mark.parametrize("name", WORLDS)
def test_states_are_those_that_noises_drive_one_epoch_after_the_other(name):
    problem = problem_of(name)
    model, levels = problem.model, np.full(len(problem.levels), 0.3)
    noises = drawn(problem).noises
    driven = jax.jit(lambda noises: model.each(lambda p, u: driven_states(p, levels, u), noises))
    for part, u, states in model.each_layout(noises, driven(noises)):
        x, scale = np.zeros(u.shape[1]), np.append(np.exp(levels), 1.0)[np.asarray(part.level)]
        F, drift, L, u = (np.asarray(own) for own in (part.F, part.drift, part.L, u))
        for e in range(len(u)):
            x = F[e] @ x + drift[e] + L[e] @ (scale[e] * u[e])
            np.testing.assert_allclose(states[e], x, rtol=1e-9, atol=1e-9 * np.abs(x).max())


def test_blocks_come_with_their_rows_and_what_belongs_to_them():
    problem = problem_of("mixed")
    model = problem.model
    found = list(model.each_block(problem.row_index, problem.columns))
    assert [block for block, *_ in found] == list(model.blocks)
    for block, rows, r, index, columns in found:
        assert rows.y.shape == (len(index), len(columns)) == (len(index), len(block.channels))
        time = np.asarray(model.recursions[r].time)[np.asarray(rows.epoch)]
        if len(np.unique(time)) > 1:
            assert time.tolist() == problem.measurements.time[index].tolist()


def test_loops_take_one_entry_per_layout_or_block():
    problem = problem_of("two")
    model = problem.model
    assert model.each(lambda part, k: (k, part.drift.shape[1]), "ab") == (("a", 4), ("b", 6))
    for call in (lambda: model.each(lambda part, k: k, "a"), lambda: list(model.each_block([0] * 9))):
        with pytest.raises(ValueError, match="zip"):
            call()


def test_trajectories_map_layout_by_layout():
    problem = problem_of("two")
    tracks = drawn(problem).trajectories
    moved = tracks.map(lambda x, u, by: (x + by, by * u), (1.0, 2.0))
    for r, by in enumerate((1.0, 2.0)):
        np.testing.assert_array_equal(moved.states[r], tracks.states[r] + by)
        np.testing.assert_array_equal(moved.noises[r], tracks.noises[r] * by)
    assert float(tracks.square) == pytest.approx(sum((u**2).sum() for u in tracks.noises))


def test_a_point_is_made_of_three_fields_or_of_four():
    point = drawn(problem_of("two"))
    states, noises = point.trajectories
    for other in (
        Point(states, noises, point.z, point.levels),
        Point(Trajectories(states, noises), point.z, point.levels),
        point._replace(noises=(0, 0), z=0)._replace(states=states, noises=noises, z=point.z),
        jax.tree.unflatten(jax.tree.structure(point), jax.tree.leaves(point)),
        pickle.loads(pickle.dumps(point)),
    ):
        assert type(other) is Point
        assert jax.tree.structure(other) == jax.tree.structure(point)
        assert all(a is b or np.array_equal(a, b) for a, b in zip(*map(jax.tree.leaves, (other, point)), strict=True))
