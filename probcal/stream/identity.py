"""Identity of a stream: digests of its declarations and of the calibration that it begins from."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from probcal.fingerprint import computes
from probcal.inference.identity import add_array, setting_text
from probcal.model.sampled import SampledMotion
from probcal.motion import Component, Motion
from probcal.network import Network, Node
from probcal.noise import Heard, at_guess, guess_of
from probcal.sensor import Channel, Sensor, SensorType
from probcal.types import float64

if TYPE_CHECKING:
    import xarray as xr

STEPS = (0.3, 7.0)  # s, two unlike steps at which the linear form of a motion is compared


@float64
def declared_identity(
    network: Network, motion: Any, calibration: xr.DataTree | None, **settings: Any
) -> dict[str, str]:
    """The declarations that streams must share to be one stream, by their names in errors; no rows."""
    found = {name.replace("_", " "): setting_text(value) for name, value in settings.items()}
    motions = {f"motion of {name}": own for name, own in motion.items()} if isinstance(motion, Mapping) else {}
    parts: dict[str, Any] = {f"sensor {own.name}": own for own in network.types}
    parts |= {f"sensor {own.name}": own for own in network.sensors}
    parts |= {f"node {own.name}": own for own in network.nodes}
    for name, part in {**parts, **(motions or {"motion": motion}), "list of sensors": list(parts)}.items():
        found[name] = hashlib.sha256(json.dumps(_stated(part, network.dimension)).encode()).hexdigest()[:16]
    return found | {"calibration": "" if calibration is None else calibration_digest(calibration)}


def calibration_digest(tree: xr.DataTree) -> str:
    """Digest of the biases and noise levels that a fit found."""
    found = hashlib.sha256()
    for group in ("calibration", "level"):
        for name, variable in sorted(tree[group].variables.items()) if group in tree.children else ():
            found.update(str(name).encode())
            add_array(found, variable.values if variable.dtype.kind in "biuf" else variable.values.astype(object))
    return found.hexdigest()


def _stated(value: Any, dimension: int) -> Any:
    """A declaration as numbers and texts, equal in every process: what it states, and what its functions compute."""
    if value is None or isinstance(value, (bool, str)):
        return value
    if isinstance(value, (int, float, np.number)):
        return float(value)
    if isinstance(value, (np.ndarray, jax.Array)):
        return _stated(np.asarray(value).tolist(), dimension)
    if isinstance(value, (set, frozenset)):
        return sorted(map(str, value))
    if isinstance(value, (list, tuple)):
        return [_stated(part, dimension) for part in value]
    if isinstance(value, Mapping):
        return [[str(name), _stated(part, dimension)] for name, part in value.items()]
    if isinstance(value, SensorType):
        return [value.fingerprint, *(_stated(channel, dimension) for channel in value.channels.values())]
    parts: dict[str, Any] = {}
    if isinstance(value, Sensor):
        parts = {"type": value.type.name, "detection": value.detection, "known": value.known}
        parts["nodes"] = [node.name for node in value.nodes]
    elif isinstance(value, Node):
        parts = {name: getattr(value, name) for name in ("position", "components", "path", "spread", "sizes")}
    elif is_dataclass(value) and not isinstance(value, type):
        parts = {one.name: getattr(value, one.name) for one in fields(value)}
    else:
        parts = {"text": setting_text(value)}
    return [type(value).__name__, _stated(parts | _computed(value, dimension), dimension)]


def _computed(value: Any, dimension: int) -> dict[str, Any]:
    """The computations of a channel's noise or of a motion, which its fields need not state."""
    if isinstance(value, Channel):
        noise, number = value.noise, jax.ShapeDtypeStruct((), float)
        known: Any = noise.at(0.0) if isinstance(noise, Heard) and noise.floor is None else at_guess(noise)

        def density(y: Any, predicted: Any, std: Any) -> Any:
            weight = known.weight(y, predicted, std, value.period)
            return (
                known.log_likelihood(y, predicted, std, value.period), weight, known.information(predicted, std)
            )  # fmt: skip

        return {"density": computes(density, number, number, number)}
    if isinstance(value, Component):
        dt = np.array(STEPS)
        means: Any = [] if value.timed else value.means(np.zeros(1), dimension)
        return {
            "names": value.names(), "transition": value.transition(dt, dimension), "start": value.start(),
            "factor": value.noise_factor(dt, dimension), "means": means,
        }  # fmt: skip
    if isinstance(value, Motion) and value.split[1] == (value,):
        levels = tuple((name, guess_of(level), -1) for name, level in value.levels.items())
        return {"steps": SampledMotion(value.within(STEPS[1]), (), levels).fingerprint}
    return {}
