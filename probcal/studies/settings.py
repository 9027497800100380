"""Settings of a study, checked before any run."""

from collections.abc import Sequence
from typing import Any

from probcal.errors import InputError

RESERVED = ("run", "estimator", "method", "bias_label", "bias_rmse", "coverage", "position_rmse", "status",
            "iterations", "error", "lower", "upper", "true", "sd", "gamma", "mean", "median", "worst", "position",
            "runs", "ran", "problem")  # fmt: skip


def check_setting(name: str, values: Sequence[Any]) -> None:
    """Raise `InputError` for a name that the results use, and for values that cannot label them."""
    if name in RESERVED:
        raise InputError(f'study: a setting cannot be called "{name}", the results use that name; rename the argument')
    if any(not isinstance(value, (int, float, str, bool)) for value in values):
        raise InputError(f"study: the values of {name} must be numbers or texts")
    if len(set(values)) < len(values):
        raise InputError(f"study: a value of {name} is given twice; give every value once")
