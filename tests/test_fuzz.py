"""Whatever a file holds, the door takes it whole or refuses it in one sentence: no other exception, no NaN kept.

`PROBCAL_FUZZ=5000 uv run pytest tests/test_fuzz.py` draws that many new examples a test, 15 the default run.
"""

import datetime
import decimal
import json
import os
import sys
import warnings
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import probcal
from probcal import (
    ConstantVelocity,
    InputError,
    Network,
    Node,
    Problem,
    Truth,
    load,
    read_nodes,
    read_table,
    sensors,
)
from probcal.cli import commands
from probcal.cli.models import load_model, load_problem, load_truth
from probcal.simulate import truth_beside
from probcal.table import measure

EXAMPLES = int(os.environ.get("PROBCAL_FUZZ", "15"))
fuzz = settings(
    max_examples=EXAMPLES, derandomize="PROBCAL_FUZZ" not in os.environ, suppress_health_check=list(HealthCheck)
)
NETWORK = Network(
    [
        sensors.radar.on(Node("a", (0, 0))),
        sensors.ranger.on(Node("01", (9, 0))),
        sensors.presence.on(Node("nan", (0, 9))),
    ]
)
HUGE = 10**400

CELLS = st.sampled_from([
    "", " ", "a", "01", "nan", "NA", "0", "1", "2.5", "-3", "1e308", "-1e999", "1e-320", "inf", "NaN", "1_0", "0x1",
    "١", "2024-01-01", "2024-01-01T00:00:00Z", "0001-01-01", "9999-12-31", "12:30", '"', "'", "a,b", "\n", "\r", "\0",
    "\ufeff", "1" * 400, "a" * 5000, "é", "True", "None", "[]", "\x1b[31m", "=1+1",
])  # fmt: skip
HEADERS = st.sampled_from([
    "time", "sensor", "target", "range", "azimuth", "present", "range_std", "azimuth_std", "time [ms]", "time [deg]",
    "range [km]", "range [mm]", "azimuth [deg]", "range_std [nmi]", "range [", "range ]", "range [m] [m]", "[m]",
    "range []", "", " ", " " * 3000 + "]", "range" * 1000, "time.1", "Unnamed: 0", "\n", "présent",
])  # fmt: skip
PLACES = st.sampled_from([
    "node", "name", "x", "y", "z", "x [km]", "y [deg]", "latitude", "longitude", "height", "latitude [rad]",
    "heading", "heading [deg]", "headng", "pitch", "clock", "clock [us]", "survey_position", "scale_position",
    "scale_heading [deg]", "scale_clock [us]", "survey_gain", "gain", "gain [dB]", "sd_gain", "path", "self",
    "survey", "survey_", "position", "",
])  # fmt: skip


def refused(call):
    """What a call returns, or None where it refuses in one sentence; every other exception is a failure."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            return call()
    except InputError as error:
        text = str(error)
        assert text
        assert text.isprintable()
        assert len(text) < 1000


def check_table(source):
    """Rows that pass the door are finite, and a problem can be built from them."""
    data = refused(lambda: measure(read_table(source), NETWORK))
    if data is None:
        return
    for array in (data.time, data.value, data.std):
        assert np.isfinite(array).all()
    assert (data.std[data.has_std] > 0).all()
    assert not (data.has_std & ~data.measured).any()
    assert set(data.sensor) <= set(range(3))
    assert len(data.target_names) > data.target.max()
    assert all(isinstance(name, str) and name for name in data.target_names)
    problem = refused(lambda: Problem(NETWORK, ConstantVelocity(1.0), source))
    if problem is not None:
        for recursion in problem.model.recursions:
            assert all(np.isfinite(np.asarray(part)).all() for part in recursion)


def check_nodes(source):
    nodes = refused(lambda: read_nodes(source))
    for node in (nodes or {}).values():
        assert np.isfinite(node.position).all()
        assert all(np.isfinite(value) for value in node.components.values())
        assert all(np.isfinite(bias.scale) and bias.scale > 0 for _, bias in node.spread.values())


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("fuzz")


def written(folder, name, content):
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode("utf-8", "surrogatepass"))
    return path


@fuzz
@given(
    content=st.binary(max_size=300),
    name=st.sampled_from(["t.csv", "t.csv.gz", "t.csv.zip", "t.csv.xz", "t.csv.zst", "t.tar"]),
)
def test_bytes(content, name, folder):
    path = written(folder, name, content)
    check_table(path)
    check_nodes(path)
    check_nodes(written(folder, "n.geojson", content))
    refused(lambda: Truth(path))
    refused(lambda: load(path))


@pytest.mark.needs("roads")
@fuzz
@given(content=st.binary(max_size=300))
def test_bytes_as_roads(content, folder):
    refused(lambda: probcal.read_roads(written(folder, "n.geojson", content), crs="local"))
    refused(lambda: probcal.read_roads(written(folder, "n.graphml", content)))


@st.composite
def texts(draw, headers):
    """Something like CSV: headers and cells that a person, a spreadsheet or a logger might leave."""
    columns = draw(st.lists(headers, min_size=1, max_size=5))
    rows = draw(st.lists(st.lists(CELLS, max_size=6), max_size=5))
    end = draw(st.sampled_from(["\n", "\r\n", "\r", "\n\n"]))
    return end.join(draw(st.sampled_from([",", ",", ",", ";"])).join(row) for row in [columns, *rows])


@fuzz
@given(text=texts(HEADERS))
def test_text_like_a_table(text, folder):
    check_table(written(folder, "t.csv", text))


@fuzz
@given(text=texts(PLACES))
def test_text_like_nodes(text, folder):
    check_nodes(written(folder, "n.csv", text))


@fuzz
@given(data=st.data())
def test_a_table_with_one_thing_wrong(data, folder):
    lines = [["time", "sensor", "target", "range", "range_std", "azimuth", "present"]]
    measured = {"a": ["5", "1", "0.1", ""], "01": ["4", "", "", ""], "nan": ["", "", "", "1"]}
    lines += [[str(t), name, "7", *cells] for t in range(3) for name, cells in measured.items()]
    row, column = data.draw(st.integers(0, len(lines) - 1)), data.draw(st.integers(0, 6))
    lines[row][column] = data.draw(HEADERS if row == 0 else CELLS)
    check_table(written(folder, "t.csv", "\n".join(",".join(line) for line in lines)))


@fuzz
@given(data=st.data())
def test_nodes_with_one_thing_wrong(data, folder):
    place = data.draw(st.sampled_from([["x", "y", "z"], ["latitude", "longitude", "height"]]))
    lines = [["node", *place, "heading", "scale_position", "clock", "scale_clock"]]
    lines += [[name, str(k), str(2 * k), "3", "0.1", "5", "", "2"] for k, name in enumerate(("a", "b", "01"))]
    row, column = data.draw(st.integers(0, 3)), data.draw(st.integers(0, 7))
    lines[row][column] = data.draw(PLACES if row == 0 else CELLS)
    check_nodes(written(folder, "n.csv", "\n".join(",".join(line) for line in lines)))


OBJECTS = st.sampled_from([
    None, pd.NA, pd.NaT, np.nan, np.inf, 1, 2.5, -1, HUGE, True, 1j, "a", "01", "1", "", "2024-01-01", b"1", [1], {},
    (1, 2), np.array([1, 2]), datetime.datetime(2024, 1, 1), datetime.date(1, 1, 1), datetime.timedelta(1),
    pd.Timestamp("2024", tz="UTC"), np.datetime64("2024-01-01"), decimal.Decimal("NaN"), decimal.Decimal("1e400"),
    decimal.Decimal("sNaN"), np.array(5.0), np.array("a"), np.ma.masked,
    pd.Interval(0, 1), pd.Period("2024"), float, np.float32(1), np.longdouble("1e4000"), "\ud800", "1e300", 1e300,
    -1e308,
])  # fmt: skip
DTYPES = st.sampled_from([
    None, object, "string", "category", "Int64", "boolean", "Float64", "datetime64[ns]", "datetime64[s, UTC]",
    "timedelta64[ns]", "complex128", "period[D]", "Sparse[float]", "float16", "uint8", "bool", np.longdouble,
])  # fmt: skip
LABELS = st.sampled_from(
    ["time", "sensor", "target", "range", "range_std", "present", "azimuth [deg]", 0, None, ("a", "b"), b"time"]
)


@st.composite
def frames(draw, labels):
    """A DataFrame whose columns have arbitrary types, double names and nested headers."""
    size = draw(st.integers(0, 4))
    columns = []
    for label in (chosen := draw(st.lists(labels, min_size=0, max_size=6))):
        cells = draw(
            st.lists(st.sampled_from(["a", "01", 1]) if label == "sensor" else OBJECTS, min_size=size, max_size=size)
        )
        column = pd.Series(cells, dtype=object)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                column = column.astype(draw(DTYPES) or object)
        except Exception:  # this type cannot hold these cells: they stay objects
            pass
        columns.append(column)
    frame = pd.concat(columns, axis=1) if columns else pd.DataFrame(index=range(size))
    frame.columns = (
        chosen if draw(st.booleans()) or not columns else pd.MultiIndex.from_tuples([(str(c), 1) for c in chosen])
    )
    if draw(st.booleans()):
        frame.index = pd.MultiIndex.from_product([range(size), ["\n"]])
    return frame


@fuzz
@given(frames(LABELS))
def test_frames(frame):
    check_table(frame)
    refused(lambda: Truth(frame))


@fuzz
@given(
    frames(
        st.sampled_from(["node", "x", "y", "latitude", "longitude", "height", "heading", "survey_position", "gain", 0])
    )
)
def test_frames_of_nodes(frame):
    check_nodes(frame)


@fuzz
@given(data=st.data())
def test_a_good_frame_with_one_column_of_another_type(data):
    frame = pd.DataFrame({"time": range(6), "sensor": ["a", "01"] * 3, "target": "7", "range": 5.0, "range_std": 1.0})
    name = data.draw(st.sampled_from(list(frame.columns)))
    cells = pd.Series(
        data.draw(st.lists(OBJECTS, min_size=6, max_size=6)) if data.draw(st.booleans()) else frame[name], dtype=object
    )
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            cells = cells.astype(data.draw(DTYPES) or object)
    except Exception:  # this type cannot hold these cells: they stay objects
        pass
    check_table(frame.assign(**{name: cells}))


LEAVES = [None, True, 0, -1.5, 200, HUGE, np.nan, np.inf, "", "a", "Point", "FeatureCollection", "\n"]
KEYS = ["type", "features", "geometry", "properties", "coordinates", "node", "height", "gain"]
JSON = st.recursive(
    st.sampled_from(LEAVES),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(KEYS), inner, max_size=4),
    max_leaves=12,
)


def feature(name, place, **properties):
    return {
        "type": "Feature",
        "geometry": {"type": "Point", "coordinates": place},
        "properties": {"node": name} | properties,
    }


def spoil(data, content):
    """Put any JSON value in the place of one somewhere in the content."""
    holder, keys = content, []
    while isinstance(holder, (dict, list)) and len(holder) and (not keys or data.draw(st.booleans())):
        keys.append(
            (holder, data.draw(st.sampled_from(list(holder) if isinstance(holder, dict) else range(len(holder)))))
        )
        holder = holder[keys[-1][1]]
    keys[-1][0][keys[-1][1]] = data.draw(JSON)


@fuzz
@given(data=st.data())
def test_geojson(data, folder):
    content = {"type": "FeatureCollection", "features": [feature("a", [8, 47, 0], gain=1), feature("b", [8.1, 47, 9])]}
    spoil(data, content)
    check_nodes(written(folder, "n.geojson", json.dumps(content)))
    check_nodes(written(folder, "n.json", json.dumps(data.draw(JSON))))


@pytest.mark.needs("roads")
@fuzz
@given(data=st.data())
def test_roads(data, folder):
    line = {"type": "LineString", "coordinates": [[0, 0], [60, 0]]}
    content = {"type": "FeatureCollection", "features": [{"geometry": line, "properties": {"name": "a", "oneway": 1}}]}
    spoil(data, content)
    refused(lambda: probcal.read_roads(written(folder, "n.geojson", json.dumps(content)), crs="local"))
    refused(lambda: probcal.read_roads(written(folder, "n.json", json.dumps(data.draw(JSON)))))


def test_nested_and_overlong_json_is_refused(folder):
    for text in ("[" * 100_000, "1" * 5000, '{"features": ' + "1" * 5000 + "}", '{"features": [[]]}'):
        assert refused(lambda text=text: read_nodes(written(folder, "n.json", text))) is None


@fuzz
@given(data=st.data())
def test_truth_beside_a_table(data, folder):
    tracks = [["time", "target", "position_x", "position_y"], ["1", "7", "2", "3"], ["2", "7", "2", "5"]]
    biases = [["bias", "value"], ["a.range_offset", "1"], ["b.range_offset", "2"]]
    cells = data.draw(st.sampled_from([tracks, biases]))
    row, column = data.draw(st.integers(0, 2)), data.draw(st.integers(0, len(cells[0]) - 1))
    cells[row][column] = data.draw(CELLS)
    written(folder, "t.tracks.csv", "\n".join(",".join(line) for line in tracks))
    written(folder, "t.biases.csv", "\n".join(",".join(line) for line in biases))
    truth = refused(lambda: truth_beside(folder / "t.csv"))
    if truth is not None:
        assert all(np.isfinite(value) for value in truth.biases.values())
        assert np.isfinite(truth.tracks[["time", "position_x", "position_y"]].to_numpy()).all()


MODELS = [
    "raise SystemExit", "import sys; sys.exit(3)", "exit('bye')", "raise RecursionError", "def f(): f()\nf()",
    "1 / 0", "x = \0", "def problem(:", "raise GeneratorExit", "class Stop(BaseException): pass\nraise Stop('a\\nb')",
    "import no_such_package", "class Odd(Exception):\n def __str__(self): raise ValueError\nraise Odd",
    "raise StopIteration", "import sys; sys.path.clear()", "raise Exception('a' * 10**6)",
    "import probcal\nprobcal.Node('a', (0, 0), survey=-1)", "raise MemoryError", "assert False", "", "problem = 3",
    "x" * 10**5 + "= 1", "(" * 10**4, "def problem(data=None, more): pass", "# -*- coding: nonsense -*-",
    "\ufeff\ufeff",
]  # fmt: skip
RESULTS = [
    "return",
    "return 3",
    "yield",
    "raise SystemExit(0)",
    "raise KeyError('a\\nb')",
    "return problem(data)",
    "return [" * 60,
    "assert 0",
]


@pytest.mark.parametrize("text", MODELS, ids=lambda text: repr(text[:20]))
def test_a_model_file_that_fails_is_refused(text, tmp_path):
    before = list(sys.path)
    for name in ("model.py", "no-name 1.py", "model.txt", "model.pyc", "model.so"):
        try:
            assert refused(lambda name=name: load_problem(written(tmp_path, name, text), None)) is None
        finally:
            sys.path[:], changed = before, list(sys.path)
        assert changed == before or "clear" in text


@pytest.mark.parametrize("text", RESULTS, ids=repr)
def test_a_model_function_that_returns_the_wrong_thing_is_refused(text, tmp_path):
    path = written(tmp_path, "model.py", f"def problem(data=None):\n    {text}\nscenario = truth = problem\n")
    assert refused(lambda: load_problem(path, None)) is None
    module = refused(lambda: load_model(path))
    problem = Problem(NETWORK, ConstantVelocity(1.0), pd.DataFrame({"time": [0, 1], "sensor": "a", "range": 1.0}))
    if module is not None:
        assert refused(lambda: load_truth(module, path, None, problem)) is None
        assert refused(lambda: commands.simulate_command(path)) is None


@fuzz
@given(content=st.binary(max_size=60) | st.text(max_size=60))
def test_bytes_as_a_model_file(content, folder):
    assert refused(lambda: load_problem(written(folder, "model.py", content), None)) is None


def test_ctrl_c_in_a_model_file_ends_the_program(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        load_model(written(tmp_path, "model.py", "raise KeyboardInterrupt"))


@pytest.mark.parametrize(
    "name", ["", ".", "a" * 300, "a\0b", "a" * 5000, "none.csv", "a\nb.csv", "\ud800.csv"], ids=lambda n: repr(n[:9])
)
def test_a_path_that_is_no_file_is_refused(name, tmp_path):
    for path in (tmp_path / name, Path(name), str(tmp_path / name)):
        for reader in (read_table, read_nodes, load, Truth):
            assert refused(lambda reader=reader, path=path: reader(path)) is None
        assert refused(lambda path=path: load_model(Path(path))) is None
        if name not in ("", "."):
            assert refused(lambda path=path: load_problem(Path(commands.__file__), Path(path))) is None


@fuzz
@given(data=st.data())
def test_a_fit_that_was_cut_off_is_refused(data, folder):
    path = folder / "whole.nc"
    if not path.exists():
        xr.DataTree.from_dict({"calibration": xr.Dataset({"mean": ("bias_label", [1.0, 2.0])})}).to_netcdf(
            path, engine="h5netcdf"
        )
        assert refused(lambda: load(path)) is None
    whole = path.read_bytes()
    size = data.draw(st.integers(0, len(whole) - 1))
    assert refused(lambda: load(written(folder, "cut.nc", whole[:size]))) is None
