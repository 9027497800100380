"""What a fit is worth: exact on linear networks, right under the true model, and by name where something is wrong."""

import sys
from pathlib import Path

import arviz as az
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
import reference
from scipy import stats
from test_exact import CASES, resting

import probcal
from probcal import (
    EA,
    MAP,
    Bias,
    Channel,
    ConstantVelocity,
    Flat,
    InputError,
    Network,
    Node,
    Target,
    sensor,
    simulate,
)
from probcal.analysis import leave, pieces, residuals
from probcal.analysis.assess import assess
from probcal.analysis.fitted import take_up
from probcal.geometry import bearing, norm
from probcal.priors import Gaussian

DATA = Path(__file__).parents[2] / "shared" / "data"
sys.path.insert(0, str(Path(__file__).parents[1] / "models"))
import sflab  # noqa: E402

TOLERANCE = 1e-8


class Tagged(reference.Linear):
    """The naive linear problem that remembers whose each datum is, and when."""

    def __init__(self, *arguments):
        self.sensors, self.times = [], []
        super().__init__(*arguments)

    def _add(self, placed, row, k, epoch):
        before = len(self.data)
        super()._add(placed, row, k, epoch)
        self.sensors += [placed.name] * (len(self.data) - before)
        self.times += [row["time"]] * (len(self.data) - before)

    def only(self, kept):
        """The evidence of some data alone."""
        every, self.data = self.data, [d for d, k in zip(self.data, kept, strict=True) if k]
        try:
            return reference.dense(self, np.ones(len(self.labels)))
        finally:
            self.data = every

    def regression(self):
        """Data as y = G z + e: G (D, M), covariance V of e (states integrated out), and y less its offset."""
        M, every, self.data = len(self.labels), self.data, []
        prior = reference.dense(self, None, hold=np.zeros(M))
        self.data = every
        starts = np.cumsum([0, *(len(c.names) * len(c.times) for c in self.chains)])
        A = np.zeros((len(every), len(prior.mean) - M))
        for row, d in zip(A, every, strict=True):
            n = len(self.chains[d.chain].names)
            first = starts[d.chain] + n * d.epoch
            row[first : first + n] = d.H
        V = A @ prior.covariance[M:, M:] @ A.T + np.diag([d.std**2 for d in every])
        y = np.array([d.y - d.offset for d in every]) - A @ prior.mean[M:]
        return np.array([d.G for d in every]), V, y


def fitted(name, method=None, **options):
    network, motion, table, fixed = CASES[name]()
    problem = probcal.Problem(network, motion, table, fix=fixed)
    tree = probcal.fit(problem, method or MAP(), start=resting(problem), **options)
    return problem, tree, Tagged(network, motion, table, fixed)


@pytest.fixture(scope="module", params=["plane", "mixed"])
def linear(request):
    problem, tree, naive = fitted(request.param, predictive_draws=request.param == "plane")
    return problem, tree, naive, assess(problem, tree)


def test_innovations_are_those_of_a_loop_filter(linear):
    """NIS of every epoch, the biases held at the fit; and the degrees of freedom that they used."""
    problem, tree, naive, out = linear
    z = tree["calibration"]["mean"].to_series() / tree["calibration"]["scale"].to_series()
    z = z[naive.labels].to_numpy()
    check = out["datum_check"].to_dataset()
    square = (check["innovation"] ** 2).to_dataframe().groupby(["target", "time"])["innovation"].sum()
    for k, chain in enumerate(naive.chains):
        m, P, total = np.zeros(len(chain.names)), np.zeros((len(chain.names),) * 2), 0.0
        for e, (F, c, Q) in enumerate(chain.steps):
            m, P, nis = F @ m + c, F @ P @ F.T + Q, 0.0
            for d in naive.data:
                if (d.chain, d.epoch) == (k, e):
                    S, r = d.H @ P @ d.H + d.std**2, d.y - d.offset - d.G @ z - d.H @ m
                    gain = P @ d.H / S
                    m, P, nis = m + gain * r, P - np.outer(gain, d.H @ P), nis + r**2 / S
            total += nis
            if len(chain.times) > 1:
                expected = square.get((chain.target, chain.times[e]), 0.0)
                assert nis == pytest.approx(expected, rel=TOLERANCE, abs=1e-9)
        assert total == pytest.approx(square[chain.target].sum(), rel=TOLERANCE)
    assert check.attrs["used"] == pytest.approx(float(tree["calibration"]["gamma"].sum()), rel=1e-10)
    epochs = out["epoch_check"].to_dataset()
    counted = sum(int(epochs[name].sum()) for name in epochs.data_vars if str(name).startswith("data"))
    assert counted == len(naive.data)


def test_a_sensor_left_out_has_the_exact_predictive_density(linear):
    """elpd and elpd as stated against dense evidences; the NIS given the rest against the dense prediction."""
    problem, tree, naive, out = linear
    network, motion, table, fixed = CASES[
        "plane" if "plane" in str(problem.labels) or "a.position_x" in problem.labels else "mixed"
    ]()
    G, V, y = naive.regression()
    C = G @ G.T + V
    whole = naive.only(np.ones(len(naive.data), bool)).evidence
    check = out["sensor_check"].to_dataset()
    owner = np.array(naive.sensors)
    for name in check["sensor"].values:
        mine, one = owner == name, check.sel(sensor=name)
        rest = naive.only(~mine).evidence
        assert float(one["elpd"]) == pytest.approx(whole - rest, rel=TOLERANCE)
        gain = np.linalg.solve(C[np.ix_(~mine, ~mine)], C[np.ix_(~mine, mine)]).T
        ahead = y[mine] - gain @ y[~mine]
        S = C[np.ix_(mine, mine)] - gain @ C[np.ix_(~mine, mine)]
        assert float(one["rest_nis"]) == pytest.approx(ahead @ np.linalg.solve(S, ahead) / mine.sum(), rel=TOLERANCE)
        used = (G != 0)[mine].any(0) & ~(G != 0)[~mine].any(0)
        held = fixed | {label: 0.0 for label, own in zip(naive.labels, used, strict=True) if own}
        stated = reference.dense(Tagged(network, motion, table, held), np.ones(len(naive.labels) - used.sum())).evidence
        assert float(one["elpd_stated"]) == pytest.approx(stated - rest, rel=TOLERANCE)
    assert np.isfinite(check.to_dataframe().to_numpy(float)).all()
    assert check.attrs["refits"] == "full"


def test_one_step_refits_agree_on_a_linear_problem(linear, monkeypatch):
    problem, tree, _, out = linear
    monkeypatch.setattr(leave, "WORK", 0.0)
    again = assess(problem, tree)["sensor_check"].to_dataset()
    assert again.attrs["refits"] == "one step"
    for name in ("elpd", "rest_nis", "elpd_stated", "stated_nis"):
        np.testing.assert_allclose(again[name], out["sensor_check"][name], rtol=TOLERANCE)


def test_the_change_between_pieces_is_generalised_least_squares(linear):
    """Each bias alone, and beside another that changes, against a dense regression."""
    problem, tree, naive, _ = linear
    times = np.unique(naive.times)
    G, V, y = naive.regression()
    solve = np.linalg.inv(V)
    edge, last = times[len(times) // 3], times[2 * len(times) // 3]
    labels = [naive.labels.index(label) for label in problem.labels]
    G = G[:, labels]
    when = np.digitize(naive.times, [edge, last])

    def regress(free):
        """Values of pieces, piece by piece, of the free biases, all others common with unit prior."""
        held = [m for m in range(G.shape[1]) if m not in free]
        X = np.concatenate([G[:, held], *(G[:, [m]] * (when == p)[:, None] for m in free for p in range(3))], 1)
        K = X.T @ solve @ X + np.diag([1.0] * len(held) + [0.0] * 3 * len(free))
        mean, covariance = np.linalg.lstsq(K, X.T @ solve @ y)[0], np.linalg.pinv(K)
        D = np.zeros((2, X.shape[1]))
        D[:, -3], D[0, -2], D[1, -1] = -1.0, 1.0, 1.0
        return D @ mean, D @ covariance @ D.T

    with jax.enable_x64(True):
        fit = take_up(problem, tree)
        piece = np.digitize(problem.measurements.time, [edge, last])
        three = pieces.divide(fit, piece, 3)
    found = pieces.contrasts(three)
    assert len(found) >= 4
    for m, contrast in found.items():
        change, covariance = regress([m])
        np.testing.assert_allclose(contrast.estimate, change, rtol=0, atol=TOLERANCE * np.abs(change).max())
        inverse = np.linalg.inv(contrast.information)
        np.testing.assert_allclose(inverse, covariance, rtol=0, atol=TOLERANCE * np.abs(covariance).max())
    first = min(found)
    for m, contrast in pieces.contrasts(three, [first]).items():
        change, _ = regress([first, m])
        np.testing.assert_allclose(contrast.estimate, change, rtol=0, atol=1e-6 * max(np.abs(change).max(), 1.0))
    halves = pieces.merged(three, [0, 1, 1])
    with jax.enable_x64(True):
        directly = pieces.divide(fit, (piece > 0).astype(int), 2)
    np.testing.assert_allclose(halves.information, directly.information, atol=1e-9 * np.abs(halves.information).max())
    np.testing.assert_allclose(halves.score, directly.score, atol=1e-9 * np.abs(halves.score).max())


def test_psis_is_that_of_arviz(linear):
    _, tree, _, out = linear
    if "log_likelihood" not in tree.children:
        assert "elpd" not in out["datum_check"].data_vars
        return
    count = tree["observed_data"].sizes["datum"]
    with pytest.warns(UserWarning, match="Pareto"):
        found = az.loo(tree, pointwise=True, reff=1.0)
    mine = leave.psis(tree, np.arange(count), count)
    np.testing.assert_allclose(mine.elpd, found.elpd_i.values, rtol=1e-12)
    np.testing.assert_allclose(mine.pareto_k, found.pareto_k.values, rtol=1e-12)
    assert leave.standard_error(mine.elpd) == pytest.approx(found.se, rel=1e-12)
    assert leave.good_k(tree) == pytest.approx(found.good_k)
