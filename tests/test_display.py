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


def test_progress_in_a_file_is_sparse():
    now, due = [0.0], []
    line = progress.Line(lambda: now[0])
    for second in range(3601):
        now[0] = float(second)
        line(Progress("EA", second, 4000, -1.5, phase="climb" if second < 100 else "checks", bound=True))
        if line.due():
            due.append(second)
        if second == 5:
            assert str(line) == "EA, climb: 5 of at most 4000, objective -1.500, 5 s"
    assert due[:8] == [5, 25, 45, 65, 85, 100, 120, 140], "early, then every 20 s, and where the phase changes"
    assert len(due) < 45
    assert 330 <= due[-1] - due[-2] <= 360, "then a tenth of the time so far"


def test_time_that_is_left_goes_on_without_news():
    now = [0.0]
    line = progress.Line(lambda: now[0])
    line(Progress("NUTS", 150, 1150, -1.5, "draws", 41.0, 200.0))
    now[0] = 30.0
    assert str(line) == "NUTS, draws: 150 of 1150, objective -1.500, 30 s, about 2 min 50 s left"


def test_a_short_command_says_nothing(capsys):
    with progress.shown() as say:
        say(Progress("EA", 1, 2))
    assert capsys.readouterr().err == ""


def test_the_accessor_aligns(tmp_path):
    tree = committed.tree("ea")
    truth = probcal.Truth(committed.DATA / "small.tracks.csv")
    assert "position_rmse_after_rigid" in tree.probcal.scores(truth, align="rigid")
