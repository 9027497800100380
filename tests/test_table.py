"""Names, times and declarations at the door: what a person's table and network may hold."""

import numpy as np
import pandas as pd
import pytest

from probcal import (
    MAP,
    Bias,
    Channel,
    ConstantVelocity,
    InputError,
    Network,
    Node,
    Path,
    Problem,
    Unknown,
    White,
    fit,
    read_table,
    sensor,
    sensors,
    simulate,
    track,
)
from probcal.geometry import norm
from probcal.table import measure

CORNERS = [(0, 0), (60, 0), (60, 60), (0, 60)]
PATH = np.stack([np.linspace(5, 55, 20), 30 + 20 * np.sin(np.linspace(0, 6, 20))], 1)
CV = ConstantVelocity(0.5)


def network(std=1.0, names=("a", "b", "c", "d")):
    @sensor(range=Channel("m", std=std))
    def gauge(target, pose, *, range_offset=Bias("m", 2.0)):
        return dict(range=norm(target.position - pose.position) + range_offset)

    return Network([gauge.on(Node(name, p)) for name, p in zip(names, CORNERS, strict=True)])


def recorded(built=None, **changes):
    return simulate(built or network(), CV, np.arange(20.0), 1, tracks={"target": PATH}, **changes).table


def test_times_may_be_dates_in_text_or_in_a_frame():
    table = recorded()
    stamps = pd.Timestamp("2024-01-01T10:00:00Z") + pd.to_timedelta(table["time"], unit="s")
    for column in (stamps, stamps.dt.strftime("%Y-%m-%dT%H:%M:%SZ"), pd.to_timedelta(table["time"], unit="s")):
        problem = Problem(network(), CV, table.assign(time=column))
        np.testing.assert_allclose(problem.measurements.time, table["time"], atol=1e-9)


def test_names_that_are_numbers_are_one_name():
    table = recorded(network(names=("1", "2", "3", "4")))
    mixed = table.assign(sensor=table["sensor"].astype(float), target=[7 if k % 2 else " 7" for k in range(len(table))])
    problem = Problem(network(names=("1", "2", "3", "4")), {7: CV}, mixed)
    assert problem.measurements.target_names == ("7",)
    assert len(problem.epochs[0].time) == 20
    run = simulate(network(), {7: CV}, np.arange(20.0), 1, tracks={7: PATH})
    np.testing.assert_allclose(run.truth.tracks[["position_x", "position_y"]], PATH)


def test_a_sensor_type_needs_only_the_components_of_the_targets_it_sees():
    built = Network([sensors.toa.on(Node("ear", (0, 0), scale={"clock": 1.0}))]
                    + [sensors.ranger.on(Node(f"mast_{k}", p)) for k, p in enumerate(CORNERS)])  # fmt: skip
    motion = {"shot": CV + White("emission", "m", 50.0), "car": CV}
    grid = [(t, s, o) for o, names in (("shot", ["ear"]), ("car", [f"mast_{k}" for k in range(4)]))
            for t in range(20) for s in names]  # fmt: skip
    plan = pd.DataFrame(grid, columns=["time", "sensor", "target"])
    run = simulate(built, motion, np.arange(20.0), 1, tracks={"shot": PATH, "car": PATH}, schedule=plan)
    assert Problem(built, motion, run.table).labels[0] == "ear.clock"


def test_exact_labels_with_brackets_can_be_fixed_and_rebuilt():
    built = network(names=("a[0]", "a[1]", "c", "d"))
    problem = Problem(built, CV, recorded(built), fix=["a[0].range_offset"])
    assert problem.rebuild().labels == problem.labels == ("a[1].range_offset", "c.range_offset", "d.range_offset")


def test_track_follows_the_fit_in_fixed_biases_levels_and_with_sensors_missing():
    built = network(Unknown(0.3, 5.0))
    table = recorded(network(), biases={"b.range_offset": 3.0})
    problem = Problem(built, CV, table, fix={"a.range_offset": 0.0})
    from probcal import EA

    done = fit(problem, EA())
    again = track(Problem(built, CV, table), done)
    for name in ("mean", "sd"):
        np.testing.assert_allclose(again["track"][name].values, done["track"][name].values, rtol=1e-3, atol=1e-3)
    part = table[table["sensor"] != "d"]
    assert track(Problem(built, CV, part), done)["track"].sizes["epoch"] == 20
    with pytest.raises(InputError, match='no row of sensor "d"'):
        fit(Problem(built, CV, part), MAP())


@pytest.mark.parametrize(
    ("build", "text"),
    [
        (lambda: Node("h", (0, 0), survey={"heading": Bias("deg", 2.0)}), 'heading is in "deg"; give it in rad'),
        (lambda: Node("h", (0, 0), scale={"clock": Bias("s", 2.0, nominal=1.0)}), "takes no nominal"),
        (lambda: Node("h", (0, 0), survey=0.0), "survey of position is 0: it must be positive"),
        (lambda: Node("h", (0, 0), survey={"hedding": 1.0}), 'did you mean "heading"'),
        (lambda: Node("h", (0, 0), survey=1.0, scale=1.0), "position has both survey and scale"),
        (lambda: Network([network().sensors[0], *network(names="efgh").sensors[:1]]), 'types are called "gauge"'),
        (lambda: simulate(network(), CV, [2.0, 1.0, 0.0], 1), "time must be one increasing column"),
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
