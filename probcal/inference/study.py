"""Studies: methods side by side over settings and simulated runs, many fits in one compiled kernel."""

import itertools
import json
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from os import PathLike
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from probcal.errors import InputError, nearest
from probcal.inference.ending import conclude
from probcal.inference.identity import identity, problem_digest
from probcal.inference.integrate import Integrated, Integration, integrate
from probcal.inference.methods import METHODS, NUTS, check_problem, choose_prior
from probcal.inference.progress import OnProgress, Progress
from probcal.inference.run import (
    Context,
    Given,
    Maximiser,
    Method,
    State,
    check_method,
    first_state,
    given_of,
    kernel,
    stepped,
)
from probcal.inference.sampler import Sampler
from probcal.inference.settings import check_setting
from probcal.inference.solve import solve
from probcal.inference.storage import Records, Storage
from probcal.model.model import Model
from probcal.priors import PRECISION_BOUNDS, Prior
from probcal.problem import Problem
from probcal.results.answer import Answer
from probcal.results.schema import INTERVAL
from probcal.simulate import Truth
from probcal.smoothing.information import mean_square
from probcal.smoothing.mode import Point
from probcal.starts import automatic_start

BATCH = 10  # runs that one compiled call solves
CHECKED = 20  # stored problems that a resumed study makes anew, to see whether the model is still the same
ORACLE = "oracle"  # MAP whose prior knows which biases are zero
VECTORS = ("error", "lower", "upper", "true", "sd", "gamma")  # by bias, over its scale; the interval less the truth
SEED = 0  # of what an E-step draws
NOTHING = np.zeros(0)  # the trace of a batch, which keeps none
Setting = Callable[..., tuple[Problem, Truth]]


class _Solved(NamedTuple):
    """Where each run of a batch ended; leading dim (runs,)."""

    state: State
    mixed: Integrated | None  # where precisions are integrated after the climb
    square: jax.Array  # (runs,) of what is left, a datum
    iterations: jax.Array  # (runs,)


@partial(jax.jit, static_argnames=("method", "prior", "how"))
def _solve(
    method: Any, models: Model, prior: Prior, iterations: int, givens: Given, starts: Point, how: Integration | None
) -> _Solved:
    """Run a method on many problems of one form: one after the other on a CPU, together on an accelerator."""

    def one(pieces: tuple[Model, Given, Point]) -> _Solved:
        model, given, start = pieces

        def step(carry: tuple[State, jax.Array]) -> tuple[State, jax.Array]:
            state, count = carry
            return stepped(method, model, prior, given, state), count + 1

        def on(carry: tuple[State, jax.Array]) -> jax.Array:
            return ~carry[0].done & (carry[1] < iterations)

        first = first_state(given, model, start, method.begin(model, start), jax.random.key(SEED))
        state, count = jax.lax.while_loop(on, step, (first, jnp.zeros((), int)))
        model = model.with_mixing(state.mixing)
        state = method.close(model, prior, given, state)._replace(seed=jnp.zeros(()), carry=())
        mixed = None if how is None else integrate(how, model, given.prior, state.point, jax.random.key(SEED))
        return _Solved(state, mixed, mean_square(model, state.point if mixed is None else mixed.point), count)

    pieces = (models, givens, starts)
    return jax.lax.map(one, pieces) if jax.default_backend() == "cpu" else jax.vmap(one)(pieces)


class _Run(NamedTuple):
    """One simulated problem, its truth and start."""

    problem: Problem
    truth: Truth
    start: Point | None  # None where a motion has no linear form
    number: int


def _given(method: Maximiser, prior: Prior, run: _Run, oracle: bool) -> Given:
    given = given_of(method, run.problem, prior)
    if not oracle:
        return given
    zero = np.array([run.truth.biases[label] == 0.0 for label in run.problem.labels])
    alpha = jnp.where(zero & ~run.problem.surveyed, PRECISION_BOUNDS[1], given.prior.alpha)
    return given._replace(prior=given.prior._replace(alpha=alpha))


def _position_rmse(run: _Run, states: Sequence[np.ndarray]) -> float:
    """Root mean square position error in m over the epochs that the truth covers, NaN if it covers none."""
    squares = []
    d = run.problem.network.dimension
    for epochs, x in zip(run.problem.epochs, states, strict=True):
        span = slice(*epochs.position)
        true = run.truth.positions(epochs.time, epochs.target, d)
        known = np.isfinite(true).all(1)
        squares.append(((x[:, span] - true)[known] ** 2).sum(1))
    joined = np.concatenate(squares)
    return float(np.sqrt(joined.mean())) if len(joined) else np.nan


def _form(run: _Run) -> tuple[Any, ...]:
    """Runs of one form are solved by one kernel: the same static part and the same shapes."""
    return (jax.tree.structure(run.problem.model), *(leaf.shape for leaf in jax.tree.leaves(run.problem.model)))


def _batch(
    setting: Setting, cases: Sequence[tuple[dict[str, Any], int]], methods: Mapping[str, tuple[Method, Prior]], *,
    stored: bool = False,
) -> list[dict[str, Any]]:  # fmt: skip
    """Records of all methods on some cases (grid point, run); one of them says what its problem was, if `stored`."""
    with jax.enable_x64(True):
        whole = [_simulated(setting, point, run, _needs_linear(methods)) for point, run in cases]
        found: list[dict[str, Any]] = []
        for name, (method, prior) in methods.items():
            if isinstance(method, Sampler) or method.by_particles:
                found += [
                    {"case": case, "method": name} | _record(run, _drawn(run, method, prior))
                    for case, run in zip(cases, whole, strict=True)
                ]
                continue
            assert isinstance(method, Maximiser)
            runs = [_prepared(method, run) for run in whole]
            groups: dict[tuple[Any, ...], list[int]] = {}
            for k, run in enumerate(runs):
                groups.setdefault(_form(run), []).append(k)
            for members in groups.values():
                chosen = [runs[k] for k in members]
                stacked = [
                    jax.tree.map(lambda *leaves: jnp.stack(leaves), *parts)
                    for parts in (
                        [run.problem.model for run in chosen],
                        [_given(method, prior, run, name == ORACLE) for run in chosen],
                        [run.start for run in chosen],
                    )
                ]
                how, climb = method.integration(chosen[0].problem, prior), method.climbs_under(prior)
                solved = _solve(kernel(method), stacked[0], climb, method.iterations, *stacked[1:], how)
                solved = jax.tree.map(np.asarray, solved)
                for j, k in enumerate(members):
                    state, mixed, square, count = jax.tree.map(lambda leaf, j=j: leaf[j], solved)
                    problem = chosen[j].problem.with_mixing(state.mixing)
                    answer = conclude(problem, method, prior, state, NOTHING, float(square), int(count), how, mixed)
                    found.append({"case": cases[k], "method": name} | _record(chosen[j], answer))
        if stored:
            first = next(record for record in found if record["case"] == cases[0])
            first["problem"] = problem_digest(whole[0].problem, whole[0].truth.biases)
        return found


def _simulated(setting: Setting, point: dict[str, Any], number: int, linear: bool) -> _Run:
    """One problem with its start; raises `InputError` where a setting does not return what a study needs."""
    problem, truth = _made(setting, point, number, linear)
    return _Run(problem, truth, automatic_start(problem) if linear else None, number)


def _needs_linear(methods: Mapping[str, tuple[Method, Prior]]) -> bool:
    """Whether some method asks for motions with a linear form."""
    return not all(method.by_particles for method, _ in methods.values())


def _made(setting: Setting, point: dict[str, Any], number: int, linear: bool) -> tuple[Problem, Truth]:
    """A problem and its truth, checked; `linear` if some method asks for motions with a linear form."""
    made = setting(number, **point)
    if not (isinstance(made, tuple) and len(made) == 2 and isinstance(made[0], Problem) and isinstance(made[1], Truth)):
        raise InputError("study: setting(run, ...) must return a pair, the Problem and its Truth")
    problem, truth = made
    check_problem(problem, linear=linear)
    unknown = [label for label in problem.labels if label not in truth.biases]
    if unknown:
        raise InputError(f'study: the truth of setting(run, ...) does not name the bias "{unknown[0]}"; give its value')
    return problem, truth


def _prepared(method: Method, run: _Run) -> _Run:
    problem = method.prepare(run.problem)
    return run if problem is run.problem else run._replace(problem=problem, start=automatic_start(problem))


def _record(run: _Run, answer: Answer) -> dict[str, Any]:
    """What a study keeps of an answer, judged by the truth."""
    problem, found = answer.problem, answer.posterior.summary
    true = np.array([run.truth.biases[label] for label in problem.labels]) / problem.scales
    error, lower, upper = found.mean - true, found.lower - true, found.upper - true
    return {
        "bias_rmse": float(np.sqrt(np.mean(error**2))),
        "coverage": float(((lower <= 0) & (upper >= 0)).mean()),
        "position_rmse": _position_rmse(run, answer.posterior.states),
        "status": str(answer.status), "ran": answer.method.name, "iterations": answer.iterations,
        "error": error, "true": true, "gamma": found.gamma, "sd": found.sd, "lower": lower, "upper": upper,
        "labels": problem.labels,
    }  # fmt: skip


def _drawn(run: _Run, method: Method, prior: Prior) -> Answer:
    """The answer of a sampler, or of a method by particles, which take their runs one by one."""
    context = Context(jax.random.key(run.number), threads=1, fallback=NUTS())
    return solve(run.problem, method, prior, context, start=None if method.by_particles else run.start)


def choose_methods(names: Sequence[str]) -> dict[str, tuple[Method, Prior]]:
    """Methods by their names on the command line; "oracle" is MAP that knows which biases are zero."""
    chosen = {}
    for name in names:
        if name not in METHODS and name != ORACLE:
            raise InputError(f'method "{name}" is not known{nearest(name, [*METHODS, ORACLE])}')
        method, prior = METHODS["map"] if name == ORACLE else METHODS[name]
        chosen[name] = (method, choose_prior(method, prior))
    return chosen


def _pairs(methods: Mapping[str, Any]) -> dict[str, tuple[Method, Prior]]:
    """Methods and their priors from a mapping to methods or pairs, checked as `fit` checks them."""
    found = {}
    for name, value in methods.items():
        method, prior = value if isinstance(value, tuple) and len(value) == 2 else (value, None)
        if not isinstance(method, Method):
            raise InputError(f'study: method "{name}" is {value!r}; give a method such as EA(), or (EA(), ARD())')
        if isinstance(method, Maximiser):
            check_method(method)
        found[name] = (method, choose_prior(method, prior))
    return found


def _values(name: str, values: Any) -> list[Any]:
    """Values of one setting, checked before any work is done."""
    if isinstance(values, str) or not hasattr(values, "__iter__"):
        raise InputError(f"study: the values of {name} are {values!r}; give a list of values")
    found = [value.item() if isinstance(value, np.generic) else value for value in values]
    check_setting(name, found)
    return found


def study(
    setting: Setting,
    grid: Mapping[str, Sequence[Any]],
    methods: Sequence[str] | Mapping[str, Any] = ("ml", "em-ea", "ea", ORACLE),
    *,
    runs: int | Sequence[int] = 20,
    store: str | PathLike[str] | None = None,
    resume: bool = False,
    overwrite: bool = False,
    progress: OnProgress | None = None,
) -> xr.Dataset:
    """Fit every run of every setting by every method: errors, coverage and status by setting, method and run.

    `setting(run, **point)` returns a problem and its truth for a run (its seed) and a point of the `grid`, a
    mapping from argument to values. `methods` are names of the command line, or a mapping to a method or a pair of
    method and prior.
    Variables have the grid's dims, `estimator` (the method; xarray keeps that word for itself) and `run`:
    `bias_rmse` (root mean square of the errors over their scales), `position_rmse` in m, `coverage` of the
    intervals, `status`, `ran` (the method, or the one that took over), `iterations`; with `bias_label`: `error`,
    `lower` and `upper` end of the interval less the truth, `true`, `sd` (all over their scales) and `gamma`.
    `store` is a folder that keeps finished fits, `resume` goes on with it, for more runs and settings too, `overwrite`
    replaces what it holds; an interruption changes no result.
    Raises `InputError` for an unknown method, settings whose biases differ and a folder that holds another study. Runs
    are solved in batches by compiled kernels, on as many threads as there are processors.
    """
    chosen = _pairs(methods) if isinstance(methods, Mapping) else choose_methods(methods)
    numbers = list(range(int(runs))) if isinstance(runs, (int, np.integer)) else [int(number) for number in runs]
    axes = {name: _values(name, values) for name, values in grid.items()}
    if not numbers or not chosen or not all(axes.values()):
        raise InputError("study: give at least one run, one method and one value of every setting")
    if len(set(numbers)) < len(numbers):
        raise InputError("study: a run is given twice; give every run once")
    points = [dict(zip(axes, values, strict=True)) for values in itertools.product(*axes.values())]
    made = {} if store is None else identity(list_of_methods=chosen)
    with Storage(store, "study", made, resume=resume, overwrite=overwrite) as storage:
        kept = _Kept(storage, setting)
        records = _fits(setting, points, numbers, chosen, kept, progress)
    found = _dataset(records, axes, list(chosen), numbers)
    if store is not None:
        found.attrs["identity"] = storage.digest
    return found


def _fits(
    setting: Setting, points: list[dict[str, Any]], numbers: list[int],
    methods: Mapping[str, tuple[Method, Prior]], kept: "_Kept", progress: OnProgress | None,
) -> list[dict[str, Any]]:  # fmt: skip
    """Records of all methods at all points and runs, those kept and those made now."""
    wanted = {_case(point, run) for point in points for run in numbers}
    records = [record for record in kept.records() if _case(*record["case"]) in wanted]
    there = {_case(*record["case"]) for record in records}
    batches = []
    for point in points:
        missing = [(point, run) for run in numbers if _case(point, run) not in there]
        batches += [missing[k : k + BATCH] for k in range(0, len(missing), BATCH)]
    firsts = [kept.next + k * BATCH * len(methods) for k in range(len(batches))]
    total = len(wanted) * len(methods)

    def one(cases: list[tuple[dict[str, Any], int]], first: int) -> list[dict[str, Any]]:
        found = _batch(setting, cases, methods, stored=kept.stored)
        kept.add(first, found)
        return found

    def take(found: list[dict[str, Any]]) -> None:
        records.extend(found)
        if progress is not None:
            progress(Progress("fits", len(records), total))

    if batches:
        take(one(batches[0], firsts[0]))  # compiles
        pool = ThreadPoolExecutor(os.cpu_count())
        try:
            for found in pool.map(one, batches[1:], firsts[1:]):
                take(found)
        finally:
            pool.shutdown(cancel_futures=True)
    return records


def _case(point: Mapping[str, Any], run: int) -> str:
    """A grid point and a run as text."""
    return json.dumps([dict(point), run], sort_keys=True)


class _Kept:
    """Records of a study in a storage, where there is one; raises `InputError` where the model is another by now."""

    def __init__(self, storage: Storage, setting: Setting):
        self.stored = storage.path is not None
        self.box = Records(storage)
        marked = [record for record in self.box.records.values() if "problem" in record]
        for record in marked[:: -(-len(marked) // CHECKED) or 1]:
            point, run = json.loads(str(record["case"]))
            with jax.enable_x64(True):
                problem, truth = _made(setting, point, run, False)
                same = problem_digest(problem, truth.biases) == str(record["problem"])
            if not same:
                raise InputError(
                    f"{storage.path}: setting(run={run}, ...) gives another problem than when the study there began:"
                    " the model has changed; go on with it as it was, give another folder, or --overwrite"
                    " (overwrite=True)"
                )

    @property
    def next(self) -> int:
        """The first number that no record has."""
        return max(self.box.records, default=-1) + 1

    def records(self) -> list[dict[str, Any]]:
        """What is kept, as `_batch` gave it."""
        found = []
        for record in self.box.records.values():
            point, run = json.loads(str(record["case"]))
            texts = {name: str(record[name]) for name in ("method", "status", "ran")}
            labels = tuple(record["labels"].tolist())
            found.append(record | texts | {"case": (point, run), "labels": labels})
        return found

    def add(self, first: int, records: list[dict[str, Any]]) -> None:
        """Keep the records of a batch, from a number on."""
        if self.stored:
            named = [record | {"case": _case(*record["case"])} for record in records]
            self.box.add(range(first, first + len(records)), named)


def _dataset(
    records: list[dict[str, Any]], axes: Mapping[str, list[Any]], methods: list[str], runs: list[int]
) -> xr.Dataset:
    labels = records[0]["labels"]
    if any(record["labels"] != labels for record in records):
        raise InputError("study: the settings have different biases; make one study for each network")
    dims = (*axes, "estimator", "run")
    shape = (*(len(values) for values in axes.values()), len(methods), len(runs))
    scalars: dict[str, Any] = {name: np.full(shape, np.nan) for name in ("bias_rmse", "coverage", "position_rmse")}
    scalars |= {name: np.full(shape, "", "<U16") for name in ("status", "ran")}
    scalars["iterations"] = np.zeros(shape, int)
    vectors = {name: np.full((*shape, len(labels)), np.nan) for name in VECTORS}
    for record in records:
        point, run = record["case"]
        where = (
            *(axes[name].index(point[name]) for name in axes), methods.index(record["method"]), runs.index(run),
        )  # fmt: skip
        for name, values in (scalars | vectors).items():
            values[where] = record[name]
    if np.isnan(scalars["position_rmse"]).all():
        del scalars["position_rmse"]
    return xr.Dataset(
        {name: (dims, values) for name, values in scalars.items()}
        | {name: ((*dims, "bias_label"), values) for name, values in vectors.items()},
        coords={**axes, "estimator": methods, "run": runs, "bias_label": list(labels)},
        attrs={"interval_probability": INTERVAL},
    )
