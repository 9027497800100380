"""The calibration of a stream as the tree of a fit: biases of all its rows, data and tracks of the last ones."""

from __future__ import annotations

from typing import Any, ClassVar, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from probcal.gaussian.mode import Point
from probcal.inference.mixture import draw_along, gaussian, gaussian_biases
from probcal.inference.widen import widened_by
from probcal.lazy import pd, xr
from probcal.linalg import invert, solve_square
from probcal.modes import automatic_start
from probcal.modes.grid import track_mode
from probcal.motion import Target
from probcal.priors import Prior
from probcal.problem import Problem
from probcal.results.answer import Answer, Draws, Posterior, Tracks
from probcal.results.blocks import SensorBlocks
from probcal.results.build import build
from probcal.status import Status
from probcal.stream.arrivals import Arrivals
from probcal.stream.mistakes import mistake
from probcal.stream.surveillance import Surveillance
from probcal.table import Table
from probcal.types import float64


class FilteredStream(Protocol):
    """The filter of a stream, as its tree reads it."""

    method: Any
    prior: Prior
    arrivals: Arrivals
    check: Surveillance
    end: Any  # the last `Augmented`
    log_evidence: float
    recent: pd.DataFrame | None  # the last rows that the model explains
    last: pd.DataFrame | None  # the last rows of any kind
    lately: pd.DataFrame | None  # tracks of the last rows, by particles

    @property
    def _problem(self) -> Problem: ...

    @property
    def counts(self) -> dict[str, int]:
        """Numbers of rows by kind."""

    @property
    def status(self) -> Status:
        """Validity of the answer."""

    @property
    def message(self) -> str:
        """Reasons against the answer."""

    @property
    def inflation(self) -> np.ndarray:
        """Factor (M,) of the part of each variance that comes from the data."""

    def levels(self, problem: Problem) -> np.ndarray:
        """Log levels (H,) of a problem."""


class Watched:
    """The description of the method in the tree."""

    name: ClassVar[str] = "online filter"
    chooses: ClassVar[bool] = False

    def __init__(self, settings: Any):
        self.settings = settings

    def __repr__(self) -> str:
        return repr(self.settings)

    def note(self, prior: Prior) -> str:
        """Describes the validity of the intervals."""
        return "Gaussian: rows linearised as they came, noise levels and precisions held"


def draw_filtered(own: Posterior, key: jax.Array, keep: tuple[str, ...]) -> Draws:
    """Independent draws of the biases, without trajectories."""
    return draw_along(own, key, (), gaussian_biases(own, key))


@float64
def calibration_tree(online: FilteredStream) -> xr.DataTree:
    """The tree of what a filter knows."""
    sampled = any(motion is not None for motion in online._problem.model.sampled)
    if online.check.unexplained and online.last is not None and not sampled:
        names = dict.fromkeys(name.rsplit(".", 1)[0] for name in online.check.unexplained)
        online.check.cause = mistake(_of_last(online, online.last), list(names))
    assert online.recent is not None
    problem = _of_last(online, online.recent)
    z, root = np.asarray(online.end.mean), np.asarray(online.end.root)
    levels = jnp.asarray(online.levels(problem))
    if sampled:
        problem, tracks = problem.seen(), _filtered(online, problem)
        states = tuple(jnp.asarray(track.mean) for track in tracks)
        point = Point(states, tuple(x[:, :0] for x in states), jnp.asarray(z), levels)
    else:
        point = track_mode(problem, automatic_start(problem)._replace(z=jnp.asarray(z), levels=levels))
    covariance = root @ root.T
    before = np.asarray(problem.first_precision(online.prior).matrix())
    known: dict[str, Any] = {}
    if sampled:  # the tracks that particles had of the last rows, whatever the motion
        known = {"moments": tracks, "zero": point._replace(z=jnp.zeros_like(point.z)), "draw": draw_filtered}
    posterior = gaussian(
        problem, online.prior, point, SensorBlocks.of(covariance), np.diag(before),
        information=invert(covariance) - before, evidence=float(online.log_evidence),
        term=solve_square(covariance, z), **known,
    )  # fmt: skip
    method = Watched(online.method)
    answer = Answer(
        problem, method, method, online.prior, posterior, online.status, online.message,
        ("",) * len(problem.labels), online.counts["rows"],
    )  # fmt: skip
    tree = build(answer, (), jax.random.key(0), ())
    tree = widened_by(tree, problem, point.levels, online.inflation)
    tree.attrs.update({f"stream_{name}": count for name, count in online.counts.items()}, seed=0)
    tree.attrs.update(online.arrivals.noted())
    return tree


def _of_last(online: FilteredStream, frame: pd.DataFrame) -> Problem:
    """The problem of the last rows of a stream."""
    template = online._problem
    own = frame.drop(columns=["cells", "line"])
    motions = online.arrivals.motions(dict.fromkeys(own["target"]))
    if online.counts["rows"] - online.counts["refused"] > len(frame):  # these do not begin where the targets did
        motions = {name: Target(target.motion) for name, target in motions.items()}
    table = Table(own, "the last rows", frame["line"].to_numpy(), admitted=True)
    return Problem(template.network, motions, table, fix=template.fixed, epoch=template.epoch)


def _filtered(online: FilteredStream, problem: Problem) -> list[Tracks]:
    """Mean and sd of the states at the last rows, as they were filtered."""
    assert online.lately is not None
    known = online.lately.drop_duplicates(["time", "target"], keep="last").set_index(["time", "target"])
    found = []
    for epochs in problem.epochs:
        names = list(epochs.components)
        rows = known.loc[list(zip(epochs.time, map(str, epochs.target), strict=True))]
        found.append(Tracks(rows[names].to_numpy(float), rows[[f"{name}_sd" for name in names]].to_numpy(float)))
    return found
