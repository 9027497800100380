"""probcal: Bayesian calibration of sensor networks from targets of opportunity.

In examples `network`, `motion`, `run`, `problem` and `tree` are those of the README: three sonars, one passing target.
"""

from typing import TYPE_CHECKING

from probcal.lazy import lazy
from probcal.wings import NAMES

if TYPE_CHECKING:
    from probcal import motion, noise, priors, sensors
    from probcal.analysis import (
        assess,
        bound_map,
        bounds,
        changes,
        compare,
        interchangeable,
        next_anchors,
        next_passes,
        next_sensors,
        observability,
        sensitivity,
    )
    from probcal.detection import Detection, Sector
    from probcal.errors import FitError, InputError
    from probcal.geodesy import LocalFrame
    from probcal.inference import (
        EA,
        EM,
        EMEA,
        MAP,
        MCMC,
        NUTS,
        SVI,
        Collapsed,
        Cubature,
        Extended,
        Gibbs,
        LeastSquares,
        Unscented,
        fit,
        log_evidence,
        numpyro_model,
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
    from probcal.nodes import read_nodes, write_network, write_nodes
    from probcal.noise import Bernoulli, Censored, Mixture, StudentT, Truncated, Unknown
    from probcal.particles.clouds import particle_filter
    from probcal.particles.gibbs import ParticleGibbs
    from probcal.particles.particles import Particles
    from probcal.priors import ARD, BernoulliGaussian, Flat, Gaussian, Horseshoe, Laplace
    from probcal.problem import Problem
    from probcal.results.drifts import drift_table
    from probcal.results.io import load, save
    from probcal.results.read import outliers, summary, tracks, with_calibration
    from probcal.results.scores import add_scores, scores
    from probcal.roads import LeavingRoad, Road, RoadNetwork, match_track, read_roads
    from probcal.sensor import Bias, Channel, Drift, Sensor, SensorType, sensor
    from probcal.simulate import Simulation, Truth, simulate
    from probcal.stream.online import AugmentedFilter, Jumps, Online, ParticleFilter
    from probcal.studies.coverage import coverage_table
    from probcal.studies.fits import load_study
    from probcal.studies.sbc import sbc
    from probcal.studies.study import study
    from probcal.table import read_table
    from probcal.tracking.gospa import gospa
    from probcal.tracking.objects import Objects, track_objects
    from probcal.tracking.phd import Intensities, phd_filter
    from probcal.tracking.poses.propagation import Beliefs, propagate_beliefs, separable_likelihood
    from probcal.tracking.registration import Registration, register_tracks
    from probcal.tracking.sampler.associations import sample_associations
    from probcal.tracking.selfconfig import SelfConfiguration

__version__: str  # of the installed package, read when it is asked for

__all__ = lazy(
    __name__,
    {
        "probcal.analysis": (
            "assess bound_map bounds changes compare interchangeable next_anchors next_passes next_sensors "
            "observability sensitivity"
        ),
        "probcal.detection": "Detection Sector",
        "probcal.results.drifts": "drift_table",
        "probcal.results.scores": "add_scores scores",
        "probcal.errors": "FitError InputError",
        "probcal.geodesy": "LocalFrame",
        "probcal.inference": (
            "EA EM EMEA MAP MCMC NUTS SVI Collapsed Cubature Extended Gibbs LeastSquares "
            "Unscented fit log_evidence numpyro_model track"
        ),
        "probcal.motion": (
            "ConstantAcceleration ConstantVelocity CoordinatedTurn Known Motion RandomWalk Static Target White"
        ),
        "probcal.network": "Network Node Path",
        "probcal.nodes": "read_nodes write_network write_nodes",
        "probcal.noise": "Bernoulli Censored Mixture StudentT Truncated Unknown",
        "probcal.priors": "ARD BernoulliGaussian Flat Gaussian Horseshoe Laplace",
        "probcal.problem": "Problem",
        "probcal.sensor": "Bias Channel Drift Sensor SensorType sensor",
        "probcal.simulate": "Simulation Truth simulate",
        "probcal.table": "read_table",
        "probcal.results.io": "load save",
        "probcal.results.read": "outliers summary tracks with_calibration",
    }
    | NAMES,
    submodules="motion noise priors sensors",
)
