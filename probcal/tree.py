"""The only writer of results: one labelled DataTree from every method, and its netCDF file."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from os import PathLike
from pathlib import Path
from statistics import NormalDist
from typing import TYPE_CHECKING, Any

import numpy as np

from probcal.errors import InputError
from probcal.files import write_whole
from probcal.lazy import Later
from probcal.status import Status

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from probcal.problem import Problem
else:
    xr = Later("xarray")

INTERVAL = 0.89  # probability of lower to upper
SHARP = 256  # steps to which the spread of a log-likelihood over the draws is rounded, so that its file is small
AT_ONCE = 10_000  # data that are rounded at once
SMALL = 1024  # bytes up to which an array of a file has no chunk of its own
RESULTS_VERSION = 1  # of the groups and variables that a fit writes; a reader refuses any other
MORE = ("r_hat", "ess", "ess_tail", "inclusion", "included", "contraction")  # columns of samplers
SUMMARY = ("bias", "unit", "scale", "mean", "sd", "lower", "upper", "gamma")

SEAL = b"probcal sha256:"  # behind the content of a file, before its digest
NEEDED = {  # what readers of a fit take for granted
    "posterior": ("bias",),
    "calibration": (*SUMMARY[1:], "bias_label", "covariance", "information", "precision", "status", "kind"),
    "track": (),
    "observed_data": ("y", "sensor", "channel", "target", "time", "row"),
    "residual": ("before", "after", "std", "weight"),
    "constant_data": ("node_position", "node_heading", "moving", "stated", "stated_node", "stated_component"),
}
TRACKED = ("mean", "sd", "before", "epoch_time", "epoch_target", "component")  # of each recursion
JUDGED = {"verdict": ("verdict", "reason"), "finding": ("sentence",), "level": ("std", "guess")}  # where they are
ATTRIBUTES = ("method", "prior", "seed", "status", "message", "intervals", "settings", "interval_probability", "data")


@dataclass(frozen=True)
class Tracks:
    """Posterior moments of one recursion: mean and sd (E, n), and the mean without calibration (E, n)."""

    mean: np.ndarray
    sd: np.ndarray
    before: np.ndarray


@dataclass(frozen=True)
class Residuals:
    """Of each block (N, C): innovation without and with calibration, noise level, and how much a datum counts."""

    before: Sequence[np.ndarray]
    after: Sequence[np.ndarray]
    std: Sequence[np.ndarray]
    weight: Sequence[np.ndarray]


@dataclass(frozen=True)
class Result:
    """What a method hands over, in z and in the order of `problem.labels`; arrays of NumPy."""

    method: str
    prior: str
    seed: int
    approximate: str
    intervals: str
    settings: str
    correlated: bool  # whether the prior couples biases
    status: Status
    message: str
    z: np.ndarray  # (M,)
    covariance: np.ndarray  # (M, M)
    precision: np.ndarray  # (M,)
    gamma: np.ndarray  # (M,)
    bias_status: Sequence[str]
    information: np.ndarray  # (M, M)
    evidence: float | None
    objective: np.ndarray | None  # trace
    levels: np.ndarray  # (H,) log factors
    directions: Sequence[Any]  # name, information, vector, sentence
    draws: np.ndarray  # (chain, draw, M) of z
    log_prior: np.ndarray | None  # (chain, draw, M) where the biases are independent
    states: Sequence[np.ndarray]  # (chain, draw, E, n) of each recursion, empty where not kept
    kept: np.ndarray  # (kept,) which draws of each chain have values by datum
    log_likelihood: Sequence[np.ndarray]  # (chain, kept, N, C) of each block
    replicas: Sequence[np.ndarray]  # (chain, kept, N, C) of each block, empty where not kept
    tracks: Sequence[Tracks]
    residuals: Residuals
    lower: np.ndarray | None = None  # (M,) of the interval, in z; Gaussian where not given
    upper: np.ndarray | None = None
    requested: str = ""  # the method that was asked for, where another ran
    precisions: str = "given"  # or "maximised", or "sampled"
    columns: Mapping[str, np.ndarray] = field(default_factory=dict)  # further columns (M,) of the calibration
    posterior: Mapping[str, Any] = field(default_factory=dict)  # name -> dims, values (chain, draw, ...)[, coords]
    sample_stats: Mapping[str, np.ndarray] = field(default_factory=dict)  # (chain, draw)
    attrs: Mapping[str, Any] = field(default_factory=dict)


def suffix(problem: Problem, r: int) -> str:
    """What the names of recursion r end with: nothing where there is one only."""
    return "" if len(problem.epochs) == 1 else f"_{r}"


def datum_of(problem: Problem) -> tuple[dict[str, Any], list[Any]]:
    """Coordinates of the measured data, and where each block keeps them (rows, channels)."""
    data, network = problem.measurements, problem.network
    picks: list[Any] = []
    columns = []
    parts = zip(problem.columns, problem.row_index, problem.model.measured, problem.model.values, strict=True)
    for names_, index, there, values in parts:
        where = np.nonzero(np.asarray(there))
        picks.append(where)
        columns.append((index[where[0]], np.array(names_)[where[1]], np.asarray(values)[where]))
    row = np.concatenate([c[0] for c in columns])
    names = np.array([s.name for s in network.sensors])
    coords = {
        "sensor": ("datum", names[data.sensor[row]]),
        "channel": ("datum", np.concatenate([c[1] for c in columns])),
        "target": ("datum", np.array(data.target_names)[data.target[row]]),
        "time": ("datum", data.time[row]),
        "row": ("datum", data.table.lines[row]),
    }
    return {"coords": coords, "y": np.concatenate([c[2] for c in columns])}, picks


def gather(parts: Sequence[np.ndarray], picks: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Measured data of all blocks, last axis datum, from arrays (..., N, C)."""
    found = [np.asarray(p)[..., rows, channels] for p, (rows, channels) in zip(parts, picks, strict=True)]
    return np.concatenate(found, -1) if len(found) > 1 else found[0]


def build(problem: Problem, result: Result) -> xr.DataTree:
    """Assemble the DataTree of a fit (groups posterior, calibration, track, observed_data, ...)."""
    datum, picks = datum_of(problem)
    coords, labels = datum["coords"], list(problem.labels)
    scales = problem.scales
    sample = ("chain", "draw")
    chains, draws = result.draws.shape[:2]
    base = {"chain": np.arange(chains), "draw": np.arange(draws)}
    posterior: dict[str, Any] = {"bias": ((*sample, "bias_label"), result.draws * scales)}
    track = track_group(problem, result.tracks)
    for r, states in enumerate(result.states):
        s = suffix(problem, r)
        posterior[f"state{s}"] = ((*sample, f"epoch{s}", f"component{s}"), states)
    further: dict[str, Any] = {str(k): v for k, v in track.coords.items()} if len(result.states) else {}
    for name, (dims, values, *own) in result.posterior.items():
        posterior[name] = ((*sample, *dims), values)
        further |= own[0] if own else {}
    z = ("bias_label", labels)
    sd = np.sqrt(np.diag(result.covariance))
    half = NormalDist().inv_cdf(0.5 + INTERVAL / 2)
    calibration = {
        "mean": result.z * scales, "sd": sd * scales,
        "lower": (result.z - half * sd if result.lower is None else result.lower) * scales,
        "upper": (result.z + half * sd if result.upper is None else result.upper) * scales,
        "gamma": result.gamma, "precision": result.precision, "scale": scales,
        "status": np.array(result.bias_status, str), "unit": np.array([b.unit for b in problem.biases], str),
        "kind": np.array([b.kind for b in problem.biases], str), **result.columns,
    }  # fmt: skip
    residual = {name: ("datum", gather(parts, picks)) for name, parts in vars(result.residuals).items()}
    groups: dict[str, xr.Dataset] = {
        "posterior": xr.Dataset(posterior, coords={**base, **further, "bias_label": z}),
        "calibration": xr.Dataset(
            {k: ("bias_label", v) for k, v in calibration.items()}
            | {
                "covariance": (("bias_label", "bias_label_other"), result.covariance * np.outer(scales, scales)),
                "information": (("bias_label", "bias_label_other"), result.information),
            },
            coords={"bias_label": z, "bias_label_other": labels},
        ),
        "track": track,
        "observed_data": xr.Dataset({"y": ("datum", datum["y"])}, coords=coords),
        "residual": xr.Dataset(residual, coords=coords),
        "constant_data": constant_group(problem),
    }
    if result.objective is not None:
        groups["optimisation"] = xr.Dataset({"objective": ("iteration", result.objective)})
    if result.sample_stats:
        groups["sample_stats"] = xr.Dataset({k: (sample, v) for k, v in result.sample_stats.items()}, coords=base)
    if result.log_prior is not None:
        groups["log_prior"] = xr.Dataset(
            {"bias": ((*sample, "bias_label"), result.log_prior)}, coords={**base, "bias_label": z}
        )
    by_datum = {"log_likelihood": result.log_likelihood, "posterior_predictive": result.replicas}
    for name, values in ((name, gather(parts, picks)) for name, parts in by_datum.items() if len(parts)):
        kept = {"chain": base["chain"], "draw": result.kept, **coords}
        rounded = _rounded(values) if name == "log_likelihood" else values
        groups[name] = xr.Dataset({"y": ((*sample, "datum"), rounded)}, coords=kept)
    if problem.levels:
        guess = np.array([level.guess for level in problem.levels])
        groups["level"] = xr.Dataset(
            {"std": ("level", guess * np.exp(result.levels)), "guess": ("level", guess)},
            coords={"level": [level.label for level in problem.levels]},
        )
    if result.directions:
        groups["direction"] = direction_group(labels, result.directions)
    attrs = {
        "method": result.method, "prior": result.prior, "seed": result.seed, "approximate": result.approximate,
        "intervals": result.intervals, "settings": result.settings, "correlated": int(result.correlated),
        "interval_probability": INTERVAL, "results_version": RESULTS_VERSION,
        "requested": result.requested or result.method, "precisions": result.precisions,
        "motion": "used",
        "status": str(result.status), "message": result.message, "data": problem.measurements.table.source,
        "versions": json.dumps({name: version(name) for name in ("probcal", "jax", "arviz", "numpy", "xarray")}),
    } | dict(result.attrs)  # fmt: skip
    if result.evidence is not None:
        attrs["log_evidence"] = result.evidence
    for group in groups.values():
        group.attrs.update(inference_library="probcal", inference_library_version=version("probcal"))
    tree = xr.DataTree.from_dict(groups)
    tree.attrs.update(attrs)
    return tree


def _rounded(log_likelihood: np.ndarray) -> np.ndarray:
    """Values (chain, draw, datum), rounded in place to 1/256 of their spread over the draws of a datum.

    What is rounded away is noise, and the rest compresses to a byte and a half a value.
    """
    for start in range(0, log_likelihood.shape[2], AT_ONCE):
        part = log_likelihood[:, :, start : start + AT_ONCE]
        with np.errstate(invalid="ignore"):  # a row of probability zero
            spread = part.std((0, 1))
        sure = np.isfinite(spread) & (spread > 1e-9)
        step = np.exp2(np.floor(np.log2(spread[sure] / SHARP)))
        part[:, :, sure] = np.rint(part[:, :, sure] / step) * step
    return log_likelihood


def direction_group(labels: Sequence[str], directions: Sequence[Any]) -> xr.Dataset:
    """Directions that the data do not fix: what moves, how weakly it is known, and the remedy."""
    texts = {name: [getattr(d, name) for d in directions] for name in ("sentence", "words", "kind", "remedy")}
    columns = texts | {
        "information": [d.information for d in directions],
        "share": [d.share for d in directions],
        "fix": [" ".join(d.fix) for d in directions],
    }
    group = xr.Dataset({name: ("direction", values) for name, values in columns.items()})
    vectors = (("direction", "bias_label"), np.stack([d.vector for d in directions]))
    return group.assign(vector=vectors).assign_coords(direction=[d.name for d in directions], bias_label=list(labels))


def track_group(problem: Problem, tracks: Sequence[Tracks]) -> xr.Dataset:
    """Mean, sd and uncalibrated mean of every state, with times and targets of the epochs."""
    return by_epoch(problem, {name: [getattr(t, name) for t in tracks] for name in ("mean", "sd", "before")})


def by_epoch(problem: Problem, variables: Mapping[str, Sequence[np.ndarray]]) -> xr.Dataset:
    """Variables of each recursion, (E, n) by state component or (E,), with times and targets of the epochs.

    Their names and dimensions carry a suffix where a problem has several recursions.
    """
    values: dict[str, Any] = {}
    coords: dict[str, Any] = {}
    for r, epochs in enumerate(problem.epochs):
        s = suffix(problem, r)
        coords |= {
            f"component{s}": list(epochs.components),
            f"epoch_time{s}": (f"epoch{s}", epochs.time),
            f"epoch_target{s}": (f"epoch{s}", np.asarray(epochs.target, str)),
        }
        for name, parts in variables.items():
            values[f"{name}{s}"] = ((f"epoch{s}", f"component{s}")[: parts[r].ndim], parts[r])
    return xr.Dataset(values, coords=coords)


def build_tracks(problem: Problem, tracks: Sequence[Tracks]) -> xr.DataTree:
    """A tree of tracks alone, for data to which a calibration was applied."""
    tree = xr.DataTree.from_dict({"track": track_group(problem, tracks)})
    tree.attrs["data"] = problem.measurements.table.source
    return tree


@dataclass(frozen=True)
class Calibrated:
    """A calibration in the numbers of a problem: the problem with the same biases held, z, its covariance, levels."""

    problem: Problem
    z: np.ndarray  # (M,)
    covariance: np.ndarray  # (M, M)
    levels: np.ndarray  # (H,) log factors


def apply(problem: Problem, calibration: xr.DataTree) -> Calibrated:
    """What a fit found, for another problem of its network; biases and levels are matched by label.

    Biases that the fit held are held; a level that it did not estimate stays at its guess. Raises `InputError` if the
    calibration lacks a bias.
    """
    constant = calibration["constant_data"].to_dataset()
    held = {str(k): float(v) for k, v in constant["fixed"].to_series().items()} if "fixed" in constant else {}
    held = {label: value for label, value in held.items() if label in problem.labels}
    problem = problem.rebuild(fix=problem.fixed | held) if held else problem
    group, labels = calibration["calibration"].to_dataset(), list(problem.labels)
    known = [str(label) for label in group["bias_label"].values]
    for label in labels:
        if label not in known:
            raise InputError(f'the calibration has no bias "{label}"; fit the same network, or fix that bias')
    mean = group["mean"].sel(bias_label=labels).values
    spread = group["covariance"].sel(bias_label=labels, bias_label_other=labels).values
    levels = np.zeros(len(problem.levels))
    if problem.levels and "level" in calibration.children:
        found = calibration["level"].to_dataset()["std"].to_series()
        levels = np.array([np.log(found.get(r.label, r.guess) / r.guess) for r in problem.levels])
    return Calibrated(problem, mean / problem.scales, spread / np.outer(problem.scales, problem.scales), levels)


def constant_group(problem: Problem) -> xr.Dataset:
    """Stated values of the nodes (positions, headings, every component), which of them move, and the fixed biases."""
    d, nodes = problem.network.dimension, problem.network.nodes
    stated = [(n.name, component, float(value)) for n in nodes for component, value in n.components.items()]
    owners, components, numbers = zip(*stated, strict=True)
    values = {
        "node_position": (("node", "axis"), np.stack([n.position for n in nodes])),
        "node_heading": ("node", np.array([float(n.components["heading"]) for n in nodes])),
        "moving": ("node", np.array([n.path is not None for n in nodes])),
        "stated": ("value", np.array(numbers)),
    }
    coords: dict[str, Any] = {
        "node": [n.name for n in nodes], "axis": ["x", "y", "z"][:d],
        "stated_node": ("value", np.array(owners)), "stated_component": ("value", np.array(components)),
    }  # fmt: skip
    if problem.fixed:
        values["fixed"] = ("fixed_label", np.array(list(problem.fixed.values())))
        coords["fixed_label"] = list(problem.fixed)
    return xr.Dataset(values, coords=coords)


def add_optima(tree: xr.DataTree, problem: Problem, outcomes: Sequence[Any], best: int) -> xr.DataTree:
    """Add the optima found from several starts, the reported one first: biases, evidence, objective, status."""
    order = [best, *(k for k in range(len(outcomes)) if k != best)]
    chosen = [outcomes[k] for k in order]
    values: dict[str, Any] = {
        "bias": (("optimum", "bias_label"), np.stack([np.asarray(o.point.z) * problem.scales for o in chosen])),
        "objective": ("optimum", np.array([float(o.trace[-1]) for o in chosen])),
        "status": ("optimum", np.array([str(o.status) for o in chosen])),
        "start": ("optimum", np.array(order)),
    }
    evidence = np.array([float(o.laplace.evidence) for o in chosen])
    if "log_evidence" in tree.attrs and np.isfinite(evidence).all():
        values["log_evidence"] = ("optimum", evidence)
    tree["optimum"] = xr.DataTree(xr.Dataset(values, coords={"bias_label": list(problem.labels)}))
    return tree


def outliers(tree: xr.DataTree, below: float = 0.5) -> pd.DataFrame:
    """Data that count less than `below` (heavy-tailed noise), the least first: row, time, sensor, residual, weight.

    The weight is that of a Student-t over its largest, or the probability that a datum is no echo of a mixture.
    """
    frame = tree["residual"].to_dataset().to_dataframe().reset_index(drop=True)
    frame["residual/std"] = frame["after"] / frame["std"]
    columns = ["row", "time", "sensor", "target", "channel", "after", "residual/std", "weight"]
    return frame[frame["weight"] < below].sort_values("weight", kind="stable")[columns].reset_index(drop=True)


def add_scores(tree: xr.DataTree, scores: Mapping[str, float], biases: Mapping[str, float]) -> xr.DataTree:
    """Add what the truth says of a fit: scores as attributes, true biases to the calibration group."""
    tree.attrs.update({name: float(value) for name, value in scores.items()})
    known = {label: value for label, value in biases.items() if label in tree["calibration"]["bias_label"]}
    if known:
        tree["truth"] = xr.DataTree(
            xr.Dataset({"bias": ("bias_label", list(known.values()))}, coords={"bias_label": list(known)})
        )
    return tree


def summary(tree: xr.DataTree) -> Any:
    """One row a bias as a DataFrame: bias, unit, scale, mean, sd, lower, upper, gamma, precision, status.

    After `assess` also verdict and reason.
    """
    group = tree["calibration"].to_dataset()
    columns = [*SUMMARY, "precision", "status", *(name for name in MORE if name in tree["calibration"])]
    if "verdict" in tree.children:
        judged = tree["verdict"].to_dataset()[["verdict", "reason"]]
        group, columns = group.merge(judged), [*columns, *judged.data_vars]
    frame = group[columns[1:]].to_dataframe().reset_index()
    return frame.rename(columns={"bias_label": "bias"})[columns]


def save(tree: xr.DataTree, path: str | PathLike[str]) -> Path:
    """Write netCDF in one step, compressed and with checksums: a file of that name is whole or absent.

    Raises `InputError` where it cannot be written.
    """
    content = tree.to_netcdf(engine="h5netcdf", encoding=_encoding(tree))  # in memory: HDF5 dies on a full disk
    return write_whole(path, b"".join([content, SEAL, hashlib.sha256(content).digest()]))


def _encoding(tree: xr.DataTree) -> dict[str, Any]:
    """Compression and a checksum for every array of every group; texts as characters, which alone can have them.

    Small ones stay plain, an HDF5 chunk would cost more than it holds: the digest of the whole file covers them.
    """
    packed = {"zlib": True, "complevel": 4, "shuffle": True, "fletcher32": True}
    found: dict[str, Any] = {}
    for node in tree.subtree:
        variables = node.to_dataset(inherit=False).variables.items()
        found[node.path] = {
            name: packed | ({"dtype": "S1"} if _is_text(variable) else {})
            for name, variable in variables
            if variable.nbytes > SMALL
        }
    return found


def _is_text(variable: xr.Variable) -> bool:
    return variable.dtype.kind in "UO" and all(isinstance(value, str) for value in variable.values.ravel())


def load(path: str | PathLike[str]) -> xr.DataTree:
    """Read a fit back from its file, or from the folder that holds `fit.nc`.

    Raises `InputError` where the file is damaged, foreign, or written by another version.
    """
    path = Path(path)
    try:
        path = path / "fit.nc" if path.is_dir() else path
        sealed = _sealed(path)
    except (OSError, ValueError) as error:  # nor is a name that no file can have
        raise InputError(f"{path} is not a fit written by probcal ({type(error).__name__}: {error})") from None
    if not sealed:
        raise InputError(f"{path} is damaged: its checksum does not match its content; fit again")
    try:
        with xr.open_datatree(path, engine="h5netcdf") as tree:
            tree = tree.load()
    except Exception as error:  # whatever the netCDF and HDF5 libraries say of foreign bytes
        raise InputError(f"{path} is not a fit written by probcal ({type(error).__name__}: {error})") from None
    check_content(tree, path)
    return tree


def _sealed(path: Path) -> bool:
    """Whether the digest behind the content matches it; a file that another program wrote has none."""
    tail = len(SEAL) + hashlib.sha256().digest_size
    with path.open("rb") as file:
        left = file.seek(0, 2) - tail
        if left < 0:
            return True
        file.seek(left)
        seal, found = file.read(tail), hashlib.sha256()
        if not seal.startswith(SEAL):
            return True
        file.seek(0)
        while left > 0:
            found.update(piece := file.read(min(left, 2**20)))
            left -= len(piece)
    return seal.endswith(found.digest())


def check_content(tree: xr.DataTree, path: Path) -> None:
    """Raise `InputError` where a fit lacks what its readers need."""
    if "calibration" not in tree.children or not set(SUMMARY[1:]) <= set(tree["calibration"].data_vars):
        raise InputError(f"{path} is not a fit written by probcal: its group calibration is missing or incomplete")
    if (found := tree.attrs.get("results_version")) != RESULTS_VERSION:
        age = "a newer" if isinstance(found, (int, np.integer)) and found > RESULTS_VERSION else "an older"
        raise InputError(f"{path} was written by {age} probcal; fit again")
    for group, names in NEEDED.items():
        if group not in tree.children or not set(names) <= set(tree[group].variables):
            raise InputError(f"{path} is incomplete: its group {group} lacks what a fit holds; fit again")
    for group, names in JUDGED.items():
        if group in tree.children and not set(names) <= set(tree[group].variables):
            raise InputError(f"{path} is incomplete: its group {group} lacks what a fit holds; fit again")
    tracked = {str(name) for name in tree["track"].variables}
    means = [name.removeprefix("mean") for name in tracked if name.startswith("mean")]
    if not means or any(f"{name}{s}" not in tracked for s in means for name in TRACKED):
        raise InputError(f"{path} is incomplete: its group track lacks what a fit holds; fit again")
    if missing := [name for name in ATTRIBUTES if name not in tree.attrs]:
        raise InputError(f"{path} is incomplete: it has no attribute {missing[0]}; fit again")
    calibration = tree["calibration"].to_dataset()
    if not all(np.isfinite(calibration[name].values).all() for name in ("mean", "sd", "covariance")):
        raise InputError(f"{path}: its means or sds are not finite; fit again")
