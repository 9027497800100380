"""A stream of millions of rows through `probcal watch`, killed again and again: nothing lost, memory at rest.

    uv run python benchmarks/soak.py 10_000_000
    uv run python benchmarks/soak.py 200_000 --compare
    uv run python benchmarks/soak.py 1_000_000 --jumps 3 --outliers 0.01 --until 0.95

Two targets pass five radars again and again, each time under new names; the rows are written piece by piece into a
temporary folder. The process is killed (SIGKILL) at random moments of the first half, some of them while it starts, and
started again at once; the second half runs through, so that its memory can be followed. Printed are rows a second,
memory (VmRSS) after a tenth of the rows and at the end, its slope in the last process, and what the outputs say of
rows counted and repeated. With `--compare` tracks and rows are written too, nothing may be missing in them, and the
biases must be those of a run that was never killed. With `--jumps` so many biases jump, one radar each, which must be
named in jumps.csv with their times; others no more often than the rate that the filter is given allows. Rows are
written then too; `--outliers` is the fraction of the data that are 10 to 1,000 sd off. Compiled kernels are kept in the
user's cache between starts.
"""

import argparse
import os
import re
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd
from scipy import stats

RADARS, TARGETS, SCANS, GAP = 5, 2, 100, 20.0  # scans of a pass, s between two passes
PASS = RADARS * TARGETS * SCANS  # rows
HEADING, OFFSET, RANGE, AZIMUTH = np.deg2rad(3.0), 10.0, 10.0, np.deg2rad(1.0)
LOOK = 0.2  # s between two looks at the memory
TIGHT = 1e-6  # sd
JUMP = 8.0, 40.0  # sd of the noise, smallest and largest jump
GROSS = 10.0, 1000.0  # sd of the noise, smallest and largest outlier
FALSE = 0.1  # false alarms an hour that the search for jumps may make
WITHIN = 60.0  # s within which a jump must be named
FAR = 4.0  # sd from which a bias is wrong
MODEL = '''"""Five radars on a ring, and targets that pass."""

from dataclasses import replace

import numpy as np
import pandas as pd

import probcal as pc
from probcal.sensors import radar


def problem(data=None):
    turn = 2 * np.pi * np.arange(5) / 5
    places = 3000.0 * np.stack([np.cos(turn), np.sin(turn)], 1)
    nodes = [pc.Node(f"r{n}", place, scale={"heading": np.deg2rad(3.0)}) for n, place in enumerate(places)]
    channels = {"range": pc.Channel("m", std=10.0), "azimuth": pc.Channel("rad", std=np.deg2rad(1.0), wrap=True)}
    kind = replace(radar, channels=channels)
    row = pd.DataFrame({"time": [0.0], "sensor": ["r0"], "range": [3000.0], "azimuth": [3.0]})
    network = pc.Network([kind.on(node) for node in nodes])
    return pc.Problem(network, pc.ConstantVelocity(0.5), row if data is None else data)
'''


@dataclass
class Truth:
    """Biases at the beginning, (2, RADARS), which of them jump, and the fraction of the data that are outliers."""

    bias: np.ndarray
    jumps: list[tuple[float, tuple[int, int], float]]  # s, number of the bias, size
    outliers: float

    def at(self, t: np.ndarray) -> np.ndarray:
        """Biases (T, 2, RADARS) at times."""
        found = np.repeat(self.bias[None], len(t), 0)
        for since, which, size in self.jumps:
            found[(t >= since, *which)] += size
        return found


def spread(rng: np.random.Generator, limits: tuple[float, float], shape: int | tuple[int, ...]) -> np.ndarray:
    """Numbers of either sign, uniform in the logarithm of their size."""
    return rng.choice([-1.0, 1.0], shape) * np.exp(rng.uniform(*np.log(limits), shape))


def passing(number: int, rng: np.random.Generator, truth: Truth) -> pd.DataFrame:
    """Rows of one pass of both targets."""
    turn = 2 * np.pi * np.arange(RADARS) / RADARS
    places = 3000.0 * np.stack([np.cos(turn), np.sin(turn)], 1)
    t = np.arange(float(SCANS))
    course = rng.uniform(-np.pi, np.pi, TARGETS)
    speed = rng.uniform(5.0, 20.0, TARGETS)[:, None] * np.stack([np.cos(course), np.sin(course)], 1)
    path = rng.uniform(-800.0, 800.0, (TARGETS, 2)) + speed * (t[:, None, None] - t.mean())  # (SCANS, TARGETS, 2)
    line = path[:, :, None] - places  # (SCANS, TARGETS, RADARS, 2)
    bias = truth.at(number * (SCANS - 1 + GAP) + t)[:, :, None]
    ranges = np.hypot(line[..., 0], line[..., 1]) + bias[:, 1] + RANGE * rng.standard_normal(line.shape[:3])
    azimuths = np.arctan2(line[..., 1], line[..., 0]) - bias[:, 0] + AZIMUTH * rng.standard_normal(line.shape[:3])
    if truth.outliers:
        for values, std in ((ranges, RANGE), (azimuths, AZIMUTH)):
            gross = rng.random(values.shape) < truth.outliers
            values[gross] += std * spread(rng, GROSS, int(gross.sum()))
    scan, target, sensor = (index.ravel() for index in np.indices(line.shape[:3]))
    return pd.DataFrame(
        {
            "time": number * (SCANS - 1 + GAP) + t[scan],
            "sensor": np.array([f"r{n}" for n in range(RADARS)])[sensor],
            "target": np.array([f"p{number}_{k}" for k in range(TARGETS)])[target],
            "range": ranges.ravel().round(3),
            "azimuth": ((azimuths.ravel() + np.pi) % (2 * np.pi) - np.pi).round(6),
        }
    )


def write(path: Path, rows: int, seed: int, jumps: int, outliers: float) -> tuple[pd.Series, pd.Series]:
    """A table of so many rows, pass by pass; the true biases at its end, and when which of them jumped."""
    rng = np.random.default_rng(seed)
    bias = np.array([HEADING, OFFSET])[:, None] * rng.standard_normal((2, RADARS))
    truth = Truth(bias, [], outliers)
    if jumps:
        radars, kinds = rng.choice(RADARS, jumps, replace=False), rng.integers(2, size=jumps)
        sizes = np.array([AZIMUTH, RANGE])[kinds] * spread(rng, JUMP, jumps)
        passes = rows / PASS * np.sort(rng.uniform(0.1, 0.9, jumps)) // 1
        times = passes * (SCANS - 1 + GAP) + rng.integers(SCANS // 4, 3 * SCANS // 4, jumps)
        which = list(zip(kinds.tolist(), radars.tolist(), strict=True))
        truth.jumps = list(zip(times.tolist(), which, sizes.tolist(), strict=True))
    with path.open("w") as file:
        for number in range(-(-rows // PASS)):
            frame = passing(number, rng, truth).head(rows - number * PASS)
            frame.to_csv(file, index=False, header=number == 0)
    names = np.array([[f"r{n}.{kind}" for n in range(RADARS)] for kind in ("heading", "range_offset")])
    since = pd.Series({str(names[which]): at for at, which, _ in truth.jumps}, dtype=float)
    return pd.Series(truth.at(np.array([np.inf]))[0].ravel(), names.ravel()), since


@dataclass
class Run:
    """A watch over a file, and what was seen of it from outside."""

    model: Path
    data: Path
    out: Path
    lag: int
    keep: str
    log: Path
    jumps: bool = False  # whether jumps are looked for
    begun: float = field(default_factory=time.monotonic)
    seen: list[tuple[int, float, int, float]] = field(default_factory=list)  # process, s, rows, MB
    starts: int = 0

    def start(self) -> subprocess.Popen[bytes]:
        """A process that goes on where the last one stood."""
        probcal = Path(sys.executable).parent / "probcal"
        command = [probcal, "watch", self.model, self.data, "--out", self.out, "--lag", str(self.lag)]
        command += ["--jumps", f"{FALSE:g}", "--within", f"{WITHIN:g}"] if self.jumps else []
        self.starts += 1
        with self.log.open("ab") as log:
            return subprocess.Popen(
                [*command, *(["--keep", self.keep] if self.keep else [])], stdout=log, stderr=subprocess.STDOUT
            )

    def look(self, process: subprocess.Popen[bytes]) -> int:
        """Rows of the last state; keeps the memory of the process."""
        rows = stored(self.out)
        try:
            status = Path(f"/proc/{process.pid}/status").read_text()
        except OSError:
            return rows
        if found := re.search(r"VmRSS:\s+(\d+)", status):
            self.seen.append((self.starts, time.monotonic() - self.begun, rows, int(found[1]) / 1024))
        return rows

    def until(self, process: subprocess.Popen[bytes], rows: float) -> bool:
        """Wait for a state of so many rows; whether the process still runs."""
        while process.poll() is None:
            if self.look(process) >= rows:
                return True
            time.sleep(LOOK)
        return False

    def whole(self, rows: int, kills: list[tuple[float, float]]) -> None:
        """Run to the end, killed once a state has so many rows and some seconds have passed."""
        for at, later in kills:
            process = self.start()
            if not self.until(process, at * rows):
                self.ended(process)
                raise SystemExit(f"all rows were read before the kill at {at:.0%}; give more rows or fewer --kills")
            time.sleep(later)
            process.kill()
            process.wait()
            print(f"killed after {at:.0%} and {later:.1f} s: {stored(self.out):,} rows stored", flush=True)
        process = self.start()
        self.until(process, np.inf)
        self.ended(process)

    def ended(self, process: subprocess.Popen[bytes]) -> None:
        """Complain of a process that failed; one that ends with an alarm says so."""
        if process.returncode == 1:
            print(self.log.read_text().split("\nwritten")[0].splitlines()[-1])
        elif process.returncode:
            raise SystemExit(f"probcal watch ended {process.returncode}:\n{self.log.read_text()[-4000:]}")


def stored(out: Path) -> int:
    """Rows that the last line of the history counts."""
    path = out / "biases.csv"
    if not path.exists():
        return 0
    with path.open("rb") as file:
        file.seek(max(0, os.fstat(file.fileno()).st_size - 2000))
        lines = file.read().split(b"\n")
    whole = lines[-2].split(b",") if len(lines) > 1 else []
    return int(whole[1]) if len(whole) == 9 and whole[1].isdigit() else 0


def final(out: Path) -> pd.DataFrame:
    """The last biases of a history."""
    frame = pd.read_csv(out / "biases.csv")
    return frame[frame["rows"] == frame["rows"].iloc[-1]].drop_duplicates("bias", keep="last").set_index("bias")


def named(out: Path, since: pd.Series, hours: float) -> list[str]:
    """What is wrong with the jumps that were named; nothing where they are those that happened.

    Others are false alarms, of which the rate that was asked for allows some.
    """
    path = out / "jumps.csv"
    found = pd.read_csv(path).set_index("label") if path.exists() else pd.DataFrame({"since": [], "found": []})
    print(found.assign(true=since.reindex(found.index)).to_string())
    wrong = [f"the jump of {label} at {since[label]:g} s is not named" for label in since.index.difference(found.index)]
    right = np.abs(found["since"].to_numpy(float) - since.reindex(found.index).to_numpy(float)) <= WITHIN
    for label, own in found[~right].iterrows():
        wrong.append(f"a jump of {label} is named at {own['since']:g} s, where it has none")
    print(f"{(~right).sum()} false alarms; the rate of {FALSE:g} an hour allows {FALSE * hours:.1f} on average")
    likely = (~right).sum() <= stats.poisson.ppf(0.99, FALSE * hours)
    return [one for one in wrong if not (likely and "where it has none" in one)]


def said(run: Run, rows: int, outliers: bool) -> list[str]:
    """What is wrong with the outputs; nothing where all is well."""
    history = pd.read_csv(run.out / "biases.csv")
    text = run.log.read_text()
    wrong = []
    if history["rows"].iloc[-1] != rows or f"{rows:,} rows up to" not in text:
        wrong.append(f"{history['rows'].iloc[-1]:,} rows counted of {rows:,}")
    if not history["rows"].is_monotonic_increasing or not history["time"].is_monotonic_increasing:
        wrong.append("the history goes back")
    if history.groupby("bias").size().nunique() > 1:
        wrong.append("the history is not whole")
    wrong += re.findall(r"[\d,]+ (?:late|duplicates)", text)
    refused = run.out / "refused.csv"
    if refused.exists() and not outliers:
        wrong.append(f"{len(pd.read_csv(refused))} rows are left out")
    if "tracks" in run.keep:
        tracks, data = pd.read_csv(run.out / "tracks.csv"), pd.read_csv(run.data)
        keys = ["target", "time"]
        wanted, double = data[keys].drop_duplicates(), int(tracks.duplicated(keys).sum())
        if set(tracks[keys].itertuples(index=False)) != set(wanted.itertuples(index=False)):
            wrong.append(f"{len(tracks) - double} epochs have states of {len(wanted)}")
        if double:
            wrong.append(f"{double} of {len(wanted)} epochs have two states")
    if "rows" in run.keep and (run.out / "rows.csv").read_bytes() != run.data.read_bytes():
        wrong.append("rows.csv is not the table")
    return wrong


def memory(run: Run, rows: int) -> str:
    """Memory after a tenth of the rows, at the end, and how it went on in the last process while it took rows."""
    seen = pd.DataFrame(run.seen, columns=["start", "s", "rows", "MB"])
    tenth = seen[seen["rows"] >= 0.1 * rows]["MB"].iloc[0]
    last = seen[(seen["start"] == run.starts) & (seen["rows"] < rows)]
    first, span = last["rows"].iloc[0], np.ptp(last["rows"])
    steps = [last[last["rows"] >= first + share * span].iloc[0] for share in np.linspace(0.1, 1.0, 10)]
    rate = 0.9 * span / max(steps[-1]["s"] - steps[0]["s"], LOOK)
    late = last[last["rows"] >= first + 0.5 * span]
    slope = np.polyfit(late["rows"], late["MB"], 1)[0] * 1e6 if np.ptp(late["rows"]) else np.nan
    return (
        f"memory: {tenth:.0f} MB after 10 % of the rows, {steps[-1]['MB']:.0f} MB before the end, with fit.nc"
        f" {seen['MB'].iloc[-1]:.0f} MB; the last process took {span:,} rows, {rate:,.0f} a second, by tenths"
        f" {', '.join(f'{step["MB"]:.0f}' for step in steps)} MB, in the second half {slope:+.2f} MB a million rows"
    )


def main() -> None:
    """One soak."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rows", nargs="?", type=int, default=10_000_000)
    parser.add_argument("--lag", type=int, default=0)
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--until", type=float, default=0.5, help="share of the rows within which it is killed")
    parser.add_argument("--jumps", type=int, default=0, help="biases that jump, one radar each, at most five")
    parser.add_argument("--outliers", type=float, default=0.0, help="fraction of the data")
    parser.add_argument("--compare", action="store_true", help="with a run that is never killed")
    chosen = parser.parse_args()
    rng = np.random.default_rng(chosen.seed)
    moments = np.sort(rng.uniform(0.0, chosen.until, chosen.kills))
    kills = list(zip(moments.tolist(), rng.uniform(0.0, 1.5, chosen.kills).tolist(), strict=True))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "passes.py").write_text(MODEL)
        truth, since = write(folder / "rows.csv", chosen.rows, chosen.seed, chosen.jumps, chosen.outliers)
        print(f"{chosen.rows:,} rows, {(folder / 'rows.csv').stat().st_size / 1e6:.0f} MB", flush=True)
        keep = "tracks,rows" if chosen.compare else "rows" if chosen.jumps else ""

        def watch(out: str, kills: list[tuple[float, float]]) -> Run:
            log = folder / f"{out}.log"
            run = Run(folder / "passes.py", folder / "rows.csv", folder / out, chosen.lag, keep, log, chosen.jumps > 0)
            run.whole(chosen.rows, kills)
            seconds = time.monotonic() - run.begun
            print(f"{out}: {run.starts} starts, {seconds:.0f} s, {chosen.rows / seconds:,.0f} rows/s, starts included")
            print(memory(run, chosen.rows))
            print("outputs:", "; ".join(said(run, chosen.rows, chosen.outliers > 0)) or "every row once", flush=True)
            return run

        out = watch("killed", kills).out
        found = final(out)
        if chosen.jumps:
            hours = chosen.rows / PASS * (SCANS - 1 + GAP) / 3600.0
            print(
                "jumps:",
                "; ".join(named(out, since, hours)) or "all named, and no more others than the rate allows",
                flush=True,
            )
        off = ((found["mean"] - truth[found.index]) / found["sd"]).abs()
        far = "" if off.max() < FAR else " (WRONG)"
        print(f"off the truth by {off.max():.1f} sd at most{far}; gamma at least {found['gamma'].min():.4f}")
        if chosen.compare:
            other = final(watch("never killed", []).out).loc[found.index]
            apart = ((found["mean"] - other["mean"]) / other["sd"]).abs().max()
            spread = (found["sd"] / other["sd"] - 1.0).abs().max()
            verdict = "as they must be" if max(apart, spread) < TIGHT else "APART"
            print(f"biases differ by {apart:.1e} sd, sds by {spread:.1e}: {verdict}")


if __name__ == "__main__":
    main()
