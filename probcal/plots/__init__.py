"""Pictures of saved results: matplotlib figures without pyplot, one module a kind of result."""

from typing import TYPE_CHECKING

from probcal.lazy import lazy
from probcal.wings import PICTURES

if TYPE_CHECKING:
    from probcal.plots.assess import draw_changes, plot_changes, plot_halves, plot_left_out, plot_nis, plot_shrinkage
    from probcal.plots.base import INTERVAL
    from probcal.plots.bounds import plot_bound_map, plot_sensitivity
    from probcal.plots.compare import draw_compare, plot_gammas, plot_methods, plot_pair
    from probcal.plots.fit import (
        plot_biases,
        plot_drift,
        plot_gamma,
        plot_objective,
        plot_outliers,
        plot_residuals,
    )
    from probcal.plots.history import draw_history, plot_history
    from probcal.plots.interactive import interactive_map
    from probcal.plots.map import plot_map
    from probcal.plots.objects import plot_objects
    from probcal.plots.observability import draw_check, plot_directions, plot_passes, plot_spectrum
    from probcal.roads.plots import plot_particles, plot_roads
    from probcal.studies.plot_sbc import draw_sbc, plot_coverage, plot_ranks
    from probcal.studies.plot_study import draw_study, plot_study

__all__ = lazy(
    __name__,
    {
        "probcal.plots.assess": "draw_changes plot_changes plot_halves plot_left_out plot_nis plot_shrinkage",
        "probcal.plots.base": "INTERVAL",
        "probcal.plots.bounds": "plot_bound_map plot_sensitivity",
        "probcal.plots.compare": "draw_compare plot_gammas plot_methods plot_pair",
        "probcal.plots.fit": "plot_biases plot_drift plot_gamma plot_objective plot_outliers plot_residuals",
        "probcal.plots.history": "draw_history plot_history",
        "probcal.plots.interactive": "interactive_map",
        "probcal.plots.map": "plot_map",
        "probcal.plots.objects": "plot_objects",
        "probcal.plots.observability": "draw_check plot_directions plot_passes plot_spectrum",
    }
    | PICTURES,
)
