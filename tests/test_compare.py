"""Fits side by side: distances against formulas, scores and predictions against numbers by hand, words, pictures."""

import arviz as az
import committed
import numpy as np
import pandas as pd
import pytest
import xarray as xr
from scipy import stats
from terminal import call

import probcal
from probcal import diagnostics
from probcal.analysis import compare, interchangeable
from probcal.analysis.compare import fits_by_name
from probcal.analysis.differences import NARROW
from probcal.analysis.overlap import ZERO, of_draws, of_gaussian, overlap, wasserstein
from probcal.cli.compare import estimates_text, methods_text
from probcal.errors import InputError
from probcal.results.schema import evidence_in

HALF = stats.norm.ppf(0.5 + 0.89 / 2)
LABELS = ("a.heading", "a.gain", "b.gain")
TRUE = {"a.heading": 0.0, "a.gain": 1.0, "b.gain": -2.0}


def synthetic(mean, sd, labels=LABELS, draws=None, truth=None, y=None, log_likelihood=None, seed=0, **attrs):
    """A tree as `fit` writes it: a Gaussian, or draws (chain, draw, bias_label) with what samplers add."""
    rng, mean, sd = np.random.default_rng(seed), np.array(mean, float), np.array(sd, float)
    lower, upper = mean - HALF * sd, mean + HALF * sd
    given = draws is not None
    if given:
        mean, sd = draws.mean((0, 1)), draws.std((0, 1))
        lower, upper = np.quantile(draws, [0.055, 0.945], axis=(0, 1))
    else:
        draws = mean + sd * rng.normal(size=(4, 250, len(mean)))
    count = len(labels)
    columns = {
        "mean": mean, "sd": sd, "lower": lower, "upper": upper, "gamma": np.full(count, 0.9), "scale": np.ones(count),
        "unit": np.full(count, "m"), "status": np.full(count, "estimated", "<U12"),
    }  # fmt: skip
    coords = {"chain": range(draws.shape[0]), "draw": range(draws.shape[1]), "bias_label": list(labels)}
    posterior = {"bias": (("chain", "draw", "bias_label"), draws)}
    groups = {}
    if given:
        columns |= {"r_hat": np.full(count, 1.002), "ess": np.full(count, 500.0), "inclusion": np.full(count, 0.3)}
        gamma = rng.uniform(0.2, 0.5, draws.shape)
        posterior["gamma"] = (("chain", "draw", "bias_label"), gamma)
        columns["gamma"] = gamma.mean((0, 1))
        groups["sample_stats"] = xr.Dataset({"diverging": (("chain", "draw"), np.zeros(draws.shape[:2], bool))})
    calibration = {name: ("bias_label", value) for name, value in columns.items()}
    calibration["covariance"] = (("bias_label", "bias_label_other"), np.diag(sd**2))
    y = np.arange(6.0) if y is None else y
    datum = {"row": ("datum", np.arange(len(y))), "channel": ("datum", np.full(len(y), "range"))}
    groups |= {
        "posterior": xr.Dataset(posterior, coords),
        "calibration": xr.Dataset(calibration, {"bias_label": list(labels), "bias_label_other": list(labels)}),
        "observed_data": xr.Dataset({"y": ("datum", y)}, datum),
    }
    if truth is not None:
        groups["truth"] = xr.Dataset({"bias": ("bias_label", list(truth.values()))}, {"bias_label": list(truth)})
    if log_likelihood is not None:
        groups["log_likelihood"] = xr.Dataset({"y": (("chain", "draw", "datum"), log_likelihood)}, datum)
    tree = xr.DataTree.from_dict(groups)
    tree.attrs |= {"method": "EA", "prior": "ARD", "status": "converged", "message": "", "settings": "EA()",
                   "intervals": "plug-in", "interval_probability": 0.89, "approximate": "exact" if given else "Laplace",
                   "precisions": "sampled" if given else "maximised"} | attrs  # fmt: skip
    return tree


def drawn(mean, sd, seed=1, size=(4, 1000)):
    return np.array(mean) + np.array(sd) * np.random.default_rng(seed).normal(size=(*size, len(mean)))


def sentences(comparison, kind):
    group = comparison["finding"].to_dataset()
    return group["sentence"].values[group["kind"].values == kind].tolist()


@pytest.mark.parametrize(("shift", "sd"), [(0.0, 1.0), (0.7, 1.0), (2.0, 0.5), (3.0, 0.01)])
def test_distances_of_two_gaussians_are_their_formulas(shift, sd):
    one, other = of_gaussian(0.0, 1.0, False), of_gaussian(shift, sd, False)
    spread = abs(1.0 - sd)  # W1 is the mean of |shift + spread z|
    exact = shift
    if spread:
        ratio = shift / spread
        exact = shift * (1 - 2 * stats.norm.cdf(-ratio)) + spread * np.sqrt(2 / np.pi) * np.exp(-0.5 * ratio**2)
    assert wasserstein(one, other) == pytest.approx(exact, abs=2e-3)
    if not spread:
        area = 2 * stats.norm.cdf(-shift / 2)
    else:  # the two points of equal density
        a, b = 1 / sd**2 - 1, -2 * shift / sd**2
        low, high = np.sort(np.roots([a, b, shift**2 / sd**2 + 2 * np.log(sd)]))
        inner, outer = (stats.norm(0, 1), stats.norm(shift, sd))
        area = inner.cdf(high) - inner.cdf(low) + outer.cdf(low) + outer.sf(high)
    assert overlap(one, other) == pytest.approx(area, abs=1e-3)
    points = np.random.default_rng(0).normal(shift, sd, 4000)
    assert overlap(one, of_draws(points)) == pytest.approx(area, abs=0.04)
    assert overlap(of_draws(points), of_draws(points)) == pytest.approx(1.0, abs=1e-9)


def test_a_point_mass_at_zero_counts_as_mass():
    rng = np.random.default_rng(0)
    spike = [of_draws(np.where(rng.random(4000) < share, rng.normal(1.0, 0.2, 4000), 0.0)) for share in (0.1, 0.6, 0.0)]
    assert overlap(spike[0], spike[0]) == pytest.approx(1.0, abs=1e-9)
    assert overlap(spike[0], spike[1]) == pytest.approx(0.4 + 0.1, abs=0.03)
    assert overlap(spike[2], spike[2]) == 1.0
    pruned = of_gaussian(0.0, 1e-4, True)
    assert overlap(pruned, spike[0]) == pytest.approx(0.9, abs=0.02)
    wide = stats.norm.cdf(ZERO / 0.1) - stats.norm.cdf(-ZERO / 0.1)
    assert overlap(pruned, of_gaussian(0.0, 0.1, False)) == pytest.approx(wide, abs=1e-3)
    heavy = [of_draws(rng.standard_cauchy(4000) * 0.05 * rng.normal(size=4000)) for _ in range(2)]
    assert overlap(*heavy) > 0.9, "heavy tails do not blur the peak"
    few = np.zeros(1000)
    few[:2] = 1.0, 1.1
    assert overlap(of_draws(few), of_draws(few)) == pytest.approx(1.0, abs=1e-5)
    assert overlap(of_draws(few), pruned) == pytest.approx(0.998, abs=1e-5)


def test_equal_fits_overlap_wholly_and_lie_at_no_distance():
    tree = synthetic([0.1, 1.0, -2.0], [0.1, 0.2, 0.3], truth=TRUE)
    found = compare([tree, tree])
    assert found["estimate"]["estimator"].values.tolist() == ["EA (ARD)", "EA (ARD) 2"]
    np.testing.assert_allclose(found["pair"]["overlap"], 1.0, atol=1e-4)
    np.testing.assert_array_equal(found["pair"]["wasserstein"], 0.0)
    assert sentences(found, "enough")[0].startswith("EA (ARD) 2 agrees with EA (ARD) on 3 of 3 biases")
    assert not sentences(found, "narrow")
    assert found["method/EA (ARD)"].attrs["posterior"] == "Gaussian"
    for node in found.subtree:
        for values in node.to_dataset().data_vars.values():
            assert values.dtype.kind != "f" or np.isfinite(values).all()


def test_scores_by_hand():
    # errors 0.2, 0.5, 0.0 scales; the intervals reach 1.6 sd: the second misses
    one = synthetic([0.2, 1.5, -2.0], [0.2, 0.2, 0.3])
    found = compare({"one": one, "two": synthetic([0.0, 1.0, -2.0], [0.2, 0.2, 0.3], truth=TRUE)})
    at = found["method/one"].attrs
    assert at["bias_rmse"] == pytest.approx(np.sqrt((0.04 + 0.25) / 3))
    assert (at["covered"], at["known"], at["covered_nonzero"], at["known_nonzero"]) == (2, 3, 1, 2)
    assert (at["coverage"], at["coverage_nonzero"]) == (pytest.approx(2 / 3), 0.5)
    assert found["method/two"].attrs["coverage"] == 1.0
    assert "hold 2 of 3 true biases, 1 of the 2 that are not zero" in sentences(found, "coverage")[0]
    assert found["pair"]["wasserstein"].values[0] == pytest.approx([0.2, 0.5, 0.0], abs=1e-9)


def test_prediction_is_that_of_arviz_and_of_the_same_data_in_any_order():
    rng = np.random.default_rng(4)
    y, base = rng.normal(size=40), -1.0 + 0.1 * rng.normal(size=(4, 250, 40))
    worse = base - rng.exponential(0.5, 40)
    fits = {
        "good": synthetic([0, 0, 0], [1, 1, 1], y=y, log_likelihood=base),
        "bad": synthetic([0, 0, 0], [1, 1, 1], y=y, log_likelihood=worse, seed=2),
    }
    wanted = az.compare(fits, round_to="none")
    turned = fits | {
        "bad": fits["bad"].map_over_datasets(lambda d: d.isel(datum=slice(None, None, -1)) if "datum" in d.dims else d)
    }
    for given in (fits, turned):
        found = {name: node.attrs for name, node in compare(given)["method"].children.items()}
        for name, at in found.items():
            for mine, theirs in (("elpd", "elpd"), ("elpd_se", "se"), ("p_loo", "p"), ("elpd_difference", "elpd_diff"),
                                 ("elpd_difference_se", "dse")):  # fmt: skip
                assert at[mine] == pytest.approx(wanted.loc[name, theirs], rel=1e-9, abs=1e-9)
            assert at["bad_k"] == 0.0
    assert "good predicts better than bad by" in sentences(compare(fits), "elpd")[0]
    alone = compare({"good": fits["good"], "none": synthetic([0, 0, 0], [1, 1, 1], y=y)})
    assert "elpd" not in alone["method/none"].attrs
    assert "elpd_difference" not in alone["method/good"].attrs
    assert sentences(alone, "elpd")[0].startswith("none: no elpd, it has no finite log_likelihood")


def test_a_sampler_judges_what_evidence_approximation_found():
    centre, sd = [0.0, 1.0, -2.0], [0.3, 0.1, 0.1]
    plugged = synthetic([0.0, 1.5, -2.0], [1e-4, 0.1, 0.05], log_evidence_type_ii=-10.0, truth=TRUE)
    plugged["calibration"]["status"][0] = "pruned"
    bayes = synthetic(centre, sd, draws=drawn(centre, sd), method="NUTS", prior="Horseshoe", seconds=2.0,
                      log_evidence=-12.0, log_evidence_se=0.1, intervals="exact")  # fmt: skip
    found = compare([plugged, bayes])
    assert found.attrs["reference"] == "NUTS (Horseshoe)"
    assert "is enough for 0 of 3" in sentences(found, "enough")[0]
    assert (
        "the 89% intervals of 1 of 3 miss the mean of NUTS (Horseshoe): a.gain (1.5 against "
        in sentences(found, "interval")[0]
    )
    assert f"the sd of 1 of 3 is below {NARROW} times that" in sentences(found, "narrow")[0]
    assert "b.gain (0.5 times)" in sentences(found, "narrow")[0]
    assert (
        "1 of the 1 that it pruned are not zero to NUTS (Horseshoe), which leaves them: a.heading ("
        in (sentences(found, "pruned")[0])
    )
    assert "gamma of 3 of 3 lies above the 89% interval" in sentences(found, "gamma")[0]
    assert not sentences(found, "evidence"), "one that is maximised says nothing beside one that is integrated"
    own, theirs = found["method/NUTS (Horseshoe)"].to_dataset(), found["method/EA (ARD)"].to_dataset()
    assert not theirs.data_vars
    assert set(own.data_vars) == {"inclusion", "r_hat", "ess", "gamma_lower", "gamma_upper"}
    assert own.attrs["ess_per_second"] == 250.0
    table = diagnostics.comparison_rows(found)
    assert not table.isna().any().any()
    row = table[
        (table["method"] == "NUTS (Horseshoe)") & (table["quantity"] == "inclusion") & (table["bias"] == "a.heading")
    ]
    assert row["value"].tolist() == [0.3]
    text = methods_text(found)
    assert "-12.0 ± 0.1" in text
    assert "nan" not in text + estimates_text(found)
    bayes["calibration"]["r_hat"][1] = 1.2
    bayes["sample_stats"]["diverging"][0, 0] = True
    doubts = sentences(compare([plugged, bayes]), "sampling")
    assert "r_hat of a.gain is 1.200, its chains disagree; draw more" in doubts[0]
    assert "1 of its transitions diverged" in doubts[1]
    plugged.attrs["status"] = "diverged"
    lost = compare([plugged, bayes])
    assert sentences(lost, "status") == ["EA (ARD) diverged: its numbers are no estimate"]
    assert not sentences(lost, "enough")


def test_interchangeable_pairs_trade_most():
    rng = np.random.default_rng(0)
    z = rng.normal(size=(4, 500, 3))
    z[..., 1] = -0.9 * z[..., 0] + 0.1 * z[..., 1]  # a.heading against a.gain
    z[..., 2] = z[..., 0] + z[..., 2]  # moves with a.heading, on another node
    tree = synthetic([0, 0, 0], [1, 1, 1], draws=z)
    (first, second, correlation), *others = interchangeable(tree)
    assert (first, second) == ("a.heading", "a.gain")
    assert correlation < -0.99
    assert [pair[:2] for pair in others] == [("a.gain", "b.gain")], "a.heading and b.gain move together"
    assert not interchangeable(tree, among=["a.heading", "b.gain"]), "on two nodes they move together"
    z[..., 1] *= -1.0  # of one node the data may know the difference
    assert interchangeable(synthetic([0, 0, 0], [1, 1, 1], draws=z), count=1)[0][:2] == ("a.heading", "a.gain")


GOOD = synthetic([0, 0, 0], [1, 1, 1], truth=TRUE)


def changed(change):
    tree = GOOD.copy(deep=True)
    change(tree)
    return tree


ERRORS = [
    (lambda: compare([GOOD]), "compare: 1 fit(s) given; give at least two"),
    (lambda: compare([GOOD, xr.DataTree()]), "compare: number 2 of the fits is no result of fit(); give trees"),
    (lambda: compare({"a": GOOD, "b": GOOD}, names=["c", "d"]), "names already; give names to a sequence"),
    (lambda: compare([GOOD, GOOD], names=["a"]), "compare: 1 names for 2 fits; give each fit a name of its own"),
    (lambda: compare([GOOD, GOOD], names=["a", "a"]), "compare: 2 names for 2 fits; give each fit a name of its own"),
    (lambda: compare([GOOD, GOOD], names=["a", "b/c"]), 'a fit cannot be called "b/c"; give a name of letters'),
    (lambda: compare([GOOD, synthetic([0], [1], ["c.x"])]),
     '"EA (ARD)" and the others have no bias in common; compare'),
    (lambda: compare([GOOD, changed(lambda t: t["calibration"]["scale"].__setitem__(1, 2.0))]),
     'the scale of a.gain is 1 m in "EA (ARD)" and 2 m in "EA (ARD) 2"; declare one'),
    (lambda: compare([GOOD, changed(lambda t: t["calibration"]["unit"].__setitem__(0, "s"))]),
     'the scale of a.heading is 1 m in "EA (ARD)" and 1 s in "EA (ARD) 2"; declare one'),
    (lambda: compare([GOOD, changed(lambda t: t.attrs.update(interval_probability=0.9))]),
     'the intervals of "EA (ARD)" and "EA (ARD) 2" have different probabilities'),
    (lambda: compare([GOOD, changed(lambda t: t["observed_data"]["y"].__setitem__(0, 9.0))]),
     '"EA (ARD)" and "EA (ARD) 2" are fits of different data; fit them to one table'),
    (lambda: compare([GOOD, changed(lambda t: t["truth"]["bias"].__setitem__(0, 9.0))]),
     'the true a.heading of "EA (ARD) 2" is not that of the fits before it; score them alike'),
]  # fmt: skip


@pytest.mark.parametrize(("call_", "text"), ERRORS, ids=[text[:40] for _, text in ERRORS])
def test_what_cannot_be_compared_is_said(call_, text):
    with pytest.raises(InputError) as caught:
        call_()
    assert text in str(caught.value)


def test_names_are_made_unique():
    other = changed(lambda t: t.attrs.update(method="MAP", prior="Gaussian"))
    assert list(fits_by_name([GOOD, other, GOOD, GOOD])) == ["EA (ARD)", "MAP (Gaussian)", "EA (ARD) 2", "EA (ARD) 3"]
    assert list(fits_by_name({"a": GOOD, "b": GOOD})) == ["a", "b"]


def without(tree, label):
    """A result of a network that lacks one bias."""

    def less(group):
        dims = [dim for dim in ("bias_label", "bias_label_other") if dim in group.dims]
        return group.sel({dim: group[dim] != label for dim in dims})

    return tree.map_over_datasets(less)


@pytest.fixture(scope="module")
def saved():
    """EA and MAP of one small problem with its truth, and MAP of a network that lacks a bias."""
    trees = [committed.tree("ea"), committed.tree("map")]
    less = without(trees[1], "c.heading")
    less.attrs.update(trees[1].attrs)
    return [*trees, less]


@pytest.mark.filterwarnings("ignore:Estimated shape parameter")
def test_saved_fits_and_two_networks(saved):
    found = compare(saved, names=["EA", "MAP", "without"])
    labels = committed.tree("ea")["calibration"]["bias_label"].values.tolist()
    assert found["estimate"]["bias_label"].values.tolist() == [label for label in labels if label != "c.heading"]
    assert "1 of EA (c.heading), 1 of MAP (c.heading)" in sentences(found, "labels")[0]
    mean = saved[1]["calibration"]["mean"].sel(bias_label="c.range_offset").item()
    assert found["estimate"]["mean"].sel(estimator="MAP", bias_label="c.range_offset") == mean
    both = compare(saved[:2])
    assert list(both["method"].children) == ["EA (Horseshoe)", "MAP (Gaussian)"]
    for name, tree in zip(both["method"].children, saved, strict=False):
        at = both[f"method/{name}"].attrs
        kind = evidence_in(tree.attrs)
        assert at[kind] == tree.attrs[kind]
        assert at["bias_rmse"] == pytest.approx(tree.attrs["bias_rmse"])
        assert at["coverage"] == pytest.approx(tree.attrs["coverage"])
        assert at["elpd"] == pytest.approx(az.loo(tree).elpd, abs=0.05)  # ArviZ takes efficiencies into its tails


def test_a_sampler_is_compared_with_what_it_reports():
    found = compare([committed.tree("ea"), committed.tree("collapsed")])
    assert found.attrs["reference"] == "Collapsed (Horseshoe)"
    at = found["method/Collapsed (Horseshoe)"].attrs
    tree = committed.tree("collapsed")["calibration"].to_dataset()
    assert at["largest_r_hat"] == pytest.approx(tree["r_hat"].max().item())
    assert at["smallest_ess"] == pytest.approx(tree["ess"].min().item())


@pytest.mark.ci
def test_the_command_line_compares_saved_fits(saved, tmp_path):
    folders = [committed.DATA / "ea.nc", committed.DATA / "map.nc", tmp_path / "less.nc"]
    probcal.save(saved[2], folders[2])
    pair = ["--pair", "c.heading,c.range_offset"]
    code, out, err = call("compare", *folders[:2], "--out", tmp_path / "out", *pair)
    assert code == 0, err
    assert "EA (Horseshoe) gamma MAP (Gaussian) gamma distance" in " ".join(out.splitlines()[0].split())
    labels = saved[0]["calibration"]["bias_label"].values
    table = [line for line in out.splitlines() if "±" in line and not line.startswith("-")]
    assert [line.split()[0] for line in table if "." in line.split()[0]][: len(labels)] == labels.tolist()
    assert "coverage" in out
    rows = pd.read_csv(tmp_path / "out" / "compare.csv", keep_default_na=False)
    assert set(rows["quantity"]) >= {"mean", "overlap", "wasserstein", "elpd", "log_evidence", "coverage"}
    with xr.open_datatree(tmp_path / "out" / "compare.nc", engine="h5netcdf") as written:
        assert written["estimate"]["estimator"].values.tolist() == ["EA (Horseshoe)", "MAP (Gaussian)"]
    assert (tmp_path / "out" / "compare.png").stat().st_size > 10_000
    code, out, _ = call("compare", *folders, "--name", "one", "--name", "two", "--name", "three")
    assert code == 0
    assert "biases that not all fits have are not compared: 1 of one (c.heading), 1 of two (c.heading)" in out
    for more, text in (
        (folders[:1], "give at least two"),
        ([*folders[:2], "--name", "one"], "1 names for 2 fits"),
        ([*folders[:2], "--pair", "c.heading"], 'the pair "c.heading" must be two labels of biases, LABEL,LABEL'),
        (
            [*folders[:2], "--pair", "c.heading,c.headng"],
            'the pair names "c.headng", which is no bias of all the fits; did',
        ),
        ([folders[0], tmp_path / "none"], "is not a fit written by probcal"),
    ):
        code, _, err = call("compare", *more)
        assert code == 2
        assert text in err
    lost = saved[1].copy()
    lost.attrs["status"] = "diverged"
    (tmp_path / "lost").mkdir()
    probcal.save(lost, tmp_path / "lost" / "fit.nc")
    code, out, _ = call("compare", folders[0], tmp_path / "lost")
    assert code == 1
    assert "MAP (Gaussian) diverged: its numbers are no estimate" in out


def test_pictures_show_what_they_say(tmp_path):
    plots = pytest.importorskip("probcal.plots")
    centre, sd = [0.0, 1.0, -2.0], [0.3, 0.1, 0.1]
    plugged = synthetic([0.0, 1.5, -2.0], [0.1, 0.1, 0.05], truth=TRUE)
    bayes = synthetic(centre, sd, draws=drawn(centre, sd), method="NUTS", prior="Horseshoe")
    fits = [plugged, bayes]
    found = compare(fits)
    ax = plots.plot_methods(found)
    texts = [text.get_text() for text in ax.get_legend().get_texts()]
    assert texts == ["EA (ARD)", "NUTS (Horseshoe)", "true"]
    np.testing.assert_allclose(ax.get_lines()[1].get_xdata(), [0.0, 1.5, -2.0])
    ax = plots.plot_gammas(found)
    assert len(ax.collections[0].get_segments()) == 3, "an interval of gamma a bias"
    ax = plots.plot_pair(fits, ("a.gain", "b.gain"))
    (ellipse,) = ax.patches
    assert ellipse.center == (1.5, -2.0)
    radius = np.sqrt(-2 * np.log(0.11))
    assert (ellipse.width, ellipse.height) == (pytest.approx(0.2 * radius), pytest.approx(0.1 * radius))
    with pytest.raises(InputError, match="must be two labels"):
        plots.plot_pair(fits, ("a.gain", "a.gain"))
    plots.draw_compare(found, dict(zip("ab", fits, strict=True)), tmp_path / "c.png")
    assert (tmp_path / "c.png").stat().st_size > 10_000
