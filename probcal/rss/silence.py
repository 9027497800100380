"""Rows for those who listened and heard nothing, where a log holds only what was heard."""

from collections.abc import Sequence

import numpy as np

from probcal.errors import InputError, nearest
from probcal.files import AnyPath
from probcal.lazy import pd
from probcal.network import Network
from probcal.noise import Censored
from probcal.table import read_table


def with_silence(
    data: "AnyPath | pd.DataFrame", network: Network, *, listens: Sequence[str] | None = None
) -> "pd.DataFrame":
    """The table with a row, its channels blank, for each receiver that was silent when another heard the same target.

    A receiver is a sensor that has a channel with `Censored(blanks=True)`; `listens` names those that were on, all
    without it. Rows count as simultaneous where `time` is the same number, so round the times of a log first. A target
    that nobody heard leaves no trace: such times stay missing. Raises `InputError` where no sensor is a receiver, for
    an unknown name, and for a table without times or sensors.

    >>> import pandas as pd
    >>> from probcal import Censored, Channel, Node, sensor
    >>> @sensor(level=Channel("dB", std=4.0, noise=Censored(-90.0, blanks=True)))
    ... def radio(target, pose):
    ...     return dict(level=-40.0 - 0.2 * sum((target.position - pose.position) ** 2))
    >>> network = Network([radio.on(Node("a", (0.0, 0.0))), radio.on(Node("b", (90.0, 0.0)))])
    >>> log = pd.DataFrame({"time": [0.0, 1.0, 1.0], "sensor": ["a", "a", "b"], "level": [-51.0, -62.0, -80.0]})
    >>> with_silence(log, network)["sensor"].tolist()
    ['a', 'b', 'a', 'b']
    """
    told = [s.name for s in network.sensors if any(_tells(c.noise) for c in s.type.channels.values())]
    if not told:
        raise InputError("with_silence: no channel has noise=Censored(floor, blanks=True), which reads a blank so")
    for name in listens or ():
        if name not in told:
            raise InputError(f'with_silence: listens "{name}"{nearest(name, told)} is no receiver with a floor')
    frame = read_table(data).frame
    if missing := {"time", "sensor"} - set(frame):
        columns = ", ".join(map(str, frame.columns))
        raise InputError(f'with_silence: the table lacks "{sorted(missing)[0]}"; its columns are {columns}')
    keys = ["time", "target"] if "target" in frame else ["time"]
    heard = frame.loc[frame["sensor"].isin(told), keys].drop_duplicates()
    all_rows = heard.merge(pd.DataFrame({"sensor": list(told if listens is None else listens)}), how="cross")
    there = pd.MultiIndex.from_frame(frame[[*keys, "sensor"]])
    silent = all_rows[~pd.MultiIndex.from_frame(all_rows[[*keys, "sensor"]]).isin(there)]
    whole = frame if silent.empty else pd.concat([frame, silent], ignore_index=True)
    return whole.iloc[np.argsort(whole["time"].to_numpy(), kind="stable")].reset_index(drop=True)


def _tells(noise: object) -> bool:
    return isinstance(noise, Censored) and noise.blanks
