"""Nonlinear worlds as plain data, to be moved, turned and renamed: radars, direction finders, rangers, arrivals."""

from dataclasses import dataclass, field, replace

import numpy as np

import probcal
from probcal import ConstantVelocity, Network, Node, RandomWalk, Target, White, sensors


@dataclass(frozen=True)
class World:
    """A network and its targets as plain data, so that it can be moved, turned and renamed."""

    nodes: tuple[dict, ...]
    placed: tuple[tuple, ...]  # (type, node names, sensor name)
    moving: object
    starts: dict  # target -> position, velocity
    time: tuple[float, ...]
    spread: tuple[float, float] = (5.0, 0.5)  # std of the start's position and velocity
    names: dict = field(default_factory=dict)  # new names of nodes, sensors and targets

    def called(self, name):
        return self.names.get(name, name)

    def moved(self, angle, shift):
        """Turn about the vertical axis through the origin, then shift."""
        nodes = []
        for node in self.nodes:
            turned = turn(node["position"], angle) + shift
            heading = np.remainder(node.get("heading", 0.0) + angle, 2 * np.pi)
            nodes.append(node | {"position": turned, "heading": heading})
        starts = {k: (turn(p, angle) + shift, turn(v, angle)) for k, (p, v) in self.starts.items()}
        return replace(self, nodes=tuple(nodes), starts=starts)

    def network(self):
        nodes = {node["name"]: Node(**(node | {"name": self.called(node["name"])})) for node in self.nodes}
        return Network([t.on(*(nodes[n] for n in on), name=self.called(name)) for t, on, name in self.placed])

    def motion(self):
        p, v = self.spread
        return {
            self.called(k): Target(self.moving, {"position": (np.array(a), p), "velocity": (np.array(b), v)})
            for k, (a, b) in self.starts.items()
        }

    def problem(self, table):
        return probcal.Problem(self.network(), self.motion(), table)


def turn(vector, angle):
    c, s = np.cos(angle), np.sin(angle)
    x, y, *rest = vector
    return np.array([c * x - s * y, s * x + c * y, *rest])


def plane():
    """2-D: radars, direction finders, rangers and a time difference; two targets."""
    nodes = (
        {"name": "r0", "position": (0.0, 0.0), "heading": 0.3},
        {"name": "r1", "position": (60.0, 5.0), "heading": 2.0, "scale": {"position": 5.0, "heading": 0.1}},
        {"name": "d0", "position": (10.0, 70.0), "heading": -1.0, "survey": {"heading": 0.05}},
        {"name": "d1", "position": (70.0, 60.0), "heading": 3.0, "scale": {"position": 4.0}},
        {"name": "g0", "position": (30.0, -20.0), "survey": {"position": 0.5}},
        {"name": "g1", "position": (-20.0, 40.0), "scale": {"clock": 3.0, "position": 2.0}},
    )
    placed = (
        (sensors.radar, ("r0",), "r0"), (sensors.radar, ("r1",), "r1"), (sensors.doa, ("d0",), "d0"),
        (sensors.doa, ("d1",), "d1"), (sensors.ranger, ("g0",), "g0"), (sensors.ranger, ("g1",), "g1"),
        (sensors.tdoa, ("g0", "g1"), "g0-g1"),
    )  # fmt: skip
    starts = {"one": ((10.0, 20.0), (3.0, 2.0)), "two": ((50.0, 40.0), (-4.0, -1.0))}
    return World(nodes, placed, ConstantVelocity(0.5), starts, tuple(np.arange(8.0)))


def waves():
    """2-D: arrival times of unknown emissions, signal strengths of a drifting power, presence detectors."""
    places = {"a": (0.0, 0.0), "b": (30.0, 3.0), "c": (5.0, 28.0), "d": (33.0, 31.0)}
    scale = {"a": {}, "b": {"position": 2.0, "clock": 1.0}, "c": {"clock": 1.0}, "d": {"position": 2.0}}
    nodes = tuple({"name": k, "position": p, "scale": scale[k]} for k, p in places.items())
    kinds = (sensors.toa, sensors.rss, sensors.presence)
    placed = tuple((kind, (name,), f"{kind.name}_{name}") for kind in kinds for name in places)
    moving = ConstantVelocity(0.3, singular=True) + White("emission", "m", 20.0, mean=10.0)
    moving = moving + RandomWalk("power", "dB", 0.5, (60.0, 5.0))
    return World(nodes, placed, moving, {"one": ((3.0, 6.0), (2.0, 1.5))}, tuple(np.arange(10.0)), (2.0, 0.3))


def space():
    """3-D: radars with attitude, direction finders, rangers."""
    nodes = (
        {"name": "r0", "position": (0.0, 0.0, 3.0), "heading": 0.3, "pitch": 0.1, "roll": -0.2},
        {"name": "r1", "position": (60.0, 5.0, 0.0), "heading": 2.0, "pitch": -0.1,
         "scale": {"position": 5.0, "heading": 0.1, "pitch": 0.05, "roll": 0.05}},
        {"name": "d0", "position": (10.0, 70.0, 10.0), "heading": -1.0, "roll": 0.3,
         "survey": {"heading": 0.05}},
        {"name": "d1", "position": (70.0, 60.0, 0.0), "heading": 3.0, "scale": {"position": 4.0}},
        {"name": "g0", "position": (30.0, -20.0, 15.0), "survey": {"position": 0.5}},
    )  # fmt: skip
    placed = (
        (sensors.radar_3d, ("r0",), "r0"), (sensors.radar_3d, ("r1",), "r1"), (sensors.doa_3d, ("d0",), "d0"),
        (sensors.doa_3d, ("d1",), "d1"), (sensors.ranger, ("g0",), "g0"),
    )  # fmt: skip
    starts = {"one": ((10.0, 20.0, 30.0), (3.0, 2.0, -1.0))}
    return World(nodes, placed, ConstantVelocity(0.5), starts, tuple(np.arange(8.0)))


def pair():
    """2-D: two radars and a target, for relations that change the shape of the table."""
    world = plane()
    starts = {"one": world.starts["one"]}
    return replace(world, placed=world.placed[:2], starts=starts, time=tuple(np.arange(6.0)))


WORLDS = {make.__name__: make for make in (plane, waves, space, pair)}
