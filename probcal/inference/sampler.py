"""The base class of samplers."""

from __future__ import annotations

from abc import ABC
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from probcal.errors import InputError
from probcal.inference import hierarchy
from probcal.inference.chains import Sample
from probcal.inference.hierarchy import Phi
from probcal.inference.leaps import Place
from probcal.inference.method import Method
from probcal.inference.posed import Form, Posed
from probcal.priors import ARD, Prior
from probcal.problem import Problem

CHAINS, DRAWS = 4_096, 10_000_000  # the most; draws with warm-up, of all chains


def check_size(name: str, chains: int, draws: int) -> None:
    """Raise `InputError` for more chains or draws than any result can keep."""
    if chains > CHAINS:
        raise InputError(f"{name}(chains={chains}): {CHAINS:,} chains are the most")
    if chains * draws > DRAWS:
        raise InputError(f"{name}: {chains} chains of {draws} draws, with warm-up; {DRAWS:,} in all are the most")


class Sampler(Method, ABC):
    """A method whose answer is draws: a frozen dataclass with `chains`, `warmup`, `draws` and a pure `step`."""

    chains: int
    warmup: int
    draws: int
    chunk: ClassVar[int]  # draws between two checkpoints
    effective: int = 0  # draws of every quantity at which the chains end; 0: at `draws` of each
    patience: int = 1  # most steps from one draw to the next, where those after fewer have not mixed
    exact: ClassVar[bool] = True  # whether its draws are those of the posterior
    atoms: ClassVar[bool] = False  # whether it takes priors under which a bias may be exactly zero
    crosses: ClassVar[bool] = False  # whether its chains visit other sides of a mirror, by `across`
    roams: ClassVar[bool] = False  # whether its chains move along orbits where the frame fits badly, by `roam`
    refusal: ClassVar[str] = ""  # its steps, and what is wrong where a chain takes few of them; empty: not looked at
    intervals = "quantiles of the exact posterior"
    climbs = False

    def __post_init__(self):
        for field, least in (("chains", 1), ("warmup", 0), ("draws", 1)):
            if getattr(self, field) < least:
                raise InputError(f"{self.name}({field}={getattr(self, field)}): it must be at least {least}")
        check_size(self.name, self.chains, self.warmup + self.draws)

    def takes(self, prior: Prior) -> bool:
        """True if there is a posterior to draw from, and the method can: a flat hyper-prior of ARD leaves none."""
        return (
            super().takes(prior) and (prior.dense or self.atoms) and not (isinstance(prior, ARD) and prior.rate == 0.0)
        )

    def suited(self, problem: Problem) -> Method:
        """The sampler, numpyro loaded: loaded later it would have all kernels traced again."""
        hierarchy.dist.Distribution  # noqa: B018
        return self

    def kernel(self) -> Sampler:
        """The method without what does not change its kernels, so that these are compiled once."""
        return self

    def instead(self, prior: Prior, fallback: Sampler) -> Sampler | None:
        """The sampler that takes over if the Gaussian reference fails; None: this one continues."""
        return None

    def first(self, form: Form, posed: Posed, theta: jax.Array, phi: Phi, key: jax.Array) -> Any:
        """State of a chain that starts at theta and phi; needed of one in a frame."""
        raise AssertionError(f"chains of {self.name} have no frame")

    def step(self, form: Form, posed: Posed, chain: Any) -> tuple[Any, Sample]:
        """The next state, and the draw it stands for; needed of one whose step is a kernel."""
        raise AssertionError(f"a step of {self.name} is no kernel")

    def place(self, form: Form, posed: Posed, chain: Any) -> Place:
        """The position of a chain; needed of a sampler with mode jumps."""
        raise AssertionError(f"{self.name} does not cross")

    def put(self, form: Form, posed: Posed, chain: Any, at: Place) -> Any:
        """The chain at another place."""
        raise AssertionError(f"{self.name} does not cross")

    def across(self, form: Form, here: Posed, there: Posed, chain: Any) -> tuple[Any, jax.Array]:
        """The chain on another side, and by how much the log density of its coordinates is larger there.

        It must be an involution between any two sides. A sampler that does not cross stays where it is.
        """
        return chain, jnp.asarray(-jnp.inf)
