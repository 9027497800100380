"""Constant velocity said again as a motion without linear form, and the small networks that see it."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from worlds import fix, meter

from probcal import ConstantVelocity, Motion, Network, Node, RandomWalk

START = {"position": ((1.0, -1.0), 2.0), "velocity": ((0.3, 0.3), 1.5)}
CV = ConstantVelocity(0.8)
POWER = RandomWalk("power", "dB", 0.5, (4.0, 2.0))


@dataclass(frozen=True)
class Glider(Motion):
    """Constant velocity whose state is a dict; every number of its start and its noise is that of `CV` and `START`."""

    std: Any = 0.8
    name: str = "velocity_std"

    @property
    def levels(self):
        return {self.name: self.std}

    def view(self, state):
        return {"velocity": state["pace"], "position": state["place"]}

    def initial(self, key):
        keys = jax.random.split(key)
        (place, wide), (pace, fast) = START["position"], START["velocity"]
        return {
            "place": jnp.array(place) + wide * jax.random.normal(keys[0], (2,)),
            "pace": jnp.array(pace) + fast * jax.random.normal(keys[1], (2,)),
        }

    def sample(self, key, state, dt, levels):
        a, b = jax.random.normal(key, (2, 2)) * levels[self.name] * jnp.sqrt(dt)
        place = state["place"] + dt * state["pace"] + a * dt / np.sqrt(3)
        return {"place": place, "pace": state["pace"] + a * np.sqrt(3) / 2 + b / 2}

    def log_density(self, before, state, dt, levels):
        block = jnp.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]) * levels[self.name] ** 2
        away = jnp.stack([state["place"] - before["place"] - dt * before["pace"], state["pace"] - before["pace"]])
        normal = jax.scipy.stats.multivariate_normal.logpdf
        return sum(normal(away[:, axis], jnp.zeros(2), block) for axis in range(2))

    def log_initial(self, state):
        normal = jax.scipy.stats.norm.logpdf
        parts = [(state["place"], START["position"]), (state["pace"], START["velocity"])]
        return sum(jnp.sum(normal(x, jnp.array(mean), std)) for x, (mean, std) in parts)


NODES = [Node("a", (0.0, 1.0), 0.4, scale=2.0), Node("b", (5.0, -2.0), -1.3, scale=1.0)]
PLACED = [fix.on(node) for node in NODES]
PLANE = Network(PLACED)
POWERED = Network([*PLACED, meter.on(NODES[0], name="own")])
TIMES = {"one": [0.0, 0.5, 1.5, 2.0, 4.0], "two": [0.2, 0.5, 2.0, 3.5]}


def plan_of(network, times):
    grid = [(t, s.name, target) for target, when in times.items() for t in when for s in network.sensors]
    return pd.DataFrame(grid, columns=["time", "sensor", "target"])
