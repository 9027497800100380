"""Targets that may leave the roads and join them again."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from probcal.errors import InputError
from probcal.motion.base import Motion
from probcal.motion.target import check_pair
from probcal.noise import Level, check_level, guess_of
from probcal.roads.motion import Road
from probcal.roads.place import draw_place, log_isotropic, log_masses, log_total, place_on

ROOT = math.sqrt(3.0)


@dataclass(frozen=True, eq=False)
class LeavingRoad(Motion):
    """Motion of a target on roads that leaves them `leave` times a second, and joins them `join` times where it can.

    State: `on` (1 on a road, else 0); `edge`, `along`, `speed` as of `Road` (0 off it); `position` (d,) and `velocity`
    (d,), on a road those of its place there. Off the road it moves with constant velocity, white acceleration of `std`
    m s^-3/2 an axis; in the step that leaves, from its place and velocity on the road.

    In the step that joins, with mean m and variance s^2 of the position that constant velocity predicts, the density
    of the new place is N(place; m, s^2 I) / Z, Z its integral over all roads, and the new speed is Gaussian around the
    predicted velocity along the road with variance std^2 T. It joins with probability
    (1 - exp(-join T)) min(1, (2 pi s^2)^((d - 1) / 2) Z), about 1 - exp(-join T) on a road and 0 far from any.

    It starts on the road with probability `on_road`; below 1, `off_start` is {"position": (mean, sd), "velocity":
    (mean, sd)}. A step costs a look at every straight piece of the network.
    """

    road: Road
    std: Level
    leave: float
    join: float
    on_road: float = 1.0
    off_start: Mapping[str, tuple[Any, float]] | None = None

    def __post_init__(self):
        if not isinstance(self.road, Road):
            raise InputError(f"LeavingRoad: road is {type(self.road).__name__}; give a Road(network, std, speed)")
        check_level(self.std, "LeavingRoad: std")
        for name in ("leave", "join"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise InputError(f"LeavingRoad: {name} is {value!r}; give a positive rate per second")
        if not 0 <= self.on_road <= 1:
            raise InputError(f"LeavingRoad: on_road is {self.on_road!r}; give a probability")
        if self.on_road < 1:
            for name in ("position", "velocity"):
                if self.off_start is None or name not in self.off_start:
                    raise InputError(
                        f'LeavingRoad: off_start states no "{name}"; give {{"position": (mean, sd), "velocity": (mean,'
                        " sd)}, or on_road=1"
                    )
                check_pair(self.off_start[name], f'LeavingRoad: off_start "{name}"')

    @property
    def levels(self) -> dict[str, Level]:
        """Noise levels on the road and off it, m s^-3/2."""
        return {**self.road.levels, "velocity_std": self.std}

    def loose(self) -> tuple[Any, Mapping[str, tuple[Any, float]]]:
        """That of the road."""
        return self.road.loose()

    def within(self, longest: float) -> LeavingRoad:
        """The motion with the paths that steps of up to `longest` s need."""
        road = self.road.within(longest)
        return self if road is self.road else replace(self, road=road)

    def view(self, state: Any) -> dict[str, Any]:
        """Position (d,) in m and velocity (d,) in m/s."""
        on, shown = state["on"] == 1, self.road.view(_driven(state))
        return {name: jnp.where(on, shown[name], state[name]) for name in ("position", "velocity")}

    def initial(self, key: jax.Array) -> dict[str, Any]:
        """State drawn at the first epoch."""
        chosen, own, free = jax.random.split(key, 3)
        on = jax.random.bernoulli(chosen, self.on_road)
        draws = jax.random.normal(free, (2, self.road.network.dimension))
        parts = [mean + sd * z for (mean, sd), z in zip(self._off_start, draws, strict=True)]
        return self._state(on, self.road.initial(own), *parts)

    def log_initial(self, state: Any) -> jax.Array:
        """Log density () of a state at the first epoch, by edge, arc length and speed, or by position and velocity."""
        on = state["on"] == 1
        off = sum(
            (
                log_isotropic(state[name] - mean, sd)
                for name, (mean, sd) in zip(("position", "velocity"), self._off_start, strict=True)
            ),
            jnp.zeros(()),
        )
        chance = (math.log(p) if p > 0 else -math.inf for p in (self.on_road, 1 - self.on_road))
        return jnp.where(on, next(chance) + self.road.log_initial(_driven(state)), next(chance) + off)

    def sample(self, key: jax.Array, state: Any, dt: Any, levels: Mapping[str, Any]) -> dict[str, Any]:
        """State drawn after `dt` seconds."""
        chosen, along, free, place, pace = jax.random.split(key, 5)
        std, network, shown = self._std(levels), self.road.network, self.view(state)
        mean, sd = shown["position"] + dt * shown["velocity"], self._spread(std, dt)
        masses = log_masses(network, mean, sd)
        a, b = jax.random.normal(free, (2, network.dimension)) * std * jnp.sqrt(dt)
        drawn = mean + a * dt / ROOT, shown["velocity"] + a * ROOT / 2 + b / 2
        driven = self.road.sample(along, _driven(state), dt, levels)
        edge, where = draw_place(place, network, mean, sd, masses)
        tangent = place_on(network, edge, where)[1]
        speed = jnp.sum(tangent * shown["velocity"]) + std * jnp.sqrt(dt) * jax.random.normal(pace)
        joined = {"edge": jnp.asarray(edge, int), "along": where, "speed": speed}
        was = state["on"] == 1
        chance = jnp.where(was, -jnp.expm1(-self.leave * dt), jnp.exp(self._log_join(masses, sd, dt)))
        changes = jax.random.uniform(chosen) < chance
        on_road = {name: jnp.where(was, driven[name], joined[name]) for name in joined}
        return self._state(was != changes, on_road, *drawn)

    def log_density(self, before: Any, state: Any, dt: Any, levels: Mapping[str, Any]) -> jax.Array:
        """Log density () of a state `dt` seconds after another, by its own place: on a road, or in the plane."""
        dt, was, on = jnp.maximum(dt, 1e-9), before["on"] == 1, state["on"] == 1
        std, network, shown = self._std(levels), self.road.network, self.view(before)
        mean, sd = shown["position"] + dt * shown["velocity"], self._spread(std, dt)
        masses = log_masses(network, mean, sd)
        join = self._log_join(masses, sd, dt)
        stays = jnp.log1p(-jnp.exp(jnp.minimum(join, -1e-12)))
        away = (state["position"] - mean) / sd
        gain = 2 * (state["velocity"] - shown["velocity"]) / (std * jnp.sqrt(dt)) - ROOT * away
        det = math.log(math.pi / ROOT) + jnp.log(std**2 * dt**2)
        free = -0.5 * jnp.sum(away**2 + gain**2) - network.dimension * det
        driven = _driven(state)
        place, tangent = place_on(network, driven["edge"], driven["along"])
        faster = driven["speed"] - jnp.sum(tangent * shown["velocity"])
        joined = log_isotropic(place - mean, sd) - log_total(masses) + log_isotropic(faster, std * jnp.sqrt(dt))
        joined = jnp.where(self.road.holds(driven["edge"], driven["along"]), joined, -jnp.inf)
        kept = self.road.log_density(_driven(before), driven, dt, levels)
        onto = jnp.where(was, -self.leave * dt + kept, join + joined)
        off = jnp.where(was, jnp.log(-jnp.expm1(-self.leave * dt)), stays) + free
        return jnp.where(on, onto, off)

    @property
    def _off_start(self) -> list[tuple[jax.Array, float]]:
        """Mean (d,) and sd of position and velocity of a start off the road."""
        d = self.road.network.dimension
        pairs = [(self.off_start or {}).get(name, (0.0, 1.0)) for name in ("position", "velocity")]
        return [(jnp.broadcast_to(jnp.asarray(mean, float), (d,)), float(sd)) for mean, sd in pairs]

    def _state(self, on: Any, driven: Any, position: Any, velocity: Any) -> dict[str, Any]:
        """The state of both forms, the one that does not count filled in."""
        shown = self.road.view(driven)
        own = {name: jnp.where(on, value, jnp.zeros_like(value)) for name, value in driven.items()}
        return {
            "on": jnp.asarray(on, int),
            **own,
            "position": jnp.where(on, shown["position"], position),
            "velocity": jnp.where(on, shown["velocity"], velocity),
        }

    def _log_join(self, masses: jax.Array, sd: Any, dt: Any) -> jax.Array:
        """Log probability of joining in a step, from the log masses (S,) of what it predicts."""
        scale = (self.road.network.dimension - 1) * (jnp.log(sd) + 0.5 * math.log(2 * math.pi))
        return jnp.log(-jnp.expm1(-self.join * dt)) + jnp.minimum(log_total(masses) + scale, 0.0)

    def _std(self, levels: Mapping[str, Any]) -> Any:
        return levels["velocity_std"] if "velocity_std" in levels else guess_of(self.std)

    @staticmethod
    def _spread(std: Any, dt: Any) -> Any:
        """Standard deviation in m of the position on each axis after `dt` seconds, never 0."""
        return std * jnp.maximum(dt, 1e-9) ** 1.5 / ROOT


def _driven(state: Any) -> dict[str, Any]:
    """The part of a state that is on a road."""
    return {name: state[name] for name in ("edge", "along", "speed")}
