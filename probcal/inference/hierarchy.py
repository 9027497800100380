"""What samplers make of a prior: its hyper-parameters, their densities, and their conjugate updates given the biases.

A `Hierarchy` is the static part (which biases it governs, in which groups); its variables `phi` are a dict of arrays.
Given them the biases are Gaussian of precision `alpha(phi)`, so that every prior but the spike is a scale mixture. To
add one: a class here with its `hyper` distributions and its `updates`, and a line in `hierarchy_of`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from probcal.errors import InputError
from probcal.inference.draws import inverse_gaussian, slice_step
from probcal.lazy import Later
from probcal.priors import ARD, BernoulliGaussian, Horseshoe, Laplace, Prior
from probcal.problem import Problem

if TYPE_CHECKING:
    from numpyro import distributions as dist
else:
    dist = Later("numpyro.distributions")

LEAST, MOST = 1e-12, 1e16  # precisions outside carry no mass that a draw could show
CELLS, NEAR, FAR = 64, -10.0, 10.0  # by which scales of their own are proposed: even cells of their logarithm
Phi = dict[str, jax.Array]
Update = Callable[[Phi, jax.Array, jax.Array], Phi]  # phi, learnt z, key


@dataclass(frozen=True)
class Hierarchy(ABC):
    """A prior over the biases that it governs: `learnt` their numbers, `group` the precision of each."""

    prior: Any
    learnt: tuple[int, ...]
    group: tuple[int, ...]

    sweeps: ClassVar[int] = 10  # Gibbs sweeps a leap that pay for themselves
    by_bias: ClassVar[tuple[str, ...]] = ()  # hyper-parameters that have a value a governed bias
    own: ClassVar[str] = ""  # the positive hyper-parameter of which each group has its own, independent of the others

    @property
    def count(self) -> int:
        """Number of precisions."""
        return max(self.group, default=-1) + 1

    def belongs(self, name: str) -> str:
        """Whose a hyper-parameter is: of each "bias" that is governed, of each "group" of them, or of "all"."""
        return "bias" if name in self.by_bias else "all"

    def variables(self, labels: Sequence[str], phi: Mapping[str, Any]) -> dict[str, Any]:
        """Hyper-parameters by draw for biases of these labels: name -> (dims beyond chain and draw, values, coords)."""
        governed, found = {"governed_label": [labels[m] for m in self.learnt]}, dict[str, Any]()
        for name, values in phi.items():
            whose = self.belongs(name)
            if whose == "bias":
                found[name] = (("governed_label",), values, governed)
            else:
                found[name] = ((), values) if whose == "all" else (("precision_group",), values)
        return found

    @abstractmethod
    def hyper(self) -> Mapping[str, dist.Distribution]:
        """Independent prior distributions of the continuous hyper-parameters."""

    @abstractmethod
    def drawn(self) -> dict[str, Callable[[jax.Array], jax.Array]]:
        """How each of them is drawn by a key; apart from `hyper`, so that what only draws need not load numpyro."""

    @abstractmethod
    def governed(self, phi: Phi) -> jax.Array:
        """Precision of each governed bias, (L,)."""

    @abstractmethod
    def updates(self) -> list[Update]:
        """Kernels that each leave p(phi | z) invariant and are reversible, z (L,) the governed biases."""

    def alpha(self, phi: Phi, first: jax.Array) -> jax.Array:
        """Precisions of all biases (M,): those of `first`, but for the governed ones."""
        if not self.learnt:
            return first
        return first.at[jnp.asarray(self.learnt)].set(jnp.clip(self.governed(phi), LEAST, MOST))

    def active(self, phi: Phi, biases: int) -> jax.Array:
        """Which biases are not exactly zero, (M,)."""
        return jnp.ones(biases, bool)

    def draw(self, key: jax.Array) -> Phi:
        """One draw of the hyper-parameters from their prior."""
        drawn = self.drawn()
        keys = jax.random.split(key, len(drawn) + 1)
        return {name: one(k) for (name, one), k in zip(drawn.items(), keys, strict=False)}

    def begin(self, key: jax.Array) -> Phi:
        """Where a chain on a Gaussian likelihood starts: a draw from the prior, unless said otherwise."""
        return self.draw(key)

    def log_prior(self, phi: Phi) -> jax.Array:
        """Log density of the hyper-parameters."""
        return sum((jnp.sum(d.log_prob(phi[name])) for name, d in self.hyper().items()), jnp.zeros(()))

    def cells(self, phi: Phi, z: jax.Array) -> jax.Array:
        """Log probability (cells, groups) that the own value of a group lies in a cell, given the rest and z (L,).

        The conditional density by its value in the middle: what a proposal needs that can be weighed both ways.
        """
        prior, group, width = self.hyper()[self.own], jnp.asarray(self.group), (FAR - NEAR) / CELLS

        def density(log: jax.Array) -> jax.Array:
            values = jnp.full(self.count, jnp.exp(log))
            alpha = jnp.clip(self.governed(phi | {self.own: values}), LEAST, MOST)
            told = jnp.zeros(self.count).at[group].add(0.5 * (jnp.log(alpha) - alpha * z**2))
            return prior.log_prob(values) + log + told

        return jax.nn.log_softmax(jax.vmap(density)(NEAR + width * (jnp.arange(CELLS) + 0.5)), 0)

    def renewed(self, phi: Phi, here: jax.Array, there: jax.Array, key: jax.Array) -> tuple[Phi, jax.Array]:
        """Own values drawn anew for biases that move from here to there (L,), and what the draw adds to a log ratio.

        That is the prior of the new values over that of the old ones, and the density of the way back over that of
        the way there; minus infinity where the old values lie outside the cells.
        """
        if not self.own:
            return phi, jnp.zeros(())
        keys, width = jax.random.split(key), (FAR - NEAR) / CELLS
        back, forth = self.cells(phi, here), self.cells(phi, there)
        new = jax.random.categorical(keys[0], forth, 0)
        logs = NEAR + width * (new + jax.random.uniform(keys[1], new.shape))
        before = jnp.log(phi[self.own])
        old = jnp.floor((before - NEAR) / width).astype(int)
        inside = (old >= 0) & (old < CELLS)
        way = jnp.where(inside, back[jnp.clip(old, 0, CELLS - 1), jnp.arange(self.count)], -jnp.inf)
        prior = self.hyper()[self.own]
        own = prior.log_prob(jnp.exp(logs)) + logs - prior.log_prob(phi[self.own]) - before
        return phi | {self.own: jnp.exp(logs)}, jnp.sum(own + way - forth[new, jnp.arange(self.count)])

    def constrain(self, free: Phi) -> tuple[Phi, jax.Array]:
        """Hyper-parameters of unconstrained values, and the log density of these under the prior."""
        phi, density = {}, jnp.zeros(())
        for name, d in self.hyper().items():
            to = _from_line(d)
            phi[name] = to(free[name])
            density = density + jnp.sum(d.log_prob(phi[name])) + jnp.sum(to.log_abs_det_jacobian(free[name], phi[name]))
        return phi, density

    def relax(self, phi: Phi) -> Phi:
        """Unconstrained values of hyper-parameters."""
        return {name: _from_line(d).inv(phi[name]) for name, d in self.hyper().items()}


def _from_line(d: dist.Distribution) -> dist.transforms.Transform:
    """From the real line to the support: Gamma variables by softplus, so that no tail is steeper than exponential."""
    if not isinstance(d, dist.Gamma | dist.Exponential):
        return dist.biject_to(d.support)
    scale = dist.transforms.AffineTransform(0.0, 1.0 / d.rate, domain=dist.constraints.positive)
    return dist.transforms.ComposeTransform([dist.transforms.SoftplusTransform(), scale])


class NoHyperprior(Hierarchy):
    """A prior without hyper-parameters: Gaussian or flat."""

    def hyper(self):
        """None."""
        return {}

    def drawn(self):
        """None."""
        return {}

    def governed(self, phi):
        """None."""
        raise AssertionError("a known prior governs no bias")

    def updates(self):
        """None."""
        return []


class GammaPrecision(Hierarchy):
    """ARD: one precision a group with a Gamma hyper-prior; the biases are then Student-t."""

    own = "alpha"

    def belongs(self, name):
        """Precisions are those of groups; where each bias is a group of its own, of the biases."""
        return "bias" if self.group == tuple(range(len(self.learnt))) else "group"

    def hyper(self):
        """Precisions, (groups,)."""
        return {"alpha": dist.Gamma(self.prior.shape * jnp.ones(self.count), self.prior.rate)}

    def drawn(self):
        """Gamma."""
        return {"alpha": lambda key: jax.random.gamma(key, self.prior.shape, (self.count,)) / self.prior.rate}

    def governed(self, phi):
        """The precision of the group."""
        return phi["alpha"][jnp.asarray(self.group)]

    def updates(self):
        """The conjugate Gamma."""

        def alpha(phi: Phi, z: jax.Array, key: jax.Array) -> Phi:
            group = jnp.asarray(self.group)
            square = jnp.zeros(self.count).at[group].add(z**2)
            number = jnp.zeros(self.count).at[group].add(1.0)
            drawn = jax.random.gamma(key, self.prior.shape + 0.5 * number)
            return phi | {"alpha": drawn / (self.prior.rate + 0.5 * square)}

        return [alpha]


class LaplaceMixture(Hierarchy):
    """Laplace density as a Gaussian of exponential variance (Park, Casella 2008)."""

    by_bias = ("variance",)
    own = "variance"

    def hyper(self):
        """Variances, (L,)."""
        return {"variance": dist.Exponential(0.5 * self.prior.rate**2 * jnp.ones(len(self.learnt)))}

    def drawn(self):
        """Exponential."""
        L = len(self.learnt)
        return {"variance": lambda key: jax.random.exponential(key, (L,)) / (0.5 * self.prior.rate**2)}

    def governed(self, phi):
        """One over the variance."""
        return 1.0 / phi["variance"]

    def updates(self):
        """Inverse Gaussian precisions."""

        def variance(phi: Phi, z: jax.Array, key: jax.Array) -> Phi:
            mean = self.prior.rate / jnp.maximum(jnp.abs(z), 1e-150)
            return {"variance": 1.0 / jnp.maximum(inverse_gaussian(key, mean, self.prior.rate**2), 1e-300)}

        return [variance]


class RegularisedHorseshoe(Hierarchy):
    """Half-Cauchy local and global scales, cut by a slab (Piironen, Vehtari 2017): alpha = 1/c^2 + 1/(tau lambda)^2."""

    own = "local_scale"

    def belongs(self, name):
        """Local scales are those of groups; where each bias is a group of its own, of the biases."""
        if name != "local_scale":
            return "all"
        return "bias" if self.group == tuple(range(len(self.learnt))) else "group"

    def hyper(self):
        """Local scales (groups,), global scale, slab variance; in declared scales."""
        half = 0.5 * self.prior.slab_df
        return {
            "local_scale": dist.HalfCauchy(jnp.ones(self.count)),
            "global_scale": dist.HalfCauchy(self.prior.expected / (1.0 - self.prior.expected)),
            "slab_variance": dist.InverseGamma(half, half * self.prior.slab_scale**2),
        }

    def drawn(self):
        """Half-Cauchy by the modulus, inverse Gamma by the reciprocal."""
        width = self.prior.expected / (1.0 - self.prior.expected)
        half = 0.5 * self.prior.slab_df
        return {
            "local_scale": lambda key: jnp.abs(jax.random.cauchy(key, (self.count,))),
            "global_scale": lambda key: jnp.abs(width * jax.random.cauchy(key)),
            "slab_variance": lambda key: half * self.prior.slab_scale**2 / jax.random.gamma(key, half),
        }

    def begin(self, key):
        """Scales from their prior, the slab as declared: its Gamma variable would take a second to compile."""
        drawn, keys = self.drawn(), jax.random.split(key)
        names = ("local_scale", "global_scale")
        scales = {name: drawn[name](k) for name, k in zip(names, keys, strict=True)}
        return scales | {"slab_variance": jnp.full((), self.prior.slab_scale**2, float)}

    def governed(self, phi):
        """Slab and shrinkage added."""
        local = phi["local_scale"][jnp.asarray(self.group)]
        return 1.0 / phi["slab_variance"] + 1.0 / (phi["global_scale"] * local) ** 2

    def updates(self):
        """Local scales by the auxiliary form (Makalic, Schmidt 2016) made exact for the slab; the others by slices."""
        width = self.prior.expected / (1.0 - self.prior.expected)
        half = 0.5 * self.prior.slab_df
        group = jnp.asarray(self.group)
        members = np.bincount(self.group, minlength=self.count)

        def total(z: jax.Array) -> jax.Array:
            return jnp.zeros(self.count).at[group].add(z**2)

        def standard_gamma(key: jax.Array) -> jax.Array:
            """Gamma draws of shape (members + 1) / 2, of one member an exponential."""
            if (members == 1).all():
                return jax.random.exponential(key, (self.count,))
            return jax.random.gamma(key, 0.5 * (jnp.asarray(members) + 1.0))

        def local(phi: Phi, z: jax.Array, key: jax.Array) -> Phi:
            keys = jax.random.split(key, 3)
            square, tau2 = phi["local_scale"] ** 2, phi["global_scale"] ** 2
            auxiliary = (1.0 + 1.0 / square) / jax.random.exponential(keys[0], square.shape)
            proposal = (1.0 / auxiliary + 0.5 * total(z) / tau2) / standard_gamma(keys[1])
            ratio = 0.5 * (
                jnp.log1p(tau2 * proposal / phi["slab_variance"]) - jnp.log1p(tau2 * square / phi["slab_variance"])
            )
            taken = jnp.log(jax.random.uniform(keys[2], square.shape)) < jnp.asarray(members) * ratio
            return phi | {"local_scale": jnp.sqrt(jnp.where(taken, proposal, square))}

        def density(z: jax.Array, local: jax.Array, logs: jax.Array) -> jax.Array:
            tau, slab = jnp.exp(logs)
            alpha = jnp.clip(1.0 / slab + 1.0 / (tau * local[group]) ** 2, LEAST, MOST)
            own = logs[0] - jnp.log1p((tau / width) ** 2) - half * logs[1] - half * self.prior.slab_scale**2 / slab
            return own + 0.5 * jnp.sum(jnp.log(alpha) - alpha * z**2)

        def shared(phi: Phi, z: jax.Array, key: jax.Array) -> Phi:
            logs = jnp.log(jnp.stack([phi["global_scale"], phi["slab_variance"]]))

            def one(logs: jax.Array, turn: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, None]:
                k, own = turn
                moved = slice_step(own, logs[k], lambda t: density(z, phi["local_scale"], logs.at[k].set(t)))
                return logs.at[k].set(moved), None

            logs, _ = jax.lax.scan(one, logs, (jnp.array([0, 1, 0]), jax.random.split(key, 3)))
            return phi | {"global_scale": jnp.exp(logs[0]), "slab_variance": jnp.exp(logs[1])}

        return [local, shared]


class SpikeAndSlab(Hierarchy):
    """Bernoulli-Gaussian: which biases are in, and the share of them; `posed.update_inclusions` moves the first."""

    by_bias = ("included",)

    sweeps = 2

    def hyper(self):
        """The share of the biases that are not zero, where it is not given."""
        return {} if self.prior.share is not None else {"share": dist.Beta(self.prior.a, self.prior.b)}

    def drawn(self):
        """Beta, where it is not given."""
        if self.prior.share is not None:
            return {}
        both = jnp.array([self.prior.a, self.prior.b])
        return {"share": lambda key: jax.random.dirichlet(key, both)[0]}

    def governed(self, phi):
        """The slab."""
        return jnp.full(len(self.learnt), 1.0 / self.prior.slab**2)

    def active(self, phi, biases):
        """Those that are in, and all that the prior does not govern."""
        return jnp.ones(biases, bool).at[jnp.asarray(self.learnt, int)].set(phi["included"])

    def share(self, phi: Phi) -> jax.Array:
        """The share of the biases that are not zero."""
        return phi["share"] if self.prior.share is None else jnp.asarray(self.prior.share)

    def draw(self, key):
        """Share and inclusions from the prior."""
        keys = jax.random.split(key)
        phi = super().draw(keys[0])
        return phi | {"included": jax.random.uniform(keys[1], (len(self.learnt),)) < self.share(phi)}

    def updates(self):
        """The conjugate Beta of the share."""

        def share(phi: Phi, z: jax.Array, key: jax.Array) -> Phi:
            number = jnp.sum(phi["included"])
            out = len(self.learnt) - number
            return phi | {"share": jax.random.beta(key, self.prior.a + number, self.prior.b + out)}

        return [share] if self.prior.share is None else []


def learnt_groups(prior: Prior, problem: Problem) -> np.ndarray:
    """Which learnt precision governs each bias, (M,), numbered from 0; those with a survey share none."""
    group = prior.groups(problem.members)
    group = np.where(problem.surveyed, len(group) + np.arange(len(group)), group)
    return np.unique(group, return_inverse=True)[1]


def hierarchy_of(prior: Prior, problem: Problem) -> Hierarchy:
    """The hierarchy of a prior for the biases of a problem; those with a survey keep their own Gaussian.

    Raises `InputError` for an ARD prior whose hyper-prior is not proper: no posterior of the biases exists then; and
    for a prior with hyper-parameters that has no class here.
    """
    learnt = np.flatnonzero(~problem.surveyed)
    groups = np.unique(prior.groups(problem.members)[learnt], return_inverse=True)[1] if len(learnt) else learnt
    kinds: dict[type, type[Hierarchy]] = {
        ARD: GammaPrecision, Laplace: LaplaceMixture, Horseshoe: RegularisedHorseshoe, BernoulliGaussian: SpikeAndSlab,
    }  # fmt: skip
    kind = kinds.get(type(prior))
    if kind is None and (prior.hierarchical or prior.learns):
        name = type(prior).__name__
        raise InputError(f"{name} has hyper-parameters but no class that draws them; add one to inference/hierarchy.py")
    if kind is None or not len(learnt):
        return NoHyperprior(prior, (), ())
    if isinstance(prior, ARD) and prior.rate == 0.0:
        raise InputError(
            "a sampler needs a proper hyper-prior: ARD(shape=1, rate=0) is flat and its posterior does not exist;"
            ' give ARD(rate=0.5) ("ard-gamma") or Horseshoe()'
        )
    return kind(prior, tuple(learnt.tolist()), tuple(int(g) for g in groups))
