"""The page of benchmarks keeps what stands outside its markers, and says what failed."""

import subprocess
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
import page

HEAD, TAIL = "# Title\n\ntext | before\n\n", "\n\n## After\n\n| a | b |\n"


def script(tmp_path, text, name="one.py"):
    (tmp_path / name).write_text(text)
    return str(tmp_path / name)


def made(tmp_path, *texts, limit=60):
    """The page of scripts, and the titles of those that went wrong."""
    file = tmp_path / "README.md"
    file.write_text(f"{HEAD}{page.BEGIN}\nold body\n{page.END}{TAIL}")
    given = [(script(tmp_path, text, f"{k}.py"),) for k, text in enumerate(texts)]
    failed = page.make([page.Part(f"part {k}", own, own, limit) for k, own in enumerate(given)], file)
    return file.read_text(), failed


@pytest.fixture(autouse=True)
def no_machine(monkeypatch):
    monkeypatch.setattr(page, "machine", lambda: ["A machine."])


def test_what_stands_outside_the_markers_stays(tmp_path):
    text, failed = made(tmp_path, "print('mode 0.1 s'); print('| a | b |'); print('|---|---|'); print('- note')")
    assert text.startswith(HEAD + page.BEGIN)
    assert text.endswith(page.END + TAIL)
    assert "old body" not in text
    assert "```\nmode 0.1 s\n```" in text
    assert "\n\n| a | b |\n|---|---|\n\n- note\n" in text
    assert not failed
    assert page.replaced(text, "x") == page.replaced(page.replaced(text, "y"), "x")


def test_what_failed_is_said_in_its_place_and_the_rest_goes_on(tmp_path):
    last = "import sys; sys.exit('no such recording')"
    text, failed = made(tmp_path, "print('so far'); 1 / 0", last, "print('fine')")
    first, second, third = text.split("### part ")[1:]
    assert "**failed (exit 1): ZeroDivisionError: division by zero**; until then:\n\n```\nso far\n```" in first
    assert "**failed (exit 1): no such recording**" in second
    assert "```\nfine\n```" in third
    assert failed == ["part 0", "part 1"]


def test_one_that_takes_too_long_or_is_not_there_is_said(tmp_path):
    text, failed = made(tmp_path, "import time; time.sleep(60)", limit=0.5)
    assert "**stopped after 0 s**" in text
    assert failed == ["part 0"]
    assert page.run(["/no/such/command"], 1.0).wrong.startswith("not run: ")


def test_nothing_is_written_without_one_pair_of_markers_or_when_cut_off(tmp_path, monkeypatch):
    for text in ("no markers", page.END + page.BEGIN, 2 * (page.BEGIN + page.END)):
        with pytest.raises(ValueError, match="the file needs one line"):
            page.replaced(text, "body")

    def cut(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(page, "run", cut)
    with pytest.raises(KeyboardInterrupt):
        made(tmp_path, "print(1)")
    assert "old body" in (tmp_path / "README.md").read_text()


def test_every_script_of_the_page_is_there():
    for part in page.PARTS:
        named = [word for own in (part.given, part.quick) for word in own if word.endswith(".py")]
        assert named
        assert all((page.ROOT / name).is_file() for name in named)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["guides", "paper_b", "paris"])
def test_what_only_a_paper_needs_runs(name):
    script = Path(__file__).parents[1] / "benchmarks" / "papers" / f"{name}.py"
    done = subprocess.run([sys.executable, script], capture_output=True, text=True)
    assert (done.returncode, done.stdout != "") == (0, True), done.stderr
