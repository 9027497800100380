"""Precisions of largest evidence: exact updates against a grid, and groups that a climb alone would not take out."""

import numpy as np

from probcal.inference.relevance import Relevance, best_precisions

HIGH = 1e8


def gaussian(design, truth, noise, seed=0):
    """Information and pull of the biases of y = design z + noise."""
    data = design @ truth + noise * np.random.default_rng(seed).normal(size=len(design))
    return design.T @ design / noise**2, design.T @ data / noise**2


def dense_evidence(information, pull, alpha):
    """Log evidence up to a constant by determinants of the whole system."""
    matrix = information + np.diag(alpha)
    volume = np.log(alpha).sum() - np.linalg.slogdet(matrix)[1]
    return 0.5 * (volume + pull @ np.linalg.solve(matrix, pull))


def test_a_single_update_is_the_maximum_and_rank_one_changes_are_exact():
    random = np.random.default_rng(1)
    information, pull = gaussian(random.normal(size=(30, 5)), np.array([2.0, 0, 0, -0.3, 0.1]), 1.0)
    found = Relevance(information, pull, np.ones(5))
    for m in (0, 1, 2, 3, 4, 1, 2):
        found.update(m)
        for factor in (0.5, 0.9, 1.1, 2.0):
            other = found.alpha.copy()
            other[m] = min(other[m] * factor, HIGH)
            assert dense_evidence(information, pull, other) <= dense_evidence(information, pull, found.alpha) + 1e-6
        mean, covariance = found.mean.copy(), found.covariance.copy()
        found.solve()
        np.testing.assert_allclose(mean, found.mean, atol=1e-10)
        np.testing.assert_allclose(covariance, found.covariance, atol=1e-10)
    assert np.isclose(found.evidence, dense_evidence(information, pull, found.alpha), atol=1e-4)
    assert not found.inside.all()


def ranges(seed, beacons=4, epochs=12, noise=0.3, radial=2.0):
    """Offsets and scales of beacons whose ranges to one target of unknown place in each epoch hardly vary."""
    random = np.random.default_rng(seed)
    design = np.zeros((beacons * epochs, 2 * beacons))
    place = np.tile(np.eye(epochs), (beacons, 1))
    for k in range(beacons):
        rows = slice(k * epochs, (k + 1) * epochs)
        design[rows, k], design[rows, beacons + k] = 1.0, 1.0 + 0.15 * random.normal(size=epochs)
    truth = np.concatenate([np.zeros(beacons), 1.0 + 0.1 * random.normal(size=beacons)])
    data = design @ truth + noise * random.normal(size=len(design))
    weight = np.linalg.inv(noise**2 * np.eye(len(design)) + radial**2 * place @ place.T)
    return design.T @ weight @ design, design.T @ weight @ data


def test_groups_go_out_and_in_together_where_one_by_one_they_stay():
    """Of 40 draws a climb of single updates stops at the worse of two optima in some, by up to 2 nats."""
    gains = []
    for seed in range(40):
        information, pull = ranges(seed)
        alone = Relevance(information, pull, np.ones(8))
        reached = alone.climb(range(8))
        alpha, gain = best_precisions(information, pull, np.ones(8), range(8), [range(4), range(4, 8)])
        best = Relevance(information, pull, alpha)
        first = dense_evidence(information, pull, np.ones(8))
        assert np.isclose(best.evidence - first, gain, atol=1e-6)
        gains.append(best.evidence - reached)
    assert min(gains) > -1e-5
    assert sum(gain > 0.3 for gain in gains) >= 3
