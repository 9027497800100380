"""The page: what is shown in which order, written whole or not at all."""

import base64
import io
import json
from pathlib import Path
from typing import Any

import jinja2
import matplotlib
import numpy as np
import xarray as xr
from matplotlib.axes import Axes

from probcal import plots
from probcal.errors import InputError
from probcal.files import AnyPath, write_whole
from probcal.plots.base import figure_of
from probcal.report import tables, words
from probcal.results.drifts import drift_table
from probcal.results.read import listed_in
from probcal.results.schema import EVIDENCES, evidence_in
from probcal.status import INVALID, Status

COLOURS = {str(s): "good" if s.settled else "warn" if s.valid else "bad" for s in Status}
HERE = Path(__file__).parent
# title of a picture -> what it shows, groups of a tree that it needs, outlying data or drifts, and what draws it
PICTURES = {
    "Map": ("Nodes and tracks before and after calibration", {"constant_data", "track"}, "plot_map"),
    "Estimates": ("Mean and interval of every bias in units of its scale", {"calibration"}, "plot_biases"),
    "Drift": ("Values of the drifting biases over time with their intervals", {"posterior", "drifts"}, "plot_drift"),
    "Residuals": ("Histograms of the residuals before and after calibration", {"residual"}, "plot_residuals"),
    "Residuals over time": (
        "Residuals over time, those that count less than half marked", {"residual", "outliers"}, "plot_outliers"),
    "Objective": ("Objective over the iterations", {"optimisation"}, "plot_objective"),
    "Objects": (
        "Existence of every object that nobody named over time, and how many there are", {"object"}, "plot_objects"),
    "Verdicts": (
        "Gamma of every bias against how much the data narrow it, coloured by verdict", {"verdict"}, "plot_shrinkage"),
    "Innovations": ("NIS of every epoch with its limits", {"epoch_check"}, "plot_nis"),
    "Sensors left out": ("Gain by calibration of each sensor, judged by the rest", {"sensor_check"}, "plot_left_out"),
    "Halves": ("Change of every bias from the first half to the second", {"halves"}, "plot_halves"),
}  # fmt: skip


def write_report(tree: xr.DataTree, path: AnyPath, *, static: bool = False) -> Path:
    """Write the report of a fit as one HTML file that needs nothing else; a file of that name is whole or absent.

    `static` leaves the interactive map, and with it every script, out. Raises `InputError` if the file cannot be
    written.

    >>> write_report(tree, folder / "report.html", static=True).name
    'report.html'
    """
    return write_whole(path, _render(tree, static))


def _render(tree: xr.DataTree, static: bool) -> str:
    """The page as text."""
    if "calibration" not in tree.children:
        raise InputError("write_report: the tree has no group calibration; give a result of fit() or load()")
    names = ("method", "prior", "message", "intervals")
    attrs: dict[str, Any] = dict.fromkeys(names, "") | {"status": "unknown", "seed": words.NONE}
    attrs |= {str(name): value for name, value in tree.attrs.items()}
    model, data = (str(attrs.get(name, "")) for name in ("model", "data"))
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(HERE), autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True,
        lstrip_blocks=True,
    )  # fmt: skip
    environment.filters["breakable"] = words.breakable
    chart = None
    if not static and "track" in tree.children and "constant_data" in tree.children:
        from probcal.report.chart import chart as made  # a static page does without Bokeh

        chart = made(tree)
    columns, rows = tables.biases(tree)
    shown, more = words.that_matter(tree)
    pictures = _pictures(tree, light=() if chart is None else ("Map",))
    drawn = pictures.pop(0) if pictures and pictures[0]["title"] == "Map" else None
    # colour of the verdict: that of the status, a warning where the fit ended well but biases
    # are in conflict
    found = COLOURS.get(str(tree.attrs.get("status")), "plain")
    return environment.get_template("page.html").render(
        attrs=attrs,
        title=model or data or "probcal fit",
        source=data if model else "",
        evidence=f"{EVIDENCES[name]} {words.number(attrs[name], 7)}" if (name := evidence_in(attrs)) else "",
        colour="warn" if found == "good" and words.in_conflict(tree) else found,
        invalid=attrs["status"] in INVALID,
        headline=words.headline(tree),
        further=[text for text in (words.left_open(tree), words.next_step(tree)) if text],
        errors=words.position_errors(attrs),
        probability=f"{float(attrs.get('interval_probability', plots.INTERVAL)):.0%}",
        chart=chart,
        map=drawn,
        shown=shown,
        more=more,
        nothing=words.nothing_found(tree),
        total=tree["calibration"].sizes["bias_label"],
        known=any(row.true for row in shown),
        notes=[*words.sentences(str(attrs["message"])), *listed_in(tree, "finding", "sentence")],
        directions=tables.directions(tree),
        columns=columns,
        rows=rows,
        tables=tables.tables(tree),
        pictures=pictures,
        versions=_versions(attrs),
        style=(HERE / "style.css").read_text(encoding="utf-8"),
        script=(HERE / "map.js").read_text(encoding="utf-8"),
    )


def _versions(attrs: dict[str, Any]) -> str:
    try:
        found = json.loads(attrs.get("versions", "{}"))
    except ValueError:
        found = None
    if not isinstance(found, dict):
        return str(attrs["versions"])
    return ", ".join(f"{name} {number}" for name, number in found.items())


# Pictures


def _pictures(tree: xr.DataTree, light: tuple[str, ...]) -> list[dict[str, str]]:
    """Pictures of what the tree holds, as data addresses; those that are to be light by pixels."""
    present = set(tree.children)
    if tables.weighted(tree):
        present.add("outliers")
    if len(drift_table(tree)):
        present.add("drifts")
    return [
        {"title": title, "alt": alt, "source": _embed(getattr(plots, draw)(tree), "png" if title in light else "svg")}
        for title, (alt, needs, draw) in PICTURES.items()
        if needs <= present
    ]


def _embed(drawn: Axes | list[Axes], kind: str) -> str:
    """The figure of these axes in a data address, the same for the same tree."""
    ax = np.atleast_1d(np.array(drawn, object))[0]
    sheet = io.BytesIO()
    with matplotlib.rc_context({"svg.hashsalt": "probcal"}):
        metadata = {"Date": None} if kind == "svg" else {"Software": None}
        figure_of(ax).savefig(sheet, format=kind, dpi=80, metadata=metadata)
    mime = "image/svg+xml" if kind == "svg" else "image/png"
    return f"data:{mime};base64," + base64.b64encode(sheet.getvalue()).decode("ascii")
