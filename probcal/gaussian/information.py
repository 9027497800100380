"""Noise levels, mean square of the residuals, and rejected channels at a point."""

import jax
import jax.numpy as jnp
import numpy as np

from probcal import linalg
from probcal.gaussian import recursion as rec
from probcal.gaussian.draws import residuals
from probcal.gaussian.mode import Point, factors
from probcal.misfit import Rejected
from probcal.model.model import Data, Model, Recursion
from probcal.model.rows import families_at
from probcal.model.trajectories import States
from probcal.noise import HALF
from probcal.problem import Problem

STEPS = 3  # of the parameters of noise families between two modes: more change less than the next mode does
FARTHEST = 1.0  # of one step of a log level, as for noise levels: a guess may be a factor of several off
CHANCE = 1e-3  # probability that a sound fit rejects any channel of any sensor
# std beyond which a datum is not explained by a std that was declared too small
GROSS = 10.0


def rejected(problem: Problem, point: Point) -> list[Rejected]:
    """Channels of sensors whose gross error robust noise hides at a point, the most data first.

    Their fraction of data with less than half weight lies nearer to one than to the expected one,
    and beyond chance: by the binomial distribution, Bonferroni over the channels, with one datum
    less for each bias that the rows of the sensor read. The noise family says what is expected, or
    most sensors of the channel do where these data are not `GROSS`: its std is then too small.
    """
    from scipy import special

    model, sensors = problem.model, problem.network.sensors
    if not any(noise.rejects for noises in model.noises for noise in noises):
        return []
    owners = [problem.measurements.sensor[index] for index in problem.row_index]
    left, found = residuals(model, point), list[Rejected]()
    counts: dict[tuple[str, float], np.ndarray] = {}  # below half weight, of these not gross, all
    for b, block in enumerate(model.blocks):
        mask = np.asarray(model.measured[b])
        low = np.asarray(left.reliance[b]) < HALF * mask
        near = np.abs(left.innovation[b]) < GROSS * np.asarray(left.std[b])
        noises = families_at(block, np.asarray(point.levels))
        for c, (channel, noise) in enumerate(zip(problem.columns[b], noises, strict=True)):
            kinds = (low[:, c], low[:, c] & near[:, c], mask[:, c] > 0)
            each = np.stack([np.bincount(owners[b], kind, len(sensors)) for kind in kinds])
            counts[channel, noise.rejects] = each + counts.get((channel, noise.rejects), 0)
    counts = {key: each for key, each in counts.items() if key[1]}
    tests = sum(np.count_nonzero(each[2]) for each in counts.values())
    for (channel, expected), (below, mild, data) in counts.items():
        usual = np.quantile((mild / np.maximum(data, 1))[data > 0], 0.5, method="lower")
        expected = max(expected, float(usual))
        for k in np.flatnonzero(below > 0.5 * (1.0 + expected) * data):
            read = [own[owner == k] for own, owner in zip(model.read, owners, strict=True)]
            used = len({m for own in read for m in np.unique(own).tolist()} - {model.biases})
            n = max(int(data[k]) - used, 0)
            chance = special.bdtrc(int(below[k]) - used - 1, n, expected)
            if n and chance < CHANCE / tests:
                name = sensors[k].name
                found.append(Rejected(name, channel, int(below[k]), int(data[k]), expected))
    return sorted(found, key=lambda one: -one.below)


@np.errstate(over="ignore", invalid="ignore")  # an absurd point is far out, which its square says
def mean_square(model: Model, point: Point) -> float:
    """Squares of all data and whitened noises a datum: about 1 at most where the model is right."""
    parts = (*residuals(model, point).square, *map(np.square, point.noises)), model.measured
    squares, count = (sum(float(np.asarray(part).sum()) for part in own) for own in parts)
    return squares / max(count, 1.0)


def growing_square(model: Model, point: Point) -> float:
    """Mean square of the data whose std grows with the predicted value, 0 where there are none."""
    grown = [own.growing for own in model.blocks]
    if not any(grown):
        return 0.0
    pairs = list(zip(grown, residuals(model, point).square, model.measured, strict=True))
    square, count = (sum(float(np.asarray(pair[k])[:, list(pair[0])].sum()) for pair in pairs) for k in (1, 2))
    return square / max(count, 1.0)


def state_covariances(model: Model, point: Point) -> States:
    """Covariances (E, n, n) of every smoothed state at held biases, linearised at a point."""
    compressed = model.of_states(model.linearise(point, expected=True))

    def of(part: Recursion, own: tuple[jax.Array, jax.Array], used: tuple[int, ...]) -> jax.Array:
        L = factors(part, point.levels)
        return rec.covariances(part.F, L, rec.gains(part.F, L, own[0], used))[0]

    return model.each(of, compressed, map(model.entries, range(len(compressed))))


def update_levels(model: Model, point: Point, spread: Data, driven: States) -> Point:
    """One MacKay step of every unknown noise level, kept within its declared factor by its log-normal prior.

    A level sigma of N whitened residuals v solves N - sum Var v = sum v^2 (Paper B 25, for noise);
    the variances are those of predicted values (N, C) and of whitened noises (E, n). The trajectory
    stays; its whitened noises are rescaled.
    """
    H = point.levels.shape[0]
    count, square = model.by_level(model.measured), model.by_level(model.level_score(point))
    variance = model.by_level(jax.tree.map(jnp.multiply, model.information(point), spread))
    for part, u, own in model.each_layout(point.noises, driven):
        active = jnp.any(part.L != 0, 1)
        count = count.at[part.level].add(active)
        square = square.at[part.level].add(active * u**2)
        variance = variance.at[part.level].add(active * own)
    free = jnp.maximum(count - variance, 1e-3 * count + 1e-9)[:H]
    step = jnp.zeros(H)
    for _ in range(8):  # Newton: -free t - square/2 exp(-2 t) - (level + t)^2 / (2 spread^2) is concave
        pull = square[:H] * jnp.exp(-2 * step)
        gradient = -free + pull - (point.levels + step) / model.level_spread**2
        step = step + gradient / (2 * pull + 1 / model.level_spread**2)
    levels = point.levels + jnp.clip(step, -1.0, 1.0)
    if any(block.unknown for block in model.blocks):
        levels = _parameters(model, point._replace(levels=levels), spread, point.levels)
    return at_levels(model, point, levels)


def _parameters(model: Model, point: Point, spread: Data, before: jax.Array) -> jax.Array:
    """Log levels (H,) after steps of those that are parameters of noise families, from `before`, by scoring.

    `spread` is the variance of the predicted values (see `waist.parameter_score`).
    """
    H, predicted = before.shape[0], model.predict(point)

    def step(_: int, levels: jax.Array) -> jax.Array:
        slope, information, chosen = model.parameter_score(predicted, levels, spread)
        there = chosen[:H] > 0
        matrix = jnp.where(there[:, None] & there[None], information[:H, :H], 0.0) + jnp.diag(model.level_spread**-2.0)
        move = linalg.solve_positive(matrix, jnp.where(there, slope - levels / model.level_spread**2, 0.0)[:, None])
        return levels + jnp.clip(move[:, 0], -FARTHEST, FARTHEST)

    numbers = np.array(sorted({n for own in model.blocks for p in own.unknown for n in p.number}))
    start = point.levels.at[numbers].set(before[numbers])
    return jax.lax.fori_loop(0, STEPS, step, start)


def at_levels(model: Model, point: Point, levels: jax.Array) -> Point:
    """The same trajectories and biases at other noise levels: the whitened noises are rescaled."""
    xp = linalg.library(*jax.tree.leaves((model, point, levels)))
    point, levels = jax.tree.map(xp.asarray, (point, levels))
    ratio = xp.append(xp.exp(point.levels - levels), 1.0)
    noises = model.each(lambda part, u: u * ratio[xp.asarray(part.level)], point.noises)
    return point._replace(levels=levels, noises=noises)
