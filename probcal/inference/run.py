"""What all methods share: first precisions, jitted chunks with progress, the verdict on where a fit ended."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal.priors import ARD, PRECISION_BOUNDS, Flat, Prior
from probcal.problem import Problem
from probcal.smoothing.directions import Direction, weak_directions
from probcal.smoothing.information import Laplace
from probcal.smoothing.mode import Point

CHUNK = 5  # outer iterations between two reports of progress
FAR = 10.0  # scales from the stated value beyond which a bias without prior has diverged
Progress = Callable[[str, int, float], None]  # method, iterations done, current objective


class Outcome(NamedTuple):
    """Where a method ended: the point, its precisions and Gaussian approximation, and the verdict in words."""

    point: Point
    alpha: np.ndarray  # (M,)
    laplace: Laplace
    trace: np.ndarray  # objective of every outer iteration
    status: str  # converged, at bound, not converged, diverged
    message: str  # one sentence on the status and what to do; empty where nothing is to be said
    bias_status: tuple[str, ...]
    weak: tuple[Direction, ...]


def first_precisions(problem: Problem, prior: Prior) -> jax.Array:
    """Precisions of z to start from: one scale (0 if flat), and one survey where surveyed."""
    governed = np.zeros(len(problem.labels)) if isinstance(prior, Flat) else np.ones(len(problem.labels))
    return jnp.asarray(np.where(problem.surveyed, 1.0, governed))


def run_chunks(
    step: Callable[[Any], tuple[Any, tuple[Any, Any]]],
    state: Any,
    iterations: int,
    name: str,
    progress: Progress | None,
) -> tuple[Any, np.ndarray]:
    """Step a jitted chunk until it is done or the iterations are spent; returns the state and the trace."""
    trace: list[float] = []
    while len(trace) < iterations and not bool(state.done):
        state, (objective, idle) = step(state)
        trace += [float(value) for value in np.asarray(objective)[~np.asarray(idle)]]
        if progress is not None:
            progress(name, len(trace), trace[-1])
    return state, np.array(trace[:iterations])


def finish(
    problem: Problem,
    prior: Prior,
    point: Point,
    precisions: jax.Array,
    found: Laplace,
    converged: bool,
    trace: np.ndarray,
) -> Outcome:
    """Say in words what the point and the Laplace approximation are worth where a method ended."""
    alpha, z = np.asarray(precisions), np.asarray(point.z)
    information = np.asarray(found.information)
    weak = weak_directions(problem, information, z) if np.isfinite(information).all() else ()
    low = (
        (alpha <= PRECISION_BOUNDS[0] * (1 + 1e-9)) & ~problem.surveyed
        if isinstance(prior, ARD)
        else np.zeros(len(z), bool)
    )
    far = (np.abs(z) > FAR) & ~problem.surveyed if isinstance(prior, Flat) else np.zeros(len(z), bool)
    sound = all(np.isfinite(np.asarray(part)).all() for part in (found.covariance, found.evidence, point.z))
    status = "converged" if converged else "not converged"
    if low.any():
        status = "at bound"
    if far.any() or not sound:
        status = "diverged"
    bias_status = tuple(
        "survey"
        if s
        else "at bound"
        if b
        else "diverged"
        if f
        else "pruned"
        if g < 1e-2 and isinstance(prior, ARD)
        else "estimated"
        for s, b, f, g in zip(problem.surveyed, low, far, np.asarray(found.gamma), strict=True)
    )
    message = _message(problem, status, low, far, weak, len(trace))
    return Outcome(point, alpha, found, trace, status, message, bias_status, weak)


def _message(
    problem: Problem, status: str, low: np.ndarray, far: np.ndarray, weak: tuple[Direction, ...], iterations: int
) -> str:
    def listed(mask: np.ndarray) -> str:
        labels = [label for label, hit in zip(problem.labels, mask, strict=True) if hit]
        return ", ".join(labels[:12]) + (f" and {len(labels) - 12} more" if len(labels) > 12 else "")

    advice = f" The data do not fix: {'; '.join(d.sentence for d in weak[:4])}." if weak else ""
    if status == "at bound":
        return f"The precision of {listed(low)} stands at its lower bound: the estimate is invalid.{advice}"
    if status == "diverged":
        where = (
            f"{listed(far)} lie more than {FAR:g} scales from the stated value"
            if far.any()
            else "the information matrix is singular"
        )
        return f"The fit diverged: {where}; the estimate is invalid. Use a prior, or fix some biases.{advice}"
    if status == "not converged":
        return (
            f"The fit did not converge in {iterations} iterations: allow more, or fix what the data leave open.{advice}"
        )
    return f"Weakly determined by the data: {'; '.join(d.sentence for d in weak[:4])}." if weak else ""
