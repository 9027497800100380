"""Pictures of saved results: matplotlib figures without pyplot, one module a kind of result."""

from probcal.plots.assess import plot_halves, plot_left_out, plot_nis, plot_shrinkage
from probcal.plots.base import INTERVAL, INVALID
from probcal.plots.bounds import plot_bound_map, plot_sensitivity
from probcal.plots.compare import draw_compare, plot_gammas, plot_methods, plot_pair
from probcal.plots.fit import (
    plot_biases,
    plot_drift,
    plot_gamma,
    plot_map,
    plot_objective,
    plot_outliers,
    plot_residuals,
)
from probcal.plots.observability import draw_check, plot_directions, plot_passes, plot_spectrum
from probcal.plots.sbc import draw_sbc, plot_coverage, plot_ranks
from probcal.plots.study import draw_study, plot_study

__all__ = [
    "INTERVAL", "INVALID", "draw_check", "draw_compare", "draw_sbc", "draw_study", "plot_biases", "plot_bound_map",
    "plot_coverage", "plot_directions", "plot_drift", "plot_gamma", "plot_gammas", "plot_halves", "plot_left_out",
    "plot_map", "plot_methods", "plot_nis", "plot_objective", "plot_outliers", "plot_pair", "plot_passes", "plot_ranks",
    "plot_residuals", "plot_sensitivity", "plot_shrinkage", "plot_spectrum", "plot_study",
]  # fmt: skip
