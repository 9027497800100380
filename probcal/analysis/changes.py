"""`changes`: two recordings of one network, and which biases moved between them.

Each fit keeps what its data say of the biases, trajectories marginalised: a quadratic log-likelihood with
`information` G and linear term `pull` h (z over its scale). Two recordings are two pieces that share their biases
(`analysis.pieces`), so that for each bias alone the generalised least-squares estimate of its change follows while
all others stay common; it needs no prior of the change. Exact on a linear problem.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import xarray as xr

from probcal.analysis import pieces
from probcal.analysis.compare import common_labels
from probcal.analysis.findings import Finding, finding_group
from probcal.analysis.verdict import RATE, limit_of
from probcal.errors import InputError, checked
from probcal.labels import check_name, label_parts, listed, step_of
from probcal.linalg import marginalise
from probcal.results.answer import HALF
from probcal.results.groups import along
from probcal.results.modes import rivals
from probcal.results.read import listed_in, stated_values
from probcal.results.schema import INTERVAL, held_biases, matrix_of
from probcal.status import Status

PATTERN = np.array([[0.0], [1.0]])  # what the second recording has beyond the first
ALIKE = 6.0  # chi-square (3 nats) within which another change explains the data as well
TOLD = 1.0  # information about a change, in declared scales, below which the data do not tell it


class Likelihood(NamedTuple):
    """The log-likelihood of biases from one recording, -z'Gz/2 + h'z in z, with its inflation."""

    labels: list[str]
    information: np.ndarray  # (M, M)
    pull: np.ndarray  # (M,)
    inflation: np.ndarray  # (M,) of variances, 1 where nobody looked

    @classmethod
    def of(cls, tree: xr.DataTree) -> "Likelihood":
        """That of a fit."""
        group = tree["calibration"].to_dataset()
        labels = [str(label) for label in group["bias_label"].values]
        wide = tree["verdict"].to_dataset()["inflation"].values if "verdict" in tree.children else np.ones(len(labels))
        return cls(labels, group["information"].values, group["pull"].values, np.maximum(wide, 1.0))

    def about(self, labels: list[str]) -> "Likelihood":
        """The same about these biases alone, the others integrated under their declared scales."""
        at = [self.labels.index(label) for label in labels]
        information, gain = marginalise(self.information, at)
        return Likelihood(labels, information, self.pull[at] - gain.T @ np.delete(self.pull, at), self.inflation[at])


@checked
def changes(first: xr.DataTree, second: xr.DataTree, *, names: Sequence[str] = ("first", "second")) -> xr.DataTree:
    """The changes between two recordings of one network, second less first, with intervals.

    `first` and `second` are results of `fit` (or loaded ones), best after `assess`, whose overdispersion widens the
    intervals. Returns a tree:

    - `change` (bias_label): change, sd, lower and upper in the unit of the bias, t, `first` and `second` (the means of
      the fits), verdict: "moved", "no change seen", or "not told" where the data say too little (an sd above the
      declared scale);
    - `finding`: kind, subject and a sentence each.

    A bias counts as moved where its change, with all others held common but for those that moved too, passes the
    limit of a false-alarm rate of 1 % over all biases (attributes `limit`, `rate`); a sentence names the biases whose
    change would explain the data as well. Biases that one fit lacks are integrated out, and so are the steps of a
    drifting one: it is compared at its first piece. Both networks have the same sensor models and count biases from
    the same stated values. Raises `InputError` for a tree that is no fit or no answer, for other scales or units, other
    stated values or fixed biases, for the same data twice, and where no bias is common.

    >>> later = probcal.simulate(network, motion, np.arange(60.0), key=1, biases={"sonar_0.heading": 0.1})
    >>> moved = changes(tree, probcal.fit(Problem(network, motion, later.table), probcal.EA()))["change"].to_dataset()
    >>> moved["verdict"].sel(bias_label="sonar_0.heading").item()
    'moved'
    """
    if len(names) != 2 or names[0] == names[1]:
        raise InputError(f"changes: names is {tuple(names)}; give two that differ")
    pair = dict(zip(map(str, names), (first, second), strict=True))
    for name in pair:
        check_name("changes: a recording", name)
    for name, tree in pair.items():
        _check(name, tree)
    _check_zero(pair)
    every = set(listed_in(first, "calibration", "bias_label"))  # of a drifting bias the first piece stays
    labels = [label for label in common_labels(pair, "changes") if step_of(label, every) is None]
    one, two = (tree["observed_data"].to_dataset() for tree in (first, second))
    if all(np.array_equal(one[name].values, two[name].values) for name in ("y", "time", "sensor")):
        raise InputError("changes: both fits are of the same data; compare() puts methods side by side")
    said = [Likelihood.of(tree).about(labels) for tree in pair.values()]
    group = first["calibration"].to_dataset().sel(bias_label=labels)
    change = _changes(said, group["scale"].values)
    means = [tree["calibration"].to_dataset().sel(bias_label=labels)["mean"].values for tree in pair.values()]
    columns = {**change, "first": means[0], "second": means[1]}
    coords = {"bias_label": labels} | {name: ("bias_label", group[name].values) for name in ("unit", "scale")}
    found = xr.Dataset(along("bias_label", columns), coords)
    found.attrs |= {"limit": float(np.sqrt(limit_of(len(labels)))), "rate": RATE}
    told = _findings(found, pair)
    tree = xr.DataTree.from_dict({"change": found, "finding": finding_group(told)})
    tree.attrs |= {"first": str(names[0]), "second": str(names[1]), "interval_probability": INTERVAL}
    return tree


def _check(name: str, tree: xr.DataTree) -> None:
    """Raise `InputError` for a tree that is no answer, or does not say what its data tell."""
    if not isinstance(tree, xr.DataTree) or not {"calibration", "observed_data", "constant_data"} <= set(tree.children):
        raise InputError(f'changes: "{name}" is no result of fit(); give trees of fit() or load()')
    status = str(tree.attrs.get("status", "unknown"))
    if status not in set(Status) or not Status(status).settled:
        raise InputError(f'changes: the fit "{name}" ended "{status}" and is no answer; mend it first')
    group = tree["calibration"].to_dataset()
    if "pull" not in group:
        raise InputError(f'changes: "{name}" does not keep what its data say of the biases; fit it again')
    matrix_of(group, "information", "changes")
    if not all(np.isfinite(values).all() for values in Likelihood.of(tree)[1:]):
        raise InputError(f'changes: what the data of "{name}" say of the biases is not finite; fit it again')


def _check_zero(pair: dict[str, xr.DataTree]) -> None:
    """Raise `InputError` where the fits count a bias from other stated values, or hold one that the other does not."""
    (one, first), (two, second) = pair.items()
    if len({str(tree.attrs.get("network", "")) for tree in pair.values()}) > 1:
        raise InputError(f'changes: "{one}" and "{two}" started from different networks; give both one --network')
    stated = [_stated(first), _stated(second)]
    for what in stated[0].keys() & stated[1].keys():
        a, b = (own[what] for own in stated)
        if not np.isclose(a, b, rtol=1e-9, atol=1e-12):
            values = f'{a:.10g} in "{one}" and {b:.10g} in "{two}"'
            raise InputError(f"changes: {what} is stated as {values}; state the same values in both")
    held = [held_biases(first), held_biases(second)]
    free = [set(listed_in(tree, "calibration", "bias_label")) for tree in pair.values()]
    for k, name in enumerate(pair):
        for label, value in held[k].items():
            if label in free[1 - k] or not np.isclose(held[1 - k].get(label, value), value):
                raise InputError(f'changes: {label} is fixed at {value:g} in "{name}" only; fix the same in both')


def _stated(tree: xr.DataTree) -> dict[str, float]:
    """Stated values of the nodes that rest, by node and component."""
    moving = tree["constant_data"].to_dataset()["moving"].to_series()
    values = stated_values(tree)
    return {label: value for label, value in values.items() if not moving[label_parts(label)[0]]}


def _changes(said: Sequence[Likelihood], scale: np.ndarray) -> dict[str, np.ndarray]:
    """Columns of the change of each bias in its unit, beside those that moved more."""
    M = len(scale)
    information = np.zeros((2 * M, 2 * M))
    for k, own in enumerate(said):
        information[k * M : (k + 1) * M, k * M : (k + 1) * M] = own.information
    both = pieces.Pieces(information, np.concatenate([own.pull for own in said]), np.eye(M), np.zeros(M))
    inflation = np.maximum(*(own.inflation for own in said))
    moved = pieces.changing(both, {"second": PATTERN}, {"second": inflation}, M, most=M)
    free = _beside_each_other(both, [one.bias for one in moved], inflation)
    beside = _but(both, free) | free
    value, sd = np.zeros(M), np.full(M, np.inf)  # of what neither recording sees
    for m, contrast in beside.items():
        value[m], sd[m] = contrast.estimate[0], np.sqrt(inflation[m] / contrast.information[0, 0])
    t = value / sd
    told = ["moved" if m in free else "no change seen" if sd[m] ** -2 >= TOLD else "not told" for m in range(M)]
    ends = {"lower": value - HALF * sd, "upper": value + HALF * sd}
    alike = [", ".join(said[0].labels[k] for k in _alike(both, m, free, inflation)) for m in range(M)]
    return {
        "change": value * scale, "sd": sd * scale, **{name: end * scale for name, end in ends.items()}, "t": t,
        "verdict": np.array(told), "alike": np.array(alike),
    }  # fmt: skip


def _beside_each_other(both: pieces.Pieces, moved: list[int], inflation: np.ndarray) -> dict[int, pieces.Contrast]:
    """The change of each moved bias given the others; drops those that these explain, least
    first."""
    limit = limit_of(len(inflation))
    while moved:
        found = {m: _but(both, moved, m).get(m) for m in moved}
        square = {m: one.square / inflation[m] if one is not None else 0.0 for m, one in found.items()}
        least = min(moved, key=square.__getitem__)
        if square[least] > limit:
            return {m: one for m, one in found.items() if one is not None}
        moved = [m for m in moved if m != least]
    return {}


def _but(both: pieces.Pieces, free: Iterable[int], kept: int = -1) -> dict[int, pieces.Contrast]:
    """The change of each bias where the biases in `free`, except `kept`, change too."""
    return pieces.contrasts(both, PATTERN, [(k, PATTERN) for k in free if k != kept])


def _alike(both: pieces.Pieces, moved: int, free: dict[int, pieces.Contrast], inflation: np.ndarray) -> list[int]:
    """Other biases whose change in the place of one that moved would explain the data about as well."""
    if moved not in free:
        return []
    least = free[moved].square / inflation[moved] - ALIKE
    return [k for k, one in _but(both, free, moved).items() if k not in free and one.square / inflation[k] > least]


def _contradictions(tree: xr.DataTree) -> str:
    """The number of biases of a fit that drift or are in conflict; empty where no assessment was kept."""
    words = listed_in(tree, "verdict", "verdict")
    counts = {word: words.count(word) for word in ("drifting", "conflicting")}
    return ", ".join(f"{count} {word}" for word, count in counts.items() if count)


def _findings(found: xr.Dataset, pair: dict[str, xr.DataTree]) -> list[Finding]:
    """A sentence for each bias that moved, one for those that are not told, one for what stays common otherwise."""
    said = [
        Finding("doubt", name, f"{name} contradicts its model ({doubt}): what is said to have moved may be that")
        for name, doubt in ((name, _contradictions(tree)) for name, tree in pair.items())
        if doubt
    ]
    verdicts, far = found["verdict"].values, np.abs(found["t"].values)
    labels = found["bias_label"].values.astype(str)
    for k in sorted(np.flatnonzero(verdicts == "moved").tolist(), key=lambda k: -far[k]):
        other = str(found["alike"].values[k])
        more = f"; or {other} did: the data cannot tell them apart" if other else ""
        said.append(Finding("moved", labels[k], f"{labels[k]} moved by {_size(found, k)}{more}"))
    seen = np.flatnonzero(verdicts == "no change seen")
    if len(seen):
        k = int(seen[np.argmax(far[seen])])
        what = "one bias" if len(seen) == 1 else f"{len(seen)} biases"
        said.append(
            Finding("held", labels[k], f"no change seen in {what}; the largest, {labels[k]}, {_size(found, k)}")
        )
    silent = labels[verdicts == "not told"].tolist()
    if silent:
        said.append(Finding("not told", "", f"the data say too little to tell a change of {listed(silent)}"))
    for name, tree in pair.items():
        if "verdict" not in tree.children:
            said.append(Finding("assess", name, f'"{name}" was not assessed: the declared noise is taken as right'))
        if rivals(tree).sizes["mode"]:
            said.append(Finding("mirror", name, f'"{name}" has another answer on the other side of a mirror'))
    return said


def _size(found: xr.Dataset, k: int) -> str:
    """A change with its sd, unit and how far it is from none."""
    change, sd, t = (float(found[name].values[k]) for name in ("change", "sd", "t"))
    unit = str(found["unit"].values[k])
    far = f"{abs(t):.1f} sd, limit {found.attrs['limit']:.1f}"
    return f"{change:.3g} ± {sd:.2g}{'' if unit == '1' else f' {unit}'} ({far})"
