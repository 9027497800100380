"""Before and after a fit: observability, the next pass or sensor, bounds, whether to trust it, fits side by side."""

from probcal.analysis.assess import assess
from probcal.analysis.bounds import bounds
from probcal.analysis.compare import compare, interchangeable
from probcal.analysis.maps import bound_map
from probcal.analysis.observability import observability
from probcal.analysis.planning import next_anchors, next_passes, next_sensors
from probcal.analysis.sensitivity import sensitivity

__all__ = [
    "assess", "bound_map", "bounds", "compare", "interchangeable", "next_anchors", "next_passes", "next_sensors",
    "observability", "sensitivity",
]  # fmt: skip
