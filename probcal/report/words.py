"""Numbers and sentences of a report: what a fit found, in words."""

import re
from collections import Counter
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from markupsafe import Markup, escape

from probcal.analysis.findings import LAST
from probcal.labels import listed
from probcal.results.read import known_truth, listed_in, summary
from probcal.results.schema import VERDICTS
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


def fixed(value: float, places: int) -> str:
    """A number with so many places, or a dash."""
    return f"{value:.{places}f}" if np.isfinite(value) else NONE


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
    frame, told = bias_frame(tree), "no bias differs from zero"
    away = frame[frame["away"]]
    if len(away):
        most = away["far"].idxmax()
        verb = "differs" if len(away) == 1 else "differ"
        told = f"{len(away)} of {len(frame)} biases {verb} from zero, most clearly {most} at {away['value'][most]}"
    return f"The fit {status.said}: {told}{_judged(tree)}."


def left_open(tree: xr.DataTree) -> str:
    """One sentence on what the data do not tell alone; empty where nothing was assessed."""
    pairs = zip(*(listed_in(tree, "verdict", name) for name in ("bias_label", "verdict")), strict=True)
    every, known = dict(pairs), ("determined", "relative", *ASIDE)
    if not every or not Status(tree.attrs["status"]).settled:
        return ""
    own = [name for name in every if every[name] not in known]
    ways = listed_in(tree, "direction", "direction")
    told = f"The data alone do not tell {len(own)} of {len(every)} biases: {listed(own)}"
    return f"{told if own else 'The data tell every bias'}{f'; left open: {listed(ways, 2)}' if ways else ''}."


def next_step(tree: xr.DataTree) -> str:
    """One sentence on what to look at first: a cause that a check names, else what is open."""
    pairs = zip(listed_in(tree, "finding", "kind"), listed_in(tree, "finding", "sentence"), strict=True)
    if cause := next((sentence for kind, sentence in pairs if kind not in LAST), ""):
        return f"To look at first: {cause}."
    if not listed_in(tree, "verdict", "verdict"):
        return ""
    columns = (listed_in(tree, "direction", name) for name in ("information", "direction", "remedy"))
    _, name, remedy = min(zip(*columns, strict=True), default=(0.0, "", ""))
    return f"To tell {name}: {remedy}." if remedy else "No check asks for a change of the model."


def _judged(tree: xr.DataTree) -> str:
    """The number of biases with each verdict."""
    count = Counter(listed_in(tree, "verdict", "verdict"))
    known = dict.fromkeys((*VERDICTS, *sorted(count)))
    told = [f"{count[name]} {name}" for name in known if count[name]]
    return f"; {', '.join(told)}" if told else ""


def nothing_found(tree: xr.DataTree) -> str:
    """The reason that no bias is shown: how many the data determine, or a fit not assessed."""
    verdicts = listed_in(tree, "verdict", "verdict")
    told = f"the data determine {verdicts.count('determined')} of {len(verdicts)}"
    return f"; {told if verdicts else 'the fit was not assessed'}"


def in_conflict(tree: xr.DataTree) -> bool:
    """True if some bias conflicts with the model or drifts."""
    return not set(ASIDE).isdisjoint(listed_in(tree, "verdict", "verdict"))


def bias_frame(tree: xr.DataTree) -> Any:
    """One row a bias: its summary, true value and value as text, how many sd it is from zero, whether surely.

    Verdict and reason are empty where the fit was not assessed.
    """
    frame = summary(tree).set_index("bias").assign(true=known_truth(tree))
    frame["far"] = (frame["mean"] / frame["sd"]).abs().fillna(np.inf)
    frame["away"] = (frame["lower"] > 0) | (frame["upper"] < 0)
    frame["grain"] = np.maximum(frame["sd"], 1e-3 * frame["scale"])  # digits finer than that say nothing
    for name in ("mean", "sd", "lower", "upper", "true"):
        pairs = zip(frame[name], frame["grain"], strict=True)
        frame[f"{name}_text"] = [rounded(value, grain) for value, grain in pairs]
    values = frame["mean_text"] + " ± " + frame["sd_text"]
    frame["value"] = [with_unit(value, unit) for value, unit in zip(values, frame["unit"], strict=True)]
    return frame.assign(**{name: "" for name in ("verdict", "reason") if name not in frame})


def that_matter(tree: xr.DataTree) -> tuple[list[Row], int]:
    """Biases in conflict or invalid, then those away from zero, then the weak ones; and how many are left out."""
    frame = bias_frame(tree)
    invalid = frame["status"].isin(INVALID)
    weak = (frame["verdict"] == "weak") & (frame["status"] != "pruned")
    frame["rank"] = np.select([frame["verdict"].isin(ASIDE) | invalid, frame["away"], weak], [0, 1, 2], 3)
    frame["verdict"] = frame["verdict"].mask(invalid, frame["status"])
    order = np.lexsort((-frame["far"], frame["rank"]))
    chosen = frame.iloc[order][lambda own: own["rank"] < 3]
    shown = chosen[:MATTER]
    reasons = said_once(shown.index, shown["reason"])
    rows = [
        Row(
            label=one.Index,
            value=one.value,
            interval=f"{one.lower_text} to {one.upper_text}",
            verdict=one.verdict,
            reason=reason,
            true=with_unit(one.true_text, one.unit) if np.isfinite(one.true) else "",
        )
        for one, reason in zip(shown.itertuples(), reasons, strict=True)
    ]
    return rows, len(chosen) - len(rows)


def said_once(labels: Iterable[str], reasons: Iterable[str]) -> list[str]:
    """Every reason in full where it stands first; where it stands again, the bias that has it."""
    first: dict[str, str] = {}
    owners = [(first.setdefault(reason, label), label, reason) for label, reason in zip(labels, reasons, strict=True)]
    return [reason if owner == label or not reason else f"as {owner}" for owner, label, reason in owners]


def position_errors(attrs: dict[str, Any]) -> str:
    """The sentence on the position error before and after, and how the answer was laid on the truth."""
    laid = {"": "", "_rigid": ", laid on the truth as a rigid body", "_similarity": ", as a similarity"}
    for suffix, how in laid.items():
        if f"position_rmse_after{suffix}" in attrs:
            before, after = (number(attrs[f"position_rmse_{when}{suffix}"]) for when in ("before", "after"))
            return f"Position error (RMSE) {before} m before calibration, {after} m after{how}."
    return ""
