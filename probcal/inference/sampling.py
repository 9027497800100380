"""Runs a sampler: chains in jitted chunks, each chain on its own thread, with progress, checkpoints and resume."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from probcal.errors import FitError, InputError
from probcal.gaussian.mode import Point
from probcal.inference.chains import Draw, run_chunk, run_sided, run_together
from probcal.inference.mixed import settled
from probcal.inference.orbits import orbits_of
from probcal.inference.pose import Pilot, Worth, chain_start, pose
from probcal.inference.posed import Form, Natural, Posed
from probcal.inference.progress import Monitor
from probcal.inference.sampler import Sampler
from probcal.inference.sides import Sided, distances, side_by_side
from probcal.inference.storage import Chunks, Storage
from probcal.modes.explore import Mirrored, new, reach
from probcal.modes.mirrors import other_sides
from probcal.priors import Prior
from probcal.problem import Problem

GROWTH = 4  # by how many times more steps a draw is tried again that has not mixed
WARM_UP = "warm-up"  # the phase that leaves no draws
ROAMING = 0.9  # acceptance of leaps below which chains also move along orbits


@dataclass(frozen=True, eq=False)
class SamplerRun:
    """What a sampler leaves: its draws, and how the run went."""

    method: Sampler
    asked: Sampler  # the method that was asked for, where another took over
    form: Form
    posed: Posed | Natural
    worth: Worth | None  # of the frame, where there is one
    draws: Draw  # leading dims (chain, draw) of every array
    seconds: float
    stopped: str  # why it was ended before all draws were made; empty where they were
    note: str  # what happened on the way, a sentence or nothing
    sides: tuple[Mirrored, ...] = ()  # other sides of a mirror that the chains visit, numbered from 1
    thin: int = 1  # steps from one draw to the next

    @property
    def z(self) -> np.ndarray:
        """Biases (chain, draw, M) over their scales."""
        return np.asarray(self.draws.theta)[..., : self.form.biases]

    @property
    def side(self) -> np.ndarray:
        """Which side of a mirror each draw (chain, draw) is on, 0 where there is none."""
        return _side(self.draws)

    @property
    def levels(self) -> np.ndarray:
        """Log levels (chain, draw, H)."""
        return np.asarray(self.draws.theta)[..., self.form.biases :]

    @property
    def states(self) -> list[np.ndarray]:
        """States (chain, draw, E, n) of each recursion."""
        return [np.asarray(x) for x in self.draws.states]


def _side(draws: Draw) -> np.ndarray:
    """Which side of a mirror each draw (chain, draw) is on, 0 where there is none."""
    return np.asarray(draws.stats.get("side", np.zeros(np.shape(draws.theta)[:2], int)))


@dataclass(frozen=True)
class Plan:
    """Which chunks are drawn: first every step is a draw; where these have not mixed, all anew, more steps a draw."""

    method: Sampler
    thin: int = 1
    before: Plan | None = None

    @property
    def begin(self) -> int:
        """The first chunk."""
        return 0 if self.before is None else self.before.end

    @property
    def end(self) -> int:
        """The chunk after the last."""
        return self.begin - (-(self._unkept + self.method.draws) // self.method.chunk)

    @property
    def _unkept(self) -> int:
        return self.method.warmup if self.before is None else 0

    @property
    def last(self) -> bool:
        """Whether the method has no patience for a longer one."""
        return self.thin * GROWTH > self.method.patience

    def longer(self) -> Plan:
        """The next, of more steps between two draws; those before it are its warm-up."""
        return Plan(self.method, self.thin * GROWTH, self)

    def kept(self, chunk: int) -> int:
        """How many draws of a chunk are kept, the last ones."""
        size = self.method.chunk
        return max(0, min((chunk - self.begin + 1) * size - self._unkept, size))

    def done(self, count: int) -> int:
        """Draws that are there after so many chunks."""
        return max(0, (count - self.begin) * self.method.chunk - self._unkept)

    def phase(self, count: int) -> str:
        """The phase after so many chunks."""
        if self.done(count) == 0 and self.before is None and self._unkept:
            return WARM_UP
        return "draws" if self.thin == 1 else f"draws, {self.thin} steps each"

    def steps(self, count: int) -> int:
        """Steps of a chain after so many chunks."""
        own = (count - self.begin) * self.method.chunk * self.thin
        return own + (0 if self.before is None else self.before.steps(self.begin))

    def drawn(self, box: Chunks) -> Draw:
        """Its own draws of those in a box."""
        arrays = box.joined(self.begin, self.end)
        return gathered({name: array[:, : self.method.draws] for name, array in arrays.items()})


def sample(
    problem: Problem,
    method: Sampler,
    prior: Prior,
    start: Point,
    key: jax.Array,
    *,
    monitor: Monitor,
    storage: Storage | None = None,
    threads: int | None = None,
    fallback: Sampler | None = None,
) -> SamplerRun:
    """Draws of a method from the posterior of a problem.

    `storage` keeps draws and state, and what it holds is gone on with; `monitor` may end it early.
    `fallback` takes over where the frame does not fit and has its prior. Raises `FitError` where no
    draw is finite, `InputError` where a stored chunk is damaged.
    """
    began = time.perf_counter()
    keys = jax.random.split(key)
    around = other_sides(problem, start) if np.isfinite(np.asarray(start.z)).all() else None
    start = start if around is None else around.point
    form, posed, found, worth = pose(problem, prior, start, keys[0])
    asked, note = method, ""
    if worth.failed and fallback is not None and (taken := method.instead(prior, fallback)) is not None:
        method = taken
        note = (
            f"The collapse does not fit (its leaps would be taken in {worth.acceptance:.0%} of the tries):"
            f" {method.name} took over."
        )
    sides, poses = list[Mirrored](), [(posed, found)]
    for k, other in enumerate(around.others if around is not None and method.crosses else ()):
        _, there, drawn_there, _ = pose(problem, prior, other.point, jax.random.fold_in(keys[0], 1 + k))
        size = reach(problem, other.point, start)
        if new(problem, there.frame.point, [one.frame.point for one, _ in poses], size):  # none is visited twice
            sides.append(other)
            poses.append((there, drawn_there))
    if len(poses) > 1:
        away = distances(problem, [start, *(other.point for other in sides)])
        poses = [(one._replace(away=own), drawn) for (one, drawn), own in zip(poses, away, strict=True)]
    if worth.acceptance < ROAMING and method.roams and not form.hierarchy.spiked:
        covariance = np.cov(np.asarray(found.theta)[:, : form.biases].T).reshape(form.biases, form.biases)
        orbits = orbits_of(problem, posed, covariance)
        poses = [(one._replace(orbits=orbits), drawn) for one, drawn in poses]
    runs = _Run(method, form, [one for one, _ in poses], [draws for _, draws in poses], keys[1])
    drawn, thin, stopped = drawn_by(method, runs, len(poses), monitor, storage, threads)
    seconds = time.perf_counter() - began
    return SamplerRun(method, asked, form, posed, worth, drawn, seconds, stopped, note, tuple(sides), thin)


class Runnable(Protocol):
    """The chains of a sampler, whatever their state is."""

    def first(self) -> Any:
        """State of all chains, leading dim (chains,)."""

    def restored(self, leaves: list[np.ndarray]) -> Any:
        """The state of saved leaves."""

    def advance(self, state: Any, thin: int, pool: ThreadPoolExecutor) -> tuple[Any, Draw]:
        """All chains one chunk further, every `thin`-th step kept."""


def drawn_by(
    method: Sampler, runs: Runnable, sides: int, monitor: Monitor, storage: Storage | None, threads: int | None
) -> tuple[Draw, int, str]:
    """Draws of all chains, chunk by chunk, steps from one to the next, and why they were ended
    early.

    What a storage holds is gone on with. Raises `FitError` where no draw is finite, and where a
    limit of time leaves none.
    """
    box = Chunks(Storage(None, "draws", {}) if storage is None else storage)
    state = runs.restored(box.state) if box.state is not None else runs.first()
    plan, phase, stopped = Plan(method), "", ""

    def enter() -> None:
        nonlocal phase
        if phase != (phase := plan.phase(box.count)):
            monitor.enter(phase, method.name, answering=phase != WARM_UP)

    with ThreadPoolExecutor(threads or os.cpu_count()) as pool:
        while True:
            while box.count < plan.end and not stopped:
                enter()
                state, draws = runs.advance(state, plan.thin, pool)
                kept = plan.kept(box.count)
                box.add({n: a[:, a.shape[1] - kept :] for n, a in flat_arrays(draws).items()}, jax.tree.leaves(state))
                enter()
                density = float(np.mean(draws.density))
                monitor.tell(method.name, plan.steps(box.count), plan.steps(plan.end), density)
                stopped = monitor.stopped
            if stopped and box.count < plan.end:
                break
            stopped, drawn = "", plan.drawn(box)
            if plan.last or settled(np.asarray(drawn.theta), _side(drawn), sides):
                break
            plan = plan.longer()
    if stopped:
        if plan.before is not None and plan.done(box.count) * GROWTH < method.draws:
            plan = plan.before
        if not plan.done(box.count):
            raise FitError(f"{stopped} in the warm-up, before there was a draw: give a longer limit, or fewer steps")
        drawn = plan.drawn(box)
    if not np.isfinite(np.asarray(drawn.theta)).all():
        raise FitError(
            f"{method.name}: some draw is not finite; give biases that no row determines a survey, or fix them"
        )
    return drawn, plan.thin, stopped


def restored_as(form: Any, leaves: list[np.ndarray]) -> Any:
    """The state of saved leaves; raises `InputError` where they are those of another."""
    if [leaf.shape for leaf in jax.tree.leaves(form)] != [leaf.shape for leaf in leaves]:
        raise InputError(
            "the state of the stored run has another form than this run's: begin anew with --overwrite (overwrite=True)"
        )
    return jax.tree.unflatten(jax.tree.structure(form), [jnp.asarray(leaf) for leaf in leaves])


def flat_arrays(draws: Draw) -> dict[str, np.ndarray]:
    """Draws as arrays (chains, draws, ...) by flat names, as a storage keeps them."""
    found: dict[str, Any] = {name: getattr(draws, name) for name in ("theta", "gamma", "variance", "density")}
    found |= {f"phi_{name}": value for name, value in draws.phi.items()}
    found |= {f"stats_{name}": value for name, value in draws.stats.items()}
    found |= {f"states_{r}": value for r, value in enumerate(draws.states)}
    return {name: np.asarray(value) for name, value in found.items()}


def gathered(arrays: Mapping[str, np.ndarray]) -> Draw:
    """The draws of arrays by flat names: what `named` made."""

    def group(prefix: str) -> dict[str, Any]:
        return {name.removeprefix(prefix): a for name, a in arrays.items() if name.startswith(prefix)}

    states = group("states_")
    fields: dict[str, Any] = {name: arrays[name] for name in ("theta", "gamma", "variance", "density")}
    in_order = tuple(states[str(r)] for r in range(len(states)))
    return Draw(phi=group("phi_"), stats=group("stats_"), states=in_order, **fields)


class _Run:
    """Chains of one method, advanced by a chunk: a thread each on a CPU, together on an accelerator.

    Where there are several sides of a mirror the chains start on them in turn, and cross.
    """

    def __init__(self, method: Sampler, form: Form, posed: list[Posed], found: list[Pilot], key: jax.Array):
        self.method, self.form, self.sides, self.found = method, form, posed, found
        self.keys = jax.random.split(key, method.chains)
        self.apart = jax.default_backend() == "cpu"
        self.mirrored = len(posed) > 1
        self.posed = side_by_side(posed) if self.mirrored else posed[0]

    def first(self) -> Any:
        """State of all chains, leading dim (chains,)."""
        starts = []
        for k in range(self.method.chains):
            side, key = k % len(self.sides), self.keys[k]
            posed = self.sides[side]
            begun = chain_start(self.form, posed, self.found[side], k, self.method.chains)
            chain = self.method.first(self.form, posed, *begun, jax.random.key_data(key))
            own = jax.random.key_data(jax.random.fold_in(key, 1))
            starts.append(Sided(chain, jnp.asarray(side), own) if self.mirrored else chain)
        return jax.tree.map(lambda *leaves: jnp.stack(leaves), *starts)

    def restored(self, leaves: list[np.ndarray]) -> Any:
        """The state of saved leaves; raises `InputError` where they are those of another."""
        return restored_as(jax.eval_shape(self.first), leaves)

    def advance(self, state: Any, thin: int, pool: ThreadPoolExecutor) -> tuple[Any, Draw]:
        """All chains one chunk further, every `thin`-th step kept."""
        alone = run_sided if self.mirrored else run_chunk
        if not self.apart:
            return run_together(alone, self.method.kernel(), self.form, self.posed, state, jnp.asarray(thin))

        def one(k: int) -> tuple[Any, Draw]:
            with jax.enable_x64(True):
                own = jax.tree.map(lambda leaf: leaf[k], state)
                return jax.block_until_ready(alone(self.method.kernel(), self.form, self.posed, own, jnp.asarray(thin)))

        found = list(pool.map(one, range(self.method.chains)))
        return jax.tree.map(lambda *leaves: jnp.stack(leaves), *found)
