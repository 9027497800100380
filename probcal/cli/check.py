"""`check`: what the data can and cannot determine, by name, what to do, and what to measure next."""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from probcal import plots
from probcal.analysis import bound_map, next_anchors, next_passes, next_sensors, observability
from probcal.analysis.standpoint import standpoint
from probcal.cli.files import formatted, printed_rows, write_result
from probcal.cli.models import load_problem, on_network
from probcal.cli.progress import shown
from probcal.errors import InputError
from probcal.files import Outputs
from probcal.gaussian.choose import choose
from probcal.gaussian.mode import Point
from probcal.inference.progress import Monitor
from probcal.labels import NOBODY
from probcal.problem import Problem
from probcal.results.read import frame_of, listed_in

Plans = tuple[xr.Dataset | None, xr.Dataset, xr.Dataset]
LISTED = 12  # directions of many biases
MAP_CELLS = 60  # of a bound map an axis
COLUMNS = ("unit", "scale", "kind", "sd", "share", "verdict")
STATUS = {
    "determined": "status: determined",
    "weak": "status: weak: some directions are left to prior and survey by half or more",
    "open": "status: open: the data say next to nothing of some direction; a fit may be no answer (exit code 1)",
}


def run(
    model: Path, data: Path | None, fix: Sequence[str], given: Mapping[str, Any], network: Path | None,
    outputs: Outputs | None,
) -> int:  # fmt: skip
    """Check before a fit: what the data can and cannot determine, by name, what to do, and what to measure next."""
    problem = on_network(load_problem(model, data, fix, given)[1], network)
    with shown() as progress:
        monitor = Monitor(progress)
        monitor.enter("start", "check")
        start = standpoint(problem, None, None)
        monitor.enter("determined directions")
        tree = observability(problem, point=start)
        monitor.enter("next measurements")
        try:
            plans: Plans | None = _planned(problem, start)
        except InputError as error:
            plans, reason = None, error
    tree.attrs["model"] = model.stem
    print_known(problem, tree)
    if plans is None:
        print(f"What to measure next is not said: {reason}")
    else:
        _print_plans(plans)
    print(STATUS[tree.attrs["status"]])
    if outputs is not None:
        passes = plans[0] if plans is not None and choose(problem.model).cheap else None
        draw = None if passes is None else partial(_draw, problem, tree, passes)
        write_result(outputs, tree, _biases(tree), draw)
    return 1 if tree.attrs["status"] == "open" else 0


def _planned(problem: Problem, start: Point) -> Plans:
    """Plans of another pass, a survey and a further sensor; no pass where no row has a target."""
    passes = next_passes(problem, point=start) if problem.targets else None
    return passes, next_anchors(problem, point=start), next_sensors(problem, point=start)


def _print_plans(plans: Plans) -> None:
    """Prints the best next measurements; for many biases without the number of directions left."""
    passes, anchors, sensors_ = plans
    counted = "weak" in anchors
    before = f"weak directions now: {anchors.attrs['weak_before']}. " if counted else ""
    print(f"{before}What would tell most (nats{'; weak directions left' if counted else ''}):")
    if passes is not None:
        path = passes["path"].values[0]
        ends = " to ".join("(" + ", ".join(f"{v:.4g}" for v in place) + ")" for place in path[[0, -1]][: len(path)])
        what = "another pass" if len(path) > 1 else "another target"
        print(f"  {what}, {ends} m: {passes['gain'].values[0]:.2f}{_left(passes)}")
    print(f"  {_survey_text(anchors)}{_left(anchors)}")
    place = ", ".join(f"{v:.4g}" for v in sensors_["place"].values[0])
    print(f"  one more {sensors_['type'].values[0]} at ({place}) m: {sensors_['gain'].values[0]:.2f}")


def _left(plan: xr.Dataset) -> str:
    """Weak directions left by the best of a plan, in brackets, where they were counted."""
    return f" ({plan['weak'].values[0]})" if "weak" in plan else ""


def _survey_text(anchors: xr.Dataset) -> str:
    """The survey that tells most of the other biases, in words."""
    label, unit, std, gain = (anchors[name].values[0] for name in ("anchor", "unit", "std", "gain"))
    survey = f"a survey of {label} to {std:.2g} {unit.strip('1')}".rstrip()
    return f"{survey}: {gain:.2f} of the other biases"


def print_known(problem: Problem, tree: xr.DataTree) -> None:
    """Data, biases (of many those that the data tell least of), sensors, targets and what is open."""
    data = problem.measurements
    print(
        f"{data.table.source}: {len(data.time)} rows of {len(set(data.sensor))} sensors, {len(problem.targets)} "
        f"target(s), {sum(len(e.time) for e in problem.epochs)} epochs over {np.ptp(data.time):g} s"
    )
    for name in problem.silent:
        print(f'sensor "{name}" has no row: a fit refuses it; add rows or take it out of the network')
    table = printed_rows(check_table(tree), _biases(tree)["share"])
    print(table.to_string(index=False, justify="right"))
    if len(table) < tree["bias"].sizes["bias_label"]:
        print(f"{len(table)} of {tree['bias'].sizes['bias_label']} biases, those that the data tell least of")
    print("share: how much of the answer the data give under a prior of one scale; sd: the bound that goes with it")
    sensors, targets = (frame_of(tree, group, "leverage")["leverage"].sort_values() for group in ("sensor", "target"))
    print(f"biases that the rows of each sensor determine: {_listed(sensors)}")
    targets = targets.drop(NOBODY, errors="ignore")
    listed = f"of each target: {_listed(targets)}; of" if len(targets) else "of"
    print(f"{listed} the motion: {tree['target'].attrs['motion']:.2f}")
    print(_directions_text(tree))


def _directions_text(tree: xr.DataTree) -> str:
    """The directions that the data leave open, in words, each with its remedy."""
    if "direction" not in tree.children:
        surveyed = "survey" in listed_in(tree, "bias", "kind")
        return f"the data determine every direction of the biases{' without a survey' if surveyed else ''}"
    frame = frame_of(tree, "direction", "kind", "share", "words", "remedy")
    count = max(len(frame), int(tree.attrs["weak"]))
    plural = "s" * (count > 1)
    lines = [f"{count} direction{plural} of the biases that the data hardly determine; remedies add up (--fix LABEL):"]
    if count > len(frame):
        lines = [f"{count} directions of the biases that the data hardly determine, {LISTED} of them:"]
    shown = frame[:LISTED] if count > len(frame) else frame
    for k, (name, kind, share, words, remedy) in enumerate(shown.itertuples(name=None), 1):
        lines.append(f"  {k}. {name} ({kind}, the data give {share:.2g} of the answer)")
        lines += [f"     {words}", f"     {remedy}"]
    return "\n".join([*lines, tree.attrs["rule"]])


def _listed(values: pd.Series, most: int = 8) -> str:
    """Names and numbers of a series in one line, the first and the last where there are many."""
    pairs = [f"{name} {value:.2f}" for name, value in values.items()]
    return ", ".join(pairs if len(pairs) <= most else [*pairs[: most // 2], "...", *pairs[-most // 2 :]])


def _biases(tree: xr.DataTree) -> pd.DataFrame:
    """The biases of a check: bias, unit, scale (or survey), kind, sd (bound), share, verdict."""
    return frame_of(tree, "bias", *COLUMNS).rename_axis("bias").reset_index()


def check_table(tree: xr.DataTree) -> pd.DataFrame:
    """The same with its numbers as texts."""
    return formatted(_biases(tree), {"scale": "{:.4g}", "sd": "{:.4g}", "share": "{:.3f}"})


def _draw(problem: Problem, tree: xr.DataTree, passes: xr.Dataset, path: Path) -> None:
    """Write the pictures of a check."""
    low, high = passes["path"].values.min((0, 1)), passes["path"].values.max((0, 1))
    height = float((low + high)[2] / 2) if len(low) == 3 else None
    sides = list(zip(low[:2].tolist(), high[:2].tolist(), strict=True))
    bound = bound_map(problem, sides, cells=MAP_CELLS, biases="unknown", z=height)
    plots.draw_check(tree, passes, bound, path)
