"""Inference: `fit(problem, method)` for every method, `track` for other data, `study` over runs."""

from probcal.inference.fit import fit, track
from probcal.inference.methods import EA, EM, EMEA, MAP, METHODS, LeastSquares, Method, table

__all__ = ["EA", "EM", "EMEA", "MAP", "METHODS", "LeastSquares", "Method", "fit", "table", "track"]
