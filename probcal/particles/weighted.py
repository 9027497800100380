"""Answers of methods whose trajectories are particles: a Gaussian of the biases, and paths drawn given them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal import linalg
from probcal.errors import InputError
from probcal.gaussian.draws import draw_biases, predictive
from probcal.gaussian.information import rejected
from probcal.gaussian.mode import Point
from probcal.inference.ending import ABSURD, conclude_at
from probcal.inference.loop import Trace
from probcal.inference.method import Given
from probcal.inference.mixture import gaussian_biases
from probcal.labels import listed
from probcal.linalg import cholesky, invert, orthogonalise, without_negative
from probcal.misfit import rejection_text
from probcal.model.model import Model
from probcal.modes.grid import follow_states, track_mode
from probcal.particles.ensemble import (
    Ensemble,
    ensemble,
    nearest_states,
    observed_over_paths,
    state_moments,
    vectors_of,
)
from probcal.particles.proposals import check_proposal
from probcal.particles.settings import ParticleSettings, check_installed
from probcal.particles.targets import Targets, targets_of
from probcal.priors import Prior
from probcal.problem import Problem
from probcal.results.answer import (
    CHAINS,
    Answer,
    Draws,
    Posterior,
    Summary,
    Tracks,
    precisions_of,
)
from probcal.results.blocks import SensorBlocks
from probcal.results.build import build_tracks
from probcal.simulate import chance_of
from probcal.status import CLIMB, Status, judge

if TYPE_CHECKING:
    import xarray as xr

FILTERS = 8  # of the last passes, whose scores give the information and whose mean likelihood is the evidence
SCATTER = 1.5  # mean square of what is left, 1 expected, from which another optimum is looked for
FEW = 5  # different smoothed particles at an epoch, below which their spread says nothing
AHEAD = 1.0  # sd a bias of the Newton step, from which the fit is not at the top
SURE = 6.0  # sd by which that mean square lies above 1 at least
# least pairs of filters about the end of a climb, whose scores give the information of the biases
PAIRS = 8
FILTERED = 512  # most filters of these pairs
SD_ERROR = 0.06  # relative Monte Carlo error of an sd at which no more are run: 2.5 of it are 15 %
LOST = 3.0  # nats below the typical likelihood from which a filter counts less
SPREAD = 32  # draws of the biases behind the sd of a track, and behind values by datum


def prepared(problem: Problem, how: ParticleSettings) -> tuple[Targets, ...]:
    """The targets of a problem; raises `InputError` for particles that it cannot have."""
    check_installed()
    check_proposal(problem.model, how)
    return targets_of(problem.model)


def check_learnt(problem: Problem) -> None:
    """Raise `InputError` for an unknown level of noise that is drawn anew at every epoch, a target's first included."""
    for part in problem.model.recursions:
        if (np.asarray(part.level)[np.asarray(part.first)] < len(problem.levels)).any():
            raise InputError(
                "particles do not learn the level of a noise without memory (White, Known): give it as a number, or use"
                " EA() or NUTS()"
            )


class Ended(NamedTuple):
    """The result of a climb by particles."""

    z: jax.Array  # (M,)
    levels: jax.Array  # (H,)
    alpha: jax.Array  # (M,)
    trace: Trace  # its objective is an estimated log-likelihood
    still: bool
    said: str  # what still moves
    stopped: str = ""  # why it was ended early


class DrawnTracks(NamedTuple):
    """The particle estimates of all states over draws of the biases."""

    z: np.ndarray  # (D, M)
    tracks: list[Tracks]  # of each recursion
    paths: list[np.ndarray]  # (D, E, n) one for each draw, as rows see it, of each recursion


@dataclass(frozen=True, eq=False)
class Paths:
    """Particles of the targets of a problem, run at any biases and levels."""

    problem: Problem  # with its own motions
    how: ParticleSettings
    targets: tuple[Targets, ...]

    def at(self, z: Any, levels: Any, key: jax.Array) -> Ensemble:
        """Smoothed particles at biases z (M,) and log levels (H,)."""
        return ensemble(self.problem.model, self.targets, jnp.asarray(z), jnp.asarray(levels), key, self.how)

    def along_paths(self) -> Paths:
        """The same, its smoothed particles joined to paths."""
        if self.how.smoother != "marginal":
            return self
        return replace(self, how=replace(self.how, smoother="backward"))

    def seen(self, found: Ensemble) -> list[jax.Array]:
        """The vectors (E, N, n) that rows read from the states of each recursion."""
        return list(vectors_of(self.problem.model, found.states))

    def over(self, z: np.ndarray, levels: np.ndarray, key: jax.Array) -> DrawnTracks:
        """Mean and sd of all states over draws of the biases z (D, M), and a path for each of the draws."""
        moments, single, model, walked = [], [], self.problem.model, self.along_paths()
        for k, own in enumerate(z):
            found = walked.at(own, levels, jax.random.fold_in(key, k))
            single.append([np.asarray(x) for x in single_vectors(model, found.path(0))])  # paths come in no order
            moments.append([(np.asarray(m.mean), np.asarray(m.variance)) for m in state_moments(model, found)])
        tracks = []
        for column in zip(*moments, strict=True):
            mean, variance = (np.stack(part) for part in zip(*column, strict=True))
            tracks.append(Tracks(mean.mean(0), np.sqrt(variance.mean(0) + mean.var(0))))
        return DrawnTracks(np.asarray(z), tracks, [np.stack(column) for column in zip(*single, strict=True)])

    def point(self, found: Ensemble, z: Any, levels: Any) -> Point:
        """The states that stand for the particles: on the road where there is one (Paper A 43)."""
        states = nearest_states(self.problem.model, found)
        vectors = single_vectors(self.problem.model, states)
        noises = tuple(jax.device_put(np.zeros((x.shape[0], 0))) for x in vectors)
        return Point(vectors, noises, jnp.asarray(z), jnp.asarray(levels))


def draw_ensemble(own: Posterior, key: jax.Array, keep: tuple[str, ...], paths: Paths, over: DrawnTracks) -> Draws:
    """Independent draws of the biases; of some of them, or of all where states are kept, a path and its values."""
    model, keys = own.problem.model, jax.random.split(key, 3)
    z = np.array(gaussian_biases(own, keys[0]))
    shape, M = z.shape[:2], z.shape[2]
    count = shape[1] if "states" in keep else min(shape[1], SPREAD // CHAINS)
    kept = np.unique(np.linspace(0, shape[1] - 1, count).round().astype(int))
    levels = np.broadcast_to(own.summary.levels, (*shape, len(own.summary.levels)))
    if not keep:
        return Draws(z, levels, [], kept, [], [])
    number = CHAINS * len(kept)
    if number <= len(over.z):  # those that the tracks came from serve again
        z[:, kept] = over.z[:number].reshape(CHAINS, len(kept), M)
    else:
        over = paths.over(z[:, kept].reshape(-1, M), own.summary.levels, keys[1])
    states = [x[:number] for x in over.paths]
    found = predictive(
        model, jnp.asarray(levels[:, kept].reshape(number, -1)), jnp.asarray(over.z[:number]),
        tuple(jnp.asarray(x) for x in states), keys[2], keep,
    )  # fmt: skip

    def split(a: Any) -> np.ndarray:
        return np.asarray(a).reshape(CHAINS, len(kept), *np.shape(a)[1:])

    likelihood, replicas = ([split(a) for a in part] for part in found)
    return Draws(z, levels, [split(x) for x in states] if "states" in keep else [], kept, likelihood, replicas)


class Louis(NamedTuple):
    """The information about biases at a place from several filters, pooled by their likelihoods."""

    information: np.ndarray  # (M, M) of the data, trajectories integrated
    score: np.ndarray  # (M,) of the log-likelihood by the biases
    noise: np.ndarray  # (M, M) covariance of that score over the filters
    log_likelihood: float
    error: float  # standard error of the log-likelihood
    found: Ensemble  # of the likeliest filter


def louis(paths: Paths, z: Any, levels: Any, key: jax.Array) -> Louis:
    """Information and score of the biases z (M,), trajectories integrated, by Louis' identity (1982).

    The information is the curvature at given states, less the covariance of the score over paths. Filters count by
    their estimates of the likelihood, so that one that lost a target counts for nothing.
    """
    z, levels, paths = jnp.asarray(z), jnp.asarray(levels), paths.along_paths()
    logs, parts, best = [], [], None
    for k in range(FILTERS):
        found = paths.at(z, levels, jax.random.fold_in(key, k))
        parts.append(jax.tree.map(np.asarray, observed_over_paths(paths.problem.model, found, z, levels)))
        logs.append(float(found.log_evidence))
        best = found if best is None or logs[-1] >= max(logs) else best
    assert best is not None
    share = np.exp(np.array(logs) - max(logs))
    share /= share.sum()
    scores, information, spread = (np.stack(column) for column in zip(*parts, strict=True))
    score = share @ scores
    off = scores - score
    within = np.einsum("k,kab->ab", share, spread) + np.einsum("k,ka,kb->ab", share, off, off)
    return Louis(
        without_negative(np.einsum("k,kab->ab", share, information) - within), score,
        np.einsum("k,ka,kb->ab", share**2, off, off), *log_mean(np.array(logs)), best,
    )  # fmt: skip


class ScoreSlope(NamedTuple):
    """The information of the biases by how the score of the marginal likelihood falls about a
    place."""

    information: np.ndarray  # (M, M) of the data, trajectories integrated
    sd_error: np.ndarray  # (M,) Monte Carlo error of each sd of the posterior, over the sd
    filters: int  # that were run


def score_slope(paths: Paths, told: Louis, prior: np.ndarray, z: Any, levels: Any, key: jax.Array) -> ScoreSlope:
    """Information of the biases z (M,) under a prior of precision (M, M), by regression of scores
    on biases.

    Louis' identity takes the difference of two large matrices. The score (Fisher's identity) at
    pairs of places z + d and z - d, one sd apart in random orthogonal directions, needs no
    difference: its mean slope is minus the information averaged over the posterior. Pairs are added
    until every sd is known to `SD_ERROR`.
    """
    paths, M = paths.along_paths(), len(z)
    rng = chance_of(key)
    found, away, rows = ScoreSlope(told.information, np.full(M, np.inf), 0), np.zeros((0, M)), list[np.ndarray]()
    logs = np.zeros(0)
    while M and found.filters < FILTERED and not (found.sd_error <= SD_ERROR).all():
        try:
            root = invert(cholesky(found.information + prior)).T
        except np.linalg.LinAlgError:  # singular, which the covariance says
            break
        turns = [orthogonalise(rng.standard_normal((M, M))) for _ in range(-(-PAIRS // M))]
        half = np.sqrt(M) * np.concatenate(turns) @ root.T
        for d in np.concatenate([half, -half]):
            at = jnp.asarray(np.asarray(z) + d)
            own = paths.at(at, levels, jax.random.fold_in(key, len(rows)))
            rows.append(np.asarray(observed_over_paths(paths.problem.model, own, at, levels).score))
            logs = np.append(logs, float(own.log_evidence))
        away = np.concatenate([away, half, -half])
        expected = away @ told.score - 0.5 * np.einsum("ka,ab,kb->k", away, found.information, away)
        found = regressed_scores(away, np.stack(rows), logs - expected, prior)
    return found


def regressed_scores(away: np.ndarray, scores: np.ndarray, logs: np.ndarray, prior: np.ndarray) -> ScoreSlope:
    """Minus the slope of scores (K, M) on places (K, M), and what its error means for each sd under
    a prior (M, M).

    Filters whose log-likelihoods, less those expected, lie far below the others' lost a target and
    count less.
    """
    K, M = away.shape
    weight = np.exp(np.minimum(logs - np.median(logs) + LOST, 0.0))
    x, y = (part - weight @ part / weight.sum() for part in (away, scores))
    inverse = invert(x.T @ (weight[:, None] * x))
    slope = inverse @ x.T @ (weight[:, None] * y)
    information = without_negative(-slope)
    covariance = invert(information + prior)
    left, pull = (y - x @ slope) @ covariance, x @ inverse @ covariance  # of each filter, by bias
    variance = (weight[:, None] ** 2 * left**2 * pull**2).sum(0) * K / max(K - M - 1, 1)
    return ScoreSlope(information, 0.5 * np.sqrt(variance) / np.diag(covariance), K)


single_vectors = jax.jit(Model.vectors_of)


@jax.jit
def squares_by_epoch(model: Model, point: Point) -> tuple[list[jax.Array], list[jax.Array]]:
    """Sums (E,) of squares and of data over the rows of each epoch, for each recursion."""
    return model.by_epoch(model.square(point)), model.by_epoch(model.measured)


def log_likelihood_at(paths: Paths, z: Any, levels: Any, key: jax.Array, filters: int = FILTERS) -> tuple[float, float]:
    """Log of the mean likelihood over some filters, and the standard error of that log."""
    keys = (jax.random.fold_in(key, k) for k in range(filters))
    return log_mean(np.array([float(paths.at(z, levels, own).log_evidence) for own in keys]))


def log_mean(logs: np.ndarray) -> tuple[float, float]:
    """Log of the mean of likelihoods whose logs (F,) are given, and the standard error of that log.

    Where the logs scatter by more than 1 one filter makes the mean, whose error is then that scatter at least.
    """
    weights, scatter = np.exp(logs - logs.max()), float(logs.std(ddof=1))
    mean = weights.mean()
    error = float(weights.std(ddof=1) / mean / np.sqrt(len(logs)))
    return float(logs.max() + np.log(mean)), max(error, scatter) if scatter > 1 else error


def conclude_particles(
    problem: Problem, method: Any, how: ParticleSettings, prior: Prior, given: Given,
    targets: tuple[Targets, ...], ended: Ended, key: jax.Array,
) -> Answer:  # fmt: skip
    """The answer of a climb by particles."""
    paths, keys = Paths(problem, how, targets), jax.random.split(key)
    z, levels = np.asarray(ended.z), np.asarray(ended.levels)
    told = louis(paths, z, levels, keys[0])
    now = given.prior._replace(alpha=ended.alpha)
    slope = score_slope(paths, told, np.asarray(now.matrix()), z, levels, jax.random.fold_in(key, 2))
    matrix = jnp.asarray(slope.information) + now.matrix()
    covariance, volume = (np.asarray(a) for a in linalg.inverse_and_logdet(matrix))
    evidence = told.log_likelihood + 0.5 * float(now.log_determinant() - now.square(ended.z)) - 0.5 * float(volume)
    alpha = np.asarray(ended.alpha)
    summary = Summary.of(
        "Laplace", precisions_of(problem, prior), z, SensorBlocks.of(covariance), alpha,
        information=slope.information, levels=levels, evidence=evidence if prior.proper else None,
        columns={"sd_error": slope.sd_error},
    )  # fmt: skip
    numbers = {"log_likelihood": told.log_likelihood, "log_likelihood_se": told.error, "particles": float(how.count)}
    posterior = posterior_of(paths, prior, summary, told, keys[1], numbers)
    ahead = steepness(told.score - np.asarray(now.matrix()) @ z, covariance, told.noise)
    error, stopped = float(np.max(slope.sd_error, initial=0.0)), bool(ended.stopped)
    worst = problem.labels[int(np.argmax(slope.sd_error))] if error else ""
    left, asked = notable_scatter(posterior.problem, posterior.point), method.tolerance == 0
    return conclude_at(
        posterior.problem, method, prior, posterior, ended.trace, converged=ended.still and not stopped,
        evidence=told.log_likelihood, stopped=ended.stopped,
        misfit=unexplained(posterior.problem, posterior.point),
        left=0.0 if stopped else left, ahead=ahead if ahead > AHEAD and not stopped else 0.0,
        inexact=(worst, error, slope.filters) if error > SD_ERROR and not stopped else (),
        better="more particles" if how.m_step == "averaged" else 'm_step="averaged", more particles',
        moved=ended.said if asked else "", moving="" if asked else ended.said,
    )  # fmt: skip


def steepness(slope: np.ndarray, covariance: np.ndarray, noise: np.ndarray) -> float:
    """The Newton step in sd per bias, less the slope's noise: the average or half the largest."""
    if not len(slope):
        return 0.0
    step, sd = covariance @ slope, np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    mean = np.sqrt(max(slope @ step - np.sum(covariance * noise), 0.0) / len(slope))
    error = np.sqrt(np.maximum(np.diag(covariance @ noise @ covariance), 0.0))
    return float(max(mean, 0.5 * np.max((np.abs(step) - 3.0 * error) / sd)))


def posterior_of(
    paths: Paths, prior: Prior, summary: Summary, told: Louis, key: jax.Array, numbers: Mapping[str, float]
) -> Posterior:  # fmt: skip
    """The posterior around a Gaussian of the biases, with tracks made by particles."""
    problem, keys = paths.problem, jax.random.split(key, 3)
    z, levels = jnp.asarray(summary.mean), summary.levels
    point = paths.point(told.found, z, levels)
    zero = paths.at(jnp.zeros_like(z), levels, keys[0])
    before = paths.point(zero, jnp.zeros_like(z), levels)
    before = before._replace(states=tuple(m.mean for m in state_moments(problem.model, zero)))
    drawn = np.asarray(draw_biases(point, jnp.asarray(summary.covariance.matrix()), keys[1], SPREAD))
    sound = np.isfinite(drawn).all()
    over = paths.over(drawn if sound else np.asarray(z)[None], levels, keys[2])
    seen = problem
    if any(form is not None for form in problem.model.sampled):
        seen = problem.seen()
    else:
        near = follow_states(problem, [np.asarray(x) for x in point.states])
        point = track_mode(problem, near._replace(z=z, levels=jnp.asarray(levels)))
    pull = summary.information @ np.asarray(z) + told.score
    drawing = partial(draw_ensemble, paths=paths, over=over)
    return Posterior(seen, prior, point, summary, drawing, moments=over.tracks, attrs=numbers, zero=before, term=pull)


def track_by_particles(
    problem: Problem, how: ParticleSettings, z: np.ndarray, covariance: np.ndarray, levels: np.ndarray, key: jax.Array
) -> xr.DataTree:
    """Tracks by particles at biases z (M,) of a covariance (M, M), and what they are worth."""
    paths, keys = Paths(problem, how, prepared(problem, how)), jax.random.split(key, 4)
    found = paths.at(z, levels, keys[0])
    point = paths.point(found, z, levels)
    zero = state_moments(problem.model, paths.at(np.zeros_like(z), levels, keys[1]))
    drawn = np.asarray(draw_biases(point, jnp.asarray(covariance), keys[2], SPREAD)) if len(z) else np.zeros((1, 0))
    tracks = paths.over(drawn, levels, keys[3]).tracks
    seen = problem.seen()
    tree = build_tracks(seen, tracks, [np.asarray(own.mean) for own in zero])
    status, message = status_of_tracks(seen, point, found)
    tree.attrs |= {"status": str(status), "message": message, "smoother": repr(how)}
    return tree


def status_of_tracks(problem: Problem, point: Point, found: Ensemble) -> tuple[Status, str]:
    """Status of tracks by particles at known biases, and a sentence: whether they explain the rows, and are enough."""
    least = fewest(found)
    facts = {"lost": notable_scatter(problem, point), "alike": str(least) if least < FEW else "", "converged": True}
    return judge(CLIMB, facts | {"misfit": unexplained(problem, point)})


def fewest(found: Ensemble) -> int:
    """The least number of different smoothed particles at any epoch."""
    least = 10**9
    for r, weights in enumerate(found.weights):
        columns = [np.asarray(leaf).reshape(*weights.shape, -1) for leaf in jax.tree.leaves(found.states[r])]
        together, heavy = np.concatenate(columns, 2), np.asarray(weights) > 1e-6
        for there, epoch in zip(heavy, together, strict=True):
            least = min(least, len(np.unique(epoch[there], axis=0)))
    return least


def unexplained(problem: Problem, point: Point) -> str:
    """A sentence on targets whose rows no path explains, or on rejected sensors; else empty."""
    squares, there = squares_by_epoch(problem.model, point)
    found = []
    for name, _, square, count in problem.tracks(squares, there):
        mean = float(square.sum() / max(count.sum(), 1))
        if not mean <= ABSURD:
            found.append((mean, name))
    if not found:
        return rejection_text(rejected(problem, point))
    named = listed([f'"{name}"' for _, name in sorted(found, reverse=True)])
    return (
        f"No path of target {named} explains its rows: check its roads or let it leave them, its start, units and"
        " the noise std; or take more particles."
    )


def notable_scatter(problem: Problem, point: Point) -> float:
    """Mean square of what a point leaves of all data where it is notably above the 1 of a right model; else 0."""
    total, count = (sum(float(np.sum(part)) for part in parts) for parts in squares_by_epoch(problem.model, point))
    square = total / max(count, 1.0)
    return square if square > max(SCATTER, 1 + SURE * np.sqrt(2 / max(count, 1.0))) else 0.0
