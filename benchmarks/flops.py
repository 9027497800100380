"""Operations of the two kernels that a fit spends its time in, against what a matrix product reaches on this machine.

    uv run python benchmarks/flops.py 10x100 100x1000 300x300

The problem of `beside_gtsam.py`, N radars by K epochs. A step: all rows linearised, the trajectory eliminated, the
biases solved (`find_mode` makes one an iteration); the covariance: `laplace` of all biases. Operations are counted on
the jaxpr (a scan as often as it runs; dense factorisations by their usual formulas), since `cost_analysis` of XLA
counts the body of a loop once and knows no factorisation: its count is printed beside. Seconds are the best of some
runs, compiling apart. The peak is a product of two float64 matrices by NumPy, on all cores.
"""

import argparse
import math
import time

import jax
import numpy as np
from beside_gtsam import best, built, drawn
from jax.extend import core

import probcal as pc
from probcal.gaussian.linearised import laplace
from probcal.gaussian.mode import eliminate
from probcal.gaussian.solves import Dense

FREE = {
    "broadcast_in_dim", "reshape", "transpose", "concatenate", "slice", "dynamic_slice", "dynamic_update_slice",
    "gather", "squeeze", "convert_element_type", "iota", "copy", "rev", "pad", "split", "stop_gradient", "scatter",
    "expand_dims", "bitcast_convert_type", "device_put",
}  # fmt: skip  # what moves numbers and makes none


def peak(size: int = 3000, times: int = 5) -> float:
    """Operations a second of a float64 product of two matrices."""
    a = np.random.default_rng(0).normal(size=(size, size))
    return 2.0 * size**3 / best(lambda: a @ a, times)


def operations(jaxpr: core.Jaxpr) -> float:
    """Floating-point operations of a jaxpr: one an entry for what is elementwise, a while loop as if it ran once."""
    total = 0.0
    for eqn in jaxpr.eqns:
        inner = [operations(p.jaxpr) for p in jax.tree.leaves(list(eqn.params.values())) if hasattr(p, "jaxpr")]
        name, shapes = eqn.primitive.name, [getattr(v.aval, "shape", ()) for v in eqn.invars]
        out = sum(math.prod(v.aval.shape) for v in eqn.outvars)
        if inner:
            total += eqn.params.get("length", 1) * sum(inner) if name != "cond" else max(inner)
        elif name == "dot_general":
            (left, _), _ = eqn.params["dimension_numbers"]
            total += 2.0 * out * math.prod(shapes[0][axis] for axis in left)
        elif name == "cholesky":
            total += math.prod(shapes[0][:-2]) * shapes[0][-1] ** 3 / 3
        elif name == "triangular_solve":
            total += math.prod(shapes[1]) * shapes[0][-1]
        elif name in ("geqrf", "qr"):
            m, n = shapes[0][-2:]
            total += math.prod(shapes[0][:-2]) * 2 * min(m, n) ** 2 * (max(m, n) - min(m, n) / 3)
        elif name == "eigh":
            total += math.prod(shapes[0][:-2]) * 9 * shapes[0][-1] ** 3
        elif name.startswith(("reduce", "cum", "scatter-add", "scatter_add")):
            total += math.prod(shapes[-1] if name.startswith("scatter") else shapes[0])
        elif name not in FREE:
            total += out
    return total


def step(model, point, prior):
    """What a step of `find_mode` solves for the biases."""
    solved = eliminate(model, point, expected=False)
    return Dense.of(solved.information + prior.matrix()).solve(solved.score - prior.pull(point.z))


def covariance(model, point, prior):
    """Covariance of all biases at a point."""
    return laplace(model, point, prior).covariance


def main():
    """Count and time both kernels, size by size."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("size", nargs="*", default=["10x100", "100x1000", "300x300"], help="radars x epochs")
    parser.add_argument("--times", type=int, default=5)
    chosen = parser.parse_args()
    most = peak()
    print(f"{jax.default_backend()} ({jax.devices()[0].device_kind}); float64 matrix product {most / 1e9:.1f} Gflop/s")
    for size in chosen.size:
        N, K = map(int, size.split("x"))
        problem, point = built(*drawn(N, K))
        with jax.enable_x64(True):
            given = problem.model, point, pc.Gaussian().precision(problem.labels, problem.surveyed)
            for kernel in (step, covariance):
                count = operations(jax.make_jaxpr(kernel)(*given).jaxpr)
                began = time.perf_counter()
                compiled = jax.jit(kernel).lower(*given).compile()
                compiling = time.perf_counter() - began
                seconds = best(lambda run=compiled, given=given: run(*given), chosen.times)
                cost = compiled.cost_analysis() or {}
                cost = cost[0] if isinstance(cost, list) else cost
                rate, counted = count / seconds, cost.get("flops", 0.0)
                print(
                    f"{size} {kernel.__name__}: {count / 1e6:.1f} Mflop (XLA says {counted / 1e6:.1f}),"
                    f" {seconds * 1e3:.2f} ms, {rate / 1e9:.2f} Gflop/s, {100 * rate / most:.1f} %"
                    f" of the peak; compiling {compiling:.1f} s",
                    flush=True,
                )


if __name__ == "__main__":
    main()
