"""The one verb: `fit(problem, method)` turns a problem into a DataTree, whatever the method."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from functools import partial
from os import PathLike
from typing import TYPE_CHECKING, cast

import jax
import jax.numpy as jnp
import numpy as np

from probcal.errors import FitError, InputError
from probcal.gaussian.choose import choose
from probcal.gaussian.information import at_levels
from probcal.gaussian.mode import Point
from probcal.gaussian.tails import settle
from probcal.identifiability.directions import alone_directions, screened_directions, weak_directions
from probcal.identifiability.remedies import Direction
from probcal.identifiability.watch import runs, strained_starts
from probcal.inference.identity import identity_of, points_digest, seed_text
from probcal.inference.manifest import stored_run
from probcal.inference.method import Context, Method, ParticleSmoother
from probcal.inference.methods import EA, NUTS, check_problem, choose_prior
from probcal.inference.progress import Monitor, OnProgress
from probcal.inference.solve import solve
from probcal.inference.storage import Storage
from probcal.inference.widen import judge_fit, judge_tracks
from probcal.labels import NODE, START, listed
from probcal.lazy import Later
from probcal.modes import automatic_start
from probcal.modes.grid import grid_start
from probcal.modes.mirrors import SAME, Mirrored
from probcal.priors import AnyPrior
from probcal.problem import Problem, check_linear
from probcal.results.answer import Answer, tracks_of
from probcal.results.build import add_mirrors, add_optima, bands, build, build_tracks
from probcal.results.read import apply
from probcal.simulate import Key, as_key
from probcal.types import float64
from probcal.wings import of_wing

if TYPE_CHECKING:
    import xarray as xr
else:
    xr = Later("xarray")

SAVE = ("states", "predictive")
NAMED = 4  # directions, or biases, that a message names
ALONE = 20  # combinations of the biases of single sensors that a large fit names
DIFFERENT = 2.0  # sd from which a bias is another one in another answer


@float64
def fit(
    problem: Problem,
    method: Method | None = None,
    *,
    prior: AnyPrior = None,
    key: Key = 0,
    start: Point | None = None,
    starts: int = 1,
    progress: OnProgress | None = None,
    limit: float | None = None,
    save: Collection[str] = (),
    store: str | PathLike[str] | None = None,
    resume: bool = False,
    overwrite: bool = False,
) -> xr.DataTree:
    """Calibrate: estimate the biases of a problem and the tracks of its targets.

    `method` is a value (`EA()` by default); `prior` defaults to the method's own, and may be a
    mapping from label pattern to prior (`{"*.range_offset": Gaussian()}`), in which a bias that no
    pattern matches has the method's own or that of "*", and of several others the last one counts:
    each kind has hyper-parameters of its own. `key` is a seed or jax key of the draws and of
    further starts; `start` replaces the automatic start. `starts` runs the method from so many
    starts, the further ones with two nodes swapped or a share of the biases drawn: the best optimum
    is reported, all of them with their evidence in the group `optimum`. `save` names draws that the
    tree keeps beside those of the biases and of the log-likelihood: "states" of every epoch
    (large), "predictive" replicas of the data. A sampler
    (`Collapsed()`, `NUTS()`, `SVI()`) writes its draws to the folder `store` while it runs;
    `resume` goes on where a killed run of the same model, data and settings stopped, with the draws
    of an uninterrupted one. A folder that holds a run is refused without `resume` or `overwrite`.
    `progress` is called with the phase, the steps done and the seconds (`Progress`). After `limit`
    seconds the search for other answers ends, and so do a climb and a sampler that are not done.
    Ctrl-C ends a fit in the same way: the best answer so far, or the draws so far, come back with
    the attribute `interrupted` and the status "not converged"; before there is one, and a second
    time, it raises. The attributes `status` and `message` say what the fit is worth. Where the
    innovations reject the model, the sds, intervals and draws of biases and states are widened by
    what they call for; `assess` looks for the cause, and sets the attribute `assessed`. Raises
    `InputError` for a prior that the method does not take and `FitError` where a flat prior leaves
    a singular problem without any interval.

    >>> found = fit(problem)
    >>> found.attrs["status"]
    'converged'
    """
    found, answer = calibrate(
        problem, method, prior=prior, key=key, start=start, starts=starts, monitor=Monitor(progress, limit), save=save,
        store=store, resume=resume, overwrite=overwrite,
    )  # fmt: skip
    judged = judged_problem(problem, answer)
    return found if judged is None else judge_fit(judged, found)


@float64
def calibrate(
    problem: Problem, method: Method | None = None, *, prior: AnyPrior = None, key: Key = 0,
    start: Point | None = None, starts: int = 1, monitor: Monitor | None = None, save: Collection[str] = (),
    store: str | PathLike[str] | None = None, resume: bool = False, overwrite: bool = False,
) -> tuple[xr.DataTree, Answer]:  # fmt: skip
    """The tree of `fit`, and the answer behind it, which the loops over many fits read."""
    method, monitor = EA() if method is None else method, monitor or Monitor()
    chosen = choose_prior(method, prior, problem.network.labels)
    check_problem(problem, linear=not method.by_particles)
    if problem.scans is not None:
        context = Context(jax.random.split(as_key(key))[0], monitor, None, fallback=NUTS())
        fit_labelled = partial(
            calibrate, prior=chosen, key=key, starts=starts, monitor=monitor, save=save, store=store, resume=resume,
            overwrite=overwrite,
        )  # fmt: skip
        return method.configured(problem, chosen, context, fit_labelled)
    keep = _kept(save)
    method.check_kept(problem, keep)
    if starts < 1:
        raise InputError(f"starts={starts}: at least one start is needed")
    if method.climbs:
        _check_store(method, store, resume, overwrite)
    identity: dict[str, str] = {}
    if store is not None:
        identity = identity_of(
            problem, method=method, prior=chosen, seed=seed_text(as_key(key)), number_of_starts=starts,
            start="" if start is None else points_digest(start),
        )  # fmt: skip
    folder = None if method.climbs else store
    with (
        Storage(folder, "draws", identity, resume=resume, overwrite=overwrite) as storage,
        monitor.interruptible(),
    ):
        keys = jax.random.split(as_key(key))
        context = Context(keys[0], monitor, storage, fallback=NUTS())
        answer = _interrupted(solve(problem, method, chosen, context, start=start, starts=starts), monitor)
        directions, count = _directions(answer)
        answer = _watched(replace(answer, message=_advised(answer, directions, count)))
        if not answer.posterior.sound:  # a flat prior on a singular problem: no interval exists
            raise FitError(answer.message)
        found = build(answer, directions, keys[1], keep)
    if answer.optima:
        found = add_optima(found, answer.optima, answer.best)
    if answer.mirrors:
        found = add_mirrors(found, answer)
    found.attrs["weak"] = count
    found.attrs["seed"] = int(key) if isinstance(key, (int, np.integer)) else -1
    if store is not None:
        found.attrs["identity"] = storage.digest
    if monitor.signal:
        found.attrs["interrupted"] = 1
    return found, answer


def _interrupted(answer: Answer, monitor: Monitor) -> Answer:
    """The answer, marked where Ctrl-C ended the search for it or for others."""
    if not monitor.signal:
        return answer
    unseen = "" if monitor.stopped in answer.message else monitor.stopped
    return replace(answer.judged(interrupted=True, unseen=unseen), interrupted=True)


def _directions(answer: Answer) -> tuple[tuple[Direction, ...], int]:
    """The directions that the data leave open at the answer, and their number; some have no name."""
    posterior, information = answer.posterior, answer.posterior.summary.information
    if (blocks := posterior.declared) is not None:
        if not answer.prior.proper:  # a flat prior leaves no room for more
            return alone_directions(answer.problem, posterior.point, blocks, ALONE)
        return screened_directions(answer.problem, posterior.expansion, blocks, ALONE)
    if information is None or not linear_form(answer) or not np.isfinite(information).all():
        return (), 0
    found = weak_directions(answer.problem, information, posterior.point)
    return found, len(found)


def judged_problem(problem: Problem, answer: Answer) -> Problem | None:
    """The problem by which the tree of an answer is judged, its rows named; None where no motion has a linear form."""
    if not linear_form(answer):
        return None
    return problem if problem.scans is None else answer.problem


def linear_form(answer: Answer) -> bool:
    """Whether the states of an answer are those of linear motions, as what follows gauges needs them."""
    states, noises = jax.tree.map(np.shape, answer.posterior.point.trajectories)
    return states == noises


def _advised(answer: Answer, directions: Sequence[Direction], count: int) -> str:
    """The message of an answer, with what the data leave open; a misfit is not for lack of data."""
    if not directions or not answer.status.explains:
        return answer.message
    named = "; ".join(direction.sentence for direction in directions[:NAMED])
    named += f"; and {count - NAMED} more" if count > NAMED else ""
    about = "Weakly determined by the data" if answer.status.settled else "The data do not fix"
    return f"{answer.message} {about}: {named}.".strip()


def _watched(answer: Answer) -> Answer:
    """The answer with what it ran along: no estimate where no row fixes that, else a sentence."""
    problem, point = answer.problem, answer.posterior.point
    if not linear_form(answer) or not answer.status.valid or not np.isfinite(np.asarray(point.z)).all():
        return answer
    found = answer
    for run in runs(problem, point, many=not answer.posterior.summary.covariance.whole):
        found = found.judged(**{"gauge" if run.gauge else "along": run})
    for strained in strained_starts(problem, point) if answer.motion == "used" else ():
        found = found.judged(strained=strained)
    for other in answer.mirrors:
        near = "worse" if other.gain <= -SAME else "equal"
        found = found.judged(**{near: (abs(other.gain), _place(answer, other))})
    alike = {other.kind for other in answer.mirrors if other.gain > -SAME}
    side = "line" if problem.network.dimension == 2 else "plane"
    return found.judged(node=NODE in alike, side=side if alike - {NODE, START} else "")


def _place(answer: Answer, other: Mirrored) -> str:
    """The place of an answer on the other side of a mirror, and the biases that differ there."""
    problem = answer.problem
    away = np.abs(other.shift) / np.maximum(answer.posterior.here[1], 1e-12)
    labels = [problem.labels[m] for m in np.argsort(-away) if away[m] > DIFFERENT]
    return f"{other.name}, " + (f"with other {listed(labels, NAMED)}" if labels else "the biases alike")


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


def _kept(save: Collection[str]) -> tuple[str, ...]:
    """What is kept of every draw, in the words of `gaussian.draws`; raises `InputError` for what cannot be saved."""
    names = (save,) if isinstance(save, str) else tuple(save)
    for name in names:
        if name not in SAVE:
            raise InputError(
                f'fit: save names "{name}", which is no group of draws; give "states", "predictive" or both'
            )
    return ("log_likelihood", *(word for name, word in zip(SAVE, ("states", "replicas"), strict=True) if name in names))


@float64
def track(
    problem: Problem, calibration: xr.DataTree, *, smoother: ParticleSmoother | None = None, key: Key = 0
) -> xr.DataTree:
    """Tracks of other data with a calibration applied: a tree with group `track` (mean, sd, before).

    The biases are held at the calibrated means; the sd carries their covariance, of a fit in sparse
    form that of each sensor by itself. Biases are matched by label. Where the innovations reject
    the model the sds are widened by what they call for, and the attribute `message` says so.
    Without a `smoother` each track is its mode and the Gaussian about it; `Particles(2000)` filters
    and smooths any motion, a road too, by draws that `key` seeds, and says in the attributes
    `status` and `message` whether some target's rows are explained by no path. Of detections that
    name no target the objects are found first (`track_objects`), as groups `association` and
    `object`. Raises `InputError` if the calibration lacks a bias, and where a motion has no linear
    form and there is no smoother.

    >>> later = track(Problem(network, motion, run.table), tree)
    >>> later["track/target"]["mean"].dims
    ('time', 'component')
    """
    if not problem.targets:
        source = problem.measurements.table.source
        raise InputError(f"track: no row of {source} has a target; fit(problem) tells of the biases")
    if problem.scans is not None:
        found = of_wing("track_detections")(problem, calibration, partial(track, smoother=smoother, key=key))
        return cast("xr.DataTree", found)
    found = apply(problem, calibration)
    problem = found.problem
    if smoother is not None:
        return smoother.tracked(problem, found.z, found.covariance, found.levels, as_key(key))
    check_linear(problem)
    engine = choose(problem.model)
    z = jnp.asarray(found.z)
    tracks = automatic_start(problem) if engine.cheap else grid_start(problem, z, 30)
    start = at_levels(problem.model, tracks, jnp.asarray(found.levels))
    before, after = start._replace(z=jnp.asarray(problem.first_z)), start._replace(z=z)
    before = engine.settled(problem.model, before).point
    if problem.model.tailed:
        _, before = settle(engine, problem, before, np.zeros((len(z), 0)))
        problem, after = settle(engine, problem, after, found.spread.root())
    at = engine.settled(problem.model, after)
    tree = build_tracks(problem, bands(tracks_of(at, found.spread), before))
    return judge_tracks(tree, problem, found, engine, at)
