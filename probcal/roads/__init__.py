"""Road networks: read and checked, motions on them and beside them, and map matching; needs `probcal[roads]`."""

from probcal.roads.matching import match_track
from probcal.roads.motion import Road
from probcal.roads.network import RoadNetwork
from probcal.roads.offroad import LeavingRoad
from probcal.roads.read import read_roads
