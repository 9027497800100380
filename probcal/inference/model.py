"""The joint posterior as a numpyro model, open to every kernel, guide and handler of numpyro.

Nothing of the frame enters: sites are the declared quantities, trajectories written by their whitened noises.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpyro
from numpyro import distributions as dist

from probcal.errors import InputError, nearest
from probcal.inference.hierarchy import Hierarchy, Phi, hierarchy_of
from probcal.model import rows
from probcal.model.rows import Block, Rows
from probcal.priors import ARD, Flat, Gaussian, Horseshoe, Laplace, Precision, Prior
from probcal.problem import Problem, check_linear
from probcal.smoothing.mode import factors
from probcal.smoothing.recursion import trajectory
from probcal.types import float64

DENSE = (Horseshoe, Gaussian, Laplace, ARD, Flat)  # priors with a density


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


@float64
def numpyro_model(problem: Problem, prior: Prior | None = None) -> Callable[..., None]:
    """The joint posterior of a problem as a numpyro model `model(data=None, *, observed=True)`.

    `model()` conditions on the problem's own rows. `data` maps sites `y_TYPE` to other values (N, C), NaN where
    missing, in the order of `problem.row_index`; other sites keep theirs. `observed=False` leaves every one free, as
    `Predictive` needs it. `prior` is `Horseshoe()` by default.

    Sites: the hyper-parameters of the prior (`local_scale`, `global_scale`, `slab_variance` of the horseshoe, `alpha`
    of ARD, `variance` of Laplace), `z` (M,) biases over scales, `level` (H,) log levels over their guesses, `noise`
    (E, n) whitened noises of the trajectories, `y_TYPE`; deterministic `bias` (M,) in units and `state` (E, n). With
    several recursions `noise`, `state` and the `y_TYPE` of a type that sees several end in `_0`, `_1`, ...

    numpyro must run in double precision: `numpyro.enable_x64()`, or all of it inside `with jax.enable_x64(True):`.
    Raises `InputError` for a prior without density (`BernoulliGaussian`), and the model for single precision, for
    unknown sites and for values of another shape.
    """
    prior = Horseshoe() if prior is None else prior
    if not isinstance(prior, DENSE):
        raise InputError(
            f"numpyro_model: {type(prior).__name__} has no density that numpyro could take; give one of"
            f" {', '.join(kind.__name__ for kind in DENSE)}, or fit BernoulliGaussian by Collapsed()"
        )
    check_linear(problem)
    hierarchy = hierarchy_of(prior, problem)
    first = prior.precision(problem.labels, problem.surveyed)
    of, scales = problem.model, jnp.asarray(problem.scales)
    suffixes = [f"_{r}" for r in range(len(of.recursions))] if len(of.recursions) > 1 else [""]
    kinds = [block.type.name for block in of.blocks]
    sites = [
        f"y_{name}{suffixes[r] if kinds.count(name) > 1 else ''}" for name, r in zip(kinds, of.recursion, strict=True)
    ]

    def model(data: Mapping[str, Any] | None = None, *, observed: bool = True) -> None:
        if jnp.zeros(()).dtype != jnp.float64:
            raise InputError(
                "a numpyro_model runs in double precision only: call numpyro.enable_x64() before,"
                " or run numpyro inside `with jax.enable_x64(True):`"
            )
        given = _given(data, sites, of.rows)
        phi = {name: numpyro.sample(name, d.to_event()) for name, d in hierarchy.hyper().items()}
        z = _biases(hierarchy, first, phi)
        numpyro.deterministic("bias", scales * z)
        levels = jnp.zeros(0)
        if problem.levels:
            levels = numpyro.sample("level", dist.Normal(0.0, of.level_spread).to_event())
        states = []
        for part, suffix in zip(of.recursions, suffixes, strict=True):
            unit = dist.Normal(jnp.zeros_like(part.drift), 1.0).to_event()
            u = numpyro.sample(f"noise{suffix}", unit)
            x = trajectory(part.F, factors(part, levels), part.drift[:, :, None], u[:, :, None])[:, :, 0]
            states.append(numpyro.deterministic(f"state{suffix}", x))
        for site, block, own, r in zip(sites, of.blocks, of.rows, of.recursion, strict=True):
            predicted = rows.predict(block, own, states[r], z)
            numpyro.sample(site, Measured(block, own, predicted, levels), obs=given[site] if observed else None)

    return model


def _biases(hierarchy: Hierarchy, first: Precision, phi: Phi) -> jax.Array:
    """The site `z`, and where the prior is flat the factor `survey` of the biases that have one."""
    alpha = hierarchy.alpha(phi, first.alpha)
    matrix = jnp.diag(alpha) + first.coupling
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
        if site not in found:
            raise InputError(f'numpyro_model: no observed site is called "{site}"{nearest(site, sites)}')
        if jnp.shape(value) != found[site].shape:
            raise InputError(
                f'numpyro_model: data["{site}"] has shape {jnp.shape(value)}, its rows {found[site].shape}'
            )
        found[site] = jnp.asarray(value)
    return found
