"""Noise families: each maps a measured and a predicted value to innovation, likelihood, score and information.

Steps of an algorithm use the positive step weight; covariance, gamma and evidence use the expected
information (for a Student-t the two differ).
To add a family, write a frozen dataclass that inherits `AdditiveNoise` with its density and how it is drawn. To let it
drive a motion too, write the methods of `ScaleMixture`: a vector of noise is then normal given a precision drawn anew
at every epoch.
"""

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import digamma, gammaln, log_ndtr, ndtr, ndtri

from probcal.errors import InputError
from probcal.geometry import wrap


@dataclass(frozen=True)
class Unknown:
    """A noise level that is estimated along: a guess, known to within a factor (one standard deviation).

    >>> Unknown(0.5, factor=3.0).guess
    0.5
    """

    guess: float
    factor: float = 3.0

    def __post_init__(self):
        if not (np.isfinite(self.guess) and self.guess > 0):
            raise InputError(f"Unknown(guess={self.guess}): the guess must be positive")
        if not (np.isfinite(self.factor) and self.factor > 1):
            raise InputError(f"Unknown(factor={self.factor}): the factor must be greater than 1")


Level = float | Unknown


def guess_of(level: Level) -> float:
    """Number to start from: the level itself, or the guess of an `Unknown`."""
    return float(level.guess if isinstance(level, Unknown) else level)


def check_driving(noise: Any, what: str) -> None:
    """Raise `InputError` unless a family can drive a motion: Gaussian, or a scale mixture around zero."""
    if isinstance(noise, Normal) or (isinstance(noise, ScaleMixture) and not getattr(noise, "delay", 0.0)):
        return
    raise InputError(
        f"{what} is {noise!r}, which cannot drive a motion: give noise.Normal(), StudentT(df) or Mixture(share, scale)"
    )


def check_level(level: Level, what: str, *, zero: bool = False) -> None:
    """Raise `InputError` unless the level is a positive (or, where allowed, zero) finite number."""
    if isinstance(level, Unknown):
        return
    try:
        value = float(level)
    except (TypeError, ValueError):
        raise InputError(f"{what} is {level!r}: give a number or Unknown(guess, factor)") from None
    if not np.isfinite(value) or value < 0 or (value == 0 and not zero):
        raise InputError(f"{what} is {value:g}: it must be positive")


NEAR = 0.1  # std within which a residual has the weight of one at that distance: a density may have a kink at zero
FAR = 6.0  # std of a floor above the predicted value, from which draws are those of the tail
FARTHEST = 30.0  # asinh of the farthest point of a quadrature, in std
HALF = 0.5  # reliance below which a datum counts as rejected


class Family(Protocol):
    """What a noise family answers; `y`, `predicted`, `std` are arrays of one shape, `period` a number or None."""

    def innovation(self, y, predicted, period: float | None): ...
    def log_likelihood(self, y, predicted, std, period: float | None): ...
    def score(self, y, predicted, std, period: float | None): ...
    def weight(self, y, predicted, std, period: float | None): ...
    def information(self, predicted, std): ...
    def level_score(self, y, predicted, std, period: float | None): ...
    def reliance(self, y, predicted, std, period: float | None): ...
    @property
    def rejects(self) -> float: ...
    def sample(self, key, predicted, std): ...
    def emit(self, key, predicted, std): ...
    def reported(self, y): ...
    def check(self, y: np.ndarray) -> np.ndarray: ...


@runtime_checkable
class ScaleMixture(Protocol):
    """What a family answers that drives a motion: a vector u (size,) is N(0, I / w), its precision w drawn anew.

    `square` is |u|^2 (or what is expected of it), `size` the number of entries; arrays of one shape.
    """

    def mixing_mean(self, square, size):
        """Mean of w given u (with an expected square, the best that does not depend on u: variational Bayes)."""

    def mixing_gain(self, weight, size):
        """E log p(w) - E log q(w) + size / 2 (E log w - log weight), for the q that `weight` = E w belongs to."""

    def mixing_density(self, square, size):
        """Log density of u over that of unit normals, w integrated."""

    def mixing_information(self, size):
        """Fisher information of each entry of u about its place, over that of unit normals."""

    def mixing_draw(self, key, shape):
        """Draws of w."""


class AdditiveNoise:
    """Noise added to the predicted value, std times e; a wrapped channel compares angles around the circle.

    A family of your own is a frozen dataclass that inherits this with the density of e and how it is drawn; all the
    rest follows from them, and a family may write its own where it knows better (all of these do).

    >>> @dataclass(frozen=True)
    ... class Logistic(AdditiveNoise):
    ...     def log_density(self, e):
    ...         return -2.0 * jnp.logaddexp(0.5 * e, -0.5 * e)
    ...
    ...     def draw(self, key, shape):
    ...         return jax.random.logistic(key, shape)
    >>> round(Logistic().unit_information(), 6)
    0.333333
    """

    def log_density(self, e):
        """Log density of the noise at std 1, arrays of one shape."""
        raise NotImplementedError(f"{type(self).__name__}: write log_density(self, e), or log_likelihood")

    def draw(self, key, shape):
        """Draws of the noise at std 1."""
        raise NotImplementedError(f"{type(self).__name__}: write draw(self, key, shape), or sample")

    def innovation(self, y, predicted, period):
        """Measured value minus the predicted one."""
        return y - predicted if period is None else wrap(y - predicted, period)

    def log_likelihood(self, y, predicted, std, period):
        """Log density of each datum."""
        return self.log_density(self.innovation(y, predicted, period) / std) - jnp.log(std)

    def score(self, y, predicted, std, period):
        """Derivative of the log density by the predicted value."""
        return -self._slope(self.innovation(y, predicted, period) / std) / std

    def weight(self, y, predicted, std, period):
        """Positive curvature used by a step: score over innovation, which outliers make small.

        Where the two have different signs (a density that is not symmetric) it is the expected information.
        """
        e = self.innovation(y, predicted, period) / std
        e = jnp.where(jnp.abs(e) < NEAR, NEAR, e)
        ratio = -self._slope(e) / e
        return jnp.where(ratio > 0, ratio, self.unit_information()) / std**2

    def information(self, predicted, std):
        """Expected information about the predicted value."""
        return self.unit_information() * jnp.ones_like(predicted) / std**2

    def level_score(self, y, predicted, std, period):
        """One plus the derivative of the log density by log std."""
        e = self.innovation(y, predicted, period) / std
        return -e * self._slope(e)

    def reliance(self, y, predicted, std, period):
        """Weight of each datum over that of one without residual, one at most."""
        there, none = self.weight(y, predicted, std, period), self.weight(predicted, predicted, std, period)
        return jnp.minimum(there / none, 1.0)

    @property
    def rejects(self) -> float:
        """Probability of a datum with a reliance below one half, by quadrature."""
        return _rejects(self)

    def sample(self, key, predicted, std):
        """Draw measured values around the predicted ones."""
        return predicted + std * self.draw(key, predicted.shape)

    def emit(self, key, predicted, std):
        """Draw what reaches the sensor, of which it says what is `reported`; a family that hears all: `sample`."""
        return self.sample(key, predicted, std)

    def reported(self, y):
        """What a sensor writes of what reaches it, NaN where it writes nothing; all of it here."""
        return y

    def check(self, y):
        """Which values are legal: all."""
        return np.ones(y.shape, bool)

    def unit_information(self) -> float:
        """Expected information at std 1, by quadrature of the squared score."""
        return _information_of(self)

    def _slope(self, e):
        """Derivative of the log density by e."""
        return jax.jvp(self.log_density, (e,), (jnp.ones_like(e),))[1]


@lru_cache
def _information_of(family: AdditiveNoise) -> float:
    """Mean square of a family's score at std 1; points are even in asinh, so that tails of any weight are reached."""
    t = np.linspace(-FARTHEST, FARTHEST, 20_001)
    with jax.enable_x64(True), jax.ensure_compile_time_eval():
        e = jnp.asarray(np.sinh(t))
        density, slope = np.exp(np.asarray(family.log_density(e))), np.asarray(family._slope(e))
    inside = density > 0
    return float(np.trapezoid(np.where(inside, slope**2 * density * np.cosh(t), 0.0), t))


@lru_cache
def normal_scores(family: Any) -> tuple[np.ndarray, np.ndarray]:
    """Residuals over the std (increasing), and the standard normal deviates with the same tail probabilities.

    A family that is not additive has no such residual: its deviates are zero.
    """
    from scipy import special

    t = np.linspace(-FARTHEST, FARTHEST, 20_001)
    e = np.sinh(t)
    if not isinstance(family, AdditiveNoise):
        return e, np.zeros_like(e)
    if isinstance(family, Normal | Heard):
        return e, e
    with jax.enable_x64(True), jax.ensure_compile_time_eval():
        points = jnp.asarray(e)
        none = jnp.zeros_like(points)
        density = np.exp(np.asarray(family.log_likelihood(points, none, jnp.ones_like(points), None)))
    mass = density * np.cosh(t)
    below = np.concatenate([[0.0], np.cumsum(0.5 * (mass[1:] + mass[:-1]))])
    above = np.concatenate([np.cumsum((0.5 * (mass[1:] + mass[:-1]))[::-1])[::-1], [0.0]])
    lower, total = below < above, max(below[-1], 1e-300)
    tail = np.maximum(np.where(lower, below, above) / total, 1e-300)
    return e, np.maximum.accumulate(np.where(lower, 1.0, -1.0) * special.ndtri(tail))


@lru_cache
def _rejects(family: Any) -> float:
    """Probability of the residuals at which a family relies on a datum by less than half."""
    from scipy import special

    e, score = normal_scores(family)
    with jax.enable_x64(True), jax.ensure_compile_time_eval():
        points = jnp.asarray(e)
        none = jnp.zeros_like(points)
        low = np.asarray(family.reliance(points, none, none + 1.0, None)) < HALF
    return float(np.diff(special.ndtr(score)) @ (0.5 * low[1:] + 0.5 * low[:-1]))


def gate_limits(family: Any, odds: float) -> tuple[float, float]:
    """Residuals over the std beyond which a datum lies with probability `odds`; infinite for odds of 0."""
    from scipy import special

    e, score = normal_scores(family)
    limit = -special.ndtri(0.5 * odds) if odds > 0 else np.inf
    if score[-1] <= limit:
        return -np.inf, np.inf
    return float(np.interp(-limit, score, e)), float(np.interp(limit, score, e))


@dataclass(frozen=True)
class Normal(AdditiveNoise):
    """Additive Gaussian noise of standard deviation `std`."""

    def log_likelihood(self, y, predicted, std, period):
        """Log density of each datum."""
        r = self.innovation(y, predicted, period) / std
        return -0.5 * r**2 - jnp.log(std) - 0.5 * np.log(2 * np.pi)

    def score(self, y, predicted, std, period):
        """Derivative of the log density by the predicted value."""
        return self.innovation(y, predicted, period) / std**2

    def weight(self, y, predicted, std, period):
        """Positive curvature used by a step."""
        return 1.0 / std**2

    def information(self, predicted, std):
        """Expected information about the predicted value."""
        return jnp.ones_like(predicted) / std**2

    def level_score(self, y, predicted, std, period):
        """One plus the derivative of the log density by log std (the mean square of a whitened residual)."""
        return (self.innovation(y, predicted, period) / std) ** 2

    def reliance(self, y, predicted, std, period):
        """One: every datum counts alike."""
        return jnp.ones_like(predicted)

    @property
    def rejects(self) -> float:
        """Zero: no datum is rejected."""
        return 0.0

    def sample(self, key, predicted, std):
        """Draw measured values around the predicted ones."""
        return predicted + std * jax.random.normal(key, predicted.shape, predicted.dtype)


@dataclass(frozen=True)
class StudentT(AdditiveNoise):
    """Additive Student-t noise with scale `std` and `df` degrees of freedom, for channels with outliers.

    A fit that gives less than half weight to most data of a sensor ends as a misfit: outliers are
    single data, not a whole sensor (see `smoothing.information.rejected`).

    >>> bool(StudentT(4.0).log_likelihood(10.0, 0.0, 1.0, None) > -10.0)  # a Gaussian has -50.9
    True
    """

    df: float = 4.0

    def __post_init__(self):
        if not (np.isfinite(self.df) and self.df > 0):
            raise InputError(f"StudentT(df={self.df}): the degrees of freedom must be positive")

    def log_likelihood(self, y, predicted, std, period):
        """Log density of each datum."""
        r2 = (self.innovation(y, predicted, period) / std) ** 2
        constant = gammaln((self.df + 1) / 2) - gammaln(self.df / 2) - 0.5 * np.log(self.df * np.pi)
        return constant - jnp.log(std) - 0.5 * (self.df + 1) * jnp.log1p(r2 / self.df)

    def score(self, y, predicted, std, period):
        """Derivative of the log density by the predicted value."""
        return self.weight(y, predicted, std, period) * self.innovation(y, predicted, period)

    def weight(self, y, predicted, std, period):
        """Positive curvature used by a step: an outlying datum counts less."""
        return (self.df + 1) / (self.df * std**2 + self.innovation(y, predicted, period) ** 2)

    def information(self, predicted, std):
        """Expected information about the predicted value."""
        return (self.df + 1) / (self.df + 3) * jnp.ones_like(predicted) / std**2

    def level_score(self, y, predicted, std, period):
        """One plus the derivative of the log density by log std."""
        r2 = self.innovation(y, predicted, period) ** 2
        return self.weight(y, predicted, std, period) * r2

    def reliance(self, y, predicted, std, period):
        """Weight of each datum over that of one without residual."""
        return 1.0 / (1.0 + (self.innovation(y, predicted, period) / std) ** 2 / self.df)

    @property
    def rejects(self) -> float:
        """Probability beyond sqrt(df) to either side."""
        from scipy import special

        return 2.0 * float(special.stdtr(self.df, -np.sqrt(self.df)))

    def sample(self, key, predicted, std):
        """Draw measured values around the predicted ones, by the polar method (Bailey 1994): no loop to compile."""
        u, v = jax.random.uniform(key, (2, *predicted.shape), predicted.dtype)
        size = jnp.sqrt(self.df * jnp.expm1(-2.0 / self.df * jnp.log1p(-u)))
        return predicted + std * size * jnp.cos(2.0 * jnp.pi * v)

    def mixing_mean(self, square, size):
        """(df + size) / (df + square)."""
        return (self.df + size) / (self.df + square)

    def mixing_gain(self, weight, size):
        """Of a Gamma q of shape (df + size) / 2."""
        shape, own = 0.5 * (self.df + size), 0.5 * self.df
        rate = shape / weight
        log_mean = digamma(shape) - jnp.log(rate)
        prior = own * np.log(own) - gammaln(own) + (own - 1) * log_mean - own * weight
        entropy = shape - jnp.log(rate) + gammaln(shape) + (1 - shape) * digamma(shape)
        return prior + entropy + 0.5 * size * (log_mean - jnp.log(weight))

    def mixing_density(self, square, size):
        """Multivariate Student-t over normal."""
        top, own = 0.5 * (self.df + size), 0.5 * self.df
        constant = gammaln(top) - gammaln(own) - 0.5 * size * np.log(own)
        return constant - top * jnp.log1p(square / self.df) + 0.5 * square

    def mixing_information(self, size):
        """(df + size) / (df + size + 2)."""
        return (self.df + size) / (self.df + size + 2.0)

    def mixing_draw(self, key, shape):
        """Chi-square of df degrees of freedom over df."""
        return jax.random.gamma(key, 0.5 * self.df, shape) / (0.5 * self.df)


@dataclass(frozen=True)
class Mixture(AdditiveNoise):
    """Inliers of standard deviation `std`, and a `share` of echoes: `scale` times wider, `delay` stds later.

    An echo of sound or radio comes late: with a positive `delay` the second component is centred there.
    """

    share: float = 0.1
    scale: float = 10.0
    delay: float = 0.0

    def __post_init__(self):
        if not 0 < self.share < 1:
            raise InputError(f"Mixture(share={self.share}): the share of echoes must lie between 0 and 1")
        if not 1e-3 <= self.scale <= 1e3:
            raise InputError(f"Mixture(scale={self.scale}): the scale of echoes must lie between 0.001 and 1000 stds")
        if not abs(self.delay) <= 1e3 or (self.delay == 0 and self.scale == 1):
            raise InputError(
                f"Mixture(scale={self.scale}, delay={self.delay}): an echo must differ from an inlier, by at most "
                f"1000 stds of delay"
            )

    def _parts(self, r):
        """Whitened residuals and log densities (without std) of the two components."""
        late = (r - self.delay) / self.scale
        inlier = np.log1p(-self.share) - 0.5 * r**2 - 0.5 * np.log(2 * np.pi)
        echo = np.log(self.share / self.scale) - 0.5 * late**2 - 0.5 * np.log(2 * np.pi)
        return late, inlier, echo

    def _slopes(self, r):
        """Probability of an inlier, and the derivative of the negative log density by the whitened residual."""
        late, inlier, echo = self._parts(r)
        kept = jax.nn.sigmoid(inlier - echo)
        return kept, kept * r + (1 - kept) * late / self.scale

    @cached_property
    def _unit_information(self) -> float:
        """Expected information at std 1, by the trapezoidal rule."""
        inner = np.linspace(-12.0, 12.0, 20_001)
        r = np.union1d(inner, self.delay + self.scale * inner)
        late, inlier, echo = self._parts(r)
        kept = 1.0 / (1.0 + np.exp(np.clip(echo - inlier, -700.0, 700.0)))
        slope = kept * r + (1 - kept) * late / self.scale
        return float(np.trapezoid(slope**2 * (np.exp(inlier) + np.exp(echo)), r))

    def log_likelihood(self, y, predicted, std, period):
        """Log density of each datum."""
        _, inlier, echo = self._parts(self.innovation(y, predicted, period) / std)
        return jnp.logaddexp(inlier, echo) - jnp.log(std)

    def score(self, y, predicted, std, period):
        """Derivative of the log density by the predicted value."""
        return self._slopes(self.innovation(y, predicted, period) / std)[1] / std

    def weight(self, y, predicted, std, period):
        """Positive curvature used by a step: that of the two components, each by its probability."""
        kept = self.reliance(y, predicted, std, period)
        return (kept + (1 - kept) / self.scale**2) / std**2

    def information(self, predicted, std):
        """Expected information about the predicted value."""
        return self._unit_information * jnp.ones_like(predicted) / std**2

    def level_score(self, y, predicted, std, period):
        """One plus the derivative of the log density by log std."""
        r = self.innovation(y, predicted, period) / std
        return r * self._slopes(r)[1]

    def reliance(self, y, predicted, std, period):
        """Probability that a datum is no echo."""
        return self._slopes(self.innovation(y, predicted, period) / std)[0]

    def sample(self, key, predicted, std):
        """Draw measured values around the predicted ones."""
        pick, size = jax.random.split(key)
        late = jax.random.uniform(pick, predicted.shape) < self.share
        normal = jax.random.normal(size, predicted.shape, predicted.dtype)
        return predicted + std * jnp.where(late, self.delay + self.scale * normal, normal)

    def _often(self, square, size):
        """Log densities of u, times its share, of the two components, less the constant."""
        inlier = np.log1p(-self.share) - 0.5 * square
        return inlier, np.log(self.share) - size * np.log(self.scale) - 0.5 * square / self.scale**2

    def mixing_mean(self, square, size):
        """One or 1 / scale^2, each by its probability."""
        inlier, wide = self._often(square, size)
        kept = jax.nn.sigmoid(inlier - wide)
        return kept + (1 - kept) / self.scale**2

    def mixing_gain(self, weight, size):
        """Of a q with two values."""
        low = self.scale**-2.0
        kept = jnp.clip((weight - low) / (1.0 - low), 1e-12, 1 - 1e-12)
        prior = kept * np.log1p(-self.share) + (1 - kept) * np.log(self.share)
        entropy = -kept * jnp.log(kept) - (1 - kept) * jnp.log1p(-kept)
        return prior + entropy + 0.5 * size * ((1 - kept) * np.log(low) - jnp.log(weight))

    def mixing_density(self, square, size):
        """Two normals over one."""
        return jnp.logaddexp(*self._often(square, size)) + 0.5 * square

    def mixing_information(self, size):
        """By the trapezoidal rule over |u|^2, for one size."""
        most = int(np.max(size, initial=1))
        of = np.array([1.0, *(self._radial(n) for n in range(1, most + 1))])
        return of[np.asarray(size, int)]

    def _radial(self, size: int) -> float:
        """E w(|u|^2)^2 |u|^2 / size."""
        from scipy import special

        radius = np.concatenate([np.linspace(0.0, 12.0, 4001), self.scale * np.linspace(0.0, 12.0, 4001)])
        radius = np.unique(radius + 1e-9)
        square = radius**2
        constant = (size - 1) * np.log(radius) + (1 - 0.5 * size) * np.log(2.0) - special.gammaln(0.5 * size)
        inlier, wide = self._often(square, size)
        kept = special.expit(inlier - wide)
        weight = kept + (1 - kept) / self.scale**2
        return float(np.trapezoid(np.exp(np.logaddexp(inlier, wide) + constant) * weight**2 * square, radius) / size)

    def mixing_draw(self, key, shape):
        """One, or 1 / scale^2 with the probability of the share."""
        return jnp.where(jax.random.uniform(key, shape) < self.share, self.scale**-2.0, 1.0)


SMALLEST = 1e-9  # weight of a datum that says nothing, times std^2


def _mills(a):
    """Normal density over its distribution function at a, for any a."""
    return jnp.exp(-0.5 * a**2 - 0.5 * np.log(2 * np.pi) - log_ndtr(a))


@dataclass(frozen=True)
class Heard(AdditiveNoise):
    """Gaussian noise of a receiver that hears nothing at or below its `floor`: what it reports of that is its own.

    A floor that nobody knows is None: a problem then takes it from its table (`found`).
    """

    floor: float | None = None

    def __post_init__(self):
        if self.floor is not None and not np.isfinite(self.floor):
            raise InputError(f"{type(self).__name__}(floor={self.floor}): give the least value that is heard")

    def found(self, heard: np.ndarray, limits: np.ndarray):
        """This family with a floor, where it has none, from values that were heard and limits such as `<-95`.

        The likelihood grows with the floor up to the least value that was heard. There it is put, less half of the
        smallest difference of two values (levels are rounded); or at the highest limit. It is off by one over the
        density of rows there, an order less than the rows leave of anything else.
        """
        if self.floor is not None:
            return self
        if len(limits):
            return self.at(limits.max())
        values = np.unique(heard)
        if len(values) < 2:
            return self.at(values[0] - 1.0 if len(values) else 0.0)
        return self.at(values[0] - 0.5 * np.diff(values).min())

    def at(self, floor: float):
        """This family with a floor."""
        return replace(self, floor=float(floor))

    def known(self) -> float:
        """The floor; raises `InputError` where it was not given."""
        if self.floor is None:
            raise InputError(
                f"{type(self).__name__}(): a floor is found in a table, here is none; state it in the channel's unit"
            )
        return self.floor

    def emit(self, key, predicted, std):
        """Draw what reaches the receiver, heard or not."""
        return predicted + std * jax.random.normal(key, predicted.shape, predicted.dtype)

    def reliance(self, y, predicted, std, period):
        """One: every datum counts alike."""
        return jnp.ones_like(predicted)

    @property
    def rejects(self) -> float:
        """Zero: no datum is rejected."""
        return 0.0

    def _log_normal(self, y, predicted, std):
        """Log density of a value, heard or not."""
        return -0.5 * (((y - predicted) / std) ** 2 + np.log(2 * np.pi)) - jnp.log(std)


@dataclass(frozen=True)
class Censored(Heard):
    """Gaussian noise of a receiver that hears nothing at or below `floor` and says so (Tobin 1958).

    In a table a cell `<-95`, or any value at or below the floor, says only that; with `blanks` every blank cell in a
    row of such a sensor says it too. `simulate` writes the floor there. Without a floor the table tells it.

    >>> round(float(jnp.exp(Censored(-95.0).log_likelihood(-95.0, -95.0, 4.0, None))), 6)  # half of it is not heard
    0.5
    """

    floor: float | None = None
    blanks: bool = False

    def reported(self, y):
        """The floor in the place of what is not heard."""
        return np.maximum(y, self.known())

    def _below(self, predicted, std):
        """How far in std the floor lies above the predicted value."""
        return (self.known() - predicted) / std

    def innovation(self, y, predicted, period):
        """Measured minus predicted value; of what is not heard, how far the predicted value lies above the floor."""
        floor = self.known()
        return jnp.where(y <= floor, jnp.minimum(floor - predicted, 0.0), y - predicted)

    def log_likelihood(self, y, predicted, std, period):
        """Log density of what is heard, log probability of the rest."""
        nothing = log_ndtr(self._below(predicted, std))
        return jnp.where(y <= self.known(), nothing, self._log_normal(y, predicted, std))

    def score(self, y, predicted, std, period):
        """Derivative by the predicted value."""
        return jnp.where(y <= self.known(), -_mills(self._below(predicted, std)), (y - predicted) / std) / std

    def weight(self, y, predicted, std, period):
        """Curvature, which is positive."""
        a = self._below(predicted, std)
        ratio = _mills(a)
        return jnp.where(y <= self.known(), jnp.maximum(ratio * (ratio + a), SMALLEST), 1.0) / std**2

    def information(self, predicted, std):
        """Expected information about the predicted value: little far below the floor."""
        a = self._below(predicted, std)
        density = jnp.exp(-0.5 * a**2) / np.sqrt(2 * np.pi)
        return jnp.maximum(ndtr(-a) + a * density + density * _mills(a), SMALLEST) / std**2

    def level_score(self, y, predicted, std, period):
        """One plus the derivative by log std."""
        a = self._below(predicted, std)
        return jnp.where(y <= self.known(), 1.0 - a * _mills(a), ((y - predicted) / std) ** 2)

    def sample(self, key, predicted, std):
        """Draw what is reported: the floor where nothing is heard."""
        return jnp.maximum(self.emit(key, predicted, std), self.known())


@dataclass(frozen=True)
class Truncated(Heard):
    """Gaussian noise of a receiver that writes no row of what lies at or below `floor` (a truncated normal).

    A row that is there then says that something was heard; `simulate` leaves the others out. Without a floor the table
    tells it. How many rows there are says nothing here, though a place from which little is heard has few: where a
    target stands hardly known and another receiver's row shows that it was sent, `rss.with_silence` and `Censored` know
    more, and do not err (`benchmarks/rings.py`).

    >>> round(float(jnp.exp(Truncated(-95.0).log_likelihood(-95.0, -95.0, 4.0, None))), 6)  # twice the normal density
    0.199471
    """

    floor: float | None = None

    def reported(self, y):
        """Nothing (NaN) where nothing is heard."""
        return np.where(y > self.known(), y, np.nan)

    def _above(self, predicted, std):
        """How far in std the predicted value lies above the floor."""
        return (predicted - self.known()) / std

    def log_likelihood(self, y, predicted, std, period):
        """Log density of each datum, given that it was heard."""
        return self._log_normal(y, predicted, std) - log_ndtr(self._above(predicted, std))

    def score(self, y, predicted, std, period):
        """Derivative by the predicted value."""
        return ((y - predicted) / std - _mills(self._above(predicted, std))) / std

    def weight(self, y, predicted, std, period):
        """Curvature, which is positive."""
        return self.information(predicted, std)

    def information(self, predicted, std):
        """Expected information about the predicted value."""
        u = self._above(predicted, std)
        ratio = _mills(u)
        return jnp.maximum(1.0 - ratio * (u + ratio), SMALLEST) / std**2

    def level_score(self, y, predicted, std, period):
        """One plus the derivative by log std."""
        u = self._above(predicted, std)
        return ((y - predicted) / std) ** 2 + u * _mills(u)

    def sample(self, key, predicted, std):
        """Draw values above the floor around the predicted ones, by the inverse of their distribution function."""
        u = self._above(predicted, std)
        share = jax.random.uniform(key, predicted.shape, predicted.dtype, minval=np.finfo(np.float32).tiny)
        far = jnp.sqrt(u**2 - 2.0 * jnp.log(share))  # of a floor many std above, where the inverse has no digits left
        near = -ndtri(share * ndtr(jnp.maximum(u, -FAR)))
        return predicted + std * jnp.where(u < -FAR, far, near)

    def check(self, y):
        """Which values are legal: those above the floor."""
        return y > self.known()


@dataclass(frozen=True)
class Bernoulli:
    """A yes-or-no channel (1 or 0): the sensor function returns the log odds of 1; `std` has no meaning."""

    def innovation(self, y, predicted, period):
        """Measured value minus the predicted probability."""
        return y - jax.nn.sigmoid(predicted)

    def log_likelihood(self, y, predicted, std, period):
        """Log probability of each datum."""
        return y * jax.nn.log_sigmoid(predicted) + (1 - y) * jax.nn.log_sigmoid(-predicted)

    def score(self, y, predicted, std, period):
        """Derivative of the log probability by the log odds."""
        return self.innovation(y, predicted, period)

    def weight(self, y, predicted, std, period):
        """Positive curvature used by a step."""
        return self.information(predicted, std)

    def information(self, predicted, std):
        """Expected information about the log odds."""
        return jax.nn.sigmoid(predicted) * jax.nn.sigmoid(-predicted)

    def level_score(self, y, predicted, std, period):
        """There is no level: one, so that nothing is learnt of it."""
        return jnp.ones_like(predicted)

    def reliance(self, y, predicted, std, period):
        """One: every datum counts alike."""
        return jnp.ones_like(predicted)

    @property
    def rejects(self) -> float:
        """Zero: no datum is rejected."""
        return 0.0

    def sample(self, key, predicted, std):
        """Draw ones and zeros."""
        return jax.random.bernoulli(key, jax.nn.sigmoid(predicted)).astype(predicted.dtype)

    emit = sample

    def reported(self, y):
        """All of it."""
        return y

    def check(self, y):
        """Which values are legal: 0 and 1."""
        return (y == 0) | (y == 1)
