"""Inference: `fit(problem, method)` for every method, `track(problem, calibration)` for other data."""

from probcal.inference.ea import EA, MAP
from probcal.inference.em import EM, EMEA
from probcal.inference.fit import METHODS, Method, fit, track

__all__ = ["EA", "EM", "EMEA", "MAP", "METHODS", "Method", "fit", "track"]
