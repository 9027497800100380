"""What a run is: digests of model and data, with the settings and versions under which its results were made."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from importlib.metadata import version
from os import PathLike
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from probcal.fingerprint import ADDRESS, computes
from probcal.inference.storage import Storage
from probcal.model.rows import Block, Rows, information, log_likelihood, weigh
from probcal.model.sampled import SampledMotion
from probcal.motion import Component, Motion
from probcal.network import Network, Node
from probcal.noise import Heard, at_guess, guess_of
from probcal.priors import Prior
from probcal.problem import Problem
from probcal.results.schema import RESULTS_VERSION
from probcal.sensor import Channel, Sensor, SensorType
from probcal.types import float64

if TYPE_CHECKING:
    import xarray as xr

STEPS = (0.3, 7.0)  # s, two unlike steps at which the linear form of a motion is compared


def identity_of(problem: Problem, **settings: Any) -> dict[str, str]:
    """What runs must share to be one run, by the name that an error gives it."""
    labels = " ".join(problem.labels)
    return identity(**settings) | {
        "data": data_digest(problem), "list of biases": labels, "model": model_digest(problem),
    }  # fmt: skip


def stored_fit(
    store: str | PathLike[str] | None, problem: Problem, method: Any, prior: Prior, key: jax.Array, start: Any,
    starts: int, *, resume: bool, overwrite: bool,
) -> Storage:  # fmt: skip
    """The storage of a fit, in memory where no folder is given: of a sampler's draws, or of the states of climbs."""
    known: dict[str, str] = {}
    if store is not None:
        known = identity_of(
            problem, method=method, prior=prior, seed=seed_text(key), number_of_starts=starts,
            start="" if start is None else points_digest(start),
        )  # fmt: skip
    return Storage(store, "climb" if method.climbs else "draws", known, resume=resume, overwrite=overwrite)


def identity(**settings: Any) -> dict[str, str]:
    """Settings as texts, with the versions of package and results."""
    versions = {"version of probcal": version("probcal"), "version of the results": str(RESULTS_VERSION)}
    return versions | {name.replace("_", " "): _text(value) for name, value in settings.items()}


def _text(value: Any) -> str:
    return value if isinstance(value, str) else ADDRESS.sub("", repr(value))


def seed_text(key: jax.Array) -> str:
    """A key as text."""
    return str(np.asarray(jax.random.key_data(key)).tolist())


def points_digest(points: Any) -> str:
    """Digest of the arrays of a pytree."""
    found = hashlib.sha256()
    for leaf in jax.tree.leaves(points):
        _add(found, leaf)
    return found.hexdigest()


def problem_digest(problem: Problem, truth: Mapping[str, float]) -> str:
    """Digest of a simulated problem and its true biases."""
    text = data_digest(problem) + model_digest(problem) + repr(sorted((k, float(v)) for k, v in truth.items()))
    return hashlib.sha256(text.encode()).hexdigest()


def data_digest(problem: Problem) -> str:
    """Digest of what was measured: values, times, sensors and targets."""
    data = problem.measurements
    found = hashlib.sha256()
    own = np.where(data.has_std, data.std, 0.0)  # else the model's
    for array in (data.value, data.measured, data.time, data.sensor, data.target, own):
        _add(found, array)
    found.update(repr((data.channels, data.target_names)).encode())
    return found.hexdigest()


def model_digest(problem: Problem) -> str:
    """Digest of sensors (functions and their constants), noise, motion, network, biases and what is fixed."""
    found = hashlib.sha256()
    for block, rows, _ in problem.model.each_block():
        found.update(_code(block, rows, len(problem.levels)).encode())
        for name, leaf in rows._asdict().items():
            if name not in ("y", "mask"):
                _add(found, leaf)
    for leaf in jax.tree.leaves((problem.model.recursions, problem.model.level_spread)):
        _add(found, leaf)
    model = problem.model
    stated = [(n.name, n.position.tolist(), {k: np.asarray(v).tolist() for k, v in n.components.items()})
              for n in problem.network.nodes]  # fmt: skip
    words = (
        problem.biases, problem.fixed, problem.levels, model.recursion, model.biases, stated,
        [(e.components, e.layout) for e in problem.epochs],
    )  # fmt: skip
    found.update(_text(words).encode())
    return found.hexdigest()


@float64
def declared_identity(
    network: Network, motion: Any, calibration: xr.DataTree | None, **settings: Any
) -> dict[str, str]:
    """What streams must share to be one stream, by the name that an error gives it; no row is part of it."""
    found = {name.replace("_", " "): _text(value) for name, value in settings.items()}
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
            _add(found, variable.values if variable.dtype.kind in "biuf" else variable.values.astype(object))
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
        parts = {"text": _text(value)}
    return [type(value).__name__, _stated(parts | _computed(value, dimension), dimension)]


def _computed(value: Any, dimension: int) -> dict[str, Any]:
    """What the functions of a channel's noise or of a motion compute, which its fields need not say."""
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


def _code(block: Block, rows: Rows, levels: int) -> str:
    """What a block computes: its sensors, and the densities and weights of its noise."""

    def noise(rows: Rows, predicted: jax.Array, levels: jax.Array) -> Any:
        weights = weigh(block, rows, predicted, levels, expected=False)
        return (
            log_likelihood(block, rows, predicted, levels), weights, information(block, rows, predicted, levels)
        )  # fmt: skip

    return block.type.fingerprint + computes(noise, rows, rows.y, jnp.zeros(levels))


def _add(found: Any, value: Any) -> None:
    """Take up the form and the bytes of an array."""
    array = np.ascontiguousarray(value)
    found.update(f"{array.dtype}{array.shape}".encode())
    found.update(repr(array.tolist()).encode() if array.dtype.hasobject else array.tobytes())
