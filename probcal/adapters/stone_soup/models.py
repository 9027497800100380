"""The measurement model and the sensor that Stone Soup makes of a declared sensor; importing this needs Stone Soup."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from typing import Any

import numpy as np
from scipy.stats import multivariate_normal
from stonesoup.base import Property
from stonesoup.models.base import GaussianModel
from stonesoup.models.measurement.base import MeasurementModel
from stonesoup.sensor.sensor import SimpleSensor
from stonesoup.types.angle import Bearing
from stonesoup.types.array import CovarianceMatrix, StateVector, StateVectors

from probcal.adapters.stone_soup.function import SensorFunction
from probcal.errors import InputError


class DeclaredModel(MeasurementModel, GaussianModel):
    """Non-linear Gaussian measurement model: the function of a declared sensor, its node and biases put right.

    Measurements are in the units of the channels; channels that wrap are `Bearing`, in radians.
    """

    reading: SensorFunction = Property(doc="The sensor with its pose and biases")
    noise_covar: CovarianceMatrix = Property(doc="Noise covariance of the chosen channels")
    chosen: Sequence[int] = Property(default=None, doc="Which channels of the sensor are measured, all by default")
    start: datetime = Property(default=None, doc="Instant of time 0 of the table, where the sensor changes in time")
    time: float = Property(default=None, doc="Time in s of the table at which the sensor is taken; None: of the state")

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        every = self.reading.channels
        if self.chosen is None:
            self.chosen = list(range(len(every)))
        self.noise_covar = CovarianceMatrix(self.noise_covar)
        named = [every[c] for c in self.chosen]
        self.channels = tuple(name for name, _ in named)
        self._angles = np.array([channel.wrap for _, channel in named])
        self._factor = np.array([[2 * np.pi / channel.period if channel.period else 1.0] for _, channel in named])

    @property
    def ndim_meas(self) -> int:
        """Number of channels."""
        return len(self.chosen)

    def covar(self, **kwargs: Any) -> CovarianceMatrix:
        """Noise covariance."""
        return self.noise_covar

    def seconds(self, state: Any) -> float:
        """Time of a state in s of the table, where the sensor changes in time."""
        if self.time is not None or not self.reading.varies:
            return self.time or 0.0
        if state.timestamp is None or self.start is None:
            raise InputError(
                f'sensor "{self.reading.placed.name}" moves or drifts: give its measurement model start=, the datetime'
                " of time 0, and states a timestamp"
            )
        return (state.timestamp - self.start).total_seconds()

    def plain(self, state: Any) -> np.ndarray:
        """Predicted values (C, N) as plain numbers, not wrapped."""
        states = np.asarray(state.state_vector, float)
        return self._factor * self.reading.values(states, self.seconds(state))[self.chosen]

    def function(self, state: Any, noise: Any = False, **kwargs: Any) -> Any:
        """Predicted measurement of one or more state vectors."""
        predicted = self.plain(state)
        if noise is True:
            drawn = super().rvs(num_samples=predicted.shape[1], **kwargs)
            return self._typed(predicted + np.asarray(drawn, float))
        if noise is None or noise is False:
            return self._typed(predicted)
        return self._typed(predicted) + noise

    def jacobian(self, state: Any, **kwargs: Any) -> np.ndarray:
        """Derivative (C, n) of the measurement by the state vector."""
        point = np.asarray(state.state_vector, float)[:, 0]
        return self._factor * self.reading.derivative(point, self.seconds(state))[self.chosen]

    def rvs(self, num_samples: int = 1, **kwargs: Any) -> Any:
        """Draws of the noise."""
        return self._typed(np.asarray(super().rvs(num_samples, **kwargs), float))

    def logpdf(self, state1: Any, state2: Any, **kwargs: Any) -> Any:
        """Log density of measurements given states, angles around the circle."""
        away = np.asarray(state1.state_vector, float) - self.plain(state2)
        away[self._angles] = (away[self._angles] + np.pi) % (2 * np.pi) - np.pi
        found = np.atleast_1d(multivariate_normal.logpdf(away.T, cov=np.asarray(self.noise_covar, float)))
        return found[0] if len(found) == 1 else found

    def _typed(self, values: np.ndarray) -> Any:
        """Values (C, N) as a state vector, angles as `Bearing`."""
        if not self._angles.any():
            return StateVectors(values)
        typed = values.astype(object)
        for c in np.flatnonzero(self._angles):
            typed[c] = [Bearing(value) for value in values[c]]
        return StateVectors(typed)


class DeclaredSensor(SimpleSensor):
    """A declared sensor for which Stone Soup has no type: its measurement model, at its node. It sees every target.

    Its model stands at the calibrated node, whatever platform it is mounted on.
    """

    model: DeclaredModel = Property(doc="The measurement model of the sensor")

    @property
    def measurement_model(self) -> DeclaredModel:
        """The measurement model."""
        return self.model

    def is_detectable(self, state: Any, measurement_model: Any = None) -> bool:
        """Always."""
        return True

    def is_clutter_detectable(self, state: Any) -> bool:
        """Always."""
        return True


def as_vector(values: Sequence[float], angles: Sequence[bool]) -> StateVector:
    """A measurement, angles as `Bearing`."""
    return StateVector([Bearing(v) if angle else float(v) for v, angle in zip(values, angles, strict=True)])
