"""Pictures of a study."""

from collections.abc import Sequence

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from probcal.errors import InputError
from probcal.files import AnyPath
from probcal.plots.base import colour, plain_text, write_figure


def plot_study(study: xr.Dataset, variable: str = "bias_rmse", axes: Sequence[Axes] | None = None) -> list[Axes]:
    """Draw mean and one sd of a study's errors over its first numeric setting, one axes a value of the others.

    `variable` is `bias_rmse`, `position_rmse` or `coverage`; the upper half of the band is drawn, as in Papers B, C.
    """
    grid = [name for name in study[variable].dims if name not in ("estimator", "run")]
    along = next((name for name in grid if np.issubdtype(study[name].dtype, np.number)), None)
    if along is None:
        raise InputError("plot_study: no setting of the study is a number; there is nothing to draw along")
    others = [name for name in grid if name != along]
    facets = study[variable].stack(facet=others) if others else study[variable].expand_dims("facet")
    count = facets.sizes["facet"]
    if axes is None:
        figure = Figure(figsize=(1.2 + 4.6 * count, 3.8), layout="constrained")
        axes = list(figure.subplots(1, count, squeeze=False)[0])
    for k, ax in enumerate(axes):
        chosen = facets.isel(facet=k)
        for m, method in enumerate(study["estimator"].values):
            values = chosen.sel(estimator=method)
            mean, sd = values.mean("run").values, values.std("run").values
            ax.plot(study[along], mean, "o-", color=colour(m), markersize=3.5, label=plain_text(method))
            ax.fill_between(study[along], mean, mean + sd, color=colour(m), alpha=0.15, linewidth=0)
        top = chosen.mean("run").max().item()
        ax.set(xlabel=plain_text(along), ylim=(0.0, 1.25 * top if np.isfinite(top) else None))
        names = facets["facet"].values[k] if others else ()
        ax.set_title(", ".join(f"{name} {value}" for name, value in zip(others, np.atleast_1d(names), strict=True)))
        ax.grid(color="0.9")
    axes[0].set_ylabel({"bias_rmse": "bias error over its scale (rms)", "position_rmse": "position error in m"}.get(
        variable, variable))  # fmt: skip
    axes[-1].legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), frameon=False, fontsize=8)
    return list(axes)


def draw_study(study: xr.Dataset, path: AnyPath) -> None:
    """Write the picture of a study to a file."""
    figure = plot_study(study)[0].get_figure(root=True)
    assert isinstance(figure, Figure)
    write_figure(figure, path, 150)
