"""Epochs one after the other, and in parallel: seconds of the passes of a smoother, compile time apart.

    uv run python benchmarks/epochs.py 1000 10000 --columns 1 300

One target in the plane at constant velocity, position measured; a line a size. What is taken by itself is parallel on
an accelerator and one after the other on a CPU (`probcal/gaussian/scans.py`).
"""

import argparse
import time

import jax
import jax.numpy as jnp
import numpy as np

from probcal.gaussian import recursion as rec
from probcal.gaussian import scans
from probcal.motion import ConstantVelocity


def main():
    """Time both."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("epochs", type=int, nargs="*", default=[1000, 10000])
    parser.add_argument("--columns", type=int, nargs="+", default=[1, 300])
    chosen = parser.parse_args()
    print(f"{jax.devices()[0].device_kind}, {jax.default_backend()}")
    motion, rng = ConstantVelocity(1.0), np.random.default_rng(0)
    for E in chosen.epochs:
        dt = np.ones(E)
        F, L = np.array(motion.transition(dt, 2)), np.array(motion.noise_factor(dt, 2))
        F[0], L[0] = 0.0, 100.0 * np.eye(4)
        J = np.zeros((E, 4, 4))
        J[:, [0, 1], [0, 1]] = 0.04
        for m in chosen.columns:
            b = np.pad(rng.standard_normal((E, 2, m)), ((0, 0), (0, 2), (0, 0)))
            seconds = {}
            with jax.enable_x64(True):
                arrays = [jnp.asarray(part) for part in (F, L, J, b)]
                for parallel in (False, True):
                    scans.PARALLEL = parallel

                    def both(F, L, J, b):
                        gain = rec.gains(F, L, J, (0, 1))
                        return rec.smooth(F, gain, b), rec.covariances(F, L, gain)

                    begun = time.perf_counter()
                    run = jax.jit(both).lower(*arrays).compile()
                    compiled, times = time.perf_counter() - begun, []
                    for _ in range(5):
                        begun = time.perf_counter()
                        jax.block_until_ready(run(*arrays))
                        times.append(time.perf_counter() - begun)
                    seconds[parallel] = min(times), compiled
            (one, first), (other, second) = seconds[False], seconds[True]
            print(
                f"{E} epochs, {m} columns: one after the other {1e3 * one:.1f} ms (compiled in {first:.1f} s), parallel"
                f" {1e3 * other:.1f} ms ({second:.1f} s): {one / other:.2f} times as fast",
                flush=True,
            )


if __name__ == "__main__":
    main()
