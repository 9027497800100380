"""The results of all runs of a simulation-based calibration: uniformity, coverage, a verdict."""

from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from probcal.errors import checked
from probcal.labels import listed
from probcal.studies.uniformity import p_value, shape, share, spread_p_value

ALARM = 0.01  # probability of a false alarm, over all quantities together


def judge_coverage(tree: xr.DataTree) -> None:
    """Add uniformity, coverage and the verdict."""
    group = tree["sbc"].to_dataset()
    place, kinds = group["place"].values, group["kind"].values
    names = [str(name) for name in group["quantity"].values]
    values = [p_value(place[:, q]) for q in range(len(names))]
    shapes = [shape(place[:, q]) for q in range(len(names))]
    biases = place[:, kinds == "bias"]
    tests = [*names, "width of all biases"]
    values.append(spread_p_value(biases))
    spread = (np.abs(biases - 0.5).mean() - 0.25) > 0
    shapes.append("the posterior is too narrow" if spread else "the posterior is too wide")
    limit = ALARM / len(tests)
    found: dict[str, Any] = {"p_value": ("test", np.array(values)), "shape": ("test", shapes)}
    tree["uniformity"] = xr.DataTree(xr.Dataset(found, coords={"test": tests}))
    tree["coverage"] = xr.DataTree(coverage(group))
    order = np.argsort(values)
    wrong = [k for k in order if values[k] < limit]
    least = order[0]
    rate = f"over all {len(tests)} tests a right method fails with probability {ALARM:.0%} at most"
    if wrong:
        apart = listed([f"{tests[k]} (p {values[k]:.1g}, {shapes[k]})" for k in wrong])
        verdict = f"not uniform: {apart}; {rate}."
    else:
        verdict = f"uniform over {len(place)} runs; the smallest p is {values[least]:.2g} of {tests[least]}; {rate}."
    tree.attrs |= {"status": "not uniform" if wrong else "uniform", "verdict": verdict, "false_alarm_rate": ALARM}


def coverage(group: xr.Dataset) -> xr.Dataset:
    """Observed coverage of the central intervals of the biases, by nominal probability."""
    chosen = group.isel(quantity=np.flatnonzero(group["kind"].values == "bias"))
    place, true = chosen["place"].values, chosen["truth"].values
    everything, nonzero = np.ones(true.shape, bool), true != 0.0
    columns: dict[str, list[float]] = {}
    for i, nominal in enumerate(group["nominal"].values.tolist()):
        random, plain = np.abs(place - 0.5) <= nominal / 2, chosen["inside"].values[:, :, i]
        kinds = {"all": (random, everything), "nonzero": (random, nonzero), "plain": (plain, everything)}
        for name, (inside, counted) in kinds.items():
            if counted.any():
                observed, error = share(inside, counted, nominal)
                columns.setdefault(name, []).append(observed)
                columns.setdefault(f"{name}_se", []).append(error)
    values: dict[str, Any] = {name: ("nominal", np.array(column)) for name, column in columns.items()}
    return xr.Dataset(values, coords={"nominal": group["nominal"].values})


@checked
def coverage_table(tree: xr.DataTree) -> pd.DataFrame:
    """Coverage of the central intervals of the biases by `nominal` probability, each with its Monte Carlo error.

    `all` counts every bias, `nonzero` those that are truly not zero (left out where there is none), both with ties
    broken at random so that a right method meets the nominal value; `plain` counts every bias whose truth lies within
    the interval, its ends included: above the nominal value where a posterior has an atom.
    """
    return tree["coverage"].to_dataset().to_dataframe().reset_index()
