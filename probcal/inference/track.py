"""The verb `track`: the tracks of other data with a calibration applied."""

from __future__ import annotations

from functools import partial
from typing import cast

import jax.numpy as jnp
import numpy as np

from probcal.errors import InputError
from probcal.gaussian.choose import choose
from probcal.gaussian.information import at_levels
from probcal.gaussian.tails import settle
from probcal.inference.method import ParticleSmoother
from probcal.inference.widen import judge_tracks
from probcal.lazy import xr
from probcal.modes import automatic_start
from probcal.modes.grid import grid_start
from probcal.problem import Problem, check_linear
from probcal.results.answer import tracks_of
from probcal.results.build import build_tracks
from probcal.results.read import apply
from probcal.simulate import Key, as_key
from probcal.types import float64
from probcal.wings import of_wing


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
    tracks = automatic_start(problem) if engine.cheap else grid_start(problem, z)
    start = at_levels(problem.model, tracks, jnp.asarray(found.levels))
    before, after = start._replace(z=jnp.asarray(problem.first_z)), start._replace(z=z)
    before = engine.settled(problem.model, before).point
    if problem.model.tailed:
        _, before = settle(engine, problem, before, np.zeros((len(z), 0)))
        problem, after = settle(engine, problem, after, found.spread.root())
    at = engine.settled(problem.model, after)
    tree = build_tracks(problem, tracks_of(at, found.spread), before.states)
    return judge_tracks(tree, problem, found, engine, at)
