"""The problem linearised at a point, and the solves behind it, against dense algebra in NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from worlds import exact, linear, resting

from probcal.gaussian.dense import DenseEngine
from probcal.gaussian.linearised import laplace, leverages
from probcal.gaussian.mode import find_mode
from probcal.gaussian.solves import Dense
from probcal.priors import Precision

ALARM = 5.0  # sds of a mean beyond which a draw is wrong: one false alarm in 10^6


@pytest.fixture(scope="module")
def precision():
    """A precision (6, 6) that is far from diagonal."""
    root = np.random.default_rng(0).standard_normal((6, 6))
    return root @ root.T + np.diag(np.arange(1.0, 7.0))


def test_solves_are_those_of_numpy(precision):
    covariance = np.linalg.inv(precision)
    right = np.random.default_rng(1).standard_normal((6, 3))

    @jax.jit
    def answers(matrix, right):
        solves = Dense.of(matrix)
        return (
            solves.solve(right), solves.solve(right[:, 0]), solves.apply(right), solves.log_determinant(),
            solves.marginals(), solves.covariance(),
        )  # fmt: skip

    with jax.enable_x64(True):
        found = answers(jnp.asarray(precision), jnp.asarray(right))
    expected = (
        covariance @ right, covariance @ right[:, 0], precision @ right, np.linalg.slogdet(precision)[1],
        np.diag(covariance), covariance,
    )  # fmt: skip
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9)


def test_draws_of_solves_have_their_covariance(precision):
    """36 products of 40,000 draws, each within 5 sd: less than one false alarm in 10^4."""
    covariance, count = np.linalg.inv(precision), 40_000
    with jax.enable_x64(True):
        draw = jax.jit(lambda matrix, key: Dense.of(matrix).draw(key, count))
        drawn = np.asarray(draw(jnp.asarray(precision), jax.random.key(0)))
    own = np.diag(covariance)
    sd = np.sqrt((np.outer(own, own) + covariance**2) / count)
    assert (np.abs(drawn.T @ drawn / count - covariance) < ALARM * sd).all()


def test_one_linearisation_has_all_moments():
    """Covariance of biases, evidence and leverages of a linear problem, from one object."""
    (problem, naive), known = linear("plane"), exact("plane")
    with jax.enable_x64(True):
        prior = Precision(jnp.ones(problem.model.biases))
        mode = find_mode(problem.model, resting(problem), prior, 50, 1e-12).point
        at, found = DenseEngine().at(problem.model, mode), laplace(problem.model, mode, prior)
        told = sum(float(np.sum(a)) for a in leverages(problem.model, at.rows, at.trajectories, found.covariance))
        marginals = jax.jit(lambda: Dense.of(at.information() + prior.matrix()).marginals())()
    order = [naive.labels.index(label) for label in problem.labels]
    np.testing.assert_allclose(found.covariance, known.z[1][np.ix_(order, order)], rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(found.evidence, known.evidence, rtol=1e-10)
    np.testing.assert_allclose(marginals, np.diag(found.covariance), rtol=1e-10)
    assert 0 < told <= np.trace(np.asarray(found.covariance) @ np.asarray(found.information)) + 1e-9
