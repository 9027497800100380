"""The form of a tree of results: version, columns, and what readers of a file take for granted.

Group `mode` (dimension `mode`) has all answers of a fit, the reported one first: its name, `kind`
("reported"; "scene", "piece", "node" or "start" of another answer, by what it differs; "again" of a
further start that came back to one of them; "rejected" of one that ended far below or invalid;
"part" of an answer that the reported mixture is of), `gain` (evidence or log density less that of
the reported answer, nats; of a part the logarithm of its weight), `bias` and `apart` (its
distance in sd) by bias, `status` of the fit from there (empty where the answer was found and not
fitted), `start` (the number of the start that led to it, -1 of none) and its `objective`. An answer
whose gain is above minus the attribute `same` fits as well. Of several answers
`mode/track/<target>` has the places. A reader takes words that it does not know, as of a verdict or
a kind, for what they are: texts.

A file of version 3 has groups `mirror` and `optimum` for this one; `load` turns them into it
(`results.modes`).
"""

from collections.abc import Container, Hashable
from typing import Any, NamedTuple

import numpy as np

from probcal.errors import InputError

INTERVAL = 0.89  # probability of lower to upper
VERDICTS = "determined", "relative", "conflicting", "drifting", "by the prior", "weak", "prior only"
# of what a fit writes; a reader takes files of version 3 too and refuses any other
RESULTS_VERSION = 4
MORE = ("r_hat", "ess", "ess_tail", "inclusion", "included", "contraction")  # columns of samplers
SUMMARY = ("bias", "unit", "scale", "mean", "sd", "lower", "upper", "gamma")


class Member(NamedTuple):
    """The form of a variable of a saved fit: its dimensions, the kind of its values, and the range
    of numbers."""

    dims: tuple[str, ...]
    kind: str = "numbers"  # or "texts", "flags", "any"
    least: float = -np.inf
    most: float = np.inf
    finite: bool = False  # whether the numbers are finite in every fit, one that gave no answer too


_BIAS, _DATUM, _STATE = ("bias_label",), ("datum",), ("time", "component")
_BIAS_TEXT, _DATUM_TEXT = Member(_BIAS, "texts"), Member(_DATUM, "texts")
_PAIR = ("bias_label", "bias_label_other")
_POSITIVE = Member(_BIAS, least=0.0, finite=True)
_DATUM_SIZE = Member(_DATUM, least=0.0)
_MODE, _BY_MODE = ("mode",), ("mode", "bias_label")
NEEDED = {  # what readers of a fit take for granted, by group
    "posterior": {"bias": Member(("chain", "draw", "bias_label"), finite=True)},
    "calibration": {
        "unit": _BIAS_TEXT, "scale": _POSITIVE, "mean": Member(_BIAS, finite=True), "sd": _POSITIVE,
        "lower": Member(_BIAS, finite=True), "upper": Member(_BIAS, finite=True),
        "gamma": Member(_BIAS, least=0.0, most=1.0, finite=True), "bias_label": _BIAS_TEXT,
        "precision": Member(_BIAS, least=0.0), "status": _BIAS_TEXT, "kind": _BIAS_TEXT,
    },
    "observed_data": {
        "y": Member(_DATUM, finite=True), "sensor": _DATUM_TEXT, "channel": _DATUM_TEXT, "target": _DATUM_TEXT,
        "time": Member(_DATUM, finite=True), "row": Member(_DATUM, "any"),
    },
    "residual": {
        "before": Member(_DATUM), "after": Member(_DATUM), "std": _DATUM_SIZE, "weight": _DATUM_SIZE,
    },
    "constant_data": {
        "node_position": Member(("node", "axis"), finite=True), "node_heading": Member(("node",), finite=True),
        "moving": Member(("node",), "flags"), "stated": Member(("value",), finite=True),
        "stated_node": Member(("value",), "texts"), "stated_component": Member(("value",), "texts"),
    },
    "mode": {
        "mode": Member(_MODE, "texts"), "kind": Member(_MODE, "texts"), "status": Member(_MODE, "texts"),
        "gain": Member(_MODE), "start": Member(_MODE), "objective": Member(_MODE), "bias": Member(_BY_MODE),
        "apart": Member(_BY_MODE, least=0.0),
    },
}  # fmt: skip
# unless in sparse form
WHOLE = {"covariance": Member(_PAIR, finite=True), "information": Member(_PAIR)}
BLOCKS = {  # the same of a fit in sparse form
    "block": _POSITIVE,
    "block_place": _POSITIVE,
    "block_covariance": Member(("bias_label", "place"), finite=True),
}
TRACKED = {  # of each target
    "mean": Member(_STATE),
    "sd": Member(_STATE, least=0.0),
    "before": Member(_STATE),
    "time": Member(("time",), finite=True),
    "component": Member(("component",), "texts"),
}
JUDGED = {  # where they are
    "verdict": {"verdict": _BIAS_TEXT, "reason": _BIAS_TEXT},
    "finding": {"sentence": Member(("finding",), "texts")},
    "level": {
        "std": Member(("level",), least=0.0),
        "guess": Member(("level",), least=0.0, finite=True),
    },
}
ATTRIBUTES = ("method", "prior", "seed", "status", "message", "intervals", "settings", "interval_probability", "data")
DIFFERENT = 2.0  # sd from which a bias is another one in another answer
ROPE = 0.1  # scales within which a bias is practically zero
TYPE_II = "log_evidence_type_ii"  # the largest over the precisions, which are then taken as known
DECLARED = "log_evidence_declared"  # with every bias Gaussian of its declared scale, whatever the prior of the fit
BOUND = "log_evidence_bound"  # the same where process noise is not Gaussian: a variational lower bound, loose by nats
EVIDENCE = {"given": "log_evidence", "maximised": TYPE_II, "integrated": DECLARED}  # by what is done with precisions
EVIDENCES = {
    "log_evidence": "log evidence", TYPE_II: "log evidence (type II)", DECLARED: "log evidence under declared scales",
    BOUND: "log evidence (lower bound)",
}  # fmt: skip


def matrix_of(group: Any, name: str, whose: str) -> Any:
    """The matrix "covariance" or "information" of a group `calibration`, for a reader that cannot do without.

    Raises `InputError` where there is none, as of a large fit in sparse form.
    """
    if name not in group:
        raise InputError(
            f"{whose} needs the {name} of all biases, which a large fit in sparse form does not hold: fit fewer"
            ' sensors, or take EA(engine="dense") where it fits'
        )
    return group[name]


def evidence_in(names: Container[Hashable]) -> str:
    """The name of the evidence among some names, empty if there is none."""
    return next((name for name in EVIDENCES if name in names), "")


def held_biases(tree: Any) -> dict[str, float]:
    """The biases that a fit held, and their values."""
    constant = tree["constant_data"].to_dataset() if "constant_data" in tree.children else {}
    return {str(k): float(v) for k, v in constant["fixed"].to_series().items()} if "fixed" in constant else {}
