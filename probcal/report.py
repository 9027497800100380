"""One self-contained HTML page of a saved fit: verdict, table of biases, weak directions and pictures."""

import base64
import io
import json
from collections.abc import Callable
from os import PathLike
from pathlib import Path
from typing import Any

import jinja2
import matplotlib
import numpy as np
import xarray as xr
from matplotlib.axes import Axes

from probcal import plots
from probcal.files import write_whole
from probcal.results.drifts import drift_table
from probcal.results.read import outliers
from probcal.results.schema import EVIDENCES, evidence_in
from probcal.status import INVALID, Status

NONE = "–"  # where there is no finite number
EXTRA = {"r_hat": "r_hat", "ess_bulk": "ess bulk", "ess_tail": "ess tail", "ess": "ess"}  # of samplers
LISTED = 20  # outlying data in the table
CHECKED = 60  # rows of a table of checks
# group of an assessment -> title, what a row is, and its columns with what they are called
CHECKS: dict[str, tuple[str, tuple[str, ...], dict[str, str]]] = {
    "sensor_check": (
        "Sensors: innovations, and what the other sensors say of each",
        ("sensor",),
        {"data": "data", "nis": "NIS", "elpd": "elpd left out", "difference": "gain by calibration, nats",
         "rest_nis": "NIS given the rest", "pareto_k": "Pareto k"},
    ),
    "target_check": (
        "Targets: innovations, and what the other targets say of each",
        ("target",),
        {"data": "data", "nis": "NIS", "elpd": "elpd left out", "rest_nis": "NIS given the rest",
         "pareto_k": "Pareto k"},
    ),
    "channel_check": (
        "Channels: whiteness and predictive checks",
        ("sensor", "channel"),
        {"data": "data", "nis": "NIS", "mean": "mean", "autocorrelation": "lag-1 correlation",
         "white": "Ljung-Box p", "p_misfit": "predictive p, misfit", "p_mean": "predictive p, mean"},
    ),
}  # fmt: skip
COLOURS = {str(s): "good" if s.settled else "warn" if s.valid else "bad" for s in Status}

PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{{ title }}: calibration by {{ attrs.method }}</title>
<style>
body { font: 15px/1.45 system-ui, sans-serif; color: #1a1a1a; background: #fff; max-width: 900px;
  margin: 1.5rem auto; padding: 0 1rem; overflow-wrap: anywhere; }
h1 { font-size: 1.6rem; margin: 0; } h2 { font-size: 1.15rem; margin: 2rem 0 .5rem; }
.sub { color: #4a4a4a; margin: .2rem 0 1rem; }
.banner { border-left: 8px solid; padding: .6rem 1rem; margin: 1rem 0; }
.banner strong { display: block; } .banner p { margin: .2rem 0 0; }
.good { background: #e7f4e8; border-color: #1f7a34; } .warn { background: #fff4d6; border-color: #a86a00; }
.bad { background: #fde8e6; border-color: #b3150f; } .plain { background: #efefef; border-color: #6b6b6b; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: 13px; font-variant-numeric: tabular-nums; }
caption { text-align: left; padding: .3rem 0; color: #4a4a4a; }
th, td { padding: .2rem .55rem; border-bottom: 1px solid #d5d5d5; text-align: right; white-space: nowrap; }
th:first-child, td:first-child, .text { text-align: left; } th { border-bottom: 2px solid #6b6b6b; }
tbody th { font-weight: normal; border-bottom: 1px solid #d5d5d5; white-space: normal; min-width: 9rem; }
.invalid { border: 3px solid #b3150f; } .invalid caption { color: #b3150f; font-weight: bold; }
.invalid tbody td { color: #767676; } tr.bad td, tr.bad th { background: #fde8e6; color: #b3150f; }
tr.pruned td, tr.pruned th { color: #6b6b6b; }
figure { margin: 0 0 1rem; } img { max-width: 100%; height: auto; }
footer { margin-top: 2rem; padding-top: .5rem; border-top: 1px solid #d5d5d5; color: #4a4a4a;
  font-size: 13px; }
@media print { body { max-width: none; margin: 0; font-size: 11px; } table { font-size: 9px; }
  th, td { padding: .1rem .3rem; } tbody th { min-width: 0; } .scroll { overflow: visible; }
  thead { display: table-header-group; } tr { break-inside: avoid; } h2 { break-after: avoid; }
  figure { break-inside: avoid; } img { max-height: 24cm; }
  * { -webkit-print-color-adjust: exact; print-color-adjust: exact; } }
</style>
</head>
<body>
<h1>{{ title }}</h1>
<p class="sub">Method {{ attrs.method }}, prior {{ attrs.prior }}{% if source %}, data {{ source }}{% endif %}
{%- if evidence %}, {{ evidence }}{% endif %}</p>
<div class="banner {{ colour }}" role="status">
<strong>{{ attrs.status | capitalize }}{% if invalid %}: estimate invalid{% endif %}</strong>
{% if attrs.message %}<p>{{ attrs.message }}</p>{% endif %}
</div>
{% if rmse %}<p>Position RMSE: <strong>{{ rmse[0] }} m</strong> before calibration,
<strong>{{ rmse[1] }} m</strong> after.</p>{% endif %}

<h2>Biases</h2>
<div class="scroll" tabindex="0" role="region" aria-label="Table of biases">
<table class="biases{% if invalid %} invalid{% endif %}">
<caption>{% if invalid %}Estimate invalid: the fit ended "{{ attrs.status }}"; do not use these numbers.
{% endif %}Intervals hold {{ probability }}{% if attrs.intervals %}; {{ attrs.intervals }}{% endif %}.
gamma: how well the data determine a bias (0 prior only, 1 data only).</caption>
<thead><tr>{% for name in columns %}<th scope="col"
{%- if name in ("bias", "unit", "status", "verdict", "reason") %} class="text"{% endif %}>{{ name }}</th>
{%- endfor %}</tr></thead>
<tbody>
{% for row in rows %}<tr class="{{ row.colour }}"><th scope="row">{{ row.label }}</th>
{%- for cell, text in row.cells %}<td{% if text %} class="text"{% endif %}>{{ cell }}</td>{% endfor %}</tr>
{% endfor %}</tbody>
</table>
</div>
{% for table in tables %}
<h2>{{ table.title }}</h2>
<table>
<thead><tr>{% for name in table.columns %}<th scope="col">{{ name }}</th>{% endfor %}</tr></thead>
<tbody>{% for row in table.rows %}
<tr><th scope="row">{{ row[0] }}</th>{% for cell in row[1:] %}<td>{{ cell }}</td>{% endfor %}</tr>{% endfor %}
</tbody>
</table>
{% endfor %}
{% if findings %}
<h2>Findings</h2>
<ul>{% for sentence in findings %}<li>{{ sentence }}</li>{% endfor %}</ul>
{% endif %}
{% if directions %}
<h2>Weak directions</h2>
<p>Combinations of biases that the data hardly determine, the weakest first.</p>
<ol>{% for sentence in directions %}<li>{{ sentence }}</li>{% endfor %}</ol>
{% endif %}
{% for picture in pictures %}
<h2>{{ picture.title }}</h2>
<figure><img src="{{ picture.source }}" alt="{{ picture.alt }}"></figure>
{% endfor %}
<footer>Seed {{ attrs.seed }}.{% if versions %} Versions: {{ versions }}.{% endif %}</footer>
</body>
</html>
"""


def write_report(tree: xr.DataTree, path: str | PathLike[str]) -> Path:
    """Write the report of a fit as one HTML file; a file of that name is whole or absent."""
    return write_whole(path, _render(tree))


def _render(tree: xr.DataTree) -> str:
    """The page as text."""
    attrs: dict[str, Any] = {
        "method": "",
        "prior": "",
        "status": "unknown",
        "seed": NONE,
        "message": "",
        "intervals": "",
    }
    attrs |= {str(name): value for name, value in tree.attrs.items()}
    columns, rows = _biases(tree)
    model, data = (str(attrs.get(name, "")) for name in ("model", "data"))
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True)
    return environment.from_string(PAGE).render(
        attrs=attrs,
        title=model or data or "probcal fit",
        source=data if model else "",
        evidence=f"{EVIDENCES[name]} {_number(attrs[name], 7)}" if (name := evidence_in(attrs)) else "",
        colour=COLOURS.get(str(attrs["status"]), "plain"),
        invalid=attrs["status"] in INVALID,
        rmse=_rmse(attrs),
        probability=f"{float(attrs.get('interval_probability', plots.INTERVAL)):.0%}",
        columns=columns,
        rows=rows,
        tables=[
            table
            for table in (
                _levels(tree),
                _fixed(tree),
                _optima(tree),
                _outliers(tree),
                *(_checked(tree, name) for name in CHECKS),
            )
            if table
        ],
        findings=_findings(tree),
        directions=_directions(tree),
        pictures=_pictures(tree),
        versions=_versions(attrs),
    )


# Numbers


def _number(value: float, digits: int = 3) -> str:
    """A number of so many significant digits, or a dash."""
    return f"{float(value):.{digits}g}" if np.isfinite(value) else NONE


def _rounded(value: float, sd: float) -> str:
    """A number as far as its sd carries: to two digits of the sd."""
    if not (np.isfinite(value) and np.isfinite(sd) and sd > 0):
        return _number(value)
    places = 1 - int(np.floor(np.log10(sd)))
    if places > 8 or abs(value) >= 1e7:
        return _number(value)
    text = f"{round(float(value), places):.{max(places, 0)}f}"
    return text.removeprefix("-") if float(text) == 0 else text


def _rmse(attrs: dict[str, Any]) -> list[str]:
    names = ("position_rmse_before", "position_rmse_after")
    return [_number(attrs[name]) for name in names] if all(name in attrs for name in names) else []


def _versions(attrs: dict[str, Any]) -> str:
    try:
        found = json.loads(attrs.get("versions", "{}"))
    except ValueError:
        return str(attrs["versions"])
    return ", ".join(f"{name} {number}" for name, number in found.items())


# Tables


def _biases(tree: xr.DataTree) -> tuple[list[str], list[dict[str, Any]]]:
    """Column names and one row a bias, cells with a mark for text."""
    group = tree["calibration"].to_dataset()
    extra = [name for name in EXTRA if name in group]
    known = tree["truth"].to_dataset()["bias"].to_series().to_dict() if "truth" in tree.children else {}
    columns = ["bias", "unit", "scale", "mean", "sd", "interval", "gamma", "status"]
    judged = tree["verdict"].to_dataset() if "verdict" in tree.children else None
    columns += ["verdict", "reason"] if judged is not None else []
    columns += [EXTRA[name] for name in extra] + (["true value"] if known else [])
    table = {str(name): group[name].values for name in (*group.data_vars, "unit") if group[name].ndim == 1}
    rows = []
    for k, label in enumerate(group["bias_label"].values.tolist()):
        one = {name: values[k] for name, values in table.items()}
        sd, status = float(one["sd"]), str(one["status"])
        mean, lower, upper, spread = (_rounded(float(one[n]), sd) for n in ("mean", "lower", "upper", "sd"))
        cells = [(str(one["unit"]), True), (_number(one["scale"]), False), (mean, False)]
        cells += [(spread, False), (f"{lower} to {upper}", False), (_gamma(float(one["gamma"])), False)]
        cells += [(status, True)]
        if judged is not None:
            cells += [(str(judged[name].values[k]), True) for name in ("verdict", "reason")]
        cells += [(_number(one[name], 4), False) for name in extra]
        if known:
            cells.append((_rounded(known[label], sd) if label in known else "", False))
        colour = "bad" if status in INVALID else "pruned" if status == "pruned" else ""
        rows.append({"label": label, "cells": cells, "colour": colour})
    return columns, rows


def _gamma(value: float) -> str:
    return f"{value:.3f}" if np.isfinite(value) else NONE


def _levels(tree: xr.DataTree) -> dict[str, Any] | None:
    """Table of the estimated noise levels."""
    if "level" not in tree.children:
        return None
    group = tree["level"].to_dataset()
    names = group["level"].values.tolist()
    pairs = zip(names, group["std"].values, group["guess"].values, strict=True)
    rows = [[name, _number(std), _number(guess)] for name, std, guess in pairs]
    return {"title": "Unknown noise levels", "columns": ["level", "std", "guess"], "rows": rows}


def _fixed(tree: xr.DataTree) -> dict[str, Any] | None:
    """Table of the biases that were fixed."""
    group = tree["constant_data"].to_dataset() if "constant_data" in tree.children else xr.Dataset()
    if "fixed" not in group:
        return None
    pairs = zip(group["fixed_label"].values.tolist(), group["fixed"].values, strict=True)
    return {
        "title": "Fixed biases",
        "columns": ["bias", "value"],
        "rows": [[k, _number(v, 6)] for k, v in pairs],
    }


def _optima(tree: xr.DataTree) -> dict[str, Any] | None:
    """Table of the optima that several starts led to, the reported one first."""
    if "optimum" not in tree.children:
        return None
    group = tree["optimum"].to_dataset()
    scale = tree["calibration"].to_dataset()["scale"].values
    apart = np.abs((group["bias"].values - group["bias"].values[0]) / scale).max(1)
    score = evidence_in(group) or "objective"
    rows = [
        [str(start), str(status), _number(value, 7), _number(far)]
        for start, status, value, far in zip(
            group["start"].values, group["status"].values, group[score].values, apart, strict=True
        )
    ]
    columns = ["start", "status", EVIDENCES.get(score, score), "largest difference, in scales"]
    return {"title": "Optima of several starts", "columns": columns, "rows": rows}


def _weighted(tree: xr.DataTree) -> bool:
    """Whether some data count less than others."""
    group = tree["residual"].to_dataset() if "residual" in tree.children else xr.Dataset()
    return "weight" in group and bool((group["weight"] < 1).any())


def _outliers(tree: xr.DataTree) -> dict[str, Any] | None:
    """Table of the data that count least, where the noise has heavy tails."""
    if not _weighted(tree) or not len(listed := outliers(tree)):
        return None
    names = ["row", "sensor", "target", "channel"]
    rows = [
        [*texts, *(_number(value, 6) for value in numbers)]
        for texts, numbers in zip(
            listed[names].head(LISTED).astype(str).to_numpy().tolist(),
            listed[["time", "residual/std", "weight"]].head(LISTED).to_numpy(float),
            strict=True,
        )
    ]
    count, total = len(listed), tree["residual"].sizes["datum"]
    title = f"Outlying data: {count} of {total} count less than half" + (
        f", the first {LISTED}" if count > LISTED else ""
    )
    columns = [*names, "time", "residual/std", "weight"]
    return {"title": title, "columns": columns, "rows": rows}


def _checked(tree: xr.DataTree, name: str) -> dict[str, Any] | None:
    """Table of one group of checks, the columns that it holds, limits as an interval."""
    title, keys, wanted = CHECKS[name]
    if name not in tree.children:
        return None
    group = tree[name].to_dataset()
    columns: dict[str, Any] = {text: group[column].values for column, text in wanted.items() if column in group}
    columns["limits"] = list(zip(group["lower"].values, group["upper"].values, strict=True))
    dim = group["nis"].dims[0]
    rows = [
        [".".join(str(group[key].values[k]) for key in keys)]
        + [
            f"{_number(v[k][0])} to {_number(v[k][1])}" if text == "limits" else _number(v[k], 4)
            for text, v in columns.items()
        ]
        for k in range(min(group.sizes[dim], CHECKED))
    ]
    left = group.sizes[dim] - len(rows)
    return {"title": title + (f", the first {CHECKED}" if left else ""), "columns": [keys[-1], *columns], "rows": rows}


def _findings(tree: xr.DataTree) -> list[str]:
    """Sentences of an assessment."""
    return tree["finding"].to_dataset()["sentence"].values.tolist() if "finding" in tree.children else []


def _directions(tree: xr.DataTree) -> list[str]:
    """Sentences of the weak directions."""
    if "direction" not in tree.children:
        return []
    group = tree["direction"].to_dataset()
    order = np.argsort(group["information"].values, kind="stable")
    return [str(sentence) for sentence in group["sentence"].values[order]]


# Pictures


def _pictures(tree: xr.DataTree) -> list[dict[str, str]]:
    """Pictures of what the tree holds, as data addresses."""
    found: list[tuple[str, str, set[str], Callable[[], Axes]]] = [
        ("Map", "Nodes and tracks before and after calibration", {"constant_data", "track"},
         lambda: plots.plot_map(tree)),
        ("Estimates", "Mean and interval of every bias in units of its scale", {"calibration"},
         lambda: plots.plot_biases(tree)),
        ("Residuals", "Histograms of the residuals before and after calibration", {"residual"},
         lambda: plots.plot_residuals(tree)[0]),
        ("Objective", "Objective over the iterations", {"optimisation"},
         lambda: plots.plot_objective(tree)),
    ]  # fmt: skip
    if _weighted(tree):
        text = "Residuals over time, those that count less than half marked"
        found.insert(3, ("Residuals over time", text, {"residual"}, lambda: plots.plot_outliers(tree)))
    if len(drift_table(tree)):
        text = "Values of the drifting biases over time with their intervals"
        found.insert(2, ("Drift", text, {"posterior"}, lambda: plots.plot_drift(tree)))
    found += [
        ("Verdicts", "Gamma of every bias against how much the data narrow it, coloured by verdict", {"verdict"},
         lambda: plots.plot_shrinkage(tree)),
        ("Innovations", "NIS of every epoch with its limits", {"epoch_check"},
         lambda: plots.plot_nis(tree)),
        ("Sensors left out", "Gain by calibration of each sensor, judged by the rest", {"sensor_check"},
         lambda: plots.plot_left_out(tree)),
        ("Halves", "Change of every bias from the first half to the second", {"halves"},
         lambda: plots.plot_halves(tree)),
    ]  # fmt: skip
    present = set(tree.children)
    return [
        {"title": title, "alt": alt, "source": _embed(draw())} for title, alt, needs, draw in found if needs <= present
    ]


def _embed(ax: Axes) -> str:
    """The figure of these axes as SVG in a data address, the same for the same tree."""
    sheet = io.BytesIO()
    figure = ax.get_figure(root=True)
    assert figure is not None
    with matplotlib.rc_context({"svg.hashsalt": "probcal"}):
        figure.savefig(sheet, format="svg", metadata={"Date": None})
    return "data:image/svg+xml;base64," + base64.b64encode(sheet.getvalue()).decode("ascii")
