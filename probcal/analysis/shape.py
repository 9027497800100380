"""Is a Gaussian answer one? How much worse the data fit at its draws than at its mode.

At draws from a Gaussian posterior of a linear model the log-likelihood lies below that of the mode by half the number
of parameters that the data tell, so by half a nat a datum at most. Draws that leave a curved ridge of the likelihood
fall without limit: bearings of an array that is small beside the distance tell the range by a factor only.
"""

import numpy as np

from probcal.analysis.check import Case, Checked, check
from probcal.analysis.findings import Finding
from probcal.gaussian.draws import residuals
from probcal.results.read import summed_log_likelihood

LINEAR, MOST = 0.5, 0.75  # nats a datum: at most of a linear model, and from which it is a finding
GAUSSIAN = ("Laplace", "mixture")  # kinds of answers that draw from Gaussians around a mode


@check("answer")
def check_shape(case: Case) -> Checked:
    """A finding where the draws of a Gaussian answer fit the data far worse than its mode; then no interval counts."""
    fit, drawn = case.fit, summed_log_likelihood(case.tree)
    if case.tree.attrs["approximate"] not in GAUSSIAN or drawn is None:
        return Checked()
    mode = sum(float(np.asarray(part).sum()) for part in residuals(fit.problem.model, fit.point).log_likelihood)
    fall = (mode - float(drawn.median())) / len(fit.data)
    if not fall > MOST:
        return Checked()
    text = (
        f"the answer is far from Gaussian: at its draws the data fit {fall:.2g} nats a datum worse than at its mode"
        f" ({LINEAR:g} at most if it were), so its intervals are not valid; state where each target starts,"
        " Target(motion, start=...), and compare with NUTS()"
    )
    every = dict.fromkeys(range(fit.problem.model.biases), "the answer is far from Gaussian: its interval is not valid")
    return Checked(findings=[Finding("shape", "fit", text)], doubts={"weak": every})
