"""Simulation-based calibration: does a method find what a problem's own prior draws, as often as it says?

Every run draws a truth from the prior and data at the problem's own rows, fits them, and asks where the truth lies
among the posterior's draws (Talts et al. 2018). `around` makes it posterior calibration (Sailynoja et al. 2025): the
truth is drawn from the posterior of the data at hand, the fit sees these data and new ones of the same trajectories,
and what is checked is the method where it will be used. It is the right tool where the prior is wide: the tracks of a
target whose start is not declared would pass many network sizes away.
"""

import time
from collections.abc import Sequence
from contextlib import closing
from copy import copy
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from probcal.errors import FitError, InputError
from probcal.files import AnyPath
from probcal.gaussian.information import at_levels
from probcal.gaussian.mode import Point, find_mode
from probcal.inference.hierarchy import hierarchy_of
from probcal.inference.identity import identity_of, points_digest, seed_text
from probcal.inference.method import Context, Method
from probcal.inference.methods import NUTS, check_problem, choose_prior
from probcal.inference.posed import Form
from probcal.inference.progress import Monitor, OnProgress
from probcal.inference.sampler import Sampler
from probcal.inference.solve import solve
from probcal.inference.spread import check_scheduler, spread
from probcal.inference.storage import Records, Storage
from probcal.model import variants
from probcal.modes.grid import follow_states
from probcal.priors import AnyPrior, Precision, Prior, as_prior
from probcal.problem import Problem
from probcal.results.read import each_track, saved_states
from probcal.simulate import Key, as_key, chance_of
from probcal.studies.coverage import judge_coverage
from probcal.studies.prior_draws import check_drawable, draw_data, draw_prior, far_start
from probcal.studies.quantities import TAKEN, Points, Pool, Trial, pool_of, ranked
from probcal.studies.uniformity import NOMINAL
from probcal.types import float64

BATCH = 5  # runs of one file
FAR = 2.0  # extents of the network beyond which the start of a target is called wide
SHORT = {"chains": 2, "warmup": 150, "draws": 150}  # of a sampler whose draws are only ranked
STARTS = ("automatic", "truth")


@float64
def sbc(
    problem: Problem,
    method: Method,
    *,
    prior: AnyPrior = None,
    runs: int = 200,
    simulate_from: AnyPrior = None,
    around: str | xr.DataTree | None = None,
    start: str = "automatic",
    key: Key = 0,
    draws: int = 100,
    store: AnyPath | None = None,
    resume: bool = False,
    overwrite: bool = False,
    fallback: bool = True,
    threads: int | None = None,
    scheduler: Any = None,
    progress: OnProgress | None = None,
) -> xr.DataTree:
    """Simulation-based calibration of a method on a problem: ranks, coverage of intervals, and a verdict.

    Truths come from `prior`, or from `simulate_from` where that is given (then coverage is reported, and uniform ranks
    are not to be expected). `around="data"`, or a saved fit of this problem, draws them from the posterior instead.
    `start="truth"` starts each fit near the simulated truth: cheaper, and of no account to a sampler that mixes.
    The truth is ranked among at most `draws` nearly independent draws, thinned by their effective sample size.
    Without `fallback` a sampler stands alone: the joint sampler does not take over where its collapse does not fit.
    `store` is a folder that keeps finished runs, `resume` goes on with it, for more `runs` too, `overwrite` replaces
    what it holds; results depend neither on an interruption nor on the number of `threads`. Ctrl-C leaves what was
    finished. `scheduler` spreads the runs over a dask cluster, as that of `study` does.

    Groups: `sbc` by run and quantity (`truth`, `mean`, `sd`, `rank` among `draws`, `place` in (0, 1), `inside` by
    nominal interval), `run` (`status`, `seconds`, ...), `uniformity` (p-values), `coverage` (see `coverage_table`).
    Attributes: `status` ("uniform", "not uniform"), `verdict`, `false_alarm_rate` of all quantities together.
    Raises `InputError` for a prior that cannot be drawn from and a folder that holds another run, and `FitError` where
    no run left a posterior, or a cluster is lost on the way.
    """
    if runs < 2 or draws < 10:
        raise InputError(f"sbc(runs={runs}, draws={draws}): give at least 2 runs and 10 draws")
    if start not in STARTS:
        raise InputError(f'sbc: start "{start}" is not known; give "automatic" or "truth"')
    check_scheduler(scheduler)
    chosen = choose_prior(method, prior, problem.network.labels)
    source = as_prior(simulate_from, chosen, problem.network.labels)
    check_problem(problem)
    method.check_kept(problem, ("states",))
    key = as_key(key)
    engine = _Engine(problem, method, chosen, source, around, start, draws, fallback, key)
    identity = {} if store is None else engine.identity()
    with Storage(store, "sbc", identity, resume=resume, overwrite=overwrite) as storage:
        kept = Records(storage)
        engine.prepare()
        records, interrupted = _runs(engine, kept, runs, threads, scheduler, progress)
    tree = _tree(engine, {k: records[k] for k in range(runs) if k in records}, interrupted)
    if store is not None:
        tree.attrs["identity"] = storage.digest
    return tree


def _runs(
    engine: "_Engine", box: Records, runs: int, threads: int | None, scheduler: Any, progress: OnProgress | None
) -> tuple[dict[int, dict[str, np.ndarray]], bool]:
    """Records of all runs, those kept and those made now, and whether Ctrl-C stopped them."""
    missing = [k for k in range(runs) if k not in box.records]
    batches = [missing[:1], *(missing[k : k + BATCH] for k in range(1, len(missing), BATCH))] if missing else []
    interrupted, monitor = False, Monitor(progress)
    monitor.tell("runs", runs - len(missing), runs)
    try:
        with closing(spread(engine.several, batches, scheduler=scheduler, threads=threads)) as finished:
            for k, records in finished:
                _check_quantities(box, records)
                box.add(batches[k], records)
                monitor.tell("runs", sum(k in box.records for k in range(runs)), runs)
    except KeyboardInterrupt:
        interrupted = True
        if len(box.records) < 2:
            raise
    return box.records, interrupted


def _check_quantities(box: Records, made: Sequence[dict[str, np.ndarray]]) -> None:
    """Raise `InputError` where runs that are kept rank other quantities than those made now."""
    named = [record["quantity"].tolist() for record in (*box.records.values(), *made) if "quantity" in record]
    if any(names != named[0] for names in named):
        other = sorted(set(named[0]) ^ set(named[-1]))
        raise InputError(
            f"{box.storage.path}: an earlier version of probcal ranked other quantities in the runs kept there"
            f" ({', '.join(other)}): give another folder, or --overwrite (overwrite=True)"
        )


def short(method: Method) -> Method:
    """A sampler with chains just long enough for ranks; any other method as it is."""
    if not isinstance(method, Sampler):
        return method
    least = {name: min(getattr(method, name), most) for name, most in SHORT.items()}
    if method.effective:
        least["effective"] = min(method.effective, least["chains"] * least["draws"] // 2)
    changed: Any = method
    return replace(changed, **least)


class _Engine:
    """The settings that every run shares."""

    def __init__(
        self, problem: Problem, method: Method, prior: Prior, source: Prior, around: Any, start: str, draws: int,
        fallback: bool, key: jax.Array,
    ):  # fmt: skip
        self.problem, self.method, self.prior, self.source = problem, method, prior, source
        self.start, self.draws, self.key = start, draws, key
        self.other = replace(NUTS(), warmup=SHORT["warmup"]) if fallback else None
        self.first = problem.first_precision(source)
        self.around = "data" if isinstance(around, str) else "fit" if around is not None else ""
        self.pool: Pool | None = None
        if around is not None and problem.clocks.any():
            raise InputError(
                "sbc: rows of free clocks have other times in every truth; leave around (--posterior) out, so that"
                " truths come from the prior"
            )
        if around is None:
            check_drawable(source, problem)
            self.form = Form(problem.model.biases, hierarchy_of(source, problem))
        elif isinstance(around, xr.DataTree):
            self.pool = _of_tree(problem, around)
        elif around != "data":
            raise InputError(f'sbc: around is "{around}"; give "data", or a tree of fit()')

    def prepare(self) -> None:
        """Fit the data at hand, where the truths come from their posterior."""
        if self.around == "data":
            self.pool = self._fit(self.problem, None, jax.random.fold_in(self.key, 2**31 - 1))

    def identity(self) -> dict[str, str]:
        """The settings that runs must share to be counted together."""
        around = self.around + (points_digest(self.pool.points) if self.pool else "")
        return identity_of(
            self.problem, method=self.method, prior=self.prior, prior_of_the_truths=self.source, start=self.start,
            posterior=around, draws=self.draws, fallback=self.other, seed=seed_text(self.key),
        )  # fmt: skip

    def trial(self, key: jax.Array) -> Trial:
        """A truth, and the problem with its data."""
        if self.pool is None:
            drawn, same = draw_prior(self.form, self.problem.model, self.first, key), self.prior == self.source
            point, timed = drawn.point, self.problem.retimed(drawn.point.z)
            if timed is not self.problem:  # the same truth, its rows where its clocks put them
                drawn = draw_prior(self.form, timed.model, self.first, key)
                states = timed.reordered(self.problem, drawn.point.states)
                point = drawn.point._replace(states=tuple(jnp.asarray(x) for x in states))
            return Trial(
                self.problem.redrawn(drawn.y), point, drawn.phi if same else {}, same and timed is self.problem
            )
        pick, seed = jax.random.split(key)
        k = int(jax.random.randint(pick, (), 0, self.pool.count))
        z, levels, states = jax.tree.map(lambda leaf: leaf[k], self.pool.points)
        flat = follow_states(self.problem, list(states))._replace(z=jnp.asarray(z))
        point = at_levels(self.problem.model, flat, jnp.asarray(levels))
        point = point._replace(states=tuple(jnp.asarray(x) for x in states))
        y = draw_data(self.problem.model, point, seed)
        phi = {name: leaf[k] for name, leaf in self.pool.hyper.items()}
        return Trial(_twice(self.problem, y), point, phi, joint=False)

    def _starting(self, trial: Trial) -> Point | None:
        """Near the truth, or None for a start from the data."""
        if self.start == "automatic":
            return None
        wide = Precision(jnp.ones(trial.problem.model.biases))
        point = trial.point
        if trial.problem.clocks.any():  # whose states are those of other times
            followed = follow_states(trial.problem, [np.asarray(x) for x in point.states])
            point = followed._replace(z=point.z, levels=point.levels)
        return find_mode(trial.problem.model, point, wide, 30, 1e-3).point

    def _fit(self, problem: Problem, start: Point | None, key: jax.Array) -> Pool:
        """The method's answer, started as `fit` starts it where no start is given."""
        keys = jax.random.split(key)
        context = Context(keys[0], threads=1, fallback=self.other)
        answer = solve(problem, self.method, self.prior, context, start=start)
        return pool_of(answer, keys[1], problem)

    def several(self, numbers: list[int]) -> list[dict[str, np.ndarray]]:
        """The records of some runs."""
        with jax.enable_x64(True):
            return [self.run(number) for number in numbers]

    def run(self, number: int) -> dict[str, np.ndarray]:
        """The record of one run."""
        keys = jax.random.split(jax.random.fold_in(self.key, number), 3)
        began = time.perf_counter()
        trial = self.trial(keys[0])
        rng = chance_of(keys[2])
        try:
            found = self._fit(trial.problem, self._starting(trial), keys[1])
        except FitError as error:
            return {"failed": np.array(str(error))}
        return ranked(trial, found, self.draws, rng) | {"seconds": np.array(time.perf_counter() - began)}


def _twice(problem: Problem, y: tuple[jax.Array, ...]) -> Problem:
    """The problem whose every row is measured twice, the second time as y (N, C) of each block."""
    other = copy(problem)
    other.model = variants.measured_twice(problem.model, y)
    other.row_index = [np.concatenate([index, index]) for index in problem.row_index]
    return other


def _of_tree(problem: Problem, tree: xr.DataTree) -> Pool:
    """The draws of a saved fit of a problem."""
    tracked = dict(each_track(tree))
    group = tree["posterior"].to_dataset() if "posterior" in tree.children else xr.Dataset()
    kept = "bias" in group and all("state" in tracked.get(name, ()) for name in problem.measurements.target_names)
    if not kept or set(problem.labels) != set(group["bias_label"].values.tolist()):
        raise InputError(
            "sbc: around must be a fit of this problem that kept its draws of biases and states; fit it again with"
            ' save=("states",)'
        )

    def flat(values: np.ndarray) -> np.ndarray:
        return values.reshape(values.shape[0] * values.shape[1], *values.shape[2:])

    z = flat(group["bias"].sel(bias_label=list(problem.labels)).values) / problem.scales
    levels = np.zeros((len(z), len(problem.levels)))
    for h, level in enumerate(problem.levels):
        drawn, held = group.get("level"), tree["level"].to_dataset()["std"]
        std = held.sel(level=level.label) if drawn is None else drawn.sel(level_label=level.label)
        levels[:, h] = level.log(np.ravel(std.values))
    points = Points(z, levels, tuple(flat(states) for states in saved_states(problem, tracked)))
    return Pool(points, {}, group.sizes["chain"], True, False, "read")


def _tree(engine: _Engine, records: dict[int, dict[str, np.ndarray]], interrupted: bool) -> xr.DataTree:
    """All runs as a tree, judged."""
    good = {run: record for run, record in records.items() if "failed" not in record}
    failed = {run: str(record["failed"]) for run, record in records.items() if "failed" in record}
    if len(good) < 2:
        raise FitError(
            f"sbc: {len(failed)} of {len(records)} runs left no posterior: {next(iter(failed.values()), '')}"
        )
    first = next(iter(good.values()))
    stacked = {name: np.stack([record[name] for record in good.values()]) for name in first}
    names, kinds = first["quantity"].tolist(), first["kind"].tolist()
    of_run = [name for name in stacked if stacked[name].ndim == 1]
    columns = [name for name in stacked if stacked[name].ndim > 1 and name not in ("quantity", "kind")]
    runs = list(good)
    table: dict[str, Any] = {
        name: (("run", "quantity", "nominal")[: stacked[name].ndim], stacked[name]) for name in columns
    }
    biases = engine.problem.biases
    quantity = {"quantity": names, "kind": ("quantity", kinds)}
    groups = {
        "sbc": xr.Dataset(table, coords={"run": runs, **quantity, "nominal": list(NOMINAL)}),
        "run": xr.Dataset({name: ("run", stacked[name]) for name in of_run}, coords={"run": runs}),
    }
    tree = xr.DataTree.from_dict(groups)
    judge_coverage(tree)
    tree.attrs |= {
        "method": engine.method.name, "settings": f"{engine.method!r}, {engine.prior!r}", "runs": len(good),
        "prior": engine.prior.title(biases), "source": engine.around or engine.source.title(biases),
        "start": engine.start, "failed": len(failed), "interrupted": int(interrupted),
        "data": engine.problem.measurements.table.source, "message": _message(engine, tree, failed, interrupted),
    }  # fmt: skip
    return tree


def _message(engine: _Engine, tree: xr.DataTree, failed: dict[int, str], interrupted: bool) -> str:
    """The warnings to read before the numbers are used."""
    parts = []
    if failed:
        parts.append(
            f"{len(failed)} runs left no posterior and are not counted, which ranks cannot make up for: "
            + next(iter(failed.values()))
        )
    taken = int((tree["run"]["status"] == TAKEN).sum())
    if taken:
        parts.append(
            f"The collapse did not fit in {taken} of {tree['run'].sizes['run']} runs, another sampler took over."
        )
    if interrupted:
        parts.append(f"Interrupted after {tree['run'].sizes['run']} runs; resume to go on.")
    if not engine.around and engine.prior != engine.source:
        parts.append(
            f"Truths come from {engine.source.title(engine.problem.biases)}, not from the prior of the fit: read the"
            " coverage, ranks need not be uniform."
        )
    if not engine.around and (wide := far_start(engine.problem)) > FAR:
        parts.append(
            f"The start of a target is {wide:.0f} network sizes wide, its simulated tracks pass far away: declare it,"
            ' Target(motion, start={...}), or calibrate around the data (around="data", --posterior).'
        )
    return " ".join(parts)
