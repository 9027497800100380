"""The catalogue of sensor types, written with the public declaration only.

To add one: write a function like these; nothing else changes. What a node owns and its sensors share (position,
heading, pitch, roll, clock, time_offset, and extras such as `gain`) is declared with the node; the keyword-only
arguments here are the biases of each sensor. Levels are in dB; where a paper takes natural logarithms, its factor of
ln r is 10 exponent / ln 10.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from probcal.geometry import bearing, elevation, norm
from probcal.noise import Bernoulli, Mixture, Unknown
from probcal.sensor import Bias, Channel, sensor

CLOSE = 1e-3  # m, distance below which a level or a direction no longer changes
DIPOLE = 100.0  # nT m^3 / (A m^2), the magnetic constant over 4 pi
TOUCH = 0.1  # m, distance below which the field of a dipole no longer grows
EDGE = np.deg2rad(80.0)  # angle off its axis beyond which the image of a pinhole camera is continued linearly


def _loss(line: Any) -> jax.Array:
    """Spreading in dB for an exponent of one: 10 log10 of the distance."""
    return 10 * jnp.log10(jnp.maximum(norm(line), CLOSE))


def _field(line: Any, moment: Any) -> jax.Array:
    """Field in nT of a dipole `moment` in A m^2 at a distance `line` in m."""
    distance = jnp.maximum(norm(line), TOUCH)
    unit = line / distance
    return DIPOLE * (3 * unit * jnp.sum(unit * moment) - moment) / distance**3


def _image(line: Any) -> jax.Array:
    """Pinhole image (right[, down]) of a line (ahead, left[, up]): the tangents of the angles off the axis.

    Beyond 80 degrees, and behind the camera, it goes on growing with the angle.
    """
    ahead, across = line[0], line[1:]
    off = norm(across)
    inside = off < np.tan(EDGE) * ahead
    angle = bearing(jnp.stack([ahead, off]))
    beyond = np.tan(EDGE) + (angle - EDGE) / np.cos(EDGE) ** 2
    return -across * jnp.where(inside, 1 / jnp.where(inside, ahead, 1.0), beyond / jnp.maximum(off, CLOSE))


@sensor(range=Channel("m", std=1.0))
def ranger(target, pose, *, range_offset=Bias("m", 1.0), range_scale=Bias("1", 0.1)):
    """Range with an offset and a scale: (1 + range_scale) |p - s| + range_offset (thesis 2.5-2.6, with a scale)."""
    return dict(range=(1 + range_scale) * norm(target.position - pose.position) + range_offset)


@sensor(range=Channel("m", std=1.0))
def flight_time(target, pose, *, range_offset=Bias("m", 1.0)):
    """Time of flight times propagation speed, emission time known (thesis 2.5): |p - s| + clock + range_offset.

    The clock is known unless its node frees it; where it does, fix the range_offset.
    """
    return dict(range=norm(target.position - pose.position) + pose.clock + range_offset)


@sensor(
    range=Channel(
        "m",
        std=Unknown(0.1),
        noise=Mixture(Unknown(0.1), Unknown(5.0), late="exponential"),
    ),
)
def uwb(target, pose, *, range_offset=Bias("m", 0.3, zeros="none")):
    """Ultra-wideband range |p - s| + range_offset + noise, of which some come late, by reflection.

    The noise is normal. With an unknown probability the direct path is blocked, which adds an
    exponential delay (Guvenc and Chong 2009). The offset is an antenna delay, which is never zero.
    """
    return dict(range=norm(target.position - pose.position) + range_offset)


@sensor(range_rate=Channel("m/s", std=0.5))
def doppler(target, pose, *, rate_offset=Bias("m/s", 0.5)):
    """Rate of the range from the node, which may move: (p - s)'(v - v_s) / |p - s| (the doppler radar of thesis 2.3.4).

    Positive where the target recedes.
    """
    line = target.position - pose.position
    rate = jnp.sum(line * (target.velocity - pose.velocity)) / jnp.maximum(norm(line), CLOSE)
    return dict(range_rate=rate + rate_offset)


@sensor(arrival=Channel("m", std=1.0))
def toa(target, pose):
    """Time of arrival times propagation speed, unknown `emission` range, clock in metres (thesis 2.7).

    The range bias of (2.7) is the clock of the node: one common to all nodes is an emission range.
    """
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
def radar_3d(target, pose, *, range_offset=Bias("m", 10.0), range_scale=Bias("1", 0.01)):
    """Radar in 3-D with the biases of a real one (thesis 2.3.4): slant range, azimuth and elevation in its own axes.

    Range offset and gain (`range_scale`) are here; the rest are its node's: position (z with the sign turned is the
    altitude bias), heading (north alignment), pitch and roll (axis tilt, antenna pitch and roll), and its clock.
    """
    line = pose.local(target.position)
    distance = (1 + range_scale) * norm(line) + range_offset
    return dict(range=distance, azimuth=bearing(line), elevation=elevation(line))


@sensor(level=Channel("dB", std=2.0))
def rss(target, pose, *, gain=Bias("dB", 3.0), exponent=Bias("1", 0.5, nominal=2.0, shared="type")):
    """Received signal strength: power - 10 exponent log10 r + gain (Paper A 6, its log(1 - gain) written in dB).

    A gain common to all sensors is a source power: the gains are told apart by the start of `power`.
    """
    return dict(level=target.power - exponent * _loss(target.position - pose.position) + gain)


@sensor(level=Channel("dB", std=2.0))
def rss_slope(target, pose, *, gain=Bias("1", 0.05), exponent=Bias("1", 0.5, nominal=2.0, shared="type")):
    """Received signal strength: (1 - gain) power - 10 exponent log10 r, the gain a slope (thesis 2.13)."""
    return dict(level=(1 - gain) * target.power - exponent * _loss(target.position - pose.position))


@sensor(level_difference=Channel("dB", std=2.0))
def rss_difference(target, first, second, *, exponent=Bias("1", 0.5, nominal=2.0, shared="type")):
    """Level at the second node minus that at the first, in which the unknown power cancels (thesis 2.3.5).

    The gains are the nodes': Node(..., gain=0.0, scale={"gain": Bias("dB", 3.0)}); one common to all cancels too.
    """
    loss = _loss(target.position - second.position) - _loss(target.position - first.position)
    return dict(level_difference=second.gain - first.gain - exponent * loss)


@sensor(level=Channel("dB", std=2.0))
def sound(target, pose, *, gain=Bias("1", 0.05)):
    """Sound pressure level, free field (Paper C 48-51): (1 - gain) L_W - 10 log10(4 pi) - 20 log10 r.

    `power` is the sound power level L_W in dB re 1 pW; (51) prints + 10 log10(4 pi), (50) has the sign used here.
    """
    free_field = 10 * np.log10(4 * np.pi) + 2 * _loss(target.position - pose.position)
    return dict(level=(1 - gain) * target.power - free_field)


@sensor(sound_level=Channel("dB", std=3.0))
def microphone(target, pose, *, gain=Bias("dB", 3.0), exponent=Bias("1", 0.5, nominal=2.6, shared="type")):
    """Log energy of a microphone: sound_power + gain - 10 exponent log10 r (RSS paper 4e, model M2).

    The measured exponents are 2.6 (Table 2). With a `geophone` on one node, both share its displacement.
    """
    return dict(sound_level=target.sound_power + gain - exponent * _loss(target.position - pose.position))


@sensor(ground_level=Channel("dB", std=3.0))
def geophone(target, pose, *, gain=Bias("dB", 3.0), exponent=Bias("1", 0.5, nominal=3.0, shared="type")):
    """Log energy of a geophone: ground_power + gain - 10 exponent log10 r (RSS paper 4e, model M2).

    The measured exponents are 2.8 and 3.4 (Table 2); source level and exponent are its own, not the microphone's.
    """
    return dict(ground_level=target.ground_power + gain - exponent * _loss(target.position - pose.position))


@sensor(field=Channel("nT", std=1.0, per_axis=True))
def magnetometer(target, pose, *, offset_x=Bias("nT", 5.0), offset_y=Bias("nT", 5.0)):
    """Two axes of a magnetometer in the plane of a dipole: its field in the node's axes, Earth's field removed.

    100 nT (3 u (u'm) - m) / r^3 for the state `moment` m in A m^2 along the common axes, u the unit vector of the
    line (Jackson, Classical Electrodynamics, 5.56; Wahlstrom and Gustafsson 2014, IEEE Trans. Signal Process. 62).
    """
    field = pose.turn(_field(target.position - pose.position, target.moment))
    return dict(field=field + jnp.stack([offset_x, offset_y]))


@sensor(field=Channel("nT", std=1.0, per_axis=True))
def magnetometer_3d(target, pose, *, offset_x=Bias("nT", 5.0), offset_y=Bias("nT", 5.0), offset_z=Bias("nT", 5.0)):
    """Three-axis magnetometer: the field of a dipole as in `magnetometer`."""
    field = pose.turn(_field(target.position - pose.position, target.moment))
    return dict(field=field + jnp.stack([offset_x, offset_y, offset_z]))


@sensor(column=Channel("1", std=0.002))
def camera(target, pose, *, focal_scale=Bias("1", 0.02), principal=Bias("1", 0.01)):
    """Column of a pinhole image, in focal lengths right of the principal point (Hartley and Zisserman 2004, 6.1).

    The camera looks along its heading; (column in pixels - c_x) / f_x is measured. A principal point is nearly a
    heading: free one of the two.
    """
    return dict(column=(1 + focal_scale) * _image(pose.local(target.position))[0] + principal)


@sensor(column=Channel("1", std=0.002), row=Channel("1", std=0.002))
def camera_3d(
    target, pose, *, focal_scale=Bias("1", 0.02), principal_column=Bias("1", 0.01), principal_row=Bias("1", 0.01)
):
    """Column and row of a pinhole image, in focal lengths right of and below the principal point (as `camera`)."""
    column, row = _image(pose.local(target.position))
    return dict(column=(1 + focal_scale) * column + principal_column, row=(1 + focal_scale) * row + principal_row)


@sensor(column=Channel("1", std=0.002), row=Channel("1", std=0.002))
def rolling_camera(
    target,
    pose,
    *,
    line_delay=Bias("s", 0.01, nominal=0.02),
    focal_scale=Bias("1", 0.02),
):
    """Pinhole image of a camera at rest with a rolling shutter (Oth and others 2013).

    A row of the image is exposed line_delay * row seconds after that of the principal point, whose
    time is stated: row = image(p(t + line_delay * row)). `line_delay` is that of one focal length.
    """
    late = 0.0
    for _ in range(3):  # each step divides the error by the focal lengths crossed in one delay
        column, row = (1 + focal_scale) * _image(pose.local(target.at(late).position))
        late = line_delay * row
    return dict(column=column, row=row)


@sensor(present=Channel("1", noise=Bernoulli()))
def presence(target, pose, *, radius=Bias("m", 2.0, nominal=10.0), width=Bias("m", 0.5, nominal=2.0)):
    """Presence detector: the log odds of a detection fall from the radius outwards over the width."""
    distance = norm(target.position - pose.position)
    return dict(present=(radius - distance) / jnp.maximum(width, 1e-3))


@sensor(position=Channel("m", std=5.0, per_axis=True))
def position(target, pose):
    """A noisy fix in the node's frame (GNSS, motion capture); the node is the frame's origin and heading."""
    return dict(position=pose.local(target.position))


@sensor(cross_track=Channel("m", std=2.0))
def cross_track(target, pose):
    """A constraint: distance to the left of the line through the node along its heading; 0 holds a target on a road."""
    return dict(cross_track=pose.local(target.position)[1])


@sensor(altitude=Channel("m", std=2.0))
def altitude(target, pose):
    """A constraint in 3-D: height above the node, where it is known (a flight level, a lake)."""
    return dict(altitude=target.position[2] - pose.position[2])
