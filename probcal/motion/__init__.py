"""Motion of a target: the protocol `Motion`, what composes with `+` to a linear one, and those of the package."""

from probcal.motion.base import Component, Joint, Linear, LinearMotion, Motion, as_motion
from probcal.motion.components import (
    ConstantAcceleration,
    ConstantVelocity,
    CoordinatedTurn,
    RandomWalk,
    Static,
    White,
)
from probcal.motion.known import Known
from probcal.motion.layout import Layout, flow_of, labels_of, view
from probcal.motion.target import Target
