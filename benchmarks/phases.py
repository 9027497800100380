"""Profile of fits: the seconds of each phase of `probcal fit`, on every recording and every complete model.

    uv run python benchmarks/phases.py
    uv run python benchmarks/phases.py --only plaza robots --functions 20 --json phases.json

Each fit is a process of its own that runs the command line, `probcal fit MODEL --out DIR`, with its checks and its
report, without any kernel of an earlier run. `--warm FOLDER` keeps kernels in a folder and takes those that are there.

The result is a Markdown table with one row per fit. A cell with two numbers holds seconds and processor seconds; the
latter count all threads. The phases add up to `all`. So do `tracing`, `lowering`, `compiling` and `running`, the rest.

- `table` includes the simulation of a model that has no recording.
- `precisions` includes those of other modes and starts; `--json` lists them apart, as `modes/precisions`.
- `draws` includes the tree that is made of the draws, and the tracks without calibration.
- `HLO` counts instructions before XLA optimises them.

`--functions` samples the stack every 20 ms. The own time of a function includes the other packages that it calls.
`--json` also lists the largest kernels, the seconds per kernel, and all functions. A script called `profile.py` would
hide that module of the standard library from the other benchmarks.
"""

import argparse
import importlib
import json
import os
import sys
import tempfile
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from types import FrameType
from typing import Any
from unittest import mock

import page

MODELS = page.ROOT / "models"
DATA = page.ROOT.parent / "shared" / "data"
SAMPLED = 0.02  # s between two samples of the stack
LARGEST = 15  # kernels that the JSON file lists
PHASES = (
    "import", "table", "objects", "start", "climb", "modes", "precisions", "directions", "draws", "checks", "report",
    "other",
)  # fmt: skip
WORK = {  # events of jax, and the work within them
    "/jax/core/compile/jaxpr_trace_duration": "tracing",
    "/jax/core/compile/jaxpr_to_mlir_module_duration": "lowering",
    "/jax/core/compile/backend_compile_duration": "compiling",
}
RUNNING = "running"
BY_PROGRESS = {"start": "start", "climb": "climb", "mirror": "modes", "objects,": "objects", "checks": "checks"}
WRAPPED = (  # module, function, phase within it, phase after it
    ("probcal.cli.fit", "load_problem", "table", ""),
    ("probcal.cli.fit", "load_truth", "table", ""),
    ("probcal.cli.fit", "calibrated", "", "report"),
    ("probcal.inference.fit", "solve", "", "other"),
    ("probcal.inference.finish", "weak_directions", "directions", ""),
    ("probcal.inference.finish", "runs", "directions", ""),
    ("probcal.inference.finish", "strained_starts", "directions", ""),
    ("probcal.inference.finish", "build", "draws", ""),
    ("probcal.inference.run", "integrate", "precisions", ""),
    ("probcal.inference.propagate", "Propagation.step", "precisions", ""),
)
HEAD = ("fit", "all", *PHASES, *WORK.values(), RUNNING, "kernels", "HLO", "GB", "fit.nc, MB", "exit")


@dataclass(frozen=True)
class Case:
    """A fit: the model, its recording in the folder of recordings, and further words of the command."""

    model: str
    recording: str = ""
    words: tuple[str, ...] = ()


CASES = {
    "plaza": Case("plaza"),
    "plaza-free": Case("plaza_free"),
    "sflab": Case("sflab", "sflab_mic_toa/dataset_1_exp2.mat"),
    "robots": Case("robots", "mrclam/MRCLAM_Dataset6"),
    "beacons": Case("bearing_beacons", "roh_bearing"),
    "office": Case("ble_office", "ble_rss"),
    "flight": Case("tdoa_flight", "uwb_tdoa"),
    "receivers": Case("receivers", "mlat_locards/set_1.csv"),
    "harbour": Case("harbour", "autoferry_radar/scenario16_detections.json", ("--method", "self-config")),
    "networks": Case("networks"),
    "radars": Case("radars"),
    "thesis": Case("thesis"),
    "microphones": Case("microphones"),
    "road-microphones": Case("road_microphones"),
    "doa-array": Case("doa_array"),
    "rss-field-trial": Case("rss_field_trial"),
    "online": Case("online"),
    "large-network": Case("large_network"),
    "sapient": Case("sapient", "", ("--method", "self-config-beliefs")),
    "grid": Case("self_configuring_grid", "", ("--method", "self-config-beliefs")),
}
LEFT_OUT = {
    "presence": "its method is particle Gibbs, whose draws take most of the time",
    "town": "its method is EM by particles, whose draws take most of the time",
}
QUICK = ("radars",)


class Clock:
    """Seconds and processor seconds per nested phase, and per kind of work of jax within it."""

    def __init__(self, begun: float):
        self.spent: defaultdict[tuple[str, str], list[float]] = defaultdict(lambda: [0.0, 0.0])
        self._at = (begun, 0.0)
        self._base, self._inner, self._work = "import", list[str](), list[str]()

    def charge(self) -> None:
        """Add the time since the last change to the current phase."""
        now = (time.time(), time.process_time())
        path = "/".join((self._base, *self._inner))
        own = self.spent[path, self._work[-1] if self._work else RUNNING]
        for k in range(2):
            own[k] += now[k] - self._at[k]
        self._at = now

    def enter(self, phase: str) -> None:
        """Begin a phase; the one before it ends."""
        self.charge()
        self._base = phase

    @contextmanager
    def within(self, phase: str) -> Iterator[None]:
        """Begin and end a phase within the current one."""
        self.charge()
        self._inner.append(phase)
        try:
            yield
        finally:
            self.charge()
            self._inner.pop()

    def begin(self, event: str, *_: Any, **__: Any) -> None:
        """Listen to jax: it begins to trace, to lower or to compile."""
        if event in WORK and _in_main():
            self.charge()
            self._work.append(WORK[event])

    def end(self, event: str, *_: Any, **__: Any) -> None:
        """Listen to jax: it has traced, lowered or compiled."""
        if event in WORK and _in_main() and self._work:
            self.charge()
            self._work.pop()


def _in_main() -> bool:
    return threading.current_thread() is threading.main_thread()


class Sampler:
    """Processor seconds per function of the package: in itself, and including the functions that it calls."""

    def __init__(self, root: Path):
        self.own, self.whole = Counter[str](), Counter[str]()
        self._root, self._ended = str(root.parent) + os.sep, threading.Event()
        self._within = str(root) + os.sep
        self._watched = threading.main_thread().ident
        self._thread = threading.Thread(target=self._look, daemon=True)

    def __enter__(self) -> "Sampler":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def _look(self) -> None:
        before = time.process_time()
        while not self._ended.wait(SAMPLED):
            now = time.process_time()
            names = list(self._names(sys._current_frames().get(self._watched or 0)))
            for name in names[:1]:
                self.own[name] += now - before
            for name in set(names):
                self.whole[name] += now - before
            before = now

    def _names(self, frame: FrameType | None) -> Iterator[str]:
        """Yield the functions of the package on the stack, the innermost first."""
        while frame is not None:
            code = frame.f_code
            if code.co_filename.startswith(self._within):
                yield f"{code.co_filename.removeprefix(self._root)}:{code.co_qualname}"
            frame = frame.f_back


@contextmanager
def timed_phases(clock: Clock) -> Iterator[None]:
    """Within it the progress of the command and the calls of the `WRAPPED` functions set the phase of a clock."""

    @contextmanager
    def shown() -> Iterator[Callable[[Any], None]]:
        yield lambda at: clock.enter(BY_PROGRESS.get(at.phase.split(" ")[0], "other") if at.phase else "other")

    def wrapped(function: Callable[..., Any], within: str, after: str) -> Callable[..., Any]:
        @wraps(function)
        def call(*arguments: Any, **options: Any) -> Any:
            with clock.within(within) if within else ExitStack():
                found = function(*arguments, **options)
            if after:
                clock.enter(after)
            return found

        return call

    with ExitStack() as stack:
        stack.enter_context(mock.patch("probcal.cli.fit.shown", shown))
        for module, name, within, after in WRAPPED:
            *parents, last = name.split(".")
            owner: Any = importlib.import_module(module)
            for parent in parents:
                owner = getattr(owner, parent)
            stack.enter_context(mock.patch.object(owner, last, wrapped(getattr(owner, last), within, after)))
        yield


def measure(words: list[str], folder: Path, begun: float, warm: Path | None) -> None:
    """Run a command in this process, and write its measurements to `measured.json` in a folder."""
    clock, dump = Clock(begun), folder / "dump"
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_dump_to={dump} --xla_dump_hlo_as_text".strip()
    os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder / "kernels" if warm is None else warm)
    # as `probcal.kernels` sets them
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
    os.environ["JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES"] = "0"

    import jax

    import probcal
    from probcal import cli

    made, seconds = Counter[str](), Counter[str]()  # kernels by the name of their function

    def count(event: str, took: float, **given: Any) -> None:
        if WORK.get(event) == "compiling":
            made[str(given.get("fun_name", ""))] += 1
            seconds[str(given.get("fun_name", ""))] += took

    jax.monitoring.register_scalar_listener(clock.begin)
    jax.monitoring.register_event_duration_secs_listener(clock.end)
    jax.monitoring.register_event_duration_secs_listener(count)
    code: Any = 0
    with Sampler(Path(probcal.__file__).parent) as sampler:
        importlib.import_module("probcal.cli.fit")
        clock.enter("other")
        with timed_phases(clock), mock.patch.object(sys, "argv", ["probcal", *words]):
            try:
                cli.main()
            except SystemExit as ended:
                code = ended.code or 0
        clock.charge()
    sizes, file = kernel_sizes(dump), folder / "out" / "fit.nc"
    found = {
        "exit": code,
        "spent": [[path, work, *own] for (path, work), own in clock.spent.items()],
        "kernels": made.total(),
        "compiled": {name: [made[name], took] for name, took in seconds.most_common()},
        "HLO": sum(size for size, _ in sizes),
        "largest": sizes[:LARGEST],
        "bytes": file.stat().st_size if file.exists() else 0,
        "functions": {name: [sampler.own[name], whole] for name, whole in sampler.whole.most_common()},
    }
    (folder / "measured.json").write_text(json.dumps(found))


def kernel_sizes(dump: Path) -> list[tuple[int, str]]:
    """List the kernels that XLA dumped, the largest first: HLO instructions before optimisation, and name."""
    texts = [(path.name.split(".")[1], path) for path in dump.glob("*before_optimizations.txt")]
    sizes = [
        (sum(" = " in line for line in path.read_text(errors="replace").splitlines()), name) for name, path in texts
    ]
    return sorted(sizes, reverse=True)


def measured(case: Case, data: Path, limit: float, warm: Path | None) -> dict[str, Any]:
    """Measure a fit in a process of its own; `wrong` is the reason of a failure, or empty."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        fit = ["fit", str(MODELS / f"{case.model}.py"), *([str(data / case.recording)] if case.recording else [])]
        here = ["--here", name, "--begun", repr(time.time()), *(["--warm", str(warm)] if warm else [])]
        words = [*fit, "--out", str(folder / "out"), *case.words]
        ran = page.run([sys.executable, __file__, *here, "--", *words], limit)
        found: dict[str, Any] = {"command": ["probcal", *fit, *case.words], "wrong": ran.wrong, "memory": ran.memory}
        with suppress(OSError):
            found |= json.loads((folder / "measured.json").read_text())
        if "spent" not in found and not ran.wrong:
            found["wrong"] = "nothing was written"
        return found


def row(name: str, found: dict[str, Any]) -> str:
    """Format a row of the table, or the reason of a failure."""
    if "spent" not in found:
        return f"| {name} | {' | '.join('–' for _ in HEAD[2:])} | {found['wrong']} |"
    both: defaultdict[str, list[float]] = defaultdict(lambda: [0.0, 0.0])
    for path, work, *spent in found["spent"]:
        for column in ("all", path.rsplit("/", 1)[-1], work):
            both[column] = [a + b for a, b in zip(both[column], spent, strict=True)]
    cells = [" / ".join(f"{value:.1f}" for value in both[column]) if both[column][0] else "–" for column in HEAD[1:-5]]
    sizes = (found["kernels"], found["HLO"], f"{found['memory']:.2f}", f"{found['bytes'] / 1e6:.2f}", found["exit"])
    return f"| {name} | {' | '.join([*cells, *map(str, sizes)])} |"


def functions(results: dict[str, dict[str, Any]], most: int) -> list[str]:
    """List the functions with the most processor seconds over all fits, one line each."""
    own, whole = Counter[str](), Counter[str]()
    for found in results.values():
        for name, (itself, everything) in found.get("functions", {}).items():
            own[name] += itself
            whole[name] += everything
    total = sum(spent[3] for found in results.values() for spent in found.get("spent", ())) or 1.0
    lines = []
    for title, counts in (("own", own), ("with what it calls", whole)):
        lines += [
            f"- {title}: {name}, {seconds:.1f} s, {seconds / total:.1%}" for name, seconds in counts.most_common(most)
        ]
    return lines


def missing(case: Case, data: Path) -> str:
    """Return the reason why a fit is left out, or an empty text."""
    there = not case.recording or (data / case.recording).exists()
    return "" if there else f"the recording {case.recording} is not here"


def main() -> None:
    """Measure each fit and print its row."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=CASES, default=list(CASES), metavar="NAME", help=", ".join(CASES))
    parser.add_argument("--quick", action="store_true", help=f"only {', '.join(QUICK)}")
    parser.add_argument("--warm", type=Path, metavar="FOLDER", help="take kernels from there, and keep new ones there")
    parser.add_argument(
        "--functions", type=int, default=0, metavar="N", help="list the N functions with the most processor seconds"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all measurements there")
    parser.add_argument("--limit", type=float, default=3600, help="seconds after which a fit is stopped")
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the recordings")
    parser.add_argument("--here", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--begun", type=float, default=0.0, help=argparse.SUPPRESS)
    parser.add_argument("words", nargs="*", help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.here is not None:
        measure(chosen.words, chosen.here, chosen.begun, chosen.warm)
        return
    print(f"| {' | '.join(HEAD)} |\n|{'---|' * len(HEAD)}", flush=True)
    results, left_out = dict[str, dict[str, Any]](), []
    for name in QUICK if chosen.quick else chosen.only:
        if reason := missing(CASES[name], chosen.data):
            left_out.append(f"- {name}: left out, {reason}")
            continue
        results[name] = measured(CASES[name], chosen.data, chosen.limit, chosen.warm)
        print(row(name, results[name]), flush=True)
        if chosen.json is not None:
            chosen.json.write_text(json.dumps(results, indent=1))
    if not chosen.quick:
        left_out += [f"- {name}: left out, {reason}" for name, reason in LEFT_OUT.items()]
    lines = [*left_out, *functions(results, chosen.functions)]
    if lines:
        print("\n" + "\n".join(lines))
    if any(found["wrong"] for found in results.values()):
        sys.exit(1)


if __name__ == "__main__":
    main()
