"""`report`: report.html of a saved fit."""

from pathlib import Path

from probcal.cli.files import report_of, say_written
from probcal.files import Outputs
from probcal.results.io import load


def run(path: Path, outputs: Outputs, *, static: bool) -> int:
    """Write report.html of a saved fit: verdict, map, the biases that matter, and the rest folded away."""
    tree = load(path)
    with outputs.writing():
        say_written([report_of(tree, outputs.folder, static=static)])
    return 0
