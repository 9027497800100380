"""A look at the rows: predicted values, and these with their Jacobians, beside the plain way, backwards.

    uv run python benchmarks/rows.py --rows 100000

One line a sensor type: milliseconds of predicting, of `Model.linearise` (forwards), of the same Jacobians by
`jax.jacrev`, the best of some runs; in brackets the seconds of compiling. Every pose is biased.
"""

import argparse
import time
from functools import partial

import jax
import numpy as np
import pandas as pd

from probcal import ConstantVelocity, Network, Node, Problem, sensors
from probcal.gaussian.mode import Point
from probcal.model import rows as waist

SENSORS = 8
TYPES = {"ranger": 2, "tdoa": 2, "radar": 2, "doa": 2, "radar_3d": 3, "camera_3d": 3}
TURNED = ("heading", "pitch", "roll")


def drawn(kind, d, count):
    """A problem of so many rows of a sensor type with values at random, and a point at random."""
    rng = np.random.default_rng(0)
    turns = [name for name in TURNED if name in kind.pose_components]
    scale = {"position": 1.0} | dict.fromkeys(turns, 0.01)
    nodes = [Node(f"n{k}", 100 * rng.normal(size=d), scale=scale, **dict.fromkeys(turns, 0.0)) for k in range(SENSORS)]
    pairs = zip(nodes, nodes[1:] + nodes[:1], strict=True)
    network = Network([kind.on(*pair[: kind.arity]) for pair in pairs])
    time_ = np.repeat(np.arange(count // SENSORS, dtype=float), SENSORS)
    names = [sensor.name for sensor in network.sensors] * (count // SENSORS)
    table = pd.DataFrame({"time": time_, "sensor": names})
    for channel, _ in kind.expand(d):
        table[channel] = rng.normal(size=len(table))
    model = Problem(network, ConstantVelocity(1.0), table).model
    states = tuple(100 * rng.normal(size=part.drift.shape) for part in model.recursions)
    noises, levels = tuple(map(np.zeros_like, states)), np.zeros(len(model.level_spread))
    return model, Point(states, noises, rng.normal(size=model.biases), levels)


def backwards(model, point):
    """Predicted values and their Jacobians by the states and the biases of each row, in reverse mode."""
    (block,), (data,) = model.blocks, model.rows
    reached, local = point.states[0][data.epoch], waist.read_biases(block, data, point.z)
    one = partial(waist._one, block)
    jacobians = jax.vmap(jax.jacrev(one, argnums=(0, 2)))(reached, data.pose, local)
    return jax.vmap(one)(reached, data.pose, local), jacobians


def measured(work, *given, times=20):
    """Milliseconds of the best of some runs, and seconds of compiling."""
    begun = time.perf_counter()
    compiled = jax.jit(work).lower(*given).compile()
    compiling, seconds = time.perf_counter() - begun, []
    for _ in range(times):
        begun = time.perf_counter()
        jax.block_until_ready(compiled(*given))
        seconds.append(time.perf_counter() - begun)
    return f"{1e3 * min(seconds):7.2f} ms ({compiling:.2f} s)"


def main():
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", type=int, default=100_000)
    chosen = parser.parse_args()
    with jax.enable_x64(True):
        for name, d in TYPES.items():
            model, point = drawn(getattr(sensors, name), d, chosen.rows)
            parts = (
                ("predicted", lambda m, at: m.predict(at)),
                ("linearised", lambda m, at: m.linearise(at, expected=False)),
                ("backwards", backwards),
            )
            print(f"{name:10s}", *(f"{what} {measured(work, model, point)}" for what, work in parts), flush=True)


if __name__ == "__main__":
    main()
