"""A saved fit as one HTML page to hand to a colleague: verdict, map, the biases that matter, the rest folded away."""

from typing import TYPE_CHECKING

from probcal.lazy import lazy

if TYPE_CHECKING:
    from probcal.report.page import write_report

__all__ = lazy(__name__, {"probcal.report.page": "write_report"})
