"""Any problem of linear motion by GTSAM: the same rows, priors, motion and start, with robust (Huber) noise.

Variables are the biases of each owner (in their scales) and the state of each epoch; motion is a linear Gaussian factor
of full covariance, every datum a `CustomFactor` whose residual and Jacobian come from `problem.model.linearise`. GTSAM
learns no noise: every std is the declared one, or the guess of an unknown one; biases have the Gaussian of their scale.
"""

import time
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

import probcal as pc
from probcal.gaussian.mode import Point, factors
from probcal.model.model import At, Model

HUBER = 1.345  # sds up to which a datum counts in full
ITERATIONS, TOLERANCE, DAMPING = 200, 1e-6, 1e8  # of Levenberg-Marquardt
OFF, FAR = 3.0, 100.0  # median residual in sds, and biases in scales, beyond which an answer is none


class RefusedError(ValueError):
    """What the adapter cannot put to GTSAM, in one sentence."""


@dataclass(frozen=True)
class Found:
    """What GTSAM found: states (E, n) of each recursion, biases z (M,), their sds, seconds, how it ended."""

    states: tuple[np.ndarray, ...]
    z: np.ndarray
    sd: np.ndarray | None
    seconds: float
    status: str


@dataclass(frozen=True)
class Place:
    """The variable that holds a state: its key (None: nothing of it is free), free entries, what the others are."""

    key: int | None
    free: np.ndarray
    fixed: np.ndarray


@jax.jit
def evaluated(model: Model, at: At) -> tuple[Any, Any, Any]:
    """Innovations, noise stds and Jacobians by state and bias of every block."""
    lins = model.linearise(at, expected=False)
    return model.innovation(at), model.noise_std(at.levels), tuple((lin.state, lin.bias) for lin in lins)


class Rows:
    """All rows at the values last asked for: a datum whose own variables are those of the last call reuses it."""

    def __init__(self, model: Model, places: list[list[Place]], owners: dict[int, np.ndarray], levels: Any) -> None:
        self.model, self.places, self.owners, self.levels = model, places, owners, levels
        self.seen: dict[int, bytes] = {}
        self.calls = 0

    def read(self, values: Any) -> tuple[tuple[np.ndarray, ...], np.ndarray]:
        """States (E, n) of each recursion and biases (M,) of GTSAM's values."""
        states = []
        for own in self.places:
            x = np.stack([place.fixed for place in own])
            for k, place in enumerate(own):
                if place.key is not None:
                    x[k, place.free] = values.atVector(place.key)
            states.append(x)
        z = np.zeros(self.model.biases)
        for key, members in self.owners.items():
            z[members] = values.atVector(key)
        return tuple(states), z

    def look(self, values: Any, keys: list[int]) -> None:
        """Evaluate every row, unless these variables are as they were."""
        if all(self.seen.get(key) == values.atVector(key).tobytes() for key in keys):
            return
        states, z = self.read(values)
        with jax.enable_x64(True):
            found = jax.device_get(evaluated(self.model, At(states, z, self.levels)))
        self.innovation, self.std, self.jacobians = found
        self.seen = {key: values.atVector(key).tobytes() for key in values.keys()}  # noqa: SIM118
        self.calls += 1


def placed(problem: pc.Problem) -> list[list[Place]]:
    """The variable of every epoch of each recursion; a state that rests shares the one before."""
    from gtsam import symbol

    found, number = [], 0
    for part in problem.model.recursions:
        F, L, drift = (np.asarray(a) for a in (part.F, part.L, part.drift))
        own: list[Place] = []
        for k in range(len(F)):
            if not L[k].any() and not drift[k].any() and np.array_equal(F[k], np.eye(len(F[k]))):
                own.append(own[-1])
                continue
            free = np.flatnonzero(F[k].any(1) | L[k].any(1))
            own.append(Place(symbol("x", number) if len(free) else None, free, drift[k].copy()))
            number += 1
        found.append(own)
    return found


def solve(problem: pc.Problem, start: Point) -> Found:
    """Levenberg-Marquardt from a start, then the marginals of the biases. Raises `RefusedError`."""
    import gtsam
    from gtsam import noiseModel, symbol

    model, levels = problem.model, np.zeros(len(problem.levels))
    if problem.scans is not None:
        raise RefusedError("its detections name no target, and a graph of factors needs to know whose each is")
    if model.tailed:
        raise RefusedError("its motion is not Gaussian")
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    places, states = placed(problem), [np.asarray(x) for x in start.states]
    for r, (part, own) in enumerate(zip(model.recursions, places, strict=True)):
        with jax.enable_x64(True):
            F, L, drift = (np.asarray(a) for a in (part.F, factors(part, levels), part.drift))
        for k, place in enumerate(own):
            if place.key is None or (k and own[k - 1] is place):
                continue
            free = place.free
            covariance = (L[k] @ L[k].T)[np.ix_(free, free)]
            spread = np.sqrt(np.diag(covariance))
            if not spread.all() or np.linalg.eigvalsh(covariance / np.outer(spread, spread))[0] < 1e-12:
                raise RefusedError("the noise of its motion is singular")
            at = gtsam.Values()
            at.insert(place.key, states[r][k, free])
            values.insert(place.key, states[r][k, free])
            root = np.linalg.inv(np.linalg.cholesky(covariance))
            terms, off = [place.key, root], drift[k, free] - states[r][k, free]
            before = own[k - 1] if k else place
            if F[k].any():
                off = off + (F[k] @ states[r][k - 1])[free]
                if before.key is not None:
                    at.insert(before.key, states[r][k - 1, before.free])
                    terms += [before.key, -root @ F[k][np.ix_(free, before.free)]]
            linear = gtsam.JacobianFactor(*terms, root @ off, noiseModel.Unit.Create(len(free)))
            graph.add(gtsam.LinearContainerFactor(linear, at))
    names = [bias.owner for bias in problem.biases]
    owners = {symbol("b", n): np.flatnonzero(np.array(names) == owner) for n, owner in enumerate(dict.fromkeys(names))}
    for key, members in owners.items():
        values.insert(key, np.asarray(start.z)[members])
        graph.add(gtsam.PriorFactorVector(key, np.zeros(len(members)), noiseModel.Isotropic.Sigma(len(members), 1.0)))
    rows = Rows(model, places, owners, levels)
    for factor in _data(problem, rows, levels):
        graph.add(factor)

    begun = time.perf_counter()
    settings = gtsam.LevenbergMarquardtParams()
    settings.setMaxIterations(ITERATIONS)
    settings.setRelativeErrorTol(1e-9)
    settings.setAbsoluteErrorTol(TOLERANCE)
    settings.setlambdaUpperBound(DAMPING)
    if not np.isfinite(graph.error(values)):
        raise RefusedError("the start has no finite cost")
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, settings)
    found = optimizer.optimize()
    status = _ended(optimizer, graph.error(found))
    states, z = rows.read(found)
    sd = None
    try:
        marginals, sd = gtsam.Marginals(graph, found), np.zeros(len(z))
        for key, members in owners.items():
            sd[members] = np.sqrt(np.diag(marginals.marginalCovariance(key)))
        if not np.isfinite(sd).all():
            sd, status = None, f"{status}; its marginals are not finite"
    except RuntimeError as error:
        said = "are singular" if "ndeterminant" in str(error) else f"fail: {str(error).splitlines()[0]}"
        sd, status = None, f"{status}; its marginals {said}"
    seconds = time.perf_counter() - begun
    rows.look(found, list(found.keys()))
    pairs = zip(rows.innovation, rows.std, model.measured, strict=True)
    off = np.concatenate([np.abs(np.asarray(y) / s)[np.asarray(m) > 0] for y, s, m in pairs])
    if len(z) and np.abs(z).max() > FAR:
        status = f"diverged: a bias of {np.abs(z).max():.0f} scales"
    elif np.median(off) > OFF:
        status = f"misfit: half of the data lie {np.median(off):.1f} sds off or more"
    return Found(states, z, sd, seconds, status)


def _ended(optimizer: Any, error: float) -> str:
    """How Levenberg-Marquardt ended, in words."""
    if not np.isfinite(error):
        return "diverged: its cost is not finite"
    if optimizer.iterations() >= ITERATIONS:
        return f"not converged: {ITERATIONS} iterations spent"
    if optimizer.lambda_() >= DAMPING:
        return "not converged: no step lowers the cost at the largest damping"
    return "converged"


def _data(problem: pc.Problem, rows: Rows, levels: np.ndarray) -> Any:
    """A factor of GTSAM for every datum that was measured."""
    import gtsam
    from gtsam import noiseModel

    model, huber = problem.model, noiseModel.mEstimator.Huber.Create(HUBER)
    holder = np.zeros(model.biases, np.int64)
    within = np.zeros(model.biases, int)
    for key, members in rows.owners.items():
        holder[members], within[members] = key, np.arange(len(members))
    with jax.enable_x64(True):
        stds = model.noise_std(levels)
    for b, (block, data, r) in enumerate(zip(model.blocks, model.rows, model.recursion, strict=True)):
        epoch, read, mask = np.asarray(data.epoch), model.read[b], np.asarray(data.mask)
        for n, c in zip(*np.nonzero(mask), strict=True):
            place = rows.places[r][epoch[n]]
            used = [(u, int(np.searchsorted(place.free, e))) for u, e in enumerate(block.used) if e in place.free]
            own = [(p, int(holder[m]), int(within[m])) for p, m in enumerate(read[n]) if m < model.biases]
            keys = ([place.key] if place.key is not None and used else []) + list(dict.fromkeys(k for _, k, _ in own))
            if not keys:
                continue
            sizes = [len(place.free) if key == place.key else len(rows.owners[key]) for key in keys]
            noise = noiseModel.Robust.Create(huber, noiseModel.Isotropic.Sigma(1, float(stds[b][n, c])))
            call = _residual(rows, (b, int(n), int(c)), keys, sizes, used if keys[0] == place.key else [], own)
            yield gtsam.CustomFactor(noise, keys, call)


def _residual(rows: Rows, where: tuple[int, int, int], keys: list[int], sizes: list[int], used: list, own: list) -> Any:
    """The error function of one datum: predicted less measured, and its Jacobians."""
    b, n, c = where
    at = {key: k for k, key in enumerate(keys)}

    def call(factor: Any, values: Any, H: Any) -> np.ndarray:
        rows.look(values, keys)
        if H is not None:
            parts = [np.zeros((1, size)) for size in sizes]
            by_state, by_bias = rows.jacobians[b]
            for u, column in used:
                parts[0][0, column] += by_state[n, c, u]
            for p, key, column in own:
                parts[at[key]][0, column] += by_bias[n, c, p]
            for k, part in enumerate(parts):
                H[k] = part
        return np.array([-rows.innovation[b][n, c]])

    return call
