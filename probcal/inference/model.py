"""The joint posterior as a numpyro model, open to every kernel, guide and handler of numpyro.

Nothing of the frame enters the density: sites are the declared quantities, trajectories written by their whitened
noises.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
from numpyro import distributions as dist

from probcal.errors import InputError, check_known
from probcal.gaussian.frame import frame_at
from probcal.gaussian.information import at_levels
from probcal.gaussian.mode import Point, driven_states
from probcal.inference.hierarchy import Hierarchy, Phi, hierarchy_of
from probcal.inference.pose import pilot
from probcal.inference.posed import Form, Posed
from probcal.lazy import xr
from probcal.model import rows
from probcal.model.model import Model
from probcal.model.rows import Block, Rows
from probcal.modes import automatic_start
from probcal.modes.grid import track_mode
from probcal.priors import PRIORS, AnyPrior, Flat, Horseshoe, Precision, as_prior
from probcal.problem import Problem, check_linear
from probcal.results.read import apply
from probcal.types import float64


def suffix(problem: Problem, r: int) -> str:
    """The ending of the site names of recursion r: empty where there is only one recursion."""
    return "" if len(problem.epochs) == 1 else f"_{r}"


class Measured(dist.Distribution):
    """The data of a block of rows around their predicted values, shape (N, C), every datum a batch entry.

    A datum without a measured value (blank in the table, or NaN in what is given) has log density 0, and is drawn like
    any other.
    """

    arg_constraints: ClassVar[dict[str, Any]] = {}
    support = dist.constraints.real
    pytree_data_fields = ("rows", "predicted", "levels")
    pytree_aux_fields = ("block",)

    def __init__(self, block: Block, rows_: Rows, predicted: jax.Array, levels: jax.Array):
        self.block, self.rows, self.predicted, self.levels = block, rows_, predicted, levels
        super().__init__(batch_shape=predicted.shape)

    def sample(self, key: jax.Array, sample_shape: tuple[int, ...] = ()) -> jax.Array:
        """Draws (*sample_shape, N, C), angles wrapped."""

        def one(key: jax.Array) -> jax.Array:
            return rows.sample(self.block, self.rows, self.predicted, self.levels, key)

        drawn = jax.vmap(one)(jax.random.split(key, math.prod(sample_shape)))
        return drawn.reshape(*sample_shape, *self.batch_shape)

    def log_prob(self, value: jax.Array) -> jax.Array:
        """Log density (..., N, C) of every datum of values (..., N, C)."""

        def one(value: jax.Array) -> jax.Array:
            there = ~jnp.isnan(value)
            given = self.rows._replace(y=jnp.where(there, value, 0.0), mask=self.rows.mask * there)
            return rows.log_likelihood(self.block, given, self.predicted, self.levels)

        return jax.vmap(one)(value.reshape(-1, *self.batch_shape)).reshape(value.shape)


class Mixed(dist.Distribution):
    """Process noises (E, n) of one recursion, some of them scale mixtures whose precisions are integrated."""

    support = dist.constraints.independent(dist.constraints.real, 2)

    def __init__(self, model: Model, r: int):
        self.model, self.r = model, r
        super().__init__((), model.recursions[r].drift.shape)

    def sample(self, key: jax.Array, sample_shape: tuple[int, ...] = ()) -> jax.Array:
        """Draws (*sample_shape, E, n)."""
        drawn = self.model.draw_noises(key, self.r, math.prod(sample_shape))
        return jnp.moveaxis(drawn, 2, 0).reshape(*sample_shape, *self.event_shape)

    def log_prob(self, value: jax.Array) -> jax.Array:
        """Log density (...) of noises (..., E, n)."""
        found = jnp.sum(-0.5 * value**2 - 0.5 * math.log(2 * math.pi), (-1, -2))
        for tail in self.model.recursions[self.r].tails:
            square = jnp.sum(value[..., slice(*tail.columns)] ** 2, -1)
            found = found + jnp.sum(jnp.where(tail.on, tail.family.mixing_density(square, tail.size), 0.0), -1)
        return found


@float64
def numpyro_model(problem: Problem, *, prior: AnyPrior = None) -> NumpyroModel:
    """The joint posterior of a problem as a numpyro model `model(data=None, *, observed=True)`.

    `model()` conditions on the problem's own rows. `data` maps sites `y_TYPE` to other values (N, C), NaN where
    missing, in the order of `problem.row_index`; other sites keep theirs. `observed=False` leaves every one free, as
    `Predictive` needs it. `prior` is `Horseshoe()` by default.

    Sites: the hyper-parameters of the prior (`local_scale`, `global_scale`, `slab_variance` of the horseshoe, `alpha`
    of ARD, `variance` of Laplace), `z` (M,) biases over scales, `level` (H,) log levels over their guesses, `noise`
    (E, n) whitened noises of the trajectories, `y_TYPE`; deterministic `bias` (M,) in units and `state` (E, n). With
    several recursions `noise`, `state` and the `y_TYPE` of a type that sees several end in `_0`, `_1`, ...

    numpyro's own start is a track far from the data, from which kernels and guides may never find the posterior.
    `model.start()` gives values of all latent sites at the automatic start, `model.start(tree)` at a fit's result;
    `model.dims` and `model.coords` label what is drawn::

        import arviz as az, jax
        from numpyro.infer import MCMC, NUTS, init_to_value

        with jax.enable_x64(True):
            model = numpyro_model(problem, prior=prior)
            kernel = NUTS(model, init_strategy=init_to_value(values=model.start()))
            mcmc = MCMC(kernel, num_warmup=500, num_samples=500)
            mcmc.run(jax.random.key(0))
            tree = az.from_numpyro(mcmc, dims=model.dims, coords=model.coords)

    and a guide is `AutoMultivariateNormal(model, init_loc_fn=init_to_value(values=model.start()), init_scale=0.01)`.
    The sites are not whitened by the data: with precise bearings and starts that are not declared numpyro's kernels
    mix slowly; look at r_hat, or take `fit(problem, probcal.NUTS())`.

    numpyro must run in double precision: `numpyro.enable_x64()`, or all of it inside `with jax.enable_x64(True):`.
    Raises `InputError` for a prior without density (`BernoulliGaussian`), and the model for single precision, for
    unknown sites and for values of another shape.
    """
    chosen = as_prior(prior, Horseshoe(), problem.network.labels)
    hierarchy = hierarchy_of(chosen, problem)
    if hierarchy.spiked:
        known = dict.fromkeys(type(one).__name__ for one in PRIORS.values() if one.dense)
        raise InputError(
            f"numpyro_model: {chosen.title(problem.biases)} has no density that numpyro could take; give one of"
            f" {', '.join(known)}, or fit it by Collapsed()"
        )
    check_linear(problem)
    return NumpyroModel(problem, hierarchy, problem.first_precision(chosen))


@dataclass(frozen=True, eq=False)
class NumpyroModel:
    """The joint posterior of a problem for numpyro (see `numpyro_model`)."""

    problem: Problem
    hierarchy: Hierarchy
    first: Precision  # prior of the biases that no hierarchy governs

    @cached_property
    def sites(self) -> list[str]:
        """Names of the observed sites, one for each block of rows."""
        model = self.problem.model
        kinds = [block.type.name for block in model.blocks]
        return [
            f"y_{name}{suffix(self.problem, r) if kinds.count(name) > 1 else ''}"
            for name, r in zip(kinds, model.recursion, strict=True)
        ]

    def __call__(self, data: Mapping[str, Any] | None = None, *, observed: bool = True) -> None:
        """Sample every site, in double precision only."""
        if jnp.zeros(()).dtype != jnp.float64:
            raise InputError(
                "a numpyro_model runs in double precision only: call numpyro.enable_x64() before,"
                " or run numpyro inside `with jax.enable_x64(True):`"
            )
        of = self.problem.model
        given = _given(data, self.sites, of.rows)
        phi = {name: numpyro.sample(name, d.to_event()) for name, d in self.hierarchy.hyper().items()}
        z = _biases(self.hierarchy, self.first, phi)
        numpyro.deterministic("bias", jnp.asarray(self.problem.scales) * z)
        levels = jnp.zeros(0)
        if self.problem.levels:
            levels = numpyro.sample("level", dist.Normal(0.0, of.level_spread).to_event())
        states = []
        for r, part in enumerate(of.recursions):
            s = suffix(self.problem, r)
            unit = Mixed(of, r) if part.tails else dist.Normal(jnp.zeros_like(part.drift), 1.0).to_event()
            u = numpyro.sample(f"noise{s}", unit)
            states.append(numpyro.deterministic(f"state{s}", driven_states(part, levels, u)))
        for block, own, r, site in of.each_block(self.sites):
            predicted = rows.predict(block, own, states[r], z)
            numpyro.sample(site, Measured(block, own, predicted, levels), obs=given[site] if observed else None)

    @float64
    def start(self, at: xr.DataTree | Point | None = None) -> dict[str, np.ndarray]:
        """Values of the latent sites to start from, by site: those of the automatic start, a fit's tree or a point.

        Biases and levels are those of the start, trajectories at their mode given them, hyper-parameters at their
        median under the Gaussian likelihood there. Raises `InputError` for a fit that lacks a bias, or holds one fixed
        that this problem does not.
        """
        point = at if isinstance(at, Point) else _started(self.problem, at)
        found = {"z": point.z} | ({"level": point.levels} if self.problem.levels else {})
        found |= {f"noise{suffix(self.problem, r)}": u for r, u in enumerate(point.noises)}
        if self.hierarchy.learnt:
            posed = Posed(self.problem.model, frame_at(self.problem.model, point), self.first)
            drawn = pilot(Form(self.problem.model.biases, self.hierarchy), posed, jax.random.key(0))
            found |= {name: np.median(values, 0) for name, values in drawn.phi.items()}
        return {name: np.asarray(value) for name, value in found.items()}

    @property
    def dims(self) -> dict[str, list[str]]:
        """Dimensions of every site beyond those of the draws, for `az.from_numpyro`."""
        found = {"z": ["bias_label"], "bias": ["bias_label"], "level": ["level_label"]}
        found |= {name: list(dims) for name, (dims, *_) in self._hyper.items()}
        for r in range(len(self.problem.epochs)):
            s = suffix(self.problem, r)
            found |= {f"noise{s}": [f"epoch{s}", f"noise_component{s}"], f"state{s}": [f"epoch{s}", f"component{s}"]}
        return found | {site: [f"row_{site[2:]}", f"channel_{site[2:]}"] for site in self.sites}

    @property
    def coords(self) -> dict[str, Sequence[Any]]:
        """Labels along these dimensions; `row_TYPE` are lines of the table."""
        problem = self.problem
        found: dict[str, Sequence[Any]] = {"bias_label": list(problem.labels)}
        found["level_label"] = [level.label for level in problem.levels]
        for _, _, *own in self._hyper.values():
            found |= own[0] if own else {}
        found |= {f"component{suffix(problem, r)}": list(e.components) for r, e in enumerate(problem.epochs)}
        for site, columns, index in zip(self.sites, problem.columns, problem.row_index, strict=True):
            found[f"channel_{site[2:]}"] = list(columns)
            found[f"row_{site[2:]}"] = problem.measurements.table.lines[index]
        return found

    @property
    def _hyper(self) -> dict[str, Any]:
        return self.hierarchy.variables(self.problem.labels, dict.fromkeys(self.hierarchy.hyper()))


def _started(problem: Problem, tree: xr.DataTree | None) -> Point:
    """The automatic start, or biases and levels of a fit with the trajectories at their mode."""
    if tree is None:
        return automatic_start(problem)
    found = apply(problem, tree)
    if held := [label for label in problem.labels if label not in found.problem.labels]:
        raise InputError(f"start: the fit holds {', '.join(held)} fixed; give the Problem of this model the same fix=")
    point = at_levels(problem.model, automatic_start(problem), jnp.asarray(found.levels))
    return track_mode(problem, point._replace(z=jnp.asarray(found.z)))


def _biases(hierarchy: Hierarchy, first: Precision, phi: Phi) -> jax.Array:
    """The site `z`, and where the prior is flat the factor `survey` of the biases that have one."""
    alpha = hierarchy.alpha(phi, first.alpha)
    matrix = jnp.diag(alpha) + first.coupled()
    if isinstance(hierarchy.prior, Flat):
        z = numpyro.sample("z", dist.ImproperUniform(dist.constraints.real_vector, (), alpha.shape))
        unit = dist.Unit(-0.5 * z @ matrix @ z)
        numpyro.sample("survey", unit, obs=unit.sample(None), infer={"is_auxiliary": True})
        return z
    if hierarchy.prior.correlation:
        return numpyro.sample("z", dist.MultivariateNormal(jnp.zeros_like(alpha), precision_matrix=matrix))
    return numpyro.sample("z", dist.Normal(jnp.zeros_like(alpha), 1 / jnp.sqrt(alpha)).to_event())


def _given(data: Mapping[str, Any] | None, sites: list[str], own: tuple[Rows, ...]) -> dict[str, jax.Array]:
    """Values of every observed site: those given, and the problem's own."""
    found = {site: data_.y for site, data_ in zip(sites, own, strict=True)}
    for site, value in (data or {}).items():
        check_known(site, sites, f'numpyro_model: no observed site is called "{site}"')
        if jnp.shape(value) != found[site].shape:
            raise InputError(
                f'numpyro_model: data["{site}"] has shape {jnp.shape(value)}, its rows {found[site].shape}'
            )
        found[site] = jnp.asarray(value)
    return found
