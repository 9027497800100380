"""Many different fits in one process: time and memory maps of each, so that a leak or a slowing shows.

    uv run python benchmarks/many_fits.py 200

Every fit has a network of its own size, so that nothing compiled for one serves the next.
"""

import resource
import sys
import time

import numpy as np

from probcal import EA, Bias, Channel, ConstantVelocity, Network, Node, Problem, fit, kernels, sensor, simulate
from probcal.geometry import bearing, norm


def problem(number: int) -> Problem:
    """A network that no other fit has: 2 to 6 gauges, 20 to 59 epochs."""

    @sensor(range=Channel("m", std=1.0), azimuth=Channel("rad", std=0.02, wrap=True))
    def gauge(target, pose, *, shift=Bias("m", 5.0)):
        line = target.position - pose.position
        return {"range": norm(line) + shift, "azimuth": bearing(line) - pose.heading}

    count, epochs = 2 + number % 5, 20 + number // 5
    nodes = [Node(f"n{k}", (80.0 * np.cos(k), 80.0 * np.sin(k)), scale={"heading": 0.1}) for k in range(count)]
    network, time_ = Network([gauge.on(node) for node in nodes]), np.arange(float(epochs))
    path = np.stack([np.linspace(-50, 50, epochs), 20 * np.sin(time_ / 9)], 1)
    run = simulate(network, ConstantVelocity(0.5), time_, key=number, share=0.3, tracks={"target": path})
    return Problem(network, ConstantVelocity(0.5), run.table)


def main(count: int) -> None:
    """Fit them all; one line for every ten."""
    began, lost = time.perf_counter(), 0
    for number in range(count):
        lost += fit(problem(number), EA(), key=number).attrs["status"] != "converged"
        if number % 10 == 9:
            seconds, began = time.perf_counter() - began, time.perf_counter()
            memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
            print(f"{number + 1:4d} fits: {seconds / 10:.2f} s each, {kernels.maps()} maps, {memory:.2f} GB at most")
    print(f"{lost} of {count} did not converge")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 200)
