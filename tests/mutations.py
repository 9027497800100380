"""Do the tests see a wrong line? One mutation at a time in a copy of the working tree, and the tests named for it.

`uv run python tests/mutations.py` prints killed or SURVIVED and the seconds of each; `--all` runs the whole default run
where the named tests pass, `--only 3 7` or `--only frame.py` picks some, `--list` runs nothing. The exit code is the
number of survivors. To add one, write a line in MUTATIONS; the old text must stand once in the package, and moves
with its code: white space apart, no file is named.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
TEXTS = {path: path.read_text() for path in sorted((ROOT / "probcal").rglob("*.py"))}
LIMIT = 1800  # seconds of one run of tests; one that never ends has seen the mutation


class Mutation(NamedTuple):
    old: str  # stands once in the package; any white space for its blanks
    new: str
    tests: str  # in tests/, those that should see it


MUTATIONS = [
    # gaussian/information.py, modes/swaps.py, inference/run.py: rejected sensors, exchanged labels
    Mutation("np.flatnonzero(below > 0.5 * (1.0 + expected) * data)", "np.flatnonzero(below > data)", "test_labels.py"),
    Mutation("int(below[k]) - used - 1, n, expected", "int(below[k]) - 1, n, expected", "test_labels.py"),
    Mutation("low[:, c] & near[:, c], mask[:, c] > 0", "low[:, c], mask[:, c] > 0", "test_labels.py"),
    Mutation("expected = max(expected, float(usual))", "pass", "test_labels.py"),
    Mutation("moved[place[b]] -= apart", "moved[place[b]] += apart", "test_labels.py"),
    Mutation("2.0 * float(special.stdtr(df, -np.sqrt(df)))", "float(special.stdtr(df, -np.sqrt(df)))", "test_labels.py"),
    # analysis/ridges.py, analysis/check.py
    Mutation("if not fall < FLAT * 0.5", "if not fall < -FLAT * 0.5", "test_ridges.py"),
    Mutation("at.score()) - z", "at.slope()) - z", "test_ridges.py"),
    # analysis/slopes.py, analysis/recoded.py
    Mutation("if not gain > CONFIRMED * expected:", "if not gain > 1e9:", "test_slopes.py"),
    Mutation("(inverse[k] - np.diag(held[members]))[np.ix_", "inverse[k][np.ix_", "test_slopes.py"),
    Mutation("if slopes.findings and strength > CLEARLY * ratio:", "if False:", "test_slopes.py"),
    Mutation('f"look like {other}": lambda value: quarter - value,', "", "test_slopes.py"),
    # gaussian/selected.py
    Mutation("across.T, inner - down.T @ across", "across.T, inner", "test_sparse.py"),
    # gaussian/recursion.py
    Mutation("moved @ (below.mT @ first.A)", "0 * moved @ (below.mT @ first.A)", "test_scans.py"),
    Mutation("[first.A.mT @ rest, first.Z]", "[rest, first.Z]", "test_scans.py"),
    Mutation("alone - gain.data.mT @ states", "alone + gain.data.mT @ states", "test_exact.py"),
    Mutation("own = square((eye - back @ _next(F)) @ gain.updated,", "own = square(gain.updated,", "test_exact.py"),
    Mutation("Smoothed(found.states + moved", "Smoothed(found.states - moved", "test_exact.py"),
    Mutation("logdet = 2.0 * jnp.sum(jnp.log(std))", "logdet = jnp.sum(jnp.log(std))", "test_exact.py"),
    Mutation("source = source.at[:, :, : c.shape[2]].add(gain.keep @ c)", "source = source.at[:, :, : c.shape[2]].add(c)", "test_exact.py"),
    Mutation("noises + gain.drive @ states @ gain.drive.mT", "noises", "test_formulas.py"),
    Mutation("gain.gain @ innovation + force", "gain.gain @ innovation", "test_diffuse.py"),
    Mutation("return states @ earlier + back", "return states @ b + back", "test_diffuse.py"),
    # results/alignment.py, plausible.py, rss/localise.py, analysis/changes.py, pieces.py
    Mutation("self.shift) @ self.rotation / self.scale", "self.shift) @ self.rotation", "test_alignment.py"),
    Mutation("GAP = 3.2e9", "GAP = 4e9", "test_plausible.py"),
    Mutation("TURNS = 20.0", "TURNS = 25.0", "test_plausible.py"),
    Mutation("APART = 20.0", "APART = 25.0", "test_plausible.py"),
    Mutation("FAR = 1e6", "FAR = 1e7", "test_plausible.py"),
    Mutation("FEW = 8", "FEW = 9", "test_plausible.py"),
    Mutation("FAINT, RANGE = 0.1, 30.0", "FAINT, RANGE = 1.0, 30.0", "test_plausible.py"),
    Mutation("FAINT, RANGE = 0.1, 30.0", "FAINT, RANGE = 0.1, 50.0", "test_plausible.py"),
    Mutation("NARROW, WIDE = 1e-9, 1e6", "NARROW, WIDE = 1e-10, 1e6", "test_plausible.py"),
    Mutation("NARROW, WIDE = 1e-9, 1e6", "NARROW, WIDE = 1e-9, 1e7", "test_plausible.py"),
    Mutation("own = w * dc**2 / about[:, None] if exponent is None else 0.0", "own = 0.0", "test_rss.py"),
    Mutation("np.minimum(slope, 0.0)", "slope", "test_rss.py"),
    Mutation("np.sqrt(inflation[m] / contrast.information[0, 0])", "np.sqrt(1.0 / contrast.information[0, 0])", "test_changes.py"),
    Mutation("change.contrast.plausible / inflation", "change.contrast.square / inflation", "test_changes.py"),
    # analysis/shape.py
    Mutation("if not fall > MOST:", "if fall > MOST:", "test_guards.py"),
    # inference/hierarchy.py, orbits.py: scales of their own that move along
    Mutation("jnp.sum(own + way - forth", "jnp.sum(own - forth", "test_orbits.py"),
    Mutation("jnp.exp(logs)) + logs - prior", "jnp.exp(logs)) - prior", "test_orbits.py"),
    Mutation("volumes[k] * r + ratio", "volumes[k] * r", "test_orbits.py"),
    # noise.py: what a density implies
    Mutation("return -e * self._slope(e)", "return e * self._slope(e)", "test_methods.py"),
    Mutation("slope**2 * density * np.cosh(t)", "slope**2 * density", "test_methods.py"),
    Mutation("return -self._slope(self.innovation(y, predicted, period) / std) / std", "return -self._slope(self.innovation(y, predicted, period) / std)", "test_methods.py"),
    # model/model.py
    Mutation("jnp.where(tail.on, tail.family.mixing_information(tail.size), 1.0)", "jnp.ones_like(tail.weight)", "test_tails.py"),
    # results/groups.py
    Mutation("mine = np.flatnonzero(member[there])", "mine = np.flatnonzero((epochs.target == epochs.target[0])[there])", "test_exact.py"),
    # linalg.py
    Mutation("(seen / (1.0 + std))", "(seen / std)", "test_exact.py"),
    Mutation("least = LOST * jnp", "least = 1e7 * LOST * jnp", "test_diffuse.py"),
    # gaussian/mode.py
    Mutation("information + linalg.gram_less(new, alone)", "information + linalg.gram(new)", "test_exact.py"),
    Mutation("0.5 * known + widening(model, point.levels)", "0.5 * known", "test_formulas.py"),
    Mutation("return proposal, 0.5 * slope", "return proposal, slope", "test_guards.py"),
    Mutation("~moved & ~converged", "moved & ~converged", "test_guards.py"),
    # gaussian/marginal.py
    Mutation("slope = own + through", "slope = own", "test_marginal.py"),
    Mutation("tuple(-own - jnp.einsum(", "tuple(0 * own - 0 * jnp.einsum(", "test_marginal.py"),
    # gaussian/climb.py
    Mutation("self.prior.pull(at.point.z) - 0.5 * volume", "self.prior.pull(at.point.z) + 0.5 * volume", "test_marginal.py"),
    # gaussian/search.py
    Mutation("(own * share - changes @ step)", "(own * share + changes @ step)", "test_marginal.py"),
    # process noise that is not Gaussian
    Mutation("jnp.sum((u**2 + variance)[:", "jnp.sum((u**2)[:", "test_tails.py"),
    Mutation("jnp.sqrt(new.weight / old.weight)", "jnp.sqrt(old.weight / new.weight)", "test_tails.py"),
    Mutation("- 0.5 * tail.size * jnp.log(tail.weight)", "+ 0.5 * tail.size * jnp.log(tail.weight)", "test_tails.py"),
    Mutation("density = log_density(model, point) + mixing_gain(model)", "density = log_density(model, point)", "test_tails.py"),
    Mutation("return (self.df + size) / (self.df + square)", "return (self.df + 1) / (self.df + square)", "test_tails.py"),
    Mutation("on[0] = component.memoryless or not begins", "on[0] = True", "test_tails.py"),
    # inference/orbits.py
    Mutation("gain = gain - there + here", "gain = gain + 0.0 * (there + here)", "test_orbits.py"),
    Mutation("density(at) + volumes[k] * r", "density(at)", "test_orbits.py"),
    # modes/mirrors.py, and crossing
    Mutation("return place - 2.0 * self.distance(place)", "return place - 1.0 * self.distance(place)", "test_mirrors.py"),
    # modes/crossings.py, explore.py, inference/pruned.py, analysis/segments.py
    Mutation("[-now, reach, -reach]", "[now, now]", "test_crossings.py"),
    Mutation("if TRIED in count.values():", "if count[False] >= TRIED:", "test_crossings.py"),
    Mutation("0.0) * self.q2).gain", "1.0) * self.q2).gain", "test_crossings.py"),
    Mutation("score = np.einsum(\"bij,bj->bi\", inverse, step[members]) +", "score = 0.0 * step[members] +", "test_segments.py"),
    Mutation("self.held = HELD * (1.0 +", "self.held = 0.0 * (1.0 +", "test_segments.py"),
    Mutation("return weight + posed.frame.log_likelihood(theta) - 0.5 * square + volume", "return weight - 0.5 * square + volume", "test_mixing.py"),
    Mutation("change / (1.0 + change * row[m])", "change / (1.0 - change * row[m])", "test_relevance.py"),
    # inference/integrate.py, propagate.py
    Mutation("information @ z + score - 0.5", "information @ z - score - 0.5", "test_integrate.py"),
    Mutation("jnp.clip(1.0 - alpha * variance, 0.0, 1.0), 0.0)\n        return total", "jnp.clip(1.0 - variance, 0.0, 1.0), 0.0)\n        return total", "test_integrate.py"),
    Mutation("total / count + jnp.cov(", "total / count + 0 * jnp.cov(", "test_integrate.py"),
    Mutation("without_negative(precision - self.sites.precision, LEAST)", "without_negative(precision, LEAST)", "test_integrate.py"),
    Mutation("middle) - self.sites.pull\n", "middle)\n", "test_integrate.py"),
    Mutation("odds + 0.5 * jnp.log(", "0.5 * jnp.log(", "test_integrate.py"),
    # inference/widen.py
    Mutation("1.0 + share * (inflation - 1.0)", "inflation", "test_assess.py"),
    Mutation("more = [own + sign * ", "more = [own + ", "test_assess.py"),
    # gaussian/information.py
    Mutation("0.5 * (solved.logdet + biases.log_determinant())", "0.5 * solved.logdet", "test_exact.py"),
    Mutation("half, -response.states,", "half, response.states,", "test_exact.py test_observability.py"),
    Mutation("pull - (point.levels + step) / model.level_spread**2", "pull", "test_formulas.py"),
    Mutation("jax.tree.map(jnp.add, alone,", "jax.tree.map(lambda a, b: b, alone,", "test_formulas.py"),
    Mutation("@ moved[epoch] + by_bias", "@ moved[epoch] - by_bias", "test_formulas.py test_observability.py"),
    Mutation("xp.exp(point.levels - levels)", "xp.exp(levels - point.levels)", "test_formulas.py"),
    Mutation("*map(np.square, point.noises)", "", "test_guards.py"),
    # gaussian/jointly.py
    Mutation("slopes.z - model.onto_biases(", "slopes.z + model.onto_biases(", "test_engine.py"),
    # gaussian/draws.py
    Mutation("prior - smooth.states", "prior + smooth.states", "test_exact.py"),
    Mutation("jax.random.normal(key, (count, M)) @ root.T", "jax.random.normal(key, (count, M)) @ root", "test_exact.py"),
    Mutation("kept.J @ prior + half @ scores", "kept.J @ prior", "test_exact.py"),
    # identifiability/gauge.py
    Mutation("moved.append(-x)", "moved.append(0 * x)", "test_observability.py"),
    # gaussian/frame.py
    Mutation("driven = own_k - jnp.sum", "driven = own_k + jnp.sum", "test_samplers.py test_model.py"),
    Mutation("self.score @ step - 0.5 * step", "self.score @ step + 0.5 * step", "test_samplers.py"),
    Mutation("loops.append(Loop(-smooth.states,", "loops.append(Loop(smooth.states,", "test_samplers.py"),
    Mutation("cross = -(slopes", "cross = (slopes", "test_formulas.py"),
    Mutation("jnp.expm1(-2 * step)", "jnp.expm1(2 * step)", "test_samplers.py"),
    # model/sigma.py
    Mutation("np.full(2 * u, 0.5 / (u + kappa))", "np.full(2 * u, 1.0 / (u + kappa))", "test_methods.py"),
    Mutation("jnp.maximum(square - jnp.sum(slope**2, -1), 0.0)", "jnp.maximum(square, 0.0)", "test_methods.py"),
    Mutation("    root = (vectors * scale) @ vectors.mT", "    root = vectors * scale", "test_methods.py"),
    # analysis/slopes.py: an answer at its bound is far from where a step from it ends
    Mutation("at = climb_to_mode(expand, at.point, prior, CLIMB, CLOSE).at", "pass", "test_slopes.py"),
    # model/rows.py
    Mutation("rows.base + rows.scale * padded", "rows.base - rows.scale * padded", "test_exact.py"),
    Mutation("Linearised(score, weight, by_state, by_bias * rows.scale[rows.sensor][:, None, :])", "Linearised(score, weight, by_state, by_bias)", "test_exact.py"),
    Mutation("return rows.std * level_factors(levels)[rows.level]", "return rows.std", "test_formulas.py"),
    Mutation("score / jnp.sqrt(jnp.where(there, information, 1.0))", "score / jnp.where(there, information, 1.0)", "test_assess.py"),
    Mutation("jnp.mod(value + channel.period / 2, channel.period)", "jnp.mod(value, channel.period)", "test_formulas.py"),
    # noise.py
    Mutation("return -0.5 * r**2 - jnp.log(std) - HALF_LOG", "return -0.5 * r**2 - jnp.log(std)", "test_exact.py"),
    Mutation("(self.df + 1) / (self.df + 3)", "(self.df + 1) / (self.df + 2)", "test_methods.py"),
    Mutation("(self.df + 1) / (self.df * std**2", "(self.df + 3) / (self.df * std**2", "test_methods.py"),
    Mutation("xp.log(self.share) + density", "density", "test_methods.py"),
    Mutation("told - 0.5 * spread", "told - 0.0 * spread", "test_late.py"),
    Mutation("rate - ratio, jnp.clip", "rate - ratio + 0.1, jnp.clip", "test_late.py"),
    # motion/components.py
    Mutation("[root * np.sqrt(3) / 2, root / 2]", "[root * np.sqrt(3) / 2, root / 3]", "test_exact.py"),
    Mutation("[[dt**2 / 2], [dt]], dimension", "[[dt**2], [dt]], dimension", "test_exact.py"),
    Mutation("dt / np.sqrt(48)", "dt / np.sqrt(24)", "test_catalogue.py"),
    Mutation("** 2 - 0.5j * angle * g", "** 2 + 0.5j * angle * g", "test_catalogue.py"),
    # motion/base.py, model/sampled.py, model/epochs.py
    Mutation("root = form.L[0] * std[None, : len(form.levels)]", "root = form.L[0]", "test_motion_protocol.py"),
    Mutation("value * jnp.exp(levels[h])", "value", "test_motion_protocol.py"),
    Mutation("lambda: sampled.begin(seed), lambda", "lambda: others, lambda", "test_motion_protocol.py"),
    Mutation("jnp.where(epoch.first, 1, 2), 0)", "jnp.where(epoch.first, 2, 1), 0)", "test_motion_protocol.py"),
    Mutation("jnp.where(epoch.recursion == r, jnp.where", "jnp.where(epoch.recursion >= 0, jnp.where", "test_motion_protocol.py"),
    Mutation("total = total + jax.lax.cond(", "total = jax.lax.cond(", "test_motion_protocol.py"),
    # problem.py
    Mutation("epoch_of[rows] = offset + own", "epoch_of[rows] = own", "test_exact.py"),
    Mutation("return offset + rate * time", "return offset", "test_clocks.py"),
    Mutation("return function(target.at(late), pose.at(late", "return function(target, pose.at(late", "test_clocks.py"),
    Mutation("found[order], order, np.argsort(order)", "found[order], order, (order)", "test_clocks.py"),
    Mutation("data.time[chosen[own]], side=\"right\") - 1", "data.time[chosen[own]], side=\"left\") - 1", "test_exact.py test_drift.py"),
    Mutation("level=np.where(own, -1,", "level=np.where(own, 0,", "test_formulas.py"),
    Mutation("pace, wander = area.wide * extent / duration", "pace, wander = area.wide * extent", "test_formulas.py test_model.py"),
    Mutation("\"position\": (area.centre, area.wide * extent)", "\"position\": (area.centre, extent)", "test_formulas.py test_model.py"),
    # table.py
    Mutation("np.arange(number, len(frame) + number)", "np.arange(1, len(frame) + 1)", "test_table.py test_cli.py"),
    Mutation("in ((name, value), (f\"{name}_std\", std)):", "in ((name, value),):", "test_table.py"),
    Mutation("\"nmi\": 1852.0", "\"nmi\": 1853.0", "test_table.py"),
    Mutation("\"mi\": 1609.344", "\"mi\": 1609.0", "test_table.py"),
    Mutation("return size / UNITS[wanted][1]", "return size * UNITS[wanted][1]", "test_table.py"),
    # nodes.py
    Mutation("@ earth_axes(self.latitude, self.longitude).T", "@ earth_axes(self.latitude, self.longitude)", "test_nodes.py"),
    Mutation("return axes turn = np.arctan2(axes[:, 0, 1], axes[:, 0, 0])", "return axes\n    turn = -np.arctan2(axes[:, 0, 1], axes[:, 0, 0])", "test_nodes.py"),
    Mutation("round(float(np.rad2deg(value)), 12)", "round(float(value), 12)", "test_nodes.py"),
    Mutation("self.path.position + (stated - self.position)", "self.path.position", "test_nodes.py"),
    Mutation("node.sizes[component] = tuple(sds)", "node.sizes[component] = (max(sds),) * len(sds)", "test_nodes.py"),
    Mutation("np.linalg.cholesky(unit + LOSS", "np.linalg.cholesky(unit + 4.0", "test_storage.py"),
    # geometry.py
    Mutation("jnp.round(angle / period)", "jnp.floor(angle / period)", "test_catalogue.py"),
    Mutation("jnp.stack([norm(line[:2]), line[2]])", "jnp.stack([norm(line), line[2]])", "test_catalogue.py"),
    # priors.py
    Mutation("+ 2 * self.rate + 1e-300", "+ self.rate + 1e-300", "test_methods.py"),
    Mutation("total(z**2 + variance)", "total(z**2)", "test_methods.py"),
    Mutation("xp.log(alpha + (alpha == 0)).sum() + self.logdet", "xp.log(alpha + (alpha == 0)).sum()", "test_methods.py"),
    # inference/
    Mutation("alpha=jnp.where(fresh, state.alpha, alpha)", "alpha=alpha", "test_methods.py test_exact.py"),
    Mutation("- cost(model, point, held) - jnp.sum(penalty)", "- cost(model, point, held)", "test_methods.py"),
    Mutation("information + prior.matrix() + RIDGE", "information + RIDGE", "test_methods.py"),
    Mutation("- 0.5 * alpha * point.z**2)", ")", "test_methods.py"),
    Mutation("max(float(best) - float(worth), 0.0)", "0.0", "test_guards.py"),
    Mutation("ABSURD = 100.0", "ABSURD = 1e40", "test_guards.py"),
    Mutation("return jnp.where(given.surveyed, alpha, learnt)", "return learnt", "test_methods.py test_exact.py"),
    Mutation("half = 50 * (1 - INTERVAL)", "half = 25 * (1 - INTERVAL)", "test_samplers.py"),
    Mutation(", **masks}", "}", "test_formulas.py"),
    Mutation("momentum = (momentum[0] * given.active, momentum[1])", "momentum = (momentum[0], momentum[1])", "test_samplers.py"),
    Mutation("gain = mixed_density(model, moved) - mixed_density(model, point)", "gain = mixed_density(model, point) - mixed_density(model, moved)", "test_mixing.py test_mirrors.py"),
    Mutation("jnp.exp(jnp.minimum(tried.weight - at.weight, 0.0))", "jnp.ones(())", "test_mixing.py"),
    Mutation("hyper + volume + log_prior(form, posed, theta, phi) + joint)", "hyper + log_prior(form, posed, theta, phi) + joint)", "test_model.py test_samplers.py"),
    Mutation("self.prior.shape + 0.5 * number", "self.prior.shape + number", "test_samplers.py"),
    Mutation("self.prior.b + out", "self.prior.b + number", "test_samplers.py"),
    Mutation("(1.0 / auxiliary + 0.5 * total(z) / tau2)", "(1.0 / auxiliary + total(z) / tau2)", "test_samplers.py"),
    Mutation("- 0.5 * square + 0.5 * prior - volume", "- 0.5 * square - volume", "test_samplers.py"),
    Mutation("total += _log_mean(gain", "total = _log_mean(gain", "test_samplers.py"),
    Mutation("usual * np.sqrt((count - 1) / (count - 3))", "usual", "test_evidence.py"),
    Mutation(" + PARTICLES * np.arange(RUNS)[:, None]", "", "test_evidence.py"),
    Mutation("{f\"noise{suffix(self.problem, r)}\": u for", "{f\"noise{suffix(self.problem, r)}\": 0 * u for", "test_model.py"),
    Mutation("found |= own[0] if own else {}", "pass", "test_model.py"),
    Mutation(" - 0.5 * np.log(2 * np.pi) * normal", "", "test_svi.py"),
    Mutation("np.clip(steps - method.warmup, 0", "np.clip(steps, 0", "test_mixing.py"),
    Mutation("self.draws[::-2][::-1]", "self.draws[::2]", "test_mixing.py"),
    Mutation("and not answer.requested.chooses", "", "test_sbc.py"),
    Mutation("0.99 ** (1.0 / len(ess))", "0.99", "test_mixing.py"),
    Mutation("wanted or min(ESS", "min(ESS", "test_mixing.py"),
    Mutation('self.found = numbered(part, "state"), chunks', 'self.found = numbered(part, "state"), chunks[:-1]', "test_storage.py"),
    # analysis/
    Mutation("(not status.settled, ", "(status is Status.DIVERGED, ", "test_guards.py"),
    Mutation("(gamma + inflation * (1.0 - gamma))", "gamma", "test_assess.py"),
    Mutation("weighted([~out[index][:, None] for", "weighted([out[index][:, None] for", "test_assess.py"),
    Mutation("np.where(own, PINNED, wide)", "np.where(own, wide, wide)", "test_assess.py"),
    Mutation("slope[:M] -= prior @ pieces.z", "slope[:M] += prior @ pieces.z", "test_assess.py"),
    Mutation("np.eye(q) + np.ones((q, q))", "np.eye(q)", "test_assess.py"),
    Mutation("expected = np.maximum(whole - used, 1e-9)", "expected = np.maximum(whole, 1e-9)", "test_assess.py"),
    Mutation("u**2 + variance - 1.0", "u**2 - 1.0", "test_asked_levels.py"),
    Mutation("return steps[1][: len(steps[0])] - steps[0]", "return 0.0 * steps[1]", "test_asked_levels.py"),
    Mutation("and again.sum() < TOGETHER * count", "", "test_asked_levels.py"),
    Mutation("slice(row, row + size), slice(row, row + width))) row += size", "slice(row, row + size), slice(row, row + width)))\n        row += width", "test_tails.py"),
    Mutation("* (n + 2) / n", "* n / (n + 2)", "test_assess.py"),
    Mutation("max(2.0 * np.sum(couples", "max(np.sum(couples", "test_assess.py"),
    Mutation("by = -both / np", "by = both / np", "test_profile.py"),
    Mutation("weights = np.exp(worth - worth.max())", "weights = np.exp(0.0 * worth)", "test_profile.py"),
    Mutation("drift[epoch] += spread * away / total", "drift[epoch] -= spread * away / total", "test_profile.py"),
    Mutation("(total + sd * np.sqrt(total))", "total", "test_profile.py"),
    Mutation("own.objective + density if line", "own.objective if line", "test_profile.py"),
    Mutation("side ^ change for change in changes", "side ^ change for change in changes[:0]", "test_profile.py"),
    Mutation("precision * covariance.variance, 0.0, 1.0)", "0.9 * precision * covariance.variance, 0.0, 1.0)", "test_profile.py"),
    Mutation("np.abs(np.log2(powers))", "np.abs(np.log(powers))", "test_assess.py"),
]  # fmt: skip


def places(mutation: Mutation) -> list[tuple[Path, int, int]]:
    """The files of the package in which the old text stands, and where it begins and ends."""
    pattern = re.compile(r"\s+".join(re.escape(word) for word in mutation.old.split()))
    return [(path, *found.span()) for path, text in TEXTS.items() for found in pattern.finditer(text)]


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
    command += ["-n", "0", "-m", "not slow"] if tests else []
    try:
        done = subprocess.run(command, cwd=copy, env=environment, capture_output=True, text=True, timeout=LIMIT)
    except subprocess.TimeoutExpired:
        return False, f"no end after {LIMIT} s"
    failed = [line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
    if done.returncode == 5:
        sys.exit(f"none of {', '.join(tests)} is in a tier of CI: name a test that is")
    if done.returncode not in (0, 1, 2, 3):
        sys.exit(done.stdout + done.stderr)
    return done.returncode == 0, failed[0] if failed else ""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--all", action="store_true", help="the whole default run where the named tests see nothing")
    parser.add_argument("--only", nargs="+", default=[], help="numbers of mutations, or parts of names of files")
    parser.add_argument("--list", action="store_true", help="print the table, run nothing")
    given = parser.parse_args()
    chosen = []
    for k, m in enumerate(MUTATIONS):
        found = places(m)
        if len(found) != 1 or m.old == m.new:
            sys.exit(f'mutation {k}: "{m.old}" stands {len(found)} times in the package; it must stand once')
        file = found[0][0].relative_to(ROOT)
        if not given.only or any(word == str(k) or (not word.isdigit() and word in str(file)) for word in given.only):
            chosen.append((k, m, file, found[0][1:]))
    survivors = 0
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder).resolve()
        tree_of(ROOT, copy)
        for k, m, file, (begin, end) in chosen:
            line = f"{k:3d} {file}: {m.old} -> {m.new or 'nothing'}"
            if given.list:
                print(line)
                continue
            began, place = time.monotonic(), copy / file
            place.write_text(TEXTS[ROOT / file][:begin] + m.new + TEXTS[ROOT / file][end:])
            alive, why = passes(copy, [f"tests/{name}" for name in m.tests.split()])
            if alive and given.all:
                alive, why = passes(copy, [])
            place.write_text(TEXTS[ROOT / file])
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
