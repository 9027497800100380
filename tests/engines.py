"""Verbs and methods by engine: how each is asked, and the sentence where it does not run; the table of the guide.

    uv run python tests/engines.py

writes the table between its markers.
"""

from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from sparse_worlds import drawn

import probcal as pc
from probcal.inference import calibrate
from probcal.inference.methods import table as of_priors
from probcal.modes import automatic_start
from probcal.types import float64

GUIDE = Path(__file__).parents[1] / "notebooks" / "guide" / "large.md"
BEGIN, END = "<!-- engines -->\n", "<!-- /engines -->\n"
KINDS = {  # what an engine is called in the table: many has no matrix of all biases, whatever the library
    "dense": "dense", "cholmod": "cholmod, superlu", "superlu": "cholmod, superlu", "many": "above 600 biases",
    "iterative": "iterative",
}  # fmt: skip
DENSE = "the dense form of .* for other methods take fewer sensors"
GIVEN = r"takes precisions that are given \(MAP\(\) with"
LINES, PLACES = [[(0.0, 0.0), (300.0, 300.0)], [(9e5, 0.0), (9e5, 100.0)]], [(100.0, 50.0), (9e5, 0.0)]
AREA = ((-300.0, 500.0), (-100.0, 500.0))


@cache
def world():
    """The bent network of `sparse_worlds`, a truth of all its biases, the same rows later, and a start."""
    problem, simulated = drawn()
    truth = pc.Truth(simulated.tracks, dict.fromkeys(problem.labels, 0.0) | dict(simulated.biases))
    frame = problem.measurements.table.frame.copy()
    frame["range"] += np.random.default_rng(1).normal(0.0, 2.0, len(frame))
    later = pc.Problem(problem.network, problem.motion, frame)
    return SimpleNamespace(problem=problem, truth=truth, later=later, start=float64(automatic_start)(problem))


def named(engine):
    """The name that a method knows."""
    return "cholmod" if engine == "many" else engine


@cache
def unnamed():
    """Detections of two targets without names, by a radar that is known and one that is not."""
    report, looks = pc.Detection(0.9, clutter=1.0, view=pc.Sector(range=3000.0)), np.arange(12.0)
    nodes = [pc.Node("west", (0.0, 0.0)), pc.Node("east", (1000.0, 0.0), scale={"position": 20.0})]
    network = pc.Network([pc.sensors.radar.on(node, detection=report) for node in nodes])
    motion = dict.fromkeys("st", pc.ConstantVelocity(0.5))
    line = np.outer(looks, [15.0, 5.0])
    tracks = {"s": line + np.array([300.0, 600.0]), "t": line + np.array([300.0, -500.0])}
    table = pc.simulate(network, motion, looks, tracks=tracks, key=1).table
    start = {"position": ((300.0, 0.0), 1500.0), "velocity": ((0.0, 0.0), 12.0)}
    return pc.Problem(network, pc.Target(motion["s"], start), table)


@cache
def fitted(engine, later=False):
    """The tree of the world's mode as `MAP` leaves it."""
    problem = world().later if later else world().problem
    return float64(calibrate)(problem, pc.MAP(engine=named(engine)), prior=pc.Gaussian())[0]


def assessed(at, engine):
    """NEES of the biases, and how well the data determine each."""
    found = pc.assess(at.problem, fitted(engine), truth=at.truth)
    return found["epoch_check"].attrs["nees_bias"], found["calibration"]["gamma"]


VERBS = {  # what each answers in numbers to the world, by the fit of an engine where it reads one
    "fit": lambda at, engine: fitted(engine)["calibration"]["mean"],
    "observability": lambda at, engine: pc.observability(at.problem, point=at.start)["bias"]["share"],
    "bounds": lambda at, engine: pc.bounds(at.problem, kind="hybrid", truth=at.truth, draws=3)["bias"]["sd"],
    "bound_map": lambda at, engine: pc.bound_map(at.problem, AREA, biases=fitted(engine), cells=3).rmse,
    "next_passes": lambda at, engine: pc.next_passes(at.problem, point=at.start, passes=LINES)["gain"],
    "next_anchors": lambda at, engine: pc.next_anchors(at.problem, point=at.start)["gain"],
    "next_sensors": lambda at, engine: pc.next_sensors(at.problem, point=at.start, places=PLACES)["gain"],
    "sensitivity": lambda at, engine: pc.sensitivity(at.problem, {"*.heading": [0.1, 0.2]}, runs=2)["predicted"],
    "track": lambda at, engine: pc.track(at.later, fitted(engine))["track/car"]["mean"],
    "assess": assessed,
    "changes": lambda at, engine: pc.changes(fitted(engine), fitted(engine, later=True))["change"]["sd"],
    "compare": lambda at, engine: pc.compare([fitted(engine), fitted(engine)])["estimate"]["sd"],
    "log_evidence": lambda at, engine: pc.log_evidence(at.problem, prior=pc.Gaussian()).value,
    "simulate": lambda at, engine: pc.simulate(at.problem.network, at.problem.motion, range(3)).table["azimuth"],
}
ENGINED = ("EA", "EMEA", "EM", "MAP", "LeastSquares")
OWN = {name: lambda engine, name=name: getattr(pc, name)(engine=named(engine)) for name in ENGINED} | {
    "Gibbs": lambda engine: pc.Gibbs(chains=2, warmup=10, draws=10),
    "MCMC": lambda engine: pc.MCMC(chains=2, warmup=10, draws=10, effective=1),
    "SelfConfiguration": lambda engine: pc.SelfConfiguration(pc.MAP(engine=named(engine))),
}
METHODS = {name: OWN.get(name, lambda engine, name=name: getattr(pc, name)()) for name in of_priors().index}
NOT = {  # what is not done, by the heading of a column: part of the sentence that says so
    "observability": {"iterative": "without a factor of the biases variances"},
    "changes": {"above 600 biases": "changes needs the information of all biases"},
    "EA": {"iterative": GIVEN},
    "EMEA": {"iterative": GIVEN},
} | {
    name: dict.fromkeys(list(KINDS.values())[1:], DENSE)
    for name in METHODS if name not in OWN
}  # fmt: skip

APART = {("bound_map", "many"): 0.2}  # share of numbers, of sensors taken as independent
# nobody asks these for one
BY_SIZE = {"bounds", "next_passes", "next_anchors", "next_sensors", "sensitivity", "Gibbs", "MCMC"}


def table():
    """Which verb or method runs on which engine, those alike in one line."""
    columns, alike = dict.fromkeys(KINDS.values()), dict[tuple[str, ...], list[str]]()
    for name in (*VERBS, *METHODS):
        own = dict.fromkeys(columns, "yes") | ({"iterative": ""} if name in BY_SIZE else {})
        own |= dict.fromkeys(NOT.get(name, {}), "no")
        alike.setdefault(tuple(own.values()), []).append(f"`{name}()`" if name in METHODS else f"`{name}`")
    rows = [("", *columns), ("---",) * (1 + len(columns)), *((", ".join(names), *own) for own, names in alike.items())]
    return "".join(f"|{'|'.join(row)}|\n" for row in rows)


def main():
    """Write the table into the guide."""
    before, _, rest = GUIDE.read_text().partition(BEGIN)
    GUIDE.write_text(before + BEGIN + table() + END + rest.partition(END)[2])


if __name__ == "__main__":
    main()
