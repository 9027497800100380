"""Do the tests see a wrong line? One mutation at a time in a copy of the working tree, and the tests named for it.

`uv run python tests/mutations.py` prints killed or SURVIVED and the seconds of each; `--all` runs the whole default run
where the named tests pass, `--only 3 7` or `--only frame.py` picks some, `--list` runs nothing. The exit code is the
number of survivors. To add one, write a line in MUTATIONS; the old text must stand in its file once.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
LIMIT = 1800  # seconds of one run of tests; one that never ends has seen the mutation


class Mutation(NamedTuple):
    file: str  # in probcal/
    old: str
    new: str
    tests: str  # in tests/, those that should see it


MUTATIONS = [
    # smoothing/recursion.py
    Mutation("smoothing/scans.py", "moved @ (below.mT @ first.A)", "0 * moved @ (below.mT @ first.A)", "test_scans.py"),
    Mutation("smoothing/scans.py", "[first.A.mT @ rest, first.Z]", "[rest, first.Z]", "test_scans.py"),
    Mutation("smoothing/recursion.py", "alone - gain.data.mT @ states", "alone + gain.data.mT @ states", "test_exact.py"),
    Mutation("smoothing/recursion.py", "own = square((eye - back @ _next(F)) @ gain.updated,", "own = square(gain.updated,", "test_exact.py"),
    Mutation("smoothing/recursion.py", "Smoothed(found.states + moved", "Smoothed(found.states - moved", "test_exact.py"),
    Mutation("smoothing/recursion.py", "logdet = 2.0 * jnp.sum(jnp.log(std))", "logdet = jnp.sum(jnp.log(std))", "test_exact.py"),
    Mutation("smoothing/recursion.py", "source = source.at[:, :, : c.shape[2]].add(gain.keep @ c)", "source = source.at[:, :, : c.shape[2]].add(c)", "test_exact.py"),
    Mutation("smoothing/recursion.py", "noises + gain.drive @ states @ gain.drive.mT", "noises", "test_formulas.py"),
    Mutation("smoothing/recursion.py", "gain.gain @ innovation + force", "gain.gain @ innovation", "test_diffuse.py"),
    Mutation("smoothing/recursion.py", "return states @ earlier + back", "return states @ b + back", "test_diffuse.py"),
    # results/alignment.py, plausible.py, rss/localise.py, analysis/changes.py, pieces.py
    Mutation("results/alignment.py", "self.shift) @ self.rotation / self.scale", "self.shift) @ self.rotation", "test_alignment.py"),
    Mutation("plausible.py", "GAP = 3.2e9", "GAP = 4e9", "test_plausible.py"),
    Mutation("plausible.py", "TURNS = 20.0", "TURNS = 25.0", "test_plausible.py"),
    Mutation("plausible.py", "APART = 20.0", "APART = 25.0", "test_plausible.py"),
    Mutation("plausible.py", "FAR = 1e6", "FAR = 1e7", "test_plausible.py"),
    Mutation("plausible.py", "FEW = 8", "FEW = 9", "test_plausible.py"),
    Mutation("plausible.py", "FAINT, RANGE = 0.1, 30.0", "FAINT, RANGE = 1.0, 30.0", "test_plausible.py"),
    Mutation("plausible.py", "FAINT, RANGE = 0.1, 30.0", "FAINT, RANGE = 0.1, 50.0", "test_plausible.py"),
    Mutation("plausible.py", "NARROW, WIDE = 1e-9, 1e6", "NARROW, WIDE = 1e-10, 1e6", "test_plausible.py"),
    Mutation("plausible.py", "NARROW, WIDE = 1e-9, 1e6", "NARROW, WIDE = 1e-9, 1e7", "test_plausible.py"),
    Mutation("rss/localise.py", "own = w * dc**2 / about[:, None] if exponent is None else 0.0", "own = 0.0", "test_rss.py"),
    Mutation("rss/localise.py", "np.minimum(slope, 0.0)", "slope", "test_rss.py"),
    Mutation("analysis/changes.py", "np.sqrt(inflation[m] / contrast.information[0, 0])", "np.sqrt(1.0 / contrast.information[0, 0])", "test_changes.py"),
    Mutation("analysis/pieces.py", "change.contrast.plausible / inflation", "change.contrast.square / inflation", "test_changes.py"),
    # analysis/shape.py
    Mutation("analysis/shape.py", "if not fall > MOST:", "if fall > MOST:", "test_guards.py"),
    # inference/hierarchy.py, orbits.py: scales of their own that move along
    Mutation("inference/hierarchy.py", "jnp.sum(own + way - forth", "jnp.sum(own - forth", "test_orbits.py"),
    Mutation("inference/hierarchy.py", "jnp.exp(logs)) + logs - prior", "jnp.exp(logs)) - prior", "test_orbits.py"),
    Mutation("inference/orbits.py", "orbit.volume * r + ratio", "orbit.volume * r", "test_orbits.py"),
    # noise.py: what a density implies
    Mutation("noise.py", "return -e * self._slope(e)", "return e * self._slope(e)", "test_methods.py"),
    Mutation("noise.py", "slope**2 * density * np.cosh(t)", "slope**2 * density", "test_methods.py"),
    Mutation("noise.py", "return -self._slope(self.innovation(y, predicted, period) / std) / std", "return -self._slope(self.innovation(y, predicted, period) / std)", "test_methods.py"),
    # model/model.py
    Mutation("model/model.py", "jnp.where(tail.on, tail.family.mixing_information(tail.size), 1.0)", "jnp.ones_like(tail.weight)", "test_tails.py"),
    # results/groups.py
    Mutation("results/groups.py", "mine = np.flatnonzero(owners == name)", "mine = np.flatnonzero(owners == owners[0])", "test_exact.py"),
    # linalg.py
    Mutation("linalg.py", "(seen / (1.0 + std))", "(seen / std)", "test_exact.py"),
    Mutation("linalg.py", "least = LOST * jnp", "least = 1e7 * LOST * jnp", "test_diffuse.py"),
    # smoothing/mode.py
    Mutation("smoothing/mode.py", "information + linalg.gram_less(new, alone)", "information + linalg.gram(new)", "test_exact.py"),
    Mutation("smoothing/mode.py", "0.5 * known + widening(model, point.levels)", "0.5 * known", "test_formulas.py"),
    Mutation("smoothing/mode.py", "return proposal, 0.5 * slope", "return proposal, slope", "test_guards.py"),
    Mutation("smoothing/mode.py", "~last.moved & ~converged", "last.moved & ~converged", "test_guards.py"),
    # smoothing/marginal.py
    Mutation("smoothing/marginal.py", "slope = own + jax.grad(along)(point.z)", "slope = own", "test_marginal.py"),
    Mutation("smoothing/marginal.py", "tuple(-own - jnp.einsum(", "tuple(0 * own - 0 * jnp.einsum(", "test_marginal.py"),
    Mutation("smoothing/marginal.py", "score = solved.score - prior.pull(point.z) - 0.5 * volume", "score = solved.score - prior.pull(point.z) + 0.5 * volume", "test_marginal.py"),
    Mutation("smoothing/marginal.py", "update = jnp.outer(change, change)", "update = 2 * jnp.outer(change, change)", "test_marginal.py"),
    # process noise that is not Gaussian
    Mutation("smoothing/tails.py", "jnp.sum((u**2 + variance)[:", "jnp.sum((u**2)[:", "test_tails.py"),
    Mutation("smoothing/tails.py", "jnp.sqrt(new.weight / old.weight)", "jnp.sqrt(old.weight / new.weight)", "test_tails.py"),
    Mutation("smoothing/mode.py", "- 0.5 * tail.size * jnp.log(tail.weight)", "+ 0.5 * tail.size * jnp.log(tail.weight)", "test_tails.py"),
    Mutation("smoothing/linearised.py", "density = log_density(model, point) + mixing_gain(model)", "density = log_density(model, point)", "test_tails.py"),
    Mutation("noise.py", "return (self.df + size) / (self.df + square)", "return (self.df + 1) / (self.df + square)", "test_tails.py"),
    Mutation("model/motions.py", "on[0] = component.memoryless or not begins", "on[0] = True", "test_tails.py"),
    # inference/orbits.py
    Mutation("inference/orbits.py", "gain = gain - there + here", "gain = gain + 0.0 * (there + here)", "test_orbits.py"),
    Mutation("inference/orbits.py", "density(at) + orbit.volume * r", "density(at)", "test_orbits.py"),
    # smoothing/mirrors.py, and crossing
    Mutation("smoothing/reflections.py", "return place - 2.0 * self.distance(place)", "return place - 1.0 * self.distance(place)", "test_mirrors.py"),
    # smoothing/crossings.py, inference/pruned.py, analysis/halves.py
    Mutation("smoothing/crossings.py", "[-now, reach, -reach]", "[now, now]", "test_crossings.py"),
    Mutation("smoothing/mirrors.py", "if max(climbs, back) >= TRIED:", "if climbs >= TRIED:", "test_crossings.py"),
    Mutation("inference/pruned.py", "0.0) * self.q2).gain", "1.0) * self.q2).gain", "test_crossings.py"),
    Mutation("analysis/halves.py", "- self.among[np.ix_(k, k)] - across", "- across", "test_halves.py"),
    Mutation("inference/collapsed.py", "return weight + posed.frame.log_likelihood(theta) - 0.5 * square + volume", "return weight - 0.5 * square + volume", "test_mirrors.py"),
    Mutation("inference/relevance.py", "change / (1.0 + change * row[m])", "change / (1.0 - change * row[m])", "test_relevance.py"),
    # inference/integrate.py, propagate.py
    Mutation("inference/integrate.py", "solved.information @ z + score", "solved.information @ z - score", "test_integrate.py"),
    Mutation("inference/integrate.py", "clip(1.0 - alpha * jnp.diagonal(covariance)", "clip(1.0 - jnp.diagonal(covariance)", "test_integrate.py"),
    Mutation("inference/integrate.py", "total / count + jnp.cov(", "total / count + 0 * jnp.cov(", "test_integrate.py"),
    Mutation("inference/propagate.py", "_positive(precision - self.sites.precision)", "_positive(precision)", "test_integrate.py"),
    Mutation("inference/propagate.py", "middle) - self.sites.pull\n", "middle)\n", "test_integrate.py"),
    Mutation("inference/propagate.py", "odds + 0.5 * jnp.log(", "0.5 * jnp.log(", "test_integrate.py"),
    # inference/widen.py
    Mutation("inference/widen.py", "1.0 + share * (inflation - 1.0)", "inflation", "test_assess.py"),
    Mutation("inference/widen.py", "more = [own + sign * ", "more = [own + ", "test_assess.py"),
    # smoothing/information.py
    Mutation("smoothing/linearised.py", "0.5 * (solved.logdet + biases.log_determinant())", "0.5 * solved.logdet", "test_exact.py"),
    Mutation("smoothing/linearised.py", "half, -response.states,", "half, response.states,", "test_exact.py test_observability.py"),
    Mutation("smoothing/information.py", "pull - (point.levels + step) / model.level_spread**2", "pull", "test_formulas.py"),
    Mutation("smoothing/linearised.py", "jax.tree.map(jnp.add, alone,", "jax.tree.map(lambda a, b: b, alone,", "test_formulas.py"),
    Mutation("model/model.py", "@ moved[epoch] + by_bias", "@ moved[epoch] - by_bias", "test_formulas.py test_observability.py"),
    Mutation("smoothing/information.py", "jnp.exp(point.levels - levels)", "jnp.exp(levels - point.levels)", "test_formulas.py"),
    Mutation("smoothing/information.py", "(squares + sum(jnp.sum(u**2) for u in point.noises))", "squares", "test_guards.py"),
    # smoothing/draws.py
    Mutation("smoothing/linearised.py", "free = prior - smooth.states", "free = prior + smooth.states", "test_exact.py"),
    Mutation("smoothing/draws.py", "jax.random.normal(key, (count, M)) @ root.T", "jax.random.normal(key, (count, M)) @ root", "test_exact.py"),
    Mutation("smoothing/linearised.py", "kept.J @ prior + own.half @ noise[1]", "kept.J @ prior", "test_exact.py"),
    # smoothing/gauge.py
    Mutation("identifiability/gauge.py", "information = information - linalg.gram(flat)", "information = information", "test_observability.py"),
    # smoothing/frame.py
    Mutation("smoothing/frame.py", "own - jnp.einsum(\"eij,ej->ei\", at.feedback, before))", "own + jnp.einsum(\"eij,ej->ei\", at.feedback, before))", "test_samplers.py test_model.py"),
    Mutation("smoothing/frame.py", "self.score @ step - 0.5 * step", "self.score @ step + 0.5 * step", "test_samplers.py"),
    Mutation("smoothing/frame.py", "loops.append(Loop(-smooth.states,", "loops.append(Loop(smooth.states,", "test_samplers.py"),
    Mutation("smoothing/frame.py", "cross = -(slopes", "cross = (slopes", "test_formulas.py"),
    Mutation("smoothing/frame.py", "jnp.expm1(-2 * step)", "jnp.expm1(2 * step)", "test_samplers.py"),
    # model/sigma.py
    Mutation("model/sigma.py", "np.full(2 * u, 0.5 / (u + kappa))", "np.full(2 * u, 1.0 / (u + kappa))", "test_methods.py"),
    Mutation("model/sigma.py", " - jnp.sum(slope**2, -1)", "", "test_methods.py"),
    # model/rows.py
    Mutation("model/rows.py", "rows.base + rows.scale * padded", "rows.base - rows.scale * padded", "test_exact.py"),
    Mutation("model/rows.py", "Linearised(score, weight, by_state, by_bias * rows.scale[rows.sensor][:, None, :])", "Linearised(score, weight, by_state, by_bias)", "test_exact.py"),
    Mutation("model/rows.py", "return rows.std * factors[rows.level]", "return rows.std", "test_formulas.py"),
    Mutation("model/rows.py", "score / jnp.sqrt(jnp.where(there, information, 1.0))", "score / jnp.where(there, information, 1.0)", "test_assess.py"),
    Mutation("model/rows.py", "jnp.mod(value + channel.period / 2, channel.period)", "jnp.mod(value, channel.period)", "test_formulas.py"),
    # noise.py
    Mutation("noise.py", "return -0.5 * r**2 - jnp.log(std) - 0.5 * np.log(2 * np.pi)", "return -0.5 * r**2 - jnp.log(std)", "test_exact.py"),
    Mutation("noise.py", "(self.df + 1) / (self.df + 3)", "(self.df + 1) / (self.df + 2)", "test_methods.py"),
    Mutation("noise.py", "(self.df + 1) / (self.df * std**2", "(self.df + 3) / (self.df * std**2", "test_methods.py"),
    Mutation("noise.py", "np.log(self.share / self.scale)", "np.log(self.share)", "test_methods.py"),
    # motion/components.py
    Mutation("motion/components.py", "[root * np.sqrt(3) / 2, root / 2]", "[root * np.sqrt(3) / 2, root / 3]", "test_exact.py"),
    Mutation("motion/components.py", "[[dt**2 / 2], [dt]], dimension", "[[dt**2], [dt]], dimension", "test_exact.py"),
    Mutation("motion/components.py", "dt / np.sqrt(48)", "dt / np.sqrt(24)", "test_catalogue.py"),
    Mutation("motion/components.py", "** 2 - 0.5j * angle * g", "** 2 + 0.5j * angle * g", "test_catalogue.py"),
    # motion/base.py, model/sampled.py, model/epochs.py
    Mutation("motion/base.py", "root = form.L[0] * std[None, : len(form.levels)]", "root = form.L[0]", "test_motion_protocol.py"),
    Mutation("model/sampled.py", "value * jnp.exp(levels[h])", "value", "test_motion_protocol.py"),
    Mutation("model/sampled.py", "lambda: sampled.begin(seed), lambda", "lambda: others, lambda", "test_motion_protocol.py"),
    Mutation("model/epochs.py", "jnp.where(epoch.first, 1, 2), 0)", "jnp.where(epoch.first, 2, 1), 0)", "test_motion_protocol.py"),
    Mutation("model/epochs.py", "jnp.where(epoch.recursion == r, jnp.where", "jnp.where(epoch.recursion >= 0, jnp.where", "test_motion_protocol.py"),
    Mutation("model/epochs.py", "total = total + jax.lax.cond(", "total = jax.lax.cond(", "test_motion_protocol.py"),
    # problem.py
    Mutation("problem.py", "epoch_of[rows] = offset + np.minimum(", "epoch_of[rows] = np.minimum(", "test_exact.py"),
    Mutation("problem.py", "side=\"right\") - 1", "side=\"left\") - 1", "test_exact.py test_drift.py"),
    Mutation("problem.py", "level=np.where(own, -1,", "level=np.where(own, 0,", "test_formulas.py"),
    Mutation("model/motions.py", "pace, wander = area.wide * extent / duration", "pace, wander = area.wide * extent", "test_formulas.py test_model.py"),
    Mutation("model/motions.py", "\"position\": (area.centre, area.wide * extent)", "\"position\": (area.centre, extent)", "test_formulas.py test_model.py"),
    # table.py
    Mutation("table.py", "np.arange(number, len(frame) + number)", "np.arange(1, len(frame) + 1)", "test_table.py test_cli.py"),
    Mutation("table.py", "in ((name, value), (f\"{name}_std\", std)):", "in ((name, value),):", "test_table.py"),
    Mutation("table.py", "(\"length\", 1852.0)", "(\"length\", 1853.0)", "test_table.py"),
    Mutation("table.py", "(\"length\", 1609.344)", "(\"length\", 1609.0)", "test_table.py"),
    Mutation("table.py", "return size / UNITS[wanted][1]", "return size * UNITS[wanted][1]", "test_table.py"),
    # nodes.py
    Mutation("geodesy.py", "@ earth_axes(self.latitude, self.longitude).T", "@ earth_axes(self.latitude, self.longitude)", "test_nodes.py"),
    Mutation("nodes.py", "turn = np.arctan2(axes[:, 0, 1], axes[:, 0, 0])", "turn = -np.arctan2(axes[:, 0, 1], axes[:, 0, 0])", "test_nodes.py"),
    Mutation("nodes.py", "round(float(np.rad2deg(value)), 12)", "round(float(value), 12)", "test_nodes.py"),
    Mutation("network.py", "self.path.position + (stated - self.position)", "self.path.position", "test_nodes.py"),
    Mutation("network.py", "node.sizes[component] = tuple(sds)", "node.sizes[component] = (max(sds),) * len(sds)", "test_nodes.py"),
    Mutation("results/io.py", "np.linalg.cholesky(unit + LOSS", "np.linalg.cholesky(unit + 4.0", "test_storage.py"),
    # geometry.py
    Mutation("geometry.py", "jnp.round(angle / period)", "jnp.floor(angle / period)", "test_catalogue.py"),
    Mutation("geometry.py", "jnp.stack([norm(line[:2]), line[2]])", "jnp.stack([norm(line), line[2]])", "test_catalogue.py"),
    # priors.py
    Mutation("priors.py", "+ 2 * self.rate + 1e-300", "+ self.rate + 1e-300", "test_formulas.py"),
    Mutation("priors.py", "total(z**2 + variance)", "total(z**2)", "test_formulas.py"),
    Mutation("priors.py", "jnp.where(self.alpha > 0, self.alpha, 1.0))) + self.logdet", "jnp.where(self.alpha > 0, self.alpha, 1.0)))", "test_methods.py"),
    # inference/
    Mutation("inference/ea.py", "alpha=jnp.where(fresh, state.alpha, alpha)", "alpha=alpha", "test_methods.py test_exact.py"),
    Mutation("inference/ea.py", "- cost(model, point, held) - jnp.sum(penalty)", "- cost(model, point, held)", "test_methods.py"),
    Mutation("inference/em.py", "expected.information + prior.matrix() + RIDGE", "expected.information + RIDGE", "test_methods.py"),
    Mutation("inference/em.py", "- 0.5 * alpha * point.z**2)", ")", "test_methods.py"),
    Mutation("inference/ending.py", "max(float(best) - float(worth), 0.0)", "0.0", "test_guards.py"),
    Mutation("inference/ending.py", "ABSURD = 100.0", "ABSURD = 1e40", "test_guards.py"),
    Mutation("inference/run.py", "return jnp.where(given.surveyed, alpha, learnt)", "return learnt", "test_methods.py test_exact.py"),
    Mutation("inference/posterior.py", "half = 50 * (1 - INTERVAL)", "half = 25 * (1 - INTERVAL)", "test_samplers.py"),
    Mutation("inference/posterior.py", "mixed[\"r_hat\"][:M] > 1.05", "mixed[\"r_hat\"][:M] > 10.5", "test_formulas.py"),
    Mutation("inference/collapsed.py", "momentum = (momentum[0] * given.active, momentum[1])", "momentum = (momentum[0], momentum[1])", "test_samplers.py"),
    Mutation("inference/sides.py", "gain = mixed_density(model, moved) - mixed_density(model, point)", "gain = mixed_density(model, point) - mixed_density(model, moved)", "test_mixing.py"),
    Mutation("inference/leaps.py", "jnp.exp(jnp.minimum(tried.weight - at.weight, 0.0))", "jnp.ones(())", "test_mixing.py"),
    Mutation("inference/coordinates.py", "hyper + volume + log_prior", "hyper + log_prior", "test_model.py test_samplers.py"),
    Mutation("inference/hierarchy.py", "self.prior.shape + 0.5 * number", "self.prior.shape + number", "test_samplers.py"),
    Mutation("inference/hierarchy.py", "self.prior.b + out", "self.prior.b + number", "test_samplers.py"),
    Mutation("inference/hierarchy.py", "(1.0 / auxiliary + 0.5 * total(z) / tau2)", "(1.0 / auxiliary + total(z) / tau2)", "test_samplers.py"),
    Mutation("inference/evidence.py", "- 0.5 * square + 0.5 * prior - volume", "- 0.5 * square - volume", "test_samplers.py"),
    Mutation("inference/evidence.py", "total += _log_mean(gain", "total = _log_mean(gain", "test_samplers.py"),
    Mutation("inference/evidence.py", "usual * np.sqrt((count - 1) / (count - 3))", "usual", "test_evidence.py"),
    Mutation("inference/evidence.py", " + PARTICLES * np.arange(RUNS)[:, None]", "", "test_evidence.py"),
    Mutation("inference/model.py", "{f\"noise{suffix(self.problem, r)}\": u for", "{f\"noise{suffix(self.problem, r)}\": 0 * u for", "test_model.py"),
    Mutation("inference/model.py", "found |= own[0] if own else {}", "pass", "test_model.py"),
    Mutation("inference/svi.py", " - 0.5 * np.log(2 * np.pi) * normal", "", "test_svi.py"),
    Mutation("inference/sampling.py", "min((chunk - self.begin + 1) * size", "min((chunk - self.begin) * size", "test_mixing.py"),
    Mutation("inference/storage.py", "self.storage.numbers[first:last])", "self.storage.numbers[first:last][:-1] or self.storage.numbers)", "test_storage.py"),
    # analysis/
    Mutation("analysis/verdict.py", "elif not status.settled:", "elif status is Status.DIVERGED:", "test_guards.py"),
    Mutation("analysis/verdict.py", "(gamma + inflation * (1.0 - gamma))", "gamma", "test_assess.py"),
    Mutation("analysis/leave.py", "-least - 0.5 * (solved.logdet + logdet)", "-least - 0.5 * solved.logdet", "test_assess.py"),
    Mutation("analysis/leave.py", "solved.score - prior.pull(point.z) - matrix @ away", "solved.score - prior.pull(point.z)", "test_assess.py"),
    Mutation("analysis/pieces.py", "slope[:M] -= prior @ pieces.z", "slope[:M] += prior @ pieces.z", "test_assess.py"),
    Mutation("analysis/pieces.py", "np.eye(q) + np.ones((q, q))", "np.eye(q)", "test_assess.py"),
    Mutation("inference/residuals.py", "expected = np.maximum(whole - used, 1e-9)", "expected = np.maximum(whole, 1e-9)", "test_assess.py"),
    Mutation("analysis/levels.py", "u**2 + spread - 1.0", "u**2 - 1.0", "test_asked_levels.py"),
    Mutation("analysis/pieces.py", "change: np.ndarray = steps[1] - steps[0]", "change: np.ndarray = 0.0 * steps[1]", "test_asked_levels.py"),
    Mutation("analysis/checks.py", "and again.sum() < TOGETHER * count", "", "test_asked_levels.py"),
    Mutation("model/motions.py", "row += size", "row += width", "test_tails.py"),
    Mutation("inference/residuals.py", "* (n + 2) / n", "* n / (n + 2)", "test_assess.py"),
    Mutation("inference/residuals.py", "max(2.0 * np.sum(couples", "max(np.sum(couples", "test_assess.py"),
]  # fmt: skip


def tree_of(root: Path, to: Path) -> None:
    """Copy what git tracks, and what it does not ignore, as it stands."""
    listed = subprocess.run(
        ["git", "ls-files", "-co", "--exclude-standard", "-z"], cwd=root, capture_output=True, check=True
    )
    for name in filter(None, listed.stdout.decode().split("\0")):
        if (root / name).is_file():
            (to / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(root / name, to / name)


def passes(copy: Path, tests: list[str]) -> tuple[bool, str]:
    """Whether tests pass in the copy, and the first line that says why not."""
    kernels = os.environ.get("JAX_COMPILATION_CACHE_DIR", str(ROOT / ".pytest_cache" / "kernels"))
    environment = os.environ | {
        "PYTHONPATH": str(copy),
        "JAX_COMPILATION_CACHE_DIR": kernels,
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    found = subprocess.run(
        [sys.executable, "-c", "import probcal; print(probcal.__file__)"],
        cwd=copy,
        env=environment,
        capture_output=True,
        text=True,
    )
    if found.returncode == 0 and not Path(found.stdout.strip()).is_relative_to(copy):
        sys.exit(f"the tests would import {found.stdout.strip()} instead of the mutated copy")
    command = [sys.executable, "-m", "pytest", *tests, "-x", "-q", "-p", "no:cacheprovider", "--durations=0"]
    command += ["-n", "0"] if tests else []
    try:
        done = subprocess.run(command, cwd=copy, env=environment, capture_output=True, text=True, timeout=LIMIT)
    except subprocess.TimeoutExpired:
        return False, f"no end after {LIMIT} s"
    failed = [line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
    if done.returncode == 5:
        sys.exit(f"none of {', '.join(tests)} is in the default run: name a test that is")
    if done.returncode not in (0, 1, 2, 3):
        sys.exit(done.stdout + done.stderr)
    return done.returncode == 0, failed[0] if failed else ""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--all", action="store_true", help="the whole default run where the named tests see nothing")
    parser.add_argument("--only", nargs="+", default=[], help="numbers of mutations, or parts of names of files")
    parser.add_argument("--list", action="store_true", help="print the table, run nothing")
    given = parser.parse_args()
    chosen = [
        (k, m) for k, m in enumerate(MUTATIONS)
        if not given.only or any(word == str(k) or (not word.isdigit() and word in m.file) for word in given.only)
    ]  # fmt: skip
    texts = {m.file: (ROOT / "probcal" / m.file).read_text() for _, m in chosen}
    for k, m in chosen:
        if texts[m.file].count(m.old) != 1 or m.old == m.new:
            sys.exit(
                f'mutation {k}: "{m.old}" stands {texts[m.file].count(m.old)} times in {m.file}; it must stand once'
            )
    survivors = 0
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder).resolve()
        tree_of(ROOT, copy)
        for k, m in chosen:
            line = f"{k:3d} {m.file}: {m.old} -> {m.new or 'nothing'}"
            if given.list:
                print(line)
                continue
            began, place = time.monotonic(), copy / "probcal" / m.file
            place.write_text(texts[m.file].replace(m.old, m.new))
            alive, why = passes(copy, [f"tests/{name}" for name in m.tests.split()])
            if alive and given.all:
                alive, why = passes(copy, [])
            place.write_text(texts[m.file])
            survivors += alive
            print(
                f"{'SURVIVED' if alive else 'killed':8} {time.monotonic() - began:5.0f} s {line}  {why[:120]}",
                flush=True,
            )
    if not given.list:
        print(f"{len(chosen) - survivors} of {len(chosen)} killed")
    return survivors


if __name__ == "__main__":
    sys.exit(main())
