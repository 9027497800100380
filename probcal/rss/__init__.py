"""Received signal strength: power laws from known tracks, localisation without power and exponent, raw samples."""

from typing import TYPE_CHECKING

from probcal.lazy import lazy

if TYPE_CHECKING:
    from probcal.rss.localise import CRITERIA, Location, Snapshot, localise, losses, position_information
    from probcal.rss.regression import power_law
    from probcal.rss.samples import levels_of, read_wav
    from probcal.rss.silence import with_silence
    from probcal.rss.tracking import track_snapshots

__all__ = lazy(
    __name__,
    {
        "probcal.rss.localise": "CRITERIA Location Snapshot localise losses position_information",
        "probcal.rss.regression": "power_law",
        "probcal.rss.samples": "levels_of read_wav",
        "probcal.rss.silence": "with_silence",
        "probcal.rss.tracking": "track_snapshots",
    },
)
