"""Building a large problem: seconds and memory of nodes, network and arrays.

    uv run python benchmarks/build.py 10000

As many radars with unknown position and heading (three biases each, and one for the range offset), 50 rows each.
"""

import resource
import sys
import time

import numpy as np
import pandas as pd

from probcal import ConstantVelocity, Network, Node, Problem, sensors

SEEN = 20  # sensors that see the target at an epoch


def main(count: int) -> None:
    """Build one problem; a line for every part."""
    rng, side = np.random.default_rng(0), int(np.ceil(np.sqrt(count)))
    began = time.perf_counter()

    def say(what: str) -> None:
        nonlocal began
        print(f"{what:40s} {time.perf_counter() - began:6.2f} s")
        began = time.perf_counter()

    spread = {"position": 2.0, "heading": 0.05}
    nodes = [Node(f"n{k}", (100.0 * (k % side), 100.0 * (k // side)), scale=spread) for k in range(count)]
    network = Network([sensors.radar.on(node) for node in nodes])
    say(f"network of {count} sensors, {len(network.labels)} biases")
    rows = 50 * count
    names = np.array([placed.name for placed in network.sensors])[np.arange(rows) % count]
    measured = {"range": rng.uniform(10, 100, rows), "azimuth": rng.uniform(-3, 3, rows)}
    table = pd.DataFrame({"time": np.arange(rows) // SEEN * 1.0, "sensor": names} | measured)
    say(f"table of {rows} rows")
    Problem(network, ConstantVelocity(0.5), table)
    say("arrays")
    print(f"{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6:.2f} GB at most")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 10_000)
