"""Ten radars and one passing target: scenario B of Paper B, C1 and C2 of Paper C, simulated.

C1: 100 scans of a sinusoidal path; C2: 25 scans of a straight one; B: 50 scans of half a wave. Biases: x and y of
each radar (10 m), its heading (10 deg; the bearing bias of Papers B 26 and C 43 is minus the heading bias) and its
range offset (10 m), a share of them non-zero. Radars stand at random in 500 x 500 m; range noise 10 m, azimuth
noise 10 deg. What the papers leave open: one scan a second, process noise 1 m s^-3/2, the paths below.

The command line uses C1 at share 0.3 on the layout of run 0. The study of the papers, methods side by side:

    probcal study models/radars.py --set scenario=C1,C2 --set share=0:1:0.1 --runs 20 --out radars-study
"""

from functools import cache

import jax
import numpy as np
import pandas as pd

from probcal import ConstantVelocity, Network, Node, Problem, Simulation, Target, Truth
from probcal.sensors import radar
from probcal.types import float64

RADARS = 10
AREA = 500.0  # m
NOISE = np.array([10.0, np.deg2rad(10.0)])  # range, azimuth
SCALES = {"position_x": 10.0, "position_y": 10.0, "range_offset": 10.0, "heading": np.deg2rad(10.0)}
SIGNS = np.array([-1.0, -1.0, 1.0, -1.0])  # Paper C moves the stated place and turns the bearing, not the radar
START = {"B": (10.0, 5.0), "C1": (2.5, 1.0), "C2": (2.5, 1.0)}  # std of the start: position in m, velocity in m/s
SCANS = {"B": 50, "C1": 100, "C2": 25}
SHARE = 0.3


def path(scenario="C1"):
    """True states (K, 4): position and velocity, one scan a second."""
    u = np.linspace(0, 1, SCANS[scenario])
    if scenario == "C1":
        position = np.stack([50 + 400 * u, 250 + 150 * np.sin(3 * np.pi * u)], 1)
    elif scenario == "C2":
        position = np.stack([100 + 300 * u, 150 + 200 * u], 1)
    else:
        position = np.stack([75 + 350 * u, 150 + 200 * np.sin(np.pi * u)], 1)
    return np.hstack([position, np.gradient(position, axis=0)])


@cache
@float64
def layout(seed=0):
    """Stated positions of the radars (10, 2) in m."""
    return np.asarray(jax.random.uniform(jax.random.split(jax.random.PRNGKey(seed), 4)[0], (RADARS, 2))) * AREA


def network(positions):
    """Radars at stated positions, each free to be displaced, turned and offset in range."""
    scale = {"position": SCALES["position_x"], "heading": SCALES["heading"]}
    return Network([radar.on(Node(f"radar_{n}", place, scale=scale)) for n, place in enumerate(positions)])


@cache
@float64
def target(scenario="C1", seed=0):
    """The target: constant velocity, q = 1 m s^-3/2, its start known as the papers say."""
    near, slow = START[scenario]
    drawn = np.asarray(jax.random.normal(jax.random.PRNGKey(1000 + seed), (4,)))
    mean = path(scenario)[0] + np.array([near, near, slow, slow]) * drawn
    return Target(ConstantVelocity(1.0), {"position": (mean[:2], near), "velocity": (mean[2:], slow)})


@cache
@float64
def draws(seed, scans):
    """What a run draws whatever its share: which biases there are, their sizes, and the noise of all scans."""
    _, choose, size, noise = jax.random.split(jax.random.PRNGKey(seed), 4)
    chosen, sizes = jax.random.uniform(choose, (RADARS, 4)), jax.random.normal(size, (RADARS, 4))
    return tuple(map(np.asarray, (chosen, sizes, jax.random.normal(noise, (scans, RADARS, 2)))))


def recording(positions, seed=0, share=SHARE, scenario="C1"):
    """Table and truth of one run, with the draws of the trial behind its reference figures (seeds 0-7)."""
    states = path(scenario)
    chosen, sizes, noise = draws(seed, len(states))
    biases = SIGNS * sizes * (chosen < share) * np.array(list(SCALES.values()))
    line = states[:, None, :2] - (positions + biases[:, :2])[None]
    true = np.stack([np.hypot(line[..., 0], line[..., 1]), np.arctan2(line[..., 1], line[..., 0])], -1)
    true += np.stack([biases[:, 2], -biases[:, 3]], -1)
    measured = true + NOISE * noise
    scans, radars = np.meshgrid(np.arange(len(states)), np.arange(RADARS), indexing="ij")
    names = [f"radar_{n}" for n in radars.ravel()]
    table = pd.DataFrame({"time": scans.ravel(), "sensor": names})
    table[["range", "azimuth"]] = measured.reshape(-1, 2)
    tracks = pd.DataFrame(states, columns=["position_x", "position_y", "velocity_x", "velocity_y"])
    tracks.insert(0, "time", np.arange(len(states)))
    labels = [f"radar_{n}.{name}" for n in range(RADARS) for name in SCALES]
    return Simulation(table, Truth(tracks, dict(zip(labels, biases.ravel().tolist(), strict=True))))


def setting(run=0, share=SHARE, scenario="C1"):
    """Problem and truth of one run of a study, layout included."""
    positions = layout(run)
    drawn = recording(positions, run, share, scenario)
    return Problem(network(positions), target(scenario, run), drawn.table), drawn.truth


def problem(data=None):
    """The network of run 0, with its own simulated table if none is given."""
    return Problem(network(layout()), target(), scenario().table if data is None else data)


def scenario(key=0):
    """Table and truth of one run on the layout of run 0."""
    return recording(layout(), key)


def truth(data=None):
    """Truth of run 0; a table written by `probcal simulate` brings its own beside it."""
    return scenario().truth if data is None else Truth()
