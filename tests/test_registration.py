"""Two lists of tracks in frames of their own: the frame between them, its sds, rivals, and what is refused."""

import numpy as np
import pandas as pd
import pytest

from probcal import register_tracks
from probcal.errors import InputError

STD = 5.0


def lists(seed, clock=0.0, space=False, straight=False):
    """Five tracks of one list and five of the other, four the same; the frame of the second in the first."""
    rng = np.random.default_rng(seed)
    d, time = 3 if space else 2, np.arange(0.0, 120.0, 2.0)
    heading, position = rng.uniform(-np.pi, np.pi), rng.uniform(-3000, 3000, d)
    c, s = np.cos(heading), np.sin(heading)
    turn = np.eye(d)
    turn[:2, :2] = [[c, -s], [s, c]]
    first, second = [], []

    def track(name, at, places):
        noisy = places + STD * rng.standard_normal(places.shape)
        columns = {f"position_{axis}": noisy[:, k] for k, axis in enumerate("xyz"[:d])}
        return pd.DataFrame({"time": at, "track": name, **columns})

    for k in range(6):
        start, speed, bend = rng.uniform(-2000, 2000, d), rng.uniform(-15, 15, d), rng.normal(0, 0.05, d)
        if straight:
            speed, bend = np.array([7.0, 3.0, 0.0][:d]), np.zeros(d)

        def place(t, start=start, speed=speed, bend=bend):
            return start + np.outer(t, speed) + 0.5 * np.outer(t**2, bend)

        if k < 5:
            first.append(track(f"a{k}", time, place(time)))
        if k > 0:
            second.append(track(f"b{k}", time + 0.7 - clock, (place(time + 0.7) - position) @ turn))
    return pd.concat(first), pd.concat(second), heading, position


@pytest.mark.parametrize("space", [False, True], ids=["plane", "space"])
@pytest.mark.parametrize("clock", [0.0, 3.0])
def test_frames_clock_and_pairs_are_found_whatever_the_frames(space, clock):
    """Ten draws: the right four pairs; errors of all numbers have an rms of 0.7 to 1.4 of their sds."""
    z = []
    for seed in range(10):
        first, second, heading, position = lists(seed, clock, space)
        found = register_tracks(first, second, clock=2 * clock)
        assert found.sound
        assert set(zip(found.pairs["first"], found.pairs["second"], strict=True)) == {
            (f"a{k}", f"b{k}") for k in range(1, 5)
        }
        off = (found.heading - heading + np.pi) % (2 * np.pi) - np.pi
        z += [off / found.sd["heading"], *((found.position - position) / found.sd["position"])]
        if clock:
            z.append((found.clock - clock) / found.sd["clock"])
        moved = found.apply(second)
        one = moved[moved["track"] == "b1"]
        own = first[first["track"] == "a1"]
        near = np.interp(one["time"], own["time"], own["position_x"]) - one["position_x"]
        assert np.abs(near[5:-5]).max() < 6 * STD
    assert 0.7 < np.sqrt(np.mean(np.square(z))) < 1.4


def test_a_single_pair_of_tracks_is_not_relied_on():
    first, second, *_ = lists(0)
    one = register_tracks(first[first["track"] == "a1"], second[second["track"] == "b1"])
    assert len(one.pairs) == 1
    assert not one.sound


def test_tracks_that_are_all_alike_leave_rivals():
    """Straight tracks of one speed lie on each other in many ways: no confident frame."""
    first, second, *_ = lists(0, straight=True)
    one = register_tracks(first[first["track"].isin(["a1", "a2"])], second[second["track"].isin(["b1", "b3"])])
    assert one.rivals > 0
    assert not one.sound


@pytest.mark.parametrize(
    ("act", "said"),
    [
        (lambda a, b: register_tracks(a, b, cut=0.0), "give metres above 0 and seconds from 0"),
        (lambda a, b: register_tracks(a.drop(columns="time"), b), 'the first table has no column "time"'),
        (lambda a, b: register_tracks(a, b.iloc[:0]), "the second table has no rows"),
        (lambda a, b: register_tracks("nowhere.csv", b), "the first table cannot be read"),
        (lambda a, b: register_tracks(a.assign(position_z=0.0), b), "the other has not; give both or neither"),
        (lambda a, b: register_tracks(a, b.assign(time=b["time"] + 1e4)), "no two tracks share"),
    ],
)
def test_what_is_wrong_is_said(act, said):
    with pytest.raises(InputError) as caught:
        act(*lists(0)[:2])
    assert said in str(caught.value)
