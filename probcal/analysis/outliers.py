"""Single data that lie far off."""

import numpy as np
from scipy import special

from probcal.analysis.check import Case, Checked, check
from probcal.analysis.findings import NAMES, Finding
from probcal.analysis.verdict import RATE
from probcal.labels import listed
from probcal.noise import Normal

OUTLYING = 4.0  # std from which a datum is an outlier
NORMAL_MEDIAN = 0.6745  # of the absolute value of a standard normal
TOGETHER = 0.3  # share of outliers whose next lies off to the same side, from which something else is wrong
SEVERAL = 2  # data of one target that are off at one time, and are then no outliers


@check(causes=["other"])
def check_outliers(case: Case) -> Checked:
    """A finding on channels of Gaussian noise of which single data lie far off, by what most of their data scatter.

    Their next of the same target does not lie off to the same side: what jumps or drifts is no outlier. Nor is what
    several data of one target say at one time: it has turned.
    """
    fit, found = case.fit, case.innovations
    channels = case.channels
    kinds = {s.name: dict(s.type.expand(fit.problem.network.dimension)) for s in fit.problem.network.sensors}
    target, time = fit.data["target"].to_numpy(str), fit.data["time"].to_numpy()
    off, chosen = np.zeros(len(target), bool), list[tuple[str, np.ndarray]]()
    for (sensor, channel), mine in zip(channels.labels.itertuples(index=False), channels.members, strict=True):
        if isinstance(kinds[sensor][channel].noise, Normal):
            order = mine[np.lexsort((time[mine], target[mine]))]
            size = np.abs(found.value[order])
            off[order] = size > OUTLYING * max(float(np.median(size)) / NORMAL_MEDIAN, 1.0)
            chosen.append((f"{sensor}.{channel}", order))
    epoch = fit.data.groupby(["target", "time"], sort=False).ngroup().to_numpy()
    off &= np.bincount(epoch, off)[epoch] < SEVERAL
    counts = {}
    for name, order in chosen:
        value, owner, out = found.value[order], target[order], off[order]
        again = out[1:] & out[:-1] & (np.sign(value[1:]) == np.sign(value[:-1])) & (owner[1:] == owner[:-1])
        count = int(out.sum())
        chance = special.bdtrc(count - 1, len(order), 2 * special.ndtr(-OUTLYING)) if count else 1.0
        if count > 1 and chance < RATE / len(channels.members) and again.sum() < TOGETHER * count:
            counts[name] = f"{count} of {len(order)}"
    if not counts:
        return Checked()
    named = listed([f"{name} {count}" for name, count in counts.items()], NAMES)
    text = f"single data lie more than {OUTLYING:g} std off: {named}; declare Channel(..., noise=StudentT(4))"
    return Checked(findings=[Finding("outliers", next(iter(counts)), text)], explains=["levels"])
