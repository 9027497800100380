"""`compare`: fits side by side. Estimates and distances, scores, prediction, evidence, cost, and findings."""

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np
import xarray as xr

from probcal.analysis import loo
from probcal.analysis.choices import check_count, check_names, split_pair
from probcal.analysis.differences import findings
from probcal.analysis.findings import Finding, finding_group
from probcal.analysis.overlap import Marginal, of_draws, of_gaussian, overlap, wasserstein
from probcal.errors import InputError, check_known, checked
from probcal.labels import label_parts
from probcal.results.groups import along
from probcal.results.read import known_truth, listed_in
from probcal.results.schema import EVIDENCES
from probcal.results.scores import judged_by, rms
from probcal.status import INVALID

Fits = Mapping[str, xr.DataTree] | Sequence[xr.DataTree]
COLUMNS = ("mean", "sd", "lower", "upper", "gamma", "status")  # of every fit
FURTHER = ("inclusion", "r_hat", "ess", "ess_tail")  # of some
DRAWN = ("gamma", "contraction")  # of which samplers have draws
NOTHING = 1e-3  # scales
TOTALS = (*EVIDENCES, "log_evidence_se", "seconds")
TEXTS = ("method", "requested", "prior", "status", "message", "settings", "intervals", "approximate", "precisions")


def compare(fits: Fits, names: Sequence[str] | None = None) -> xr.DataTree:
    """Put fits of the same data side by side, whatever their methods, priors and sensor models.

    `fits` are results of `fit` (or loaded ones), by name or in a sequence with `names`, which default to method and
    prior. What is compared are the biases that all have. Returns a tree:

    - `estimate` (estimator, bias_label): mean, sd, lower, upper, gamma, status; coordinates unit and scale;
    - `pair` (pair, bias_label): `overlap` of the two posteriors (1: equal) and `wasserstein`, their distance in
      declared scales (see `analysis.overlap`); coordinates first and second;
    - `method/NAME`: what this fit has and others may lack, by bias (inclusion, r_hat, ess, interval of gamma) and as
      attributes: status, settings, `posterior` (Gaussian or draws: what the distances rest on), `elpd` by PSIS-LOO with
      its error and its difference to the best, log evidence, seconds, smallest ess; where the truth is known
      `bias_rmse` (in scales) and how many intervals hold it;
    - `truth` where one of the fits knows it, and `finding`: kind, subject and a sentence each.

    The attribute `reference` names the fit whose posterior the others are judged by: the first whose draws are exact,
    else the first that has draws of its own, else the first. Raises `InputError` for fits of different data, scales or
    units, and where no bias is common.

    >>> compare({"all": tree, "again": tree}).attrs["reference"]
    'all'
    """
    known = fits_by_name(fits, names)
    labels = common_labels(known)
    order = loo.same_data(known)
    tables = [tree["calibration"].to_dataset().sel(bias_label=labels) for tree in known.values()]
    columns = {name: (("estimator", "bias_label"), np.stack([g[name].values for g in tables])) for name in COLUMNS}
    coords = {name: ("bias_label", tables[0][name].values) for name in ("unit", "scale")}
    groups = {
        "estimate": xr.Dataset(columns, {"estimator": list(known), "bias_label": labels, **coords}),
        "pair": _pairs(known, labels),
    }
    truth = _truth(known, labels)
    if len(truth):
        groups["truth"] = xr.Dataset({"bias": ("bias_label", list(truth.values()))}, {"bias_label": list(truth)})
    methods = {name: _method(tree, labels) for name, tree in known.items()}
    for name, tree in known.items():
        methods[name].attrs |= _scores(tree, truth) | _cost(methods[name])
    for name, found in loo.elpd(known, order).items():
        methods[name].attrs |= found
    groups |= {f"method/{name}": dataset for name, dataset in methods.items()}
    sampled = [n for n, t in known.items() if not plugged_in(t) and t.attrs["status"] not in INVALID]
    exact = [n for n in sampled if known[n].attrs["approximate"] == "exact"]
    reference = next(iter([*exact, *sampled, *known]))
    tree = xr.DataTree.from_dict(groups)
    tree.attrs |= {
        "reference": reference,
        "interval_probability": float(next(iter(known.values())).attrs["interval_probability"]),
    }
    said = [*_left_out(known, labels), *findings(tree)]
    tree["finding"] = xr.DataTree(finding_group(said))
    return tree


def fits_by_name(fits: Fits, names: Sequence[str] | None = None) -> dict[str, xr.DataTree]:
    """Fits by name; a fit without one is called by its method and prior, "EA (ARD)", numbered where that is taken."""
    if isinstance(fits, xr.DataTree):
        raise InputError("compare: fits is a single tree; give several in a list, compare([first, second])")
    if isinstance(fits, Mapping):
        if names is not None:
            raise InputError("compare: the fits have names already; give names to a sequence of fits only")
        names, fits = [str(name) for name in fits], list(fits.values())
    check_count(len(fits))
    for k, tree in enumerate(fits):
        if not isinstance(tree, xr.DataTree) or not {"calibration", "posterior", "observed_data"} <= set(tree.children):
            raise InputError(
                f"compare: number {k + 1} of the fits is no result of fit(); give trees of fit() or load()"
            )
    if names is None:
        names = list[str]()
        for tree in fits:
            plain = f"{tree.attrs['method']} ({tree.attrs['prior']})"
            taken = sum(name == plain or name.startswith(f"{plain} ") for name in names)
            names.append(f"{plain} {taken + 1}" if taken else plain)
    check_names(names, len(fits))
    return dict(zip(names, fits, strict=True))


def plugged_in(tree: xr.DataTree) -> bool:
    """True if the posterior of the biases is one Gaussian, precisions and levels taken as known."""
    return bool(tree.attrs["approximate"] == "Laplace")


@checked
def interchangeable(
    tree: xr.DataTree, *, count: int = 3, among: Sequence[str] | None = None
) -> list[tuple[str, str, float]]:
    """The pairs of biases that a fit cannot tell apart, with their posterior correlation, those that trade most first.

    What a pair trades is its negative correlation, where the data know the sum and not the parts, times the smaller
    sd in declared scales; within one node or sensor the size of the correlation counts, for there the data may know a
    difference. A pair that trades next to nothing is left out; `among` are the labels to choose from.

    >>> min(correlation for first, second, correlation in interchangeable(tree, count=4)) < -0.5
    True
    """
    draws = tree["posterior"].to_dataset()["bias"].transpose("chain", "draw", "bias_label")
    draws = draws if among is None else draws.sel(bias_label=list(among))
    labels = draws["bias_label"].values.astype(str)
    scale = tree["calibration"].to_dataset()["scale"].sel(bias_label=labels).values
    z = (draws.values / scale).reshape(-1, len(labels))
    sd, owner = z.std(0), np.array([label_parts(label)[0] for label in labels])
    unit = (z - z.mean(0)) / np.where(sd > 0, sd, 1.0)
    first, second = np.triu_indices(len(labels), 1)
    value = (unit.T @ unit / len(z))[first, second]
    traded = np.where(owner[first] == owner[second], np.abs(value), -value) * np.minimum(sd[first], sd[second])
    best = [k for k in np.argsort(-traded, kind="stable")[:count] if traded[k] > NOTHING]
    return [(str(labels[first[k]]), str(labels[second[k]]), float(value[k])) for k in best]


def chosen_pair(fits: Mapping[str, xr.DataTree], labels: Sequence[str]) -> tuple[str, str]:
    """A pair of labels that all fits have; raises `InputError` for any other."""
    common = common_labels(fits)
    pair = split_pair(labels)
    for label in pair:
        check_known(label, common, f'the pair names "{label}", which is no bias of all the fits')
    return pair


def common_labels(fits: Mapping[str, xr.DataTree], verb: str = "compare") -> list[str]:
    """Labels that all fits have, in the order of the first, checked to mean the same; errors begin with the verb."""
    groups = {name: tree["calibration"].to_dataset() for name, tree in fits.items()}
    (first, group), *others = groups.items()
    labels = [str(label) for label in group["bias_label"].values]
    labels = [label for label in labels if all(label in other["bias_label"] for _, other in others)]
    if not labels:
        raise InputError(f'{verb}: "{first}" and the others have no bias in common; compare fits of one network')
    group, level = group.sel(bias_label=labels), fits[first].attrs["interval_probability"]
    for name, other in others:
        other = other.sel(bias_label=labels)
        same = (group["unit"] == other["unit"]) & np.isclose(group["scale"], other["scale"])
        for label in np.array(labels)[~same.values][:1]:
            sizes = [f"{float(g['scale'].sel(bias_label=label)):g} {g['unit'].sel(bias_label=label).item()}"
                     for g in (group, other)]  # fmt: skip
            raise InputError(
                f'{verb}: the scale of {label} is {sizes[0]} in "{first}" and {sizes[1]} in "{name}"; declare one'
            )
        if fits[name].attrs["interval_probability"] != level:
            raise InputError(f'{verb}: the intervals of "{first}" and "{name}" have different probabilities')
    return labels


def _marginals(tree: xr.DataTree, labels: list[str]) -> list[Marginal]:
    """Posterior of each bias in scales."""
    group = tree["calibration"].to_dataset().sel(bias_label=labels)
    scale = group["scale"].values
    if plugged_in(tree):
        columns = group["mean"].values / scale, group["sd"].values / scale, group["status"].values == "pruned"
        return [of_gaussian(float(m), float(s), bool(p)) for m, s, p in zip(*columns, strict=True)]
    draws = tree["posterior"]["bias"].sel(bias_label=labels).transpose("bias_label", "chain", "draw").values
    return [of_draws(values / size) for values, size in zip(draws, scale, strict=True)]


def _pairs(fits: Mapping[str, xr.DataTree], labels: list[str]) -> xr.Dataset:
    marginals = {name: _marginals(tree, labels) for name, tree in fits.items()}
    pairs = list(combinations(fits, 2))
    columns = {
        measure.__name__: (
            ("pair", "bias_label"),
            [[measure(*own) for own in zip(marginals[a], marginals[b], strict=True)] for a, b in pairs],
        )
        for measure in (overlap, wasserstein)
    }
    first, second = zip(*pairs, strict=True)
    ends = {"first": ("pair", list(first)), "second": ("pair", list(second))}
    return xr.Dataset(columns, {**ends, "bias_label": labels})


def _method(tree: xr.DataTree, labels: list[str]) -> xr.Dataset:
    """The columns per bias that one fit has beyond those common to all fits, and its attributes."""
    group = tree["calibration"].to_dataset().sel(bias_label=labels)
    posterior, level = tree["posterior"].to_dataset(), float(tree.attrs["interval_probability"])
    columns = {name: group[name].values for name in FURTHER if name in group and np.isfinite(group[name]).all()}
    for name in DRAWN:
        if name in posterior and {"chain", "draw", "bias_label"} == set(posterior[name].dims):
            draws = posterior[name].sel(bias_label=labels)
            ends = draws.quantile([0.5 - level / 2, 0.5 + level / 2], ("chain", "draw")).values
            columns |= {f"{name}_lower": ends[0], f"{name}_upper": ends[1]}
            if name not in COLUMNS:
                columns[name] = draws.mean(("chain", "draw")).values
    attrs: dict[str, Any] = {name: str(tree.attrs[name]) for name in TEXTS if name in tree.attrs}
    attrs["posterior"] = "Gaussian" if plugged_in(tree) else "draws"  # what its distances to the others are taken from
    attrs |= {n: float(tree.attrs[n]) for n in TOTALS if n in tree.attrs and np.isfinite(tree.attrs[n])}
    if "sample_stats" in tree.children and "diverging" in tree["sample_stats"].data_vars:
        attrs["divergences"] = int(tree["sample_stats"]["diverging"].sum())
    return xr.Dataset(along("bias_label", columns), {"bias_label": labels}, attrs)


def _cost(method: xr.Dataset) -> dict[str, float]:
    """Largest r_hat, smallest ess, and ess a second where the time is known."""
    found = {"largest_r_hat": float(method["r_hat"].max())} if "r_hat" in method else {}
    if "ess" in method:
        found["smallest_ess"] = float(method["ess"].min())
        if method.attrs.get("seconds", 0.0) > 0:
            found["ess_per_second"] = found["smallest_ess"] / method.attrs["seconds"]
    return found


def _truth(fits: Mapping[str, xr.DataTree], labels: list[str]) -> dict[str, float]:
    """True biases that any of the fits knows."""
    found: dict[str, float] = {}
    for name, tree in fits.items():
        for label, value in known_truth(tree).items():
            if found.setdefault(str(label), value) != value:
                raise InputError(
                    f'compare: the true {label} of "{name}" is not that of the fits before it; score them alike'
                )
    return {label: found[label] for label in labels if label in found}


def _scores(tree: xr.DataTree, truth: Mapping[str, float]) -> dict[str, Any]:
    """Error in scales, and how many intervals hold the truth: of all known biases and of those that are not zero."""
    if not truth:
        return {}
    known = judged_by(tree, truth)
    found = {"bias_rmse": rms(known["error"])}
    for suffix, own in (("", known["inside"]), ("_nonzero", known["inside"][known["true"] != 0])):
        if len(own):
            count = {f"covered{suffix}": int(own.sum()), f"known{suffix}": len(own)}
            found |= count | {f"coverage{suffix}": float(own.mean())}
    return found


def _left_out(fits: Mapping[str, xr.DataTree], labels: list[str]) -> list[Finding]:
    """Findings on the biases that not all fits have."""
    texts = list[str]()
    for name, tree in fits.items():
        own = [label for label in listed_in(tree, "calibration", "bias_label") if label not in labels]
        if own:
            texts.append(f"{len(own)} of {name} ({own[0]}{', ...' if len(own) > 1 else ''})")
    said = f"biases that not all fits have are not compared: {', '.join(texts)}"
    return [Finding("labels", "", said)] if texts else []
