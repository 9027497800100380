"""The pages that Sphinx builds of guide, notebooks and docstrings: every public name, and no dead link."""

import html.parser
import subprocess
import sys
from pathlib import Path
from urllib.parse import unquote

import pytest

import probcal

SOURCES = Path(__file__).parents[1] / "notebooks"


class Links(html.parser.HTMLParser):
    """Anchors and links of a page."""

    def __init__(self):
        super().__init__()
        self.anchors, self.links = set(), set()

    def handle_starttag(self, tag, attrs):
        given = dict(attrs)
        self.anchors.add(given.get("id"))
        if tag == "a" and given.get("href"):
            self.links.add(given["href"])


@pytest.mark.ci
def test_the_pages_have_every_public_name_and_no_dead_link(tmp_path):
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", SOURCES, tmp_path / "site"]
    built = subprocess.run([*command, "-d", tmp_path / "trees"], capture_output=True, text=True)
    assert built.returncode == 0, built.stderr
    pages = {}
    for path in (tmp_path / "site").rglob("*.html"):
        pages[path.resolve()] = page = Links()
        page.feed(path.read_text())
    reference = pages[(tmp_path / "site" / "reference.html").resolve()]
    modules = {"motion", "noise", "priors", "sensors"}
    assert not {f"probcal.{name}" for name in set(probcal.__all__) - modules} - reference.anchors
    dead = []
    for path, page in pages.items():
        for link in page.links:
            file, _, anchor = unquote(link).partition("#")
            if "://" in file or file.startswith(("mailto:", "_static")):
                continue
            there = (path.parent / file).resolve() if file else path
            if not there.exists() or (anchor and there in pages and anchor not in pages[there].anchors):
                dead.append((path.name, link))
    assert not dead
