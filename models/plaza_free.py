"""Plaza 2 with the beacon positions freed (scale 1 m): a network that its data cannot fix.

Positions and range scales shrink together (a dilation), and the whole scene can be moved and turned. The fit
ends `at bound` and names what to anchor; `--fix "beacon_0.position_*" --fix "beacon_1.position_*"` makes it
an answer.
"""

from plaza import HERE, network, truth

from probcal import ConstantVelocity, Problem

__all__ = ["problem", "truth"]


def problem(data=None):
    """The recording of `models/plaza.py`, beacons free."""
    return Problem(network(scale=1.0), ConstantVelocity(1.0), HERE / "plaza_ranges.csv" if data is None else data)
