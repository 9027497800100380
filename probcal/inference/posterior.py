"""The summary of a sampler's draws: estimates, intervals, gamma, inclusion, mixing of the chains,
in words."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import numpy as np

from probcal.gaussian.draws import draws_a_chain, predictive
from probcal.gaussian.information import at_levels
from probcal.gaussian.mode import Point
from probcal.inference.chains import Draw
from probcal.inference.ending import FAR, bias_status, misfit_sentence
from probcal.inference.hierarchy import drawn_precisions, inclusions
from probcal.inference.mixed import (
    ESS,
    UNSURE,
    mixing,
    quantities,
    r_hat_limit,
    side_of_draws,
    weights_of_sides,
    within_sides,
)
from probcal.inference.pose import Worth, pareto_khat
from probcal.inference.posed import Form, Natural, Posed
from probcal.inference.sampler import Sampler
from probcal.model.motions import level_values
from probcal.modes.explore import Mirrored
from probcal.modes.grid import track_mode
from probcal.priors import Flat, Prior
from probcal.problem import Problem
from probcal.results.answer import Answer, Draws, Posterior, Summary, Tracks
from probcal.results.blocks import SensorBlocks
from probcal.results.schema import INTERVAL, ROPE
from probcal.status import CHAINS, judge

RARE = 0.05  # share of leaps, or of swings, taken below which it is said
# Pareto k-hat from which importance weights, and so a guide, are unreliable (Vehtari et al. 2024)
K_HAT = 0.7
BFMI = 0.3  # below which the energy is not explored (Betancourt 2016)


@dataclass(frozen=True, eq=False)
class SamplerRun:
    """The draws of a sampler, and how the run went."""

    method: Sampler
    asked: Sampler  # the method that was asked for, where another took over
    form: Form
    posed: Posed | Natural
    worth: Worth | None  # of the frame, where there is one
    draws: Draw  # leading dims (chain, draw) of every array
    seconds: float
    stopped: str  # why it was ended before all draws were made; empty where they were
    note: str  # what happened on the way, a sentence or nothing
    sides: tuple[Mirrored, ...] = ()  # other sides of a mirror that the chains visit, numbered from 1
    thin: int = 1  # steps from one draw to the next

    @property
    def z(self) -> np.ndarray:
        """Biases (chain, draw, M) over their scales."""
        return np.asarray(self.draws.theta)[..., : self.form.biases]

    @property
    def side(self) -> np.ndarray:
        """The index of the mode of each draw (chain, draw), 0 where there is no reflection."""
        return side_of_draws(self.draws)

    @property
    def levels(self) -> np.ndarray:
        """Log levels (chain, draw, H)."""
        return np.asarray(self.draws.theta)[..., self.form.biases :]

    @property
    def states(self) -> list[np.ndarray]:
        """States (chain, draw, E, n) of each recursion."""
        return [np.asarray(x) for x in self.draws.states]


def chains(
    problem: Problem, prior: Prior, run: SamplerRun, mixed: Mapping[str, np.ndarray],
    covariance: SensorBlocks | None = None, gamma: np.ndarray | None = None, point: Point | None = None, **known: Any,
) -> Posterior:  # fmt: skip
    """The posterior of a run, whose quantities mixed as they did.

    Covariance and gamma (M,) are those of the draws where they are not given, the point is that at their means.
    `known` are further fields.
    """
    z, M, information = run.z, run.form.biases, None
    columns = {name: values[:M] for name, values in mixed.items()} | {"contraction": 1.0 - z.var((0, 1))}
    columns |= inclusions(run.form.hierarchy, z, run.draws.phi)
    if covariance is None:
        covariance = SensorBlocks.drawn(z.reshape(-1, M), np.arange(M)[None], np.asarray(run.draws.variance)[0, 0])
        gamma, information = np.asarray(run.draws.gamma).mean((0, 1)), run.posed.information[:M, :M]
    hyper, first = {name: np.asarray(a) for name, a in run.draws.phi.items()}, run.posed.first.alpha
    if (declared := known.get("declared")) is not None:  # of some hyper-parameters no draws are kept
        columns |= declared.contraction()
        known["precisions"] = lambda: None
    half = 50 * (1 - INTERVAL)
    summary = Summary.of(
        "exact" if run.method.exact else "variational", "sampled", z.mean((0, 1)), covariance, first, gamma=gamma,
        interval=np.percentile(z, [half, 100 - half], axis=(0, 1)),
        governed=np.isin(np.arange(M), run.form.hierarchy.learnt), information=information,
        levels=run.levels.mean((0, 1)), columns=columns,
    )  # fmt: skip
    mine = z[run.side == heaviest(run)]
    fields: dict[str, Any] = {
        "hyper": hyper, "hierarchy": run.form.hierarchy, "variables": _variables(problem, run), "run": run,
        "precisions": partial(drawn_precisions, prior, run.form.hierarchy, hyper, first),
        "stats": {"lp": np.asarray(run.draws.density)} | _stats(run), "attrs": _numbers(run),
        "moments": [Tracks(x.mean((0, 1)), x.std((0, 1))) for x in run.states],
        "side": (mine.mean(0), mine.std(0) if len(mine) > 1 else summary.sd), "chained": True, "held": False,
    } | known  # fmt: skip
    return Posterior(problem, prior, mean_point(problem, run) if point is None else point, summary, draw_run, **fields)


def draw_run(own: Posterior, key: jax.Array, keep: tuple[str, ...]) -> Draws:
    """The draws that were made; of data that are many, values by datum at some of them."""
    keep = keep if own.run.states else ()
    kept, likelihood, replicas = values_by_datum(own.problem, own.run, key, keep)
    states = own.run.states if "states" in keep else []
    return Draws(own.run.z, own.run.levels, states, kept, likelihood, replicas)


def _numbers(run: SamplerRun) -> dict[str, float]:
    """Seconds, the worth of the frame, and the limits used."""
    found = {"seconds": run.seconds, "rope": ROPE, "thin": run.thin}
    if run.worth is not None:
        found |= {"frame_khat": run.worth.khat, "frame_moves": run.worth.moves}
        found |= {"frame_acceptance": run.worth.acceptance}
    if not run.method.exact:
        found["khat"] = pareto_khat(_stats(run)["log_weight"].ravel())
    return {name: float(value) for name, value in found.items()}


def conclude_draws(
    problem: Problem, prior: Prior, run: SamplerRun, posterior_of: Callable[..., Posterior] = chains,
    misfit: Callable[[Problem, Point], str] = misfit_sentence, **facts: Any,
) -> Answer:  # fmt: skip
    """The answer of a sampler's run; `misfit` says why its mean explains nothing, `facts` are further ones."""
    labels = [*problem.labels, *(level.label for level in problem.levels)]
    names, values = quantities(run.draws, labels, hyper=run.method.effective > 0)
    mixed = mixing(within_sides(values, run.side))
    posterior = posterior_of(problem, prior, run, mixed)
    unexplained = misfit(problem, posterior.point)
    known = facts_of(names, run, mixed) | ({} if unexplained else facts_of_steps(problem, prior, run))
    status, message = judge(CHAINS, known | facts | {"misfit": unexplained})
    ended = bias_status(problem, {"not mixed": mixed["r_hat"][: run.form.biases] > 1.05} if "r_hat" in mixed else {})
    # the other sides that draws are on, seen from the heaviest: log ratio of weights, and shift
    # of the means
    first, share = heaviest(run), np.bincount(run.side.ravel(), minlength=len(run.sides) + 1) / run.side.size
    middle = run.z[run.side == first].mean(0)
    found = []
    for k in np.flatnonzero(share):
        if k != first:
            other = run.sides[int(k or first) - 1]  # of the first side, what was reflected to leave it
            shift = run.z[run.side == k].mean(0) - middle
            point = other.point if k else _framed(run)
            gain = float(np.log(share[k] / share[first]))
            found.append(Mirrored(other.name, gain, point, shift, status=str(status)))
    return Answer(
        problem, run.method, run.asked, prior, posterior, status, message, ended, run.z.shape[1],
        interrupted=bool(run.stopped), mirrors=tuple(found),
    )  # fmt: skip


def heaviest(run: SamplerRun) -> int:
    """The side of a mirror that most draws are on."""
    return int(np.bincount(run.side.ravel()).argmax())


def _framed(run: SamplerRun) -> Point:
    """The point of the Gaussian reference of a run."""
    assert isinstance(run.posed, Posed)
    return run.posed.frame.point


def mean_point(problem: Problem, run: SamplerRun) -> Point:
    """Posterior means of biases and levels on the heaviest side, trajectories at their mode there."""
    side = heaviest(run)
    start = _framed(run) if side == 0 else run.sides[side - 1].point
    mine = run.side == side
    start = at_levels(problem.model, start, jax.device_put(run.levels[mine].mean(0)))
    return track_mode(problem, start._replace(z=jax.device_put(run.z[mine].mean(0))))


def values_by_datum(
    problem: Problem, run: SamplerRun, key: jax.Array, keep: tuple[str, ...]
) -> tuple[np.ndarray, list[np.ndarray], list[np.ndarray]]:
    """The draws (kept,) of each chain with values by datum; log-likelihood and replicas (chain,
    kept, N, C) there."""
    chains, draws = run.z.shape[:2]
    most = draws_a_chain(problem.model.size, chains)
    kept = np.unique(np.linspace(0, draws - 1, min(draws, most)).round().astype(int))
    if not {"log_likelihood", "replicas"} & set(keep):
        return kept, [], []

    def flat(a: np.ndarray) -> jax.Array:
        return jax.device_put(a[:, kept].reshape(chains * len(kept), *a.shape[2:]))

    found = predictive(
        problem.model, flat(run.levels), flat(run.z), tuple(flat(s) for s in run.states), key, keep
    )  # fmt: skip
    likelihood, replicas = (
        [np.asarray(a).reshape(chains, len(kept), *a.shape[1:]) for a in part] for part in found
    )  # fmt: skip
    return kept, likelihood, replicas


def _variables(problem: Problem, run: SamplerRun) -> dict[str, Any]:
    """Further posterior variables, name -> (dims beyond chain and draw, values, coords)."""
    found: dict[str, Any] = {
        "gamma": (("bias_label",), np.asarray(run.draws.gamma)),
        "contraction": (("bias_label",), 1.0 - np.asarray(run.draws.variance)),
    }
    found = found if np.size(run.draws.gamma) else {}
    found |= run.form.hierarchy.variables(problem.labels, run.draws.phi)
    if problem.levels:
        names = [level.label for level in problem.levels]
        found["level"] = (("level_label",), level_values(problem.levels, run.levels), {"level_label": names})
    return found


def _stats(run: SamplerRun) -> dict[str, np.ndarray]:
    return {name: np.asarray(value) for name, value in run.draws.stats.items()}


def facts_of(names: Sequence[str], run: SamplerRun, mixed: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Facts of the draws of named quantities, in the names of `probcal.status.CHAINS`."""
    count, draws, wanted = *run.z.shape[:2], run.method.effective
    facts = {"note": run.note} | mixed_of(names, mixed, count, r_hat_limit(mixed["ess"], count), wanted)
    if run.stopped:
        made = f"{draws} draws a chain" if wanted else f"{draws} of {run.method.draws} draws a chain"
        facts["stopped"] = f"{run.stopped} after {made}" + (f", {run.thin} steps each" if run.thin > 1 else "")
    share, error = weights_of_sides(run.side, len(run.sides) + 1)
    if np.count_nonzero(share) > 1:
        listed = ", ".join(f"{share[k]:.2f} ± {error[k]:.2f}" for k in np.flatnonzero(share))
        facts["sides"] = np.count_nonzero(share), listed
        facts["unsure"] = error.max() > UNSURE
    return facts


def mixed_of(
    names: Sequence[str], mixed: Mapping[str, np.ndarray], chains: int, limit: Any, wanted: int = 0
) -> dict[str, Any]:
    """Quantities whose chains have not mixed, or have fewer effective draws than `wanted`, worst
    first; `limit` is of each r_hat."""
    facts, few = dict[str, Any](), int(mixed["ess"].argmin())
    if "r_hat" in mixed:
        above = mixed["r_hat"] - limit
        worst = int(above.argmax())
        facts["r_hat"] = above[worst] > 0 and (names[worst], mixed["r_hat"][worst])
    facts["few"] = mixed["ess"][few] < (wanted or ESS * chains) and (names[few], mixed["ess"][few])
    return facts


def facts_of_steps(problem: Problem, prior: Prior, run: SamplerRun) -> dict[str, Any]:
    """Facts of the steps of a sampler or of a guide; a misfit says none of them."""
    found, facts = _stats(run), dict[str, Any]()
    if not run.method.exact:
        khat = pareto_khat(found["log_weight"].ravel())
        facts["fitting" if khat < K_HAT else "unfitting"] = khat, K_HAT
    away = np.abs(run.z.mean((0, 1))[~problem.surveyed])
    facts["far"] = isinstance(prior, Flat) and (away > FAR).any()
    if "diverging" in found and found["diverging"].any():
        facts["divergences"] = int(found["diverging"].sum())
        facts["or"] = ", or take collapsed" if run.asked is run.method else ""
    if "tree_depth" in found:
        share = float((found["tree_depth"] >= getattr(run.method, "depth", np.inf)).mean())
        facts["depth"] = share > 0.05 and share
    if "energy" in found and np.ptp(found["energy"], axis=1).min() > 0:
        bfmi = (np.diff(found["energy"], axis=1) ** 2).mean(1) / found["energy"].var(1)
        facts["bfmi"] = bfmi.min() < BFMI and (bfmi.min(), BFMI)
    rate = found["acceptance_rate"].mean(1) if "acceptance_rate" in found else np.ones(1)
    if "swung" in found:
        taken = found["swung"].mean(1).min()
        facts["accepted"] = rate.mean() < RARE and (rate.mean(),)
        facts["hmc"] = taken < RARE and (taken,)
    if run.method.refusal and rate.min() < RARE:
        facts["turns"] = rate.min(), run.method.refusal
    return facts
