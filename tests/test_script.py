"""The script of a user, `tests/data/script.py`: 40 lines from files to a report, nothing by hand."""

import runpy
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import probcal
from probcal import Channel, ConstantVelocity, Network, Node, sensor
from probcal.geometry import bearing, norm

pytest.importorskip("bokeh")
SCRIPT = Path(__file__).parent / "data" / "script.py"
TURN, SHIFT = 0.7, np.array([30.0, -20.0])  # of the frame in which the truth lives
PLACES = np.array([[0.0, 0.0], [60.0, 0.0], [30.0, 50.0]])
HEADINGS = np.array([0.3, -1.2, 2.0])


@sensor(range=Channel("m", std=0.5), azimuth=Channel("rad", std=0.005, wrap=True))
def scanner(target, pose):
    line = target.position - pose.position
    return {"range": norm(line), "azimuth": bearing(line) - pose.heading}


def rotation(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.moveaxis(np.array([[c, -s], [s, c]]), (0, 1), (-2, -1))


def record(folder):
    """Rows with jittered stamps, one mast turned by 0.06 rad, and a truth in another frame."""
    nodes = [
        Node(f"mast_{k}", *own, scale={"heading": 0.1}) for k, own in enumerate(zip(PLACES, HEADINGS, strict=True))
    ]
    time = 0.5 * np.arange(60)
    path = np.stack([30 + 25 * np.cos(time / 6), 25 + 20 * np.sin(time / 5)], 1)
    run = probcal.simulate(
        Network([scanner.on(node) for node in nodes]), ConstantVelocity(0.5), time, key=3,
        biases={"mast_0.heading": 0.0, "mast_1.heading": 0.06, "mast_2.heading": 0.0}, tracks={"target": path},
    )  # fmt: skip
    rows = run.table.frame if hasattr(run.table, "frame") else run.table
    jitter = np.random.default_rng(0).uniform(-0.05, 0.05, len(rows))
    rows.assign(time=rows["time"] + jitter).sort_values("time").to_csv(folder / "rows.csv", index=False)
    np.savez(folder / "masts.npz", places=PLACES, rotations=rotation(HEADINGS))
    there = path @ rotation(TURN).T + SHIFT
    pd.DataFrame({"time": time, "position_x": there[:, 0], "position_y": there[:, 1]}).to_csv(
        folder / "truth.csv", index=False
    )


@pytest.mark.slow
def test_a_script_of_forty_lines_does_it_all(tmp_path, monkeypatch, capsys):
    assert len(SCRIPT.read_text().splitlines()) <= 40
    record(tmp_path)
    monkeypatch.setattr(sys, "argv", ["script.py", str(tmp_path)])
    found = runpy.run_path(str(SCRIPT))
    tree = found["tree"]
    mean = tree["calibration"].to_dataset()["mean"].to_series()
    assert abs(mean["mast_1.heading"] - 0.06) < 0.01
    assert tree.attrs["position_rmse_after_rigid"] < 0.5
    assert tree.attrs["epoch_shift"] < 0.051
    out = capsys.readouterr().out
    assert "no change seen in 3 biases" in out
    assert "converged, 0." in out
    assert pd.read_csv(tmp_path / "tracks.csv").columns[:3].tolist() == ["time", "target", "position_x"]
    page = (tmp_path / "report.html").read_text()
    assert "laid on the truth as a rigid body" in page
