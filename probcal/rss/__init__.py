"""Received signal strength: power laws from known tracks, localisation without power and exponent, raw samples."""

from probcal.rss.localise import CRITERIA, Location, Snapshot, localise, losses, position_information
from probcal.rss.regression import power_law
from probcal.rss.samples import levels_of, read_wav
from probcal.rss.silence import with_silence
from probcal.rss.tracking import track_snapshots

__all__ = [
    "CRITERIA",
    "Location",
    "Snapshot",
    "levels_of",
    "localise",
    "losses",
    "position_information",
    "power_law",
    "read_wav",
    "track_snapshots",
    "with_silence",
]
