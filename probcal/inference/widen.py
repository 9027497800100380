"""Intervals widened where the innovations say that the noise is larger, or longer remembered, than
the model has it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal.gaussian import recursion as rec
from probcal.gaussian.engine import Engine, Expansion
from probcal.gaussian.information import rejected
from probcal.gaussian.mode import Eliminated, factors
from probcal.gaussian.scans import recur_squared
from probcal.inference import residuals
from probcal.inference.fitted import COLUMNS, Judged, take_up
from probcal.inference.residuals import LAGGED, NOTABLE, PRACTICAL, Channels, Innovations
from probcal.lazy import Later
from probcal.linalg import spectrum
from probcal.misfit import rejection_text
from probcal.model.model import Data, Model
from probcal.model.rows import Linearised
from probcal.motion.base import level_name
from probcal.priors import Precision
from probcal.problem import Problem
from probcal.results.blocks import SensorBlocks
from probcal.results.groups import along, by_target, data_columns, datum_of
from probcal.results.read import Calibrated
from probcal.status import INVALID
from probcal.types import float64

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr
    from scipy import signal
else:
    pd, xr, signal = Later("pandas"), Later("xarray"), Later("scipy.signal")

TOLD = 1.05  # times as wide, from which sds are widened
# probability of the NIS of all data, or of the whiteness of any channel, of a model that is wrong
REJECTED = 1e-3
# times `COLUMNS` simulated errors: the sd of a state is found to 6 % (128 columns, 4,000 Gaussian
# states)
CHUNKS = 8
NUMBERS = 20_000_000  # most simulated data of all columns together
SMALL = "small: the std or the process noise is too large, or the time has another unit"
LARGE = "large: the std is too small, or the model is wrong"
UNMOVED = 1e-3  # mean square of smoothed process noise below which the std is 30 times too large
UNASSESSED = "`assess` has not run: it looks for the cause."


class Rejection(NamedTuple):
    """Why the innovations reject a model, and what they call for.

    The reason is empty where they do not.
    """

    reason: str
    inflation: np.ndarray  # (M,) of the part of the variance of each bias that comes from the data
    scatter: residuals.Scatter  # of each channel
    channels: Channels


def rejection(fit: Judged, found: Innovations, channels: Channels) -> Rejection:
    """The test of the innovations by their mean square, and of each channel by its correlation in
    time."""
    scatter = residuals.scatter_of(fit.data, found, channels.members)
    inflation = residuals.inflation(fit, scatter.size * scatter.memory, channels.group)
    return Rejection(_reason(found, channels), inflation, scatter, channels)


def _reason(found: Innovations, channels: Channels) -> str:
    """The test of the innovations that rejects the model, in words; empty where none does."""
    total = residuals.squares(found, np.zeros(len(found.value), int), 1, 2 * REJECTED)
    if total.nis[0] > max(total.upper[0], PRACTICAL):
        return f"their mean square is {total.nis[0]:.2g} (limit {total.upper[0]:.2g})"
    lagged = channels.autocorrelation
    notable = np.maximum(NOTABLE, LAGGED / np.sqrt(np.bincount(channels.group)))
    red = (channels.white < REJECTED / len(lagged)) & (lagged > notable)
    if red.any():
        worst = int(np.argmax(np.where(red, lagged, -1.0)))
        cure = "if its noise has a memory, declare Channel(..., memory=Memory(std, time))"
        return f"those of {channels.names[worst]} follow each other ({lagged[worst]:.2f}; {cure})"
    return ""


def scattered(fit: Judged, found: Innovations, high: bool) -> str:
    """A sentence on innovations, of all data or of a sensor, that are far too small, or where
    `high` too large."""
    group, labels = residuals.codes(fit.data, ["sensor"])
    names = [f" of {name}" for name in labels["sensor"]]
    whole = residuals.squares(found, np.zeros(len(group), int), 1, REJECTED)
    part = residuals.squares(found, group, len(names), REJECTED / len(names))
    if whole.nis[0] < min(whole.lower[0], 1 / PRACTICAL):
        part, names = whole, [""]
    few, many = part.nis < np.minimum(part.lower, 1 / PRACTICAL), part.nis > np.maximum(part.upper, PRACTICAL)
    sentences, size = [], np.abs(np.log(np.maximum(part.nis, 1e-300)))
    for out, limit, cause in ((few, part.lower, SMALL), (many & high, part.upper, LARGE)):
        if out.any():
            k, others = int(np.argmax(np.where(out, size, -1.0))), int(out.sum()) - 1
            more = f" and {others} more sensors" if others else ""
            numbers = f"(mean square {part.nis[k]:.2g}, limit {limit[k]:.2g})"
            sentences.append(f"The innovations{names[k]} {numbers}{more} are too {cause}.")
    return " ".join(sentences)


def unmoved(fit: Judged) -> str:
    """A sentence on the component whose smoothed process noises are nearest to nothing, if less
    than `UNMOVED`.

    Under the model a whitened noise has mean square one, of which smoothing leaves one less its
    variance.
    """
    problem, found, driven = fit.problem, dict[str, float](), [own.spread for own in fit.expansion.given_biases()]
    for name, _, part, noises, spread in problem.tracks(problem.model.recursions, fit.point.noises, driven):
        expected = np.where(part.L.any(1), 1.0 - spread, 0.0)
        for component, columns in problem.noise_columns(name):
            told = float(expected[~part.first, columns].sum())
            if told >= residuals.FEWEST:
                square = float(np.sum(noises[~part.first, columns] ** 2)) / told
                drives = level_name(component).removesuffix("_std")
                found[f'the {drives} noise of target "{name}"'] = square
    name, square = min(found.items(), key=lambda pair: pair[1], default=("", 1.0))
    if square > UNMOVED:
        return ""
    return f"The data show {np.sqrt(square):.1g} of the std of {name}: check that std and the unit of the time."


@jax.jit
def _errors(
    model: Model,
    lins: Sequence[Linearised],
    solved: Eliminated,
    noise: Data,
    biases: jax.Array,
) -> list[jax.Array]:
    """Mean square (E, n) of the errors of the smoothed states of each recursion over K simulations.

    `noise` (N, C, K) is that of unit-noise data, `biases` (M, K) are the errors of the biases in z.
    """
    unit = [lin._replace(state=jnp.sqrt(lin.weight)[:, :, None] * lin.state) for lin in lins]
    columns = [
        own - jnp.sqrt(lin.weight)[:, :, None] * along
        for own, along, lin in zip(noise, model.by_bias(lins, biases), lins, strict=True)
    ]
    pulls = model.onto_states(unit, columns)
    parts = model.each_layout(solved.parts, pulls)
    return [jnp.mean(rec.smooth(part.F, kept.gain, pull).states ** 2, 2) for part, kept, pull in parts]


@jax.jit
def before_data(model: Model, levels: jax.Array) -> list[jax.Array]:
    """Variance (E, n) of every state before any data."""
    roots = [(part.F, factors(part, levels)) for part in model.recursions]
    return [jnp.diagonal(recur_squared(F, L @ L.mT), axis1=1, axis2=2) for F, L in roots]


def track_factors(
    fit: Judged, rejected: Rejection, tracks: xr.DataTree, root: Any, wide: np.ndarray
) -> dict[str, np.ndarray]:
    """Factors (time, component) of the sd of every target's states, by the name of its group; never
    beyond the prior.

    The variance of a smoothed state grows by that of the errors which noise as the innovations show
    it, and biases `wide` (M,) times as uncertain, make beyond those of the model: both are
    simulated with the smoother of the fit.
    """
    model, rng = fit.problem.model, np.random.default_rng(0)
    chunks = int(np.clip(NUMBERS // (COLUMNS * max(len(fit.data), 1)), 1, CHUNKS))
    more = [np.zeros(part.drift.shape) for part in model.recursions]
    for _ in range(chunks):
        biases = root @ rng.standard_normal((root.shape[1], COLUMNS))
        # unit noise (N, C, K) of each block as the model has it, and with the size and memory that each channel shows
        white = rng.standard_normal((len(fit.data), COLUMNS))
        red = np.empty_like(white)
        target, time = fit.data["target"].to_numpy(str), fit.data["time"].to_numpy()
        for mine, size, memory in zip(rejected.channels.members, *rejected.scatter, strict=True):
            order = mine[np.lexsort((time[mine], target[mine]))]
            again = (memory - 1.0) / (memory + 1.0)  # autoregressive noise of which so many count as one
            fresh = np.sqrt(1.0 - again**2) * white[order]
            fresh[0] = white[order[0]]
            red[order] = np.sqrt(size) * signal.lfilter([1.0], [1.0, -again], fresh, axis=0)
        plain, shown = fit.in_blocks(white), fit.in_blocks(red)
        for sign, noise, moved in ((-1, plain, biases), (1, shown, wide[:, None] * biases)):
            errors = _errors(model, fit.lins, fit.expansion.eliminated, noise, jax.device_put(moved))
            more = [own + sign * np.asarray(error) / chunks for own, error in zip(more, errors, strict=True)]
    dims, found, most = ("time", "component"), {}, before_data(model, fit.point.levels)
    for name, own in by_target(fit.problem, {"more": (dims, more), "most": (dims, most)}).items():
        variance = tracks[name].to_dataset()["sd"].values ** 2
        grown = variance + np.maximum(own["more"].values, 0.0)
        grown = np.minimum(grown, np.maximum(own["most"].values, variance))
        found[name] = np.sqrt(grown / np.where(variance > 0, variance, 1.0)).clip(1.0)
    return found


def widened(fit: Judged, rejected: Rejection, tree: xr.DataTree, root: Any) -> tuple[xr.DataTree, str]:
    """A copy of a result whose biases and tracks have the variance that the innovations call for,
    and what was done.

    `root` (M, R) is of the covariance of z. A bias takes the share gamma of its inflation, and no
    sd exceeds that of the prior. Means keep their place; sd, interval, covariance and the spread of
    the draws grow together, and "widened" of the groups says by which factor. A fit that is no
    answer stays as it is.
    """
    result = tree.copy()
    if not rejected.reason or tree.attrs.get("status") in INVALID:
        return result, ""
    text, wide, told = f"the innovations reject the model: {rejected.reason}", np.ones(len(rejected.inflation)), 1.0
    grown = []
    if "calibration" in tree.children:
        group = tree["calibration"].to_dataset()
        wide = bias_factors(group, rejected.inflation, tree.attrs["precisions"] == "given")
        if len(wide) and wide.max() >= TOLD:
            told = float(wide.max())
            _widen_biases(result, group, wide)
            most_of = group["bias_label"].values[int(wide.argmax())]
            grown.append(f"biases are already widened by up to {told:.2g} times (most {most_of})")
    tracks = track_factors(fit, rejected, tree.children["track"], root, wide) if "track" in tree.children else {}
    largest = {name: float(own.max(initial=1.0)) for name, own in tracks.items()}
    name, most = max(largest.items(), key=lambda pair: pair[1], default=("", 1.0))
    if most >= TOLD:
        told = max(told, most)
        for own, factor in tracks.items():
            _widen_track(result, own, factor)
        target, verb = tree["track"][name].attrs["target"], "" if grown else "are already widened "
        grown.append(f"tracks {verb}by up to {most:.2g} times ({target})")
    result.attrs["widened"] = told
    return result, f"{text}; the sd of the {', those of the '.join(grown)}" if grown else text


def widened_by(tree: xr.DataTree, problem: Problem, levels: jax.Array, inflation: np.ndarray) -> xr.DataTree:
    """A result whose biases have the variance that `inflation` (M,) calls for, and its tracks their mean."""
    if not (inflation > 1.0).any():
        return tree
    group = tree["calibration"].to_dataset()
    wide = bias_factors(group, inflation, False)
    _widen_biases(tree, group, wide)
    most = by_target(problem, {"most": (("time", "component"), before_data(problem.model, levels))})
    for name, own in most.items():
        sd = tree["track"][name].to_dataset()["sd"].values
        factors = widening_factors(sd, np.sqrt(own["most"].values), np.full(sd.shape, float(np.mean(inflation))))
        _widen_track(tree, name, np.where(sd > 0, factors, 1.0))
    tree.attrs["widened"] = float(wide.max())
    return tree


def bias_factors(group: xr.Dataset, inflation: np.ndarray, given: bool) -> np.ndarray:
    """Factors (M,) of the sd of the biases of a group `calibration`; never beyond the prior.

    The sd of the prior is the scale, or what its precision says where that is `given`.
    """
    precision = group["precision"].values if given else np.ones(len(inflation))
    with np.errstate(divide="ignore"):  # a flat prior has no sd
        before = group["scale"].values / np.sqrt(precision)
    return widening_factors(group["sd"].values, before, inflation, group["gamma"].values)


def widening_factors(
    sd: np.ndarray, before: np.ndarray, inflation: np.ndarray, gamma: np.ndarray | None = None
) -> np.ndarray:
    """Factors (M,) of sds, of whose variance the share gamma grows by `inflation`; never beyond the sds before data."""
    share = np.clip(1.0 - (sd / before) ** 2, 0.0, 1.0) if gamma is None else gamma
    wide = np.sqrt(1.0 + share * (inflation - 1.0))
    return np.clip(wide, 1.0, np.maximum(before / sd, 1.0))


def _widen_biases(result: xr.DataTree, group: xr.Dataset, wide: np.ndarray) -> None:
    """Biases of a result with their sds times `wide` (M,)."""
    mean = group["mean"].values
    ends = {name: mean + wide * (group[name].values - mean) for name in ("lower", "upper")}
    columns = {"sd": group["sd"].values * wide, **ends, "widened": wide}
    spread = SensorBlocks.read(group, group["bias_label"].values.tolist(), "widened").widened(wide)
    grown = spread.columns(np.ones(len(wide)))
    group = group.assign(along("bias_label", columns))
    result["calibration"] = xr.DataTree(group.assign(grown))
    draws = result["posterior"].to_dataset()
    drawn = (draws["bias"] - draws["bias"].mean(("chain", "draw"))) * xr.DataArray(wide - 1.0, dims="bias_label")
    result["posterior"] = xr.DataTree(draws.assign(bias=draws["bias"] + drawn))


def _widen_track(result: xr.DataTree, name: str, wide: np.ndarray) -> None:
    """A track of a result with its sds times `wide` (time, component), and the spread of its draws
    where it has any."""
    group = result.children["track"].children[name].to_dataset(inherit=False)
    factor = xr.DataArray(wide, dims=("time", "component"))
    columns = {"sd": group["sd"] * factor, "widened": factor}
    if "state" in group:
        middle = group["state"].mean(("chain", "draw"))
        columns["state"] = (middle + (group["state"] - middle) * factor).transpose(*group["state"].dims)
    result[f"track/{name}"] = xr.DataTree(group.assign(columns))


def unwidened(tree: xr.DataTree) -> xr.DataTree:
    """A copy of a result as its method left it, without what its innovations made of it."""
    result = tree.copy()
    if told := result.attrs.pop("innovations", ""):
        result.attrs["message"] = tree.attrs["message"].removesuffix(told).rstrip()
    if result.attrs.pop("widened", None) is None:
        return result
    group = tree["calibration"].to_dataset()
    if "widened" in group:
        _widen_biases(result, group, 1.0 / group["widened"].values)
        result["calibration"] = xr.DataTree(result["calibration"].to_dataset().drop_vars("widened"))
    for name, node in tree.children["track"].children.items() if "track" in tree.children else ():
        if "widened" in node:
            _widen_track(result, name, 1.0 / node.to_dataset(inherit=False)["widened"].values)
            own = result.children["track"].children[name].to_dataset(inherit=False)
            result[f"track/{name}"] = xr.DataTree(own.drop_vars("widened"))
    return result


def said(tree: xr.DataTree, text: str) -> None:
    """Add to the message of a result what its innovations say, so that it can be taken off again."""
    text = text.strip()
    if not text:
        return
    tree.attrs |= {"message": f"{tree.attrs.get('message', '')} {text}".strip(), "innovations": text}


def sentence(text: str) -> str:
    """The sentence of a clause; empty for none."""
    return f"{text[0].upper()}{text[1:]}." if text else ""


@float64
def judge_fit(problem: Problem, tree: xr.DataTree) -> xr.DataTree:
    """A copy of the tree of a fit of a problem with what its innovations say in its message, its intervals
    widened by that."""
    if tree.attrs["status"] in INVALID:
        return tree
    fit = take_up(problem, tree)
    found = residuals.innovations(fit, residuals.measured_kurtosis(fit)).innovations
    return _judged(fit, found, tree, fit.root, unmoved(fit), UNASSESSED)


def judge_tracks(tree: xr.DataTree, problem: Problem, known: Calibrated, engine: Engine, at: Expansion) -> xr.DataTree:
    """A copy of tracks at a calibration, judged and widened likewise.

    The biases are taken where rows and calibration together put them, so that an error within the sds of the
    calibration is no misfit. Where the covariance of all is not held it raises what the innovations are expected to
    scatter.
    """
    datum, picks = datum_of(problem)
    data = pd.DataFrame(data_columns(datum))
    flat, root, spread, dz = Precision(jnp.zeros(len(known.z))), known.spread.root(), known.spread, None
    if spread.whole and (information := at.information()) is not None:
        values, vectors = spectrum(root.T @ information @ root)
        both = root @ (vectors / np.sqrt(1.0 + np.maximum(values, 0.0)))
        spread = SensorBlocks.of(both @ both.T)
        dz = spread.matrix() @ np.asarray(at.slope())
    fit = Judged(problem, at, picks, data, flat, spread, engine)
    found = residuals.innovations(fit, residuals.measured_kurtosis(fit), dz).innovations
    return _judged(fit, found, tree, root, rejection_text(rejected(problem, at.point)))


def _judged(
    fit: Judged,
    found: Innovations,
    tree: xr.DataTree,
    root: Any,
    cause: str = "",
    more: str = "",
) -> xr.DataTree:
    """A copy of a result, judged by its innovations.

    If there is something to say its message ends with `more`.
    """
    rejected = rejection(fit, found, residuals.channels_of(fit.data, found))
    result, text = widened(fit, rejected, tree, root)
    told = [part for part in (sentence(text), scattered(fit, found, not text), cause) if part]
    said(result, " ".join([*told, more] if told else []))
    return result
