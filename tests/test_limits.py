"""What a receiver does not hear: censored and truncated noise, against quadrature, in tables, in fits."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from scipy import optimize, stats

import probcal
from probcal import (
    Bias,
    Censored,
    Channel,
    Gaussian,
    InputError,
    Known,
    Network,
    Node,
    Problem,
    Truncated,
    Unknown,
    fit,
    sensor,
    simulate,
)
from probcal.geometry import norm

FLOOR, STD = -2.0, 0.7
PREDICTED = np.array([-12.0, -4.0, -2.3, -1.0, 1.0, 9.0])
FINE = np.union1d(FLOOR + np.geomspace(1e-9, 22.0, 100_000), np.linspace(FLOOR + 1e-3, 20.0, 300_001))


@partial(jax.jit, static_argnums=0)
def answers(family, y, m, s):
    """Log density, its slope, curvature and one plus its slope by the level; then what the family says of these."""

    def density(m, s):
        return family.log_likelihood(y, m, s, None)

    def slope(m):
        return jax.jvp(lambda m: density(m, s), (m,), (jnp.ones_like(m),))[1]

    by_level = jax.jvp(lambda s: density(m, s), (s,), (s,))[1]
    bent = jax.jvp(slope, (m,), (jnp.ones_like(m),))[1]
    own = (family.score(y, m, s, None), family.weight(y, m, s, None), family.level_score(y, m, s, None))
    return density(m, s), slope(m), bent, 1 + by_level, *own, family.information(m, s)


def values(family, y, predicted):
    """`answers` of values y (N,) about one predicted value."""
    with jax.enable_x64(True):
        return [np.asarray(part) for part in answers(family, y, np.full(len(y), predicted), np.full(len(y), STD))]


@partial(jax.jit, static_argnums=0)
def draws(family, key, m, s):
    """Values as they are weighed, and what reaches the receiver."""
    return family.sample(key, m, s), family.emit(key, m, s)


@pytest.mark.parametrize("family", [Censored(FLOOR), Truncated(FLOOR)], ids=repr)
@pytest.mark.parametrize("predicted", PREDICTED)
def test_limits_agree_with_their_density(family, predicted):
    """Score, curvature and information follow from a density that, with what is not heard, integrates to one."""
    told, slope, bent, level, score, weight, level_score, information = values(family, FINE, predicted)
    np.testing.assert_allclose(score, slope, atol=1e-7, rtol=1e-7)
    np.testing.assert_allclose(weight, np.maximum(-bent, 1e-9 / STD**2), atol=1e-5, rtol=1e-5)
    np.testing.assert_allclose(level_score, level, atol=1e-7, rtol=1e-7)
    p, expected = np.exp(told), slope**2
    mass, square = np.trapezoid(p, FINE), np.trapezoid(p * expected, FINE)
    if isinstance(family, Censored):
        nothing = values(family, np.array([FLOOR, FLOOR - 5.0]), predicted)
        np.testing.assert_allclose(nothing[4], nothing[1], atol=1e-9, rtol=1e-9)
        np.testing.assert_allclose(nothing[5], np.maximum(-nothing[2], 1e-9 / STD**2), atol=1e-6, rtol=1e-6)
        np.testing.assert_allclose(nothing[6], nothing[3], atol=1e-9, rtol=1e-9)
        mass, square = mass + np.exp(nothing[0][0]), square + np.exp(nothing[0][0]) * nothing[1][0] ** 2
    assert mass == pytest.approx(1.0, abs=1e-4)
    assert information[0] == pytest.approx(max(square, 1e-9 / STD**2), rel=2e-3, abs=1e-8)


@pytest.mark.parametrize("predicted", [-12.0, -4.0, -1.0, 3.0])
def test_limits_are_drawn_as_they_are_weighed(predicted):
    """Empirical probabilities of 100,000 draws: sd at most 0.0016, limit five of them."""
    count, key = 100_000, jax.random.key(1)
    with jax.enable_x64(True):
        around = np.full(count, predicted), np.full(count, STD)
        heard, emitted = (np.asarray(part) for part in draws(Truncated(FLOOR), key, *around))
        told = np.asarray(draws(Censored(FLOOR), key, *around)[0])
    assert np.isfinite(heard).all()
    assert (heard > FLOOR).all()
    p = np.exp(values(Truncated(FLOOR), FINE, predicted)[0])
    total = np.concatenate([[0.0], np.cumsum(0.5 * (p[1:] + p[:-1]) * np.diff(FINE))])
    for q in (0.1, 0.5, 0.9):
        edge = FINE[np.searchsorted(total, q)]
        assert (heard < edge).mean() == pytest.approx(q, abs=0.008)
    share = float(np.exp(values(Censored(FLOOR), np.array([FLOOR]), predicted)[0][0]))
    assert (told == FLOOR).mean() == pytest.approx(share, abs=0.008)
    np.testing.assert_array_equal(np.isnan(Truncated(FLOOR).reported(emitted)), emitted <= FLOOR)


HEARS = -72.0
PLACES = [(0.0, 0.0), (60.0, 10.0), (20.0, 45.0), (70.0, 60.0)]


def radio(noise, std=2.0):
    """A receiver of levels in dB whose exponent is not known: 10 n log10 of the distance are lost."""

    @sensor(level=Channel("dB", std=std, noise=noise))
    def receiver(target, pose, *, offset=Bias("dB", 2.0), exponent=Bias("1", 0.5)):
        distance = jnp.maximum(norm(target.position - pose.position), 1.0)
        return dict(level=-40.0 - 10.0 * (2.0 + exponent) * jnp.log10(distance) + offset)

    return receiver


def heard(noise, run):
    """Receivers, a walk that is known, and what they tell of it."""
    network = Network([radio(noise).on(Node(f"r{k}", p)) for k, p in enumerate(PLACES)])
    time = np.arange(60.0)
    walk = Known((time, np.stack([5 + 1.2 * time, 25 + 15 * np.sin(time / 9.0)], 1)))
    drawn = np.random.default_rng(run)
    biases = {b.label: float(b.scale * drawn.standard_normal()) for b in network.biases}
    return network, walk, simulate(network, walk, time, key=run, biases=biases)


def test_a_floor_above_zero_is_simulated():
    """Decibels above 20 micropascal are positive numbers."""

    @sensor(level=Channel("dB", std=2.0, noise=Truncated(60.0)))
    def loud(target, pose, *, offset=Bias("dB", 2.0)):
        return dict(level=100.0 - 20.0 * jnp.log10(norm(target.position - pose.position)) + offset)

    time = np.arange(20.0)
    network = Network([loud.on(Node("a", (0.0, 0.0)))])
    run = simulate(network, Known((time, np.stack([20 + 10 * time, 0 * time], 1))), time, key=0)
    assert run.table["level"].min() > 60.0
    assert len(run.table) < 20


def likeliest(run, kind):
    """Offset and exponent of every receiver by scipy, from the densities as they stand in a textbook."""
    found = {}
    for k, place in enumerate(PLACES):
        rows = run.table[run.table["sensor"] == f"r{k}"]
        t, y = rows["time"].to_numpy(), rows["level"].to_numpy()
        lost = 10 * np.log10(np.maximum(np.hypot(5 + 1.2 * t - place[0], 25 + 15 * np.sin(t / 9.0) - place[1]), 1.0))

        def cost(b, y=y, lost=lost):
            mean = -40.0 - (2.0 + b[1]) * lost + b[0]
            below, each = stats.norm.logcdf((HEARS - mean) / 2.0), stats.norm.logpdf(y, mean, 2.0)
            each = np.where(y <= HEARS, below, each) if kind is Censored else each - stats.norm.logsf(HEARS, mean, 2.0)
            return 0.5 * (b[0] / 2.0) ** 2 + 0.5 * (b[1] / 0.5) ** 2 - each.sum()

        best = optimize.minimize(cost, np.zeros(2), method="Nelder-Mead", options={"xatol": 1e-8, "fatol": 1e-10})
        found |= {f"r{k}.offset": best.x[0], f"r{k}.exponent": best.x[1]}
    return found


@pytest.mark.slow
@pytest.mark.parametrize("noise", [Censored(HEARS), Truncated(HEARS)], ids=repr)
def test_what_is_not_heard_is_simulated_and_fitted(noise):
    """Rows below the floor are limits, or gone; the mode is that of scipy, and without the floor it is elsewhere."""
    network, motion, run = heard(noise, 3)
    if isinstance(noise, Censored):
        assert len(run.table) == 240
        assert (run.table["level"] == HEARS).mean() > 0.1
    else:
        assert len(run.table) < 230
    assert run.table["level"].min() >= HEARS
    tree = fit(Problem(network, motion, run.table), probcal.MAP(), prior=Gaussian())
    assert tree.attrs["status"] == "converged", tree.attrs["message"]
    group, best = tree["calibration"].to_dataset(), likeliest(run, type(noise))
    sd = group["sd"].values
    away = group["mean"].values - np.array([best[label] for label in group["bias_label"].values])
    assert np.abs(away / sd).max() < 0.02
    plain = Network([radio(probcal.noise.Normal()).on(node) for node in network.nodes])
    deaf = Problem(plain, motion, run.table[run.table["level"] > HEARS])
    naive = fit(deaf, probcal.MAP(), prior=Gaussian())["calibration"]["mean"].values
    assert np.abs((naive - group["mean"].values) / sd).max() > 1.0


@pytest.mark.slow
@pytest.mark.parametrize("kind", [Censored, Truncated])
def test_intervals_hold_where_little_is_heard(kind):
    """40 runs of 8 biases: nominal 0.89, limit four standard errors of the mean share."""
    held = []
    for run in range(40):
        network, motion, simulated = heard(kind(HEARS), run)
        there = [placed for placed in network.sensors if placed.name in set(simulated.table["sensor"])]
        network = Network(there)  # a receiver that heard nothing has no row
        group = fit(Problem(network, motion, simulated.table), probcal.MAP(), prior=Gaussian(), key=run)["calibration"]
        true = np.array([simulated.truth.biases[label] for label in group["bias_label"].values])
        held.append(((group["lower"].values < true) & (true < group["upper"].values)).mean())
    assert abs(np.mean(held) - 0.89) < 4 * np.std(held, ddof=1) / np.sqrt(40)


@pytest.mark.parametrize("kind", [Censored, Truncated])
def test_an_unknown_floor_is_found_in_the_table(kind):
    """The least value that was heard, less half of the step to which values are rounded; or the highest limit."""
    network, motion, run = heard(kind(HEARS), 3)
    other = Network([radio(kind()).on(node) for node in network.nodes])
    table = run.table[run.table["level"] > HEARS]
    noise = Problem(other, motion, table).network.types[0].channels["level"].noise
    assert isinstance(noise, kind)
    assert HEARS < noise.floor < HEARS + 0.3
    assert noise.floor < table["level"].min()
    rounded = Problem(other, motion, table.assign(level=np.round(table["level"]))).network
    assert rounded.types[0].channels["level"].noise.floor == np.round(table["level"]).min() - 0.5
    assert rounded.types[0] == rounded.sensors[-1].type
    if kind is Censored:
        told = run.table.assign(level=run.table["level"].astype(object).where(run.table["level"] > HEARS, "<-72"))
        problem = Problem(other, motion, told)
        assert problem.network.types[0].channels["level"].noise == Censored(HEARS)
        np.testing.assert_allclose(problem.measurements.value, Problem(network, motion, run.table).measurements.value)
        blank = Network([radio(Censored(blanks=True)).on(node) for node in network.nodes])
        silent = run.table.assign(level=run.table["level"].where(run.table["level"] > HEARS))
        assert Problem(blank, motion, silent).measurements.measured.all()
    with pytest.raises(InputError, match="a floor is found in a table, here is none"):
        simulate(other, motion, np.arange(60.0), key=0)


@pytest.mark.ci
def test_an_unknown_noise_level_is_found_among_limits():
    network, motion, run = heard(Censored(HEARS), 5)
    unknown = Network([radio(Censored(HEARS), Unknown(4.0)).on(node) for node in network.nodes])
    tree = fit(Problem(unknown, motion, run.table), probcal.MAP(), prior=Gaussian())
    assert float(tree["level"]["std"][0]) == pytest.approx(2.0, rel=0.2)  # 2 is true; sd about 6 %


def test_cells_below_a_limit_are_read(tmp_path):
    """`<-72` in a file, a value at the floor, and a blank where blanks tell, are one and the same."""
    network, motion, run = heard(Censored(HEARS), 3)
    path = tmp_path / "levels.csv"
    table = run.table.copy()
    low = table["level"] <= HEARS
    table["level"] = table["level"].astype(object).where(~low, "<-72")
    table.to_csv(path, index=False)
    text, number = (Problem(network, motion, data).measurements for data in (path, run.table))
    np.testing.assert_allclose(text.value, number.value)
    silent = Network([radio(Censored(HEARS, blanks=True)).on(node) for node in network.nodes])
    blank = Problem(silent, motion, table.assign(level=pd.to_numeric(run.table["level"].where(~low)))).measurements
    np.testing.assert_allclose(blank.value, number.value)
    assert blank.measured.all()


@pytest.mark.needs("rss")
def test_who_listened_and_heard_nothing_gets_a_row():
    """What falls silent is put back, but for times at which nobody heard anything; a column without rows stays."""
    network, motion, run = heard(Censored(HEARS), 3)
    listening = Network([radio(Censored(HEARS, blanks=True)).on(node) for node in network.nodes])
    log = run.table[run.table["level"] > HEARS]
    from probcal.rss import with_silence

    whole = with_silence(log, listening)
    known = run.table[run.table["time"].isin(log["time"])]
    assert len(log) < len(whole) == len(known)
    left, right = (Problem(network_, motion, t.sort_values(["time", "sensor"])).measurements
                   for network_, t in ((listening, whole), (network, known)))  # fmt: skip
    np.testing.assert_array_equal(left.value, right.value)
    name = whole["sensor"][whole["level"].isna()].iloc[0]
    some = with_silence(log, listening, listens=[name])
    assert set(some["sensor"][some["level"].isna()]) == {name}
    assert len(with_silence(whole, listening)) == len(whole)
    with pytest.raises(InputError, match=r"with_silence: no channel has noise=Censored\(floor, blanks=True\)"):
        with_silence(log, network)
    with pytest.raises(InputError, match=r'with_silence: listens "r9".* is no receiver with a floor'):
        with_silence(log, listening, listens=["r9"])
    with pytest.raises(InputError, match='with_silence: the table lacks "time"'):
        with_silence(log.drop(columns="time"), listening)


COMPLAINTS = [
    (Censored(-72.0), "<-60", r'row 3 column "level": "<-60" lies above the floor -72 of its channel'),
    (probcal.noise.Normal(), "<-72", r'row 3 column "level": "<-72" is a limit, but the channel hears all'),
    (Truncated(-72.0), -80.0, r'row 3 column "level": -80 does not suit Truncated\(floor=-72.0\); leave it blank'),
    (Censored(-72.0), "<low", r'row 3 column "level": "low" is no number'),
]


@pytest.mark.parametrize(("noise", "cell", "text"), COMPLAINTS)
def test_limits_that_cannot_be_are_refused(noise, cell, text):
    network, motion, run = heard(Censored(HEARS), 3)
    other = Network([radio(noise).on(node) for node in network.nodes])
    table = run.table[run.table["level"] > HEARS].reset_index(drop=True).astype({"level": object})
    table.loc[3, "level"] = cell
    with pytest.raises(InputError, match=text):
        Problem(other, motion, table)
    with pytest.raises(InputError, match="an angle has no least value"):
        Channel("rad", noise=Censored(0.0), wrap=True)
    with pytest.raises(InputError, match="give the least value that is heard"):
        Truncated(float("nan"))
