"""Maps of the position bound: how well one snapshot of a network locates a target, cell by cell of an area."""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import xarray as xr

from probcal import linalg
from probcal.errors import InputError, nearest
from probcal.gaussian.mode import factors
from probcal.inference.fitted import take_up
from probcal.labels import AXES, NOBODY
from probcal.linalg import root_of
from probcal.model.model import At, Data, Model
from probcal.problem import Problem, check_linear
from probcal.results.blocks import SensorBlocks
from probcal.results.read import apply
from probcal.simulate import blank
from probcal.types import float64

BATCH = (256, 200_000)  # cells worked on at once, and entries of their matrices
LOST = 1e-13  # share of the information of a position below which a direction counts as open
APART = (
    "The covariance between the biases of different sensors is left out: the fit holds that of each"
    " sensor. Fit fewer sensors, or give the problem as it was fitted."
)


@float64
def bound_map(
    problem: Problem,
    area: Sequence[Sequence[float]],
    *,
    cells: int | tuple[int, int] = 100,
    biases: str | xr.DataTree = "known",
    z: float | None = None,
    target: str | None = None,
    time: float | None = None,
) -> xr.Dataset:
    """Position bound over an area ((x0, x1), (y0, y1)) in m, every placed sensor seeing the target once.

    The position is free; every further state component has its start as prior (its mean is where it is evaluated).
    `biases` are `"known"` (the stated values), `"unknown"` (marginalised with one scale or their survey) or a fit:
    its means with its covariance. Of a large fit that of all is found anew from its `problem`;
    above 600 biases, or of another table, sensors count as independent: attribute `note` says so.
    `cells` along x and y, `z` the height in m of a 3-D map, `target` whose motion is taken (the
    first), `time` at which moving nodes are met (the first).

    Variables over (y, x): `rmse` = sqrt tr J^-1 in m (thesis 4.4.2, RSS paper 22-23), `trace` and `smallest` eigenvalue
    of the information J in 1/m^2 (RSS paper 20-21), `determined`. A bound beyond the diagonal of the area is no
    position in it: there, as where J is singular, `rmse` is the diagonal and `determined` is False. Also
    `node_position` (node, axis). Raises `InputError` for an area, cells, biases, target or time that cannot be used.

    >>> bound_map(problem, ((-50, 250), (0, 150)), cells=(6, 3))["rmse"].shape
    (3, 6)
    """
    x, y = _axes(area, cells)
    d = problem.network.dimension
    if (z is None) == (d == 3):
        raise InputError(f"bound_map: the network is {d}-D; {'give the height z' if d == 3 else 'leave z out'}")
    at = snapshot(problem, target, time)
    M = len(at.labels)
    mean, levels = np.zeros(M), np.zeros(len(at.levels))
    spread = None
    if isinstance(biases, xr.DataTree):
        if not {"calibration", "constant_data"} <= set(biases.children):
            raise InputError("bound_map: the tree of biases has no group calibration; give the result of fit()")
        found = apply(at, biases)
        at, mean, levels = found.problem, found.z, found.levels
        spread = _coupled(problem, biases, at.labels, found.spread)
    elif biases == "unknown":
        spread = SensorBlocks(M, np.arange(M)[:, None], np.ones((M, 1, 1)))
    elif biases != "known":
        raise InputError(f'bound_map: biases is {biases!r}; give "known", "unknown" or the result of fit()')
    flat = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    places = flat if z is None else np.column_stack([flat, np.full(len(flat), float(z))])
    span = at.epochs[0].position
    point = At((), jnp.asarray(mean), jnp.asarray(levels))
    blocks = None if spread is None else BiasBlocks.of(at.model, spread)
    values = np.asarray(spectra(at.model, span, point, blocks, jnp.asarray(places)))
    with np.errstate(divide="ignore"):
        rmse = np.sqrt((1.0 / values).sum(1))
    largest = float(np.hypot(*np.ptp(np.asarray(area, float), axis=1)))
    variables = {
        "rmse": np.minimum(rmse, largest), "determined": rmse < largest,
        "trace": values.sum(1), "smallest": values[:, 0],
    }  # fmt: skip
    drawn = xr.Dataset(
        {name: (("y", "x"), value.reshape(len(y), len(x))) for name, value in variables.items()}
        | {"node_position": (("node", "axis"), _nodes(at, mean))},
        coords={"x": x, "y": y, "node": [n.name for n in at.network.nodes], "axis": list(AXES[:d])},
        attrs={"biases": biases if isinstance(biases, str) else "fitted", "target": at.measurements.target_names[0]},
    )
    if spread is not None and not spread.whole and drawn.attrs["biases"] == "fitted":
        drawn.attrs["note"] = APART
    return drawn if z is None else drawn.assign_coords(z=float(z))


def _coupled(problem: Problem, fit: xr.DataTree, labels: Any, spread: SensorBlocks) -> SensorBlocks:
    """The covariance of all biases: the sds of a fit, its correlations where it ended.

    That of each sensor alone where these are not to be had.
    """
    if spread.whole:
        return spread
    try:
        own = take_up(problem, fit)
    except InputError:  # a problem of other data
        return spread
    information = own.expansion.information()
    if information is None:
        return spread
    order = np.array([problem.labels.index(label) for label in labels])
    whole = linalg.invert(information + own.factors.matrix(len(information)))
    covariance = whole[order[:, None], order]
    wide = np.sqrt(spread.variance / np.diagonal(covariance))
    return SensorBlocks.of(covariance).widened(wide)


def _axes(area: Sequence[Sequence[float]], cells: int | tuple[int, int]) -> list[np.ndarray]:
    """Centres of the cells along x and y."""
    sides = np.asarray(area, float)
    if sides.shape != (2, 2) or not np.isfinite(sides).all() or not (sides[:, 0] < sides[:, 1]).all():
        raise InputError(f"bound_map: area is {area!r}; give ((x0, x1), (y0, y1)) in m with x0 < x1 and y0 < y1")
    counts = np.broadcast_to(np.asarray(cells), 2)
    if not np.issubdtype(counts.dtype, np.integer) or (counts < 1).any():
        raise InputError(f"bound_map: cells is {cells!r}; give a positive number, or one along x and one along y")
    return [a + (b - a) * (np.arange(n) + 0.5) / n for (a, b), n in zip(sides, counts, strict=True)]


def _nodes(at: Problem, z: np.ndarray) -> np.ndarray:
    """The positions (nodes, d) of the nodes of a snapshot, with their biases z (M,) added."""
    found = []
    shift = at.fixed | dict(zip(at.labels, z * at.scales, strict=True))
    for record in at.network.biases:
        if record.since is not None and record.since <= at.measurements.time[0]:
            constant = record.label.rpartition("@")[0]
            shift[constant] = shift.get(constant, 0.0) + shift[record.label]
    for node in at.network.nodes:
        place = node.position if node.path is None else node.path.at(at.measurements.time[:1])["position"][0]
        found.append([p + shift.get(f"{node.name}.position_{a}", 0.0) for p, a in zip(place, AXES, strict=False)])
    return np.array(found)


def snapshot(problem: Problem, target: str | None = None, time: float | None = None) -> Problem:
    """The problem of one instant, the first of the table by default: every placed sensor sees one target once."""
    names, motion = problem.measurements.target_names, problem.motion
    name = next(iter(problem.targets), NOBODY) if target is None else str(target)
    if name == NOBODY:
        raise InputError("no row has a target, so there is no position to map: name a target and give its motion")
    if name not in (motion if isinstance(motion, Mapping) else names):
        raise InputError(f'there is no target "{name}"{nearest(name, names)}')
    instant = float(problem.measurements.time.min() if time is None else time)
    rows = {"time": instant, "sensor": [s.name for s in problem.network.sensors]}
    table = blank(problem.network, pd.DataFrame(rows).assign(target=name))
    check_linear(found := Problem(problem.network, motion, table, fix=problem.fixed))
    return found


class BiasBlocks(NamedTuple):
    """The biases in blocks of which no row and no covariance couples two."""

    root: np.ndarray  # (B, p, p) of the covariance of each
    block: Data  # (N,) that each row reads
    place: Data  # (N, q) of each bias that it reads in there, p of none

    @classmethod
    def of(cls, model: Model, spread: SensorBlocks) -> "BiasBlocks":
        """The blocks of a model whose biases have a covariance."""
        M, reads = model.biases, [np.asarray(own) for own in model.read]
        least, before = np.arange(M + 1), np.zeros(0, int)
        while not np.array_equal(least, before):
            before = least.copy()
            for own in (*reads, spread.members):
                np.minimum.at(least, own, least[own].min(1, initial=M)[:, None])
                least[M] = M
        numbers, block = np.unique(least[:M], return_inverse=True)
        sizes = np.bincount(block, minlength=len(numbers))
        if len(sizes) * int(sizes.max(initial=0)) ** 2 > M**2:
            # padded they would take more memory than one matrix of all
            block, sizes = np.zeros(M, int), np.array([M])
        order = np.argsort(block, kind="stable")
        place = np.zeros(M, int)
        place[order] = np.arange(M) - np.repeat(np.cumsum(sizes) - sizes, sizes)
        p = int(sizes.max(initial=0))
        block, place = np.append(block, 0), np.append(place, p)
        covariance, at = np.zeros((len(sizes), p + 1, p + 1)), place[spread.members]
        number = block[spread.members].max(1, initial=0)[:, None, None]
        covariance[number, at[:, :, None], at[:, None, :]] = spread.covariance
        return cls(
            root_of(covariance[:, :p, :p]),
            tuple(block[own].max(1, initial=0) for own in reads),
            tuple(place[own] for own in reads),
        )


@partial(jax.jit, static_argnames="span")
def spectra(model: Model, span: tuple[int, int], point: At, biases: BiasBlocks | None, places: jax.Array) -> jax.Array:
    """Eigenvalues (cells, d) of the information about the position at places (cells, d).

    The biases are known if None.

    What else is unknown is v = V e with e of unit covariance: A - C V (I + V'BV)^-1 V'C', with A, C and B the
    information of the position, with v and of v; the biases first, block by block. No covariance is
    inverted, so that any of them may be singular.
    """
    part, place = model.recursions[0], slice(*span)
    own = factors(part, point.levels)[0].at[place].set(0.0)

    def cell(position: jax.Array) -> jax.Array:
        states = (part.drift.at[0, place].set(position),)
        lins = model.linearise(point._replace(states=states), expected=True)
        J = known = model.of_states(lins)[0][0][0]
        if biases is not None:
            B, p, _ = biases.root.shape
            G, cross = jnp.zeros((B, p + 1, p + 1)), jnp.zeros((B, len(J), p + 1))
            for block, _, _, lin, b, at in model.each_block(lins, biases.block, biases.place):
                weighed, used = lin.weight[:, :, None] * lin.bias, np.asarray(block.used, int)
                b, at = b[:, None, None], at[:, None, :]
                G = G.at[b, at.mT, at].add(lin.bias.mT @ weighed)
                cross = cross.at[b, used[:, None], at].add(lin.state.mT @ weighed)
            G = biases.root.mT @ G[:, :p, :p] @ biases.root + jnp.eye(p)[None]
            half = jax.vmap(linalg.factor_and_inverse)(G)[1] @ (cross[:, :, :p] @ biases.root).mT
            J = J - jnp.einsum("bpn,bpm->nm", half, half)
        half = linalg.factor_and_inverse(own.T @ J @ own + jnp.eye(len(J)))[1] @ (J[place] @ own).T
        left = J[place, place] - half.T @ half
        values, _ = linalg.spectrum(0.5 * (left + left.T))
        return jnp.where(values > LOST * jnp.trace(known[place, place]), values, 0.0)

    size = len(own) ** 2 if biases is None else len(own) ** 2 + biases.root.size
    return jax.lax.map(cell, places, batch_size=max(1, min(BATCH[0], BATCH[1] // size)))
