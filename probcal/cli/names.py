"""Names of methods and priors on the command line, for help texts and checks that come before anything heavy.

`tests/test_imports.py` compares them with `inference.METHODS` and `priors.PRIORS`.
"""

from typing import NamedTuple

from probcal.wings import METHODS as OF_WINGS
from probcal.wings import installed


class KnownMethod(NamedTuple):
    """The properties of a method that the command line knows."""

    title: str  # its name in results
    chains: bool  # whether it draws them
    priors: tuple[str, ...]  # that it takes


ORACLE = "oracle"  # of studies: the method that knows which biases are zero
SAVE = ("states", "predictive")  # draws that a fit writes where asked for
PRIORS = {  # the class of each
    "flat": "Flat", "gaussian": "Gaussian", "laplace": "Laplace", "ard": "ARD", "ard-node": "ARD", "ard-owner": "ARD",
    "ard-type": "ARD", "ard-component": "ARD", "ard-vector": "ARD", "ard-gamma": "ARD", "horseshoe": "Horseshoe",
    "horseshoe-axis": "Horseshoe", "bernoulli-gaussian": "BernoulliGaussian",
}  # fmt: skip
_LEARNT = ("ard", "ard-node", "ard-owner", "ard-type", "ard-component", "ard-vector", "ard-gamma")
_FIXED = ("flat", "gaussian", "laplace")
_HORSESHOE = ("horseshoe", "horseshoe-axis")
_SAMPLED = (*_FIXED, "ard-gamma", *_HORSESHOE)
_INTEGRATED = ("laplace", *_LEARNT, *_HORSESHOE, "bernoulli-gaussian")
METHODS = {
    "ea": KnownMethod("EA", False, _INTEGRATED),
    "ea-maximised": KnownMethod("EA", False, _LEARNT),
    "ea-printed": KnownMethod("EA", False, _LEARNT),
    "ea-em": KnownMethod("EA", False, _LEARNT),
    "em-ea": KnownMethod("EM-EA", False, _LEARNT),
    "em": KnownMethod("EM", False, _FIXED),
    "em-ml": KnownMethod("EM", False, _FIXED),
    "map": KnownMethod("MAP", False, _FIXED),
    "map-l1": KnownMethod("MAP", False, _FIXED),
    "ml": KnownMethod("MAP", False, _FIXED),
    "nls": KnownMethod("least squares", False, ("flat",)),
    "mcmc": KnownMethod("MCMC", True, (*_SAMPLED, "bernoulli-gaussian")),
    "collapsed": KnownMethod("Collapsed", True, (*_SAMPLED, "bernoulli-gaussian")),
    "collapsed-spike": KnownMethod("Collapsed", True, (*_SAMPLED, "bernoulli-gaussian")),
    "nuts": KnownMethod("NUTS", True, _SAMPLED),
    "gibbs": KnownMethod("Gibbs", True, _SAMPLED),
    "svi": KnownMethod("SVI", True, _SAMPLED),
}
_OF_WINGS = {
    "em-particles": KnownMethod("EM", False, _FIXED),
    "em-ea-particles": KnownMethod("EM-EA", False, _LEARNT),
    "particle-gibbs": KnownMethod("ParticleGibbs", True, _SAMPLED),
    "self-config": KnownMethod("self-configuration", False, _INTEGRATED),
    "self-config-beliefs": KnownMethod("self-configuration", False, _INTEGRATED),
}
METHODS |= {name: known for name, known in _OF_WINGS.items() if installed(OF_WINGS[name])}
