"""Motion on a road network: edge, arc length and speed, with random ways on at junctions (Paper A, sections IV, V)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np

from probcal.errors import InputError
from probcal.motion.base import Motion
from probcal.motion.components import ConstantVelocity
from probcal.motion.target import check_pair
from probcal.noise import Level, Unknown, check_level, guess_of
from probcal.roads.network import RoadNetwork
from probcal.roads.paths import exits_of, path_table, turns_of
from probcal.roads.place import draw_place, log_isotropic, log_masses, log_total, place_on

FAR = 6.0  # sd from every road at which a start is refused
WIDE = 6.0  # sd of the noise of a step that the reach holds
QUICK = 4.0  # sd of the speed that the reach holds
BEYOND = 1e7  # m that a displacement never exceeds
ROOT = math.sqrt(3.0)


@dataclass(frozen=True, eq=False)
class Road(Motion):
    """Motion along the roads of a network: constant speed with white acceleration, turns at random at junctions.

    State: `edge` (number), `along` (m from its start), `speed` (m/s, positive from its start to its end). Over T s the
    displacement along the road and the speed gain noise of covariance std^2 [[T^3/3, T^2/2], [T^2/2, T]], `std` in
    m s^-3/2, as in `ConstantVelocity`. At a node all edges that may be entered but the one it comes from are as likely,
    or as `turns` {(from_edge, to_edge): weight} says, where an edge that is not named beside others has 0; where none
    leads on, it turns back. A one-way edge is entered at its end by who turns back there alone.

    `speed` (mean, sd) is that of the start in the direction of travel, which is either one with probability 1/2, on
    one-way edges the allowed one. `position` ((x, y), sd) starts it there on the roads; None, anywhere by length.

    Densities sum over the paths up to `reach` m beyond an edge (Paper A (40)), by default what a speed of `fastest` m/s
    and the noise cover in the longest step, which `within` states; no drawn displacement is longer.
    """

    network: RoadNetwork
    std: Level
    speed: tuple[float, float]
    position: tuple[Any, float] | None = None
    turns: Mapping[tuple[str, str], float] | None = None
    fastest: float | None = None
    reach: float | None = None
    longest: float | None = None  # s, the longest step that `within` stated

    def __post_init__(self):
        if not isinstance(self.network, RoadNetwork):
            raise InputError(f"Road: network is {type(self.network).__name__}; give a RoadNetwork")
        check_level(self.std, "Road: std")
        check_pair(self.speed, "Road: speed")
        for name in ("fastest", "reach"):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value > 0):
                raise InputError(f"Road: {name} is {value!r}; give a positive number, or leave it out")
        exits_of(self.network, self._turns)
        if self.position is not None:
            check_pair(self.position, "Road: position")
            mean, sd = np.asarray(self.position[0], float), self.position[1]
            if mean.shape != (self.network.dimension,):
                raise InputError(f"Road: position has mean {mean}; give {self.network.dimension} values in m")
            edge, _, away = self.network.nearest(mean[None])
            if away[0] > FAR * sd:
                raise InputError(
                    f'Road: position is {away[0]:.1f} m from the nearest road, edge "{self.network.names[edge[0]]}",'
                    f" {away[0] / sd:.1f} of its sd; move it or give a larger sd"
                )

    @property
    def levels(self) -> dict[str, Level]:
        """Noise level of the speed, m s^-3/2."""
        return {"speed_std": self.std}

    @cached_property
    def _turns(self) -> Any:
        return turns_of(self.turns, self.network)

    def within(self, longest: float) -> Road:
        """The motion with paths that reach as far as steps of up to `longest` s need, unless `reach` is stated."""
        return self if self.longest == longest else replace(self, longest=float(longest))

    def loose(self) -> tuple[Any, Mapping[str, tuple[Any, float]]]:
        """Constant velocity in the plane that can turn within the longest step, from the same start."""
        quick = abs(self.speed[0]) + QUICK * self.speed[1]
        corners = np.concatenate([np.asarray(line) for line in self.network.lines])
        middle = (corners.mean(0), float(np.ptp(corners, axis=0).max()))
        position = self.position if self.position is not None else middle
        velocity = (np.zeros(self.network.dimension), abs(self.speed[0]) + self.speed[1])
        motion = ConstantVelocity(quick / math.sqrt(self.longest or 1.0))
        return motion, {"position": position, "velocity": velocity}

    @property
    def limit(self) -> float | None:
        """The distance in m beyond an edge to which its paths are known: `reach`, or the longest
        step's need, or None.
        """
        if self.reach is not None or self.longest is None:
            return self.reach
        T = self.longest
        std = guess_of(self.std) * (self.std.factor if isinstance(self.std, Unknown) else 1.0)
        fastest = self.fastest
        if fastest is None:
            mean, sd = self.speed
            fastest = abs(mean) + QUICK * (sd + std * math.sqrt(T))
        return max(T * fastest + WIDE * std * math.sqrt(T**3 / 3), 1.0)

    def view(self, state: Any) -> dict[str, Any]:
        """Position (d,) in m and velocity (d,) in m/s, the speed along the tangent."""
        position, tangent = place_on(self.network, state["edge"], state["along"])
        return {"position": position, "velocity": state["speed"] * tangent}

    def initial(self, key: jax.Array) -> dict[str, Any]:
        """State drawn at the first epoch."""
        where, way, pace = jax.random.split(key, 3)
        if self.position is None:
            offsets = jnp.asarray(self.network.offsets)
            whole = jax.random.uniform(where) * float(self.network.lengths.sum())
            edge = jnp.clip(jnp.searchsorted(offsets, whole, side="right") - 1, 0, len(self.network.names) - 1)
            along = jnp.clip(whole - offsets[edge], 0.0, jnp.asarray(self.network.lengths)[edge])
        else:
            mean, sd = self._start
            edge, along = draw_place(where, self.network, mean, sd, log_masses(self.network, mean, sd))
        speed = self.speed[0] + self.speed[1] * jax.random.normal(pace)
        turned = jax.random.bernoulli(way) & ~jnp.asarray(self.network.oneway)[edge]
        return {"edge": jnp.asarray(edge, int), "along": along, "speed": jnp.where(turned, -speed, speed)}

    def log_initial(self, state: Any) -> jax.Array:
        """Log density () of a state at the first epoch, by edge, arc length in m and speed in m/s."""
        edge, along = state["edge"], state["along"]
        if self.position is None:
            place = -jnp.log(float(self.network.lengths.sum()))
        else:
            mean, sd = self._start
            position, _ = place_on(self.network, edge, along)
            place = log_isotropic(position - mean, sd) - log_total(log_masses(self.network, mean, sd))
        ahead, back = (log_isotropic(sign * state["speed"] - self.speed[0], self.speed[1]) for sign in (1.0, -1.0))
        both = jnp.logaddexp(ahead, back) - math.log(2.0)
        speed = jnp.where(jnp.asarray(self.network.oneway)[edge], ahead, both)
        return jnp.where(self.holds(edge, along), place + speed, -jnp.inf)

    def sample(self, key: jax.Array, state: Any, dt: Any, levels: Mapping[str, Any]) -> dict[str, Any]:
        """State drawn after `dt` seconds; every junction on the way is one turn."""
        std = self._std(levels)
        noise, turn = jax.random.split(key)
        a, b = jax.random.normal(noise, (2,)) * std * jnp.sqrt(dt)
        most = BEYOND if self.limit is None else self.limit
        gone = jnp.clip(dt * state["speed"] + a * dt / ROOT, -most, most)
        speed = state["speed"] + a * ROOT / 2 + b / 2
        exits = exits_of(self.network, self._turns)
        onto, cumulative = jnp.asarray(exits.onto), jnp.asarray(exits.cumulative)
        lengths = jnp.asarray(self.network.lengths)
        ahead = gone >= 0
        way = 2 * jnp.asarray(state["edge"], onto.dtype) + jnp.where(ahead, 0, 1)
        done = jnp.where(ahead, state["along"], lengths[state["edge"]] - state["along"])

        def cross(carry: Any) -> Any:
            way, done, rest, crossed = carry
            rest = rest - (lengths[way // 2] - done)
            chance = jax.random.uniform(jax.random.fold_in(turn, crossed))
            return onto[way, jnp.sum(chance >= cumulative[way])], jnp.zeros_like(done), rest, crossed + 1

        start = (way, done, jnp.abs(gone), jnp.zeros((), int))
        way, done, rest, _ = jax.lax.while_loop(lambda c: c[1] + c[2] > lengths[c[0] // 2], cross, start)
        edge, back = way // 2, way % 2 == 1
        done = done + rest
        along = jnp.clip(jnp.where(back, lengths[edge] - done, done), 0.0, lengths[edge])
        return {"edge": edge, "along": along, "speed": jnp.where(back == ahead, -speed, speed)}

    def log_density(self, before: Any, state: Any, dt: Any, levels: Mapping[str, Any]) -> jax.Array:
        """Log density () of a state `dt` seconds after another, the sum over paths (Paper A (40), s their length)."""
        if self.limit is None:
            raise InputError("Road: a density needs to know how far paths lead; give reach= in m, or motion.within(dt)")
        table = path_table(self.network, self._turns, self.limit)
        e, std = before["edge"], self._std(levels)
        T = jnp.maximum(dt, 1e-9)
        found = jnp.asarray(table.edges)[e] == state["edge"]
        slot = jnp.argmax(found)
        shift, sign, chance = (jnp.asarray(part)[e, slot] for part in table[1:])
        away = (shift + sign * state["along"] - before["along"] - T * before["speed"]) / (std * T**1.5 / ROOT)
        gain = 2 * (sign * state["speed"] - before["speed"]) / (std * jnp.sqrt(T)) - ROOT * away
        logs = chance - 0.5 * (away**2 + gain**2)
        largest = jax.lax.stop_gradient(jnp.max(logs))
        total = largest + jnp.log(jnp.sum(jnp.exp(logs - largest)))
        density = total - math.log(math.pi / ROOT) - jnp.log(std**2 * T**2)
        return jnp.where(jnp.any(found) & self.holds(state["edge"], state["along"]), density, -jnp.inf)

    def estimate(self, states: Any, weights: Any) -> Any:
        """Point estimate on the road (Paper A (43)): of states (M leading) the one nearest to their weighted mean.

        Nearest in global coordinates, among those of positive weight.
        """
        weights = jnp.asarray(weights)
        places = jax.vmap(self.view)(states)["position"]
        mean = jnp.sum(weights[:, None] * places, 0) / jnp.sum(weights)
        away = jnp.where(weights > 0, jnp.sum((places - mean[None]) ** 2, 1), jnp.inf)
        return jax.tree.map(lambda leaf: jnp.asarray(leaf)[jnp.argmin(away)], states)

    @property
    def _start(self) -> tuple[jax.Array, float]:
        """Mean (d,) and sd of the position at the start."""
        mean, sd = cast(tuple[Any, float], self.position)
        return jnp.asarray(mean, float), float(sd)

    def _std(self, levels: Mapping[str, Any]) -> Any:
        return levels["speed_std"] if "speed_std" in levels else guess_of(self.std)

    def holds(self, edge: Any, along: Any) -> jax.Array:
        """True if an arc length is one of the edge."""
        return (along >= 0) & (along <= jnp.asarray(self.network.lengths)[edge])
