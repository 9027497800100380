"""Is a Gaussian answer one? How much worse the data fit at its draws than at its mode.

At draws from a Gaussian posterior of a linear model the log-likelihood lies below that of the mode by half the number
of parameters that the data tell, so by half a nat a datum at most. Draws that leave a curved ridge of the likelihood
fall without limit: bearings of an array that is small beside the distance tell the range by a factor only.
"""

import jax
import xarray as xr

from probcal.analysis.findings import Finding
from probcal.gaussian.mode import log_likelihood
from probcal.inference.fitted import Judged
from probcal.results.read import summed_log_likelihood

LINEAR, MOST = 0.5, 0.75  # nats a datum: at most of a linear model, and from which it is a finding
GAUSSIAN = ("Laplace", "mixture")  # kinds of answers that draw from Gaussians around a mode

_log_likelihood = jax.jit(log_likelihood)


def check_shape(fit: Judged, tree: xr.DataTree) -> Finding | None:
    """A finding where the draws of a Gaussian answer fit the data far worse than its mode."""
    drawn = summed_log_likelihood(tree)
    if tree.attrs["approximate"] not in GAUSSIAN or drawn is None:
        return None
    mode = float(_log_likelihood(fit.problem.untilted.model, fit.point))  # draws are those of rows alone
    fall = (mode - float(drawn.median())) / len(fit.data)
    if not fall > MOST:
        return None
    text = (
        f"the answer is far from Gaussian: at its draws the data fit {fall:.2g} nats a datum worse than at its mode"
        f" ({LINEAR:g} at most if it were), so its intervals are not valid; state where each target starts,"
        " Target(motion, start=...), and compare with NUTS()"
    )
    return Finding("shape", "fit", text)
