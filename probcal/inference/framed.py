"""Samplers whose chains move in the frame of a pose."""

from __future__ import annotations

from abc import ABC
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from probcal.inference.chains import Draw, run_chunk, run_sided, run_together
from probcal.inference.orbits import orbits_of
from probcal.inference.pose import GOOD, chain_start, pose
from probcal.inference.sampler import Sampler
from probcal.inference.sampling import Chains, each_chain
from probcal.inference.sides import Sided, distances, side_by_side
from probcal.modes.explore import Mirrored, new, reach
from probcal.modes.mirrors import other_sides


@dataclass(eq=False)
class FramedChains(Chains):
    """Chains in a frame: a thread each on a CPU, together on an accelerator.

    Where there are several sides of a mirror the chains start on them in turn, and cross. The fallback of the context
    takes over where the frame does not fit and has its prior.
    """

    def init(self) -> Any:
        """State of all chains, leading dim (chains,)."""
        problem, prior, start, fallback = self.problem, self.prior, self.start, self.context.fallback
        keys = jax.random.split(self.context.key)
        around = other_sides(problem, start) if np.isfinite(np.asarray(start.z)).all() else None
        start = start if around is None else around.point
        self.form, posed, found, worth = pose(problem, prior, start, keys[0])
        self.posed, self.worth = posed, worth
        if worth.failed and fallback is not None and (taken := self.method.instead(prior, fallback)) is not None:
            self.method = taken
            self.note = (
                f"The collapse does not fit (its leaps would be taken in {worth.acceptance:.0%} of the tries):"
                f" {taken.name} took over."
            )
        sides, poses = list[Mirrored](), [(posed, found)]
        for k, other in enumerate(around.others if around is not None and self.method.crosses else ()):
            _, there, drawn_there, _ = pose(problem, prior, other.point, jax.random.fold_in(keys[0], 1 + k))
            size = reach(problem, other.point, start)
            if new(problem, there.frame.point, [one.frame.point for one, _ in poses], size):  # none is visited twice
                sides.append(other)
                poses.append((there, drawn_there))
        if len(poses) > 1:
            away = distances(problem, [start, *(other.point for other in sides)])
            poses = [(one._replace(away=own), drawn) for (one, drawn), own in zip(poses, away, strict=True)]
        if worth.acceptance < GOOD and self.method.roams and not self.form.hierarchy.spiked:
            covariance = np.cov(np.asarray(found.theta)[:, : self.biases].T).reshape(self.biases, self.biases)
            orbits = orbits_of(problem, posed, covariance)
            poses = [(one._replace(orbits=orbits), drawn) for one, drawn in poses]
        self.sides = tuple(sides)
        self.where = side_by_side([one for one, _ in poses]) if sides else poses[0][0]
        starts = []
        for k, key in enumerate(jax.random.split(keys[1], self.method.chains)):
            side = k % len(poses)
            chain = _begun(
                self.method.kernel(), self.form, *poses[side], k, self.method.chains, jax.random.key_data(key)
            )
            own = jax.random.key_data(jax.random.fold_in(key, 1))
            starts.append(Sided(chain, jnp.asarray(side), own) if sides else chain)
        return jax.tree.map(lambda *leaves: np.stack(leaves), *starts)

    def advance(self, state: Any, thin: int) -> tuple[Any, Draw]:
        """All chains one chunk further, every `thin`-th step kept."""
        run, method, form, steps = (
            run_sided if self.sides else run_chunk,
            self.method.kernel(),
            self.form,
            jnp.asarray(thin),
        )
        if jax.default_backend() != "cpu":
            return run_together(run, method, form, self.where, state, steps)
        chains, threads = self.method.chains, self.context.threads
        return each_chain(lambda own: run(method, form, self.where, own, steps), state, chains, threads)


@partial(jax.jit, static_argnums=(0, 1))
def _begun(method: Any, form: Any, side: Any, drawn: Any, k: int, chains: int, key: jax.Array) -> Any:
    """Chain k on a side, in one kernel."""
    return method.first(form, side, *chain_start(form, side, drawn, k, chains), key)


class FramedSampler(Sampler, ABC):
    """A sampler with `first` and a pure `step` on the frame."""

    work = FramedChains
