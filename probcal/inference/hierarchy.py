"""The form of a prior for samplers: hyper-parameters, their densities, and their conjugate updates
given the biases.

A `Hierarchy` is the static part (which biases it governs, in which groups); its variables `phi` are a dict of arrays.
Given them the biases are Gaussian of precision `alpha(phi)`, so that every prior but the spike is a scale mixture. To
add one: a class here with its `hyper` distributions and its `updates`, and a line in `KINDS`. Kinds of biases with
priors of their own are a `Product` of such parts.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING, Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from probcal.errors import InputError
from probcal.inference.draws import inverse_gaussian, normals, slice_step, uniforms
from probcal.lazy import Later
from probcal.priors import ARD, BernoulliGaussian, Flat, Gaussian, Horseshoe, Laplace, Prior
from probcal.problem import Problem
from probcal.results.schema import ROPE

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

    @property
    def spiked(self) -> tuple[int, ...]:
        """Biases that may be exactly zero, of which `phi["included"]` says which are not."""
        return ()

    def share(self, phi: Phi) -> jax.Array:
        """The prior probability that a spiked bias is not zero, one number or one per spiked bias."""
        raise AssertionError("no bias of this prior can be exactly zero")

    def belongs(self, name: str) -> str:
        """Whose a hyper-parameter is: of each governed "bias", of each "group" of them, or of "all".

        The own ones of groups are those of the biases where each bias is a group of its own.
        """
        if name == self.own and self.group != tuple(range(len(self.learnt))):
            return "group"
        return "bias" if name in (self.own, *self.by_bias) else "all"

    def variables(self, labels: Sequence[str], phi: Mapping[str, Any]) -> dict[str, Any]:
        """Hyper-parameters by draw for biases of these labels: name -> (dims beyond chain and draw, values, coords)."""
        governed, found = {"governed_label": [labels[m] for m in self.learnt]}, dict[str, Any]()
        first = {"precision_group": [labels[self.learnt[self.group.index(g)]] for g in range(self.count)]}
        for name, values in phi.items():
            whose = self.belongs(name)
            if whose == "bias":
                found[name] = (("governed_label",), values, governed)
            else:
                found[name] = ((), values) if whose == "all" else (("precision_group",), values, first)
        return found

    @abstractmethod
    def hyper(self) -> Mapping[str, dist.Distribution]:
        """Independent prior distributions of the continuous hyper-parameters."""

    @abstractmethod
    def drawn(self) -> dict[str, Callable[[jax.Array], jax.Array]]:
        """The functions of a key that draw them; apart from `hyper`, to draw without numpyro."""

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
        """A mask (M,) of the biases that are not exactly zero."""
        return jnp.ones(biases, bool)

    def draw(self, key: jax.Array) -> Phi:
        """One draw of the hyper-parameters from their prior."""
        drawn = self.drawn()
        keys = jax.random.split(key, len(drawn) + 1)
        return {name: one(k) for (name, one), k in zip(drawn.items(), keys, strict=False)}

    def begin(self, chains: int) -> dict[str, np.ndarray]:
        """Far starts of chains on a Gaussian likelihood: one level of all hyper-parameters of each."""
        levels, shapes = np.geomspace(0.03, 0.97, chains), jax.eval_shape(lambda: self.draw(jax.random.key(0)))
        return {
            name: np.moveaxis(np.full((*own.shape, chains), levels), -1, 0).astype(own.dtype)
            for name, own in shapes.items()
        }

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


class GammaPrecision(Hierarchy):
    """ARD: one precision a group with a Gamma hyper-prior; the biases are then Student-t."""

    own = "alpha"

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

    @property
    def _widths(self) -> tuple[float, float, float]:
        """Width of the global scale; shape and scale of the slab variance."""
        half = 0.5 * self.prior.slab_df
        return self.prior.expected / (1.0 - self.prior.expected), half, half * self.prior.slab_scale**2

    def hyper(self):
        """Local scales (groups,), global scale, slab variance; in declared scales."""
        width, half, slab = self._widths
        return {
            "local_scale": dist.HalfCauchy(jnp.ones(self.count)),
            "global_scale": dist.HalfCauchy(width),
            "slab_variance": dist.InverseGamma(half, slab),
        }

    def drawn(self):
        """Half-Cauchy by the modulus, inverse Gamma by the reciprocal."""
        width, half, slab = self._widths
        return {
            "local_scale": lambda key: jnp.abs(jax.random.cauchy(key, (self.count,))),
            "global_scale": lambda key: jnp.abs(width * jax.random.cauchy(key)),
            "slab_variance": lambda key: slab / jax.random.gamma(key, half),
        }

    def governed(self, phi):
        """Slab and shrinkage added."""
        local = phi["local_scale"][jnp.asarray(self.group)]
        return 1.0 / phi["slab_variance"] + 1.0 / (phi["global_scale"] * local) ** 2

    def updates(self):
        """Local scales by the auxiliary form (Makalic, Schmidt 2016) made exact for the slab; the others by slices."""
        width, half, scale = self._widths
        group = jnp.asarray(self.group)
        members = np.bincount(self.group, minlength=self.count)

        def total(z: jax.Array) -> jax.Array:
            return jnp.zeros(self.count).at[group].add(z**2)

        def standard_gamma(alone: jax.Array, key: jax.Array) -> jax.Array:
            """Gamma draws of shape (members + 1) / 2, of one member the exponential `alone`.

            They are halves of chi-squares: the sampler of jax would take a second to compile.
            """
            if (members == 1).all():
                return alone
            number = np.arange(members.max(initial=0) + 1)
            squares = normals(key, (self.count, len(number))) ** 2
            return 0.5 * jnp.sum(jnp.where(number <= members[:, None], squares, 0.0), 1)

        def local(phi: Phi, z: jax.Array, key: jax.Array) -> Phi:
            square, tau2 = phi["local_scale"] ** 2, phi["global_scale"] ** 2
            drawn = -jnp.log1p(-uniforms(key, (3, self.count)))  # exponential
            auxiliary = (1.0 + 1.0 / square) / drawn[0]
            proposal = (1.0 / auxiliary + 0.5 * total(z) / tau2) / standard_gamma(drawn[1], jax.random.fold_in(key, 1))
            ratio = 0.5 * (
                jnp.log1p(tau2 * proposal / phi["slab_variance"]) - jnp.log1p(tau2 * square / phi["slab_variance"])
            )
            taken = -drawn[2] < jnp.asarray(members) * ratio
            return phi | {"local_scale": jnp.sqrt(jnp.where(taken, proposal, square))}

        def density(z: jax.Array, local: jax.Array, logs: jax.Array) -> jax.Array:
            tau, slab = jnp.exp(logs)
            alpha = jnp.clip(1.0 / slab + 1.0 / (tau * local[group]) ** 2, LEAST, MOST)
            own = logs[0] - jnp.log1p((tau / width) ** 2) - half * logs[1] - scale / slab
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
    shape: ClassVar[float] = 2.0  # and rate of the Gamma of a learnt slab precision: 4 degrees of freedom

    @property
    def spiked(self):
        """All that it governs."""
        return self.learnt

    def hyper(self):
        """The share of the biases that are not zero, and the precision of these, where they are not given."""
        share = {} if self.prior.share is not None else {"share": dist.Beta(self.prior.a, self.prior.b)}
        return share if self.prior.slab is not None else share | {"slab_precision": dist.Gamma(self.shape, self.shape)}

    def drawn(self):
        """Beta and Gamma, where they are not given."""
        found = {}
        if self.prior.share is None:
            both = jnp.array([self.prior.a, self.prior.b])
            found["share"] = lambda key: jax.random.dirichlet(key, both)[0]
        if self.prior.slab is None:
            found["slab_precision"] = lambda key: jax.random.gamma(key, self.shape) / self.shape
        return found

    def governed(self, phi):
        """The slab."""
        precision = phi["slab_precision"] if self.prior.slab is None else 1.0 / self.prior.slab**2
        return jnp.full(len(self.learnt), precision)

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
        """The conjugate Beta of the share, and the conjugate Gamma of the precision of the biases that are in."""

        def share(phi: Phi, z: jax.Array, key: jax.Array) -> Phi:
            number = jnp.sum(phi["included"])
            out = len(self.learnt) - number
            return phi | {"share": jax.random.beta(key, self.prior.a + number, self.prior.b + out)}

        def slab(phi: Phi, z: jax.Array, key: jax.Array) -> Phi:
            number, square = jnp.sum(phi["included"]), jnp.sum(jnp.where(phi["included"], z**2, 0.0))
            drawn = jax.random.gamma(key, self.shape + 0.5 * number)
            return phi | {"slab_precision": drawn / (self.shape + 0.5 * square)}

        return [share] * (self.prior.share is None) + [slab] * (self.prior.slab is None)


@dataclass(frozen=True)
class Product(Hierarchy):
    """Hierarchies of disjoint biases, each with hyper-parameters of its own, called `<name>_<part>`.

    That of a Gaussian or flat prior has no part.
    """

    pieces: tuple[tuple[str, Hierarchy], ...] = ()

    @classmethod
    def of(cls, prior: Prior, parts: Sequence[tuple[str, Hierarchy]]) -> Product:
        """The product of named parts; a part without a name keeps the names of its hyper-parameters."""
        before = np.cumsum([0, *(one.count for _, one in parts)]).tolist()
        learnt = tuple(m for _, one in parts for m in one.learnt)
        group = tuple(first + g for first, (_, one) in zip(before, parts, strict=False) for g in one.group)
        return cls(prior, learnt, group, tuple(parts))

    @property
    def spiked(self):
        """Those of all parts."""
        return tuple(m for _, one in self.pieces for m in one.spiked)

    def _slices(self, counts: Sequence[int]) -> list[slice]:
        """Places of each part in an array that holds as many entries of each."""
        ends = np.cumsum([0, *counts]).tolist()
        return [slice(*pair) for pair in pairwise(ends)]

    def _parts(self, phi: Mapping[str, Any]) -> list[tuple[str, Hierarchy, Any, slice]]:
        """Each part: name, hierarchy, its hyper-parameters by their own names, and its places in `learnt`."""
        spiked = self._slices([len(one.spiked) for _, one in self.pieces])
        found = []
        for (name, one), mine, inside in zip(
            self.pieces, self._slices([len(one.learnt) for _, one in self.pieces]), spiked, strict=True
        ):
            own = {known: phi[_named(known, name)] for known in one.drawn() if _named(known, name) in phi}
            if one.spiked and "included" in phi:
                own["included"] = phi["included"][..., inside]
            found.append((name, one, own, mine))
        return found

    def _joined(self, found: Sequence[Phi]) -> Phi:
        """Hyper-parameters of all parts as one."""
        inside = [own["included"] for own in found if "included" in own]
        joined = {
            _named(known, name): value
            for (name, _), own in zip(self.pieces, found, strict=True)
            for known, value in own.items()
            if known != "included"
        }
        return joined | ({"included": jnp.concatenate(inside, -1)} if inside else {})

    def variables(self, labels, phi):
        """Those of every part, with dimensions of its own."""
        found = dict[str, Any]()
        for name, one, own, _ in self._parts(phi):
            for known, (dims, values, *coords) in one.variables(labels, own).items():
                renamed = [{_named(dim, name): c for dim, c in each.items()} for each in coords]
                found[_named(known, name)] = (tuple(_named(dim, name) for dim in dims), values, *renamed)
        return found

    def hyper(self):
        """Those of every part."""
        return {_named(known, name): d for name, one in self.pieces for known, d in one.hyper().items()}

    def drawn(self):
        """Those of every part."""
        return {_named(known, name): d for name, one in self.pieces for known, d in one.drawn().items()}

    def governed(self, phi):
        """Part by part."""
        return jnp.concatenate([one.governed(own) for _, one, own, _ in self._parts(phi)])

    def active(self, phi, biases):
        """Those that no part takes out."""
        active = jnp.ones(biases, bool)
        for _, one, own, _ in self._parts(phi):
            active = active & one.active(own, biases)
        return active

    def share(self, phi):
        """That of its part for every spiked bias."""
        each = [
            jnp.broadcast_to(one.share(own), (len(one.spiked),))
            for _, one, own, _ in self._parts(phi) if one.spiked
        ]  # fmt: skip
        return jnp.concatenate(each)

    def draw(self, key):
        """From the prior of every part."""
        keys = jax.random.split(key, len(self.pieces))
        return self._joined([one.draw(own) for (_, one), own in zip(self.pieces, keys, strict=True)])

    def updates(self):
        """Those of every part, given its own biases."""

        def lifted(k: int, update: Update) -> Update:
            def moved(phi: Phi, z: jax.Array, key: jax.Array) -> Phi:
                name, one, own, mine = self._parts(phi)[k]
                new = update(own, z[mine], key)
                return phi | {_named(known, name): new[known] for known in one.drawn()}

            return moved

        return [lifted(k, update) for k, (_, one) in enumerate(self.pieces) for update in one.updates()]

    def renewed(self, phi, here, there, key):
        """Own values of every part, whose ratios add up."""
        found, total = list[Phi](), jnp.zeros(())
        for (_, one, own, mine), k in zip(self._parts(phi), jax.random.split(key, len(self.pieces)), strict=True):
            new, ratio = one.renewed(own, here[mine], there[mine], k)
            found.append(new)
            total = total + ratio
        return self._joined(found), total


def _named(name: str, part: str) -> str:
    """The name of a hyper-parameter, or dimension, of a part."""
    return f"{name}_{part}" if part else name


KINDS: dict[type, type[Hierarchy]] = {
    ARD: GammaPrecision, Laplace: LaplaceMixture, Horseshoe: RegularisedHorseshoe, BernoulliGaussian: SpikeAndSlab,
}  # fmt: skip


def held(prior: Prior, problem: Problem) -> np.ndarray:
    """Biases (M,) whose Gaussian is known under a prior: those with a survey, and kinds that are Gaussian."""
    parts, part = prior.parts(problem.biases)
    known = np.array([k > 0 and isinstance(one, Gaussian) for k, (_, one) in enumerate(parts)])
    return problem.surveyed | known[part]


def learnt_groups(prior: Prior, problem: Problem) -> np.ndarray:
    """The index (M,) of the learnt precision of each bias, numbered from 0; held ones share
    none."""
    group, count = np.arange(len(problem.biases)), len(problem.biases)
    parts, part = prior.parts(problem.biases)
    for k, (_, one) in enumerate(parts):
        group = np.where(part == k, (k + 1) * count + one.groups(problem.members), group)
    group = np.where(held(prior, problem), np.arange(count), group)
    return np.unique(group, return_inverse=True)[1]


def hierarchy_of(prior: Prior, problem: Problem) -> Hierarchy:
    """The hierarchy of a prior for the biases of a problem; those with a survey keep their own Gaussian.

    Raises `InputError` for an ARD prior whose hyper-prior is not proper: no posterior of the biases exists then; and
    for a prior with hyper-parameters that has no class here.
    """
    named, part = prior.parts(problem.biases)
    found = list[tuple[str, Hierarchy]]()
    for k, (name, one) in enumerate(named):
        learnt = np.flatnonzero(~problem.surveyed & (part == k))
        kind = KINDS.get(type(one))
        if kind is None and (one.hierarchical or one.learns):
            title = type(one).__name__
            raise InputError(
                f"{title} has hyper-parameters but no class that draws them; add one to inference/hierarchy.py"
            )
        if kind is None or not len(learnt):
            continue
        if isinstance(one, ARD) and one.rate == 0.0:
            raise InputError(
                "a sampler needs a proper hyper-prior: ARD(shape=1, rate=0) is flat and its posterior does not exist;"
                ' give ARD(rate=0.5) ("ard-gamma") or Horseshoe()'
            )
        groups = np.unique(one.groups(problem.members)[learnt], return_inverse=True)[1]
        own = replace(one, correlation=prior.correlation)
        word = re.sub(r"\W+", "_", name).strip("_")
        found.append((word, kind(own, tuple(learnt.tolist()), tuple(int(g) for g in groups))))
    if len(found) == 1:
        return found[0][1]
    words = [word for word, _ in found]
    apart = [(f"{word}_{k}" if words.count(word) > 1 else word, one) for k, (word, one) in enumerate(found)]
    return Product.of(prior, apart)


def inclusions(hierarchy: Hierarchy, z: np.ndarray, phi: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Columns by bias: the fraction of draws z (chain, draw, M) beyond the practical zero, and of those that are in."""
    found = {"inclusion": (np.abs(z) > ROPE).mean((0, 1))}
    if "included" in phi:
        found["included"] = np.ones(z.shape[2])
        found["included"][list(hierarchy.spiked)] = np.asarray(phi["included"]).mean((0, 1))
    return found


def drawn_precisions(prior: Prior, hierarchy: Hierarchy, hyper: Mapping[str, Any], first: Any) -> np.ndarray | None:
    """Precision (chain, draw, M) of each bias by draw, (M,) where all draws have the same.

    None where not every bias has one of its own, and where hyper-parameters have no draws.
    """
    if isinstance(prior, Flat) or prior.correlation or hierarchy.spiked or (hierarchy.learnt and not hyper):
        return None
    alpha = _by_draw(hierarchy, dict(hyper), jax.device_put(first)) if hyper else first
    return np.clip(np.asarray(alpha), LEAST, MOST)


@partial(jax.jit, static_argnames="hierarchy")
def _by_draw(hierarchy: Hierarchy, phi: Phi, first: jax.Array) -> jax.Array:
    return jax.vmap(jax.vmap(lambda one: hierarchy.alpha(one, first)))(phi)
