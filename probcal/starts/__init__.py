"""Starts from the data alone: a geometric one for each family of sensors, beside the grid."""

from probcal.starts.automatic import automatic_start, optima
from probcal.starts.further import further_starts

__all__ = ["automatic_start", "further_starts", "optima"]
