"""Three radars and two targets: a small model that has nearly everything which tables, reports and pictures show."""

import numpy as np

from probcal import Bias, Channel, ConstantVelocity, Drift, Network, Node, Problem, Unknown, sensor, simulate
from probcal.geometry import bearing, norm

TIME = np.arange(8.0)
TRACKS = {
    "car": np.stack([np.linspace(5, 45, 8), 20 + 10 * np.sin(np.linspace(0, 3, 8))], 1),
    "van": np.stack([30 + 10 * np.cos(np.linspace(0, 3, 8)), np.linspace(45, 5, 8)], 1),
}


@sensor(range=Channel("m", std=Unknown(1.0)), azimuth=Channel("rad", std=0.02, wrap=True))
def gauge(target, pose, *, range_offset=Bias("m", 2.0)):
    """Range with an offset, azimuth from the node's heading."""
    line = target.position - pose.position
    return dict(range=norm(line) + range_offset, azimuth=bearing(line) - pose.heading)


def network():
    """An anchor, a node that turns while the recording lasts, and one whose place is surveyed."""
    turns = Bias("rad", 0.1, drift=Drift((0.0, 4.0), scale=0.05))
    nodes = [
        Node("a", (0.0, 0.0)),
        Node("b", (50.0, 0.0), 0.5, scale={"position": 2.0, "heading": turns}),
        Node("c", (0.0, 50.0), -0.7, survey={"position": 0.3}, scale={"heading": 0.1}),
    ]
    return Network([gauge.on(node) for node in nodes])


def problem(data=None):
    """The recording in `data`; the offset of the anchor is known to be zero."""
    return Problem(network(), ConstantVelocity(0.5), data, fix=["a.range_offset"])


def scenario(key=0):
    """A recording of both targets, a quarter of it missing."""
    return simulate(network(), ConstantVelocity(0.5), TIME, key=key, tracks=TRACKS, missing=0.25)
