"""Studies: methods side by side over settings and simulated runs, many fits in one compiled kernel."""

import itertools
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from probcal.devices import over_devices
from probcal.errors import InputError, nearest
from probcal.files import AnyPath
from probcal.gaussian.mode import Point
from probcal.inference.ending import conclude
from probcal.inference.identity import identity, problem_digest
from probcal.inference.integrate import Integrated, Integration, integrate
from probcal.inference.loop import Trace
from probcal.inference.method import Context, Given, Method, State
from probcal.inference.methods import METHODS, NUTS, check_problem, choose_prior
from probcal.inference.progress import Monitor, OnProgress
from probcal.inference.run import Maximiser, check_method, first_state, given_of, kernel, stepped
from probcal.inference.solve import solve
from probcal.inference.spread import check_scheduler, spread
from probcal.inference.storage import Storage
from probcal.model.model import Model
from probcal.modes import automatic_start
from probcal.priors import PRECISION_BOUNDS, Prior
from probcal.problem import Problem
from probcal.results.answer import Answer
from probcal.simulate import Truth
from probcal.studies.fits import Fits, open_fits
from probcal.studies.settings import check_setting
from probcal.wings import check_method_installed

CHECKED = 20  # stored problems that a resumed study makes anew, to see whether the model is still the same
ORACLE = "oracle"  # MAP whose prior knows which biases are zero
SEED = 0  # of what an E-step draws
Setting = Callable[..., tuple[Problem, Truth]]


class _Solved(NamedTuple):
    """The final state of a run."""

    state: State
    mixed: Integrated | None  # where precisions are integrated after the climb
    iterations: jax.Array  # ()


def _climb(
    method: Any, prior: Prior, how: Integration | None, iterations: int, model: Model, given: Given, start: Point
) -> _Solved:
    """Run a method on a problem."""

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
    return _Solved(state, mixed, count)


_alone = partial(jax.jit, static_argnums=(0, 1, 2))(_climb)


@partial(jax.jit, static_argnums=(0, 1, 2))
def _together(
    method: Any, prior: Prior, how: Integration | None, iterations: int, models: Model, givens: Given, starts: Point
) -> _Solved:
    """Run a method on many problems of one form, stacked, on all devices."""
    climb = jax.vmap(partial(_climb, method, prior, how, iterations))
    return over_devices(climb, models, givens, starts)


def _solve(
    method: Any, prior: Prior, how: Integration | None, iterations: int, pieces: Sequence[tuple[Model, Given, Any]]
) -> list[_Solved]:
    """Run a method on problems of one form: one by one on a CPU, whose kernel serves any number; together elsewhere."""
    if jax.default_backend() == "cpu":
        return [jax.tree.map(np.asarray, _alone(method, prior, how, iterations, *own)) for own in pieces]
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *pieces)
    solved = jax.tree.map(np.asarray, _together(method, prior, how, iterations, *stacked))
    return [jax.tree.map(lambda leaf, j=j: leaf[j], solved) for j in range(len(pieces))]


class _Run(NamedTuple):
    """One simulated problem, its truth and start."""

    problem: Problem
    truth: Truth
    start: Point | None  # None where a motion has no linear form
    number: int
    places: list[np.ndarray]  # true positions (E, d) of each recursion, NaN where unknown


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
    for place, true in zip(run.problem.positions(states), run.places, strict=True):
        known = np.isfinite(true).all(1)
        squares.append(((place - true)[known] ** 2).sum(1))
    joined = np.concatenate(squares)
    return float(np.sqrt(joined.mean())) if len(joined) else np.nan


def _form(run: _Run) -> tuple[Any, ...]:
    """Runs of one form are solved by one kernel: the same static part and the same shapes."""
    return (jax.tree.structure(run.problem.model), *(leaf.shape for leaf in jax.tree.leaves(run.problem.model)))


def _batch(
    setting: Setting, methods: Mapping[str, tuple[Method, Prior]], stored: bool,
    batch: tuple[int, dict[str, Any], list[int]],
) -> list[dict[str, Any]]:  # fmt: skip
    """Records of all methods on some runs of a grid point; one of them says what its problem was, if `stored`."""
    turn, point, numbers = batch
    with jax.enable_x64(True):
        whole = [_simulated(setting, point, number, _needs_linear(methods)) for number in numbers]
        found: list[dict[str, Any]] = []
        for name in _turned(list(methods), turn):
            method, prior = methods[name]
            for run in whole:
                prior.check_kinds(run.problem.network.labels)
            once = [_climbs_once(method, prior, run, name == ORACLE) for run in whole]
            alone = [run for run, own in zip(whole, once, strict=True) if not own]
            records = [_record(run, _alone_by(run, method, prior)) for run in alone]
            found += [{"run": run.number, "method": name} | own for run, own in zip(alone, records, strict=True)]
            if len(alone) == len(whole):
                continue
            assert isinstance(method, Maximiser)
            runs = [_prepared(method, run) for run, own in zip(whole, once, strict=True) if own]
            groups: dict[tuple[Any, ...], list[int]] = {}
            for k, run in enumerate(runs):  # one kernel serves those of one form, whose precisions are integrated alike
                groups.setdefault((_form(run), method.integration(run.problem, prior)), []).append(k)
            for (_, how), members in groups.items():
                chosen = [runs[k] for k in members]
                pieces = [(run.problem.model, _given(method, prior, run, name == ORACLE), run.start) for run in chosen]
                climb = method.climbs_under(prior)
                inside = how if how is not None and how.sweeps else None  # a propagation runs on the host
                solved = _solve(kernel(method), climb, inside, method.iterations, pieces)
                for j, k in enumerate(members):
                    state, mixed, count = solved[j]
                    problem = chosen[j].problem.with_mixing(state.mixing)
                    if how is not None and inside is None:
                        held = problem.first_precision(prior)
                        mixed = integrate(how, problem.model, held, state.point, jax.random.key(SEED))
                    course = Trace(*np.full((3, int(count)), np.nan))  # of a batch, which keeps none
                    answer = conclude(problem, method, prior, state, course, how, mixed)
                    found.append({"run": runs[k].number, "method": name} | _record(chosen[j], answer))
        if stored:
            first = next(record for record in found if record["run"] == numbers[0])
            first["problem"] = _number(whole[0].problem, whole[0].truth)
        return found


def _turned(names: list[str], by: int) -> list[str]:
    """Names from another one on: workers that begin with different methods each compile what the others then find."""
    return names[by % len(names) :] + names[: by % len(names)]


def _number(problem: Problem, truth: Truth) -> int:
    """A number that says what a problem and its truth are, not 0."""
    return int(problem_digest(problem, truth.biases)[:15], 16) + 1


def _simulated(setting: Setting, point: dict[str, Any], number: int, linear: bool) -> _Run:
    """One problem with its start; raises `InputError` where a setting does not return what a study needs."""
    problem, truth = _made(setting, point, number, linear)
    truth.check_targets(problem.measurements.target_names)
    return _Run(problem, truth, automatic_start(problem) if linear else None, number, _places(problem, truth))


def _places(problem: Problem, truth: Truth) -> list[np.ndarray]:
    """True positions (E, d) at the epochs of each recursion."""
    return [truth.positions(epochs.time, epochs.target, problem.network.dimension) for epochs in problem.epochs]


def _needs_linear(methods: Mapping[str, tuple[Method, Prior]]) -> bool:
    """True if some method asks for motions with a linear form."""
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
    """The record of an answer in a study, judged by the truth."""
    problem, found = answer.problem, answer.posterior.summary
    true = np.array([run.truth.biases[label] for label in problem.labels]) / problem.scales
    error, lower, upper = found.mean - true, found.lower - true, found.upper - true
    if problem.clocks.any():  # whose rows stand at other times
        run = run._replace(problem=problem, places=_places(problem, run.truth))
    return {
        "bias_rmse": float(np.sqrt(np.mean(error**2))),
        "coverage": float(((lower <= 0) & (upper >= 0)).mean()),
        "position_rmse": _position_rmse(run, answer.posterior.states),
        "status": str(answer.status), "ran": answer.method.name, "iterations": answer.iterations,
        "error": error, "true": true, "gamma": found.gamma, "sd": found.sd, "lower": lower, "upper": upper,
        "labels": problem.labels,
    }  # fmt: skip


def _climbs_once(method: Method, prior: Prior, run: _Run, oracle: bool) -> bool:
    """True if runs are solved together: not by samplers and particles, nor where a fit is more than one climb."""
    if not isinstance(method, Maximiser) or method.by_particles:
        return False
    return oracle or (method.climbs_once(run.problem, prior) and not run.problem.clocks.any())


def _alone_by(run: _Run, method: Method, prior: Prior) -> Answer:
    """The answer to a run that is solved by itself, as `fit` does it."""
    context = Context(jax.random.key(run.number), threads=1, fallback=NUTS())
    anew = method.by_particles or run.problem.clocks.any()
    return solve(run.problem, method, prior, context, start=None if anew else run.start)


def choose_methods(names: Sequence[str]) -> dict[str, tuple[Method, Prior]]:
    """Methods by their names on the command line; "oracle" is MAP that knows which biases are zero."""
    chosen = {}
    for name in names:
        check_method_installed(name)
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
    store: AnyPath | None = None,
    resume: bool = False,
    overwrite: bool = False,
    scheduler: Any = None,
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
    `store` is a folder that keeps finished fits as zarr (`load_study` reads them meanwhile), `resume` goes on with it,
    for more runs and settings too, `overwrite` replaces what it holds; an interruption changes no result.
    Where a fit is one climb, runs are solved in batches by compiled kernels: unlike `fit`, these do not look for the
    other side of a mirror, nor for a second optimum of integrated precisions. Others are solved as `fit` does it. All
    go on as many threads as there are processors; `scheduler` spreads them otherwise: "local" (processes of this
    machine), the address of a dask scheduler, or a `distributed.Client`. The numbers are the same, bit for bit, on
    processors of one kind.
    Raises `InputError` for an unknown method, settings whose biases differ and a folder that holds another study, and
    `FitError` where a cluster is lost on the way.
    """
    if not callable(setting):
        what = f"setting is of type {type(setting).__name__}"
        raise InputError(f"study: {what}; give a function setting(run, ...) that returns a problem and its truth")
    check_scheduler(scheduler)
    chosen = _pairs(methods) if isinstance(methods, Mapping) else choose_methods(methods)
    numbers = list(range(int(runs))) if isinstance(runs, (int, np.integer)) else [int(number) for number in runs]
    axes = {name: _values(name, values) for name, values in grid.items()}
    if not numbers or not chosen or not all(axes.values()):
        raise InputError("study: give at least one run, one method and one value of every setting")
    if len(set(numbers)) < len(numbers):
        raise InputError("study: a run is given twice; give every run once")
    made = {} if store is None else identity(list_of_methods=chosen)
    with Storage(store, "study", made, resume=resume, overwrite=overwrite) as storage:
        fits = open_fits(storage, axes, list(chosen), numbers)
        _check_model(fits, setting, storage.path)
        _fit_missing(fits, setting, axes, numbers, chosen, storage.path is not None, scheduler, progress)
    found = fits.dataset(axes, numbers)
    if store is not None:
        found.attrs["identity"] = storage.digest
    return found


def _fit_missing(
    fits: Fits, setting: Setting, axes: Mapping[str, list[Any]], numbers: list[int],
    methods: Mapping[str, tuple[Method, Prior]], stored: bool, scheduler: Any, progress: OnProgress | None,
) -> None:  # fmt: skip
    """Fit what is missing of a grid and runs."""
    wanted = set(numbers)
    points = [dict(zip(axes, values, strict=True)) for values in itertools.product(*axes.values())]
    blocks = [(point, [run for run in runs if run in wanted]) for point in points for runs in fits.missing(point)]
    batches = [(k, point, runs) for k, (point, runs) in enumerate(block for block in blocks if block[1])]
    total, monitor = len(points) * len(numbers) * len(methods), Monitor(progress)
    monitor.tell("fits", fits.count(axes, numbers), total)
    with closing(spread(partial(_batch, setting, methods, stored), batches, scheduler=scheduler)) as finished:
        for k, records in finished:
            fits.add(batches[k][1], records)
            monitor.tell("fits", fits.count(axes, numbers), total)


def _check_model(fits: Fits, setting: Setting, path: Path | None) -> None:
    """Raise `InputError` where a setting gives other problems than those that were fitted."""
    known = fits.problems()
    for point, run, number in known[:: -(-len(known) // CHECKED) or 1]:
        with jax.enable_x64(True):
            same = _number(*_made(setting, point, run, False)) == number
        if not same:
            raise InputError(
                f"{path}: setting(run={run}, ...) gives another problem than when the study there began:"
                " the model has changed; go on with it as it was, give another folder, or --overwrite"
                " (overwrite=True)"
            )
