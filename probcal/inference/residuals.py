"""Normalised innovations of the forward filter at a fit, with limits; whiteness.

Every datum counts as its standardised score v = score / sqrt(information): for Gaussian noise residual / std, and for
every family of mean 0 and variance 1 where the model is right. The filter is linearised at the fitted trajectory.
The innovations of an epoch are whitened by the symmetric root of their covariance, so that none comes first: their
squares add up to the NIS of the epoch, and each stays with its sensor and channel.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal import linalg
from probcal.gaussian import recursion as rec
from probcal.gaussian.mode import Eliminated, Point, factors
from probcal.inference.fitted import Judged
from probcal.lazy import Later
from probcal.model.model import Data, Model, Recursion
from probcal.model.rows import Linearised, standardised
from probcal.noise import Bernoulli, Normal

if TYPE_CHECKING:
    import pandas as pd
    from scipy import special
else:
    special = Later("scipy.special")

PRACTICAL = 1.25  # factor from 1 within which a NIS beyond its limits is no finding
# sd of its lag-1 correlation from which a channel is called correlated, next to its Ljung-Box test
LAGGED = 2.5
NOTABLE = 0.1  # lag-1 correlation, and mean, of innovations within which neither is
LAGS = 10  # of the Ljung-Box statistic
LONGEST = 200  # lags over which a correlation in time is followed
FEWEST = 20  # data below which whiteness is not judged


def codes(frame: pd.DataFrame, names: list[str]) -> tuple[np.ndarray, pd.DataFrame]:
    """Number of each datum's group (D,), in order of appearance, and one row a group."""
    group = frame.groupby(names, sort=False).ngroup().to_numpy()
    return group, frame[names].drop_duplicates().reset_index(drop=True)


class Filter(NamedTuple):
    """The covariance pass of one recursion, for any columns of data."""

    gain: rec.Gains
    mix: jax.Array  # (E, n, n) root V g V' root', S^-1/2 - I between data of an epoch


class Innovations(NamedTuple):
    """Of every datum: its innovation, N(0, 1) under the model, and what is needed to judge sums of squares."""

    value: np.ndarray  # (D,)
    used: np.ndarray  # (D,) degrees of freedom that the biases took
    kurtosis: np.ndarray  # (D,) excess over a Gaussian's
    expected: np.ndarray  # (D,) of its square: 1, less where a row has a weight below one

    @property
    def excess(self) -> float:
        """Sum of squares of all above what is expected of it."""
        return float(np.sum(self.value**2 - self.expected + self.used))

    def spread(self, mine: Any) -> float:
        """Mean square of some of them over what is expected."""
        return float(np.sum(self.value[mine] ** 2) / max(np.sum(self.expected[mine]), 1e-300))


def expected_squares(fit: Judged, kept: np.ndarray) -> np.ndarray:
    """Expected square of every innovation (D,); `kept` is the fraction of the datum's own noise in
    it.

    A row of weight w counts as if its noise had the variance 1 / w, but scatters as declared.
    """
    found: np.ndarray = 1.0 - (1.0 - fit.flat(fit.problem.model.measured)) * kept**2
    return found


def prepare(solved: Eliminated) -> list[Filter]:
    """Covariance pass of every recursion: with U the data's responses to the whitened prediction, S = I + U U'."""
    found = []
    for kept in solved.parts:
        gain = jax.tree.map(np.asarray, kept.gain)
        vectors, values, _ = linalg.singular(gain.predicted.mT @ gain.data)
        size = np.sqrt(1.0 + values**2)
        half = gain.predicted @ vectors
        found.append(Filter(gain, (half * (-1.0 / (size * (1.0 + size)))[:, None, :]) @ half.mT))
    return found


def _whiten(
    model: Model,
    lins: Sequence[Linearised],
    filters: list[Filter],
    columns: Sequence[jax.Array],
    drifts: list[jax.Array],
) -> Data:
    """Innovations (N, C, K) of columns of unit-noise data (N, C, K) with drifts (E, n, K) of the states."""
    unit = [lin._replace(state=jnp.sqrt(lin.weight)[:, :, None] * lin.state) for lin in lins]
    pulls = model.onto_states(unit, columns)

    def corrected(part: Recursion, known: Filter, pull: jax.Array, drift: jax.Array) -> jax.Array:
        found = rec.predict(part.F, known.gain, pull, drift)
        # what S^-1/2 takes off each datum
        return found.states - known.mix @ (known.gain.data @ found.innovation)

    return jax.tree.map(jnp.subtract, columns, model.by_state(unit, model.each(corrected, filters, pulls, drifts)))


@jax.jit
def _innovations(
    model: Model,
    point: Point,
    lins: Sequence[Linearised],
    filters: list[Filter],
    shift: list[jax.Array],
    root: jax.Array,
) -> list[tuple[jax.Array, jax.Array, jax.Array]]:
    """Of each block: innovations with the predictions moved by `shift` (N, C), the sum of squares of their responses to
    bias directions `root` (M, K), and the share of itself that S^-1/2 leaves a datum; each (N, C)."""
    columns = []
    for lin, moved, along in zip(lins, shift, model.by_bias(lins, root), strict=True):
        size = jnp.sqrt(lin.weight)[:, :, None]
        left = standardised(lin.score, lin.weight)[:, :, None] - size * moved[:, :, None]
        columns.append(jnp.concatenate([left, size * along], 2))
    mixed = model.state_variance(lins, [known.mix for known in filters])
    kept = [1.0 + lin.weight * own for lin, own in zip(lins, mixed, strict=True)]
    drifts = [
        jnp.pad(-(factors(part, point.levels) @ u[:, :, None]), ((0, 0), (0, 0), (0, root.shape[1])))
        for part, u in model.each_layout(point.noises)
    ]
    white = _whiten(model, lins, filters, tuple(columns), drifts)
    return [(c[:, :, 0], jnp.sum(c[:, :, 1:] ** 2, 2), k) for c, k in zip(white, kept, strict=True)]


class Filtered(NamedTuple):
    """The filters of a fit, its innovations, and the bias directions (M, K) behind their degrees of freedom."""

    filters: list[Filter]
    innovations: Innovations
    roots: list[jax.Array]


def all_gaussian(model: Model) -> bool:
    """True where the noise of every channel is Gaussian."""
    return all(isinstance(noise, Normal) for noises in model.noises for noise in noises)


def exact_kurtosis(fit: Judged, kurtosis: np.ndarray) -> np.ndarray:
    """Excess kurtosis (D,), that of yes-or-no data in closed form, 1 / (p q) - 6: replicas may lack
    a rare event."""
    answers = [
        np.broadcast_to([isinstance(channel.noise, Bernoulli) for channel in block.channels], lin.weight.shape)
        for block, _, _, lin in fit.problem.model.each_block(fit.lins)
    ]
    variance = fit.flat([lin.weight for lin in fit.lins])
    return np.maximum(np.where(fit.flat(answers), 1 / np.maximum(variance, 1e-12) - 6, kurtosis), -2.0)


def measured_kurtosis(fit: Judged) -> np.ndarray:
    """Excess kurtosis (D,) of the standardised scores, measured over the data of each sensor's
    channel."""
    if all_gaussian(fit.problem.model):
        return np.zeros(len(fit.data))
    value = fit.flat([standardised(lin.score, lin.weight) for lin in fit.lins])
    group, _ = codes(fit.data, ["sensor", "channel"])
    second, fourth = (np.bincount(group, value**k) / np.bincount(group) for k in (2, 4))
    return exact_kurtosis(fit, (fourth / np.maximum(second**2, 1e-300))[group] - 3.0)


def innovations(fit: Judged, kurtosis: np.ndarray, dz: np.ndarray | None = None) -> Filtered:
    """Innovations of all data with the biases `dz` (M,) from their means, for noise of excess
    kurtosis (D,).

    A sum of squares over some data expects their number less what the biases used: over all data the sum of gamma,
    over a share of them the trace of B (G + A)^-1 B', B their responses to the biases. Where the covariance of all
    biases is not held the sum is shared among the data by the variance that the biases of the own sensor give each.
    """
    model = fit.problem.model
    filters, roots = prepare(fit.expansion.eliminated), fit.roots
    shift = moved_predictions(fit, np.zeros(model.biases) if dz is None else dz)
    found = [_innovations(model, fit.point, fit.lins, filters, shift, part) for part in roots]
    value, _, kept = (fit.flat(parts) for parts in zip(*found[0], strict=True))
    used = np.sum([fit.flat([own for _, own, _ in part]) for part in found], axis=0)
    shared = fit.shared()
    return Filtered(
        filters,
        Innovations(value, used if shared is None else shared, kurtosis * kept**4, expected_squares(fit, kept)),
        roots,
    )


def moved_predictions(fit: Judged, dz: np.ndarray) -> list[jax.Array]:
    """By how much biases moved by dz (M,) move the predictions (N, C) of each block, tracks held."""
    padded, model = np.append(dz, 0.0), fit.problem.model
    parts = model.each_block(fit.lins, model.read)
    return [jax.device_put(np.einsum("ncp,np->nc", lin.bias, padded[read])) for *_, lin, read in parts]


def moved_innovations(fit: Judged, known: Filtered, shift: list[jax.Array]) -> np.ndarray:
    """Innovations (D,) with the predictions of each block moved by `shift` (N, C)."""
    model = fit.problem.model
    found = _innovations(model, fit.point, fit.lins, known.filters, shift, known.roots[0])
    return fit.flat([value for value, _, _ in found])


class Squares(NamedTuple):
    """Mean square of the innovations of groups of data, each (groups,): NIS per datum and its limits."""

    data: np.ndarray
    nis: np.ndarray
    lower: np.ndarray
    upper: np.ndarray


def squares(found: Innovations, group: Any, count: int, rate: float) -> Squares:
    """Sums of squares by group (D,) over what they expect, with two-sided limits at a false-alarm rate each.

    The limits are those of a scaled chi-square of the right mean and variance (exact for Gaussian noise); a group that
    has less than one degree of freedom is not judged.
    """
    group = np.asarray(group)
    data, total, used, kurtosis = (
        np.bincount(group, weight, count)
        for weight in (np.ones(len(group)), found.value**2, found.used, found.kurtosis * found.expected**2)
    )
    whole, second = (np.maximum(np.bincount(group, found.expected**k, count), 1e-300) for k in (1, 2))
    expected = np.maximum(whole - used, 1e-9)
    variance = np.maximum(2.0 * expected * second / whole + kurtosis, 1e-9 * expected)
    scale, freedom = variance / (2.0 * expected), 2.0 * expected**2 / variance
    lower, upper = (scale * special.chdtri(freedom, p) / expected for p in (1 - rate / 2, rate / 2))
    judged = freedom >= 1.0  # below, as with events that hardly ever happen, there is no limit
    light = whole < data * (1.0 - 1e-9)  # rows with a weight tell each other less than they scatter
    lower, upper = np.where(judged & ~light, lower, 0.0), np.where(judged, upper, np.inf)
    return Squares(data.astype(int), total / expected, lower, upper)


def enough(kurtosis: np.ndarray) -> bool:
    """True where data of this excess kurtosis (n,) inform a mean as 20 Gaussian ones do a variance."""
    return bool(2.0 * len(kurtosis) >= FEWEST * (2.0 + np.mean(kurtosis)))


class Whiteness(NamedTuple):
    """Of one sensor's channel: lag-1 correlation of its innovations, mean, and Ljung-Box p-value."""

    autocorrelation: float
    mean: float
    probability: float


def _correlations(value: np.ndarray, target: np.ndarray, time: np.ndarray, lags: int) -> tuple[np.ndarray, np.ndarray]:
    """Autocorrelations (lags,) of values in the order of time about their mean, and the pairs behind each.

    Pairs lie within a target.
    """
    order = np.lexsort((time, target))
    value, target = value[order] - value.mean(), target[order]
    together = [target[lag:] == target[:-lag] for lag in range(1, lags + 1)]
    pairs = np.array([same.sum() for same in together])
    sums = [np.sum(value[k + 1 :] * value[: -k - 1] * same) for k, same in enumerate(together)]
    return np.array(sums) / np.maximum(pairs, 1) / max(float(np.mean(value**2)), 1e-300), pairs


def whiteness(value: np.ndarray, target: np.ndarray, time: np.ndarray) -> Whiteness | None:
    """Whiteness of the innovations (n,) of one channel; None where there are too few.

    Ljung and Box (1978), Q = sum of n_k r_k^2 (n + 2) / n over m lags, at most 10, n_k the pairs at lag k. Of few data
    the variance of Q is larger than the 2 m of its chi-square (Davies, Triggs, Newbold 1977), by 1 + m^2 / (7 n) as
    200,000 series of 20 to 400 normals have it: a scaled chi-square of that variance is taken.
    """
    n = len(value)
    if n < FEWEST:
        return None
    r, pairs = _correlations(value, target, time, min(LAGS, n // 5))
    lags = int(np.sum(np.cumprod(pairs >= FEWEST // 2)))
    if not lags:
        return None
    statistic, wide = np.sum(pairs[:lags] * r[:lags] ** 2) * (n + 2) / n, 1.0 + lags**2 / (7.0 * n)
    return Whiteness(float(r[0]), float(np.mean(value)), float(special.chdtrc(lags / wide, statistic / wide)))


class Channels(NamedTuple):
    """The innovations of every sensor's channels, in order of appearance: which they are, and how
    they follow."""

    labels: pd.DataFrame  # sensor and channel
    group: np.ndarray  # (D,) number of each datum's channel
    members: list[np.ndarray]  # data of each channel
    autocorrelation: np.ndarray  # from one to the next; 0 where there are too few to be judged
    mean: np.ndarray
    white: np.ndarray  # Ljung-Box p-value; 1 where there are too few

    @property
    def names(self) -> list[str]:
        """Sensor and channel in one word."""
        return [".".join(pair) for pair in self.labels.to_numpy(str)]


def channels_of(data: pd.DataFrame, found: Innovations) -> Channels:
    """Whiteness of the innovations of every sensor's channels."""
    group, labels = codes(data, ["sensor", "channel"])
    target, time = data["target"].to_numpy(str), data["time"].to_numpy()
    members = np.split(np.argsort(group, kind="stable"), np.cumsum(np.bincount(group))[:-1])
    extra = np.zeros((len(members), 3))
    for k, mine in enumerate(members):
        judged = enough(found.kurtosis[mine])
        white = whiteness(found.value[mine], target[mine], time[mine]) if judged else None
        extra[k] = (0.0, float(np.mean(found.value[mine])), 1.0) if white is None else white
    return Channels(labels, group, members, *extra.T)


class Scatter(NamedTuple):
    """Of every sensor's channel: mean square of its innovations, and how many of them count as one.

    A mean square below 1 counts as 1, unless the data scatter far less than that.
    """

    size: np.ndarray
    memory: np.ndarray


def scatter_of(data: pd.DataFrame, found: Innovations, members: Sequence[np.ndarray]) -> Scatter:
    """Overdispersion and correlation in time of the innovations of each channel, by its `members`
    among the data."""
    target, time = data["target"].to_numpy(str), data["time"].to_numpy()
    size = np.array([found.spread(mine) for mine in members])
    size = np.where(size < 1 / PRACTICAL, size, np.maximum(size, 1.0))
    return Scatter(size, np.array([memory(found.value[own], target[own], time[own]) for own in members]))


def inflation(fit: Judged, wide: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Factor (M,) of the variance of each bias, from the factors `wide` of the channels.

    The mean over the channels that inform it, by information, and not less than the mean of all.
    """
    M, start, wide = fit.problem.model.biases, 0, np.maximum(wide, 1.0)
    told, weighed = np.zeros(M + 1), np.zeros(M + 1)
    for read, lin, (row, channel) in zip(fit.problem.model.read, fit.lins, fit.picks, strict=True):
        own = (np.asarray(lin.weight)[:, :, None] * np.asarray(lin.bias) ** 2)[row, channel]  # (data, p)
        bias, times = np.asarray(read)[row].ravel(), wide[group[start : start + len(row)]][:, None]
        told += np.bincount(bias, own.ravel(), M + 1)
        weighed += np.bincount(bias, (own * times).ravel(), M + 1)
        start += len(row)
    return np.maximum(weighed[:M] / np.maximum(told[:M], 1e-300), np.mean(wide[group]))


def memory(value: np.ndarray, target: np.ndarray, time: np.ndarray) -> float:
    """Innovations of one channel that count as one: 1 + 2 sum of r_k over the first positive lag
    pairs.

    The initial positive sequence of Geyer (1992); 1 where the first correlation is not beyond 3 sd.
    """
    n = len(value)
    if n < FEWEST:
        return 1.0
    r, pairs = _correlations(value, target, time, min(LONGEST, n // 5))
    if r[0] < 3.0 / np.sqrt(max(pairs[0], 1)):
        return 1.0
    r = np.concatenate([[1.0], r[: len(r) // 2 * 2 - 1]])
    couples = r.reshape(-1, 2).sum(1) * np.cumprod(np.append(pairs[: len(r) - 1], n)[1::2] >= FEWEST // 2)
    return float(max(2.0 * np.sum(couples * np.cumprod(couples > 0)) - 1.0, 1.0))
