"""Numbers and sentences of a report: what a fit found, in words."""

import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from markupsafe import Markup, escape

from probcal.status import INVALID, Status

NONE = "–"  # where there is no finite number
MATTER = 24  # biases in the first table
ASIDE = ("conflicting", "drifting")  # verdicts that come first


class Row(NamedTuple):
    """A bias in the first table."""

    label: str
    value: str
    interval: str
    verdict: str
    reason: str
    true: str


def number(value: float, digits: int = 3) -> str:
    """A number of so many significant digits, or a dash."""
    return f"{float(value):.{digits}g}" if np.isfinite(value) else NONE


def rounded(value: float, sd: float) -> str:
    """A number as far as its sd carries: to two digits of the sd."""
    if not (np.isfinite(value) and np.isfinite(sd) and sd > 0):
        return number(value)
    places = 1 - int(np.floor(np.log10(sd)))
    if places > 8 or abs(value) >= 1e7:
        return number(value)
    text = f"{round(float(value), places):.{max(places, 0)}f}"
    return text.removeprefix("-") if float(text) == 0 else text


def with_unit(text: str, unit: str) -> str:
    """A number with its unit, if it has one."""
    return text if unit == "1" or text == NONE else f"{text} {unit}"


def breakable(label: str) -> Markup:
    """A label that may go on in the next line behind a point or underscore, and nowhere else."""
    return Markup("<wbr>").join(escape(part) for part in re.findall(r"[^._]*[._]?", str(label)) if part)


def sentences(message: str) -> list[str]:
    """The sentences of a message, each by itself."""
    return [part for part in re.split(r"(?<=[.!?]) (?=[A-Z])", message.strip()) if part]


def headline(tree: xr.DataTree) -> str:
    """The verdict on a fit in one sentence."""
    ended = str(tree.attrs.get("status", ""))
    if ended not in set(Status):
        return f'The fit ended "{ended}".' if ended else "The fit does not say how it ended."
    status = Status(ended)
    if not status.settled:
        return f"The fit {status.said}." if not status.valid else f"The fit {status.said}: its numbers are no answer."
    group = tree["calibration"].to_dataset()
    away, total = np.flatnonzero(_away(group)), group.sizes["bias_label"]
    told = "no bias differs from zero"
    if len(away):
        most = away[np.argmax(np.abs(group["mean"].values / group["sd"].values)[away])]
        verb = "differs" if len(away) == 1 else "differ"
        told = f"{len(away)} of {total} biases {verb} from zero, most clearly {group['bias_label'].values[most]} at "
        told += _value(group, int(most))
    return f"The fit {status.said}: {told}{_judged(tree)}."


def _judged(tree: xr.DataTree) -> str:
    """How many biases have which verdict."""
    if "verdict" not in tree.children:
        return ""
    verdicts = tree["verdict"].to_dataset()["verdict"].values.tolist()
    counts = {name: verdicts.count(name) for name in ("determined", *ASIDE, "weak", "prior only")}
    return "; " + ", ".join(f"{count} {name}" for name, count in counts.items() if count)


def nothing_found(tree: xr.DataTree) -> str:
    """What it means that no bias is shown: how many the data tell of, or that nobody asked."""
    if "verdict" not in tree.children:
        return "; the fit was not assessed"
    verdicts = tree["verdict"].to_dataset()["verdict"].values
    told = int((verdicts == "determined").sum())
    return f"; the data determine {told} of {len(verdicts)}"


def in_conflict(tree: xr.DataTree) -> bool:
    """Whether some bias conflicts with the model or drifts."""
    return "verdict" in tree.children and bool(np.isin(tree["verdict"].to_dataset()["verdict"].values, ASIDE).any())


def _away(group: xr.Dataset) -> np.ndarray:
    """Which intervals leave zero out, (M,) bool."""
    return (group["lower"].values > 0) | (group["upper"].values < 0)


def _value(group: xr.Dataset, k: int) -> str:
    """Mean ± sd of bias k with its unit."""
    mean, sd, grain = float(group["mean"].values[k]), float(group["sd"].values[k]), _grain(group, k)
    return with_unit(f"{rounded(mean, grain)} ± {rounded(sd, grain)}", str(group["unit"].values[k]))


def _grain(group: xr.Dataset, k: int) -> float:
    """What the digits of bias k follow: its sd, but nothing finer than a thousandth of its scale."""
    return max(float(group["sd"].values[k]), 1e-3 * float(group["scale"].values[k]))


def that_matter(tree: xr.DataTree) -> tuple[list[Row], int]:
    """Biases in conflict or invalid, then those away from zero, then the weak ones; and how many are left out."""
    group = tree["calibration"].to_dataset()
    count = group.sizes["bias_label"]
    judged = tree["verdict"].to_dataset() if "verdict" in tree.children else None
    verdicts = judged["verdict"].values.tolist() if judged is not None else [""] * count
    reasons = judged["reason"].values.tolist() if judged is not None else [""] * count
    status = group["status"].values.tolist()
    with np.errstate(invalid="ignore", divide="ignore"):
        far = np.nan_to_num(np.abs(group["mean"].values / group["sd"].values), nan=np.inf)
    rank = np.full(count, 3)
    rank[[verdict == "weak" and one != "pruned" for verdict, one in zip(verdicts, status, strict=True)]] = 2
    rank[_away(group)] = 1
    rank[[v in ASIDE or s in INVALID for v, s in zip(verdicts, status, strict=True)]] = 0
    order = [k for k in np.lexsort((-far, rank)).tolist() if rank[k] < 3]
    true = true_values(tree)
    rows = []
    for k in order[:MATTER]:
        label, unit, grain = str(group["bias_label"].values[k]), str(group["unit"].values[k]), _grain(group, k)
        lower, upper = (rounded(float(group[name].values[k]), grain) for name in ("lower", "upper"))
        known = with_unit(rounded(true[label], grain), unit) if label in true else ""
        verdict = status[k] if status[k] in INVALID else verdicts[k]
        rows.append(Row(label, _value(group, k), f"{lower} to {upper}", verdict, reasons[k], known))
    said = said_once([row.label for row in rows], [row.reason for row in rows])
    rows = [row._replace(reason=reason) for row, reason in zip(rows, said, strict=True)]
    return rows, len(order) - len(rows)


def said_once(labels: Sequence[str], reasons: Sequence[str]) -> list[str]:
    """Every reason in full where it stands first; where it stands again, the bias that has it."""
    first: dict[str, str] = {}
    owners = [first.setdefault(reason, label) for label, reason in zip(labels, reasons, strict=True)]
    return [
        reason if owner == label or not reason else f"as {owner}"
        for label, reason, owner in zip(labels, reasons, owners, strict=True)
    ]


def true_values(tree: xr.DataTree) -> dict[str, float]:
    """True biases by label, none where they are not known."""
    if "truth" not in tree.children:
        return {}
    return {str(label): float(value) for label, value in tree["truth"].to_dataset()["bias"].to_series().items()}


def position_errors(attrs: dict[str, Any]) -> str:
    """The sentence on the position error before and after, and how the answer was laid on the truth."""
    for suffix, how in (
        ("", ""),
        ("_rigid", ", laid on the truth as a rigid body"),
        ("_similarity", ", as a similarity"),
    ):
        names = [f"position_rmse_{when}{suffix}" for when in ("before", "after")]
        if all(name in attrs for name in names):
            before, after = (number(attrs[name]) for name in names)
            return f"Position error (RMSE) {before} m before calibration, {after} m after{how}."
    return ""
