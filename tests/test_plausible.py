"""Well-formed nonsense at the door: refused in one sentence with its row and what to do; what can be meant passes."""

import re

import numpy as np
import pandas as pd
import pytest

from probcal import ConstantVelocity, InputError, Network, Node, Problem
from probcal.plausible import check_plausible
from probcal.sensors import radar, rss
from probcal.table import measure, read_table

ROWS = 36


def table():
    """Three radars and a target that passes."""
    random = np.random.default_rng(0)
    time = np.repeat(np.arange(12.0), 3)
    return pd.DataFrame({
        "time": time, "sensor": [f"radar_{k}" for k in range(3)] * 12,
        "range": 40 + 2 * time + random.normal(size=ROWS),
        "azimuth": 0.2 + 0.05 * time + 0.01 * random.normal(size=ROWS),
    })  # fmt: skip


def problem(data):
    nodes = [Node(f"radar_{k}", place, scale=1.0) for k, place in enumerate([(0, 0), (30, 0), (0, 30)])]
    return Problem(Network([radar.on(node) for node in nodes]), ConstantVelocity(0.1), data)


def with_cell(column, row, value):
    def change(data):
        data.loc[row, column] = value
        return data

    return change


def with_times(factor, start=0.0):
    return lambda data: data.assign(time=(start + data["time"]) * factor)


def degrees(data):
    return data.assign(azimuth=np.rad2deg(data["azimuth"]))


def kilometres(data):
    return data.assign(range=data["range"] / 1e3).rename(columns={"range": "range [km]"})


EPOCH = 1.7e9  # s since 1970, in 2023


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (with_times(1e9, EPOCH), 'column "time": 1.7e+18 s looks like ns since 1970; write the header as time [ns]'),
        (with_times(1e6, EPOCH), "looks like us since 1970"),
        (with_times(1e3, EPOCH), "looks like ms since 1970"),
        (with_cell("time", 35, 1e10), r'row 35 column "time": 1e+10 s after the row before it in time (data row 34)'),
        (degrees, "rad looks like degrees; write the header as azimuth [deg]"),
        (with_cell("range", 7, -9999.0), 'row 7 column "range": -9999 looks like a mark for a missing value'),
        (with_cell("range", 7, 9999.0), "leave the cell blank"),
        (with_cell("range", 7, 1e30), "looks like a mark"),
        (with_cell("range", 7, 1e12), "is far from all others (the usual is about"),
        (lambda d: d.assign(range_std=1.0).pipe(with_cell("range_std", 3, 1e-30)), 'row 3 column "range_std"'),
        (lambda d: d.assign(range_std=1e12), "many orders of magnitude larger"),
        (
            lambda d: d.assign(range=d["range"] + np.where(d["time"] > 6.0, 1.07e11, 0.0), range_std=40.0),
            'row 21 column "range": the values of radar_0 jump at 7 s from about 45.3 to 1.07e+11 m; correct its clock',
        ),
        (
            lambda d: d.assign(range=d["range"] + np.where(d["time"] % 2 > 0, 1.07e11, 0.0), range_std=40.0),
            'row 3 column "range_std": a std of 40 is many orders of magnitude smaller than the values (here 1.07e+',
        ),
        (
            lambda d: kilometres(d).assign(range_std=1.0),
            'column "range_std" has no unit beside "range [km]": write range_std [km], or range_std [m]',
        ),
    ],
)  # fmt: skip
def test_nonsense_is_refused_in_one_sentence(change, says):
    with pytest.raises(InputError, match=re.escape(says)) as refused:
        problem(change(table()))
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "change",
    [
        lambda d: d,
        with_times(1.0, EPOCH),
        lambda d: with_times(1e9, EPOCH)(d).rename(columns={"time": "time [ns]"}),
        lambda d: degrees(d).rename(columns={"azimuth": "azimuth [deg]"}),
        lambda d: d.assign(azimuth=d["azimuth"] + 8 * np.pi).rename(columns={"azimuth": "azimuth [rad]"}),
        with_cell("range", 7, 400.0),
        lambda d: d.assign(range=d["range"] + 9999.0 - d["range"].iloc[0]),
        lambda d: d.assign(range=50.0),
        lambda d: d.assign(range_std=np.geomspace(1e-3, 1e3, ROWS)),
        lambda d: kilometres(d).assign(**{"range_std [m]": 1.0}),
    ],
)  # fmt: skip
def test_what_can_be_meant_passes(change):
    assert problem(change(table())).model.size > 0


def spread_of(width):
    """Ranges from 0 to `width` m: eight tenths of it lie between the quantiles that tell the spread."""
    return lambda data: data.assign(range=np.linspace(0.0, width, len(data)))


def powers(ratio, most):
    return lambda data: pd.DataFrame(
        {"time": np.arange(float(ROWS)), "sensor": "level", "level": np.geomspace(most / ratio, most, ROWS)}
    )


LIMITS = {  # the last that passes, the first that does not, of each limit in `probcal.plausible`
    "GAP": (with_cell("time", 35, 3.1e9), with_cell("time", 35, 3.3e9), "after the row before it"),
    "ms": (with_times(1.0, 0.9e11), with_times(1.0, 1.1e11), "looks like ms since 1970"),
    "TURNS": (with_cell("azimuth", 5, 19.0), with_cell("azimuth", 5, -21.0), "rad looks like degrees"),
    "APART": (
        lambda d: with_cell("range", 35, 9999.0)(spread_of(670.0)(d)),
        lambda d: with_cell("range", 35, 9999.0)(spread_of(550.0)(d)),
        "looks like a mark for a missing value",
    ),
    "FAR": (
        lambda d: with_cell("range", 35, 0.9e6 * 28.8)(spread_of(36.0)(d)),
        lambda d: with_cell("range", 35, 1.1e6 * 28.8)(spread_of(36.0)(d)),
        "is far from all others",
    ),
    "FEW": (
        lambda d: d.assign(range=100.0, range_std=1e-9).head(7),
        lambda d: d.assign(range=100.0, range_std=1e-9).head(8),
        "many orders of magnitude smaller",
    ),
    "NARROW": (
        lambda d: d.assign(range=100.0, range_std=1.1e-7), lambda d: d.assign(range=100.0, range_std=0.9e-7), "smaller",
    ),
    "WIDE": (
        lambda d: d.assign(range=100.0, range_std=0.9e8), lambda d: d.assign(range=100.0, range_std=1.1e8), "larger",
    ),
    "RANGE": (powers(29.0, 0.09), powers(31.0, 0.09), "looks like power in W"),
    "FAINT": (powers(40.0, 0.11), powers(40.0, 0.09), "looks like power in W"),
}  # fmt: skip


@pytest.mark.parametrize(("passes", "refused", "says"), LIMITS.values(), ids=LIMITS)
def test_each_limit_lies_where_it_is_stated(passes, refused, says):
    nodes = [Node(f"radar_{k}", (30.0 * k, 0.0)) for k in range(3)]
    network = Network([*(radar.on(node) for node in nodes), rss.on(nodes[0], name="level")])
    check_plausible(measure(read_table(passes(table())), network), network)
    with pytest.raises(InputError, match=re.escape(says)):
        check_plausible(measure(read_table(refused(table())), network), network)
