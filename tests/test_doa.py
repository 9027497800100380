"""Directions alone: modified coordinates against exact paths, similar triangles, and arrays put together."""

import numpy as np
import pytest

from probcal import InputError
from probcal.doa import bearing_track, match, similarity, turn_of
from probcal.doa.modified import step

STD = np.deg2rad(1.0)
PLACES = np.array([(0.0, 0.0), (120.0, 30.0), (200.0, -60.0), (60.0, -110.0), (-80.0, 40.0)])
TIME = 0.5 * np.arange(200)


def wrapped(angle):
    return (angle + np.pi) % (2 * np.pi) - np.pi


def angles_of(path):
    azimuth = np.arctan2(path[:, 1], path[:, 0])
    return azimuth if path.shape[1] == 2 else np.stack([azimuth, np.arctan2(path[:, 2], np.hypot(*path.T[:2]))], 1)


def modified(place, velocity):
    """Modified spherical coordinates of a target, by their definition."""
    r = np.linalg.norm(place)
    b, e = np.arctan2(place[1], place[0]), np.arcsin(place[2] / r)
    along = np.array([-np.sin(b), np.cos(b), 0.0])
    up = np.array([-np.sin(e) * np.cos(b), -np.sin(e) * np.sin(b), np.cos(e)])
    return np.array([velocity @ along / r, velocity @ up / r, velocity @ place / r**2, b, e, 1 / r])


@pytest.mark.parametrize("seed", range(5))
def test_a_step_is_that_of_a_straight_path(seed):
    rng = np.random.default_rng(seed)
    place, velocity, dt = rng.normal(size=3) * 30, rng.normal(size=3) * 5, 1.7
    found, slope = step(modified(place, velocity), dt)
    there = modified(place + dt * velocity, velocity)
    there[3] = found[3] + wrapped(there[3] - found[3])
    np.testing.assert_allclose(found, there, atol=1e-12)
    numeric = np.zeros((6, 6))
    x = modified(place, velocity)
    for k in range(6):
        h = 1e-6 * np.eye(6)[k]
        numeric[:, k] = (step(x + h, dt)[0] - step(x - h, dt)[0]) / 2e-6
    np.testing.assert_allclose(slope, numeric, atol=1e-7)


def test_a_step_in_the_plane_is_the_printed_one():
    """Aidala and Hammel 1983, as written out in `papers/README.md`."""
    y1, y2, y3, y4, T = 0.03, -0.02, 0.7, 0.01, 2.5
    D = (1 + T * y2) ** 2 + (T * y1) ** 2
    printed = [y1 / D, (y2 + T * (y1**2 + y2**2)) / D, y3 + np.arctan2(T * y1, 1 + T * y2), y4 / np.sqrt(D)]
    found, _ = step(np.array([y1, 0.0, y2, y3, 0.0, y4]), T)
    np.testing.assert_allclose(found[[0, 2, 3, 5]], printed, atol=1e-14)
    assert found[1] == found[4] == 0.0


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_track_without_noise_is_exact_up_to_scale(dimension):
    path = np.array([700.0, -600.0, 50.0])[:dimension] + np.outer(TIME, np.array([-25.0, 25.0, 10.0])[:dimension])
    found = bearing_track(TIME, angles_of(path), 1e-6)
    np.testing.assert_allclose(found.place * np.linalg.norm(path[0]), path, atol=1e-3)
    given = bearing_track(TIME, angles_of(path), 1e-6, distance=float(np.linalg.norm(path[0])))
    np.testing.assert_allclose(given.place, path, atol=1e-3)


def test_the_covariance_of_a_track_is_that_of_its_errors():
    """Errors of a straight path, of 300 runs, over the printed covariance: chi-square of 2 at the last time."""
    path = np.array([-200.0, 100.0]) + np.outer(np.arange(40.0), [10.0, 10.0])
    size, errors, spread = np.linalg.norm(path[0]), [], []
    for seed in range(300):
        noisy = angles_of(path) + STD * np.random.default_rng(seed).standard_normal(40)
        found = bearing_track(np.arange(40.0), noisy, STD, gamma=10.0)
        errors.append(found.place[-1] * size - path[-1])
        spread.append(found.spread[-1] * size**2)
    worth = [e @ np.linalg.solve(S + 1e-9 * np.eye(2), e) for e, S in zip(errors, spread, strict=True)]
    assert 1.6 < np.mean(worth) < 2.5


@pytest.mark.parametrize("dimension", [2, 3])
def test_process_noise_and_gaps_are_smoothed_too(dimension):
    rng = np.random.default_rng(3)
    velocity = np.array([6.0, -1.5, 0.4])[:dimension] + np.cumsum(0.1 * rng.standard_normal((200, dimension)), 0)
    path = np.array([-300.0, 150.0, 80.0])[:dimension] + np.cumsum(0.5 * velocity, 0)
    angles = angles_of(path) + 0.2 * STD * rng.standard_normal((200, 2) if dimension == 3 else 200)
    angles[40:60] = np.nan
    rough = bearing_track(TIME, angles, 0.2 * STD)
    found = bearing_track(TIME, angles, 0.2 * STD, noise=0.15, distance=float(np.linalg.norm(path[0])))
    assert found.cost < 0.5 * rough.cost
    assert np.linalg.norm(found.place - path, axis=1).mean() < 0.15 * np.linalg.norm(path, axis=1).mean()


def test_the_printed_filter_removes_the_bias_of_the_range():
    """Without the second-order term the filtered 1/r of the 3-D case is off; the smoother has no such bias."""
    path = np.array([1000.0, -500.0, 50.0]) + np.outer(0.3 * np.arange(300), [-25.0, 25.0, 25.0])
    true = np.linalg.norm(path[0]) / np.linalg.norm(path[-1])
    smooth = []
    for seed in range(20):
        noisy = angles_of(path) + STD * np.random.default_rng(seed).standard_normal((300, 2))
        smooth.append(np.linalg.norm(bearing_track(0.3 * np.arange(300), noisy, STD).place[-1]) * true)
        for remove in (True, False):
            run = bearing_track(0.3 * np.arange(300), noisy, STD, smooth=False, remove_bias=remove)
            assert np.isfinite(run.state).all()
    assert abs(np.mean(smooth) - 1.0) < 0.01


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_similarity_is_recovered_and_weighed(dimension):
    rng = np.random.default_rng(0)
    moved = rng.normal(size=(30, dimension))
    turn = np.linalg.qr(rng.normal(size=(dimension, dimension)))[0]
    turn[:, 0] *= np.sign(np.linalg.det(turn))
    fixed = np.arange(1.0, dimension + 1) + 2.5 * moved @ turn.T
    found = similarity(moved, fixed)
    np.testing.assert_allclose(found.position, np.arange(1.0, dimension + 1), atol=1e-10)
    np.testing.assert_allclose(found.rotation, turn, atol=1e-10)
    assert found.determined
    assert abs(found.scale - 2.5) < 1e-10
    spread = np.broadcast_to(1e-4 * np.eye(dimension), (30, dimension, dimension)).copy()
    wrong = fixed.copy()
    wrong[7] += 5.0
    spread[7] *= 1e8
    np.testing.assert_allclose(similarity(moved, wrong, None, spread).position, found.position, atol=1e-3)


def test_the_plane_is_that_of_complex_numbers():
    rng = np.random.default_rng(1)
    B, A = (rng.normal(size=20) + 1j * rng.normal(size=20) for _ in range(2))
    A = 0.2 * A + (1 + 2j) + 1.5 * np.exp(0.4j) * B
    g = np.sum(np.conj(B - B.mean()) * (A - A.mean())) / np.sum(np.abs(B - B.mean()) ** 2)
    found = similarity(np.stack([B.real, B.imag], 1), np.stack([A.real, A.imag], 1))
    assert abs(found.scale - abs(g)) < 1e-10
    assert abs(np.arctan2(found.rotation[1, 0], found.rotation[0, 0]) - np.angle(g)) < 1e-10
    s = A.mean() - g * B.mean()
    np.testing.assert_allclose(found.position, [s.real, s.imag], atol=1e-10)


def test_one_straight_path_in_space_leaves_a_turn_open():
    line = np.outer(np.linspace(0, 1, 10), [1.0, 2.0, 0.5])
    weight = np.ones(10)
    assert not turn_of([(line, line, weight)])[1]
    assert turn_of([(line, line, weight)], level=True)[1]
    other = np.outer(np.linspace(0, 1, 10), [-1.0, 1.0, 0.0])
    assert turn_of([(line, line, weight), (other, other, weight)])[1]


def seen(run, targets, sensors=range(5), noise=STD):
    """Bearings of straight paths in each sensor's own axes, and the headings."""
    rng = np.random.default_rng(run)
    headings, tracks = rng.uniform(-np.pi, np.pi, 5), {}
    for name, (start, velocity, who) in targets.items():
        path = np.array(start) + np.outer(TIME, velocity)
        for k in sensors if who is None else who:
            line = path - PLACES[k]
            angle = np.arctan2(line[:, 1], line[:, 0]) - headings[k] + noise * rng.standard_normal(len(TIME))
            tracks[f"s{k}", name] = bearing_track(TIME, angle, STD)
    return headings, tracks


def errors(array, headings, unit):
    """Errors of places in m and of headings in rad, in the axes of sensor 0."""
    c, s = np.cos(headings[0]), np.sin(headings[0])
    frame = np.array([[c, -s], [s, c]])
    place = [np.linalg.norm(unit * frame @ array.position[f"s{k}"] - PLACES[k]) for k in range(5)]
    turn = [np.arctan2(array.rotation[f"s{k}"][1, 0], array.rotation[f"s{k}"][0, 0]) for k in range(5)]
    return max(place), np.abs(wrapped(np.array(turn) - headings + headings[0])).max()


@pytest.mark.parametrize("run", range(6))
def test_five_sensors_of_any_heading_are_placed(run):
    headings, tracks = seen(run, {"boat": ((-300.0, 150.0), (6.0, -1.5), None)})
    place, turn = errors(match(tracks, reference="s0"), headings, np.hypot(300.0, 150.0))
    assert place < 6.0
    assert turn < np.deg2rad(1.5)


def test_sensors_are_reached_through_others_and_targets_averaged():
    """Sensors 3 and 4 never see a target of sensor 0; another target brings both to the first two."""
    targets = {
        "west": ((-300.0, 150.0), (6.0, -1.5), (0, 1, 2)),
        "east": ((300.0, -200.0), (-5.0, 3.0), (1, 2, 3, 4)),
        "north": ((0.0, 250.0), (3.0, -4.0), (1, 3, 4)),
    }
    headings, tracks = seen(2, targets, noise=0.1 * STD)
    array = match(tracks, reference="s0")
    assert not array.lost
    assert set(array.track) == set(targets)
    place, turn = errors(array, headings, np.hypot(300.0, 150.0))
    assert place < 3.0
    assert turn < np.deg2rad(1.0)


def test_what_cannot_be_matched_is_said():
    t = TIME
    path = np.array([4.0, 3.0]) + np.outer(t, [0.1, -0.3])
    one = bearing_track(t, angles_of(path), STD)
    with pytest.raises(InputError, match="bearings of one sensor alone say nothing of places"):
        match({("a", "x"): one})
    with pytest.raises(InputError, match="has no track; give one of a, b"):
        match({("a", "x"): one, ("b", "x"): one}, reference="c")
    with pytest.raises(InputError, match="no two sensors see a target at a common time"):
        match({("a", "x"): one, ("b", "y"): one})
    with pytest.raises(InputError, match=r"bearing_track: times \(T,\) must increase"):
        bearing_track(t[::-1], angles_of(path), STD)
    with pytest.raises(
        InputError, match=r"bearing_track: angles are \(T,\) azimuths or \(T, 2\) azimuths and elevations, got"
    ):
        bearing_track(t, np.zeros((200, 3)), STD)
    with pytest.raises(InputError, match=r"1 bearing\(s\) give no track; give two or more"):
        bearing_track(t[:1], angles_of(path)[:1], STD)
    with pytest.raises(InputError, match=r"similarity: give two paths of one shape \(T, 2 or 3\)"):
        similarity(path, path[:10])
