"""Innovations and replicas of every channel of every sensor."""

import numpy as np
import xarray as xr
from scipy import special

from probcal.analysis.check import Case, Checked, check
from probcal.analysis.findings import NAMES, Finding, sized
from probcal.analysis.verdict import RATE
from probcal.inference import residuals
from probcal.inference.residuals import LAGGED, NOTABLE
from probcal.labels import listed
from probcal.results.groups import along


@check()
def check_channels(case: Case) -> Checked:
    """NIS, mean, correlation in time and predictive p-values of every sensor's channels, dimension `part`.

    The p-values are left out where there are no replicas.

    `white` is the Ljung-Box p-value; below 20 data (of a yes-or-no channel: events) nothing can be told, the
    correlation stays 0 and `white` 1.
    """
    found, channels, replicas = case.innovations, case.channels, case.replicas
    findings, names, count = list[Finding](), channels.names, len(channels.names)
    values = residuals.squares(found, channels.group, count, RATE / count)._asdict()
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
        text = f"innovations are correlated from one to the next: {sized(names, r, order)}: something changes"
        text += " slowly that the model takes as constant, or the noise has a memory"
        findings.append(Finding("whiteness", names[order[0]], text))
    first = np.array([mine[0] for mine in channels.members], int)
    if replicas is not None:
        for kind, of in (("misfit", replicas.misfit), ("mean", replicas.mean)):
            values[f"p_{kind}"] = of[first]
            findings += _unlike_replicas(kind, names, of[first], replicas.draws)
    coords = {name: ("part", channels.labels[name].to_numpy(str)) for name in channels.labels}
    return Checked({"channel_check": xr.Dataset(along("part", values), coords)}, findings)


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
