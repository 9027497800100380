"""The command `levels` and its options."""

from pathlib import Path
from typing import Annotated

import typer

from probcal.cli import options


def levels_command(
    recordings: Annotated[list[Path], typer.Argument(help="WAV files, each named like its sensor", show_default=False)],
    out: Annotated[Path, typer.Option(help="table to write (CSV): time, sensor and the column")],
    band: Annotated[str | None, typer.Option(help="frequencies that pass, in Hz: 50,500")] = None,
    window: Annotated[float, options.quantity("s of one row")] = 0.5,
    start: Annotated[float, options.quantity("s at which the recordings begin", zero=True, negative=True)] = 0.0,
    column: Annotated[str, typer.Option(help="name of the channel")] = "level",
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace the table")] = False,
) -> None:
    """Levels: from raw samples to received signal strength in dB, a table for `fit`."""
    from probcal.rss import levels  # it needs pandas, and the options are checked before

    levels.run(recordings, out, band, window, start, column, overwrite)
