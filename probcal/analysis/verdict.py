"""One verdict per bias, with its reason in one short sentence with numbers.

With s = 1 - [(G + I)^-1]_mm, G the information of the data in units of the declared scale (trajectories and other
biases marginalised), how much the data narrow a bias, the first that applies:

drifting     the halves of the recording differ on it beyond the limit, after what stronger changes
explain conflicting  it lies beyond the limit of its survey (or of its scale under a prior that does
not learn) and explains a
             tenth of what the innovations have too much, or the targets disagree on it beyond the
             limit, after what stronger changes explain
prior only   s < 0.05
weak         s < 0.5 (information below 1), or one scale along a combination of biases that the data leave open would
             put it more than 1.8 sd off and it is not clearly away from zero, or it would move
             by more than one sd with the noise levels
             that the data ask for or if the biases that drift were free to, or if what a channel leaves follows the
             geometry (`analysis.slopes`), or it lies beyond the
             limit of its survey by a misfit that is mostly elsewhere, or it is another one in an
             answer that fits as well (a mirror, all biases where a target touches it), or the
             answer is far from Gaussian, or it is a clock and another lag may explain the
             innovations (their mean square is 2 or more), or the fit is no answer (not converged,
             at bound, diverged), or the chains of the bias have not mixed, or it was pruned: held at zero by
             a precision that was maximised; all are "conflicting" where the fit explains nothing
             (misfit)
relative     clearly away from zero, as the prior shares out a combination of biases that the data
             leave open: it stands apart from the others of that, all of which may be off together
by the prior its sd is less than half of what a Gaussian prior of its scale leaves, and its prior gives a
             tenth of it or more: sparsity decides
determined   none of these

Limits have a false-alarm rate of 1 % over all biases together, and the standard deviations behind them carry the
overdispersion of the innovations and their correlation in time. A sensor whose noise is larger than declared, or
whose data fit the rest badly, is a finding of its own: it widens those standard deviations and is no verdict.
"""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from scipy import special

from probcal.problem import Problem
from probcal.results.schema import INTERVAL
from probcal.status import Status

RATE = 0.01  # false alarms of each kind of check, all its comparisons together
PRIOR_ONLY, WEAK = 0.05, 0.5
# share of the chi-square of the innovations above its mean from which a bias is one of its causes,
# and of an answer from which its prior counts
PART = 0.1
# sd of a bias, in that under a Gaussian prior of its scale, below which sparsity decides
SHARP = 0.5


Doubts = Mapping[str, Mapping[int, str]]  # reason by bias, by the verdict that it is for


class Grounds(NamedTuple):
    """The quantities behind the verdicts, each (M,) in z."""

    contraction: np.ndarray  # s
    pull: np.ndarray  # sd from the prior, 0 where the prior follows the data
    limit: float  # of pull
    # share of the chi-square that the innovations have too much which the bias alone explains
    part: Any = 1.0
    # lower and upper end of the interval that a Gaussian prior of the declared scale leaves
    gaussian: Any = (0.0, 0.0)
    sharper: Any = 1.0  # sd of the fit in that of such a prior, where the own prior counts


def gaussian_interval(mean: np.ndarray, sd: np.ndarray) -> np.ndarray:
    """Lower and upper end (2, M) of the interval of a Gaussian."""
    half = special.ndtri(0.5 + 0.5 * INTERVAL) * sd
    return np.stack([mean - half, mean + half])


def narrowed(share: float) -> str:
    """The verdict in words for the share s of an answer that the data give."""
    return "prior only" if share < PRIOR_ONLY else "weak" if share < WEAK else "determined"


def pull(z: np.ndarray, alpha: np.ndarray, gamma: np.ndarray, inflation: np.ndarray) -> np.ndarray:
    """Distance (M,) of each estimate from its prior in sd, where the precision is that declared (1).

    Under the model an estimate has variance gamma / alpha; noise `inflation` times too large adds to its own share.
    """
    spread = np.sqrt(np.maximum(gamma * (gamma + inflation * (1.0 - gamma)), 1e-12))
    return np.where(alpha == 1.0, np.abs(z) / spread, 0.0)


def explained_part(z: np.ndarray, alpha: np.ndarray, gamma: np.ndarray, excess: float) -> np.ndarray:
    """Share (M,), one at most, of the excess chi-square of the innovations that each bias explains
    without its prior.

    The squared distance from the prior, at the declared noise, is the chi-square that goes with
    that prior.
    """
    return np.minimum(pull(z, alpha, gamma, np.ones(len(z))) ** 2 / max(excess, 1e-300), 1.0)


def limit_of(count: int, freedom: int = 1) -> float:
    """Chi-square beyond which one of `count` statistics may go at the false-alarm rate of all."""
    return float(special.chdtri(freedom, RATE / max(count, 1)))


def judge_biases(
    problem: Problem,
    status: Status,
    ended: Sequence[str],
    known: Grounds,
    doubts: Doubts,
    remarks: Mapping[int, str] = MappingProxyType({}),
) -> tuple[list[str], list[str]]:
    """Verdict and reason of every bias, from the evidence and the doubts of the checks, by the verdict they are for.

    `status` is that of the fit, `ended` that of each bias, `remarks` are added to the reason of a bias.
    """
    verdicts, sentences = [], []

    def charged(word: str, m: int) -> list[tuple[bool, str, str]]:
        return [(True, word, doubts[word][m])] if m in doubts.get(word, {}) else []

    numbers = (known.part, known.sharper, *known.gaussian)
    explained, sharper, lower, upper = (np.broadcast_to(own, len(problem.biases)) for own in numbers)
    for m, bias in enumerate(problem.biases):
        s, unit = known.contraction[m], bias.unit
        declared = bias.kind
        sizes = f"{declared} of {in_unit(bias.scale, unit)} to {in_unit(bias.scale * np.sqrt(1 - s), unit)}"
        information = f"information {s / max(1 - s, 1e-12):.2g}"
        beyond = (
            f"{known.pull[m]:.1f} sd beyond its {declared} of {in_unit(bias.scale, unit)} (limit {known.limit:.1f})"
        )
        far, part = known.pull[m] > known.limit, explained[m]
        sharp = sharper[m] < SHARP
        left = f"{lower[m] * bias.scale:.2g} to {in_unit(upper[m] * bias.scale, unit)}"
        elsewhere = f"{beyond}, by a misfit elsewhere: it explains {part:.1g} of the excess of the innovations"
        cases = (  # the first that holds counts
            (not status.explains, "conflicting", "the fit ended misfit: model and data contradict each other"),
            *charged("drifting", m),
            (far and part >= PART, "conflicting", beyond),
            *charged("conflicting", m),
            (s < PRIOR_ONLY, "prior only", f"the data hardly narrow its {declared} ({information})"),
            (s < WEAK and not sharp, "weak", f"the data narrow its {sizes} only ({information})"),
            (far, "weak", elsewhere),
            *charged("weak", m),
            (not status.settled, "weak", f"the fit ended {status}: its interval is not valid"),
            (ended[m] == "not mixed", "weak", "its chains have not mixed: its interval is not valid"),
            (ended[m] == "pruned", "weak", "pruned: its precision was maximised, so its interval is not valid"),
            *(charged("relative", m) if s >= WEAK else []),
            (sharp, "by the prior", f"sparsity decides; a Gaussian prior of its {declared} leaves {left}"),
            (True, "determined", f"the data narrow its {sizes}"),
        )
        verdict, reason = next((verdict, reason) for holds, verdict, reason in cases if holds)
        verdicts.append(verdict)
        sentences.append(reason + remarks.get(m, ""))
    return verdicts, sentences


def in_unit(value: float, unit: str) -> str:
    """A value with its unit, if it has one."""
    return f"{value:.2g} {unit if unit != '1' else ''}".strip()
