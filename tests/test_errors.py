"""Every sentence that the package can raise is matched by a test: a walk of the source, and the cases without a home.

A text counts as matched where a string in `tests/` holds a stretch of it (12 characters, or all there is) that no
other error shares. Values that are filled in (`{name}`) are no part of the text.
"""

import ast
import inspect
import re
from pathlib import Path as File

import numpy as np
import pandas as pd
import pytest
import xarray as xr

import probcal
from probcal import (
    EA,
    MAP,
    Bias,
    Channel,
    ConstantVelocity,
    Detection,
    Gaussian,
    Horseshoe,
    InputError,
    LocalFrame,
    Network,
    Node,
    Path,
    Problem,
    RandomWalk,
    StudentT,
    Target,
    Truth,
    Unknown,
    White,
    compare,
    fit,
    load,
    read_nodes,
    read_table,
    sensor,
    sensors,
    simulate,
    track,
    write_nodes,
)
from probcal.analysis.check import check
from probcal.cli import commands
from probcal.cli.models import load_model, load_truth
from probcal.geometry import norm
from probcal.inference.methods import choose_prior
from probcal.motion import as_motion
from probcal.network import ANGLES
from probcal.simulate import truth_beside
from probcal.types import PoseView, TargetView

ROOT = File(probcal.__file__).parent
TESTS = File(__file__).parent
LENGTH = 12


def constants(node):
    """Constant stretches of a message: of a string, an f-string, a conditional of both."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return [node.value]
    if isinstance(node, ast.JoinedStr):
        return [part.value for part in node.values if isinstance(part, ast.Constant)]
    if isinstance(node, ast.IfExp):
        return constants(node.body) + constants(node.orelse)
    if isinstance(node, ast.BinOp):
        return constants(node.left) + constants(node.right)
    return []


def raised(text, file):
    """Messages of one module as (place, stretches); those that carry the text of another error have none."""
    for node in ast.walk(ast.parse(text)):
        call = node.exc if isinstance(node, ast.Raise) else None
        name = call.func.id if isinstance(call, ast.Call) and isinstance(call.func, ast.Name) else ""
        if name in ("InputError", "FitError", "WingMissing"):
            stretches = [s.strip(" \"':;,.()") for s in constants(call.args[0])]
            yield f"{file}:{node.lineno}", [s for s in stretches if len(s) > 2]


def strings(text):
    """Strings of a test file, doc strings apart, as a regular expression or a text would read."""
    tree = ast.parse(text)
    docs = {id(n.body[0].value) for n in ast.walk(tree) if isinstance(n, (ast.Module, ast.FunctionDef, ast.ClassDef))
            and n.body and isinstance(n.body[0], ast.Expr)}  # fmt: skip
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docs:
            yield node.value.replace("\\", "").replace("[+]", "+")


def windows(stretches):
    """Every stretch of LENGTH characters, shorter constants whole."""
    return {s[k : k + LENGTH] for s in stretches for k in range(max(1, len(s) - LENGTH + 1))}


def unmatched(messages, said):
    """Messages of which no string in `said` holds a stretch of their own: (place, the longest such stretch)."""
    of = {place: windows(stretches) for place, stretches in messages}
    count = {}
    for found in of.values():
        for window in found:
            count[window] = count.get(window, 0) + 1
    for place, stretches in messages:
        own = {window for window in of[place] if count[window] == 1} or of[place]
        if stretches and not any(window in said for window in own):
            yield place, max(stretches, key=len)


def test_every_error_text_is_matched_by_a_test():
    files = sorted(ROOT.rglob("*.py"))
    messages = [one for path in files for one in raised(path.read_text(), path.relative_to(ROOT).as_posix())]
    said = "\n".join(text for path in sorted(TESTS.glob("test_*.py")) for text in strings(path.read_text()))
    open_ones = [f'{place}: "{text}"' for place, text in unmatched(messages, said)]
    assert not open_ones, "no test matches these texts, write pytest.raises(..., match=...) or add a case below:\n" + (
        "\n".join(open_ones)
    )


def node(**changes):
    return Node("n", **({"position": (0, 0)} | changes))


def gauge(**channels):
    """A declaration that returns what its channels are called."""
    return sensor(**(channels or {"range": Channel("m")}))


def declare(function, **channels):
    return lambda _: gauge(**channels)(function)


def reads_gain(target, pose, *, gain=Bias("dB", 1.0)):
    return dict(range=norm(target.position - pose.position) + gain + pose.gain)


def fails(target, pose):
    raise ArithmeticError("no distance")


class Endless(RandomWalk):
    """A component that states no start."""

    def start(self):
        return {}


RANGER = sensors.ranger
PLACES = [(0, 0), (50, 0), (0, 50)]
NETWORK = Network([RANGER.on(Node(f"n_{k}", place)) for k, place in enumerate(PLACES)])
ROWS = pd.DataFrame({"time": [0.0, 1.0, 2.0], "sensor": ["n_0", "n_1", "n_2"], "range": 30.0})
CV = ConstantVelocity(1.0)
MIXED = Network([sensors.presence.on(Node("p", (0, 0))), RANGER.on(Node("r", (9, 0)))])
COUNTER = Network([gauge(counts=Channel("furlong"))(lambda target, pose: dict(counts=target.position[0])).on(node())])
FRAME = LocalFrame(50.0, 8.0)
TRACK = pd.DataFrame({"time": [0.0, 1.0], "position_x": [0.0, 1.0], "position_y": 0.0})


def problem(network=NETWORK, motion=CV, rows=ROWS, **changes):
    return Problem(network, motion, rows, **changes)


def calibrated(*labels):
    values = {name: ("bias_label", np.ones(len(labels))) for name in ("mean", "sd")}
    return xr.DataTree.from_dict({"calibration": xr.Dataset(values, {"bias_label": list(labels)}),
                                  "constant_data": xr.Dataset()})  # fmt: skip


def cells(**columns):
    return pd.DataFrame({"node": ["a", "b"], "x": [0.0, 1.0], "y": 0.0} | columns)


def places(**columns):
    return pd.DataFrame({"node": ["a"], "latitude": [50.0], "longitude": [8.0]} | columns)


def written(folder, name, text):
    path = folder / name
    path.write_text(text)
    return path


def points(*features):
    return '{"type": "FeatureCollection", "features": [' + ", ".join(features) + "]}"


CASES = [
    (lambda _: Problem([1], CV, None), "Problem: network is of type list; give a Network, as in Network([sensor_type.on("),
    (lambda _: choose_prior(MAP(), "gaussian"), "the prior is 'gaussian'; give a prior itself, such as Horseshoe() or"),
    (lambda _: check("answers"), 'check: no fit has "answers"; a check may need explained, answer, factor, draws, truth'),
    (lambda _: as_motion(ConstantVelocity), "ConstantVelocity'> is not a motion; give ConstantVelocity(std)"),
    (lambda _: sensor(a=Channel("m"))(lambda target, pose, o=Bias("m", 1.0): {"a": o}), 'argument "o" is a bias: write a * before the first bias'),
    # sensor
    (lambda _: Bias("m", 1.0, nominal=np.nan), "nominal=nan): the nominal value must be finite"),
    (lambda _: Bias("m", 1.0, shared="node"), 'shared=\'node\'): shared is None or "type"'),
    (lambda _: Bias(5.0, 5.0), 'Bias(5.0, ...): the first argument is the unit, a string such as "m"'),
    (lambda _: Channel("meter"), 'Channel: the unit "meter" is not known; write "m"'),
    (lambda _: Bias("Degrees", 1.0), 'Bias: the unit "Degrees" is not known; write "deg"'),
    (lambda _: node(heading=45.0), 'node "n": heading is 45 rad, more than a turn; give radians, as in np.deg2rad(45)'),
    (lambda _: node(scale={"heading": 5}), "scale of heading is 5 rad, more than half a turn; give radians, as in"),
    (lambda _: Channel("m", wrap=True), "Channel('m', wrap=True): only angles in rad or deg wrap"),
    (lambda _: sensors.tdoa.on(node()), "tdoa uses 2 node(s), 1 given"),
    (lambda _: sensor(range=1.0), "sensor channel range=1.0: give Channel(unit, std=...)"),
    (declare(lambda target, pose, *, gain=1.0: {}), 'argument "gain" needs Bias(unit, scale) as default'),
    (declare(lambda target, *poses: {}), 'argument "*poses" is not allowed'),
    (declare(lambda target, pose: dict(rnge=1.0)), "returns ['rnge'], but the declared channels are ['range']"),
    (declare(fails), "sensor fails: the function failed on a trial call: no distance"),
    (declare(lambda target, pose: dict(range=1j * target.position[0])), 'channel "range" is complex; return its real'),
    (lambda _: TargetView("the target", {"position": 0.0}).power, 'the target has no component "power"; known: position'),
    # noise, priors, motion
    (lambda _: Unknown(-1.0), "Unknown(guess=-1.0): the guess must be positive"),
    (lambda _: Unknown(1.0, 1.0), "Unknown(factor=1.0): the factor must be greater than 1"),
    (lambda _: StudentT(0.0), "StudentT(df=0.0): the degrees of freedom must be positive"),
    (lambda _: Gaussian(correlation={"n_*": 2.0}), 'correlation "n_*" is 2: it must lie between -1 and 1'),
    (lambda _: Gaussian(correlation={"n_9.*": 0.5}).precision(["n_0.gain"], np.zeros(1, bool)), 'correlation "n_9.*" reaches 0 bias(es)'),
    (lambda _: Horseshoe(slab_df=0.0), "Horseshoe(slab_df=0.0): it must be positive"),
    (lambda _: CV + CV, 'motion: component "position" is declared twice'),
    (lambda _: Target(CV, {"position": 3.0}), 'Target start "position" is 3.0: give (mean, std) with finite values'),
    # network
    (lambda _: Path([0, np.nan], np.zeros((2, 2))), "Path: time, position and heading must be finite; drop the gaps"),
    (lambda _: Path([0, 0], np.zeros((2, 2))), "Path: time must increase"),
    (lambda _: Node("n"), 'node "n": give either position or path'),
    (lambda _: node(position=(1, 2, 3, 4)), 'node "n": position must be 2 or 3 finite numbers, got (1, 2, 3, 4)'),
    (lambda _: node(heading=np.inf), 'node "n": heading must be a finite number, got inf'),
    (lambda _: node(scale={"pitch": 0.1}), 'node "n": pitch has no meaning in 2-D'),
    (lambda _: node(scale={"gane": 0.1}, gain=1.0), 'node "n": scale names "gane"; did you mean "gain"?'),
    (lambda _: node(scale=-1.0), "scale of position is -1: it must be positive; leave it out where the stated value"),
    (lambda _: Network([node()]), "place a sensor with sensor_type.on(node)"),
    (lambda _: Network([RANGER.on("n", name="s")]), "sensor \"s\" is placed on 'n'; place it on a Node"),
    (lambda _: Network([RANGER.on(node()), RANGER.on(node(), name="s")]), 'two nodes are called "n"'),
    (lambda _: Network([RANGER.on(a := node()), sensors.doa.on(a)]), 'two sensors are called "n"; place one with .on('),
    (lambda _: Network([RANGER.on(node()), RANGER.on(Node("m", (0, 0, 0)))]), 'node "m" is 3-D, node "n" 2-D'),
    (
        lambda _: Network([RANGER.on(node(), name="m"), RANGER.on(Node("m", (0, 0)), name="s")]),
        '"m" is the name of a node and of a sensor elsewhere; rename one',
    ),
    (lambda _: Network([RANGER.on(Node("ranger", (0, 0)))]), '"ranger" is the name of a sensor type; rename the node or'),
    (
        lambda _: Network([gauge()(reads_gain).on(node(gain=0.0, scale={"gain": 1.0}))]),
        'two biases are called "n.gain"; give node, sensor and bias names that differ',
    ),
    # table
    (lambda _: read_table(3), "data must be a path or a DataFrame, got int"),
    (read_table, "cannot be read (Is a directory)"),
    (lambda _: problem(rows=ROWS.rename(columns={"range": "range [m"})), 'column "range [m": write the header as name'),
    (lambda _: problem(rows=ROWS.assign(target=["a", None, "b"])), 'data row 1 column "target" is blank; name the target'),
    (lambda _: problem(COUNTER, rows=pd.DataFrame({"time": [0], "sensor": "n", "counts [m]": 1})),
     'column "counts": unit "m", but the channel is in "furlong"'),
    (lambda _: problem(MIXED, rows=pd.DataFrame({"time": [0], "sensor": "r", "present": 1})),
     'sensor "r" (ranger) has no such channel, it measures range; leave the cell blank'),
    (lambda _: problem(MIXED, rows=pd.DataFrame({"time": [0], "sensor": "p", "present": 2})), "2 is not 0 or 1"),
    # problem, simulate, tree
    (lambda _: problem(rows=ROWS.assign(range=np.nan)), "data has no measured value; fill the channel columns"),
    (lambda _: problem(fix=["n_9.*"]), 'fix: no bias is called "n_9.*"'),
    (lambda _: problem(motion={"car": CV}), 'target "target" has no motion'),
    (lambda _: problem(motion=White("power", "dB", 1.0)), "the motion has no position; add ConstantVelocity(std) or"),
    (lambda _: problem(motion=CV + Endless("power", "dB", 1.0, (0.0, 1.0))), 'state the start of "power", Target(motion, start={"power": '),
    (lambda _: problem(motion=Target(CV, {"position": ((1, 2, 3), 1.0)})), 'the start mean of "position" must have 2'),
    (lambda _: Truth(TRACK, biases=[1.0]), "truth: biases is list; give a mapping from label to value"),
    (lambda _: Truth(biases={"a": "1"}), "truth: bias \"a\" is '1'; give a finite number"),
    (lambda _: Truth(TRACK.drop(columns="time")), 'truth data has no column "time"'),
    (lambda _: Truth(TRACK.assign(time=[0.0, None])), 'truth data row 1 column "time" is blank; drop the row'),
    (lambda _: Truth(TRACK).positions(np.zeros(1), np.array(["a"]), 3),
     'truth: the tracks have no column "position_z", the network is 3-D'),
    (lambda f: truth_beside(written(f, "t.biases.csv", "label,value\na,1\n").with_name("t.csv")),
     'truth t.biases.csv has no column "bias"'),
    (lambda _: simulate(NETWORK, CV, [0.0, 1.0], biases={"n_0.gain": 1}), 'simulate: no bias is called "n_0.gain"'),
    (lambda _: simulate(NETWORK, CV, [0.0, 1.0], tracks={"a": [[1, 2, 3]]}),
     'simulate: track "a" has shape (1, 3), expected (times, 2)'),
    (lambda f: load(calibrated("a").to_netcdf(f / "fit.nc", engine="h5netcdf") or f),
     "is not a fit written by probcal: its group calibration is missing or incomplete"),
    # inference, command line
    (lambda _: load(calibrated("a")), "load: path is of type DataTree; give the folder of a fit, or its fit.nc"),
    (lambda _: compare(calibrated("a"), calibrated("a")), "compare: fits is a single tree; give several in a list"),
    (lambda _: fit(problem(), key=2**63), "key=9223372036854775808: a seed is a whole number below 2**63"),
    (lambda _: fit(problem(), EA), "fit: method is the class EA itself; give a method, such as EA() or MAP()"),
    (lambda _: fit(problem(), start=np.zeros(3)), "fit: start is of type ndarray; give a Point, as probcal.modes."),
    (lambda _: track(problem()), "track: the argument calibration is missing; give the tree that fit(problem) or load("),
    (lambda _: track(problem(), "out"), 'track: calibration is the text "out"; give the tree that fit(problem) or load('),
    (lambda _: fit(problem(), save=("tracks",)), 'which is no group of draws; give "states", "predictive" or both'),
    (lambda _: track(problem(), calibrated("other")), "; fit the same network, or fix that bias"),
    (lambda f: load_model(written(f, "model.txt", "")), "model.txt is not a Python file; a model file defines"),
    (lambda f: commands.simulate_command(written(f, "model.py", "def scenario(key): return 3")),
     "scenario() returned int; return probcal.simulate(...)"),
    (lambda f: load_truth(load_model(path := written(f, "model.py", "def truth(data): return 3")), path, None, None),
     "truth() returned int; return a probcal.Truth or None"),
    # nodes
    (lambda _: LocalFrame("north", 0.0), "LocalFrame: latitude, longitude and height must be numbers"),
    (lambda _: LocalFrame(91.0, 0.0), "LocalFrame: latitude must lie between -90 and 90 degrees, longitude between"),
    (lambda _: FRAME.to_local(0.0, 0.0, np.nan), "height must be metres above the ellipsoid, between -6378137"),
    (lambda _: FRAME.to_geodetic(np.zeros(4)), "LocalFrame.to_geodetic: positions must be finite metres of shape (..., 2)"),
    (lambda _: read_nodes(cells()[:0]), "data has no nodes; write one a row"),
    (lambda _: read_nodes(cells(), origin=(50.0, 8.0)), "data states x and y; an origin goes with latitude and longitude"),
    (lambda _: read_nodes(cells(name=1)), 'data has both a column "node" and a column "name"; keep one'),
    (lambda _: read_nodes(cells().drop(columns="node")), 'data has no column "node"; known: x, y'),
    (lambda _: read_nodes(cells(node=["a", None])), 'data row 1 column "node" is blank; name the node'),
    (lambda _: read_nodes(cells(node="a")), 'data row 1: node "a" is there already (row 0); rename one'),
    (lambda _: read_nodes(cells().drop(columns=["x", "y"])), "data states no place: write x, y and perhaps z in m, or"),
    (lambda _: read_nodes(cells().drop(columns="y")), 'data has no column "y"'),
    (lambda _: read_nodes(cells(height=1.0)), 'data column "height" does not go with "x"; drop one of them'),
    (lambda _: read_nodes(cells(z=[1.0, None])), 'data row 1 column "z" is blank; state it for every node'),
    (lambda _: read_nodes(places(), origin=8.0), "read_nodes: origin is 8.0; give (latitude, longitude) or with a height"),
    (lambda _: read_nodes(places(latitude=95.0)), "data row 0: latitude must lie between -90 and 90 degrees"),
    (lambda _: read_nodes(cells(**{"clock [us]": 1.0, "scale_clock": 2.0})),
     'data column "scale_clock" is in "m", "clock" in "us"; give both one unit'),
    (lambda _: read_nodes(cells(headng=1.0)), 'column "headng" cannot be the name of an extra component, rename it; did'),
    (lambda _: read_nodes(cells(survey_heading=-1.0)), 'data row 0: node "a": survey of heading is -1: it must be positive'),
    (lambda _: read_nodes(cells(**{"gain": 0, "scale_gain [dB]": -1.0})), '"scale_gain" is in "dB", "gain" in "1"; give'),
    (lambda f: read_nodes(f / "none.geojson"), "none.geojson: no such file"),
    (lambda f: read_nodes((f / "n.geojson").mkdir() or f / "n.geojson"), "n.geojson: cannot be read (Is a directory)"),
    (lambda f: read_nodes(written(f, "n.json", "{")), "n.json is not GeoJSON: Expecting property name"),
    (lambda f: read_nodes(written(f, "n.json", "[]")), "n.json is not GeoJSON: it holds no FeatureCollection"),
    (lambda f: read_nodes(written(f, "n.json", points("{}"))), "n.json feature 1 is no Point with coordinates [longitude"),
    (lambda f: write_nodes(f / "n.json", [node()]), "n.json: GeoJSON holds latitude and longitude; give a frame, or write"),
    (lambda f: write_nodes(f / "n.csv", []), "n.csv: there is no node that stands still; nothing is to be written"),
    (lambda f: write_nodes(f / "n.csv", xr.DataTree()), "the tree holds no calibrated nodes; give the result of fit()"),
    (lambda f: write_nodes(f / "n.csv", [node(), Node("m", (0, 0, 0))]), 'nodes "n" and "m" differ in dimension; write'),
    (lambda f: write_nodes(f / "n.csv", [node(scale={"clock": Bias(u, 1.0)}) for u in "ms"]),
     'the nodes state "clock" in "m" and in "s"; a file needs one unit'),
    (lambda f: write_nodes(f / "none" / "n.csv", [node()]), "n.csv cannot be written: No such file or directory"),
]  # fmt: skip


@pytest.mark.parametrize(("call", "text"), CASES, ids=[text[:50] for _, text in CASES])
def test_an_error_says_what_is_wrong_and_what_to_do(call, text, tmp_path):
    with pytest.raises(InputError) as caught:
        call(tmp_path)
    assert text in str(caught.value)


VERBS = [
    name
    for name in probcal.__all__
    if inspect.isfunction(verb := getattr(probcal, name))
    and next(iter(inspect.signature(verb).parameters)) in ("problem", "network", "tree")
]


@pytest.mark.parametrize("name", VERBS)
def test_a_verb_says_what_its_first_argument_must_be(name):
    assert len(VERBS) > 20
    with pytest.raises(InputError, match=rf"^{name}: \w+ is of type object; give "):
        getattr(probcal, name)(object())


def turns(target, pose):
    if norm(target.position - pose.position) > 5.0:
        return 1.0
    return 0.0


def numbers(target, pose):
    return float(target.position[0])


def arrays(target, pose):
    return np.hypot(*target.position)


@pytest.mark.parametrize(
    ("function", "code", "remedy"),
    [
        (turns, "if norm(target.position - pose.position) > 5.0:", "write jnp.where(condition, a, b) for if"),
        (numbers, "return float(target.position[0])", "leave out float() and int()"),
        (arrays, "return np.hypot(*target.position)", "write jnp. for np."),
    ],
)
def test_python_that_jax_cannot_follow_is_named_with_its_line(function, code, remedy):
    """In a sensor where it is declared, in a field of view at the first verb, in a motion where it is compiled."""
    line = inspect.getsourcelines(function)[1] + 1
    where = rf'test_errors\.py line {line}, "{re.escape(code)}", asks for .*; {re.escape(remedy)}'

    def read(target, pose):
        return {"range": function(target, pose)}

    with pytest.raises(InputError, match=f"^sensor read: {where}"):
        gauge()(read)
    seen = RANGER.on(node(), detection=Detection(0.9, view=function))
    with pytest.raises(InputError, match=f"^{where}"):
        simulate(Network([seen]), CV, [0.0, 1.0])


def test_the_help_of_a_sensor_lists_what_target_and_pose_offer():
    text = inspect.getdoc(sensor)
    offered = {*PoseView.__dict__, *TargetView.__dict__} - {*object.__dict__, "__module__", "__firstlineno__"}
    for name in ("position", "velocity", *ANGLES, "clock", *(name for name in offered if name[0] != "_")):
        assert f"`{name}" in text


def test_the_report_without_plot_packages_says_what_to_install(monkeypatch, tmp_path):
    monkeypatch.setattr(commands.files, "can_plot", lambda: False)
    with pytest.raises(InputError, match="the report needs plot packages: pip install"):
        commands.report_command(tmp_path)


def test_a_text_that_no_test_matches_is_found():
    source = 'raise InputError(f"{name}: the moon is not a sensor; take {other} instead")\nraise FitError(text)\n'
    messages = [*raised(source, "a.py"), *raised('raise InputError("the sun is not a sensor; wait")', "b.py")]
    assert list(unmatched(messages, "is not a sensor")) == [
        ("a.py:1", "the moon is not a sensor; take"), ("b.py:1", "the sun is not a sensor; wait"),
    ]  # fmt: skip
    assert not list(unmatched(messages, '"m": the moon is not\nthe sun is no'))
    assert list(strings('"""Doc."""\nmatch = r"bad\\.csv \\(x\\)"')) == ["bad.csv (x)"]


def test_an_error_is_one_line_that_can_be_printed():
    text = str(InputError("a\n\tb\x1b[31m" + "c" * 5000))
    assert text.startswith("a b\ufffd[31mccc")
    assert text.isprintable()
    assert len(text) < 1000
