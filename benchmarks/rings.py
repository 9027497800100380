"""Tags that stand still, heard by a few receivers only: places far from Gaussian, and what is not heard.

    uv run python benchmarks/rings.py --runs 20 [--methods map,collapsed,particle-gibbs] [--kind truncated]

Eight receivers of known place hear `TAGS` tags of unknown place; the exponent, shared by all, is a bias. A tag that one
receiver hears stands anywhere on a ring, one that two hear on either side of their line. The posterior of the exponent
is computed by quadrature over exponent and place (a grid of `GRID` cells an axis) and by the methods, with the floor
modelled and without. Kinds: `censored` (who hears nothing says so), `truncated` (one to four receivers listen to each
tag until they have heard it `READINGS` times), and `dropped` (as censored, but rows below the floor are missing, and
the fit takes them as truncated). Seeds are the run numbers.
"""

import argparse
import time

import jax.numpy as jnp
import numpy as np
import pandas as pd
from scipy.special import log_ndtr, logsumexp, ndtr, ndtri

import probcal as pc
import probcal.rss

PLACES = [
    (0.0, 0.0),
    (60.0, -10.0),
    (120.0, 0.0),
    (130.0, 60.0),
    (115.0, 110.0),
    (60.0, 100.0),
    (0.0, 105.0),
    (-10.0, 50.0),
]
TAGS, READINGS = 24, 4
POWER, NOMINAL, SCALE, STD, FLOOR = -40.0, 2.5, 0.5, 5.0, -82.0
CENTRE, SPREAD = np.array([60.0, 50.0]), 40.0
GRID, EXPONENTS = 400, 31


def receiver(noise):
    """Level of a tag whose power is known, over the logarithm of its distance."""

    @pc.sensor(level=pc.Channel("dB", std=STD, noise=noise))
    def radio(target, pose, *, exponent=pc.Bias("1", SCALE, nominal=NOMINAL, shared="type")):
        squared = jnp.sum((target.position - pose.position) ** 2) + 1.0
        return dict(level=POWER - 5.0 * exponent * jnp.log10(squared))

    return radio


def network(noise, names):
    """The receivers of these names, at known places."""
    kind = receiver(noise)
    return pc.Network([kind.on(pc.Node(f"r{k}", place)) for k, place in enumerate(PLACES) if f"r{k}" in names])


def motion():
    """Tags with a prior of place."""
    return {f"t{k}": pc.Target(pc.Static(), {"position": (tuple(CENTRE), SPREAD)}) for k in range(TAGS)}


def simulated(run, kind):
    """Table, true exponent and levels (TAGS, receivers, READINGS) of a run, NaN where nobody listened."""
    rng = np.random.default_rng(run)
    exponent = NOMINAL + SCALE * rng.standard_normal()
    places = CENTRE + SPREAD * rng.standard_normal((TAGS, 2))
    squared = ((places[:, None] - np.array(PLACES)) ** 2).sum(2) + 1.0
    mean = (POWER - 5.0 * exponent * np.log10(squared))[..., None]
    if kind == "truncated":
        above = rng.uniform(size=(TAGS, len(PLACES), READINGS)) * ndtr((mean - FLOOR) / STD)
        drawn = mean - STD * ndtri(above)
        listens = rng.permuted(np.tile(np.arange(len(PLACES)), (TAGS, 1)), axis=1) < rng.integers(1, 5, (TAGS, 1))
        drawn[~listens] = np.nan
    else:
        drawn = mean + STD * rng.standard_normal((TAGS, len(PLACES), READINGS))
    t, n, r = np.indices(drawn.shape)
    table = dict(time=r.ravel() * 1.0, sensor=[f"r{k}" for k in n.ravel()], target=[f"t{k}" for k in t.ravel()])
    frame = pd.DataFrame(table | {"level": np.maximum(drawn.ravel(), FLOOR)}).dropna()
    if kind == "dropped":
        frame = frame[frame["level"] > FLOOR]
    return frame.reset_index(drop=True), exponent, drawn


def quadrature(drawn, kind):
    """Mean and sd of the exponent, places integrated on a grid, and the share of tags that two or fewer hear."""
    axis = [np.linspace(c - 4 * SPREAD, c + 4 * SPREAD, GRID) for c in CENTRE]
    grid = np.stack(np.meshgrid(*axis, indexing="ij"), -1).reshape(-1, 2)
    prior = -0.5 * ((grid - CENTRE) ** 2).sum(1)[:, None] / SPREAD**2
    lost = 5.0 * np.log10(((grid[:, None] - np.array(PLACES)) ** 2).sum(2) + 1.0)
    heard = drawn > FLOOR
    count, unheard = heard.sum(2).T, (drawn <= FLOOR).sum(2).T
    first = np.where(heard, drawn, 0.0).sum(2).T
    seen = (count.sum(0) > 0) | (kind == "censored")
    values = np.linspace(NOMINAL - 3 * SCALE, NOMINAL + 3 * SCALE, EXPONENTS)
    for _ in range(2):  # the second time over what the first left
        log_p = []
        for value in values:
            mean = POWER - value * lost
            told = prior + (mean @ first - 0.5 * mean**2 @ count) / STD**2
            if kind == "truncated":
                told -= log_ndtr((mean - FLOOR) / STD) @ count
            else:
                told += log_ndtr((FLOOR - mean) / STD) @ unheard
            each = logsumexp(told[:, seen], axis=0)
            if kind == "dropped":  # of a tag that nobody heard nobody knows
                silent = np.minimum(np.exp(READINGS * log_ndtr((FLOOR - mean) / STD).sum(1)), 1.0 - 1e-15)
                each = each - logsumexp(prior[:, 0] + np.log1p(-silent))
            log_p.append(each.sum() - 0.5 * ((value - NOMINAL) / SCALE) ** 2)
        p = np.exp(np.array(log_p) - max(log_p))
        p /= p.sum()
        mean = p @ values
        sd = max(np.sqrt(p @ (values - mean) ** 2), np.diff(values)[0] / 2)
        values = np.linspace(mean - 5 * sd, mean + 5 * sd, EXPONENTS)
    return mean, sd, ((count > 0).sum(0) <= 2)[seen].mean()


METHODS = {
    "map": lambda: pc.MAP(),
    "collapsed": lambda: pc.Collapsed(warmup=300, draws=400, chains=2),
    "particle-gibbs": lambda: pc.ParticleGibbs(particles=pc.Particles(200), warmup=200, draws=400, chains=2),
}
WORDS = {pc.noise.Normal: ", all is heard", pc.Censored: ", silent rows put back"}


def main():
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--methods", default="map")
    parser.add_argument("--kind", choices=("truncated", "censored", "dropped"), default="truncated")
    chosen = parser.parse_args()
    family = (pc.Censored if chosen.kind == "censored" else pc.Truncated)(FLOOR)
    whole = pc.Censored(FLOOR, blanks=True)
    noises = (family, pc.noise.Normal(), *((whole,) if chosen.kind == "dropped" else ()))
    found = {}
    few = []
    for run in range(chosen.runs):
        table, true, drawn = simulated(run, chosen.kind)
        mean, sd, alone = quadrature(drawn, chosen.kind)
        few.append(alone)
        found.setdefault("quadrature", []).append((mean, sd, mean - 1.598 * sd, mean + 1.598 * sd, true, mean, sd, 0.0))
        there = set(table["target"])
        targets = {name: target for name, target in motion().items() if name in there}
        for name in chosen.methods.split(","):
            for noise in noises:
                label = name + ("" if noise is family else WORDS[type(noise)])
                rows = table[table["level"] > FLOOR] if isinstance(noise, pc.noise.Normal) else table
                if noise is whole:
                    rows = pc.rss.with_silence(rows, network(noise, {f"r{k}" for k in range(len(PLACES))}))
                used = {n: t for n, t in targets.items() if n in set(rows["target"])}
                begun = time.perf_counter()
                tree = pc.fit(
                    pc.Problem(network(noise, set(rows["sensor"])), used, rows),
                    METHODS[name](),
                    prior=pc.Gaussian(),
                    key=run,
                )
                took = time.perf_counter() - begun
                group = tree["calibration"].to_dataset().isel(bias_label=0)
                low, high = (float(group[k]) for k in ("lower", "upper"))
                at = NOMINAL if abs(float(group["mean"])) < NOMINAL / 2 else 0.0
                value = float(group["mean"]) + at
                found.setdefault(label, []).append(
                    (value, float(group["sd"]), low + at, high + at, true, mean, sd, took)
                )
                print(
                    run,
                    label,
                    tree.attrs["status"],
                    f"{value:.3f} {float(group['sd']):.3f} for {mean:.3f} {sd:.3f}, true {true:.3f}",
                    flush=True,
                )
    print(
        f"\n{chosen.kind}, {chosen.runs} runs, {100 * np.mean(few):.0f} % of the tags heard by one or two receivers\n"
    )
    print("| by | off | rms z | 89 % hold | from quadrature, its sds | sd over that of quadrature | s |")
    print("|---|---|---|---|---|---|---|")
    for label, rows in found.items():
        value, sd, low, high, true, mean, own, took = np.array(rows).T
        print(
            f"| {label} | {np.mean(value - true):+.3f} | {np.sqrt(np.mean(((value - true) / sd) ** 2)):.2f} |"
            f" {np.mean((low < true) & (true < high)):.2f} | {np.mean((value - mean) / own):+.2f} ±"
            f" {np.std((value - mean) / own):.2f} | {np.mean(sd / own):.2f} | {np.median(took):.1f} |"
        )


if __name__ == "__main__":
    main()
