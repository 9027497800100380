"""Filtered and smoothed particles of a problem as a tree, to look at and to study."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from probcal.errors import InputError
from probcal.lazy import xr
from probcal.particles.ensemble import filter_ensemble
from probcal.particles.particles import Particles
from probcal.particles.weighted import FILTERS, Paths, log_likelihood_at, prepared, status_of_tracks
from probcal.problem import Problem
from probcal.results.groups import by_target
from probcal.results.read import apply
from probcal.simulate import Key, as_key
from probcal.types import float64

THOUSAND = Particles(1000)


@float64
def particle_filter(
    problem: Problem, particles: Particles = THOUSAND, *, calibration: xr.DataTree | None = None,
    runs: int = FILTERS, key: Key = 0,
) -> xr.DataTree:  # fmt: skip
    """Particles of every target at biases of zero, or those of a `calibration` (Paper A, Algorithms 2-4).

    Nodes `filtered/<target>` and `smoothed/<target>` have `state` (particle, time, component) and `weight` (particle,
    time) that sum to 1 at each time. The attributes hold `log_likelihood`, the logarithm of its mean over `runs`
    filters, and its standard error `log_likelihood_se`; `status` is misfit where no path explains a target, and not
    converged where particles were too few. Raises `InputError` for less than 2 runs, and if the calibration lacks a
    bias.

    >>> from probcal import Particles
    >>> found = particle_filter(problem, Particles(50), runs=2)
    >>> found["smoothed/target"]["state"].dims
    ('particle', 'time', 'component')
    """
    if runs < 2:
        raise InputError(f"particle_filter(runs={runs}): at least 2 filters give an error")
    z, levels = np.zeros(problem.model.biases), np.zeros(len(problem.levels))
    if calibration is not None:
        found = apply(problem, calibration)
        problem, z, levels = found.problem, found.z, found.levels
    paths, keys = Paths(problem, particles, prepared(problem, particles)), jax.random.split(as_key(key), 3)
    given: Any = (jnp.asarray(z), jnp.asarray(levels))
    parts = {
        "filtered": filter_ensemble(problem.model, paths.targets, *given, keys[0], particles),
        "smoothed": paths.at(z, levels, keys[1]),
    }
    groups: dict[str, xr.Dataset] = {}
    for name, part in parts.items():
        states = [np.moveaxis(np.asarray(x), 1, 0) for x in paths.seen(part)]
        weights = [np.asarray(w).T for w in part.weights]
        columns = {"state": (("particle", "time", "component"), states), "weight": (("particle", "time"), weights)}
        groups |= {f"{name}/{target}": own for target, own in by_target(problem, columns).items()}
    tree = xr.DataTree.from_dict(groups)
    likelihood, error = log_likelihood_at(paths, z, levels, keys[2], runs)
    point = paths.point(parts["smoothed"], z, levels)
    status, message = status_of_tracks(problem.seen(), point, parts["smoothed"])
    tree.attrs |= {
        "log_likelihood": likelihood, "log_likelihood_se": error, "particles": repr(particles),
        "status": str(status), "message": message,
    }  # fmt: skip
    return tree
