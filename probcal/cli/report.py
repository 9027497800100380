"""`report`: report.html of a saved fit."""

from pathlib import Path

from probcal.cli.files import report_of, say_written
from probcal.files import make_folder
from probcal.tree import load


def run(path: Path) -> int:
    """Write report.html of a saved fit: map, forest of biases, residuals, trace."""
    tree = load(path)
    say_written([report_of(tree, make_folder(path if path.is_dir() else path.parent))])
    return 0
