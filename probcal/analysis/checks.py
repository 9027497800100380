"""What the innovations and the replicas of a fit say, labelled: groups of a tree, and findings in words."""

from typing import Any

import numpy as np
import xarray as xr
from scipy import special

from probcal.analysis import leave, predictive
from probcal.analysis.findings import NAMES, Finding
from probcal.analysis.verdict import RATE
from probcal.inference import residuals
from probcal.inference.fitted import Judged
from probcal.inference.residuals import LAGGED, NOTABLE, PRACTICAL, codes
from probcal.labels import listed
from probcal.noise import Normal
from probcal.results.groups import by_target

OUTLYING = 4.0  # std from which a datum is an outlier
NORMAL_MEDIAN = 0.6745  # of the absolute value of a standard normal
TOGETHER = 0.3  # share of outliers whose next lies off to the same side, from which something else is wrong
SEVERAL = 2  # data of one target that are off at one time, and are then no outliers
GAIN = 5.0  # nats that a calibration must win before it is a finding
NEAR_TURN = 1.0  # rad of a full turn within which a residual tells of a missing wrap
WIDE = np.pi / 3  # noise std in rad above which a wrapped angle is ambiguous
FAR = 2 * np.pi / 3  # rad beyond which a wrapped residual may belong to the next turn
LOOKED = 4  # sensors, and targets, of a large network that are left out
SHARE = 0.01  # of a channel's data beyond which its residuals are


def _sized(names: list[str], values: np.ndarray, order: np.ndarray) -> str:
    """The first names in an order, each with its number."""
    return listed([f"{names[k]} {values[k]:.3g}" for k in order], NAMES)


def _beyond(names: list[str], part: residuals.Squares) -> list[Finding]:
    """Findings of the groups whose NIS lies beyond the limits, and notably so: one sentence for those alike."""
    found, order = [], np.argsort(-np.abs(np.log(np.maximum(part.nis, 1e-300))))
    high, low = part.nis > np.maximum(part.upper, PRACTICAL), part.nis < np.minimum(part.lower, 1 / PRACTICAL)
    for out, word, limit in ((high, "more", part.upper), (low, "less", part.lower)):
        if out.any():
            order_out = order[out[order]]
            text = f"NIS a datum {_sized(names, part.nis, order_out)} (limit {limit[order_out[0]]:.3g})"
            found.append(
                Finding("nis", names[order_out[0]], f"{text}: the data scatter {word} than the declared noise")
            )
    return found


def squares_by(fit: Judged, found: residuals.Innovations, name: str) -> tuple[xr.Dataset, list[Finding]]:
    """NIS by "sensor" or "target"."""
    group, labels = codes(fit.data, [name])
    names = labels[name].tolist()
    part = residuals.squares(found, group, len(names), RATE / len(names))
    columns = {key: (name, value) for key, value in part._asdict().items()}
    alone = name == "target" and len(names) == 1  # its sensors say the same
    return xr.Dataset(columns, {name: names}), [] if alone else _beyond(names, part)


def by_channel(
    found: residuals.Innovations,
    channels: residuals.Channels,
    replicas: predictive.Predictive | None,
) -> tuple[xr.Dataset, list[Finding]]:
    """NIS, mean, correlation in time and predictive p-values of every sensor's channels, dimension `part`.

    The p-values are left out where there are no replicas.

    `white` is the Ljung-Box p-value; below 20 data (of a yes-or-no channel: events) nothing can be told, the
    correlation stays 0 and `white` 1.
    """
    findings, names, count = list[Finding](), channels.names, len(channels.names)
    values: dict[str, Any] = residuals.squares(found, channels.group, count, RATE / count)._asdict()
    for name, mine, mean in zip(names, channels.members, channels.mean, strict=True):
        limit = -special.ndtri(RATE / (2 * count)) / np.sqrt(len(mine))
        if residuals.enough(found.kurtosis[mine]) and abs(mean) > max(limit, NOTABLE):
            text = f"{name}: innovations have mean {mean:.2f} noise std (limit {limit:.2f}): a bias is left"
            text += ", or targets keep turning"
            findings.append(Finding("mean", name, text))
    r = channels.autocorrelation
    values |= {"autocorrelation": r, "mean": channels.mean, "white": channels.white}
    notable = np.maximum(NOTABLE, LAGGED / np.sqrt(values["data"]))
    red = np.flatnonzero((channels.white < RATE / count) & (np.abs(r) > notable))
    if len(red):
        order = red[np.argsort(-np.abs(r[red]))]
        text = f"innovations are correlated from one to the next: {_sized(names, r, order)}"
        findings.append(Finding("whiteness", names[order[0]], text))
    coords = {name: ("part", channels.labels[name].to_numpy(str)) for name in channels.labels}
    first = np.array([mine[0] for mine in channels.members], int)
    if replicas is None:
        return xr.Dataset({name: ("part", value) for name, value in values.items()}, coords), findings
    for kind, of in (("misfit", replicas.misfit), ("mean", replicas.mean)):
        values[f"p_{kind}"] = of[first]
        findings += _unlike_replicas(kind, names, of[first], replicas.draws)
    return xr.Dataset({name: ("part", value) for name, value in values.items()}, coords), findings


def outlying(fit: Judged, found: residuals.Innovations) -> list[Finding]:
    """A finding on channels of Gaussian noise of which single data lie far off, by what most of their data scatter.

    Their next of the same target does not lie off to the same side: what jumps or drifts is no outlier. Nor is what
    several data of one target say at one time: it has turned.
    """
    group, labels = codes(fit.data, ["sensor", "channel"])
    kinds = {s.name: dict(s.type.expand(fit.problem.network.dimension)) for s in fit.problem.network.sensors}
    target, time = fit.data["target"].to_numpy(str), fit.data["time"].to_numpy()
    members = np.split(np.argsort(group, kind="stable"), np.cumsum(np.bincount(group))[:-1])
    off, chosen = np.zeros(len(target), bool), list[tuple[str, np.ndarray]]()
    for (sensor, channel), mine in zip(labels.itertuples(index=False), members, strict=True):
        if isinstance(kinds[sensor][channel].noise, Normal):
            order = mine[np.lexsort((time[mine], target[mine]))]
            size = np.abs(found.value[order])
            off[order] = size > OUTLYING * max(float(np.median(size)) / NORMAL_MEDIAN, 1.0)
            chosen.append((f"{sensor}.{channel}", order))
    epoch = fit.data.groupby(["target", "time"], sort=False).ngroup().to_numpy()
    off &= np.bincount(epoch, off)[epoch] < SEVERAL
    counts = {}
    for name, order in chosen:
        value, owner, out = found.value[order], target[order], off[order]
        again = out[1:] & out[:-1] & (np.sign(value[1:]) == np.sign(value[:-1])) & (owner[1:] == owner[:-1])
        count = int(out.sum())
        chance = special.bdtrc(count - 1, len(order), 2 * special.ndtr(-OUTLYING)) if count else 1.0
        if count > 1 and chance < RATE / len(labels) and again.sum() < TOGETHER * count:
            counts[name] = f"{count} of {len(order)}"
    if not counts:
        return []
    named = listed([f"{name} {count}" for name, count in counts.items()], NAMES)
    text = f"single data lie more than {OUTLYING:g} std off: {named}; declare Channel(..., noise=StudentT(4))"
    return [Finding("outliers", next(iter(counts)), text)]


def wrapping(fit: Judged, tree: xr.DataTree) -> list[Finding]:
    """Findings on angles: residuals a turn off without `wrap`, or too wide with it."""
    found, left = list[Finding](), tree["residual"].to_dataset()
    innovation, std = left["after"].values, left["std"].values
    for kind in fit.problem.network.types:
        for name, channel in kind.expand(fit.problem.network.dimension):
            ours = [s.name for s in fit.problem.network.sensors if s.type == kind]
            mine = (fit.data["channel"] == name).to_numpy() & fit.data["sensor"].isin(ours).to_numpy()
            turn = {"rad": 1.0, "deg": np.pi / 180}.get(channel.unit)
            if turn is None or not mine.any():
                continue
            residual, spread = np.abs(innovation[mine]) * turn, std[mine] * turn
            subject, off = f"{kind.name}.{name}", np.abs(residual - 2 * np.pi) < NEAR_TURN
            if channel.period is None and off.any():
                text = f"{off.sum()} of {len(off)} residuals lie a full turn off: declare wrap=True"
            elif channel.period is not None and np.median(spread) > WIDE:
                text = f"its noise std of {np.median(spread):.2f} rad is too wide for an angle: wrapping is ambiguous"
            elif channel.period is not None and (residual > FAR).mean() > SHARE:
                text = f"{(residual > FAR).sum()} of {len(off)} residuals lie beyond 120 deg: wrapping is ambiguous"
            else:
                continue
            found.append(Finding("wrapping", subject, f"{subject}: {text}"))
    return found


def _unlike_replicas(kind: str, names: list[str], p: np.ndarray, draws: int) -> list[Finding]:
    """Findings of the predictive p-values (parts,) that are small or near one, one sentence for those alike.

    They are shares of so many draws: one more draw must not change the verdict, and few draws show nothing. Of many
    parts some are extreme by chance: there must be more of them than a binomial has at the false-alarm rate.
    """
    words, found = {"misfit": ("fit worse", "fit better"), "mean": ("lie higher", "lie lower")}[kind], []
    for word, extreme in zip(words, (p + 1 / draws, 1 - p + 1 / draws), strict=True):
        out = np.flatnonzero(extreme < RATE / 2)
        if len(out) and special.bdtrc(len(out) - 1, len(p), RATE / 2) < RATE:
            named = listed([names[k] for k in out], NAMES)
            text = f"{named}: the data {word} than replicas (posterior predictive p at most {extreme[out].max():.3f})"
            found.append(Finding("predictive", names[out[0]], text))
    return found


def by_epoch(fit: Judged, found: residuals.Innovations) -> dict[str, xr.Dataset]:
    """NIS of every epoch with data, its number of data and limits (false-alarm rate 1 % of each epoch), by target."""
    parts, kept = list[residuals.Squares](), list[np.ndarray]()
    model = fit.problem.model
    pairs = zip(model.measured, model.epoch, model.recursion, strict=True)
    places, owners = zip(
        *((np.broadcast_to(np.asarray(e)[:, None], there.shape), np.full(there.shape, r)) for there, e, r in pairs),
        strict=True,
    )
    epoch, owner = fit.flat(places), fit.flat(owners)
    for r, epochs in enumerate(fit.problem.epochs):
        mine = owner == r
        there, group = np.unique(epoch[mine], return_inverse=True)
        parts.append(residuals.squares(residuals.Innovations(*(v[mine] for v in found)), group, len(there), RATE))
        kept.append(np.isin(np.arange(len(epochs.time)), there))
    names = residuals.Squares._fields
    columns = {name: (("time",), [np.asarray(getattr(part, name)) for part in parts]) for name in names}
    groups = by_target(fit.problem, columns, kept=kept)
    return {f"epoch_check/{name}": group for name, group in groups.items()}


def by_datum(fit: Judged, found: residuals.Innovations, tree: xr.DataTree) -> tuple[xr.Dataset, list[Finding]]:
    """Innovation of every datum, and PSIS-LOO of its row where the tree holds the log-likelihood."""
    data = fit.data
    values: dict[str, Any] = {"innovation": found.value}
    used, findings = float(found.used.sum()), list[Finding]()
    attrs = {"nis": float((found.value**2).sum()) / max(len(data) - used, 1e-9), "used": used}
    if "log_likelihood" in tree.children and not leave.tailed(tree):
        text = f"PSIS-LOO and power scaling are left out: they need {leave.TAILED} draws at least, take more"
        findings.append(Finding("loo", "rows", text))
    if "log_likelihood_sum" in tree.children:
        text = f"PSIS-LOO is left out: of {len(data)} data a fit keeps the log-likelihood of all, not of each"
        findings.append(Finding("loo", "rows", text))
    if leave.tailed(tree):
        group, labels = codes(data, ["row", "sensor", "target", "time"])
        row = leave.psis(tree, group, len(labels))
        values |= {"elpd": row.elpd[group], "pareto_k": row.pareto_k[group]}
        good = leave.good_k(tree)
        attrs |= {"elpd": float(row.elpd.sum()), "elpd_se": leave.standard_error(row.elpd), "good_k": good}
        bad = int((row.pareto_k > good).sum())
        if bad > RATE * len(labels):
            text = f"PSIS-LOO: Pareto k of {bad} of {len(labels)} rows is above {good:.2f}: its elpd is uncertain"
            findings.append(Finding("loo", "rows", text))
    texts = ("sensor", "channel", "target")
    coords = {name: ("datum", data[name].to_numpy(str if name in texts else None)) for name in data}
    return xr.Dataset({name: ("datum", v) for name, v in values.items()}, coords, attrs), findings


def left_out(fit: Judged, tree: xr.DataTree, groups: dict[str, xr.Dataset]) -> list[Finding]:
    """Add to the groups `sensor_check` and `target_check` what the rest says of each; returns findings.

    Of a large network those of the largest mean squares are left out; they stand in `sensor_left`
    and `target_left`, whose attribute `of` says of how many.
    """
    findings = list[Finding]()
    for name, leaves in (("sensor", leave.leave_sensors), ("target", leave.leave_targets)):
        check = groups[f"{name}_check"]
        if leave.tailed(tree) and check.sizes[name] > 1:
            group, labels = codes(fit.data, [name])
            check["pareto_k"] = (name, leave.psis(tree, group, len(labels)).pareto_k)
        if not fit.engine.cheap:
            worst = np.sort(np.argsort(-check["nis"].values, kind="stable")[:LOOKED])
            check = groups[f"{name}_left"] = check.isel({name: worst}).assign_attrs(of=check.sizes[name])
        if (found := leaves(fit, check[name].values.tolist())) is None:
            continue
        names = check[name].values.tolist()
        order = [found.names.index(n) for n in names]
        sound = all(np.isfinite(part).all() for part in (found.elpd, found.nis, found.stated, found.stated_nis))
        if not sound:  # the rest alone leaves a flat prior without an answer
            continue
        check["elpd"] = (name, found.elpd[order])
        check["rest_nis"] = (name, found.nis[order])
        check.attrs |= {"refits": "one step" if found.quick else "full", "elpd": float(found.elpd.sum())}
        if len(names) > 1:
            check.attrs["elpd_se"] = leave.standard_error(found.elpd)
        if name == "sensor":
            check["elpd_stated"] = (name, found.stated[order])
            check["difference"] = (name, (found.elpd - found.stated)[order])
            check["stated_nis"] = (name, found.stated_nis[order])
            findings += _unlike_the_rest(check)
    return findings


def _unlike_the_rest(check: xr.Dataset) -> list[Finding]:
    """Findings on sensors that do not fit the rest: as stated (the largest gain by calibration), or even calibrated."""
    names, gain = check["sensor"].values.tolist(), check["difference"].values
    order, findings = np.argsort(-gain), list[Finding]()
    worst = order[0]
    if gain[worst] > GAIN:
        text = f"{names[worst]} fits the rest {gain[worst]:.1f} nats better calibrated than as stated"
        if len(order) > 1:
            text += f"; next {names[order[1]]}, {gain[order[1]]:.1f}"
        findings.append(Finding("gain", names[worst], text))
    nis, upper = check["rest_nis"].values, check["upper"].values
    for k in np.flatnonzero(nis > np.maximum(upper, PRACTICAL)):
        text = f"{names[k]} does not fit the rest even when calibrated: NIS {nis[k]:.3g} a datum, limit {upper[k]:.3g}"
        findings.append(Finding("rest", names[k], text))
    return findings
