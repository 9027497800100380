"""Noise families: each maps a measured and a predicted value to innovation, likelihood, score and information.

Steps of an algorithm use the positive step weight; covariance, gamma and evidence use the expected
information (for a Student-t the two differ).
To add a family, write a frozen dataclass that inherits `AdditiveNoise` with its density and how it is drawn. To let it
drive a motion too, write the methods of `ScaleMixture`: noise is then normal given a precision drawn at every epoch.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, ClassVar, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import digamma, gammaln, log_ndtr, ndtr, ndtri

from probcal.errors import InputError
from probcal.geometry import wrap


@dataclass(frozen=True)
class Unknown:
    """A noise level that is estimated along: a guess, known to within a factor (one standard deviation).

    A parameter of a noise family may be unknown too, `StudentT(Unknown(4.0))` or `Mixture(Unknown(0.1))`; the factor
    of a share is that of its odds. All sensors of a type have one value; with `by="sensor"` each has its own.

    >>> Unknown(0.5, factor=3.0).guess
    0.5
    """

    guess: float
    factor: float = 3.0
    by: str | None = None

    def __repr__(self):
        return f"Unknown(guess={self.guess!r}, factor={self.factor!r}{', by=' + repr(self.by) if self.by else ''})"

    def __post_init__(self):
        if self.by not in (None, "sensor"):
            raise InputError(f'Unknown(by={self.by!r}): by is None or "sensor"')
        if not (np.isfinite(self.guess) and self.guess > 0):
            raise InputError(f"Unknown(guess={self.guess}): the guess must be positive")
        if not (np.isfinite(self.factor) and self.factor > 1):
            raise InputError(f"Unknown(factor={self.factor}): the factor must be greater than 1")


Level = float | Unknown


@dataclass(frozen=True)
class Grows:
    """A std that grows with the predicted value p, `Channel("m", std=Grows(0.05, 0.01))`: sqrt(std^2 + (slope p)^2).

    Either may be `Unknown`. A row with a std of its own has it in the place of `std`.

    >>> Grows(0.05, 0.01).slope
    0.01
    """

    std: Level
    slope: Level

    def __post_init__(self):
        check_level(self.std, "Grows: std", by=True)
        check_level(self.slope, "Grows: slope", by=True)


@dataclass(frozen=True)
class Memory:
    """The part of the noise of a channel that is remembered, `Channel("m", std=0.02, memory=Memory(0.05, 2.0))`.

    It adds to the white noise of the channel. For each sensor and target it is a stationary Ornstein-Uhlenbeck process
    e, an AR(1) at equal steps: e' = exp(-dt / time) e + sqrt(1 - exp(-2 dt / time)) std u, u ~ N(0, 1) (Uhlenbeck,
    Ornstein 1930). `std` is in the unit of the channel and may be `Unknown`, `time` is in s and known. It is one more
    state of every target for each sensor, so that the answer is exact, and costs what these states cost.

    >>> Memory(0.05, 2.0).time
    2.0
    """

    std: Level
    time: float

    def __post_init__(self):
        check_level(self.std, "Memory: std", by=True)
        if not (np.isfinite(self.time) and self.time > 0):
            raise InputError(f"Memory(time={self.time}): the correlation time must be positive, in s")


def guess_of(level: Level) -> float:
    """Number to start from: the level itself, or the guess of an `Unknown`."""
    return float(level.guess if isinstance(level, Unknown) else level)


def check_driving(noise: Any, what: str) -> None:
    """Raise `InputError` unless a family can drive a motion: Gaussian, or a known scale mixture around zero."""
    centred = not getattr(noise, "delay", 0.0) and getattr(noise, "late", NORMAL) == NORMAL
    if isinstance(noise, Normal) or (isinstance(noise, ScaleMixture) and centred and not unknowns(noise)):
        return
    raise InputError(
        f"{what} is {noise!r}, which cannot drive a motion: give noise.Normal(), StudentT(df) or Mixture(share, scale)"
    )


def check_driven(component: Any, what: str, *, zero: bool = True) -> None:
    """Raise `InputError` unless std and noise of a component of a motion can drive it."""
    check_level(component.std, f"{what} std", zero=zero)
    check_driving(component.noise, f"{what} noise")


def unknowns(family: Any) -> dict[str, Unknown]:
    """The parameters of a family that are unknown, by name; those of a family within it as `noise.share`."""
    found: dict[str, Unknown] = {}
    for one in fields(family) if is_dataclass(family) else ():
        value = getattr(family, one.name)
        if isinstance(value, Unknown):
            found[one.name] = value
        else:
            found |= {f"{one.name}.{name}": own for name, own in unknowns(value).items()}
    return found


def with_values(family: Any, values: Mapping[str, Any]) -> Any:
    """A family with numbers or arrays for its unknown parameters, by the names of `unknowns`; they are not checked."""
    parts = {one.name: getattr(family, one.name) for one in fields(family)}
    for name, value in values.items():
        first, _, rest = name.partition(".")
        parts[first] = with_values(parts[first], {rest: value}) if rest else value
    found = object.__new__(type(family))
    found.__dict__.update(parts)
    return found


def at_guess(family: Any) -> Any:
    """A family with the guesses of its unknown parameters."""
    values = {name: level.guess for name, level in unknowns(family).items()}
    return with_values(family, values) if values else family


def is_odds(family: Any, name: str) -> bool:
    """True for a parameter between 0 and 1, whose log odds are estimated."""
    first, _, rest = name.partition(".")
    return is_odds(getattr(family, first), rest) if rest else name in getattr(family, "fractions", ())


def level_at(guess: float, odds: bool, log: Any) -> Any:
    """Value of a level whose log (or log odds) lies `log` above that of its guess."""
    factor = (np if isinstance(log, (float, np.ndarray)) else jnp).exp(log)
    return guess * factor / (1.0 - guess + guess * factor) if odds else guess * factor


def log_level(guess: float, odds: bool, value: Any) -> Any:
    """By how much the log (or log odds) of a level lies above that of its guess."""
    value = np.asarray(value, float)
    return np.log(value / guess * ((1.0 - guess) / (1.0 - value) if odds else 1.0))


def _functions(*values: Any) -> Any:
    """NumPy for numbers, which compile to constants; jax for parameters that are estimated."""
    return jnp if any(isinstance(value, jax.Array) for value in values) else np


def check_level(level: Level, what: str, *, zero: bool = False, by: bool = False) -> None:
    """Raise `InputError` unless the level is a positive (or, where allowed, zero) finite number.

    One for each sensor is allowed with `by`.
    """
    if isinstance(level, Unknown):
        if level.by and not by:
            raise InputError(f'{what} is {level!r}: by="sensor" is for the noise of channels')
        return
    try:
        value = float(level)
    except (TypeError, ValueError):
        raise InputError(f"{what} is {level!r}: give a number or Unknown(guess, factor)") from None
    if not np.isfinite(value) or value < 0 or (value == 0 and not zero):
        raise InputError(f"{what} is {value:g}: it must be positive")


NORMAL, EXPONENTIAL, HALF_NORMAL = "normal", "exponential", "half-normal"  # late parts of a `Mixture`
NEAR = 0.1  # std within which a residual has the weight of one at that distance: a density may have a kink at zero
FAR = 6.0  # std of a floor above the predicted value, from which draws are those of the tail
FAR_OUT = 1e4  # std of the farthest point of a quadrature with estimated parameters: 10 of the widest late part
POINTS = 401  # of that quadrature: the information of a mixture is 4e-4 off
FARTHEST = 30.0  # asinh of the farthest point of a quadrature, in std
HALF = 0.5  # reliance below which a datum counts as rejected
HALF_LOG = 0.5 * np.log(2 * np.pi)  # minus the log density of a unit normal at its mean
# asinh of the points of a quadrature, even there so that tails of any weight are reached
DEVIATES = np.linspace(-FARTHEST, FARTHEST, 20_001)
# points of a quadrature for parameters (S, 1)
WIDE = np.sinh(np.linspace(-np.arcsinh(FAR_OUT), np.arcsinh(FAR_OUT), POINTS))[None]


class Family:
    """A noise family; `y`, `predicted`, `std` are arrays of one shape, `period` a number or None.

    The derivatives are those of its log-likelihood. A family that says no more relies on every datum.
    """

    def innovation(self, y, predicted, period):
        """Measured value minus the predicted one."""
        return y - predicted

    def log_likelihood(self, y, predicted, std, period):
        """Log density of each datum."""
        raise NotImplementedError

    def score(self, y, predicted, std, period):
        """Derivative of the log density by the predicted value."""
        return _derivative(lambda at: self.log_likelihood(y, at, std, period), predicted)

    def weight(self, y, predicted, std, period):
        """Positive curvature used by a step: the expected information."""
        return self.information(predicted, std)

    def information(self, predicted, std):
        """Expected information about the predicted value."""
        raise NotImplementedError

    def level_score(self, y, predicted, std, period):
        """One plus the derivative of the log density by log std."""
        return 1.0 + std * _derivative(lambda at: self.log_likelihood(y, predicted, at, period), std)

    def reliance(self, y, predicted, std, period):
        """One: every datum counts alike."""
        return jnp.ones_like(predicted)

    @property
    def rejects(self) -> float:
        """Zero: no datum is rejected."""
        return 0.0

    def sample(self, key, predicted, std):
        """Draw measured values around the predicted ones."""
        raise NotImplementedError

    def emit(self, key, predicted, std):
        """Draw what reaches the sensor, of which it says what is `reported`; a family that hears all: `sample`."""
        return self.sample(key, predicted, std)

    def reported(self, y):
        """The values written of those that reach the sensor, NaN if not written; here all."""
        return y

    def check(self, y):
        """The mask of the legal values: all."""
        return np.ones(y.shape, bool)


def _derivative(function: Callable[[Any], Any], at: Any) -> Any:
    """Derivative of a function of each entry by that entry."""
    at = jnp.asarray(at, float)
    return jax.jvp(function, (at,), (jnp.ones_like(at),))[1]


@runtime_checkable
class ScaleMixture(Protocol):
    """The protocol of a family that drives a motion: u (size,) is N(0, I / w), w drawn anew.

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

    def mixing_draw(self, key, shape, square=0.0, size=0):
        """Draws of w, given u where its square is given."""


class AdditiveNoise(Family):
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
        return _rejects(at_guess(self))

    def sample(self, key, predicted, std):
        """Draw measured values around the predicted ones."""
        return predicted + std * self.draw(key, predicted.shape)

    def unit_information(self) -> Any:
        """Expected information at std 1, by quadrature of the squared score; of parameters (S,) by each."""
        if _functions(*self.__dict__.values()) is np:
            return _information_of(self)
        # the same in fewer points, which are an axis more of parameters that are estimated, () or (S,)
        own, shape = _upright(self)
        e = own._points(WIDE)
        return jnp.trapezoid(own._slope(e) ** 2 * jnp.exp(own.log_density(e)), e).reshape(shape)

    def _points(self, e):
        """Residuals over the std (increasing) at which a quadrature looks, from those that suit a wide density."""
        return e

    def _slope(self, e):
        """Derivative of the log density by e."""
        return _derivative(self.log_density, e)


def _upright(family: Any) -> tuple[Any, tuple[int, ...]]:
    """A family with its parameters that are estimated as columns, and their shape, () or (S,)."""
    values = {name: value for name, value in family.__dict__.items() if isinstance(value, jax.Array)}
    own = with_values(family, {name: value.reshape(-1, 1) for name, value in values.items()})
    return own, jnp.broadcast_shapes(*(value.shape for value in values.values()))


def _evaluated(law: Callable[..., Any], *at: Any) -> np.ndarray:
    """Values of a function at points, in double precision, also while another is traced."""
    with jax.enable_x64(True), jax.ensure_compile_time_eval():
        return np.asarray(jax.jit(law)(*at))


@lru_cache
def _information_of(family: AdditiveNoise) -> float:
    """Mean square of a family's score at std 1."""
    t, e = DEVIATES, np.sinh(DEVIATES)
    density, slope = np.exp(_evaluated(family.log_density, e)), _evaluated(family._slope, e)
    return float(np.trapezoid(np.where(density > 0, slope**2 * density * np.cosh(t), 0.0), t))


@lru_cache
def normal_scores(family: Any) -> tuple[np.ndarray, np.ndarray]:
    """Residuals over the std (increasing), and the standard normal deviates with the same tail probabilities.

    A family that is not additive has no such residual: its deviates are zero.
    """
    from scipy import special

    e, family = np.sinh(DEVIATES), at_guess(family)
    if not isinstance(family, AdditiveNoise):
        return e, np.zeros_like(e)
    if isinstance(family, Normal | Heard):
        return e, e
    log = _evaluated(family.log_likelihood, e, np.zeros_like(e), np.ones_like(e), None)
    mass = np.exp(log) * np.cosh(DEVIATES)
    steps = 0.5 * (mass[1:] + mass[:-1])
    below, above = np.append(0.0, np.cumsum(steps)), np.append(np.cumsum(steps[::-1])[::-1], 0.0)
    lower, total = below < above, max(below[-1], 1e-300)
    tail = np.maximum(np.where(lower, below, above) / total, 1e-300)
    return e, np.maximum.accumulate(np.where(lower, 1.0, -1.0) * special.ndtri(tail))


@lru_cache
def _rejects(family: Any) -> float:
    """Probability of the residuals at which a family relies on a datum by less than half."""
    from scipy import special

    e, score = normal_scores(family)
    low = _evaluated(family.reliance, e, np.zeros_like(e), np.ones_like(e), None) < HALF
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

    reliance, rejects = Family.reliance, Family.rejects

    def log_likelihood(self, y, predicted, std, period):
        """Log density of each datum."""
        r = self.innovation(y, predicted, period) / std
        return -0.5 * r**2 - jnp.log(std) - HALF_LOG

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

    def sample(self, key, predicted, std):
        """Draw measured values around the predicted ones."""
        return predicted + std * jax.random.normal(key, predicted.shape, predicted.dtype)


@lru_cache
def _level_moments(family: AdditiveNoise) -> tuple[float, float]:
    """Expected square of the derivative l of a log density by log std, and of its product with the score, at std 1."""
    square, cross = _evaluated(lambda e: jnp.stack(_moments(family, e)), np.sinh(DEVIATES)).tolist()
    return square, cross


def _moments(family: AdditiveNoise, e: Any) -> tuple[Any, Any]:
    """The same by the trapezoidal rule over residuals e."""
    none, one = jnp.zeros_like(e), jnp.ones_like(e)
    p = jnp.exp(family.log_likelihood(e, none, one, None))
    score, level = family.score(e, none, one, None), family.level_score(e, none, one, None) - 1.0
    there = p > 0
    square, cross = (jnp.where(there, part, 0.0) for part in (p * level**2, p * score * level))
    return jnp.trapezoid(square, e), jnp.trapezoid(cross, e)


@dataclass(frozen=True)
class Growing(Family):
    """Additive `noise` whose std grows with the predicted value p (see `Grows`): s^2 = std^2 + (slope p)^2.

    With g = d log s / d p = slope^2 p / s^2 the score is that of the noise at s plus l g, l the derivative of its log
    density by log s; the information I / s^2 + E[l^2] g^2 + 2 E[l score] g / s (Seber, Wild 1989, 2.8).
    """

    noise: Any
    slope: Any

    def spread(self, predicted, std):
        """Std at the predicted value."""
        return jnp.sqrt(std**2 + (self.slope * predicted) ** 2)

    def _steep(self, predicted, std):
        """Std, and the derivative of its log by the predicted value."""
        s = self.spread(predicted, std)
        return s, self.slope**2 * predicted / s**2

    def _moments(self):
        """Moments of the derivative by log std: numbers, or arrays of estimated parameters."""
        if _functions(*self.noise.__dict__.values()) is np:
            return _level_moments(at_guess(self.noise))
        own, shape = _upright(self.noise)
        return [part.reshape(shape) for part in _moments(own, WIDE)]

    def innovation(self, y, predicted, period):
        """Measured value minus the predicted one."""
        return self.noise.innovation(y, predicted, period)

    def log_likelihood(self, y, predicted, std, period):
        """Log density of each datum."""
        return self.noise.log_likelihood(y, predicted, self.spread(predicted, std), period)

    def weight(self, y, predicted, std, period):
        """Positive curvature used by a step."""
        s, g = self._steep(predicted, std)
        return self.noise.weight(y, predicted, s, period) + self._moments()[0] * g**2

    def information(self, predicted, std):
        """Expected information about the predicted value."""
        s, g = self._steep(predicted, std)
        square, cross = self._moments()
        return self.noise.information(predicted, s) + square * g**2 + 2.0 * cross * g / s

    def level_score(self, y, predicted, std, period):
        """One plus the derivative of the log density by log std."""
        s = self.spread(predicted, std)
        return 1.0 + (self.noise.level_score(y, predicted, s, period) - 1.0) * (std / s) ** 2

    def reliance(self, y, predicted, std, period):
        """Weight of each datum over that of one without residual."""
        return self.noise.reliance(y, predicted, self.spread(predicted, std), period)

    @property
    def rejects(self):
        """Probability of a datum with a reliance below one half."""
        return self.noise.rejects

    def sample(self, key, predicted, std):
        """Draw measured values around the predicted ones."""
        return self.noise.sample(key, predicted, self.spread(predicted, std))

    def reported(self, y):
        """All of it."""
        return self.noise.reported(y)

    def check(self, y):
        """The mask of the legal values: all."""
        return self.noise.check(y)

    def square(self, y, predicted, std):
        """Square of each standardised score, 1 expected, of asinh(slope value / std) / slope, whose std is 1.

        In the channel's own unit a far prediction has a std so wide that no residual counts (Bartlett 1947).
        """
        y, predicted = (jnp.arcsinh(self.slope * value / std) / self.slope for value in (y, predicted))
        one = jnp.ones_like(predicted)
        return self.noise.score(y, predicted, one, None) ** 2 / self.noise.information(predicted, one)


class GrowingWithMeasured(Growing):
    """The same with the std at the measured value, for starts: no step moves it, and no far prediction widens it."""

    def log_likelihood(self, y, predicted, std, period):
        """Log density of each datum."""
        return self.noise.log_likelihood(y, predicted, self.spread(y, std), period)

    def weight(self, y, predicted, std, period):
        """Positive curvature used by a step."""
        return self.noise.weight(y, predicted, self.spread(y, std), period)


@dataclass(frozen=True)
class StudentT(AdditiveNoise):
    """Additive Student-t noise with scale `std` and `df` degrees of freedom, for channels with outliers.

    `StudentT(Unknown(4.0))` learns how heavy the tails are.
    A fit that gives less than half weight to most data of a sensor ends as a misfit: outliers are
    single data, not a whole sensor (see `gaussian.information.rejected`).

    >>> bool(StudentT(4.0).log_likelihood(10.0, 0.0, 1.0, None) > -10.0)  # a Gaussian has -50.9
    True
    """

    df: Any = 4.0  # or `Unknown`

    def __post_init__(self):
        if not (isinstance(self.df, Unknown) or (np.isfinite(self.df) and self.df > 0)):
            raise InputError(f"StudentT(df={self.df}): the degrees of freedom must be positive")

    def log_density(self, e):
        """Log density of the noise at std 1."""
        constant = gammaln((self.df + 1) / 2) - gammaln(self.df / 2) - 0.5 * _functions(self.df).log(self.df * np.pi)
        return constant - 0.5 * (self.df + 1) * jnp.log1p(e**2 / self.df)

    def weight(self, y, predicted, std, period):
        """Positive curvature used by a step: an outlying datum counts less."""
        return (self.df + 1) / (self.df * std**2 + self.innovation(y, predicted, period) ** 2)

    def information(self, predicted, std):
        """Expected information about the predicted value."""
        return (self.df + 1) / (self.df + 3) * jnp.ones_like(predicted) / std**2

    @property
    def rejects(self) -> float:
        """Probability beyond sqrt(df) to either side."""
        from scipy import special

        df = guess_of(self.df)
        return 2.0 * float(special.stdtr(df, -np.sqrt(df)))

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

    def mixing_draw(self, key, shape, square=0.0, size=0):
        """Chi-square of df + size degrees of freedom over df + square."""
        return jax.random.gamma(key, 0.5 * (self.df + size), shape) / (0.5 * (self.df + square))


def _late_normal(x, scale):
    """Log density of a late part N(0, scale^2) of a mixture, minus its slope by x, and its curvature."""
    return -0.5 * (x / scale) ** 2 - _functions(scale).log(scale) - HALF_LOG, x / scale**2, 1.0 / scale**2


def _late_exponential(x, scale):
    """The same of a unit normal plus an exponential of mean `scale` (exponentially modified Gaussian, Grushka 1972).

    log f = 1 / (2 scale^2) - x / scale - log scale + log Phi(x - 1 / scale).
    """
    a, rate = x - 1.0 / scale, 1.0 / scale
    ratio = _mills(a)
    density = 0.5 * rate**2 - rate * x + _functions(rate).log(rate) + log_ndtr(a)
    return density, rate - ratio, jnp.clip(ratio * (ratio + a), 0.0, 1.0)


def _late_half_normal(x, scale):
    """The same of a unit normal plus scale times the size of another (skew normal, Azzalini 1985).

    f = 2 / v phi(x / v) Phi(scale x / v), v^2 = 1 + scale^2.
    """
    square = 1.0 + scale**2
    steep = scale / square**0.5
    ratio = _mills(steep * x)
    density = np.log(2.0) - 0.5 * x**2 / square - 0.5 * _functions(square).log(square) - HALF_LOG + log_ndtr(steep * x)
    curved = jnp.clip(ratio * (ratio + steep * x), 0.0, 1.0)
    return density, x / square - steep * ratio, 1.0 / square + steep**2 * curved


LATE = {NORMAL: _late_normal, EXPONENTIAL: _late_exponential, HALF_NORMAL: _late_half_normal}


@dataclass(frozen=True)
class Mixture(AdditiveNoise):
    """Inliers of standard deviation `std`, and a `share` of echoes: `scale` times wider, `delay` stds later.

    `late` is the distribution of an echo after its delay, in stds. "normal": a normal of sd `scale` replaces the noise
    of the inlier, so that an echo may be early. "exponential" adds an exponential of mean `scale` to that noise,
    "half-normal" adds `scale` times the size of a normal: these echoes are never early. Each of the three numbers may
    be `Unknown(guess, factor)`; the factor of the share is that of its odds.

    >>> reflected = Mixture(Unknown(0.2), Unknown(20.0), late="exponential")  # of ranges: the direct path is blocked
    """

    fractions: ClassVar[tuple[str, ...]] = ("share",)

    share: Any = 0.1  # or `Unknown`, as the next two
    scale: Any = 10.0
    delay: Any = 0.0
    late: str = NORMAL

    def __post_init__(self):
        if self.late not in LATE:
            raise InputError(f'Mixture(late="{self.late}"): give one of {", ".join(LATE)}')
        share, scale, delay = guess_of(self.share), guess_of(self.scale), guess_of(self.delay)
        if not 0 < share < 1:
            raise InputError(f"Mixture(share={self.share}): the share of echoes must lie between 0 and 1")
        if not 1e-3 <= scale <= 1e3:
            raise InputError(f"Mixture(scale={self.scale}): the scale of echoes must lie between 0.001 and 1000 stds")
        if not abs(delay) <= 1e3 or (delay == 0 and scale == 1 and self.late == NORMAL):
            raise InputError(
                f"Mixture(scale={self.scale}, delay={self.delay}): an echo must differ from an inlier, by at most "
                f"1000 stds of delay"
            )

    def _parts(self, r):
        """Log densities (without std) of the two components, and slope and step weight of the late one."""
        xp = _functions(self.share)
        late = r - self.delay
        density, slope, curved = LATE[self.late](late, self.scale)
        # slope over distance bounds the density by a parabola where the curvature dies away
        curved = jnp.where(late > 1.0, jnp.maximum(curved, slope / jnp.maximum(late, 1.0)), curved)
        inlier = xp.log1p(-self.share) - 0.5 * r**2 - HALF_LOG
        return inlier, xp.log(self.share) + density, slope, curved

    def _slopes(self, r):
        """Probability of an inlier, the derivative of the negative log density by r, and the step weight."""
        inlier, echo, slope, curved = self._parts(r)
        kept = jax.nn.sigmoid(inlier - echo)
        return kept, kept * r + (1 - kept) * slope, kept + (1 - kept) * curved

    def log_density(self, e):
        """Log density of the noise at std 1."""
        inlier, echo, _, _ = self._parts(e)
        return jnp.logaddexp(inlier, echo)

    def _slope(self, e):
        return -self._slopes(e)[1]

    def _points(self, e):
        narrow = jnp.minimum(self.scale, 1.0) if self.late == NORMAL else 1.0
        return jnp.sort(jnp.concatenate(jnp.broadcast_arrays(e, self.delay + narrow * e), -1))

    @cached_property
    def _unit_information(self) -> float:
        """Expected information at std 1, by the trapezoidal rule."""
        inner = np.linspace(-12.0, 12.0, 20_001)
        wide = self.scale * (inner if self.late == NORMAL else np.linspace(0.0, 40.0, 20_001))
        r = np.union1d(np.append(inner, self.delay + inner), self.delay + wide)
        density, slope = np.exp(_evaluated(self.log_density, r)), _evaluated(self._slope, r)
        return float(np.trapezoid(slope**2 * density, r))

    def unit_information(self) -> Any:
        """Expected information at std 1."""
        known = _functions(self.share, self.scale, self.delay) is np
        return self._unit_information if known else super().unit_information()

    def weight(self, y, predicted, std, period):
        """Positive curvature used by a step: that of the two components, each by its probability."""
        return self._slopes(self.innovation(y, predicted, period) / std)[2] / std**2

    def reliance(self, y, predicted, std, period):
        """Probability that a datum is no echo."""
        return self._slopes(self.innovation(y, predicted, period) / std)[0]

    def sample(self, key, predicted, std):
        """Draw measured values around the predicted ones."""
        pick, size = jax.random.split(key)
        late = jax.random.uniform(pick, predicted.shape) < self.share
        normal = jax.random.normal(size, predicted.shape, predicted.dtype)
        if self.late == NORMAL:
            return predicted + std * jnp.where(late, self.delay + self.scale * normal, normal)
        draw = jax.random.exponential if self.late == EXPONENTIAL else jax.random.normal
        extra = jnp.abs(draw(jax.random.fold_in(key, 2), predicted.shape, predicted.dtype))
        return predicted + std * (normal + jnp.where(late, self.delay + self.scale * extra, 0.0))

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
        """By the trapezoidal rule over the square of u, for one size."""
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

    def mixing_draw(self, key, shape, square=0.0, size=0):
        """One with the probability of an inlier, else 1 / scale^2."""
        kept = jax.nn.sigmoid(jnp.subtract(*self._often(square, size)))
        return jnp.where(jax.random.uniform(key, shape) >= kept, self.scale**-2.0, 1.0)


SMALLEST = 1e-9  # weight of a datum that says nothing, times std^2


def _mills(a):
    """Normal density over its distribution function at a, for any a."""
    return jnp.exp(-0.5 * a**2 - HALF_LOG - log_ndtr(a))


@dataclass(frozen=True)
class Heard(AdditiveNoise):
    """Gaussian noise of a receiver that hears nothing at or below its `floor`: what it reports of that is its own.

    A floor that nobody knows is None: a problem then takes it from its table (`found`).
    """

    score, weight, level_score = Family.score, Family.weight, Family.level_score
    reliance, rejects = Family.reliance, Family.rejects

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
        return Normal().sample(key, predicted, std)


@dataclass(frozen=True)
class Censored(Heard):
    """Gaussian noise of a receiver that hears nothing at or below `floor` and says so (Tobin 1958).

    In a table a cell `<-95`, or any value at or below the floor, says only that; with `blanks` every blank cell in a
    row of such a sensor says it too. `simulate` writes the floor there. Without a floor the table tells it.

    >>> round(float(jnp.exp(Censored(-95.0).log_likelihood(-95.0, -95.0, 4.0, None))), 6)  # half of it is not heard
    0.5
    """

    blanks: bool = False

    def reported(self, y):
        """The floor in the place of what is not heard."""
        return np.maximum(y, self.known())

    def _below(self, predicted, std):
        """The height of the floor above the predicted value, in std."""
        return (self.known() - predicted) / std

    def innovation(self, y, predicted, period):
        """Measured minus predicted value; of what is not heard, how far the predicted value lies above the floor."""
        floor = self.known()
        return jnp.where(y <= floor, jnp.minimum(floor - predicted, 0.0), y - predicted)

    def log_likelihood(self, y, predicted, std, period):
        """Log density of what is heard, log probability of the rest."""
        nothing = log_ndtr(self._below(predicted, std))
        return jnp.where(y <= self.known(), nothing, Normal().log_likelihood(y, predicted, std, None))

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

    def reported(self, y):
        """Nothing (NaN) where nothing is heard."""
        return np.where(y > self.known(), y, np.nan)

    def _above(self, predicted, std):
        """The height of the predicted value above the floor, in std."""
        return (predicted - self.known()) / std

    def log_likelihood(self, y, predicted, std, period):
        """Log density of each datum, given that it was heard."""
        return Normal().log_likelihood(y, predicted, std, None) - log_ndtr(self._above(predicted, std))

    def information(self, predicted, std):
        """Expected information about the predicted value."""
        u = self._above(predicted, std)
        ratio = _mills(u)
        return jnp.maximum(1.0 - ratio * (u + ratio), SMALLEST) / std**2

    def sample(self, key, predicted, std):
        """Draw values above the floor around the predicted ones, by the inverse of their distribution function."""
        u = self._above(predicted, std)
        share = jax.random.uniform(key, predicted.shape, predicted.dtype, minval=np.finfo(np.float32).tiny)
        far = jnp.sqrt(u**2 - 2.0 * jnp.log(share))  # of a floor many std above, where the inverse has no digits left
        near = -ndtri(share * ndtr(jnp.maximum(u, -FAR)))
        return predicted + std * jnp.where(u < -FAR, far, near)

    def check(self, y):
        """The mask of the legal values: those above the floor."""
        return y > self.known()


@dataclass(frozen=True)
class Bernoulli(Family):
    """A yes-or-no channel (1 or 0): the sensor function returns the log odds of 1; `std` has no meaning."""

    def innovation(self, y, predicted, period):
        """Measured value minus the predicted probability."""
        return y - jax.nn.sigmoid(predicted)

    def log_likelihood(self, y, predicted, std, period):
        """Log probability of each datum."""
        return y * jax.nn.log_sigmoid(predicted) + (1 - y) * jax.nn.log_sigmoid(-predicted)

    def information(self, predicted, std):
        """Expected information about the log odds."""
        return jax.nn.sigmoid(predicted) * jax.nn.sigmoid(-predicted)

    def level_score(self, y, predicted, std, period):
        """One: a std has no meaning here."""
        return jnp.ones_like(predicted)

    def sample(self, key, predicted, std):
        """Draw ones and zeros."""
        return jax.random.bernoulli(key, jax.nn.sigmoid(predicted)).astype(predicted.dtype)

    def check(self, y):
        """The mask of the legal values: 0 and 1."""
        return (y == 0) | (y == 1)
