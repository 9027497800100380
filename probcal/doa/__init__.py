"""Bearings only: single-sensor tracks up to scale, and sensors matched by them (the DOA self-calibration paper)."""

from probcal.doa.modified import SensorTrack
from probcal.doa.smoother import bearing_track
from probcal.modes.array import Array, match
from probcal.modes.triangles import Similarity, similarity, turn_of

__all__ = ["Array", "SensorTrack", "Similarity", "bearing_track", "match", "similarity", "turn_of"]
