"""The API reference that `pdoc` makes of the docstrings: every public name has its place, no link leads nowhere."""

import html.parser
import subprocess
import sys

import pytest

import probcal

MODULES = ("probcal", "probcal.adapters", "probcal.plots", "probcal.results")


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
def test_the_reference_has_every_public_name_and_no_dead_link(tmp_path):
    subprocess.run([sys.executable, "-m", "pdoc", *MODULES, "-o", tmp_path], check=True, capture_output=True)
    pages = {}
    for path in tmp_path.rglob("*.html"):
        pages[path.resolve()] = page = Links()
        page.feed(path.read_text())
    assert set(probcal.__all__) - {"motion", "noise", "priors", "sensors"} <= pages[tmp_path / "probcal.html"].anchors
    dead = []
    for path, page in pages.items():
        for link in page.links:
            file, _, anchor = link.partition("#")
            if "://" in file:
                continue
            there = (path.parent / file).resolve() if file else path
            owner = anchor.rpartition(".")[0]  # a member that a class inherits stands with its parent
            if there not in pages or (anchor and not {anchor, owner} & (pages[there].anchors - {None, ""})):
                dead.append((path.name, link))
    assert not dead
