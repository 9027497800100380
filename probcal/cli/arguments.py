"""Arguments and options that several commands share."""

from pathlib import Path
from typing import Annotated

import typer

from probcal.cli import options
from probcal.cli.names import METHODS, PRIORS

Model = Annotated[Path, typer.Argument(help="model file that defines problem(data=None)", show_default=False)]
Data = Annotated[Path | None, typer.Argument(help="table of rows (CSV); the model's own data if left out")]
Method = Annotated[str, typer.Option(help=" | ".join(METHODS))]
Prior = Annotated[
    list[str] | None,
    typer.Option(
        help=" | ".join(PRIORS) + "; PATTERN=NAME for biases of a kind (repeat); the model's or the method's own if"
        " left out",
        show_default=False,
    ),
]
Fix = Annotated[list[str] | None, typer.Option(help="hold biases at 0, by label or pattern (repeat)")]
Given = Annotated[
    list[str] | None, typer.Option("--set", help="an argument of problem(): swap=3,4 (repeat)", show_default=False)
]
Network = Annotated[
    Path | None,
    typer.Option(
        help="start from the network of a fit to other data: its folder, or its network.csv",
        callback=options.network_file, show_default=False,
    ),
]  # fmt: skip
LARGEST_SEED = 2**62
Seed = Annotated[int, typer.Option(min=0, max=LARGEST_SEED, help="seed of everything random")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="replace the run in --out: the files that probcal wrote")]
Scheduler = Annotated[
    str | None,
    typer.Option(help='spread over a dask cluster: "local", or the address of its scheduler, tcp://host:8786'),
]
