"""Before and after a fit: observability, the next pass or sensor, bounds, whether to trust it, fits side by side."""

from typing import TYPE_CHECKING

from probcal.lazy import lazy

if TYPE_CHECKING:
    from probcal.analysis.assess import assess
    from probcal.analysis.bounds import bounds
    from probcal.analysis.changes import changes
    from probcal.analysis.compare import compare, interchangeable
    from probcal.analysis.maps import bound_map
    from probcal.analysis.observability import observability
    from probcal.analysis.planning import next_anchors, next_passes, next_sensors
    from probcal.analysis.sensitivity import sensitivity

__all__ = lazy(
    __name__,
    {
        "probcal.analysis.assess": "assess",
        "probcal.analysis.bounds": "bounds",
        "probcal.analysis.changes": "changes",
        "probcal.analysis.compare": "compare interchangeable",
        "probcal.analysis.maps": "bound_map",
        "probcal.analysis.observability": "observability",
        "probcal.analysis.planning": "next_anchors next_passes next_sensors",
        "probcal.analysis.sensitivity": "sensitivity",
    },
)
