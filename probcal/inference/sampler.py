"""What samplers share: the base class, and the kernels that run many steps of a chain between two checkpoints."""

from abc import ABC, abstractmethod
from functools import partial
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp

from probcal.errors import InputError
from probcal.inference.hierarchy import Phi
from probcal.inference.posed import Form, Posed, conditional, log_prior
from probcal.inference.run import Method
from probcal.priors import ARD, Prior
from probcal.smoothing.frame import place


class Sample(NamedTuple):
    """One draw as a sampler sees it, and what it says about itself."""

    theta: jax.Array  # (Q,)
    eps: tuple[jax.Array, ...]
    phi: Phi
    joint: jax.Array  # () log density of data and eps given theta
    stats: dict[str, jax.Array]


class Draw(NamedTuple):
    """One draw as it is kept; a pytree of arrays, with leading dims (draws,) in a chunk."""

    theta: jax.Array  # (Q,) biases, log levels
    phi: Phi
    gamma: jax.Array  # (M,) 1 - alpha Sigma given phi
    variance: jax.Array  # (M,) of each z given phi
    states: tuple[jax.Array, ...]  # (E, n) of each recursion
    density: jax.Array  # () log density of data, eps and theta given phi
    stats: dict[str, jax.Array]


class Sampler(Method, ABC):
    """A method whose answer is draws: a frozen dataclass with `chains`, `warmup`, `draws` and a pure `step`."""

    chains: int
    warmup: int
    draws: int
    chunk: ClassVar[int]  # steps between two checkpoints
    exact: ClassVar[bool] = True  # whether its draws are those of the posterior
    intervals: ClassVar[str] = "quantiles of the exact posterior"

    def __post_init__(self):
        for field, least in (("chains", 1), ("warmup", 0), ("draws", 1)):
            if getattr(self, field) < least:
                raise InputError(f"{self.name}({field}={getattr(self, field)}): it must be at least {least}")

    @classmethod
    def takes(cls, prior: Prior) -> bool:
        """Whether there is a posterior to draw from: a flat hyper-prior of ARD leaves none."""
        return super().takes(prior) and not (isinstance(prior, ARD) and prior.rate == 0.0)

    def kernel(self) -> "Sampler":
        """The method without what does not change its kernels, so that these are compiled once."""
        return self

    def instead(self, prior: Prior, fallback: "Sampler") -> tuple["Sampler", str] | None:
        """What takes over, and its name, where the frame does not stand for the posterior; None: this one goes on."""
        return None

    @abstractmethod
    def first(self, form: Form, posed: Posed, theta: jax.Array, phi: Phi, key: jax.Array) -> Any:
        """State of a chain that starts at theta and phi."""

    @abstractmethod
    def step(self, form: Form, posed: Posed, chain: Any) -> tuple[Any, Sample]:
        """The next state, and the draw it stands for."""


def keep(form: Form, posed: Posed, sample: Sample) -> Draw:
    """What is kept of a draw: gamma and the variance given its hyper-parameters, its trajectories."""
    M = form.biases
    given = conditional(form, posed, sample.phi)
    variance = given.variance[:M]
    gamma = jnp.where(given.active[:M], jnp.clip(1.0 - given.alpha[:M] * variance, 0.0, 1.0), 0.0)
    point = place(posed.model, posed.frame, sample.theta, sample.eps)
    density = sample.joint + log_prior(form, posed, sample.theta, sample.phi)
    return Draw(sample.theta, sample.phi, gamma, variance, point.states, density, sample.stats)


@partial(jax.jit, static_argnames=("method", "form"))
def run_chunk(method: Any, form: Form, posed: Posed, chain: Any) -> tuple[Any, Draw]:
    """`method.chunk` steps of one chain, all kept; leading dims of the draws are (chunk,)."""

    def one(chain: Any, _: None) -> tuple[Any, Draw]:
        chain, sample = method.step(form, posed, chain)
        return chain, keep(form, posed, sample)

    return jax.lax.scan(one, chain, None, length=method.chunk)


run_chunks = jax.jit(jax.vmap(run_chunk, in_axes=(None, None, None, 0)), static_argnums=(0, 1))
