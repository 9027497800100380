"""Everything that is measured by one command: runs the listed benchmarks one after the other and writes the page.

    uv run --with gtsam python benchmarks/page.py
    uv run --with gtsam python benchmarks/page.py --quick --out page.md

Writes the machine, the commit and what each benchmark printed, with its seconds and the most memory that it took,
between two marker lines of `benchmarks/README.md`; what stands outside them stays. One that fails, or takes too long,
is said in its place. The file is replaced once, at the end. `PARTS` lists the benchmarks; a script that can tell
compiling from running prints both.
"""

import argparse
import contextlib
import datetime
import os
import platform
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from probcal.files import write_whole

ROOT = Path(__file__).parents[1]
BEGIN, END = "<!-- page: begin -->", "<!-- page: end -->"
HIDDEN = re.compile(r"^(=+.*=+|\s*|platform .*|rootdir: .*|plugins: .*|cachedir: .*|Legend:.*|  (Outliers|OPS): .*)$")
TESTED = ("-m", "pytest", "benchmarks/test_speed.py", "--benchmark-only", "-n", "0", "-q", "-p", "no:cacheprovider")
COLUMNS = ("--benchmark-columns=min,mean,rounds", "--benchmark-warmup=off", "--durations=0")


@dataclass(frozen=True)
class Part:
    """A benchmark of the page: what it is, the arguments of Python, those of a quick run, and seconds at most."""

    title: str
    given: tuple[str, ...]
    quick: tuple[str, ...]
    limit: float = 1800
    said: str = ""
    needs: tuple[str, ...] = ()  # packages beside those of the page's own command, brought by uv


PARTS = (
    Part(
        "Operations of the kernels against the peak",
        ("benchmarks/flops.py", "10x100", "100x1000", "300x300"),
        ("benchmarks/flops.py", "10x100"),
        said="A scan counts as often as it runs; seconds without compiling, the best of five.",
    ),
    Part(
        "Beside GTSAM",
        ("benchmarks/beside_gtsam.py", "10x100", "30x300", "100x1000", "300x300"),
        ("benchmarks/beside_gtsam.py", "10x100"),
        said="The same rows, priors, motion and start; seconds without compiling, the best of three.",
    ),
    Part(
        "Large networks, EA",
        ("benchmarks/large.py", "--side", "16", "25"),
        ("benchmarks/large.py", "--side", "8", "--epochs", "200"),
        said="Seconds of a fit contain compiling.",
    ),
    Part(
        "Large networks, MAP",
        ("benchmarks/large.py", "--side", "25", "50", "--method", "map"),
        ("benchmarks/large.py", "--side", "8", "--epochs", "200", "--method", "map"),
        said="Seconds of a fit contain compiling.",
    ),
    Part(
        "Many different fits in one process",
        ("benchmarks/many_fits.py", "20"),
        ("benchmarks/many_fits.py", "10"),
        said="Every fit is of a form of its own: seconds contain compiling.",
    ),
    Part(
        "Passes of a smoother",
        ("benchmarks/epochs.py", "1000", "--columns", "1", "300"),
        ("benchmarks/epochs.py", "200", "--columns", "1"),
    ),
    Part(
        "Kernels by pytest-benchmark",
        (*TESTED, *COLUMNS, "-k", "smoothing_pass or elimination"),
        (*TESTED, *COLUMNS, "-k", "smoothing_pass"),
        said="Seconds without compiling; some of the suite that `CONTRIBUTING.md` names.",
        needs=("pytest-benchmark",),
    ),
    Part(
        "Accuracy over the real recordings",
        ("benchmarks/accuracy.py", "--limit", "150"),
        ("benchmarks/accuracy.py", "--only", "plaza", "beacons", "--methods", "uncalibrated", "GTSAM, Huber", "EA"),
        limit=5400,
        said=(
            "Position RMSE over the epochs that the reference covers; rms error of the surveyed biases over their"
            " declared scales (uncalibrated 0 where nothing was displaced); the share of them that 89 % intervals hold,"
            " those of GTSAM from its Gaussian marginals. GTSAM has the automatic start, Huber noise (1.345 sds) of the"
            " declared std, or of the guess of an unknown one, since it learns none, and Gaussian priors of the"
            " declared scales; its rows are evaluated here, so that its seconds (without the start) say nothing of its"
            " speed. EA is `EA()`, full Bayes `Collapsed(chains=2, warmup=100, draws=600, patience=4)`: few draws, so"
            " that it often says that it has not converged; their seconds contain compiling."
        ),
    ),
)


@dataclass(frozen=True)
class Ran:
    """How a benchmark went: what it printed, seconds, the most memory in GB, and what went wrong ("" if nothing)."""

    printed: str
    seconds: float
    memory: float
    wrong: str = ""


def run(command: Sequence[str], limit: float, folder: Path = ROOT) -> Ran:
    """Run a command to its end, or for so many seconds; what it printed on stderr says what went wrong."""
    begun = time.perf_counter()
    with tempfile.TemporaryFile("w+") as out, tempfile.TemporaryFile("w+") as err:
        try:
            child = subprocess.Popen(
                command, stdout=out, stderr=err, cwd=folder, env=_environment(), start_new_session=True
            )
        except OSError as error:
            return Ran("", 0.0, 0.0, f"not run: {error}")
        clock = threading.Timer(limit, _end, (child.pid,))
        clock.start()
        try:
            _, status, usage = os.wait4(child.pid, 0)
        except BaseException:
            _end(child.pid)
            raise
        finally:
            clock.cancel()
        child.returncode = os.waitstatus_to_exitcode(status)
        took = time.perf_counter() - begun
        texts = []
        for file in (out, err):
            file.seek(0)
            texts.append(file.read())
    wrong = ""
    if took >= limit and child.returncode:
        wrong = f"stopped after {limit:.0f} s"
    elif child.returncode:
        wrong = f"failed (exit {child.returncode}): {_reason(texts[1]) or _reason(texts[0]) or 'it said nothing'}"
    return Ran(texts[0], took, usage.ru_maxrss / 1e6, wrong)


def _end(group: int) -> None:
    """End a benchmark and what it started."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(group, signal.SIGKILL)


def _reason(text: str) -> str:
    """The last line that speaks of an error, else the last."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    spoken = [line for line in lines if "error" in line.lower()]
    return (spoken or lines or [""])[-1]


def _python(part: Part) -> list[str]:
    """This interpreter, or uv's with what else a part needs."""
    if not part.needs:
        return [sys.executable]
    packages = [word for name in part.needs for word in ("--with", name)]
    return [os.environ.get("UV", "uv"), "run", "--no-sync", *packages, "python"]


def _environment() -> dict[str, str]:
    """The environment of a benchmark: it imports the package of this folder."""
    before = os.environ.get("PYTHONPATH")
    return os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), *([before] if before else [])])}


def machine() -> list[str]:
    """The machine, the versions and the commit, a line each."""
    cpu = next((line.split(":")[1].strip() for line in _lines("/proc/cpuinfo") if line.startswith("model name")), "CPU")
    memory = next((int(line.split()[1]) / 1e6 for line in _lines("/proc/meminfo") if line.startswith("MemTotal")), 0.0)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    names = ("probcal", "jax", "jaxlib", "numpy", "gtsam")
    asked = run([sys.executable, "-c", "import jax; print(*(d.device_kind for d in jax.devices()), sep=', ')"], 120)
    kinds = asked.printed.strip() if not asked.wrong else "unknown"
    there = f"accelerator: {kinds}" if kinds not in ("cpu", "unknown") else "no accelerator"
    head = run(["git", "rev-parse", "--short", "HEAD"], 20)
    dirty = run(["git", "status", "--porcelain", "--untracked-files=no"], 20)
    commit = "no commit" if head.wrong else f"commit {head.printed.strip()}"
    return [
        f"{cpu}, {cores} cores, {memory:.0f} GB, {there}; load {os.getloadavg()[0]:.1f} before the first benchmark.",
        f"Python {platform.python_version()}, {', '.join(f'{name} {_version(name)}' for name in names)}.",
        f"{datetime.date.today()}, {commit}{' and changes' if dirty.printed.strip() else ''}.",
    ]


def _lines(path: str) -> list[str]:
    """Lines of a file, none where it cannot be read."""
    try:
        return Path(path).read_text().splitlines()
    except OSError:
        return []


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed"


def told(part: Part, given: Sequence[str], ran: Ran) -> str:
    """A section of the page: the command, seconds, memory, and what was printed, tables as tables."""
    shown = " ".join(f'"{word}"' if " " in word else word for word in given)
    lines = [f"### {part.title}", "", f"`python {shown}`: {ran.seconds:.0f} s in all, {ran.memory:.1f} GB at most."]
    if part.said:
        lines[-1] += f" {part.said}"
    if ran.wrong:
        lines += ["", f"**{ran.wrong}**" + ("; until then:" if ran.printed.strip() else "")]
    kept = [line.rstrip() for line in ran.printed.splitlines() if not HIDDEN.match(line)]
    table = [line for line in kept if line.startswith(("|", "- "))]
    rest = [line for line in kept if not line.startswith(("|", "- "))]
    if table:
        first = next((k for k, line in enumerate(table) if line.startswith("- ")), len(table))
        lines += ["", *table[:first]] + (["", *table[first:]] if first < len(table) else [])
    if rest:
        lines += ["", "```", *rest, "```"]
    return "\n".join(lines)


def replaced(text: str, body: str) -> str:
    """The text with another body between its markers. Raises `ValueError` where there is not one pair of them."""
    if text.count(BEGIN) != 1 or text.count(END) != 1 or text.index(BEGIN) > text.index(END):
        raise ValueError(f"the file needs one line {BEGIN} and, after it, one line {END}")
    before, rest = text.split(BEGIN)
    return f"{before}{BEGIN}\n{body.strip()}\n{END}{rest.split(END)[1]}"


def make(parts: Sequence[Part], path: Path, *, quick: bool = False, note: str = "") -> list[str]:
    """Run all parts and write the page into a file that has the markers; titles of those that went wrong."""
    text = path.read_text()
    replaced(text, "")
    body, failed = [" ".join(machine()) + (f" {note.strip()}" if note.strip() else "")], []
    for part in parts:
        given = part.quick if quick else part.given
        print(f"{part.title} ...", flush=True)
        ran = run([*_python(part), *given], part.limit)
        print(f"  {ran.seconds:.0f} s, {ran.memory:.1f} GB{', ' + ran.wrong if ran.wrong else ''}", flush=True)
        body.append(told(part, given, ran))
        failed += [part.title] if ran.wrong else []
    write_whole(path, replaced(path.read_text(), "\n\n".join(body)))
    return failed


def main() -> None:
    """Make the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="small sizes, some minutes")
    parser.add_argument("--only", nargs="+", metavar="WORD", help="parts whose title or command holds a word")
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "README.md", help="a file with the markers")
    parser.add_argument("--note", default="", help="said beside the machine, such as what else ran")
    chosen = parser.parse_args()
    wanted = [w.lower() for w in chosen.only or [""]]
    parts = [part for part in PARTS if any(w in " ".join((part.title, *part.given)).lower() for w in wanted)]
    if not chosen.out.exists():
        chosen.out.write_text(f"{BEGIN}\n{END}\n")
    failed = make(parts, chosen.out, quick=chosen.quick, note=chosen.note)
    if failed:
        sys.exit(f"went wrong: {', '.join(failed)}")


if __name__ == "__main__":
    main()
