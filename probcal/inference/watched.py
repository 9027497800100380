"""The calibration of a stream as the tree of a fit: biases of all its rows, data and tracks of the last ones."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from probcal.priors import Prior
from probcal.problem import Problem
from probcal.results.answer import Answer, NormalPosterior
from probcal.results.build import build
from probcal.smoothing.grid import track_mode
from probcal.smoothing.linearised import LaplaceApproximation
from probcal.starts import automatic_start
from probcal.status import Status
from probcal.table import Table
from probcal.types import float64

if TYPE_CHECKING:
    import xarray as xr

    from probcal.inference.online import Online


class Watched:
    """What the tree says of the method."""

    name: ClassVar[str] = "online filter"

    def __init__(self, settings: Any):
        self.settings = settings

    def __repr__(self) -> str:
        return repr(self.settings)

    def note(self, prior: Prior) -> str:
        """What the intervals are worth."""
        return "Gaussian: rows linearised as they came, noise levels and precisions held"


class StreamPosterior(NormalPosterior):
    """A Gaussian of the biases by all rows of a stream; its problem has the last of them."""

    @property
    def pull(self) -> np.ndarray:
        """Linear term (M,) of the log-likelihood of all rows about zero."""
        return np.linalg.solve(self.summary.whole, self.summary.mean)


@float64
def calibration_tree(online: Online) -> xr.DataTree:
    """The tree of what a filter knows."""
    template = online._problem
    frame = online.recent
    assert frame is not None
    own = frame.drop(columns=["cells", "line"])
    motions = online.arrivals.motions(dict.fromkeys(own["target"]))
    table = Table(own, "the last rows", frame["line"].to_numpy())
    problem = Problem(template.network, motions, table, fix=template.fixed)
    z, root = np.asarray(online.end.mean), np.asarray(online.end.root)
    point = automatic_start(problem)
    point = track_mode(problem, point._replace(z=jnp.asarray(z), levels=jnp.asarray(online.levels(problem))))
    covariance = root @ root.T
    before = np.asarray(online.prior.precision(problem.labels, problem.surveyed).matrix())
    alpha = np.diag(before)
    found = LaplaceApproximation(
        jnp.asarray(np.linalg.inv(covariance) - before), jnp.asarray(covariance),
        jnp.asarray(np.clip(1.0 - alpha * np.diag(covariance), 0.0, 1.0)), jnp.asarray(online.log_evidence),
    )  # fmt: skip
    posterior = StreamPosterior.of(problem, online.prior, point, found, alpha)
    method = Watched(online.method)
    answer = Answer(
        problem, method, method, online.prior, posterior, Status.NOT_CONVERGED if online.message else Status.SPENT,
        online.message, ("",) * len(problem.labels),
        online.counts["rows"],
    )  # fmt: skip
    tree = build(answer, (), jax.random.key(0), ())
    tree.attrs.update({f"stream_{name}": count for name, count in online.counts.items()}, seed=0)
    return tree
