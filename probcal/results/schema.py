"""What a tree of results holds: version, columns, and what readers of a file take for granted."""

from collections.abc import Container, Hashable
from typing import Any

from probcal.errors import InputError

INTERVAL = 0.89  # probability of lower to upper
RESULTS_VERSION = 3  # of the groups and variables that a fit writes; a reader refuses any other
MORE = ("r_hat", "ess", "ess_tail", "inclusion", "included", "contraction")  # columns of samplers
SUMMARY = ("bias", "unit", "scale", "mean", "sd", "lower", "upper", "gamma")
NEEDED = {  # what readers of a fit take for granted
    "posterior": ("bias",),
    "calibration": (*SUMMARY[1:], "bias_label", "precision", "status", "kind"),
    "observed_data": ("y", "sensor", "channel", "target", "time", "row"),
    "residual": ("before", "after", "std", "weight"),
    "constant_data": ("node_position", "node_heading", "moving", "stated", "stated_node", "stated_component"),
}
WHOLE = ("covariance", "information")  # of `calibration`, but for a fit in sparse form
TRACKED = ("mean", "sd", "before", "time", "component")  # of each target
JUDGED = {"verdict": ("verdict", "reason"), "finding": ("sentence",), "level": ("std", "guess")}  # where they are
ATTRIBUTES = ("method", "prior", "seed", "status", "message", "intervals", "settings", "interval_probability", "data")
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

    Raises `InputError` for a fit in sparse form, which holds none.
    """
    if name not in group:
        raise InputError(
            f"{whose} needs the {name} of all biases, which a fit in sparse form does not hold: fit fewer sensors, or"
            ' take EA(form="dense") where it fits'
        )
    return group[name]


def evidence_in(names: Container[Hashable]) -> str:
    """Which of the evidences is among some names, empty where there is none."""
    return next((name for name in EVIDENCES if name in names), "")
