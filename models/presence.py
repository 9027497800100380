"""Presence sensors along a path, whose places are stated wrongly: calibrated from yes and no, simulated.

Twelve sensors on both sides of a way say once a second whether somebody is near: yes with probability 1/2 at 4 m, and
hardly ever beyond 8 m (a logistic curve of the distance). Three known posts measure the distance to 2 m, so that the
walkers' ways are roughly known. Each sensor's place is stated to 3 m; five walkers pass. A yes or a no tells
no number, so that no Gaussian stands for the walker or for the sensor: particle Gibbs is exact.

    probcal fit models/presence.py --method particle-gibbs --prior gaussian --out presence
"""

from functools import cache

import numpy as np

from probcal import Channel, ConstantVelocity, Network, Node, Problem, Target, Truth, sensor, simulate
from probcal.geometry import norm
from probcal.noise import Bernoulli

NEAR, STEEP = 4.0, 0.6  # m at which a yes is as likely as a no; m over which the curve falls
SCALE = 3.0  # m, of the stated places
WALKERS, SECONDS = 5, 40
SPEED = 1.4  # m/s


@sensor(near=Channel("1", noise=Bernoulli()))
def presence(target, pose):
    """Whether somebody is near: the log odds fall with the distance."""
    return dict(near=(NEAR - norm(target.position - pose.position)) / STEEP)


@sensor(distance=Channel("m", std=2.0))
def gate(target, pose):
    """Coarse distance to a gate."""
    return dict(distance=norm(target.position - pose.position))


def stated():
    """Stated places of the presence sensors (12, 2), staggered along the way."""
    x = np.linspace(5.0, 50.0, 12)
    return np.stack([x, np.where(np.arange(12) % 2, 3.0, -3.0) + 1.5 * np.sin(x / 9.0)], 1)


def network():
    """Presence sensors of uncertain place, and three anchors that measure the distance."""
    seen = [presence.on(Node(f"presence_{k}", place, scale=SCALE)) for k, place in enumerate(stated(), 1)]
    anchors = [Node("gate_west", (0.0, 12.0)), Node("gate_east", (55.0, -12.0)), Node("gate_north", (28.0, 20.0))]
    return Network([*seen, *(gate.on(node) for node in anchors)])


def motion():
    """Walkers that come in at the west gate."""
    walk = Target(ConstantVelocity(0.25), {"position": ((0.0, 0.0), 2.0), "velocity": ((SPEED, 0.0), 0.3)})
    return {f"walker_{k}": walk for k in range(1, WALKERS + 1)}


@cache
def scenario(key=0):
    """Table and truth of one run: places drawn from their scales."""
    drawn = np.random.default_rng(key)
    biases = {b.label: b.scale * drawn.standard_normal() for b in network().biases}
    return simulate(network(), motion(), np.arange(float(SECONDS)), key=key, biases=biases)


def problem(data=None):
    """The network with a table of its own (columns time, target, sensor, near, distance), or that of run 0."""
    return Problem(network(), motion(), scenario().table if data is None else data)


def setting(run=0):
    """Problem and truth of one run of a study."""
    drawn = scenario(run)
    return problem(drawn.table), drawn.truth


def truth(data=None):
    """Truth of run 0; a table written by `probcal simulate` brings its own beside it."""
    return scenario().truth if data is None else Truth()
