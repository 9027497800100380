"""Plaza 2 with the beacon positions freed (scale 1 m): a network that its data cannot fix.

Positions grow and range scales shrink together (a dilation), and the whole scene can be moved and turned: positions
are `weak`, and the fit names what to anchor, as in `--fix "beacon_0.position_*" --fix "beacon_1.position_*"`. The size
hangs on how sharply the mower is said to turn, which is therefore learnt: declared as 1 m s^-3/2 the scales came out as
1 % instead of 7, with sds of 2 %, and the track 1.7 m off instead of 0.5.
"""

from plaza import HERE, MOTION, network, truth

from probcal import Problem

__all__ = ["problem", "truth"]


def problem(data=None):
    """The recording of `models/plaza.py`, beacons free."""
    return Problem(network(scale=1.0), MOTION, HERE / "plaza_ranges.csv" if data is None else data)
