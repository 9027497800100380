"""The cases of the audit of faults, tried again: what each printed then, and what it prints now.

uv run python benchmarks/faults.py
uv run python benchmarks/faults.py --case seed --case report

Three range and azimuth gauges, 36 rows, one gauge off by 3 m. A line a case: exit code, the first line on stderr or
the status on stdout, and whether a traceback was seen (then the script ends with 1). About three minutes on two cores.
"""

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pandas as pd
import xarray as xr

MODEL = """
import numpy as np
from probcal import Bias, Channel, ConstantVelocity, Network, Node, Problem, sensor
from probcal.geometry import bearing, norm
COUNT = [0]

@sensor(range=Channel("m", std=0.5), azimuth=Channel("rad", std=0.01, wrap=True))
def gauge(target, pose, *, range_offset=Bias("m", 2.0)):
    line = target.position - pose.position
    return dict(range=norm(line) + range_offset EXTRA, azimuth=bearing(line))

def problem(data=None, share=0.5):
    places = [(0.0, 0.0), (60.0, 0.0), (0.0, 60.0)]
    network = Network([gauge.on(Node(f"gauge_{k}", place)) for k, place in enumerate(places)])
    return Problem(network, ConstantVelocity(0.5), data)

def setting(run, share=0.5):
    return problem("rows.csv", share), None
TAIL
"""


def rows():
    """A pass of 12 epochs that all three gauges see."""
    rng, found = np.random.default_rng(0), []
    for t in range(12):
        x, y = 5.0 + 4.0 * t, 20.0 + 2.0 * t
        for k, (a, b) in enumerate([(0.0, 0.0), (60.0, 0.0), (0.0, 60.0)]):
            away = np.hypot(x - a, y - b) + (3.0 if k == 1 else 0.0) + 0.5 * rng.normal()
            found.append((float(t), f"gauge_{k}", away, np.arctan2(y - b, x - a) + 0.01 * rng.normal()))
    return pd.DataFrame(found, columns=["time", "sensor", "range", "azimuth"])


def run(folder, *arguments):
    """A command in a process of its own: exit code, stdout, stderr."""
    command = [sys.executable, "-m", "probcal.cli", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder, timeout=600)
    return done.returncode, done.stdout, done.stderr


def model(folder, extra="", tail="", name="small.py"):
    """The model file, its range with something added."""
    (folder / name).write_text(MODEL.replace("EXTRA", extra).replace("TAIL", tail))
    return name


def table(change):
    """A fit to the table with one thing changed."""

    def case(folder):
        frame = change(rows())
        frame.to_csv(folder / "rows.csv", index=False)
        return run(folder, "fit", model(folder), "rows.csv")

    return case


def cell(column, value, row=7):
    """A table with one cell changed."""

    def change(frame):
        frame[column] = frame[column].astype(object)
        frame.loc[row, column] = value
        return frame

    return table(change)


def command(*arguments, extra="", tail=""):
    """A command on the good table."""

    def case(folder):
        rows().to_csv(folder / "rows.csv", index=False)
        model(folder, extra, tail)
        return run(folder, *arguments)

    return case


def spoilt(spoil, *arguments):
    """A command on a fit in `fit/` that was spoilt."""

    def case(folder):
        rows().to_csv(folder / "rows.csv", index=False)
        code, out, err = run(folder, "fit", model(folder), "rows.csv", "--out", "fit", "--no-assess")
        assert code == 0, (out, err)
        spoil(folder / "fit")
        return run(folder, *arguments)

    return case


def without(group, variable=None):
    """Drop a group, or a variable of it, from fit.nc."""

    def spoil(fit):
        tree = read(fit)
        if variable is None:
            tree = tree.drop_nodes(group)
        else:
            tree[group] = xr.DataTree(tree[group].to_dataset().drop_vars(variable))
        write(tree, fit)

    return spoil


def read(fit):
    """A saved fit, its file closed."""
    with xr.open_datatree(fit / "fit.nc", engine="h5netcdf") as tree:
        return tree.load()


def write(tree, fit):
    """A fit in the place of the saved one."""
    tree.to_netcdf(fit / "other.nc", engine="h5netcdf")
    (fit / "other.nc").replace(fit / "fit.nc")


def nothing_for_means(fit):
    """NaN in the place of all means."""
    tree = read(fit)
    tree["calibration"]["mean"][:] = np.nan
    write(tree, fit)


def zeros(fit):
    """40 kB of zeros in the middle of fit.nc."""
    whole = bytearray((fit / "fit.nc").read_bytes())
    middle = len(whole) // 2
    whole[middle : middle + 40_000] = bytes(40_000)
    (fit / "fit.nc").write_bytes(whole)


def own_file(folder):
    """A file of the user's own in OUT/draws outlives a fit."""
    (folder / "out" / "draws").mkdir(parents=True)
    (folder / "out" / "draws" / "thesis.txt").write_text("x")
    code, out, err = command("fit", "small.py", "rows.csv", "--out", "out", "--no-assess")(folder)
    kept = (folder / "out" / "draws" / "thesis.txt").exists()
    return code, f"thesis.txt {'kept' if kept else 'LOST'}\n{out}", err


def other_model(folder):
    """A run resumed by a model whose sensor has changed."""
    sizes = ("--method", "collapsed", "--chains", "2", "--draws", "60", "--warmup", "30")
    command("fit", "small.py", "rows.csv", "--out", "out", *sizes)(folder)
    rows().to_csv(folder / "rows.csv", index=False)
    model(folder, " + 0.05 * norm(line)")
    return run(folder, "fit", "small.py", "rows.csv", "--out", "out", "--resume", *sizes)


def full_disk(folder):
    """A file system of 4 kB."""
    (folder / "full").mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=4k", "tmpfs", folder / "full"], capture_output=True)
    if mounted.returncode:
        return None, "", "left out: mounting a file system needs root"
    try:
        return command("fit", "small.py", "rows.csv", "--out", "full/o", "--no-assess")(folder)
    finally:
        subprocess.run(["umount", folder / "full"], check=True)


def degrees(frame):
    """The azimuth in degrees under a bare header."""
    return frame.assign(azimuth=np.rad2deg(frame["azimuth"]))


def decimal_commas(folder):
    """Semicolons and decimal commas."""
    rows().to_csv(folder / "rows.csv", index=False, sep=";", decimal=",")
    return run(folder, "fit", model(folder), "rows.csv")


FIT = ("fit", "small.py", "rows.csv")
TINY = ("--method", "collapsed", "--chains", "1", "--draws", "1", "--warmup", "0")
CASES = {
    "clean": (command(*FIT), "converged"),
    "ns in a bare time": (table(lambda f: f.assign(time=(f["time"] * 1e9).astype(int) + 10**18)), "converged, all 0"),
    "a mark -9999": (cell("range", -9999.0), "converged"),
    "degrees in a bare azimuth": (table(degrees), "converged"),
    "one cell 1e30": (cell("range", 1e30), "traceback, LinAlgError"),
    "stds 1e-99": (table(lambda f: f.assign(range_std=1e-99)), "converged, sd 1.5e-99"),
    "azimuth + 1e20": (table(lambda f: f.assign(azimuth=f["azimuth"] + 1e20)), "converged"),
    "gaps of 1e15 s": (table(lambda f: f.assign(time=f["time"] * 1e15)), "converged"),
    "gaps of 1e-300 s": (table(lambda f: f.assign(time=f["time"] * 1e-300)), "converged"),
    "one std 1e-30": (table(lambda f: f.assign(range_std=[1e-30] + [0.5] * 35)), "means 0"),
    "range [km], bare range_std": (
        table(lambda f: f.assign(**{"range [km]": f["range"] / 1e3, "range_std": 0.5}).drop(columns="range")),
        "std taken in m",
    ),
    "decimal commas": (decimal_commas, "more cells than its header"),
    "own file in draws": (own_file, "deleted"),
    "resume with another sensor": (other_model, "two models mixed"),
    "a full disk": (full_disk, "SIGSEGV"),
    "seed 2**63": (command(*FIT, "--seed", 2**63), "traceback, OverflowError"),
    "draws 10**12": (command(*FIT, *TINY[:-4], "--draws", 10**12), "out of memory"),
    "one draw, assessed": (command(*FIT, *TINY), "traceback, IndexError"),
    "one draw": (command(*FIT, *TINY, "--no-assess"), "RuntimeWarnings"),
    "study of 1e9 values": (command("study", "small.py", "--set", "share=0:1:1e-9"), "builds 1e9 values"),
    "fit.nc is a folder": (
        spoilt(lambda fit: ((fit / "fit.nc").unlink(), (fit / "fit.nc").mkdir()), "report", "fit"), "traceback",
    ),
    "draws is a file": (
        spoilt(lambda fit: (fit / "draws").write_text("x"), *FIT, "--out", "fit", "--overwrite", *TINY), "traceback",
    ),
    "a complex sensor": (command(*FIT, extra="* (1 + 1j)"), "traceback"),
    "a random sensor": (command(*FIT, extra="+ np.random.normal()"), "other biases each run"),
    "PRIOR is a string": (command(*FIT, tail='PRIOR = "ard"'), "ignored"),
    "resume with EA": (command(*FIT, "--out", "o", "--resume"), "ignored"),
    **{
        f"{verb} without {group}": (spoilt(without(group), *rest), "traceback, KeyError")
        for verb, *rest in (
            ("report", "report", "fit"),
            ("track", "track", "small.py", "rows.csv", "--calibration", "fit"),
            ("compare", "compare", "fit", "fit"),
        )
        for group in ("constant_data", "observed_data")
    },
    "report without covariance": (spoilt(without("calibration", "covariance"), "report", "fit"), "traceback, KeyError"),
    "track with NaN means": (
        spoilt(nothing_for_means, "track", "small.py", "rows.csv", "--calibration", "fit"), "a table, exit 0",
    ),
    "zeros inside fit.nc": (spoilt(zeros, "report", "fit"), "accepted"),
}  # fmt: skip


def line(name):
    """The line of a case, and whether it went wrong."""
    case, before = CASES[name]
    with tempfile.TemporaryDirectory() as folder:
        code, out, err = case(Path(folder))
    wrong = "Traceback" in err or (code is not None and code < 0)
    said = [text for text in err.splitlines() if text.strip()] or [
        text for text in out.splitlines() if ": " in text and "(" in text
    ]
    return f"| {name} | {before} | {code} | {(said or out.splitlines() or [''])[0][:170]} |", wrong or len(said) > 20


def main():
    """Print the table; exit code 1 for a traceback or a signal."""
    ask = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    ask.add_argument("--case", action="append", choices=list(CASES))
    print("| case | in the audit | exit code | now |\n|---|---|---|---|", flush=True)
    bad = []
    for name in ask.parse_args().case or CASES:
        text, wrong = line(name)
        print(text, flush=True)
        bad += [name] if wrong else []
    print(f"\n{len(bad)} wrong{': ' + ', '.join(bad) if bad else ''}")
    sys.exit(bool(bad))


if __name__ == "__main__":
    main()
