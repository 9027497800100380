"""Priors of the biases, as data chosen at the fit; every bias is taken as z = bias / scale.

A bias with a `survey` keeps its Gaussian of known standard deviation under every prior. Every prior takes
`correlation`: label patterns with the correlation of the Gaussian biases they match, for survey errors that
nodes share; and `kinds`: label patterns with the priors of the biases they match, each with hyper-parameters of its
own, the last pattern that matches a bias being the one that counts. `by_kind` makes such a prior from the mapping that
a fit takes. `inference.table()` says which method takes which prior.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal.errors import InputError, nearest
from probcal.linalg import library

PRECISION_BOUNDS = (1e-2, 1e8)  # of z; a fit with a bias at the lower bound is not an answer
GROUPS = ("owner", "node", "type", "component", "vector")
Members = Sequence[Mapping[str, str]]  # of each bias: what it belongs to, by the names in GROUPS


class Coupling(NamedTuple):
    """Biases that are correlated with each other and no others."""

    members: Any  # (p,)
    precision: Any  # (p, p) what the correlation adds to their precision


class Precision(NamedTuple):
    """Gaussian prior of z: diag(alpha) and couplings, of which `logdet` is the log determinant."""

    alpha: jax.Array  # (M,) precision of each bias alone, 0 where flat
    coupling: tuple[Coupling, ...] = ()
    logdet: Any = np.zeros(())

    @classmethod
    def correlated(cls, alpha: jax.Array, groups: Iterable[tuple[np.ndarray, float]]) -> "Precision":
        """Precisions alpha (M,), and groups of biases with one correlation between every two."""
        coupling, logdet = list[Coupling](), 0.0
        for members, value in groups:
            p = len(members)
            shared = value / (1 + (p - 1) * value)  # Sherman, Morrison 1950
            coupling.append(Coupling(members, (np.eye(p) - shared) / (1 - value) - np.eye(p)))
            logdet -= (p - 1) * np.log(1 - value) + np.log(1 + (p - 1) * value)
        return cls(alpha, *jax.device_put((tuple(coupling), np.array(logdet)))) if coupling else cls(alpha)

    def matrix(self) -> jax.Array:
        """The precision matrix (M, M)."""
        return self._added(jnp.diag(self.alpha))

    def coupled(self) -> jax.Array:
        """The term (M, M) that correlations add to diag(alpha)."""
        M = self.alpha.shape[0]
        return self._added(jnp.zeros((M, M)))

    def _added(self, matrix: jax.Array) -> jax.Array:
        for members, own in self.coupling:
            matrix = matrix.at[members[:, None], members[None]].add(own)
        return matrix

    def pull(self, z: jax.Array) -> jax.Array:
        """Precision times z, (M,)."""
        found = self.alpha * z
        for members, own in self.coupling:
            found = found.at[members].add(own @ z[members])
        return found

    def square(self, z: jax.Array) -> jax.Array:
        """z' (precision) z."""
        xp = library(z, self.alpha)
        z = xp.asarray(z)
        parts = (z[members] @ (own @ z[members]) for members, own in self.coupling)
        return sum(parts, (xp.asarray(self.alpha) * z) @ z)

    def log_determinant(self) -> jax.Array:
        """Log determinant, a flat bias counted as one."""
        xp = library(self.alpha)
        alpha = xp.asarray(self.alpha)
        return xp.log(alpha + (alpha == 0)).sum() + self.logdet


@dataclass(frozen=True, kw_only=True)
class Prior:
    """The base of every prior: a method accepts a prior by its capabilities."""

    correlation: Any = ()
    kinds: Any = ()

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
        kinds = tuple(self.kinds.items() if isinstance(self.kinds, Mapping) else self.kinds)
        for pattern, prior in kinds:
            if not isinstance(prior, Prior) or isinstance(prior, Flat) or prior.kinds:
                raise InputError(
                    f'the prior of "{pattern}" is {prior!r}: give one such as Gaussian() or Horseshoe(); for biases'
                    " without a prior declare a wide scale"
                )
            if prior.hierarchical and not self.hierarchical:
                raise InputError(
                    f'{type(self).__name__}(kinds=...) has a sparse prior of "{pattern}": give the fit'
                    f' prior={{"*": {type(self).__name__}(), "{pattern}": {type(prior).__name__}()}}'
                )
            pairs += prior.correlation
        kinds = tuple((str(pattern), replace(prior, correlation=())) for pattern, prior in kinds)
        object.__setattr__(self, "correlation", pairs)
        object.__setattr__(self, "kinds", kinds)

    def kind_of(self, label: str) -> int:
        """Number of the kind that governs a bias, the last whose pattern matches; -1 where none does."""
        return max((k for k, (pattern, _) in enumerate(self.kinds) if fnmatchcase(label, pattern)), default=-1)

    def parts(self, biases: Sequence[Any]) -> tuple[list[tuple[str, "Prior"]], np.ndarray]:
        """Priors by name, this one without its kinds first, and the number (M,) of the one that governs each bias.

        A pattern is above what a bias declares as `zeros`, which only a hierarchical prior reads.
        """
        own = replace(self, kinds=())
        found = {("", ""): own} | {("pattern", pattern): prior for pattern, prior in self.kinds}
        names, numbers = list(found), []
        for bias in biases:
            kind, name = self.kind_of(bias.label), ("", "")
            if kind >= 0:
                name = ("pattern", self.kinds[kind][0])
            elif self.hierarchical and bias.zeros == "none":
                name = ("none", bias.component)
                found[name] = Gaussian()
            elif bias.zeros == "learnt" and (learnt := own.adaptive()) is not None:
                name = ("learnt", bias.component)
                found[name] = learnt
            names += [name] if name not in names else []
            numbers.append(names.index(name))
        return [(name, found[kind, name]) for kind, name in names], np.array(numbers, int)

    def title(self, biases: Sequence[Any]) -> str:
        """Its name in results, with the names of the priors that govern kinds of these biases."""
        parts, part = self.parts(biases)
        governing = [pair for k, pair in enumerate(parts) if k in part] or parts[:1]
        return "; ".join(
            type(prior).__name__ + (f" of {name}" if name not in ("", "*") else "") for name, prior in governing
        )

    def adaptive(self) -> "Prior | None":
        """This prior for a kind whose global scale and share of zeros are learnt; None where nothing is shared."""
        return None

    def check_kinds(self, labels: Sequence[str]) -> None:
        """Raise `InputError` for a pattern that governs none of the biases of these labels."""
        governing = {self.kind_of(label) for label in labels}
        for k, (pattern, _) in enumerate(self.kinds):
            if k in governing or pattern == "*":  # the rest, of which there may be none
                continue
            if not any(fnmatchcase(label, pattern) for label in labels):
                raise InputError(f'prior "{pattern}" matches no bias{nearest(pattern, labels)}')
            raise InputError(f'prior "{pattern}" governs no bias, as later patterns match all of them: put it last')

    def precision(self, labels: Sequence[str], surveyed: np.ndarray) -> Precision:
        """First precision of biases by label; those in `surveyed` (M,) have their own Gaussian."""
        priors = [self, *(prior for _, prior in self.kinds)]
        own = [priors[self.kind_of(label) + 1] for label in labels]
        alpha = jax.device_put(np.where(surveyed, 1.0, np.array([one.first for one in own])))
        return Precision.correlated(alpha, self.correlated(labels, surveyed))

    def correlated(self, labels: Sequence[str], surveyed: np.ndarray) -> list[tuple[np.ndarray, float]]:
        """Biases by number and their correlation for each pattern.

        Those in `surveyed` (M,) have their own Gaussian. Raises `InputError` for a pattern that
        reaches biases which are not Gaussian, or others have taken.
        """
        found, coupled = list[tuple[np.ndarray, float]](), np.zeros(len(labels), bool)
        for pattern, value in self.correlation:
            members = [m for m, label in enumerate(labels) if fnmatchcase(label, pattern)]
            if len(members) < 2:
                raise InputError(f'correlation "{pattern}" reaches {len(members)} bias(es){nearest(pattern, labels)}')
            for m in members:
                kind = self.kind_of(labels[m])
                if not (surveyed[m] or isinstance(self if kind < 0 else self.kinds[kind][1], Gaussian)):
                    raise InputError(
                        f'correlation "{pattern}" reaches {labels[m]}, which has no survey: give it one, '
                        f"or use the prior Gaussian"
                    )
                if coupled[m]:
                    raise InputError(f'correlation "{pattern}" reaches {labels[m]}, which another pattern has taken')
            coupled[members] = True
            if 1 + (len(members) - 1) * value <= 0:
                raise InputError(f'correlation "{pattern}" is {value:g}: too negative for {len(members)} biases')
            found.append((np.array(members), value))
        return found

    def groups(self, members: Members) -> np.ndarray:
        """The index (M,) of the precision that governs each bias."""
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

    proper = False
    first = 0.0


@dataclass(frozen=True)
class Gaussian(Prior):
    """Zero-mean Gaussian with the declared scale of each bias as its standard deviation (l2, thesis 4.14a).

    `correlation={"mic_*.position_x": 0.9}` correlates the biases that a pattern matches, surveyed or not.
    """


@dataclass(frozen=True)
class Laplace(Prior):
    """Zero-mean Laplace density with the declared scale as its standard deviation: l1 (thesis 4.14b, lambda 2/beta).

    Its mode is found as a Gaussian scale mixture: precision sqrt(2) / abs(z), renewed at every iteration.
    """

    learns = True
    hierarchical = True
    proper = False  # what Laplace's method gives at a corner is no evidence
    rate: ClassVar[float] = float(np.sqrt(2.0))
    note = "l1: given the scale mixture at the mode, no posterior intervals"

    def learn(self, gamma: jax.Array, variance: jax.Array, z: jax.Array, group: jax.Array, rule: str) -> jax.Array:
        """Precision of the Gaussian that touches the density at z."""
        return self.rate / jnp.maximum(jnp.abs(z), 1e-300)

    def penalty(self, z: Any, alpha: Any) -> Any:
        """Negative log density of each z, up to a constant."""
        return self.rate * abs(z)


AnyPrior = Prior | Mapping[str, Prior] | None  # as a fit takes it: one prior, or one by label pattern


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

    learns = True
    hierarchical = True

    def __post_init__(self):
        super().__post_init__()
        if not (np.isfinite(self.shape) and self.shape >= 1 and np.isfinite(self.rate) and self.rate >= 0):
            raise InputError(
                f"ARD(shape={self.shape}, rate={self.rate}): shape must be 1 or more (1 is flat, more is sparser), "
                f"rate not negative"
            )
        check_by("ARD", self.by)

    def groups(self, members: Members) -> np.ndarray:
        """The index (M,) of the precision that governs each bias."""
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
    the large ones (Piironen, Vehtari 2017). `by` shares a local scale, as in `ARD`: by "vector", the default, the axes
    of one position, so that the answer turns with the world; None gives every bias one of its own.
    """

    expected: float = 0.2
    slab_scale: float = 2.0
    slab_df: float = 4.0
    by: str | None = "vector"

    hierarchical = True

    def __post_init__(self):
        super().__post_init__()
        if not 0 < self.expected < 1:
            raise InputError(f"Horseshoe(expected={self.expected}): the share must lie between 0 and 1")
        for name in ("slab_scale", "slab_df"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise InputError(f"Horseshoe({name}={getattr(self, name)}): it must be positive")
        check_by("Horseshoe", self.by)

    def groups(self, members: Members) -> np.ndarray:
        """The index (M,) of the local scale that governs each bias."""
        return grouped(members, self.by)

    def adaptive(self) -> "Horseshoe":
        """The one whose global scale, half-Cauchy of scale 1, says whether few of the kind are zero or most.

        A handful of biases says little of their kind, and every kind that learns that few of it are zero
        makes the others sparser: the kinds trade, and those gain what these lose. Where it is known that
        none is zero, say so by `zeros="none"` (measured in `benchmarks/README.md`, kinds of biases).
        """
        return replace(self, expected=0.5)


@dataclass(frozen=True, kw_only=True)
class BernoulliGaussian(Prior):
    """Spike and slab, the generating model of Papers B and C: each bias is zero or Gaussian of `slab` declared scales.

    `share` of the biases is non-zero; None learns it under a Beta(a, b) prior, uniform by default. `slab` None learns
    its variance too, under an inverse-Gamma(2, 2): the non-zero biases are then Student t of 4 degrees of freedom.
    """

    share: float | None = None
    slab: float | None = 1.0
    a: float = 1.0
    b: float = 1.0

    hierarchical = True
    dense = False

    def __post_init__(self):
        super().__post_init__()
        if self.share is not None and not 0 < self.share < 1:
            raise InputError(f"BernoulliGaussian(share={self.share}): it must lie between 0 and 1, or be None")
        for name in ("slab", "a", "b"):
            value = getattr(self, name)
            if not (name == "slab" and value is None) and not (np.isfinite(value) and value > 0):
                raise InputError(f"BernoulliGaussian({name}={value}): give a positive number")

    def adaptive(self) -> "BernoulliGaussian":
        """The one whose share and slab are learnt."""
        return replace(self, share=None, slab=None)


def by_kind(first: Prior, priors: Mapping[str, Prior]) -> Prior:
    """The prior of a mapping from label pattern to prior; biases that none matches have that of "*", else `first`.

    Of several other patterns that match a bias the last one counts. The type of the result is that of a sparse prior
    where one is among them, since that decides which method takes it.

    >>> by_kind(Horseshoe(), {"*.delay": Gaussian()}).kinds
    (('*.delay', Gaussian(correlation=(), kinds=())),)
    """
    given = dict(priors)
    rest = given.pop("*", first)
    every = {"*": rest} | given
    sparse = [prior for prior in every.values() if isinstance(prior, Prior) and prior.hierarchical]
    core = sparse[0] if sparse else rest if isinstance(rest, Prior) else first
    plain = core is first or isinstance(core, Flat)
    return replace(core, correlation=first.correlation if core is first else (), kinds=given if plain else every)


def as_prior(prior: Any, first: Prior, labels: Sequence[str] = ()) -> Prior:
    """The prior that is given, by a mapping from label pattern too, or `first` where none is.

    Raises `InputError` for what is no prior, and for a pattern that governs none of the biases of these labels.
    """
    found = first if prior is None else by_kind(first, prior) if isinstance(prior, Mapping) else prior
    if not isinstance(found, Prior):
        raise InputError(
            f"the prior is {prior!r}; give a prior itself, such as Horseshoe() or Gaussian(), or a mapping from label"
            ' pattern to prior, such as {"*.delay": Gaussian()}'
        )
    if labels:
        found.check_kinds(labels)
    return found


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
    "horseshoe-axis": Horseshoe(by=None),
    "bernoulli-gaussian": BernoulliGaussian(),
}
