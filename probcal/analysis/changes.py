"""`changes`: two recordings of one network, and which biases moved between them.

Each fit keeps what its data say of the biases, trajectories marginalised: a quadratic log-likelihood with
`information` G and linear term `pull` h (z over its scale). Two recordings are two pieces that share their biases
(`analysis.pieces`), so that for each bias alone the generalised least-squares estimate of its change follows while
all others stay common; it needs no prior of the change. Exact on a linear problem.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import xarray as xr

from probcal.analysis import pieces
from probcal.analysis.compare import common_labels
from probcal.analysis.findings import Finding
from probcal.analysis.verdict import RATE, limit_of
from probcal.errors import InputError
from probcal.results.answer import HALF
from probcal.results.schema import INTERVAL
from probcal.status import INVALID

PATTERN = np.array([[0.0], [1.0]])  # what the second recording has beyond the first
TOLD = 1.0  # information about a change, in declared scales, below which the data do not tell it


class Likelihood(NamedTuple):
    """What one recording says of some biases, in z: -z'Gz/2 + h'z, and how much wider its sd are than that says."""

    labels: list[str]
    information: np.ndarray  # (M, M)
    pull: np.ndarray  # (M,)
    inflation: np.ndarray  # (M,) of variances

    def about(self, labels: list[str]) -> "Likelihood":
        """The same about these biases alone, the others integrated under their declared scales."""
        at = [self.labels.index(label) for label in labels]
        rest = [k for k in range(len(self.labels)) if self.labels[k] not in set(labels)]
        G, h = self.information, self.pull
        gain = np.linalg.solve(G[np.ix_(rest, rest)] + np.eye(len(rest)), G[np.ix_(rest, at)])
        information = G[np.ix_(at, at)] - G[np.ix_(at, rest)] @ gain
        return Likelihood(labels, information, h[at] - gain.T @ h[rest], self.inflation[at])


def changes(first: xr.DataTree, second: xr.DataTree, *, names: Sequence[str] = ("first", "second")) -> xr.DataTree:
    """What moved between two recordings of one network, second less first, with intervals.

    `first` and `second` are results of `fit` (or loaded ones), best after `assess`, whose overdispersion widens the
    intervals. Returns a tree:

    - `change` (bias_label): change, sd, lower and upper in the unit of the bias, t, `first` and `second` (the means of
      the fits), verdict: "moved", "no change seen", or "not told" where the data say too little (an sd above the
      declared scale);
    - `finding`: kind, subject and a sentence each.

    A bias counts as moved where its change, with all others held common but for those that moved more, passes the
    limit of a false-alarm rate of 1 % over all biases (attributes `limit`, `rate`). Biases that one fit lacks are
    integrated out. Raises `InputError` for a tree that is no fit or no answer, for other scales or units, for the same
    data twice, and where no bias is common.

    >>> later = probcal.simulate(network, motion, np.arange(60.0), key=1, biases={"sonar_0.heading": 0.1})
    >>> moved = changes(tree, probcal.fit(Problem(network, motion, later.table), probcal.EA()))["change"].to_dataset()
    >>> moved["verdict"].sel(bias_label="sonar_0.heading").item()
    'moved'
    """
    if len(names) != 2 or names[0] == names[1]:
        raise InputError(f"changes: names is {tuple(names)}; give two that differ")
    pair = dict(zip(map(str, names), (first, second), strict=True))
    for name, tree in pair.items():
        _check(name, tree)
    labels = common_labels(pair, "changes")
    if _same_data(first, second):
        raise InputError("changes: both fits are of the same data; compare() puts methods side by side")
    said = [_likelihood(name, tree).about(labels) for name, tree in pair.items()]
    group = first["calibration"].to_dataset().sel(bias_label=labels)
    change = _changes(said, group["scale"].values)
    means = [tree["calibration"].to_dataset().sel(bias_label=labels)["mean"].values for tree in pair.values()]
    columns = {**change, "first": means[0], "second": means[1]}
    coords = {"bias_label": labels} | {name: ("bias_label", group[name].values) for name in ("unit", "scale")}
    found = xr.Dataset({name: ("bias_label", values) for name, values in columns.items()}, coords)
    found.attrs |= {"limit": float(np.sqrt(limit_of(len(labels)))), "rate": RATE}
    told = _findings(found, pair)
    tree = xr.DataTree.from_dict(
        {
            "change": found,
            "finding": xr.Dataset({name: ("finding", [getattr(f, name) for f in told]) for name in Finding._fields}),
        }
    )
    tree.attrs |= {"first": str(names[0]), "second": str(names[1]), "interval_probability": INTERVAL}
    return tree


def _check(name: str, tree: xr.DataTree) -> None:
    if not isinstance(tree, xr.DataTree) or not {"calibration", "observed_data"} <= set(tree.children):
        raise InputError(f'changes: "{name}" is no result of fit(); give trees of fit() or load()')
    if tree.attrs["status"] in INVALID:
        raise InputError(f'changes: the fit "{name}" ended "{tree.attrs["status"]}" and is no answer; mend it first')
    if "pull" not in tree["calibration"].data_vars:
        raise InputError(f'changes: "{name}" does not keep what its data say of the biases; fit it again')


def _same_data(first: xr.DataTree, second: xr.DataTree) -> bool:
    one, two = (tree["observed_data"].to_dataset() for tree in (first, second))
    return all(np.array_equal(one[name].values, two[name].values) for name in ("y", "time", "sensor"))


def _likelihood(name: str, tree: xr.DataTree) -> Likelihood:
    group = tree["calibration"].to_dataset()
    M = group.sizes["bias_label"]
    wide = tree["verdict"].to_dataset()["inflation"].values if "verdict" in tree.children else np.ones(M)
    labels = [str(label) for label in group["bias_label"].values]
    return Likelihood(labels, group["information"].values, group["pull"].values, np.maximum(wide, 1.0))


def _changes(said: Sequence[Likelihood], scale: np.ndarray) -> dict[str, np.ndarray]:
    """Columns of the change of each bias in its unit, beside those that moved more."""
    M = len(scale)
    information = np.zeros((2 * M, 2 * M))
    for k, own in enumerate(said):
        information[k * M : (k + 1) * M, k * M : (k + 1) * M] = own.information
    both = pieces.Pieces(information, np.concatenate([own.pull for own in said]), np.eye(M), np.zeros(M))
    inflation = np.maximum(*(own.inflation for own in said))
    moved = pieces.changing(
        both, {"second": PATTERN}, {"second": inflation}, lambda freedom: limit_of(M, freedom), most=M
    )
    free = {one.bias: one.contrast for one in moved}
    for m in free:  # each beside all the others
        free[m] = pieces.contrasts(both, PATTERN, [(k, PATTERN) for k in free if k != m]).get(m, free[m])
    beside = pieces.contrasts(both, PATTERN, [(k, PATTERN) for k in free]) | free
    value, sd = np.zeros(M), np.full(M, np.inf)  # of what neither recording sees
    for m, contrast in beside.items():
        value[m], sd[m] = contrast.estimate[0], np.sqrt(inflation[m] / contrast.information[0, 0])
    t = value / sd
    told = ["moved" if m in free else "no change seen" if sd[m] ** -2 >= TOLD else "not told" for m in range(M)]
    ends = {"lower": value - HALF * sd, "upper": value + HALF * sd}
    return {
        "change": value * scale, "sd": sd * scale, **{name: end * scale for name, end in ends.items()}, "t": t,
        "verdict": np.array(told),
    }  # fmt: skip


def _findings(found: xr.Dataset, pair: dict[str, xr.DataTree]) -> list[Finding]:
    """A sentence for each bias that moved, one for those that are not told, one for what stays common otherwise."""
    said = []
    verdicts = found["verdict"].values
    for k in sorted(np.flatnonzero(verdicts == "moved").tolist(), key=lambda k: -abs(float(found["t"].values[k]))):
        label, unit = str(found["bias_label"].values[k]), str(found["unit"].values[k])
        change, sd, t = (float(found[name].values[k]) for name in ("change", "sd", "t"))
        size = f"{change:.3g} ± {sd:.2g}{'' if unit == '1' else f' {unit}'}"
        said.append(
            Finding("moved", label, f"{label} moved by {size} ({abs(t):.1f} sd, limit {found.attrs['limit']:.1f})")
        )
    if not said:
        count = int((verdicts == "no change seen").sum())
        said.append(Finding("moved", "", f"nothing moved: none of {count} biases that the data tell of has changed"))
    silent = int((verdicts == "not told").sum())
    if silent:
        said.append(Finding("not told", "", f"of {silent} biases the data say too little to see a change of one scale"))
    for name, tree in pair.items():
        if "verdict" not in tree.children:
            said.append(Finding("assess", name, f'"{name}" was not assessed: the declared noise is taken as right'))
    return said
