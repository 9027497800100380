"""Problems in which something is empty: no sparse bias, no target, no free bias, one row, one epoch, one sensor.

Every method and verb answers or says one sentence.
"""

import numpy as np
import pytest
import worlds
import xarray as xr
from contracts import check_tree

import probcal
from probcal import (
    EA,
    EM,
    EMEA,
    MAP,
    NUTS,
    SVI,
    BernoulliGaussian,
    Bias,
    Channel,
    Collapsed,
    ConstantVelocity,
    Gibbs,
    Laplace,
    LeastSquares,
    Network,
    Node,
    Problem,
    Static,
    add_scores,
    fit,
    observability,
    sensor,
    simulate,
    track,
    tracks,
)
from probcal.cli.check import print_known
from probcal.errors import FitError, InputError
from probcal.report import write_report
from probcal.wings import installed

SPAN_STD = 0.1  # m


@sensor(span=Channel("m", std=SPAN_STD))
def span(target, first, second):
    return {"span": second.position[0] - first.position[0] + first.delay + second.delay}


def surveyed(size=3, times=(0.0, 1.0, 2.0, 3.0)):
    """Sensors of position, each bias of which has a survey and none a scale."""
    return tagged("survey", size, times)


def tagged(kind, size=3, times=(0.0, 1.0, 2.0, 3.0)):
    places = np.array([(0.0, 1.0), (5.0, -2.0), (-3.0, 4.0)])[:size]
    network = Network([worlds.fix.on(Node(f"n{k}", place, **{kind: 0.5})) for k, place in enumerate(places)])
    path = np.stack([1.0 + 0.5 * np.array(times), -1.0 + 0.2 * np.array(times)], 1)
    run = simulate(network, ConstantVelocity(0.5), times, key=1, tracks={"target": path})
    return Problem(network, ConstantVelocity(0.5), run.table)


def spans(kind="scale"):
    """Four nodes that measure the distances between each other: a network without a target."""
    nodes = [
        Node(f"n{k}", (x, 0.0), delay=0.0, **{"survey": {"position": 0.2} | ({"delay": D} if kind == "survey" else {})},
             scale={} if kind == "survey" else {"delay": D})
        for k, x in enumerate((0.0, 3.0, 7.0, 4.0))
    ]  # fmt: skip
    return Network([span.on(a, b) for i, a in enumerate(nodes) for b in nodes[i + 1 :]])


D = Bias("m", 0.5)


def apart(kind="scale"):
    network = spans(kind)
    return Problem(network, data=simulate(network, None, range(3), key=2).table)


def test_where_no_bias_has_a_scale_the_default_method_is_the_gaussian():
    network, motion, table, _ = worlds.plane()
    nodes = [Node(s.name, s.nodes[0].position, s.nodes[0].components["heading"], survey=1.0) for s in network.sensors]
    problem = Problem(Network([worlds.fix.on(node) for node in nodes]), motion, table)
    known = fit(problem, MAP(), start=worlds.resting(problem))
    for prior in (None, Laplace(), BernoulliGaussian()):
        found = fit(problem, EA(), prior=prior, start=worlds.resting(problem))
        check_tree(found, problem)
        assert found.attrs["precisions"] == "given"
        assert "no precision is estimated" in found.attrs["intervals"]
        for name in ("mean", "sd", "lower", "upper", "gamma"):
            np.testing.assert_allclose(found["calibration"][name], known["calibration"][name], rtol=1e-6, atol=1e-9)


@pytest.mark.ci
def test_distances_between_nodes_need_no_target(tmp_path):
    problem = apart()
    data = problem.measurements
    assert "target" not in data.table.frame
    assert problem.targets == ()
    found = fit(problem, MAP(), start=worlds.resting(problem))
    H = np.zeros((len(data.time), len(problem.labels)))
    for n, k in enumerate(data.sensor):
        for sign, node in zip((-1.0, 1.0), problem.network.sensors[k].nodes, strict=True):
            for name, slope in ((f"{node.name}.position_x", sign), (f"{node.name}.delay", 1.0)):
                m = problem.labels.index(name)
                H[n, m] = slope * problem.scales[m] / SPAN_STD
    place = np.array([s.nodes[1].position[0] - s.nodes[0].position[0] for s in problem.network.sensors])
    left = (data.value[:, 0] - place[data.sensor]) / SPAN_STD
    covariance = np.linalg.inv(H.T @ H + np.eye(H.shape[1]))
    calibration = found["calibration"].to_dataset()
    np.testing.assert_allclose(calibration["mean"] / problem.scales, covariance @ H.T @ left, atol=1e-8)
    np.testing.assert_allclose(calibration["sd"] / problem.scales, np.sqrt(np.diag(covariance)), rtol=1e-8)
    check_tree(found, problem)
    assert found.attrs["status"] == "converged"
    assert tracks(found).empty
    assert "no target" not in write_report(found, tmp_path / "page.html", static=True).read_text()
    for word in ("line", "mirror", "target"):
        assert word not in found.attrs["message"]


def test_rows_without_a_target_stand_beside_those_of_one(capsys):
    nodes = [Node("a", (0.0, 0.0), delay=0.0, scale=1.0), Node("b", (4.0, 0.0), delay=0.0, scale=1.0)]
    network = Network([span.on(*nodes), *(worlds.fix.on(node, name=f"{node.name}_fix") for node in nodes)])
    table = worlds.table_of(network, {"tag": [0.0, 1.0, 2.0]}, 1, missing=0.0)
    blank = table.assign(target=table["target"].mask(table["sensor"] == "a-b"))
    motion = ConstantVelocity(1.0)
    whole, apart = (Problem(network, motion, data) for data in (table, blank))
    assert apart.targets == whole.targets == ("tag",)
    assert [name for epochs in apart.epochs for name in epochs.target] == ["no target"] * 3 + ["tag"] * 3
    assert Problem(network, motion, table.drop(columns="target")).targets == ("target",)
    with pytest.raises(InputError, match='column "target" is blank'):
        Problem(network, motion, table.assign(target=None))
    with pytest.raises(InputError, match="stands for rows without a target"):
        Problem(network, motion, table.assign(target="no target"))
    with pytest.raises(InputError, match="the table of rows is missing"):
        Problem(network, table)
    with pytest.raises(InputError, match='target "tag" has no motion; give one, such as'):
        Problem(network, data=table)
    print_known(apart, observability(apart, point=worlds.resting(apart)))
    said = capsys.readouterr().out
    assert "of each target: tag " in said
    assert "no target" not in said


def test_what_asks_for_a_target_says_that_there_is_none():
    problem = apart()
    with pytest.raises(InputError, match="no row has a target; next_anchors and next_sensors"):
        probcal.next_passes(problem)
    with pytest.raises(InputError, match="there is no position to map"):
        probcal.bound_map(problem, ((0, 1), (0, 1)))
    with pytest.raises(InputError, match="track: no row of data has a target"):
        track(problem, xr.DataTree())


PROBLEMS = {
    "every bias surveyed": surveyed,
    "one bias surveyed": lambda: surveyed(1),
    "distances alone": apart,
    "distances alone, surveyed": lambda: apart("survey"),
    "one epoch": lambda: tagged("scale", 3, (0.0,)),
    "one sensor": lambda: tagged("scale", 1),
    "one row": lambda: tagged("scale", 1).select(np.array([0])),
    "a sensor without rows": lambda: (all_ := tagged("scale")).select(all_.measurements.sensor > 0),
    "no free bias": lambda: tagged("scale").rebuild(fix="*"),
    "nothing drifts, nothing moves": lambda: Problem(
        (moving := tagged("scale")).network, Static(), moving.measurements.table
    ),
}
METHODS = {
    "EA": EA(),
    "EA, joint": EA(trajectory="joint"),
    "EA, maximised": EA(precisions="maximised"),
    "EA, sparse": EA(engine="cholmod"),
    "as printed": EA.as_printed(),
    "EMEA": EMEA(iterations=5),
    "EM": EM(),
    "MAP": MAP(),
    "MAP, sparse": MAP(engine="cholmod"),
    "MAP, iterative": MAP(engine="iterative"),
    "least squares": LeastSquares(),
}
if installed("probcal.particles"):
    METHODS["EM by particles"] = EM(probcal.Particles(20), iterations=3)
SAMPLERS = {
    "Collapsed": Collapsed(chains=2, warmup=20, draws=50, patience=1),
    "NUTS": NUTS(chains=2, warmup=20, draws=20, depth=4),
    "Gibbs": Gibbs(chains=2, warmup=25, draws=25, patience=1),
    "SVI": SVI(chains=2, warmup=50, draws=50),
}
if installed("probcal.particles"):
    SAMPLERS["ParticleGibbs"] = probcal.ParticleGibbs(chains=2, warmup=25, draws=25, steps=2, patience=1)

DRAWN = ("every bias surveyed", "distances alone")  # problems that samplers are asked of too


def of_stream(problem, tree):
    online = probcal.Online(problem.network, problem.motion, fix=problem.fixed)
    online.update(problem.measurements.table.frame)
    online.finish()
    return online.tree()


VERBS = {
    "observability": lambda problem, tree: observability(problem),
    "bounds": lambda problem, tree: probcal.bounds(problem),
    "assess": lambda problem, tree: probcal.assess(problem, tree),
    "compare": lambda problem, tree: probcal.compare({"one": tree, "other": tree}),
    "changes": lambda problem, tree: probcal.changes(tree, tree),
    "sensitivity": lambda problem, tree: probcal.sensitivity(problem, {"*": [0.1]}, runs=2),
    "scores": lambda problem, tree: add_scores(tree, probcal.Truth(None, dict.fromkeys(problem.labels[:1], 0.0))),
    "track": lambda problem, tree: track(problem, tree),
    "log_evidence": lambda problem, tree: probcal.log_evidence(problem),
    "next_passes": lambda problem, tree: probcal.next_passes(problem),
    "next_anchors": lambda problem, tree: probcal.next_anchors(problem),
    "next_sensors": lambda problem, tree: probcal.next_sensors(problem),
    "bound_map": lambda problem, tree: probcal.bound_map(problem, ((-5, 5), (-5, 5)), cells=(2, 2)),
    "numpyro_model": lambda problem, tree: probcal.numpyro_model(problem),
    "sbc": lambda problem, tree: probcal.sbc(problem, MAP(), runs=4),
    "summary": lambda problem, tree: probcal.summary(tree),
    "Online": of_stream,
}


@pytest.mark.slow
@pytest.mark.parametrize("name", PROBLEMS)
def test_every_method_and_verb_answers_or_says_one_sentence(name, tmp_path):
    wrong = []
    problem = PROBLEMS[name]()

    def said(what, ask):
        try:
            found = ask()
        except (InputError, FitError) as error:
            if not 20 < len(str(error)) < 400 or "\n" in str(error):
                wrong.append(f"{what}: {error}")
            return None
        except Exception as error:
            wrong.append(f"{what}: {type(error).__name__}: {error}")
            return None
        if hasattr(found, "children") and "nan" in str(found.attrs.get("message", "")).split():
            wrong.append(f"{what}: {found.attrs['message']}")
        return found

    for what, method in (METHODS | SAMPLERS if name in DRAWN else METHODS).items():
        said(what, lambda method=method: fit(problem, method))
    tree = said("fit", lambda: fit(problem, MAP()))
    for what, ask in VERBS.items():
        if tree is not None or what in ("observability", "bounds", "next_anchors", "numpyro_model", "Online"):
            said(what, lambda ask=ask: ask(problem, tree))
    if tree is not None:
        said("report", lambda: write_report(tree, tmp_path / "page.html", static=True))
    assert not wrong, "\n".join(wrong)
