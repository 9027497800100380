"""probcal: Bayesian calibration of sensor networks from targets of opportunity."""

from probcal import noise, priors, sensors
from probcal.analysis import (
    assess,
    bound_map,
    bounds,
    compare,
    interchangeable,
    next_anchors,
    next_passes,
    next_sensors,
    observability,
    sensitivity,
)
from probcal.diagnostics import drift_table, scores
from probcal.inference import (
    EA,
    EM,
    EMEA,
    MAP,
    NUTS,
    SVI,
    Collapsed,
    LeastSquares,
    coverage_table,
    fit,
    log_evidence,
    numpyro_model,
    sbc,
    study,
    track,
)
from probcal.motion import (
    ConstantAcceleration,
    ConstantVelocity,
    CoordinatedTurn,
    Known,
    Motion,
    RandomWalk,
    Static,
    Target,
    White,
)
from probcal.network import Network, Node, Path
from probcal.nodes import LocalFrame, read_nodes, write_nodes
from probcal.noise import Bernoulli, Mixture, StudentT, Unknown
from probcal.priors import ARD, BernoulliGaussian, Flat, Gaussian, Horseshoe, Laplace
from probcal.problem import Problem
from probcal.sensor import Bias, Channel, Drift, Sensor, SensorType, sensor
from probcal.simulate import Simulation, Truth, simulate
from probcal.table import read_table
from probcal.tree import load, outliers, save, summary
from probcal.types import FitError, InputError

__all__ = [
    "ARD", "EA", "EM", "EMEA", "MAP", "NUTS", "SVI", "Bernoulli", "BernoulliGaussian", "Bias", "Channel",
    "Collapsed", "ConstantAcceleration", "ConstantVelocity", "CoordinatedTurn", "Drift", "FitError", "Flat",
    "Gaussian", "Horseshoe", "InputError", "Known", "Laplace", "LeastSquares", "LocalFrame", "Mixture", "Motion",
    "Network", "Node", "Path", "Problem", "RandomWalk", "Sensor", "SensorType", "Simulation", "Static", "StudentT",
    "Target", "Truth", "Unknown", "White", "assess", "bound_map", "bounds", "compare", "coverage_table",
    "drift_table", "fit", "interchangeable", "load", "log_evidence", "next_anchors", "next_passes", "next_sensors",
    "noise", "numpyro_model", "observability", "outliers", "priors", "read_nodes", "read_table", "save", "sbc",
    "scores", "sensitivity", "sensor", "sensors", "simulate", "study", "summary", "track", "write_nodes",
]  # fmt: skip
