"""Priors of the biases, as data chosen at the fit; every bias is taken as z = bias / scale.

A bias with a `survey` keeps its Gaussian of known standard deviation under every prior. Every prior takes
`correlation`: label patterns with the correlation of the Gaussian biases they match, for survey errors that
nodes share. `inference.table()` says which method takes which prior.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal import linalg
from probcal.errors import InputError, nearest

PRECISION_BOUNDS = (1e-2, 1e8)  # of z; a fit with a bias at the lower bound is not an answer
GROUPS = ("owner", "node", "type", "component", "vector")
Members = Sequence[Mapping[str, str]]  # of each bias: what it belongs to, by the names in GROUPS


class Precision(NamedTuple):
    """Gaussian prior of z with precision diag(alpha) + coupling; `logdet` is the coupling's share of log |.|.

    Independent biases have no coupling: nothing of size (M, M) is held for them.
    """

    alpha: jax.Array  # (M,) precision of each bias alone, 0 where flat
    coupling: jax.Array | None  # (M, M) what correlations add to diag(alpha)
    logdet: jax.Array  # ()

    @staticmethod
    def single(alpha: jax.Array) -> "Precision":
        """Independent biases of precisions alpha (M,)."""
        nothing: Any = np.zeros(())
        return Precision(alpha, None, nothing)

    def matrix(self) -> jax.Array:
        """The precision matrix (M, M)."""
        return jnp.diag(self.alpha) if self.coupling is None else jnp.diag(self.alpha) + self.coupling

    def coupled(self) -> jax.Array:
        """What correlations add to diag(alpha), (M, M)."""
        M = self.alpha.shape[0]
        return jnp.zeros((M, M)) if self.coupling is None else self.coupling

    def pull(self, z: jax.Array) -> jax.Array:
        """Precision times z, (M,)."""
        return self.alpha * z if self.coupling is None else self.alpha * z + self.coupling @ z

    def square(self, z: jax.Array) -> jax.Array:
        """z' (precision) z."""
        return z @ self.pull(z)

    def log_determinant(self) -> jax.Array:
        """Log determinant, a flat bias counted as one."""
        return jnp.sum(jnp.log(jnp.where(self.alpha > 0, self.alpha, 1.0))) + self.logdet


@dataclass(frozen=True, kw_only=True)
class Prior:
    """What every prior is and has: a method takes it by what it can do."""

    correlation: Any = ()

    learns: ClassVar[bool] = False  # precisions follow the data in a climb
    hierarchical: ClassVar[bool] = False  # hyper-parameters of its own, with a class in `inference.hierarchy`
    dense: ClassVar[bool] = True  # no bias is exactly zero
    proper: ClassVar[bool] = True  # an evidence
    first: ClassVar[float] = 1.0  # precision to start from
    note: ClassVar[str] = ""  # what the intervals of every method are worth, where the prior decides it

    def __post_init__(self):
        given = self.correlation.items() if isinstance(self.correlation, Mapping) else self.correlation
        pairs = tuple((str(pattern), float(value)) for pattern, value in given)
        for pattern, value in pairs:
            if not -1 < value < 1:
                raise InputError(f'correlation "{pattern}" is {value:g}: it must lie between -1 and 1')
        object.__setattr__(self, "correlation", pairs)

    def precision(self, labels: Sequence[str], surveyed: np.ndarray) -> Precision:
        """First precision of biases by label; those in `surveyed` (M,) have their own Gaussian."""
        M = len(labels)
        alpha = jax.device_put(np.where(surveyed, 1.0, self.first))
        if not self.correlation:
            return Precision.single(alpha)
        matrix, coupled = np.eye(M), np.zeros(M, bool)
        for pattern, value in self.correlation:
            members = [m for m, label in enumerate(labels) if fnmatchcase(label, pattern)]
            if len(members) < 2:
                raise InputError(f'correlation "{pattern}" reaches {len(members)} bias(es){nearest(pattern, labels)}')
            for m in members:
                if not (surveyed[m] or isinstance(self, Gaussian)):
                    raise InputError(
                        f'correlation "{pattern}" reaches {labels[m]}, which has no survey: give it one, '
                        f"or use the prior Gaussian"
                    )
                if coupled[m]:
                    raise InputError(f'correlation "{pattern}" reaches {labels[m]}, which another pattern has taken')
            coupled[members] = True
            matrix[np.ix_(members, members)] = np.where(np.eye(len(members)) > 0, 1.0, value)
            if 1 + (len(members) - 1) * value <= 0:
                raise InputError(f'correlation "{pattern}" is {value:g}: too negative for {len(members)} biases')
        inverse, logdet = (np.asarray(part) for part in linalg.inverse_and_logdet(matrix))
        return Precision(alpha, jax.device_put(inverse - np.eye(M)), jax.device_put(-logdet))

    def groups(self, members: Members) -> np.ndarray:
        """Which precision governs each bias, (M,)."""
        return np.arange(len(members))

    def penalty(self, z: Any, alpha: Any) -> Any:
        """Negative log density of each z whose precision this prior governs, up to a constant, (M,)."""
        return 0.5 * alpha * z**2

    def log_hyper(self, alpha: jax.Array, group: jax.Array) -> jax.Array:
        """Log density of the log precisions that are learnt, up to a constant: with the evidence what is maximised."""
        return jnp.zeros(())


@dataclass(frozen=True)
class Flat(Prior):
    """No prior: maximum likelihood."""

    proper: ClassVar[bool] = False
    first: ClassVar[float] = 0.0


@dataclass(frozen=True)
class Gaussian(Prior):
    """Zero-mean Gaussian with the declared scale of each bias as its standard deviation (l2, thesis 4.14a).

    `correlation={"mic_*.position_x": 0.9}` correlates the biases that a pattern matches, surveyed or not.
    """


@dataclass(frozen=True)
class Laplace(Prior):
    """Zero-mean Laplace density with the declared scale as its standard deviation: l1 (thesis 4.14b, lambda 2/beta).

    Its mode is found as a Gaussian scale mixture: precision sqrt(2) / |z|, renewed at every iteration.
    """

    learns: ClassVar[bool] = True
    hierarchical: ClassVar[bool] = True
    proper: ClassVar[bool] = False  # what Laplace's method gives at a corner is no evidence
    rate: ClassVar[float] = float(np.sqrt(2.0))
    note: ClassVar[str] = "l1: given the scale mixture at the mode, no posterior intervals"

    def learn(self, gamma: jax.Array, variance: jax.Array, z: jax.Array, group: jax.Array, rule: str) -> jax.Array:
        """Precision of the Gaussian that touches the density at z."""
        return self.rate / jnp.maximum(jnp.abs(z), 1e-300)

    def penalty(self, z: Any, alpha: Any) -> Any:
        """Negative log density of each z, up to a constant."""
        return self.rate * abs(z)


def check_by(name: str, by: str | None) -> None:
    """Raise `InputError` where a prior shares its precisions by something that it does not know."""
    if by is not None and by not in GROUPS:
        raise InputError(f'{name}(by="{by}"): give one of {", ".join(GROUPS)}{nearest(by, GROUPS)}')


def grouped(members: Members, by: str | None) -> np.ndarray:
    """A number (M,) that biases share which belong together; each has its own where `by` is None."""
    if by is None:
        return np.arange(len(members))
    names = [member[by] for member in members]
    order = {name: k for k, name in enumerate(dict.fromkeys(names))}
    return np.array([order[name] for name in names], int)


@dataclass(frozen=True)
class ARD(Prior):
    """Automatic relevance determination: one precision a bias, with a Gamma(shape, rate) hyper-prior.

    The default, shape 1 and rate 0, is the flat hyper-prior of the papers (Paper B 11, Paper C 18). `by` shares a
    precision among the biases of one "node", "owner" (sensor or node), sensor "type", "component" (all headings), or
    "vector" (the axes of one position: the answer then turns with the world).
    """

    shape: float = 1.0
    rate: float = 0.0
    by: str | None = None

    learns: ClassVar[bool] = True
    hierarchical: ClassVar[bool] = True

    def __post_init__(self):
        super().__post_init__()
        if not (np.isfinite(self.shape) and self.shape >= 1 and np.isfinite(self.rate) and self.rate >= 0):
            raise InputError(
                f"ARD(shape={self.shape}, rate={self.rate}): shape must be 1 or more (1 is flat, more is sparser), "
                f"rate not negative"
            )
        check_by("ARD", self.by)

    def groups(self, members: Members) -> np.ndarray:
        """Which precision governs each bias, (M,)."""
        return grouped(members, self.by)

    def log_hyper(self, alpha: jax.Array, group: jax.Array) -> jax.Array:
        """(shape - 1) log alpha - rate alpha of each precision, whose maximum with the evidence `learn` seeks."""
        M = alpha.shape[0]
        members = jax.ops.segment_sum(jnp.ones(M), group, M)[group]
        return jnp.sum(((self.shape - 1) * jnp.log(alpha) - self.rate * alpha) / members)

    def learn(self, gamma: jax.Array, variance: jax.Array, z: jax.Array, group: jax.Array, rule: str) -> jax.Array:
        """New precisions (M,): `mackay` solves gamma = alpha z^2 (Paper B 25), `em` the expectation (Paper C 40)."""
        M = z.shape[0]

        def total(values: jax.Array) -> jax.Array:
            return jax.ops.segment_sum(values, group, M)[group]

        if rule == "mackay":
            return (total(gamma) + 2 * (self.shape - 1)) / (total(z**2) + 2 * self.rate + 1e-300)
        return (total(jnp.ones(M)) + 2 * (self.shape - 1)) / (total(z**2 + variance) + 2 * self.rate)


@dataclass(frozen=True)
class Horseshoe(Prior):
    """Regularised horseshoe: half-Cauchy global and local scales, a slab of inverse-Gamma variance.

    `expected` is the share of biases expected to be non-zero, `slab_scale` (in declared scales) and `slab_df` bound
    the large ones (Piironen, Vehtari 2017). `by` shares a local scale, as in `ARD`: by "vector" the axes of one
    position.
    """

    expected: float = 0.2
    slab_scale: float = 2.0
    slab_df: float = 4.0
    by: str | None = None

    hierarchical: ClassVar[bool] = True

    def __post_init__(self):
        super().__post_init__()
        if not 0 < self.expected < 1:
            raise InputError(f"Horseshoe(expected={self.expected}): the share must lie between 0 and 1")
        for name in ("slab_scale", "slab_df"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise InputError(f"Horseshoe({name}={getattr(self, name)}): it must be positive")
        check_by("Horseshoe", self.by)

    def groups(self, members: Members) -> np.ndarray:
        """Which local scale governs each bias, (M,)."""
        return grouped(members, self.by)


@dataclass(frozen=True, kw_only=True)
class BernoulliGaussian(Prior):
    """Spike and slab, the generating model of Papers B and C: each bias is zero or Gaussian of `slab` declared scales.

    `share` of the biases is non-zero; None learns it under a Beta(a, b) prior, uniform by default.
    """

    share: float | None = None
    slab: float = 1.0
    a: float = 1.0
    b: float = 1.0

    hierarchical: ClassVar[bool] = True
    dense: ClassVar[bool] = False

    def __post_init__(self):
        super().__post_init__()
        if self.share is not None and not 0 < self.share < 1:
            raise InputError(f"BernoulliGaussian(share={self.share}): it must lie between 0 and 1, or be None")
        for name in ("slab", "a", "b"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise InputError(f"BernoulliGaussian({name}={getattr(self, name)}): give a positive number")


# names on the command line
PRIORS: dict[str, Prior] = {
    "flat": Flat(),
    "gaussian": Gaussian(),
    "laplace": Laplace(),
    "ard": ARD(),
    "ard-node": ARD(by="node"),
    "ard-owner": ARD(by="owner"),
    "ard-type": ARD(by="type"),
    "ard-component": ARD(by="component"),
    "ard-vector": ARD(by="vector"),
    "ard-gamma": ARD(shape=1.0, rate=0.5),
    "horseshoe": Horseshoe(),
    "horseshoe-vector": Horseshoe(by="vector"),
    "bernoulli-gaussian": BernoulliGaussian(),
}
