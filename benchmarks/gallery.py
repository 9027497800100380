"""The page of all notebooks and models, `notebooks/README.md`, and its pictures.

uv run python benchmarks/gallery.py --fits fits
uv run python benchmarks/gallery.py --fits fits --data ../shared/data

A notebook is shown by the first picture of its committed output, a model by the map of its fit: that in the folder
`--fits` if there is one, else `probcal fit` runs (seed 0, the default method or that of `HOW`) and leaves it there.
Models whose recording is not at `--data`, or that `--only` does not name, keep the picture that they have.
"""

import argparse
import ast
import base64
import io
import subprocess
import sys
from pathlib import Path

import matplotlib.image
import nbformat
import numpy as np
from matplotlib.figure import Figure

from probcal.plots import plot_map
from probcal.plots.base import figure_of
from probcal.results.io import load

ROOT = Path(__file__).parents[1]
PICTURES = ROOT / "notebooks" / "pictures"
WIDTH = 480  # px
RECORDINGS = {
    "sflab": "sflab_mic_toa/dataset_1_exp2.mat", "tdoa_flight": "uwb_tdoa",
    "robots": "mrclam/MRCLAM_Dataset6", "receivers": "mlat_locards/set_1.csv", "ble_office": "ble_rss",
    "bearing_beacons": "roh_bearing", "harbour": "autoferry_radar/scenario3_detections.json",
}  # fmt: skip
HOW = {
    "harbour": ("--method", "self-config"), "self_configuring_grid": ("--method", "self-config-tracks"),
    "road_microphones": ("--set", "motion=road", "--method", "em-particles"), "town": ("--method", "em-particles"),
    "presence": ("--method", "particle-gibbs", "--prior", "gaussian", "--chains", "2", "--draws", "300"),
}  # fmt: skip
HEAD = """# Notebooks and models

Made by `benchmarks/gallery.py`. Notebooks run from top to bottom; a model is run by `probcal fit models/NAME.py`. Pages
by task are in [guide](guide): [declare](guide/declare.md), [before a fit](guide/before.md),
[results](guide/results.md), [methods](guide/methods.md).
"""


def shrunk(png, path):
    """Write a picture as a PNG of the width of the page."""
    pixels = matplotlib.image.imread(io.BytesIO(png))
    height, width = pixels.shape[:2]
    figure = Figure(figsize=(WIDTH / 100, WIDTH / 100 * height / width), dpi=100)
    ax = figure.add_axes((0, 0, 1, 1))
    ax.imshow(np.clip(pixels, 0, 1), interpolation="antialiased")
    ax.axis("off")
    figure.savefig(path, dpi=100, pil_kwargs={"optimize": True})


def first_picture(book):
    """The first picture of a notebook's output, None without."""
    outputs = [output for cell in book.cells if cell.cell_type == "code" for output in cell.outputs]
    found = [output.data["image/png"] for output in outputs if "image/png" in output.get("data", {})]
    return base64.b64decode(found[0]) if found else None


def notebooks():
    """Title, link and picture of each notebook."""
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        book = nbformat.read(path, as_version=4)
        title, _, text = book.cells[0].source.partition("\n")
        png = first_picture(book)
        if png is None:
            raise SystemExit(f"{path.name} shows no picture; draw one in it and run it again")
        shrunk(png, PICTURES / f"{path.stem}.png")
        yield title.removeprefix("# "), path.name, text.strip().split("\n")[0], f"pictures/{path.stem}.png"


def models(fits, data, only):
    """Title, link and picture of each model with a problem of its own or a recording that is there."""
    for path in sorted((ROOT / "models").glob("*.py")):
        if path.stem == "networks":
            continue  # many small ones, made by a call
        picture, recording = PICTURES / f"model_{path.stem}.png", RECORDINGS.get(path.stem)
        there = recording is None or (data is not None and (data / recording).exists())
        there = there and (not only or path.stem in only)
        out = fits / path.stem
        if there and not (out / "fit.nc").exists():
            given = [] if recording is None else [data / recording]
            command = [sys.executable, "-m", "probcal.cli", "fit", path, *given, "--out", out, "--no-assess"]
            command += HOW.get(path.stem, ())
            subprocess.run(list(map(str, command)), check=False)
        if (out / "fit.nc").exists():
            sheet = io.BytesIO()
            figure_of(plot_map(load(out))).savefig(sheet, format="png", dpi=80)
            shrunk(sheet.getvalue(), picture)
        text = ast.get_docstring(ast.parse(path.read_text())).split("\n\n")[0].replace("\n", " ")
        yield path.stem, f"../models/{path.name}", text, f"pictures/{picture.name}"


def main():
    """Write the page and its pictures."""
    ask = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    ask.add_argument("--fits", type=Path, required=True)
    ask.add_argument("--data", type=Path)
    ask.add_argument("--only", nargs="+", default=[], help="models to fit; the others keep their pictures")
    given = ask.parse_args()
    PICTURES.mkdir(exist_ok=True)
    parts = [HEAD]
    for heading, entries in (("Notebooks", notebooks()), ("Models", models(given.fits, given.data, given.only))):
        parts.append(f"\n## {heading}\n")
        for title, link, text, picture in entries:
            shown = f"\n![{title}]({picture})\n" if (ROOT / "notebooks" / picture).exists() else ""
            parts.append(f"\n### {title}\n\n[{Path(link).name}]({link}): {text}\n{shown}")
    (ROOT / "notebooks" / "README.md").write_text("".join(parts))


if __name__ == "__main__":
    main()
