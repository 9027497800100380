"""Names of methods and priors on the command line, for help texts and checks that come before anything heavy.

`tests/test_imports.py` compares them with `inference.METHODS` and `priors.PRIORS`.
"""

from typing import NamedTuple


class Known(NamedTuple):
    """What the command line knows of a method."""

    title: str  # its name in results
    chains: bool  # whether it draws them
    priors: tuple[str, ...]  # that it takes


ORACLE = "oracle"  # of studies: the method that knows which biases are zero
SAVE = ("states", "predictive")  # draws that a fit writes where asked for
PRIORS = {  # the class of each
    "flat": "Flat", "gaussian": "Gaussian", "laplace": "Laplace", "ard": "ARD", "ard-node": "ARD", "ard-owner": "ARD",
    "ard-type": "ARD", "ard-component": "ARD", "ard-vector": "ARD", "ard-gamma": "ARD", "horseshoe": "Horseshoe",
    "horseshoe-vector": "Horseshoe", "bernoulli-gaussian": "BernoulliGaussian",
}  # fmt: skip
_LEARNT = ("ard", "ard-node", "ard-owner", "ard-type", "ard-component", "ard-vector", "ard-gamma")
_FIXED = ("flat", "gaussian", "laplace")
_HORSESHOE = ("horseshoe", "horseshoe-vector")
_SAMPLED = (*_FIXED, "ard-gamma", *_HORSESHOE)
_INTEGRATED = ("laplace", *_LEARNT, *_HORSESHOE, "bernoulli-gaussian")
METHODS = {
    "ea": Known("EA", False, _INTEGRATED),
    "ea-maximised": Known("EA", False, _LEARNT),
    "ea-printed": Known("EA", False, _LEARNT),
    "ea-em": Known("EA", False, _LEARNT),
    "paper-b": Known("EA", False, _LEARNT),
    "em-ea": Known("EM-EA", False, _LEARNT),
    "em": Known("EM", False, _FIXED),
    "em-ml": Known("EM", False, _FIXED),
    "map": Known("MAP", False, _FIXED),
    "map-l1": Known("MAP", False, _FIXED),
    "ml": Known("MAP", False, _FIXED),
    "nls": Known("least squares", False, ("flat",)),
    "collapsed": Known("Collapsed", True, (*_SAMPLED, "bernoulli-gaussian")),
    "collapsed-spike": Known("Collapsed", True, (*_SAMPLED, "bernoulli-gaussian")),
    "nuts": Known("NUTS", True, _SAMPLED),
    "svi": Known("SVI", True, _SAMPLED),
    "svi-mean-field": Known("SVI", True, _SAMPLED),
    "svi-low-rank": Known("SVI", True, _SAMPLED),
}
