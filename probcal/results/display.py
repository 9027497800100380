"""The first view of a result in a notebook: status, message, table of biases, then the tree."""

from __future__ import annotations

import html
import sys
from typing import Any

from probcal.lazy import xr
from probcal.status import INVALID

ROWS = 40  # biases that are shown
SHOWN = ("bias", "unit", "mean", "sd", "lower", "upper", "gamma", "status", "verdict")


def install() -> None:
    """Have IPython, where it runs, show results this way."""
    found = sys.modules.get("IPython")
    shell = found.get_ipython() if found is not None and hasattr(found, "get_ipython") else None
    if shell is None:
        return
    formatters = shell.display_formatter.formatters
    formatters["text/html"].for_type(xr.DataTree, as_html)
    formatters["text/plain"].for_type(xr.DataTree, lambda tree, printer, cycle: printer.text(as_text(tree)))


def as_html(tree: xr.DataTree) -> str:
    """The result as HTML, a tree that is none as xarray shows it."""
    if not _is_result(tree):
        return tree._repr_html_()
    head, message, table = _parts(tree)
    said = f"<p>{html.escape(message)}</p>" if message else ""
    more = f"<p>{_more(tree)}</p>" if _more(tree) else ""
    body = table.to_html(index=False, float_format=_number, na_rep="–", escape=True, border=0)
    return (
        f"<div><p><strong>{html.escape(head)}</strong></p>{said}{body}{more}"
        f"<details><summary>The whole tree</summary><pre>{html.escape(repr(tree))}</pre></details></div>"
    )


def as_text(tree: xr.DataTree) -> str:
    """The result as text."""
    if not _is_result(tree):
        return repr(tree)
    head, message, table = _parts(tree)
    body = table.to_string(index=False, float_format=_number, na_rep="–")
    groups = ", ".join(str(name) for name in tree.children)
    return "\n".join(part for part in (head, message, body, _more(tree), f"groups: {groups}") if part)


def _is_result(tree: xr.DataTree) -> bool:
    return "calibration" in tree.children and {"method", "prior", "status"} <= set(tree.attrs)


def _parts(tree: xr.DataTree) -> tuple[str, str, Any]:
    from probcal.results.read import summary

    frame = summary(tree)
    attrs = tree.attrs
    head = f"{attrs['method']} ({attrs['prior']}): {attrs['status']}"
    head += ", estimate invalid: do not use these numbers" if attrs["status"] in INVALID else ""
    head += "; not assessed: assess(problem, tree) checks it" if not attrs.get("assessed", 1) else ""
    return head, str(attrs.get("message", "")), frame[[name for name in SHOWN if name in frame]].head(ROWS)


def _more(tree: xr.DataTree) -> str:
    left = tree["calibration"].sizes["bias_label"] - ROWS
    return f"and {left} more biases: tree.probcal.summary()" if left > 0 else ""


def _number(value: float) -> str:
    return f"{value:.4g}"
