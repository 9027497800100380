"""What a notebook and a file of messages show: the table first, names escaped; lines now and then, never many."""

import committed
import pytest
import xarray as xr

import probcal
from probcal.cli import progress
from probcal.inference.progress import Progress
from probcal.results import display


@pytest.mark.parametrize("name", [*committed.METHODS])
def test_status_message_and_table_come_first(name):
    tree = committed.tree(name)
    tree.attrs["message"] = "<b>Mind the gap.</b>"
    page, text = display.as_html(tree), display.as_text(tree)
    head = f"{tree.attrs['method']} ({tree.attrs['prior']}): {tree.attrs['status']}"
    assert text.startswith(f"{head}\n<b>Mind the gap.</b>\n")
    assert (
        page.index(head)
        < page.index("&lt;b&gt;Mind the gap.&lt;/b&gt;")
        < page.index("<table")
        < page.index("<details")
    )
    for label in tree["calibration"]["bias_label"].values:
        assert label in page
        assert label in text


def test_a_tree_that_is_no_result_is_shown_as_it_is():
    tree = xr.DataTree(xr.Dataset({"x": 1.0}))
    assert display.as_text(tree) == repr(tree)
    assert "<details" not in display.as_html(tree).split("xr-")[0]


def test_many_biases_are_cut_and_counted(monkeypatch):
    monkeypatch.setattr(display, "ROWS", 2)
    tree = committed.tree("ea")
    left = tree["calibration"].sizes["bias_label"] - 2
    assert f"and {left} more biases: tree.probcal.summary()" in display.as_text(tree)
    assert f"and {left} more biases" in display.as_html(tree)


@pytest.mark.ci
def test_a_notebook_shows_it():
    """In IPython a result is displayed by its table, in HTML and as text."""
    testing = pytest.importorskip("IPython.testing.globalipapp")
    shell = testing.start_ipython()
    shell.display_formatter.active_types = ["text/plain", "text/html"]
    display.install()
    data, _ = shell.display_formatter.format(committed.tree("ea"))
    assert data["text/plain"].startswith("EA (")
    assert "<table" in data["text/html"]


def test_progress_in_a_file_is_sparse(capsys):
    now = [0.0]
    say = progress.sparse(lambda: now[0])
    for second in range(0, 3601):
        now[0] = float(second)
        say(Progress("EA", second, 4000, -1.5))
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "EA: 30 of 4000, objective -1.500, 30 s"
    assert [line.rsplit(", ", 1)[1] for line in lines] == [
        f"{s} s" for s in (30, 90, 210, 450, 930, 1530, 2130, 2730, 3330)
    ]


def test_a_short_command_says_nothing(capsys):
    with progress.line() as say:
        say(Progress("EA", 1, 2))
    with progress.bar() as say:
        say(Progress("runs", 1, 2))
    assert capsys.readouterr().err == ""


def test_the_accessor_aligns(tmp_path):
    tree = committed.tree("ea")
    truth = probcal.Truth(committed.DATA / "small.tracks.csv")
    assert "position_rmse_after_rigid" in tree.probcal.scores(truth, align="rigid")
