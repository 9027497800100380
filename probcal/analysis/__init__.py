"""Before and after a fit: observability, the next pass or sensor, bounds, and whether a result can be trusted."""

from probcal.analysis.observability import observability
from probcal.analysis.planning import next_anchors, next_passes, next_sensors

__all__ = ["next_anchors", "next_passes", "next_sensors", "observability"]
