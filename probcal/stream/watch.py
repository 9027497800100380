"""`watch`: a stream calibrated as it comes, with a live table, a history on disk and a state that survives a kill."""

import hashlib
import os
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from rich.console import Console
from rich.live import Live
from rich.table import Table as Shown

from probcal.cli.files import can_plot
from probcal.cli.models import load_fit, load_problem, note_network, on_network
from probcal.cli.progress import shown
from probcal.errors import InputError
from probcal.files import Outputs, cannot_write, write_whole
from probcal.inference.progress import Progress, handled
from probcal.problem import Problem, check_linear
from probcal.results.io import save
from probcal.results.schema import ROPE
from probcal.stream import checkpoint
from probcal.stream.arrivals import refused_rows
from probcal.stream.counted import COUNTED
from probcal.stream.online import AugmentedFilter, Online, ParticleFilter, Update
from probcal.table import Table, csv_text, read_lines

BLOCK = 1 << 18  # bytes that are read at once
TRIED = 50  # first lines of which a model is made that has no data of its own, and that may be refused
REST = 0.2  # s between two looks at a file that does not grow
NAMED = 3  # rows left out that are named on stderr where no folder takes their table
LISTED = 40  # biases of the live table; of more those that are largest in their sds
DRAWN = 1000  # times of a history that is drawn
ALARMS = {"changed": "jumped", "lost": "conflicting", "drifts": "drifting"}  # verdicts by what befell a sensor
PICTURE = "biases.png"
STATE, HISTORY, JUMPS, TRACKS, REFUSED, ROWS, FIT = (
    "watch.npz", "biases.csv", "jumps.csv", "tracks.csv", "refused.csv", "rows.csv", "fit.nc"
)  # fmt: skip
TABLES = (HISTORY, JUMPS, TRACKS, REFUSED, ROWS)
BESIDE = {  # what a state says of source and tables
    "length": checkpoint.named(checkpoint.whole), "offset": checkpoint.whole, "line": checkpoint.whole,
    "header": checkpoint.text, "digest": checkpoint.text, "held": checkpoint.optional(checkpoint.TRACKS),
    "refused": checkpoint.whole,
}  # fmt: skip


@dataclass
class Source:
    """The lines of a table that grows: header, bytes that were taken, and the number of the next line."""

    name: str
    offset: int = 0
    header: bytes = b""
    line: int = 2
    rest: bytes = b""  # of a line that has not ended
    ended: bool = False
    cut: bool = False  # whether the last line that was taken had no end yet
    digest: Any = field(default_factory=hashlib.sha256)  # of the bytes before the offset

    def skip(self, file: Any, path: Path, digest: str) -> None:
        """Go on behind the bytes that were taken, of that digest; raises `InputError` where others stand there."""
        if self.offset > os.fstat(file.fileno()).st_size:
            raise InputError(f"{path} is shorter than what was read of it; it is another file: give another --out")
        if file.readline().rstrip(b"\n") != self.header:
            raise InputError(f"{path}: its header has changed since it was read; restore it, or give another --out")
        file.seek(0)
        while block := file.read(min(self.offset - file.tell(), BLOCK)):
            self.digest.update(block)
            self.cut = not block.endswith(b"\n")
        if self.digest.hexdigest() != digest:
            raise InputError(
                f"{path}: its first {self.line - 1} lines are not those that were read; it is another file, or was"
                " edited: restore it, or give another --out"
            )

    def take(self, file: Any) -> bytes:
        """Whole lines that have come, at most a block of them."""
        at = self.offset + len(self.rest)  # blocks end where they would have in a run that nothing stopped
        block = b"" if b"\n" in self.rest else file.read1(BLOCK - at % BLOCK)
        self.ended = not block and b"\n" not in self.rest
        whole, cut, self.rest = (self.rest + block).rpartition(b"\n")
        lines = whole + cut
        if not self.header and lines:
            self.header, _, lines = lines.partition(b"\n")
            self._count(self.header + b"\n")
        return lines

    def peek(self, file: Any) -> bytes:
        """The first whole lines, header and rows, which stay to be taken; nothing where there is no row yet."""
        while self.rest.count(b"\n") < 2 and (block := file.read1(BLOCK)):
            self.rest += block
        return self.rest.rpartition(b"\n")[0] + b"\n" if self.rest.count(b"\n") > 1 else b""

    def last(self) -> bytes:
        """The bytes after the last line end, when no more will come."""
        rest, self.rest = self.rest, b""
        return rest if rest.strip() else b""

    def ends(self, lines: bytes) -> bytes:
        """The end, which came since, of a line that had none when it was taken."""
        end = lines[: lines.find(b"\n") + 1] if self.cut else b""
        return b"" if end.strip() else end

    def taken(self, lines: bytes) -> None:
        """These lines were filtered."""
        self._count(lines)
        self.line += lines.count(b"\n")
        self.cut = not lines.endswith(b"\n")

    def _count(self, content: bytes) -> None:
        self.offset += len(content)
        self.digest.update(content)


@dataclass
class Appended:
    """Tables of a folder to which rows are added, cut back to where the last state stood."""

    folder: Path
    length: dict[str, int] = field(default_factory=dict)

    def open(self) -> None:
        """Take away what was written after the last state, of a run that was killed."""
        for name in TABLES:
            path, length = self.folder / name, self.length.get(name, 0)
            size = path.stat().st_size if path.exists() else 0
            if size < length:
                raise InputError(f"{path} is shorter than {STATE} says; restore it, or move {STATE} away to begin anew")
            if size > length:
                self._cut(path, length)

    def add(self, name: str, frame: pd.DataFrame) -> None:
        """Rows at the end of a table."""
        if frame.empty:
            return
        self.write(name, csv_text(frame, header=not self.length.get(name)).encode())

    def write(self, name: str, content: bytes) -> None:
        """Bytes at the end of a file: all of them or, where they cannot be written, none."""
        path, length = self.folder / name, self.length.get(name, 0)
        try:
            with path.open("ab") as file:
                file.write(content)
        except OSError as error:
            with suppress(InputError):
                self._cut(path, length)
            raise cannot_write(path, error) from None
        self.length[name] = length + len(content)

    @staticmethod
    def _cut(path: Path, length: int) -> None:
        try:
            os.truncate(path, length)
        except OSError as error:
            raise cannot_write(path, error) from None


def run(
    model: Path, data: Path | None, fix: Sequence[str], given: Mapping[str, Any], network: Path | None,
    method: AugmentedFilter | ParticleFilter, *, calibration: Path | None, targets: int, follow: bool,
    outputs: Outputs | None, every: float, kept: Sequence[str],
) -> int:  # fmt: skip
    """Filter the rows of a file, or of standard input, until they end or the process is told to end."""
    known = None if calibration is None else load_fit(calibration, network)
    source = Source("standard input" if data is None else data.name)
    with shown() as say:
        say(Progress(f"watch: {source.name}", 0, 1, phase="start"))
        problem = on_network(_declared(model, data, fix, given, source, follow), network)
    if isinstance(method, AugmentedFilter):
        check_linear(problem)
    online = Online(
        problem.network, problem.motion, method, calibration=known, fix=problem.fixed, epoch=problem.epoch,
        targets=targets,
    )  # fmt: skip
    tables, held, digest = None if outputs is None else Appended(outputs.folder), pd.DataFrame(), ""
    refused = 0
    if outputs is not None:
        assert tables is not None
        state = outputs.folder / STATE
        if state.exists():
            said = checkpoint.unpack_state(online, state.read_bytes(), str(state))
            beside = checkpoint.read_members(said, BESIDE, str(state))
            tables.length, held = beside["length"], held if beside["held"] is None else beside["held"]
            refused = beside["refused"]
            if data is not None:
                digest, source.header = beside["digest"], beside["header"].encode()
                source.offset, source.line = beside["offset"], beside["line"]
        outputs.begin()
        tables.open()
    size = 0 if data is None or follow else data.stat().st_size
    watching = Watching(online, source, tables, every, kept, held, size, refused)
    with (
        _input(data, source, digest) as file,
        watching.shown() as show,
        _told_to_end(watching),
        suppress(KeyboardInterrupt),
    ):
        watching.follow(file, follow and data is not None, show)
    watching.store()
    tree = None if online.end is None else online.tree()  # which looks for the cause of a misfit
    print(watching.said())
    if online.message:
        print(online.message)
    if tree is None:
        if watching.refused > watching.unfit:
            raise InputError(
                f"{source.name}: the calibration has counted all its rows; watch rows that came later, or leave"
                " --calibration out"
            )
        raise InputError(f"{source.name} has no rows that could be taken")
    if outputs is not None:
        save(note_network(tree, network), outputs.folder / FIT)
        if can_plot():
            _draw(outputs.folder)
        with outputs.writing():
            pass
        print(f"written: {', '.join(str(outputs.folder / name) for name in outputs.there)}")
    else:
        with pd.option_context("display.max_rows", None, "display.width", 160):
            print(judged(online).to_string(float_format=lambda value: f"{value:.4g}"))
    return int(online.alarmed)


@dataclass
class Watching:
    """One run: what comes in is filtered, shown and stored."""

    online: Online
    source: Source
    tables: Appended | None
    every: float  # s between two states
    kept: Sequence[str]  # "tracks", "rows"
    held: pd.DataFrame  # tracks at the last time, of which more rows may come
    size: int = 0  # bytes of a file that does not grow
    refused: int = 0  # rows left out, of the runs before a restart too
    unfit: int = 0  # of this run, rows left out that no calibration has counted
    why: str = ""  # the first reason of those
    used: int = 0
    stored: float = field(default_factory=time.monotonic)
    begun: float = field(default_factory=time.monotonic)
    busy: bool = False  # with rows or tables, which are taken and written whole
    ending: bool = False
    unstored: bool = False

    def __post_init__(self):
        self.first = self.online.counts["rows"], self.source.offset  # at the beginning of this run

    def follow(self, file: Any, grows: bool, show: Callable[[str], None]) -> None:
        """Take lines until there are no more, or for as long as the file may grow."""
        while True:
            lines = self.source.take(file)
            if lines:
                with self.undisturbed():
                    self.filter(lines)
                show("")
            elif self.source.ended and grows:
                show("waiting for rows")
                self.checkpoint()
                time.sleep(REST)
            elif self.source.ended:
                break
            self.checkpoint()
        if lines := self.source.last():
            with self.undisturbed():
                self.filter(lines)
        if self.online.end is not None:
            self.note(self.online.finish())
        if self.tables is not None:
            self.tables.add(TRACKS, self.held)
            self.held = self.held.iloc[:0]
        show("")

    def filter(self, lines: bytes) -> None:
        """Filter some lines; those that cannot be taken are put aside."""
        end = self.source.ends(lines)
        first = self.source.line + end.count(b"\n")
        table = read_lines(self.source.header, lines[len(end) :], self.source.name, first)
        before = self.unfit
        if len(table.frame):
            self._take(table)
        if self.unfit - before == len(table.frame) > 0 and self.online.end is None:
            raise InputError(self._none_taken)
        if self.tables is not None and "rows" in self.kept:
            head = b"" if self.tables.length.get(ROWS) else self.source.header.rstrip(b"\r") + b"\n"
            self.tables.write(ROWS, head + lines)
        self.source.taken(lines)
        self.unstored = True

    @contextmanager
    def undisturbed(self) -> Iterator[None]:
        """Completes the code inside: a request to end meanwhile takes effect after it."""
        self.busy = True
        yield
        self.busy = False
        if self.ending:
            raise KeyboardInterrupt

    def _take(self, table: Table) -> None:
        try:
            update = self.online.update(table)
        except InputError as error:
            rows = len(table.frame)
            if rows == 1:
                self._refuse(refused_rows(table.lines, [str(error)]))
                if self.unfit >= TRIED and self.online.end is None:
                    raise InputError(self._none_taken) from None
                return
            for some in (slice(0, rows // 2), slice(rows // 2, rows)):
                part = Table(table.frame.iloc[some].reset_index(drop=True), table.source, table.lines[some], table.word)
                self._take(part)
            return
        self.note(update)

    def _refuse(self, rows: pd.DataFrame) -> None:
        """Put rows with their reasons aside."""
        if self.tables is not None:
            self.tables.add(REFUSED, rows)
        else:
            for why in rows["reason"].head(max(NAMED - self.refused, 0)):
                print(f"left out: {why}", file=sys.stderr)
        self.refused += len(rows)
        others = rows["reason"][~rows["reason"].str.endswith(COUNTED)]
        self.unfit += len(others)
        self.why = self.why or next(iter(others), "")

    @property
    def _none_taken(self) -> str:
        return self.why if self.unfit < TRIED else f"the first {TRIED} rows cannot be taken: {self.why}"

    def note(self, update: Update) -> None:
        """Add what an update made known to the tables."""
        self.used = self.online.counts["rows"]
        self._refuse(update.refused)
        if self.tables is None:
            return
        if "tracks" in self.kept and len(update.tracks):
            tracks = pd.concat([self.held, update.tracks]) if len(self.held) else update.tracks
            tracks = tracks.drop_duplicates(["time", "target"], keep="last")
            last = tracks["time"] == tracks["time"].max()
            self.tables.add(TRACKS, tracks[~last])
            self.held = tracks[last]
        if update.jumps:
            self.tables.add(JUMPS, pd.DataFrame(update.jumps))
        self._since = True

    def checkpoint(self) -> None:
        """Store the state where it is time."""
        if self.unstored and time.monotonic() - self.stored >= self.every:
            with self.undisturbed():
                self.store()

    def store(self) -> None:
        """History first, then the state that says how long it is."""
        self.stored, self.unstored = time.monotonic(), False
        if self.tables is None or self.online.end is None:
            return
        biases = self.online.biases.reset_index()
        self.tables.add(HISTORY, biases.assign(time=self.online.time, rows=self.online.counts["rows"])[
            ["time", "rows", "bias", "unit", "mean", "sd", "lower", "upper", "gamma"]
        ])  # fmt: skip
        beside = {
            "length": self.tables.length, "offset": self.source.offset, "line": self.source.line,
            "header": self.source.header.decode(), "digest": self.source.digest.hexdigest(),
            "held": None if self.held.empty else self.held, "refused": self.refused,
        }  # fmt: skip
        write_whole(self.tables.folder / STATE, checkpoint.pack_state(self.online, beside))

    def said(self) -> str:
        """One line on where it stands."""
        if self.online.end is None:
            return f"no rows of {self.source.name} yet"
        counts = self.online.counts
        parts = [f"{counts['rows']:,} rows up to time {self.online.time:g} s"]
        parts += [f"{counts[name]:,} {name}" for name in ("late", "duplicates") if counts[name]]
        if self.online.message:
            parts.append(str(self.online.status) if not self.online.status.settled else "with a warning")
        if self.refused:
            parts.append(f"{self.refused:,} left out" + ("" if self.tables is None else f" (see {REFUSED})"))
        if self.online.jumps:
            last = self.online.jumps[-1]
            number = len(self.online.jumps)
            parts.append(f"{number} jump{'s' * (number > 1)}, the last of {last.label} at {last.since:g} s")
        return ", ".join(parts)

    def progress(self, phase: str) -> Progress:
        """Rows so far, their rate, and how much of a file that does not grow was read."""
        seconds, (rows, offset) = time.monotonic() - self.begun, self.first
        parts, left = [f"watch: {self.said()}"], None
        if (came := self.online.counts["rows"] - rows) and not phase:
            parts.append(f"{came / max(seconds, 1e-9):,.0f} rows per s")
        if self.size and self.source.offset > offset:
            parts.append(f"{self.source.offset / self.size:.0%} of {self.source.name}")
            left = seconds * (self.size - self.source.offset) / (self.source.offset - offset)
        return Progress(", ".join(parts), 0, 1, phase=phase, seconds=seconds, left=left)

    @contextmanager
    def shown(self) -> Iterator[Callable[[str], None]]:
        """A live table on a terminal, else progress on stderr; to be called with the phase."""
        console = Console()
        if not console.is_terminal:
            with shown() as say:
                say(Progress(f"watch: {self.source.name}", 0, 1, phase="first rows"))
                yield lambda phase: say(self.progress(phase))
            return
        with Live(console=console, refresh_per_second=4, transient=True) as live:
            yield lambda _: live.update(_table(self)) if self.online.end is not None else None


def judged(online: Online) -> pd.DataFrame:
    """The biases with a verdict: biased, zero (within a tenth of a scale), open, or not known yet.

    Of a sensor with an alarm: conflicting, jumped or drifting.
    """
    frame = online.biases
    away = (frame["lower"] > 0) | (frame["upper"] < 0)
    near = (frame["lower"] > -ROPE * frame["scale"]) & (frame["upper"] < ROPE * frame["scale"])
    words = np.select([frame["gamma"] < 0.5, away, near], ["not known yet", "biased", "zero"], "open")
    for event in online.check.events:
        alone = np.flatnonzero(frame.index == event.channel)
        words[alone if len(alone) else online.read_by(event.sensor)] = ALARMS[event.kind]
    for name in online.check.unexplained:
        words[online.read_by(name.rpartition(".")[0])] = ALARMS["lost"]
    return frame.drop(columns="scale").assign(verdict=words)


def _table(watching: Watching) -> Shown:
    frame = judged(watching.online)
    if len(frame) > LISTED:
        frame = frame.loc[(frame["mean"].abs() / frame["sd"]).nlargest(LISTED).index]
    shown = Shown(title=watching.said())
    for name in ("bias", "unit", "mean", "89 % interval", "known by data", "verdict"):
        shown.add_column(name)
    for label, row in frame.iterrows():
        interval = f"{row['lower']:.4g} to {row['upper']:.4g}"
        shown.add_row(str(label), row["unit"], f"{row['mean']:.4g}", interval, f"{row['gamma']:.0%}", row["verdict"])
    return shown


def _draw(folder: Path) -> None:
    """The picture of the history."""
    from probcal.plots import draw_history  # the plot packages are an extra

    jumps = folder / JUMPS
    history = pd.read_csv(folder / HISTORY)
    draw_history(_thinned(history), pd.read_csv(jumps) if jumps.exists() else None, folder / PICTURE)


def _thinned(history: pd.DataFrame) -> pd.DataFrame:
    """A history of at most `DRAWN` times."""
    times = history["time"].unique()
    return history[history["time"].isin(times[:: -(-len(times) // DRAWN)])] if len(times) > DRAWN else history


def _declared(
    model: Path, data: Path | None, fix: Sequence[str], given: Mapping[str, Any], source: Source, follow: bool
) -> Problem:
    """The problem of a model, for its network and motion: of its own data, or, where it has none, of a first line."""
    try:
        return load_problem(model, None, fix, given)[1]
    except InputError as error:
        why = error
    first = source if data is None else Source(source.name)
    with tempfile.TemporaryDirectory() as folder, _input(data, first) as file:
        while not (head := first.peek(file)) and follow:
            time.sleep(REST)
        header, *lines = head.splitlines(keepends=True) or [b""]
        for line in lines[:TRIED]:
            rows = Path(folder) / source.name
            try:
                write_whole(rows, header + line)
                return load_problem(model, rows, fix, given)[1]
            except InputError as error:
                why = error
    raise why


@contextmanager
def _input(data: Path | None, source: Source, digest: str = "") -> Iterator[Any]:
    """The file, or standard input, behind what was taken of it, which has a digest."""
    if data is None:
        yield sys.stdin.buffer
        return
    try:
        file = data.open("rb")
    except OSError as error:
        raise InputError(f"{data}: cannot be read ({error.strerror or error})") from None
    with file:
        if source.offset:
            source.skip(file, data, digest)
        yield file


@contextmanager
def _told_to_end(watching: Watching) -> Iterator[None]:
    """SIGTERM ends a watch as Ctrl-C does: what is known is stored, rows that are being filtered too."""

    def end(*_: Any) -> None:
        if not watching.busy or watching.ending:
            raise KeyboardInterrupt
        watching.ending = True

    with handled(end, (signal.SIGTERM, signal.SIGINT)):
        yield
