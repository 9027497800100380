"""The joint sampler: NUTS over biases, hyper-parameters and every trajectory, in coordinates that the frame whitens."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp

from probcal.errors import InputError
from probcal.gaussian.frame import log_weight
from probcal.inference.chains import Sample
from probcal.inference.coordinates import Free, parts
from probcal.inference.framed import FramedSampler
from probcal.inference.hierarchy import Phi
from probcal.inference.leaps import Place, leap
from probcal.inference.orbits import roam
from probcal.inference.posed import Form, Posed, conditional
from probcal.lazy import Later
from probcal.priors import Horseshoe, Prior

if TYPE_CHECKING:
    from numpyro.infer import hmc
else:
    hmc = Later("numpyro.infer.hmc")


@dataclass(frozen=True)
class NUTS(FramedSampler):
    """Exact posterior of biases, hyper-parameters and trajectories by the no-U-turn sampler (Hoffman, Gelman 2014).

    `chains` of `warmup` and `draws` steps, a diagonal metric (`dense=True`: full), steps that are
    accepted with probability `target`, trees of at most `depth` doublings, three less while it warms
    up. Raises `InputError` for settings outside their ranges.
    """

    chains: int = 4
    warmup: int = 400
    draws: int = 500
    target: float = 0.85
    depth: int = 10
    dense: bool = False
    patience: int = 1
    effective: int = 0

    name = "NUTS"
    priors = (Horseshoe, Prior)
    crosses = True
    roams = True
    chunk = 20
    roomy = False

    def __post_init__(self):
        super().__post_init__()
        if not (0.1 < self.target < 1 and 1 <= self.depth <= 20):
            raise InputError(
                f"NUTS(target={self.target}, depth={self.depth}): target is in (0.1, 1), depth from 1 to 20"
            )

    def _kernels(self, form: Form, posed: Posed) -> tuple[Any, Any]:
        return hmc.hmc(lambda free: -parts(form, posed, free).density, algo="NUTS")

    def _started(self, kernels: tuple[Any, Any], free: Free, key: jax.Array) -> Any:
        return kernels[0](
            free, self.warmup, step_size=0.3, dense_mass=self.dense, target_accept_prob=self.target,
            max_tree_depth=(max(self.depth - 3, 1), self.depth), rng_key=key,
        )  # fmt: skip

    def kernel(self) -> NUTS:
        """The method whatever the number of its chains and draws; its adaptation knows the length of the warm-up."""
        return replace(self, chains=1, draws=1, patience=1, effective=0)

    def first(self, form: Form, posed: Posed, theta: jax.Array, phi: Phi, key: jax.Array) -> Any:
        """A chain at theta and phi, its trajectories drawn from the frame."""
        keys = jax.random.split(key, len(posed.frame.loops) + 1)
        eps = posed.frame.normals(keys)
        given = conditional(form, posed, phi)
        eta = given.factor.T @ (theta - given.mean)
        return self._started(self._kernels(form, posed), Free(form.hierarchy.relax(phi), eta, eps), keys[-1])

    def step(self, form: Form, posed: Posed, chain: Any) -> tuple[Any, Sample]:
        """One draw; during warm-up step size and metric adapt."""
        kernels = self._kernels(form, posed)
        self._started(kernels, chain.z, chain.rng_key)  # hands its settings to the kernel; its state is not used
        chain = kernels[1](chain)
        found = parts(form, posed, chain.z)
        jumps = dict[str, jax.Array]()
        if posed.orbits:
            # the chain after a leap on the frame, and a proposal along each orbit
            keys = jax.random.split(jax.random.fold_in(chain.rng_key, 1))
            at, leapt = leap(form, posed, self.place(form, posed, chain), keys[0], 1, form.hierarchy.sweeps)
            at, roamed = roam(form, posed, at, keys[1])
            chain, jumps = self.put(form, posed, chain, at), {"leapt": leapt, "roamed": roamed}
            found = parts(form, posed, chain.z)
        stats = {
            "acceptance_rate": chain.accept_prob,
            "diverging": chain.diverging,
            "n_steps": chain.num_steps,
            "tree_depth": jnp.floor(jnp.log2(chain.num_steps)).astype(int) + 1,
            "energy": chain.energy,
            "step_size": chain.adapt_state.step_size,
        }
        return chain, Sample(found.theta, chain.z.eps, found.phi, found.joint, stats | jumps)

    def place(self, form: Form, posed: Posed, chain: Any) -> Place:
        """The position of a chain."""
        found = parts(form, posed, chain.z)
        weight = log_weight(posed.model, posed.frame, found.theta, chain.z.eps)
        return Place(found.theta, chain.z.eps, found.phi, weight)

    def put(self, form: Form, posed: Posed, chain: Any, at: Place) -> Any:
        """The chain at another place."""
        given = conditional(form, posed, at.phi)
        free = Free(form.hierarchy.relax(at.phi), given.factor.T @ (at.theta - given.mean), at.eps)
        energy, slope = jax.value_and_grad(lambda own: -parts(form, posed, own).density)(free)
        return chain._replace(z=free, potential_energy=energy, z_grad=slope)

    def across(self, form: Form, here: Posed, there: Posed, chain: Any) -> tuple[Any, jax.Array]:
        """The same coordinates on the other side."""
        energy, slope = jax.value_and_grad(lambda free: -parts(form, there, free).density)(chain.z)
        return chain._replace(potential_energy=energy, z_grad=slope), chain.potential_energy - energy
