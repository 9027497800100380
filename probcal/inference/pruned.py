"""Biases that maximised precisions keep in only by another mode: taken out where their prior asks for more.

The rule for a precision sees the curvature of the likelihood where the climb ended. A node on the other side of the
path that it hears stands out there by many sds, though at its stated value the data fit nearly as well. What it stands
out by is then not its mean over its sd but the nats that the evidence falls without it, all else fitted again.
"""

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from probcal.gaussian.linearised import laplace
from probcal.gaussian.mode import Point, find_mode, smooth_tracks
from probcal.inference.method import Given, State
from probcal.linalg import invert, spectrum
from probcal.model.model import Mixing, Model
from probcal.priors import ARD, PRECISION_BOUNDS

TRIED = 8  # groups of biases that are taken out for a trial, those farthest from their stated values first
SHARE = 0.5  # of the fall that the curvature foretells, from which a group is believed
GRID = np.geomspace(*PRECISION_BOUNDS, 400)  # precisions of which one must be the best for a group to stay

Climb = Callable[[Point, np.ndarray, Mixing], State]  # from a point with precisions (M,) and those of process noise


@dataclass(frozen=True)
class GroupEvidence:
    """A group of biases of one precision: information s (K,) and squared score q2 (K,) in the axes that part them."""

    s: np.ndarray
    q2: np.ndarray

    @classmethod
    def of(cls, covariance: np.ndarray, mean: np.ndarray, alpha: float) -> "GroupEvidence":
        """From the posterior of the group, the others integrated."""
        values, axes = spectrum(invert(covariance))
        return cls(np.maximum(values - alpha, 0.0), (values * (axes.T @ mean)) ** 2)

    def gain(self, alpha: np.ndarray) -> np.ndarray:
        """Nats of evidence that the group gains at precisions alpha (...) over being at its stated values."""
        own = np.asarray(alpha)[..., None] + self.s
        return np.asarray(0.5 * np.sum(np.log(np.asarray(alpha)[..., None] / own) + self.q2 / own, -1))

    def share(self, alpha: float, fall: float) -> float:
        """The true fraction of the squared score if the evidence falls by `fall` nats without
        it."""
        own = alpha + self.s
        promised = 0.5 * np.sum(self.q2 / own)
        return float((fall - 0.5 * np.sum(np.log(alpha / own))) / max(promised, 1e-300))

    def stays(self, prior: ARD, share: float) -> bool:
        """True if some precision short of the upper bound is best for a group of so much less score."""
        hyper = (prior.shape - 1) * np.log(GRID) - prior.rate * GRID
        worth = GroupEvidence(self.s, max(share, 0.0) * self.q2).gain(GRID) + hyper
        return bool(worth[0] > worth[1] or np.any((worth[1:-1] > worth[:-2]) & (worth[1:-1] >= worth[2:])))


def without_far_modes(model: Model, prior: ARD, given: Given, state: State, climb: Climb) -> State:
    """The state after every group of biases that another mode keeps in was taken out, one after the other.

    A climb that did not end, or ended nowhere, is left as it is.
    """
    stayed = set[int]()
    for _ in range(TRIED):
        sound = bool(state.done) and bool(jnp.isfinite(state.found.evidence))
        found = _without_one(model, prior, given, state, climb, stayed) if sound else None
        if found is None:
            break
        state = found
    return state


def _without_one(
    model: Model, prior: ARD, given: Given, state: State, climb: Climb, stayed: set[int]
) -> State | None:  # fmt: skip
    """The state without the first group that does not stay, None where all do; `stayed` gathers what was tried."""
    z, alpha, covariance = (np.asarray(x) for x in (state.point.z, state.alpha, state.found.covariance))
    group, inside = np.asarray(given.group), (alpha < 0.1 * PRECISION_BOUNDS[1]) & ~np.asarray(given.surveyed)
    model = model.with_mixing(state.mixing)
    far = sorted(set(group[inside].tolist()), key=lambda g: -np.abs(z[group == g]).max())
    for g in [g for g in far if g not in stayed][:TRIED]:
        mine = np.flatnonzero(group == g)
        first = float(alpha[mine[0]])
        standing = GroupEvidence.of(covariance[np.ix_(mine, mine)], z[mine], first)
        out, at = alpha.copy(), z.copy()
        out[mine], at[mine] = PRECISION_BOUNDS[1], 0.0
        now = given.prior._replace(alpha=jax.device_put(out))
        start = smooth_tracks(model, state.point._replace(z=jnp.asarray(at)))
        start = find_mode(model, start, now, 30, 1e-3).point
        fall = float(state.found.evidence - laplace(model, start, now).evidence)
        if not standing.share(first, fall) < SHARE:
            continue
        tried = climb(start, out, state.mixing)
        fall = float(state.found.evidence - tried.found.evidence)
        stayed.add(g)
        if bool(tried.done) and np.isfinite(fall) and not standing.stays(prior, standing.share(first, fall)):
            return tried
    return None
