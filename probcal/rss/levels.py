"""`levels`: from WAV files to a table of received levels."""

from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from probcal.cli.files import say_written, write_csv
from probcal.errors import InputError
from probcal.labels import check_name
from probcal.rss.samples import levels_of, read_wav


def run(
    recordings: Sequence[Path], out: Path, band: str | None, window: float, start: float, column: str, overwrite: bool
) -> None:
    """Write one row a window, sensor and file; a file of several channels gives a sensor a channel, numbered from 1."""
    if out.exists() and not overwrite:
        raise InputError(f"{out} exists; give another name, or --overwrite")
    frequencies = None if band is None else _band(band)
    parts = []
    for path in recordings:
        samples, rate = read_wav(path)
        for c in range(samples.shape[1]):
            name = path.stem if samples.shape[1] == 1 else f"{path.stem}_{c + 1}"
            check_name(f"{path}: the sensor of this file", name)
            try:
                own = levels_of(samples[:, c], rate, band=frequencies, window=window, start=start, column=column)
            except InputError as error:
                raise InputError(f"{path.name}: {error}") from None
            parts.append(own.assign(sensor=name))
    table = pd.concat(parts, ignore_index=True)[["time", "sensor", column]]
    names = table["sensor"].unique()
    if len(names) < sum(1 for part in parts if len(part)):
        raise InputError("levels: two files have the same name; each must be named like its sensor")
    write_csv(table, out)
    say_written([out])


def _band(text: str) -> tuple[float, float]:
    """Two frequencies in Hz."""
    try:
        low, high = (float(part) for part in text.split(","))
    except ValueError:
        raise InputError(f'--band "{text}": give two frequencies in Hz, as in 50,500') from None
    return low, high
