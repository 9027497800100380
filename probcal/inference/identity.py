"""The identity of a run: digests of model and data, and the settings and versions used."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from importlib.metadata import version
from typing import Any

import jax
import numpy as np

from probcal.files import AnyPath
from probcal.fingerprint import ADDRESS, computes
from probcal.inference.storage import Storage
from probcal.model.rows import Block, Rows, information, log_likelihood, weigh
from probcal.priors import Prior
from probcal.problem import Problem
from probcal.results.schema import RESULTS_VERSION


def identity_of(problem: Problem, **settings: Any) -> dict[str, str]:
    """The properties that runs must share to be one run, by the names that error messages use."""
    labels = " ".join(problem.labels)
    return identity(**settings) | {
        "data": data_digest(problem), "list of biases": labels, "model": model_digest(problem),
    }  # fmt: skip


def stored_fit(
    store: AnyPath | None, problem: Problem, method: Any, prior: Prior, key: jax.Array, start: Any,
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
    return versions | {name.replace("_", " "): setting_text(value) for name, value in settings.items()}


def setting_text(value: Any) -> str:
    """A setting as text, without addresses in memory."""
    return value if isinstance(value, str) else ADDRESS.sub("", repr(value))


def seed_text(key: jax.Array) -> str:
    """A key as text."""
    return str(np.asarray(jax.random.key_data(key)).tolist())


def points_digest(points: Any) -> str:
    """Digest of the arrays of a pytree."""
    found = hashlib.sha256()
    for leaf in jax.tree.leaves(points):
        add_array(found, leaf)
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
        add_array(found, array)
    found.update(repr((data.channels, data.target_names)).encode())
    return found.hexdigest()


def model_digest(problem: Problem) -> str:
    """Digest of sensors (functions and their constants), noise, motion, network, biases and what is fixed."""
    found = hashlib.sha256()
    for block, rows, _ in problem.model.each_block():
        found.update(_code(block, rows, len(problem.levels)).encode())
        for name, leaf in rows._asdict().items():
            if name not in ("y", "mask"):
                add_array(found, leaf)
    for leaf in jax.tree.leaves((problem.model.recursions, problem.model.level_spread)):
        add_array(found, leaf)
    model = problem.model
    stated = [(n.name, n.position.tolist(), {k: np.asarray(v).tolist() for k, v in n.components.items()})
              for n in problem.network.nodes]  # fmt: skip
    words = (
        problem.biases, problem.fixed, problem.levels, model.recursion, model.biases, stated,
        [(e.components, e.layout) for e in problem.epochs],
    )  # fmt: skip
    found.update(setting_text(words).encode())
    return found.hexdigest()


def _code(block: Block, rows: Rows, levels: int) -> str:
    """The fingerprint of a block: its sensors, and the densities and weights of its noise."""

    def noise(rows: Rows, predicted: jax.Array, levels: jax.Array) -> Any:
        weights = weigh(block, rows, predicted, levels, expected=False)
        return (
            log_likelihood(block, rows, predicted, levels), weights, information(block, rows, predicted, levels)
        )  # fmt: skip

    return block.type.fingerprint + computes(noise, rows, rows.y, np.zeros(levels))


def add_array(found: Any, value: Any) -> None:
    """Take up the form and the bytes of an array."""
    array = np.ascontiguousarray(value)
    found.update(f"{array.dtype}{array.shape}".encode())
    found.update(repr(array.tolist()).encode() if array.dtype.hasobject else array.tobytes())
