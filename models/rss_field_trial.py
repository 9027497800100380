"""Twelve nodes with a microphone and a geophone each, and two vehicles that pass: the field trial of the RSS paper.

A simulated twin: a motorcycle (MC) and a four-wheeled vehicle (FW) drive the same track at 30 km/h, levels at 2 Hz, the
ten seconds from 20 to 30 s used. Exponents and noises are those of Table 2 and Figure 7 (each vehicle and sensor its
own; variances 9.24, 14.9, 4.46, 6.98 dB^2), gains of the nodes 2 dB. What the paper leaves open: places, path,
source levels, gains.

The whole paper runs on it: `power_law` for M0, M1, M2 with the track known, `localise` and `track_snapshots` for single
instants, `bound_map` for the design. And what the paper lacks: `problem()` declares the same physics as sensors,
so that `probcal fit` finds the track, the gains, the exponents and displaced nodes together.

    probcal fit models/rss_field_trial.py --out trial
"""

from functools import cache

import jax.numpy as jnp
import numpy as np
import pandas as pd

from probcal import (
    Bias,
    Channel,
    ConstantVelocity,
    Network,
    Node,
    Problem,
    RandomWalk,
    Simulation,
    Target,
    Truth,
    sensor,
)
from probcal.geometry import norm

NODES = np.array([
    (-95.0, 60.0), (-60.0, 145.0), (-30.0, 10.0), (0.0, 95.0), (20.0, -20.0), (35.0, 165.0),
    (65.0, 70.0), (95.0, 5.0), (115.0, 120.0), (140.0, 190.0), (165.0, 50.0), (190.0, 135.0),
])  # fmt: skip
SPEED = 30 / 3.6  # m/s
WINDOW = (20.0, 30.0)  # s that are used
RATE = 2.0  # Hz
EXPONENT = {"FW": (2.6, 2.8), "MC": (2.6, 3.4)}  # microphone, geophone
STD = {"FW": (3.04, 2.11), "MC": (3.86, 2.64)}  # dB
POWER = {"FW": (84.0, 88.0), "MC": (81.5, 101.0)}  # dB at 1 m
GAIN = 2.0  # dB, of the nodes
PLACED = 0.5  # m, survey of the nodes
CLOSE = 1e-3  # m


def _law(target, pose, power, gain, exponent):
    """Level by the distance power law (RSS paper 4e)."""
    return power + gain - 10 * exponent * jnp.log10(jnp.maximum(norm(target.position - pose.position), CLOSE))


def kinds(vehicle):
    """Microphone and geophone with the noise of a vehicle; nominal exponent 2.5, of which nothing better is known."""

    @sensor(sound_level=Channel("dB", std=STD[vehicle][0]))
    def trial_microphone(target, pose, *, gain=Bias("dB", GAIN), exponent=Bias("1", 0.7, nominal=2.5, shared="type")):
        """Log energy of a microphone."""
        return dict(sound_level=_law(target, pose, target.sound_power, gain, exponent))

    @sensor(ground_level=Channel("dB", std=STD[vehicle][1]))
    def trial_geophone(target, pose, *, gain=Bias("dB", GAIN), exponent=Bias("1", 0.7, nominal=2.5, shared="type")):
        """Log energy of a geophone."""
        return dict(ground_level=_law(target, pose, target.ground_power, gain, exponent))

    return trial_microphone, trial_geophone


def network(vehicle="FW"):
    """Twelve nodes with both sensors each."""
    both = kinds(vehicle)
    nodes = [Node(f"node_{k}", place, survey=PLACED) for k, place in enumerate(NODES, start=1)]
    return Network([kind.on(n, name=f"{n.name}_{kind.name.removeprefix('trial_')}") for n in nodes for kind in both])


def path(time):
    """Track of the vehicles (T, 2): along the nodes, with a bend."""
    along = SPEED * (np.asarray(time) - 25.0)
    return np.stack([50.0 + along, 82.0 + 0.25 * along + 6.0 * np.sin(along / 22.0)], 1)


def motion():
    """A vehicle on open ground; its source levels are all but constant over a passage."""
    own = ConstantVelocity(0.7) + RandomWalk("sound_power", "dB", 0.1, (85.0, 20.0))
    return own + RandomWalk("ground_power", "dB", 0.1, (90.0, 20.0))


def times():
    """Times of the levels in s."""
    return np.arange(WINDOW[0], WINDOW[1], 1 / RATE)


@cache
def scenario(key=0, vehicle="FW"):
    """Table and truth of one passage: gains drawn, the rest as printed."""
    rng = np.random.default_rng(1000 + key)
    own, time = network(vehicle), times()
    place, rows, biases = path(time), [], {}
    for kind, name, k in (("microphone", "sound_level", 0), ("geophone", "ground_level", 1)):
        for n, node in enumerate(NODES, start=1):
            gain = GAIN * rng.standard_normal()
            distance = np.linalg.norm(place - node, axis=1)
            level = POWER[vehicle][k] + gain - 10 * EXPONENT[vehicle][k] * np.log10(distance)
            rows.append(pd.DataFrame({
                "time": time, "sensor": f"node_{n}_{kind}",
                name: level + STD[vehicle][k] * rng.standard_normal(len(time)),
            }))  # fmt: skip
            biases[f"node_{n}_{kind}.gain"] = float(gain)
        biases[f"trial_{kind}.exponent"] = EXPONENT[vehicle][k] - 2.5
    biases |= {b.label: 0.0 for b in own.biases if b.component == "position"}
    tracks = pd.DataFrame({"time": time, "target": "target", "position_x": place[:, 0], "position_y": place[:, 1]})
    return Simulation(pd.concat(rows, ignore_index=True), Truth(tracks, biases))


def problem(data=None, run=0, vehicle="FW"):
    """The twelve nodes with a table (columns time, sensor, sound_level, ground_level), or with that of a run."""
    rows = scenario(run, vehicle).table if data is None else data
    return Problem(network(vehicle), Target(motion()), rows)


def truth(data=None, run=0, vehicle="FW"):
    """What a passage was simulated with."""
    return scenario(run, vehicle).truth if data is None else Truth()
