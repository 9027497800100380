"""Particle filters and smoothers: speed beside a peer, cost over particles and epochs, and scenario A of Paper A.

    uv run python benchmarks/particles.py speed            # of a pass, a --peer's script beside it
    uv run python benchmarks/particles.py cost             # cost over particles and epochs, exponents fitted
    uv run python benchmarks/particles.py paper --runs 70  # table 2 of Paper A on the twin, free and on the road
    uv run python benchmarks/particles.py coverage         # intervals of EM by particles over runs of its own model
    uv run python benchmarks/particles.py presence         # yes-or-no sensors: particle Gibbs and Laplace
    uv run python benchmarks/particles.py sbc --runs 200   # particle Gibbs on a small presence network

Every figure of `benchmarks/README.md` on particles is printed by one of these; times are the best of several, compiled.
"""

import argparse
import re
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

sys.path.insert(0, str(Path(__file__).parents[1] / "models"))
import presence
import road_microphones as microphones

import probcal
from probcal import (
    EM,
    MAP,
    ConstantVelocity,
    Gaussian,
    Network,
    Node,
    ParticleGibbs,
    Particles,
    Problem,
    Target,
    simulate,
)
from probcal.particles.ensemble import ensemble
from probcal.particles.targets import targets_of


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
    "EM, paths, O(M^2)": EM(Particles(500, smoother="exact", m_step="paths"), iterations=30, tolerance=0.0),
    "EM, mean": EM(Particles(500, "bootstrap", m_step="mean"), iterations=30, tolerance=0.0),
    "EM, mean, O(M^2)": EM(Particles(500, "bootstrap", "marginal", m_step="mean"), iterations=30, tolerance=0.0),
    "EM, extended": EM(iterations=30, tolerance=0.0),
    "particle Gibbs": ParticleGibbs(chains=2, warmup=300, draws=400, patience=1, particles=Particles(60)),
}
SHOWN = [f"mic_{n}.{part}" for n in (3, 4, 7, 8) for part in ("position_x", "position_y", "gain")]


def runs_of(motion, name, runs):
    """One method on some runs of scenario A: what is printed of it, and its column of the table."""
    truth, errors, inside, statuses, steps, began = pd.Series(microphones.biases()), [], [], [], [], time.perf_counter()
    method = METHODS[name]
    for run in range(runs):
        problem, _ = microphones.setting(run, motion)
        tree = probcal.fit(problem, method, prior=Gaussian(), key=run)
        group, true = tree["calibration"].to_dataset(), truth[list(problem.labels)].values
        place = np.char.find(np.array(problem.labels, str), "position") >= 0
        errors.append(pd.Series(group["mean"].values - true, index=problem.labels))
        inside.append((group["lower"].values < true) & (true < group["upper"].values))
        statuses.append(tree.attrs["status"])
        if "optimisation" in tree.children:
            away = tree["optimisation"]["bias"].values - true
            steps.append(np.mean(away[:, place] ** 2, 1))
    took, frame = time.perf_counter() - began, pd.DataFrame(errors)
    squares = frame.loc[:, place].pow(2).mean(axis=1)
    lines = [
        f"{motion}, {name}: {runs} runs, {took:.0f} s, position RMS {np.sqrt(squares.mean()):.2f} m (worst run"
        f" {np.sqrt(squares.max()):.2f}), mean spread {frame.loc[:, place].std().mean():.2f} m, intervals of 89 % hold"
        f" {np.mean(inside):.0%}, {pd.Series(statuses).value_counts().to_dict()}"
    ]
    lost = squares > 3.0**2
    if lost.any():
        words = pd.Series(statuses)[lost.values].value_counts().to_dict()
        lines.append(f"    {lost.sum()} runs lie more than 3 m off, and say {words}")
    if steps:
        over = np.sqrt(np.mean(steps, 0))[[0, 1, 2, 4, 9, 14, 19, 24, -1]]
        lines.append(
            f"    RMS after 1, 2, 3, 5, 10, 15, 20, 25 iterations and at the end: {np.round(over, 2).tolist()}"
        )
    mean, spread = (truth + frame.mean())[SHOWN], frame.std()[SHOWN]
    return lines, [f"{m:.2f} ± {sd:.2f}" for m, sd in zip(mean, spread, strict=True)], squares.values


def paper(runs, beside, names):
    """Table 2 of Paper A on the twin, free and on the road side by side, then the other methods on some of the runs."""
    truth = microphones.biases()
    table = pd.DataFrame({"true": [truth[label] for label in SHOWN]}, index=SHOWN)
    asked = [(motion, "EM, particles", runs) for motion in ("free", "road")]
    if beside:
        motions = {name: ("free",) if name == "EM, extended" else ("free", "road") for name in names}  # of linear form
        asked += [(motion, name, beside) for name in names for motion in motions[name]]
    began, squares = time.perf_counter(), {}
    with ProcessPoolExecutor(2, get_context("spawn")) as pool:
        waiting = [(one, pool.submit(runs_of, *one)) for one in asked]
        for (motion, name, _), later in waiting:
            lines, column, squares[motion, name] = later.result()
            print("\n".join(lines), flush=True)
            table[f"{motion}: {name}"] = column
            if (motion, name) == ("road", "EM, particles"):
                free, road = squares["free", name], squares["road", name]
                ratio = np.sqrt(road.mean() / free.mean())
                print(f"{time.perf_counter() - began:.0f} s for both; error on the road by the free one {ratio:.2f},"
                      f" smaller in {np.mean(road < free):.0%} of the runs", flush=True)  # fmt: skip
    print(table.to_string())


def coverage(runs):
    """Biases and ways drawn from the model: how often intervals of 89 % hold the truth, and those called converged."""
    network = microphones.network()
    for motion in ("free", "road"):
        for name in ("EM, particles", "EM, paths", "EM, mean"):
            method, inside, squares, settled = METHODS[name], [], [], []
            for run in range(runs):
                drawn = np.random.default_rng(run)
                biases = {b.label: b.scale * drawn.standard_normal() for b in network.biases}
                simulated = simulate(network, microphones.motion(motion), microphones.TIME, key=run, biases=biases)
                problem = Problem(network, microphones.motion(motion), simulated.table)
                tree = probcal.fit(problem, replace(method, iterations=60), prior=Gaussian(), key=run)
                group, true = tree["calibration"].to_dataset(), np.array([biases[b] for b in problem.labels])
                inside.append(((group["lower"].values < true) & (true < group["upper"].values)).mean())
                settled.append(tree.attrs["status"] == "converged")
                away = group["mean"].values - true
                squares.append(away @ np.linalg.solve(group["covariance"].values, away) / len(away))
            error = np.std(inside, ddof=1) / np.sqrt(runs)
            print(
                f"{motion}, {name}: {runs} runs, coverage {np.mean(inside):.3f} ± {error:.3f} (0.89 nominal), NEES a"
                f" bias {np.mean(squares):.2f}, worst {np.max(squares):.1f}; {sum(settled)} converged, coverage"
                f" {np.mean(np.array(inside)[settled]) if any(settled) else np.nan:.3f}",
                flush=True,
            )


def yes_and_no(runs):
    """Presence sensors drawn from their scales: particle Gibbs, and what the Laplace approximation says."""
    methods = {"particle Gibbs": ParticleGibbs(chains=2, draws=800, particles=Particles(60)), "Laplace": MAP()}
    told = {name: [] for name in methods}
    for run in range(runs):
        problem, truth = presence.setting(run)
        true = np.array([truth.biases[label] for label in problem.labels])
        for name, method in methods.items():
            began = time.perf_counter()
            tree = probcal.fit(problem, method, prior=Gaussian(), key=run)
            group = tree["calibration"].to_dataset()
            away = group["mean"].values - true
            told[name].append({
                "seconds": time.perf_counter() - began,
                "RMS": np.sqrt(np.mean(away**2)), "sd": group["sd"].mean().item(),
                "held": ((group["lower"].values < true) & (true < group["upper"].values)).mean(),
                "NEES": away @ np.linalg.solve(group["covariance"].values, away) / len(away),
                "converged": tree.attrs["status"] == "converged",
            })  # fmt: skip
            print(run, name, {k: round(float(v), 2) for k, v in told[name][-1].items()}, flush=True)
    for name, rows in told.items():
        frame = pd.DataFrame(rows).astype(float)
        error = frame["held"].std(ddof=1) / np.sqrt(runs)
        print(f"{name}: {runs} runs, {frame.mean().round(2).to_dict()}, held ± {error:.3f} (0.89 nominal)")


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
    asked.add_argument("what", choices=("speed", "cost", "paper", "coverage", "presence", "sbc"))
    asked.add_argument("--peer", nargs="+", help="a command that prints its seconds last: filter, then smoother")
    asked.add_argument("--runs", type=int, default=20)
    asked.add_argument("--beside", type=int, default=0, help="runs of every other method, in `paper`")
    asked.add_argument(
        "--methods", nargs="+", choices=list(METHODS)[1:], default=list(METHODS)[1:], help="those beside"
    )
    given = asked.parse_args()
    if given.what == "speed":
        speed(given.peer)
    elif given.what == "cost":
        cost()
    elif given.what == "paper":
        paper(given.runs, given.beside, given.methods)
    elif given.what == "coverage":
        coverage(given.runs)
    elif given.what == "presence":
        yes_and_no(given.runs)
    else:
        calibration(given.runs)
