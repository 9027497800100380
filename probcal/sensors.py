"""The catalogue of sensor types, written with the public declaration only.

To add one: write a function like these; nothing else changes.
"""

import jax.numpy as jnp
import numpy as np

from probcal.geometry import bearing, elevation, norm
from probcal.noise import Bernoulli
from probcal.sensor import Bias, Channel, sensor


@sensor(range=Channel("m", std=1.0))
def ranger(target, pose, *, range_offset=Bias("m", 1.0), range_scale=Bias("1", 0.1)):
    """Range with an offset and a scale: (1 + range_scale) |p - s| + range_offset (thesis 2.5-2.6, with a scale)."""
    return dict(range=(1 + range_scale) * norm(target.position - pose.position) + range_offset)


@sensor(arrival=Channel("m", std=1.0))
def toa(target, pose):
    """Time of arrival times propagation speed, unknown `emission` range, clock in metres (thesis 2.7)."""
    return dict(arrival=norm(target.position - pose.position) + target.emission + pose.clock)


@sensor(difference=Channel("m", std=1.0))
def tdoa(target, first, second, *, difference_offset=Bias("m", 1.0)):
    """Time difference of arrival times propagation speed: |p - b| - |p - a| + clocks (thesis 2.8, sign turned)."""
    ranges = norm(target.position - second.position) - norm(target.position - first.position)
    return dict(difference=ranges + second.clock - first.clock + difference_offset)


@sensor(azimuth=Channel("rad", std=np.deg2rad(1.0), wrap=True))
def doa(target, pose):
    """Direction of arrival in the plane, from the node's heading (thesis 2.10-2.11)."""
    return dict(azimuth=bearing(target.position - pose.position) - pose.heading)


@sensor(
    azimuth=Channel("rad", std=np.deg2rad(1.0), wrap=True),
    elevation=Channel("rad", std=np.deg2rad(1.0), wrap=True),
)
def doa_3d(target, pose):
    """Azimuth and elevation in the node's own axes (heading, pitch, roll)."""
    line = pose.local(target.position)
    return dict(azimuth=bearing(line), elevation=elevation(line))


@sensor(range=Channel("m", std=10.0), azimuth=Channel("rad", std=np.deg2rad(10.0), wrap=True))
def radar(target, pose, *, range_offset=Bias("m", 10.0)):
    """Plan-position radar: range and azimuth (Paper B 26-27, Paper C 43-44; heading is minus its bearing bias)."""
    line = target.position - pose.position
    return dict(range=norm(line) + range_offset, azimuth=bearing(line) - pose.heading)


@sensor(
    range=Channel("m", std=10.0),
    azimuth=Channel("rad", std=np.deg2rad(1.0), wrap=True),
    elevation=Channel("rad", std=np.deg2rad(1.0), wrap=True),
)
def radar_3d(target, pose, *, range_offset=Bias("m", 10.0)):
    """Radar in 3-D: slant range, azimuth and elevation in the node's own axes (heading, pitch, roll)."""
    line = pose.local(target.position)
    return dict(range=norm(line) + range_offset, azimuth=bearing(line), elevation=elevation(line))


@sensor(level=Channel("dB", std=2.0))
def rss(target, pose, *, gain=Bias("dB", 3.0), exponent=Bias("1", 0.5, nominal=2.0, shared="type")):
    """Received signal strength: power - 10 exponent log10 r + gain (thesis 2.13, Paper A 6)."""
    distance = norm(target.position - pose.position)
    return dict(level=target.power - 10 * exponent * jnp.log10(jnp.maximum(distance, 1e-3)) + gain)


@sensor(present=Channel("1", noise=Bernoulli()))
def presence(target, pose, *, radius=Bias("m", 2.0, nominal=10.0), width=Bias("m", 0.5, nominal=2.0)):
    """Presence detector: the log odds of a detection fall from the radius outwards over the width."""
    distance = norm(target.position - pose.position)
    return dict(present=(radius - distance) / jnp.maximum(width, 1e-3))


@sensor(position=Channel("m", std=5.0, per_axis=True))
def position(target, pose):
    """A noisy fix in the node's frame (GNSS, motion capture); the node is the frame's origin and heading."""
    return dict(position=pose.local(target.position))
