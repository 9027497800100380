"""Every method on noise whose parameters are unknown: late parts, growing std, memory, one for each sensor."""

from functools import cache

import jax
import numpy as np
import pytest

import probcal as pc
from probcal.inference import calibrate
from probcal.inference.mixed import mixing
from probcal.noise import Grows, Memory, Mixture

BEACONS = ((0.0, 0.0), (10.0, 0.0), (10.0, 8.0), (0.0, 8.0), (5.0, 9.0))
LATE = Mixture(0.2, 15.0, late="exponential")
SHARE, SIZE = 0.1, 8.0  # guesses of its parameters
NOISES = {  # std, noise and memory of a channel: as drawn, and as declared
    "late": ((0.05, LATE), (pc.Unknown(0.1), Mixture(pc.Unknown(SHARE), pc.Unknown(SIZE), late="exponential"))),
    "by sensor": (
        (0.05, LATE),
        (pc.Unknown(0.1), Mixture(pc.Unknown(SHARE, by="sensor"), pc.Unknown(SIZE), late="exponential")),
    ),
    "grows": ((Grows(0.03, 0.02), None), (Grows(pc.Unknown(0.1), pc.Unknown(0.05)), None)),
    "memory": ((0.02, None, Memory(0.05, 2.0)), (pc.Unknown(0.05), None, Memory(pc.Unknown(0.1), 2.0))),
}


def beacons(std, noise=None, memory=None):
    """Five beacons with surveyed places and an offset of each range."""

    @pc.sensor(range=pc.Channel("m", std=std, noise=noise or pc.noise.Normal(), memory=memory))
    def uwb(target, pose, *, range_offset=pc.Bias("m", 0.3, zeros="none")):
        return dict(range=pc.geometry.norm(target.position - pose.position) + range_offset)

    return pc.Network([uwb.on(pc.Node(f"a{k}", p, survey={"position": 0.01})) for k, p in enumerate(BEACONS)])


@cache
def walk(name):
    """Forty epochs of a walk between them, all of it drawn."""
    drawn, declared = NOISES[name]
    start = {"position": ((5.0, 4.0), 2.0), "velocity": ((0.0, 0.0), 0.5)}
    motion = pc.Target(pc.ConstantVelocity(0.2), start)
    run = pc.simulate(beacons(*drawn), motion, 0.2 * np.arange(40), key=1)
    return pc.Problem(beacons(*declared), motion, run.table)


@cache
def answered(name, method):
    """Mean and sd of the biases, values of the levels, and draws (chain, draw, H) of their logs."""
    tree, answer = calibrate(walk(name), method, prior=None if method == pc.EA() else pc.Gaussian())
    group = tree["calibration"].to_dataset()
    levels = tree["level"].to_dataset()["std"].values
    chained = isinstance(method, pc.Collapsed | pc.NUTS | pc.SVI)
    logs = answer.posterior.draws(jax.random.key(0), ()).levels if chained else None
    return tree, group["mean"].values, group["sd"].values, levels, logs


APART = 0.15  # sd by which methods may differ in a bias; Monte Carlo errors are 0.03 to 0.05
EXACT = (pc.Collapsed(), pc.NUTS())
METHODS = (*EXACT, pc.SVI(), pc.EM(iterations=5000))
CASES = [(name, own) for name in NOISES for own in (METHODS[::2] if name == "memory" else METHODS)]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "method"), CASES, ids=lambda own: getattr(own, "name", own))
def test_methods_agree_on_biases_and_parameters(name, method):
    """With EA: biases within 0.15 sd, sds within a sixth, logs of parameters within the sd of their draws.

    Exact chains agree with one another within four standard errors.
    """
    problem = walk(name)
    _, mean, sd, known, _ = answered(name, pc.EA())
    tree, other, spread, found, logs = answered(name, method)
    assert np.abs((other - mean) / sd).max() < APART
    np.testing.assert_allclose(np.log(spread / sd), 0.0, atol=1 / 6)
    assert tree.attrs["status"] == "converged" or (name == "memory" and method not in EXACT)
    known, found = (np.array([own.log(v) for own, v in zip(problem.levels, of, strict=True)]) for of in (known, found))
    if logs is None:
        np.testing.assert_allclose(found, known, atol=0.1)
        return
    assert (np.abs(logs.mean((0, 1)) - known) < logs.std((0, 1))).all()
    if method == EXACT[1]:
        both = (logs, answered(name, EXACT[0])[-1])
        error = np.hypot(*(own.std((0, 1)) / np.sqrt(mixing(own)["ess"]) for own in both))
        assert (np.abs(both[0].mean((0, 1)) - both[1].mean((0, 1))) < 4 * error).all()
