"""Unconstrained coordinates of the joint posterior, which NUTS and the guides of SVI move in."""

from typing import NamedTuple

import jax

from probcal.gaussian.frame import log_joint
from probcal.inference.hierarchy import Phi
from probcal.inference.posed import Form, Posed, log_prior, prior_precision, whiten
from probcal.model.trajectories import States


class Free(NamedTuple):
    """Unconstrained coordinates: phi on the real line, eta and eps unit normals where the frame is exact."""

    phi: Phi
    eta: jax.Array  # (Q,) of theta given phi
    eps: States  # (E, n) of the trajectories given theta


class Parts(NamedTuple):
    """The parameters that coordinates represent, and the log densities there."""

    theta: jax.Array
    phi: Phi
    joint: jax.Array  # of data and eps given theta
    density: jax.Array  # of the coordinates


def parts(form: Form, posed: Posed, free: Free) -> Parts:
    """Biases and hyper-parameters of coordinates, and the log density of the joint posterior in them.

    theta = mean(phi) + factor(phi) eta follows the hyper-parameters, the trajectories follow theta: neither the funnel
    of a scale nor the ridge between a bias and a track is left.
    """
    phi, hyper = form.hierarchy.constrain(free.phi)
    alpha, coupling = prior_precision(form, posed, phi)
    theta, volume = whiten(posed.frame.information + coupling, alpha, posed.frame.pull, free.eta)
    joint = log_joint(posed.model, posed.frame, theta, free.eps)
    return Parts(theta, phi, joint, hyper + volume + log_prior(form, posed, theta, phi) + joint)
