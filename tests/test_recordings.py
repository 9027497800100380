"""Real recordings: what a fit finds against what is known. They lie beside the project and are skipped where not.

`uv run pytest tests/test_recordings.py -n 0 -s -m slow` prints the figures.
"""

import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import probcal
from probcal import EA

sys.path.insert(0, str(Path(__file__).parents[1] / "models"))
import bearing_beacons
import ble_office
import receivers
import robots
import sflab
import tdoa_flight

pytestmark = pytest.mark.slow
DATA = Path(__file__).parents[2] / "shared" / "data"


def say(what, found):
    print(f"\n{what}: " + ", ".join(f"{name} {value:.2f}" for name, value in found.items()))


def recording(name):
    if not (DATA / name).exists():
        pytest.skip(f"the recording {name} is not here")
    return DATA / name


def displaced(tree, truth, nodes, axes):
    """Distance in m of every node's calibrated place from the true one."""
    mean = tree["calibration"]["mean"].to_series()
    error = {n: [mean[f"{n}.position_{a}"] - truth.biases.get(f"{n}.position_{a}", 0.0) for a in axes] for n in nodes}
    return {node: float(np.linalg.norm(e)) for node, e in error.items()}


def fit_sflab(swap, starts=1, prior=None):
    data = recording("sflab_mic_toa/dataset_1_exp2.mat")
    tree = probcal.fit(sflab.problem(data, swap), EA(), prior=prior, starts=starts)
    assert tree.attrs["status"] == "converged"
    found = displaced(tree, sflab.truth(data, swap), [f"mic_{n}" for n in range(1, 9)], "xy")
    evidence = f"log evidence under declared scales {tree.attrs.get('log_evidence_declared', np.nan):.1f}"
    say(f"sflab, swap {swap}, {starts} start(s), prior {prior or 'ARD()'}, {evidence}, m from its place", found)
    return found, tree


def test_a_swap_of_two_microphones_is_found_and_none_is_made_up():
    found, _ = fit_sflab((5, 8))
    assert max(found["mic_5"], found["mic_8"]) < 0.15
    found, tree = fit_sflab(None)
    assert max(found.values()) < 0.3
    listed = probcal.outliers(tree)
    assert 0.1 < len(listed) / tree["residual"].sizes["datum"] < 0.3, "the echoes: 14 to 24 % of each microphone"


@pytest.mark.parametrize("swap", [(1, 4), (1, 2), (3, 6)])
def test_a_swap_across_the_room_needs_one_start(swap):
    """Exchanged microphones are tried by the start itself; no prior or further start has to ask for it."""
    found, _ = fit_sflab(swap)
    assert max(found.values()) < 0.35


@pytest.mark.parametrize("swap", [(1, 5), (1, 4), (2, 3)])
def test_a_strict_prior_by_node_finds_swaps_across_the_room_and_nothing_else(swap):
    found, _ = fit_sflab(swap, starts=6, prior=sflab.PRIOR)
    assert max(found.values()) < 0.2


def headings(tree):
    mean = np.rad2deg(tree["calibration"]["mean"].to_series())
    found = {n: mean[f"robot_{n}.heading"] for n in range(1, 6)}
    say("headings of the robots in deg", found)
    return found


def test_robots_know_their_headings():
    data = recording("mrclam/MRCLAM_Dataset6")
    plain = headings(probcal.fit(robots.problem(data), EA()))
    # regression of the bearings on the motion capture, in deg: the heading bias is minus the bearing bias
    assert plain[4] == pytest.approx(0.81, abs=0.15)
    turned = robots.problem(data, turn={"robot_2": np.deg2rad(5.0)})
    found = headings(probcal.fit(turned, EA()))
    assert plain[2] - found[2] == pytest.approx(5.0, abs=0.15)


def test_a_turned_robot_is_determined_before_and_after_the_fit():
    data = recording("mrclam/MRCLAM_Dataset6")
    problem = robots.problem(data)
    before = probcal.observability(problem)
    assert before["bias"]["verdict"].sel(bias_label="robot_4.heading").item() == "determined"
    tree = probcal.assess(problem, probcal.fit(problem, EA()))
    row = probcal.summary(tree).set_index("bias").loc["robot_4.heading"]
    assert row["verdict"] == "determined"
    assert abs(row["mean"]) > 5 * row["sd"], "determined and biased"
    print(f"\nrobot_4.heading {np.rad2deg(row['mean']):.2f} deg, {row['verdict']}: {row['reason']}")


def test_delays_of_receivers_repeat_over_sets():
    """Delays of the larger group of receivers, a shift common to it apart (nobody can know it), set by set."""
    delays = {}
    for number in range(1, 5):
        path = recording(f"mlat_locards/set_{number}.csv")
        problem = receivers.problem(path)
        tree = probcal.fit(problem, EA())
        assert tree.attrs["status"] == "converged"
        group = pd.Series(receivers.groups(receivers.messages(path)[0]))
        members = group.index[group == group.mode()[0]]
        mean = tree["calibration"]["mean"].to_series().to_dict() | problem.fixed
        delays[number] = pd.Series({n: mean[f"receiver_{n}.delay"] for n in members if f"receiver_{n}.delay" in mean})
    for number in (2, 3, 4):
        apart = (delays[number] - delays[1]).dropna()
        assert len(apart) >= 10
        left = apart - apart.mean()
        say(f"receivers, set {number} against set 1, m", {"rms": np.sqrt(np.mean(left**2)), "worst": left.abs().max()})
        assert np.sqrt(np.mean(left**2)) < 10.0


def test_swapped_anchors_of_a_flight_are_found():
    data, swap = recording("uwb_tdoa"), (3, 4)
    problem = tdoa_flight.problem(data, swap)
    tree = probcal.fit(problem, EA(), prior=tdoa_flight.PRIOR)
    assert tree.attrs["status"] == "converged"
    truth = tdoa_flight.truth(data, swap)
    found = displaced(tree, truth, [f"anchor_{n}" for n in range(8)], "xyz")
    say(f"flight, anchors {swap} swapped, m from its place", found)
    assert max(found.values()) < 0.3
    scores = probcal.scores(tree, truth)
    say("flight", scores)
    assert scores["position_rmse_after"] < 0.5 * scores["position_rmse_before"]


@pytest.mark.parametrize("settings", [{}, {"heading": "any"}, {"heading": "any", "beacons_are": "open"}], ids=str)
def test_turned_detectors_are_found_by_bearings_alone(settings):
    """About 5 and 3 degrees at two of nine places, each within 3 of its own sds, the others within 2.5 degrees."""
    data = recording("roh_bearing")
    tree = probcal.fit(bearing_beacons.problem(data, **settings), EA())
    assert tree.attrs["status"] == "converged"
    group = tree["calibration"].to_dataset()
    turn = group.where(group["component"] == "heading", drop=True)
    mean, sd = (np.rad2deg(turn[k].to_series()) for k in ("mean", "sd"))
    truth = np.rad2deg(pd.Series(bearing_beacons.truth(data).biases))
    if "beacons_are" not in settings:
        say("turn in deg", mean)
    off = (mean - truth.reindex(mean.index)).dropna()
    assert len(off) >= 2
    assert (off.abs() < 3 * sd[off.index]).all()


def test_gains_learnt_on_three_walks_place_the_beacon_on_others():
    """Mean RMSE over two other walks below that of nominal gains and exponent; the exponent is that of free space."""
    data = recording("ble_rss")
    tree = probcal.fit(ble_office.problem(data), EA(), prior=ble_office.PRIOR)
    assert tree.attrs["status"] == "converged"
    exponent = tree["calibration"].to_dataset().sel(bias_label="receiver.exponent")
    assert abs(float(exponent["mean"])) < 0.3
    errors = []
    for walk in ble_office.OTHERS:
        later = probcal.track(ble_office.problem(data, walks=walk), tree)
        found = probcal.scores(later, ble_office.truth(data, walks=walk))
        say(walk, found)
        errors.append((found["position_rmse_before"], found["position_rmse_after"]))
    before, after = np.mean(errors, 0)
    assert after < 0.95 * before
