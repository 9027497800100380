"""Inference: `fit(problem, method)` for every method, `track` for other data, `study` over runs."""

from probcal.inference.coverage import coverage_table
from probcal.inference.evidence import Evidence, log_evidence
from probcal.inference.fit import fit, track
from probcal.inference.methods import EA, EM, EMEA, MAP, METHODS, NUTS, Collapsed, LeastSquares, table
from probcal.inference.model import numpyro_model
from probcal.inference.run import Method
from probcal.inference.sbc import sbc
from probcal.inference.study import ORACLE, study
from probcal.inference.svi import SVI

__all__ = [
    "EA", "EM", "EMEA", "MAP", "METHODS", "NUTS", "ORACLE", "SVI", "Collapsed", "Evidence", "LeastSquares",
    "Method", "coverage_table", "fit", "log_evidence", "numpyro_model", "sbc", "study", "table", "track",
]  # fmt: skip
