"""All answers of a problem: starts from the data alone, and what a found one is mirrored or exchanged into."""

from probcal.modes.automatic import automatic_start, further_starts, optima

__all__ = ["automatic_start", "further_starts", "optima"]
