"""The one verb: `fit(problem, method)` turns a problem into a DataTree, whatever the method."""

from __future__ import annotations

from collections.abc import Collection
from os import PathLike
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from probcal import tree
from probcal.errors import FitError, InputError
from probcal.inference.identity import identity_of, points_digest, seed_text
from probcal.inference.manifest import stored_run
from probcal.inference.methods import EA, MAP, NUTS, check_problem, choose_prior
from probcal.inference.posterior import log_normal, result
from probcal.inference.run import Maximiser, Method, Outcome, Progress, maximise
from probcal.inference.sampler import Sampler
from probcal.inference.sampling import sample
from probcal.inference.storage import Storage
from probcal.priors import Gaussian, Prior
from probcal.problem import Problem
from probcal.simulate import Key, as_key
from probcal.smoothing.draws import draw, draw_biases, draws_a_chain, residuals_of
from probcal.smoothing.information import at_levels, moments
from probcal.smoothing.mode import Point
from probcal.smoothing.start import automatic_start, follow_states, further_starts, track_mode
from probcal.types import float64

if TYPE_CHECKING:
    import xarray as xr

CHAINS = 4  # of the draws of a Gaussian, so that ArviZ reads them as it reads a sampler's
SAVE = ("states", "predictive")


@float64
def fit(
    problem: Problem,
    method: Method | None = None,
    *,
    prior: Prior | None = None,
    key: Key = 0,
    start: Point | None = None,
    starts: int = 1,
    progress: Progress | None = None,
    save: Collection[str] = (),
    store: str | PathLike[str] | None = None,
    resume: bool = False,
    overwrite: bool = False,
) -> xr.DataTree:
    """Calibrate: estimate the biases of a problem and the tracks of its targets.

    `method` is a value (`EA()` by default); `prior` defaults to the method's own; `key` is a seed or jax key
    of the draws and of further starts; `start` replaces the automatic start. `starts` runs the method from so many
    starts, the further ones with two nodes swapped or a share of the biases drawn: the best optimum is reported,
    all of them with their evidence in the group `optimum`. `save` names draws that the tree keeps beside those of the
    biases and of the log-likelihood: "states" of every epoch (large), "predictive" replicas of the data. A
    sampler (`Collapsed()`, `NUTS()`, `SVI()`) writes its draws to the folder `store` while it runs; `resume` goes on
    where a killed run of the same model, data and settings stopped, with the draws of an uninterrupted one; Ctrl-C
    leaves what was drawn. A folder that holds a run is refused without `resume` or `overwrite`. The attributes `status`
    and `message` say what the fit is worth. Raises `InputError` for a prior that the method does not take and
    `FitError` where a flat prior leaves a singular problem without any interval.
    """
    method = EA() if method is None else method
    if not isinstance(method, Method):
        raise InputError(f"method must be a value such as EA() or MAP(), got {method!r}")
    prior = choose_prior(method, prior)
    check_problem(problem)
    keep = _kept(save)
    if starts < 1:
        raise InputError(f"starts={starts}: at least one start is needed")
    if not isinstance(method, Sampler):
        _check_store(method, store, resume, overwrite)
    identity: dict[str, str] = {}
    if store is not None:
        identity = identity_of(
            problem, method=method, prior=prior, seed=seed_text(as_key(key)), number_of_starts=starts,
            start="" if start is None else points_digest(start),
        )  # fmt: skip
    folder = store if isinstance(method, Sampler) else None
    with Storage(folder, "draws", identity, resume=resume, overwrite=overwrite) as storage:
        found = _fit(problem, method, prior, key, start, starts, progress, keep, storage)
    if store is not None:
        found.attrs["identity"] = storage.digest
    return found


def _check_store(method: Method, store: str | PathLike[str] | None, resume: bool, overwrite: bool) -> None:
    """A method that keeps no draws neither goes on with a run nor stands in the place of one."""
    if resume:
        raise InputError(
            f"{method.name} has nothing to resume: samplers (collapsed, nuts, svi) keep their draws; leave --resume"
            " (resume=True) out"
        )
    if store is not None and not overwrite and (other := stored_run(store)):
        raise InputError(
            f"{store} holds {other}: go on with it by its own method, give another folder, or give --overwrite"
            " (overwrite=True) to let it lie"
        )


def _fit(
    problem: Problem, method: Method, prior: Prior, key: Key, start: Point | None, starts: int,
    progress: Progress | None, keep: tuple[str, ...], storage: Storage,
) -> xr.DataTree:  # fmt: skip
    given, problem = problem, method.prepare(problem)
    keys = jax.random.split(as_key(key), 3)
    first = automatic_start(problem) if start is None else _suited(given, problem, start)
    points = [first, *further_starts(problem, starts - 1, keys[2])]
    seed = int(key) if isinstance(key, (int, np.integer)) else -1
    if isinstance(method, Sampler):
        return _sampled(problem, method, prior, points, keys, seed, progress, keep, storage)
    assert isinstance(method, Maximiser)
    outcomes = [maximise(method, problem, prior, point, progress) for point in points]
    best = max(range(starts), key=lambda k: _rank(prior, outcomes[k]))
    tree_ = tree.build(problem, _result(problem, method, prior, outcomes[best], keys, seed, keep))
    tree_.attrs["motion"] = "used" if problem is given else "left out"
    return tree.add_optima(tree_, problem, outcomes, best) if starts > 1 else tree_


def _kept(save: Collection[str]) -> tuple[str, ...]:
    """What is kept of every draw, in the words of `smoothing.draws`; raises `InputError` for what cannot be saved."""
    names = (save,) if isinstance(save, str) else tuple(save)
    for name in names:
        if name not in SAVE:
            raise InputError(
                f'fit: save names "{name}", which is no group of draws; give "states", "predictive" or both'
            )
    return ("log_likelihood", *(word for name, word in zip(SAVE, ("states", "replicas"), strict=True) if name in names))


def _sampled(
    problem: Problem, method: Sampler, prior: Prior, points: list[Point], keys: jax.Array, seed: int,
    progress: Progress | None, keep: tuple[str, ...], storage: Storage,
) -> xr.DataTree:  # fmt: skip
    """The tree of a sampler, from the best of several starts."""
    best, outcomes = 0, []
    if len(points) > 1 or problem.levels:  # the joint mode at the declared scales: levels, and which start is best
        outcomes = [maximise(MAP(), problem, Gaussian(), point, progress) for point in points]
        best = max(range(len(points)), key=lambda k: _rank(Gaussian(), outcomes[k]))
        points = [outcome.point for outcome in outcomes]
    run = sample(problem, method, prior, points[best], keys[0], progress=progress, storage=storage, fallback=NUTS())
    found = tree.build(problem, result(problem, prior, run, keys[1], seed, keep))
    return tree.add_optima(found, problem, outcomes, best) if len(points) > 1 else found


def _suited(given: Problem, problem: Problem, start: Point) -> Point:
    """A start for the problem that a method solves in the place of the given one."""
    if problem is given:
        return start
    states = [np.asarray(x) for x in start.states]
    return follow_states(problem, states)._replace(z=start.z)


def _rank(prior: Prior, outcome: Outcome) -> tuple[bool, bool, float]:
    """Order of optima: an answer before none, a converged one before others, then evidence (density if flat)."""
    value = float(outcome.laplace.evidence) if prior.proper else float(outcome.trace[-1])
    sound = outcome.status.valid and np.isfinite(value)
    return sound, outcome.status.settled, value if np.isfinite(value) else -np.inf


def _result(
    problem: Problem, method: Method, prior: Prior, outcome: Outcome, keys: jax.Array, seed: int, keep: tuple[str, ...]
) -> tree.Result:
    model, point = problem.model, outcome.point
    found = outcome.laplace
    if not np.isfinite(np.asarray(found.covariance)).all():  # a flat prior on a singular problem: no interval exists
        raise FitError(outcome.message)
    shape = (CHAINS, draws_a_chain(model.size, CHAINS))
    z = draw_biases(point, found.covariance, keys[0], shape[0] * shape[1])
    drawn, spread = draw(model, point, found.covariance, z, point.levels, keys[1], keep)
    before = track_mode(problem, _uncalibrated(point))

    def split(a: jax.Array) -> np.ndarray:
        return np.asarray(a).reshape(*shape, *a.shape[1:])

    alpha, draws = np.asarray(outcome.alpha), split(z)
    independent = prior.proper and not prior.correlation  # else no density of each bias alone, or not that of the draws
    return tree.Result(
        method=method.name, prior=type(prior).__name__, seed=seed, approximate="Laplace",
        intervals=prior.note or method.note(), settings=f"{method!r}, {prior!r}",
        correlated=bool(prior.correlation),
        status=outcome.status, message=outcome.message, z=np.asarray(point.z),
        covariance=np.asarray(found.covariance), precision=alpha, gamma=np.asarray(found.gamma),
        bias_status=outcome.bias_status, information=np.asarray(found.information),
        evidence=float(found.evidence) if prior.proper else None, objective=outcome.trace,
        levels=np.asarray(point.levels), directions=outcome.weak, draws=draws,
        log_prior=log_normal(draws, alpha) if independent else None,
        states=[split(s) for s in drawn.states], kept=np.arange(shape[1]),
        log_likelihood=[split(a) for a in drawn.log_likelihood], replicas=[split(a) for a in drawn.replicas],
        tracks=_tracks(point, before, spread, found.covariance),
        residuals=residuals_of(model, before, point), precisions="maximised" if prior.learns else "given",
    )  # fmt: skip


def _uncalibrated(point: Point) -> Point:
    return point._replace(z=jnp.zeros_like(point.z))


def _tracks(point: Point, before: Point, spread: list[Any], covariance: jax.Array) -> list[tree.Tracks]:
    found = []
    for states, old, moment in zip(point.states, before.states, spread, strict=True):
        response = np.asarray(moment.response)
        variance = np.diagonal(np.asarray(moment.states), axis1=1, axis2=2)
        variance = variance + np.sum((response @ np.asarray(covariance)) * response, 2)
        found.append(tree.Tracks(np.asarray(states), np.sqrt(np.maximum(variance, 0.0)), np.asarray(old)))
    return found


@float64
def track(problem: Problem, calibration: xr.DataTree) -> xr.DataTree:
    """Tracks of other data with a calibration applied: a tree with group `track` (mean, sd, before).

    The biases are held at the calibrated means; the sd carries their covariance. Biases are matched by label;
    raises `InputError` if the calibration lacks one.
    """
    found = tree.apply(problem, calibration)
    problem, covariance = found.problem, jnp.asarray(found.covariance)
    start = at_levels(problem.model, automatic_start(problem), jnp.asarray(found.levels))
    before = track_mode(problem, _uncalibrated(start))
    after = track_mode(problem, start._replace(z=jnp.asarray(found.z)))
    spread = moments(problem.model, after, covariance)
    return tree.build_tracks(problem, _tracks(after, before, spread, covariance))
