"""Innovations epoch by epoch, and squared errors against a truth."""

import numpy as np
import xarray as xr

from probcal.analysis import nees
from probcal.analysis.check import Case, Checked, check
from probcal.analysis.verdict import RATE
from probcal.inference import residuals
from probcal.results.groups import by_target, node_of
from probcal.results.read import each_target


@check()
def check_epochs(case: Case) -> Checked:
    """NIS of every epoch with data, its number of data and limits (false-alarm rate 1 % of each epoch), by target.

    With a truth also NEES of positions by epoch, and those of all positions and biases as attributes.
    """
    fit, found, parts, kept = case.fit, case.innovations, list[residuals.Squares](), list[np.ndarray]()
    blocks = [
        (data.epoch, r, own.shape) for _, data, r, own in fit.problem.model.each_block(fit.problem.model.measured)
    ]
    epoch = fit.flat([np.broadcast_to(np.asarray(own)[:, None], shape) for own, _, shape in blocks])
    owner = fit.flat([np.full(shape, r) for _, r, shape in blocks])
    for r, own in enumerate(fit.problem.epochs):
        mine = owner == r
        there, group = np.unique(epoch[mine], return_inverse=True)
        parts.append(residuals.squares(residuals.Innovations(*(v[mine] for v in found)), group, len(there), RATE))
        kept.append(np.isin(np.arange(len(own.time)), there))
    names = residuals.Squares._fields
    columns = {name: (("time",), [np.asarray(getattr(part, name)) for part in parts]) for name in names}
    groups = {f"epoch_check/{name}": group for name, group in by_target(fit.problem, columns, kept=kept).items()}
    groups = {"epoch_check": xr.Dataset()} | groups
    if case.truth is not None:
        # add the errors; positions are judged by draws of their tracks, where there are some
        tracked = dict(each_target(case.tree))
        case.truth.check_targets(tracked)
        for r, draws in enumerate(case.drawn.states if "draws" in case.has else ()):
            own = case.fit.problem.epochs[r]
            for target in (name for name in tracked if name in own.target):
                states = np.asarray(draws)[:, own.target == target]
                errors = nees.of_positions(target, tracked[target], states, case.truth)
                if errors is not None:
                    name = f"epoch_check/{node_of(target)}"
                    check = groups[name].assign_coords(nees_time=tracked[target]["time"].values[errors.known])
                    groups[name] = check.assign(nees=("nees_time", errors.value))
                    attrs = {"nees": errors.mean, "nees_lower": errors.lower, "nees_upper": errors.upper}
                    groups[name].attrs |= attrs
        biases = nees.of_biases(case.tree, case.truth) if case.fit.whole else nees.of_all_biases(case.fit, case.truth)
        if biases is not None:
            names = ("nees_bias", "nees_bias_count", "nees_bias_lower", "nees_bias_upper")
            groups["epoch_check"].attrs |= dict(zip(names, biases, strict=True))
    return Checked(groups)
