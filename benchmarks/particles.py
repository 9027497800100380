"""Particle filters and smoothers: speed beside a peer, cost over particles and epochs, and scenario A of Paper A.

    uv run python benchmarks/particles.py speed            # of a pass, a --peer's script beside it
    uv run python benchmarks/particles.py cost             # cost over particles and epochs, exponents fitted
    uv run python benchmarks/particles.py paper --runs 70  # table 2 of Paper A on the twin, free and on the road
    uv run python benchmarks/particles.py coverage         # intervals of EM by particles over runs of its own model
    uv run python benchmarks/particles.py sbc --runs 200   # particle Gibbs on a small presence network

Every figure of `benchmarks/README.md` on particles is printed by one of these; times are the best of several, compiled.
"""

import argparse
import re
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

sys.path.insert(0, str(Path(__file__).parents[1] / "models"))
import presence
import road_microphones as microphones

import probcal
from probcal import EM, ConstantVelocity, Gaussian, Network, Node, ParticleGibbs, Particles, Problem, Target, simulate
from probcal.particle.ensemble import ensemble
from probcal.particle.targets import targets_of


def best(problem, how, tries=5):
    """Seconds to compile and of the best of some runs: filter and smoother of every target."""
    with jax.enable_x64(True):
        model = problem.model
        targets = targets_of(model)
        z, levels = jnp.zeros(model.biases), jnp.zeros(len(problem.levels))
        times = []
        for k in range(tries + 1):
            key = jax.random.key(k)
            began = time.perf_counter()
            jax.block_until_ready(ensemble(model, targets, z, levels, key, how))
            times.append(time.perf_counter() - began)
    return times[0], min(times[1:])


def speed(peer):
    """One pass over scenario A's rows: M = 500, K = 30, 12 microphones."""
    problem, _ = microphones.setting(0)
    for how in (
        Particles(500, "bootstrap", "marginal"), Particles(500, "bootstrap", "backward"),
        Particles(500, "extended", "marginal"), Particles(10_000, "bootstrap", "backward"),
    ):  # fmt: skip
        first, run = best(problem, how)
        print(f"{how.count:6d} {how.proposal:9} {how.smoother:9} first {first:.2f} s, then {run:.4f} s")
        if how.smoother == "marginal" and how.proposal == "bootstrap":
            mine = run
    road, _ = microphones.setting(0, "road")
    for how in (Particles(500, smoother="marginal"), Particles(500), Particles(10_000)):
        first, run = best(road, how)
        print(f"{how.count:6d} on road   {how.smoother:9} first {first:.2f} s, then {run:.4f} s")
    if peer:
        told = subprocess.run([*peer], capture_output=True, text=True, check=True).stdout
        theirs = sum(float(value) for value in re.findall(r"\d+\.\d+(?:e-?\d+)?", told)[-2:])
        print(told.strip())
        print(f"ratio of filter and O(M^2) smoother: {theirs / mine:.0f}")


def cost():
    """Seconds over particles and epochs, and the exponents of a power law."""
    for smoother, sizes in (("backward", (1000, 2000, 4000, 8000, 16000)), ("marginal", (500, 1000, 2000, 4000))):
        problem, _ = microphones.setting(0)
        found = [best(problem, Particles(M, "bootstrap", smoother), 3)[1] for M in sizes]
        slope = np.polyfit(np.log(sizes), np.log(found), 1)[0]
        print(f"{smoother} over M {sizes}: {np.round(found, 4).tolist()} s, exponent {slope:.2f}")
    found, sizes = [], (30, 60, 120, 240)
    for K in sizes:
        network, motion = microphones.network(), microphones.motion()
        problem = Problem(network, motion, simulate(network, motion, np.arange(float(K)), key=1).table)
        found.append(best(problem, Particles(2000, "bootstrap"), 3)[1])
    slope = np.polyfit(np.log(sizes), np.log(found), 1)[0]
    print(f"backward over K {sizes}: {np.round(found, 4).tolist()} s, exponent {slope:.2f}")


METHODS = {
    "EM, particles": EM(Particles(500), iterations=30, tolerance=0.0),
    "EM, paths": EM(Particles(500, m_step="paths"), iterations=30, tolerance=0.0),
    "EM, mean": EM(Particles(500, "bootstrap", m_step="mean"), iterations=30, tolerance=0.0),
}


def paper(runs, gibbs):
    """Table 2 of Paper A on the twin: bias = truth minus survey, so that its signs are turned."""
    shown = [f"mic_{n}.{part}" for n in (3, 4, 7, 8) for part in ("position_x", "position_y", "gain")]
    truth = microphones.biases()
    table = pd.DataFrame({"true": [truth[label] for label in shown]}, index=shown)
    for motion in ("free", "road"):
        methods = dict(METHODS)
        if motion == "free":
            methods["EM, extended"] = EM(iterations=30, tolerance=0.0)
        if gibbs:
            methods["particle Gibbs"] = ParticleGibbs(particles=Particles(100))
        for name, method in methods.items():
            found, inside, squares, statuses, began = [], [], [], [], time.perf_counter()
            count = min(runs, gibbs) if name == "particle Gibbs" else runs
            for run in range(count):
                problem, _ = microphones.setting(run, motion)
                tree = probcal.fit(problem, method, prior=Gaussian(), key=run)
                group = tree["calibration"].to_dataset()
                labels, true = list(problem.labels), np.array([truth[label] for label in problem.labels])
                found.append(group["mean"].to_series())
                inside.append((group["lower"].values < true) & (true < group["upper"].values))
                statuses.append(tree.attrs["status"])
                place = np.char.find(np.array(labels, str), "position") >= 0
                squares.append(np.mean((group["mean"].values - true)[place] ** 2))
            frame = pd.DataFrame(found)[shown]
            table[f"{motion}: {name}"] = [
                f"{mean:.2f} ± {sd:.2f}" for mean, sd in zip(frame.mean(), frame.std(), strict=True)
            ]
            took = time.perf_counter() - began
            counts = pd.Series(statuses).value_counts().to_dict()
            print(
                f"{motion}, {name}: {count} runs, {took:.0f} s, position RMS {np.sqrt(np.mean(squares)):.2f} m (median"
                f" of runs {np.sqrt(np.median(squares)):.2f}), mean spread {frame.std().iloc[:].mean():.2f},"
                f" intervals of 89 % hold {np.mean(inside):.0%}, {counts}",
                flush=True,
            )
    print(table.to_string())


def coverage(runs):
    """Biases drawn from their scales, four targets: how often intervals of 89 % hold the truth."""
    network = microphones.network()
    for motion in ("free", "road"):
        for name, method in METHODS.items():
            inside, squares = [], []
            for run in range(runs):
                drawn = np.random.default_rng(run)
                biases = {b.label: b.scale * drawn.standard_normal() for b in network.biases}
                simulated = simulate(network, microphones.motion(motion), microphones.TIME, key=run, biases=biases)
                problem = Problem(network, microphones.motion(motion), simulated.table)
                tree = probcal.fit(problem, replace(method, iterations=60), prior=Gaussian(), key=run)
                group, true = tree["calibration"].to_dataset(), np.array([biases[b] for b in problem.labels])
                inside.append(((group["lower"].values < true) & (true < group["upper"].values)).mean())
                away = group["mean"].values - true
                squares.append(away @ np.linalg.solve(group["covariance"].values, away) / len(away))
            error = np.std(inside, ddof=1) / np.sqrt(runs)
            print(
                f"{motion}, {name}: {runs} runs, coverage {np.mean(inside):.3f} ± {error:.3f} (0.89 nominal), NEES a"
                f" bias {np.mean(squares):.2f}, worst {np.max(squares):.1f}",
                flush=True,
            )


def small():
    """Three presence sensors and two known posts beside two walkers: small enough for simulation-based calibration."""
    nodes = [Node(f"p{k}", (4.0 * k, 2.0 * (-1) ** k), scale=2.0) for k in (1, 2, 3)]
    posts = [Node("g", (0.0, 10.0)), Node("h", (16.0, -10.0))]
    network = Network([*(presence.presence.on(n) for n in nodes), *(presence.gate.on(n) for n in posts)])
    start = {"position": ((0.0, 0.0), 1.0), "velocity": ((1.4, 0.0), 0.2)}
    motions = {name: Target(ConstantVelocity(0.3), start) for name in ("one", "two")}
    return Problem(network, motions, simulate(network, motions, np.arange(12.0), key=0).table)


def calibration(runs):
    """Ranks of the truth among draws of particle Gibbs."""
    method = ParticleGibbs(chains=1, warmup=100, draws=300, particles=Particles(50))
    tree = probcal.sbc(small(), method, prior=Gaussian(), runs=runs, key=0)
    print(tree.attrs["verdict"])
    print(tree["uniformity"].to_dataset()["p_value"].to_series().round(3).to_string())
    print(tree["coverage"].to_dataset()[["all", "all_se"]].to_dataframe().to_string())


if __name__ == "__main__":
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    asked.add_argument("what", choices=("speed", "cost", "paper", "coverage", "sbc"))
    asked.add_argument("--peer", nargs="+", help="a command that prints its seconds last: filter, then smoother")
    asked.add_argument("--runs", type=int, default=20)
    asked.add_argument("--gibbs", type=int, default=0, help="runs of particle Gibbs beside, in `paper`")
    given = asked.parse_args()
    if given.what == "speed":
        speed(given.peer)
    elif given.what == "cost":
        cost()
    elif given.what == "paper":
        paper(given.runs, given.gibbs)
    elif given.what == "coverage":
        coverage(given.runs)
    else:
        calibration(given.runs)
