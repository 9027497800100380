"""The ranked quantities: biases, levels, shared hyper-parameters, the track, the data's density.

The density of the data is a quantity that depends on them: ranks of parameters alone cannot see a method that ignores
part of the data (Modrak et al. 2023).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal.errors import FitError
from probcal.gaussian.frame import volume
from probcal.gaussian.mode import Point, log_likelihood, mixed_density
from probcal.inference.hierarchy import Hierarchy, Phi
from probcal.inference.posed import Form, Posed, log_prior
from probcal.inference.posterior import SamplerRun
from probcal.lazy import Later
from probcal.model.model import At, Model
from probcal.problem import Problem
from probcal.results.answer import Answer
from probcal.studies.uniformity import NOMINAL, randomised_rank

if TYPE_CHECKING:
    from arviz_stats.base import array_stats
else:
    array_stats = Later("arviz_stats.base.array_stats")

TAKEN = "taken over"  # status of a run whose method gave way to another


class Points(NamedTuple):
    """Draws of all that data depend on; the leading dim is that of all draws."""

    z: np.ndarray  # (D, M)
    levels: np.ndarray  # (D, H)
    states: tuple[np.ndarray, ...]  # (D, E, n) of each recursion


@dataclass(frozen=True, eq=False)
class Pool:
    """Draws of what a method says of one data set, chain after chain, and how it went."""

    points: Points
    hyper: Mapping[str, np.ndarray]  # hyper-parameters (D, ...), of samplers
    chains: int
    chained: bool  # draws depend on each other
    held: bool  # levels are the same in every draw
    status: str
    run: SamplerRun | None = None  # of a sampler
    hierarchy: Hierarchy | None = None  # that the hyper-parameters belong to
    joint: Callable[[Point, Phi], float] | None = None  # the log density that a sampler keeps of each draw

    @property
    def count(self) -> int:
        """Number of draws D."""
        return len(self.points.z)


def pool_of(answer: Answer, key: jax.Array, problem: Problem) -> Pool:
    """Draws of an answer, its chains one after the other, the states in the order of the epochs of a problem.

    There are no trajectories where the method solved another problem in the place of the given one. Raises `FitError`
    where there is no covariance.
    """
    posterior = answer.posterior
    if not posterior.sound:
        raise FitError(answer.message)
    drawn = posterior.draws(key, ("states",))

    def flat(a: np.ndarray) -> np.ndarray:
        return a.reshape(a.shape[0] * a.shape[1], *a.shape[2:])

    states = tuple(flat(x) for x in drawn.states) if answer.motion == "used" else ()
    if states and answer.problem.clocks.any():
        states = tuple(
            np.moveaxis(x, 0, 1) for x in answer.problem.reordered(problem, [np.moveaxis(x, 1, 0) for x in states])
        )
    points = Points(flat(drawn.z), flat(drawn.levels), states)
    hyper = {name: flat(a) for name, a in posterior.hyper.items()}
    taken = answer.method != answer.requested and not answer.requested.chooses
    run, joint = posterior.run, posterior.joint
    status = TAKEN if taken else str(answer.status) if run is None else "sampled"
    if joint is None and run is not None and isinstance(run.posed, Posed):
        joint = partial(_joint, run.form, run.posed)
    return Pool(
        points, hyper, drawn.z.shape[0], posterior.chained, posterior.held, status, run, posterior.hierarchy, joint
    )


@jax.jit
def _likelihoods(model: Model, z: jax.Array, levels: jax.Array, states: Any) -> jax.Array:
    """Log-likelihood of all data at draws, (D,)."""
    return jax.lax.map(lambda d: log_likelihood(model, At(d[2], d[0], d[1])), (z, levels, states))


def _joint(form: Form, posed: Posed, point: Point, phi: Phi) -> float:
    """Log joint density of data, noises and biases at the truth, as samplers keep it of each draw."""
    return float(_framed_joint(form, posed, point, phi))


@partial(jax.jit, static_argnames="form")
def _framed_joint(form: Form, posed: Posed, point: Point, phi: Phi) -> jax.Array:
    theta = jnp.concatenate([point.z, point.levels])
    spread = volume(posed.model, posed.frame, theta)
    return mixed_density(posed.model, point) + spread + log_prior(form, posed, theta, phi)


class Trial(NamedTuple):
    """One simulated truth and the problem that a method is given."""

    problem: Problem
    point: Point
    phi: Mapping[str, Any]  # hyper-parameters of the truth, empty where they are not those of the fit's prior
    joint: bool  # whether the point and phi are a draw of the fit's own prior, noises included


class _Quantity(NamedTuple):
    kind: str  # bias, level, hyper, density, track
    truth: float
    draws: np.ndarray  # (D,)


def _hyper(phi: Mapping[str, Any], truth: Mapping[str, Any], kind: Hierarchy) -> dict[str, _Quantity]:
    """Hyper-parameters that biases share, and how many biases a spike and slab lets in."""
    found = {}
    for name, draws in phi.items():
        if name not in truth:
            continue
        if name == "included":
            found["biases not zero"] = _Quantity("hyper", float(np.sum(truth[name])), draws.sum(1).astype(float))
        elif kind.belongs(name) == "all":
            found[name] = _Quantity("hyper", float(truth[name]), draws)
        elif kind.belongs(name) == "group":
            values = np.asarray(truth[name])
            found |= {f"{name} {g}": _Quantity("hyper", float(values[g]), draws[:, g]) for g in range(len(values))}
    return found


def _quantities(trial: Trial, found: Pool) -> dict[str, _Quantity]:
    problem, point, points = trial.problem, trial.point, found.points
    all_: dict[str, _Quantity] = {}
    for m, label in enumerate(problem.labels):
        scale = problem.scales[m]
        all_[label] = _Quantity("bias", float(point.z[m]) * scale, points.z[:, m] * scale)
    if not found.held:
        for h, level in enumerate(problem.levels):
            draws = level.at(points.levels[:, h])
            all_[level.label] = _Quantity("level", float(level.at(point.levels[h])), draws)
    sampled = found.run
    if found.hierarchy is not None:
        all_ |= _hyper(found.hyper, trial.phi, found.hierarchy)
    if points.states:
        all_ |= _middle(problem, point, points)
    if points.states and not problem.clocks.any():
        args = jax.tree.map(jnp.asarray, tuple(points))
        true = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], (point.z, point.levels, point.states))
        draws = np.asarray(_likelihoods(problem.model, *args))
        truth = float(_likelihoods(problem.model, *true)[0])
        all_["log likelihood"] = _Quantity("density", truth, draws)
    if found.joint is not None and sampled is not None and trial.joint:
        truth = found.joint(point, {name: jnp.asarray(value) for name, value in trial.phi.items()})
        all_["log joint"] = _Quantity("density", truth, np.asarray(sampled.draws.density).reshape(-1))
    return all_


def _middle(problem: Problem, point: Point, points: Points) -> dict[str, _Quantity]:
    """The position of the first target of each recursion at the middle of its track, at a time that the table tells."""
    found = {}
    for r, epochs in enumerate(problem.epochs):
        mine = np.flatnonzero((epochs.target == epochs.target[0]) & ~problem.by_clock[r])
        if not len(mine):
            continue
        e = mine[len(mine) // 2]
        for j in range(*epochs.position):
            name = f"{epochs.target[e]} {epochs.components[j]} at {epochs.time[e]:g}"
            found[name] = _Quantity("track", float(point.states[r][e, j]), points.states[r][:, e, j])
    return found


def _position_rmse(problem: Problem, point: Point, points: Points) -> float:
    """Root mean square error in m of the mean positions, over all epochs."""
    means = [draws.mean(0) for draws in points.states]
    away = problem.positions(jax.tree.map(np.subtract, means, list(point.states)))
    return float(np.sqrt(np.concatenate([(own**2).sum(1) for own in away]).mean()))


def _effective(draws: np.ndarray, chains: int) -> tuple[float, float]:
    """Effective number of draws (D,), all of them where none varies, and their r_hat."""
    by_chain = draws.reshape(chains, -1)
    if np.ptp(draws) == 0.0 or by_chain.shape[1] < 4:
        return float(len(draws)), 1.0
    ess = float(array_stats.ess(by_chain, chain_axis=0, draw_axis=1, method="bulk"))
    r_hat = float(array_stats.rhat(by_chain, chain_axis=0, draw_axis=1))
    return (ess if np.isfinite(ess) else float(len(draws))), (r_hat if np.isfinite(r_hat) else 1.0)


def ranked(trial: Trial, found: Pool, most: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Rank of the truth among at most `most` nearly independent draws of every quantity, and what else is recorded."""
    record: dict[str, list[Any]] = {
        name: [] for name in ("quantity", "kind", "truth", "mean", "sd", "rank", "draws", "place", "inside", "ess")
    }
    worst = 1.0
    tails = np.array(NOMINAL)[:, None] / 2 * np.array([-1.0, 1.0]) + 0.5
    for name, (kind, truth, draws) in _quantities(trial, found).items():
        ess, r_hat = _effective(draws, found.chains) if found.chained else (float(len(draws)), 1.0)
        worst = max(worst, r_hat)
        count = int(np.clip(ess, 1, most))
        thin = draws[((np.arange(count) + 0.5) * len(draws) / count).astype(int)]
        rank, place = randomised_rank(truth, thin, rng)
        ends = np.quantile(draws, tails)
        inside = (ends[:, 0] <= truth) & (truth <= ends[:, 1])
        values = (name, kind, truth, draws.mean(), draws.std(), rank, count, place, inside, ess)
        for field, value in zip(record, values, strict=True):
            record[field].append(value)
    arrays = {field: np.array(values) for field, values in record.items()}
    arrays["status"] = np.array(found.status, "<U16")
    if found.points.states:
        arrays["position_rmse"] = np.array(_position_rmse(trial.problem, trial.point, found.points))
    if found.run is not None:
        worth = found.run.worth
        arrays |= {"r_hat": np.array(worst)} | ({} if worth is None else {"khat": np.array(worth.khat)})
    return arrays
