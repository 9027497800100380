"""Rows looked at by parts, as where they are many: the numbers of all at once, and derivatives through them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import worlds

from probcal.model import rows as waist


def looked(model, point):
    """Rows linearised, their densities, and first and second derivatives of the sum of these, compiled anew."""
    return jax.jit(lambda point: _looked(model, point))(point)


def _looked(model, point):
    found = []
    for block, data, r in zip(model.blocks, model.rows, model.recursion, strict=True):
        states = point.states[r] + 1.0

        def total(z, states=states, block=block, data=data):
            predicted = waist.predict.__wrapped__(block, data, states, z)  # no kernel of other tests
            return jnp.sum(waist.log_likelihood.__wrapped__(block, data, predicted, point.levels) ** 2)

        lin = waist.linearise(block, data, states, point.z, point.levels, expected=False)
        ahead = jax.jvp(jax.grad(total), (point.z,), (jnp.ones_like(point.z),))
        found.append((lin, total(point.z), ahead))
    return found


@pytest.mark.parametrize("size", [4, 7])
def test_rows_by_parts_are_those_of_all_at_once(size, monkeypatch):
    problem = worlds.small(missing=0.3, scans=9)
    with jax.enable_x64(True):
        point = worlds.resting(problem)._replace(z=0.1 * jnp.arange(1.0, 1.0 + problem.model.biases))
        whole = looked(problem.model, point)
        assert all(data.y.shape[0] > 2 * size for data in problem.model.rows)
        monkeypatch.setattr(waist, "AT_ONCE", size)
        parts = looked(problem.model, point)
    for a, b in zip(jax.tree.leaves(parts), jax.tree.leaves(whole), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)
