"""The one verb: `fit(problem, method)` turns a problem into a DataTree, whatever the method."""

from __future__ import annotations

from collections.abc import Collection
from functools import partial
from os import PathLike
from typing import TYPE_CHECKING

import numpy as np

from probcal.gaussian.mode import Point
from probcal.inference.finish import finished, judged_tree, kept
from probcal.inference.identity import stored_fit
from probcal.inference.method import Context, Method
from probcal.inference.methods import METHODS, check_problem, choose_prior
from probcal.inference.progress import Monitor, OnProgress
from probcal.inference.solve import solve, with_room
from probcal.priors import AnyPrior
from probcal.problem import Problem
from probcal.results.answer import Answer
from probcal.simulate import Key, as_key, derived_keys
from probcal.types import float64

if TYPE_CHECKING:
    import xarray as xr


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
    is reported, all of them with their evidence in the group `mode`. `save` names draws that the
    tree keeps beside those of the biases and of the log-likelihood: "states" of every epoch
    (large), "predictive" replicas of the data. A method
    writes its draws, or the states of its climbs, to the folder `store` while it runs; `resume`
    goes on where a killed run of the same model, data and settings stopped, with the answer of an
    uninterrupted one. A folder that holds a run is refused without `resume` or `overwrite`.
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
    return judged_tree(problem, answer, found)


@float64
def calibrate(
    problem: Problem, method: Method | None = None, *, prior: AnyPrior = None, key: Key = 0,
    start: Point | None = None, starts: int = 1, monitor: Monitor | None = None, save: Collection[str] = (),
    store: str | PathLike[str] | None = None, resume: bool = False, overwrite: bool = False,
) -> tuple[xr.DataTree, Answer]:  # fmt: skip
    """The tree of `fit`, and the answer behind it, which the loops over many fits read."""
    (default, _), (fallback, _) = METHODS["ea"], METHODS["nuts"]
    method, monitor, keys = default if method is None else method, monitor or Monitor(), derived_keys(as_key(key))
    chosen = choose_prior(method, prior, problem.network.labels)
    check_problem(problem, linear=not method.by_particles)
    if problem.scans is not None:
        context = Context(keys[0], monitor, None, fallback=fallback)
        fit_labelled = partial(
            calibrate, prior=chosen, key=key, starts=starts, monitor=monitor, save=save, store=store, resume=resume,
            overwrite=overwrite,
        )  # fmt: skip
        return method.configured(problem, chosen, context, fit_labelled)
    keep = kept(save)
    method.check_kept(problem, keep)
    own = method, chosen, as_key(key), start, starts
    with (
        stored_fit(store, problem, *own, resume=resume, overwrite=overwrite) as storage,
        monitor.interruptible(),
    ):
        context = Context(keys[0], monitor, storage, fallback=fallback)
        roomy, start = with_room(problem, method, start)
        answer = solve(roomy, method, chosen, context, start=start, starts=starts)
        found, answer = finished(answer, keys[1], keep, monitor)
    found.attrs["seed"] = int(key) if isinstance(key, (int, np.integer)) else -1
    if store is not None:
        found.attrs["identity"] = storage.digest
    return found, answer
