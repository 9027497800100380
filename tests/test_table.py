"""Names, times and declarations at the door: what a person's table and network may hold."""

import csv
import decimal
import re
import sys
import time
from dataclasses import replace
from functools import cache
from pathlib import Path as File

import committed
import numpy as np
import pandas as pd
import pytest

from probcal import (
    Bias,
    Channel,
    ConstantVelocity,
    InputError,
    Network,
    Node,
    Path,
    Problem,
    White,
    read_nodes,
    read_table,
    sensor,
    sensors,
    simulate,
    table,
    write_nodes,
)
from probcal.geometry import norm
from probcal.results import build
from probcal.simulate import truth_beside
from probcal.table import UNITS, measure, unit_factor

sys.path.insert(0, str(committed.DATA))

CORNERS = [(0, 0), (60, 0), (60, 60), (0, 60)]
PATH = np.stack([np.linspace(5, 55, 20), 30 + 20 * np.sin(np.linspace(0, 6, 20))], 1)
CV = ConstantVelocity(0.5)


@sensor(range=Channel("m", std=1.0))
def gauge(target, pose, *, range_offset=Bias("m", 2.0)):
    return dict(range=norm(target.position - pose.position) + range_offset)


@sensor(range=Channel("m", std=1.0))
def namesake(target, pose):
    return dict(range=norm(target.position - pose.position))


ALIKE = [gauge.on(Node("a", (0, 0))), replace(namesake, name="gauge").on(Node("b", (1, 0)))]


def network(names=("a", "b", "c", "d")):
    return Network([gauge.on(Node(name, p)) for name, p in zip(names, CORNERS, strict=True)])


@cache
def run():
    return simulate(network(), CV, np.arange(20.0), key=1, tracks={"target": PATH})


def recorded(names=("a", "b", "c", "d")):
    """A recording, its sensors called otherwise."""
    return run().table.replace({"sensor": dict(zip("abcd", names, strict=True))})


def test_times_may_be_dates_in_text_or_in_a_frame():
    table = recorded()
    stamps = pd.Timestamp("2024-01-01T10:00:00Z") + pd.to_timedelta(table["time"], unit="s")
    for column in (stamps, stamps.dt.strftime("%Y-%m-%dT%H:%M:%SZ"), pd.to_timedelta(table["time"], unit="s")):
        problem = Problem(network(), CV, table.assign(time=column))
        np.testing.assert_allclose(problem.measurements.time, table["time"], atol=1e-9)


def test_names_that_are_numbers_are_one_name():
    table = recorded(("1", "2", "3", "4"))
    mixed = table.assign(sensor=table["sensor"].astype(float), target=[7 if k % 2 else " 7" for k in range(len(table))])
    problem = Problem(network(names=("1", "2", "3", "4")), {7: CV}, mixed)
    assert problem.measurements.target_names == ("7",)
    assert len(problem.epochs[0].time) == 20
    same = simulate(network(), {7: CV}, np.arange(20.0), key=1, tracks={7: PATH})
    np.testing.assert_allclose(same.truth.tracks[["position_x", "position_y"]], PATH)


def test_a_sensor_type_needs_only_the_components_of_the_targets_it_sees():
    built = Network([sensors.toa.on(Node("ear", (0, 0), scale={"clock": 1.0}))]
                    + [sensors.ranger.on(Node(f"mast_{k}", p)) for k, p in enumerate(CORNERS)])  # fmt: skip
    motion = {"shot": CV + White("emission", "m", 50.0), "car": CV}
    grid = [(t, s, o) for o, names in (("shot", ["ear"]), ("car", [f"mast_{k}" for k in range(4)]))
            for t in range(20) for s in names]  # fmt: skip
    plan = pd.DataFrame(grid, columns=["time", "sensor", "target"])
    run = simulate(built, motion, np.arange(20.0), key=1, tracks={"shot": PATH, "car": PATH}, schedule=plan)
    assert Problem(built, motion, run.table).labels[0] == "ear.clock"


def test_exact_labels_with_brackets_can_be_fixed_and_rebuilt():
    built = network(names=("a[0]", "a[1]", "c", "d"))
    problem = Problem(built, CV, recorded(("a[0]", "a[1]", "c", "d")), fix=["a[0].range_offset"])
    assert problem.rebuild().labels == problem.labels == ("a[1].range_offset", "c.range_offset", "d.range_offset")


@pytest.mark.parametrize(
    ("build", "text"),
    [
        (lambda: Node("h", (0, 0), survey={"heading": Bias("deg", 2.0)}), 'heading is in "deg"; give it in rad'),
        (lambda: Node("h", (0, 0), scale={"clock": Bias("s", 2.0, nominal=1.0)}), "takes no nominal"),
        (lambda: Node("h", (0, 0), survey=0.0), "survey of position is 0: it must be positive"),
        (lambda: Node("h", (0, 0), survey={"hedding": 1.0}), 'did you mean "heading"'),
        (lambda: Node("h", (0, 0), survey=1.0, scale=1.0), "position has both survey and scale"),
        (
            lambda: Network(ALIKE),
            'types are called "gauge"',
        ),
        (lambda: simulate(network(), CV, [2.0, 1.0, 0.0], key=1), "time must be one increasing column"),
        (
            lambda: Problem(
                Network([sensors.ranger.on(Node("m", path=Path([0, 10], [[0, 0], [10, 0]])))]),
                CV,
                pd.DataFrame({"time": [0.0, 500.0], "sensor": "m", "range": [5.0, 6.0]}),
            ),
            'data row 1: time 500 is outside the path of node "m"',
        ),
    ],
)
def test_a_bad_declaration_is_told_by_name(build, text):
    with pytest.raises(InputError, match=text):
        build()


def test_names_in_a_file_are_text(tmp_path):
    path = tmp_path / "rows.csv"
    path.write_text("time,sensor,target,range\n0,01,NA,5\n1,NA,NA,6\n2,nan,NA,7\n3,7.0,NA,8\n")
    data = measure(read_table(path), network(names=("01", "NA", "nan", "7")))
    np.testing.assert_array_equal(data.sensor, [0, 1, 2, 3])
    assert data.target_names == ("NA",)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (dict(range="2024-01-01"), 'row 0 column "range": "2024-01-01" is no number'),
        (dict(range=pd.Timestamp("2024-01-01")), 'row 0 column "range": "2024-01-01 00:00:00" is no number'),
        (dict(range=1e300), 'row 0 column "range": 1e[+]300 is too large; leave it blank'),
        (dict(range_std=1e-300), 'row 0 column "range_std": std is 1e-300; it must be positive, 1e-100 or more'),
        (dict(time=1e300), 'row 0 column "time": 1e[+]300 is not a finite time'),
    ],
)
def test_a_cell_from_which_no_finite_number_follows_is_refused(change, text):
    with pytest.raises(InputError, match=text):
        measure(read_table(recorded().assign(**change)), network())


def test_rows_with_more_cells_than_the_header_are_refused(tmp_path):
    path = tmp_path / "rows.csv"
    path.write_text("time,sensor,range\n0,a,5,\n1,a,6,\n")  # a spreadsheet's empty last column
    assert measure(read_table(path), network()).value.tolist() == [[5.0], [6.0]]
    path.write_text("time,sensor,range\n0,a,5,1\n1,a,6,1\n")
    with pytest.raises(InputError, match="has rows with more cells than its header; give every column a name"):
        read_table(path)


UNIT_SIZES = {  # by the definitions: SI, international foot, statute mile and nautical mile
    "m": {"m": 1, "km": 1000, "cm": 1 / 100, "mm": 1 / 1000, "ft": 0.3048, "mi": 5280 * 0.3048, "nmi": 1852},
    "rad": {"rad": 1, "mrad": 1 / 1000, "deg": np.pi / 180, "°": np.pi / 180},
    "s": {"s": 1, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60, "h": 3600},
    "m/s": {"m/s": 1, "km/h": 1000 / 3600},
    "Hz": {"Hz": 1, "kHz": 1000},
    "dB": {"dB": 1},
    "dBm": {"dBm": 1},
    "1": {"1": 1, "%": 1 / 100},
    "T": {"T": 1, "uT": 1e-6, "nT": 1e-9},
}


def test_every_unit_has_the_size_of_its_definition():
    assert {unit for sizes in UNIT_SIZES.values() for unit in sizes} == set(UNITS)
    given = read_table(recorded())
    for wanted, sizes in UNIT_SIZES.items():
        for unit, size in sizes.items():
            assert unit_factor(given, "x", unit, wanted) == pytest.approx(size, rel=1e-12), unit
            assert unit_factor(given, "x", wanted, unit) == pytest.approx(1 / size, rel=1e-12), unit
        assert unit_factor(given, "x", None, wanted) == 1.0


def test_values_and_stds_are_converted_each_by_its_own_unit():
    frame = pd.DataFrame({"time [min]": [1.0, 2.0], "sensor": ["a", "b"], "range [km]": [0.05, 0.06],
                          "range_std [cm]": [150.0, np.nan]})  # fmt: skip
    data = measure(read_table(frame), network())
    np.testing.assert_allclose(data.time, [60.0, 120.0])
    np.testing.assert_allclose(data.value[:, 0], [50.0, 60.0])
    assert data.std[0, 0] == pytest.approx(1.5)
    assert data.has_std[:, 0].tolist() == [True, False]
    nautical = measure(read_table(frame.rename(columns={"range_std [cm]": "range_std [nmi]"})), network())
    assert nautical.std[0, 0] == pytest.approx(150.0 * 1852)
    plain = measure(read_table(frame.rename(columns={"range_std [cm]": "range_std"})), network())
    assert plain.std[0, 0] == 150.0, "a std without a unit is in that of the channel"


def test_rows_are_named_by_the_line_of_the_file_and_by_the_index_of_a_frame(tmp_path):
    path = tmp_path / "rows.csv"
    path.write_text("time,sensor,range\n0,a,5\n1,a,x\n")
    with pytest.raises(InputError, match=r"rows\.csv row 3 column .range.: .x. is no number"):
        measure(read_table(path), network())
    frame = pd.DataFrame({"time": [0.0, 1.0], "sensor": "a", "range": [5.0, "x"]}, index=[70, 80])
    with pytest.raises(InputError, match=r"data row 80 column .range.: .x. is no number"):
        measure(read_table(frame), network())
    assert read_table(path).lines.tolist() == [2, 3]
    joined = pd.concat([frame.head(1), frame.head(1), frame])  # labels 70, 70, 70, 80 name no row
    with pytest.raises(InputError, match=r"data row at position 3 column .range.: .x. is no number"):
        measure(read_table(joined), network())


def test_rows_are_brought_to_common_epochs(tmp_path):
    """Jittered stamps of three sensors share an epoch; what is rebuilt, selected and applied keeps it."""
    random = np.random.default_rng(0)
    nodes = [Node(f"gauge_{k}", place, scale=1.0) for k, place in enumerate([(0, 0), (50, 0), (0, 50)])]
    network = Network([sensors.ranger.on(node) for node in nodes])
    time = np.repeat(0.1 * np.arange(40), 3)
    table = pd.DataFrame({
        "time": time + random.uniform(-0.04, 0.04, 120), "sensor": [f"gauge_{k}" for k in range(3)] * 40,
        "range": 30 + time + random.normal(size=120),
    })  # fmt: skip
    free = Problem(network, ConstantVelocity(1.0), table)
    problem = Problem(network, ConstantVelocity(1.0), table, epoch=0.1)
    assert [len(p.epochs[0].time) for p in (free, problem)] == [120, 40]
    np.testing.assert_allclose(problem.measurements.time, time, atol=1e-12)
    assert problem.epoch_shift == pytest.approx(np.abs(table["time"] - time).max())
    assert free.epoch_shift == 0.0
    for other in (problem.rebuild(fix=["gauge_0.*"]), problem.select(np.arange(60)), problem.unlinked()):
        assert other.epoch == 0.1
        assert len(other.epochs[0].time) == len(np.unique(other.measurements.time))
    assert build._epoch(problem) == {"epoch": 0.1, "epoch_shift": problem.epoch_shift}
    assert build._epoch(free) == {}
    for bad in (0.0, -1.0, np.nan, "0.1"):
        with pytest.raises(InputError, match=r"Problem\(epoch=.*give seconds, a positive number"):
            Problem(network, ConstantVelocity(1.0), table, epoch=bad)


@pytest.mark.parametrize(("mark", "name"), [(";", "semicolons"), ("\t", "tabs"), ("|", "bars")])
def test_another_separator_is_named(mark, name, tmp_path):
    path = tmp_path / "rows.csv"
    path.write_text(f"time{mark}sensor{mark}range\n0,5{mark}a{mark}1,25\n")
    with pytest.raises(InputError, match=f"rows.csv: its columns are parted by {name}; write commas"):
        read_table(path)


def test_a_category_of_numbers_is_no_date():
    """It came as a warning of pandas out of `read_table`."""
    cells = pd.Series([None, None, None, 10**400], dtype=object).astype("category")
    frame = pd.DataFrame({"time": cells, "sensor": list("abcd"), "range": 5.0})
    with pytest.raises(InputError, match="time"):
        measure(read_table(frame), network())


@pytest.mark.parametrize(
    ("cell", "value"),
    [(np.array(5.0), 5.0), (np.array("5"), 5.0), (np.ma.masked, None), (decimal.Decimal("sNaN"), None)],
    ids=["array", "text", "masked", "signalling"],
)
def test_a_cell_may_be_an_array_without_axes_or_masked(cell, value):
    cells: np.ndarray = np.empty(2, object)
    cells[:] = [cell, 1.0]
    frame = pd.DataFrame({"time": [0.0, 1.0], "sensor": "a", "range": pd.Series(cells, dtype=object)})
    data = measure(read_table(frame), network())
    assert data.value[:, 0].tolist() == [value or 0.0, 1.0]
    assert data.measured[:, 0].tolist() == [value is not None, True]


def test_a_wide_header_is_checked_in_the_time_of_its_length():
    """10,000 columns took 4 s by pairs; a second is three hundred times what it takes now."""
    began = time.perf_counter()
    assert len(table._once(File("t.csv"), [f"c{k}" for k in range(10_000)])) == 10_000
    assert time.perf_counter() - began < 1.0


NAMED = {
    "node": lambda name: Node(name, (0, 0)),
    "sensor": lambda name: gauge.on(Node("a", (0, 0)), name=name),
    "component": lambda name: Node("a", (0, 0), **{name: 1.0}),
    "column": lambda name: measure(read_table(pd.DataFrame({"time": [0.0], "sensor": "a", name: 1.0})), network()),
    "target": lambda name: measure(
        read_table(pd.DataFrame({"time": [0.0], "sensor": "a", "target": name, "range": 1.0})), network()
    ),
}


@pytest.mark.parametrize("what", NAMED)
def test_a_name_has_no_control_characters(what):
    """A terminal obeys them, and a table of two lines has a name that ends its line."""
    for name in ("a\x1bcb", "a\nb", "a\x9bb", "\ud800", "a\u2028b"):
        with pytest.raises(InputError, match="has control characters in its name") as caught:
            NAMED[what](name)
        assert str(caught.value).isprintable()
    if what in ("node", "sensor", "component"):
        with pytest.raises(InputError, match="has the blank name"):
            NAMED[what](" ")
        with pytest.raises(InputError, match="stands for =a in a table; drop the apostrophe"):
            NAMED[what]("'=a")
        assert NAMED[what]("Büro 1 \N{MICRO SIGN}")


@pytest.mark.parametrize("name", ["=HYPERLINK(1)", "+x", "-x", "@home"])
def test_no_cell_of_a_table_is_a_formula_and_every_name_comes_back(name, tmp_path):
    nodes = [Node(name, (0, 0)), Node("-1", (60, 0)), Node("'a", (0, 60))]
    net = Network([gauge.on(node) for node in nodes])
    drawn = simulate(net, CV, np.arange(3.0), key=1, tracks={name: PATH[:3], "-7": PATH[3:6]})
    drawn.write(tmp_path / "t.csv")
    write_nodes(tmp_path / "n.csv", nodes)
    for path in tmp_path.glob("*.csv"):
        rows = list(csv.reader(path.read_text().splitlines()))
        assert not [cell for row in rows for cell in row if cell != "-1" and re.match(r"[=+@]|-[^\d]|-\d\.[a-z]", cell)]
    data = measure(read_table(tmp_path / "t.csv"), net)
    assert set(data.target_names) == {name, "-7"}
    assert set(data.sensor.tolist()) == {0, 1, 2}
    assert list(truth_beside(tmp_path / "t.csv").biases) == list(net.labels)
    assert list(read_nodes(tmp_path / "n.csv")) == [name, "-1", "'a"]
    assert measure(read_table(pd.read_csv(tmp_path / "t.csv")), net).target_names == data.target_names
