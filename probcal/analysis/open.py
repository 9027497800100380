"""Combinations of biases that the data leave open, and the biases that these put far off."""

import numpy as np

from probcal.analysis.check import Case, Checked, check
from probcal.analysis.verdict import limit_of
from probcal.identifiability.directions import combination
from probcal.identifiability.patterns import cause
from probcal.identifiability.remedies import WEAK
from probcal.linalg import outer, spectrum

SHARED = 1.8  # sd that an open combination of one scale may put a bias off; of four with a free common part, about 1.9


@check()
def check_open(case: Case) -> Checked:
    """The biases that a combination which the data leave open would put more than `SHARED` sd off.

    A bias that is clearly away from zero all the same, as the prior shares out the combination,
    stands apart from the others of it: its verdict is relative to them.

    Where the truth lies c v along a combination v, its largest part one scale, an estimate under the declared scales,
    of covariance C, is off by c C v: of M biases with a common part that no row tells, each is sqrt(M) sd off. The
    combinations are those of the tree, or those within each sensor where the covariance of all is not held.
    """
    problem, blocks, group = case.fit.problem, case.declared, case.tree["calibration"].to_dataset()
    away = np.abs(group["mean"].values) > np.sqrt(limit_of(len(group["mean"]))) * group["sd"].values
    doubts: dict[str, dict[int, str]] = {"weak": {}, "relative": {}}
    known, free, names, why = blocks.covariance, np.ones(blocks.members.shape, bool), None, ""
    if blocks.whole:
        if "direction" not in case.tree.children:
            return Checked()
        directions = case.tree["direction"].to_dataset()
        names, vectors = directions["direction"].values, directions["vector"].values.T[None]
        information = directions["information"].values[None]
    else:
        free = np.append(~problem.surveyed, False)[blocks.members]
        known = np.where(outer(free), known, 0.0)
        values, vectors = spectrum(known)
        information = 1.0 / np.maximum(values, 1e-300) - 1.0
    sd = np.sqrt(np.maximum(np.diagonal(known, axis1=1, axis2=2), 1e-300))[:, :, None]
    off = np.abs(known @ vectors) / sd / np.maximum(np.abs(vectors).max(1, keepdims=True), 1e-300)
    off = np.where((information < WEAK)[:, None, :] & free[:, :, None], off, 0.0)
    for b, j in np.argwhere(off.max(2, initial=0.0) > SHARED):
        k = int(off[b, j].argmax())
        if names is None:
            why = why or cause(problem, case.fit.point)
            own = [problem.labels[m] for m in blocks.members[b][free[b]]]
            name = combination(problem, own, vectors[b, free[b], k], why).name
        else:
            name = names[k]
        m, told = int(blocks.members[b, j]), f"{name} (information {max(information[b, k], 0.0):.2g})"
        word, how = ("relative", "stands apart from others of") if away[m] else ("weak", "belongs to")
        doubts[word][m] = f"it {how} {told}, which the data leave open" + ": all may be off together" * bool(away[m])
    return Checked(doubts=doubts)
