"""The sparse form beside the dense one: the same mode, variances, evidence and tracks; and what it refuses."""

import re
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache
from pathlib import Path

import engines
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import worlds
import xarray as xr
from sparse_worlds import LIBRARIES, MOTION, TIME, drawn, ear, half_radar, loud, radar

import probcal as pc
from probcal.analysis.nees import of_biases
from probcal.cli import check
from probcal.errors import FitError, InputError
from probcal.files import Outputs
from probcal.gaussian.cholmod import Cholmod
from probcal.gaussian.choose import ENGINES as CALLED
from probcal.gaussian.dense import DenseEngine
from probcal.gaussian.factor import Entries
from probcal.gaussian.iterative import Iterative
from probcal.gaussian.joint import JointPrecision, blocks_of
from probcal.gaussian.linearised import linearise_rows
from probcal.gaussian.mode import Point, compress
from probcal.gaussian.room import check_room
from probcal.gaussian.superlu import SuperLU
from probcal.geometry import bearing, norm
from probcal.identifiability.directions import shared_directions
from probcal.inference import calibrate
from probcal.inference.fitted import take_up
from probcal.inference.solve import _on_engine
from probcal.modes import automatic_start
from probcal.results.blocks import SensorBlocks
from probcal.types import float64


def fitted(method, prior=None):
    """The tree as its method leaves it: the innovations of this world reject its model, which `fit` widens by draws."""
    return calibrate(drawn()[0], method, prior=prior)[0]


@pytest.fixture(scope="module")
def dense():
    return fitted(pc.MAP(engine="dense"), pc.Gaussian())


@pytest.mark.parametrize("library", LIBRARIES, indirect=True)
def test_the_sparse_form_ends_where_the_dense_one_does(library, dense):
    """Means within 1e-4 sds; variances, tracks and evidence exact."""
    sparse = fitted(pc.MAP(engine=library), pc.Gaussian())
    a, b = (tree["calibration"].to_dataset() for tree in (dense, sparse))
    assert sparse.attrs["status"] == dense.attrs["status"] == "converged"
    assert "covariance" not in b
    sd = a["sd"].values
    np.testing.assert_allclose(b["mean"].values / sd, a["mean"].values / sd, atol=1e-4)
    np.testing.assert_allclose(b["sd"].values, sd, rtol=1e-6)
    np.testing.assert_allclose(b["gamma"], a["gamma"], atol=1e-6)
    assert "sd_error" not in b
    np.testing.assert_allclose(b["pull"], a["pull"], rtol=1e-4, atol=1e-4)
    assert sparse.attrs["log_evidence"] == pytest.approx(dense.attrs["log_evidence"], abs=1e-4)
    for name in ("car", "van", "mast"):
        one, other = (tree[f"track/{name}"].to_dataset() for tree in (dense, sparse))
        np.testing.assert_allclose(other["mean"], one["mean"], atol=1e-3)
        np.testing.assert_allclose(other["sd"], one["sd"], rtol=1e-5)


CORRELATED = {"*.heading": 0.6}


@pytest.mark.ci
@pytest.mark.parametrize(
    ("world", "method", "prior"),
    [
        ("loud", pc.MAP(tolerance=1e-3), pc.Gaussian()),
        ("loud", pc.MAP(tolerance=1e-3, trajectory="joint"), pc.Gaussian()),
        ("plane", pc.LeastSquares(), pc.Flat()),
        ("drawn", pc.MAP(), pc.Gaussian(correlation=CORRELATED)),
        ("drawn", pc.EA(), pc.Horseshoe(kinds={"*.heading": pc.Gaussian(correlation=CORRELATED)})),
    ],
)
def test_unknown_noise_and_correlated_priors_end_where_the_dense_form_does(world, method, prior, monkeypatch):
    """Unknown levels, heavy tails of data and process noise: by the same turns. Precisions: by propagation in both."""
    monkeypatch.setattr("probcal.inference.ea.MANY", 0)
    problem = {"loud": loud, "plane": lambda: worlds.linear("plane")[0], "drawn": lambda: drawn()[0]}[world]()
    one, other = (calibrate(problem, replace(method, engine=engine), prior=prior) for engine in ("dense", "cholmod"))
    a, b = (tree["calibration"].to_dataset() for tree, _ in (one, other))
    assert one[0].attrs["status"] == other[0].attrs["status"] == "converged"
    assert np.abs((b["mean"] - a["mean"]) / a["sd"]).max() < 0.02
    np.testing.assert_allclose(b["sd"], a["sd"], rtol=0.02)
    np.testing.assert_allclose(other[1].posterior.summary.levels, one[1].posterior.summary.levels, atol=1e-3)
    for x, y in zip(*(jax.tree.leaves(answer.problem.model.mixing) for _, answer in (one, other)), strict=True):
        np.testing.assert_allclose(y, x, rtol=1e-2)
    with jax.enable_x64(True):
        found, wanted = (take_up(answer.problem, tree).prior.matrix() for tree, answer in (other, one))
    np.testing.assert_allclose(np.asarray(found), np.asarray(wanted), rtol=0.02, atol=1e-9)
    assert (np.asarray(found)[~np.eye(len(found), dtype=bool)] != 0).any() == bool(prior.correlation)


@pytest.mark.slow
@pytest.mark.parametrize("form", ["dense", "cholmod", "superlu"])
@pytest.mark.parametrize("prior", [pc.Horseshoe(), pc.BernoulliGaussian()], ids=lambda prior: type(prior).__name__)
def test_propagation_agrees_with_sweeps_over_all_biases(prior, form, monkeypatch):
    """Within what the Monte Carlo error of both leaves: 0.4 sds, a third of an sd; most intervals hold the truth."""
    swept = fitted(pc.EA(engine="dense"), prior)
    monkeypatch.setattr("probcal.inference.ea.MANY", 0)
    propagated = fitted(pc.EA(engine=form), prior)
    assert propagated.attrs["status"] == swept.attrs["status"] == "converged"
    a, b = (tree["calibration"].to_dataset() for tree in (swept, propagated))
    sd = a["sd"].values
    assert np.sqrt(np.mean(((b["mean"].values - a["mean"].values) / sd) ** 2)) < 0.15
    np.testing.assert_allclose(b["mean"].values / sd, a["mean"].values / sd, atol=0.4)
    np.testing.assert_allclose(np.log(b["sd"].values / sd), 0.0, atol=0.3)
    np.testing.assert_allclose(b["gamma"], a["gamma"], atol=0.2)
    true = np.array([drawn()[1].biases[label] for label in a["bias_label"].values.tolist()])
    assert np.mean((b["lower"].values <= true) & (true <= b["upper"].values)) > 0.75


@pytest.mark.ci
def test_draws_have_the_means_and_sds(dense):
    group, draws = (
        dense["calibration"].to_dataset(),
        fitted(pc.MAP(engine="cholmod"), pc.Gaussian())["posterior"]["bias"],
    )
    flat = draws.values.reshape(-1, draws.shape[-1])
    np.testing.assert_allclose(
        (flat.mean(0) - group["mean"].values) / group["sd"].values, 0.0, atol=5 / len(flat) ** 0.5
    )
    np.testing.assert_allclose(flat.std(0) / group["sd"].values, 1.0, atol=5 / (2 * len(flat)) ** 0.5)


def test_every_bias_is_in_one_block():
    """Blocks of sensors share no bias, and the entries of their pairs stand where they say."""
    with jax.enable_x64(True):
        model = drawn()[0].model
        joint = JointPrecision.of(model)
        members = blocks_of(model)
        pairs = joint.pairs(members)
    free = members[members < model.biases]
    assert sorted(free) == list(range(model.biases))
    for b, i, j in np.argwhere(pairs >= 0):
        place = sorted(members[b, [i, j]] + joint.states)
        assert [joint.places.row[pairs[b, i, j]], joint.places.column[pairs[b, i, j]]] == place
    assert len(joint.slots[0]) + len(joint.slots[-1]) > 0
    assert joint.states == 4 * 2 * len(TIME) + 2, "the mast has one place"


@pytest.mark.parametrize("library", [Cholmod, SuperLU])
def test_factors_solve_and_say_what_is_not_positive(library):
    pytest.importorskip("sparsax", reason="sparsax is an extra")
    rng = np.random.default_rng(0)
    A, _ = thing(20, 10, rng)
    i, j = (own.astype(np.int32) for own in np.nonzero(np.triu(A)))
    places = Entries(i, j, len(A), np.flatnonzero(i == j))
    factor, inverse = library(places, A[i, j]), np.linalg.inv(A)
    right = rng.normal(size=(len(A), 3))
    np.testing.assert_allclose(factor.solve(right), inverse @ right, atol=1e-10)
    assert factor.log_determinant() == (pytest.approx(np.linalg.slogdet(A)[1]), 0.0)
    for found in (factor.inverse, factor.selected()):
        np.testing.assert_allclose(found, inverse[i, j], atol=1e-10)
    assert not factor.inverse_diagonal()[1].any()
    white = np.linalg.cholesky(A).T @ factor.draw(rng, 20_000).T
    np.testing.assert_allclose(white @ white.T / 20_000, np.eye(len(A)), atol=0.05)
    with pytest.raises(np.linalg.LinAlgError, match="not positive definite"):
        library(places, (A - 50 * np.eye(len(A)))[i, j])


def test_a_factor_that_other_threads_pushed_out_is_made_again():
    """Four threads that factorise in turn, and one factor that waited meanwhile: each gets the answers of its own."""
    pytest.importorskip("sparsax", reason="sparsax is an extra")
    places = Entries(np.arange(5, dtype=np.int32), np.arange(5, dtype=np.int32), 5, np.arange(5))
    first = Cholmod(places, np.full(5, 100.0))

    def several(k):
        return [
            Cholmod(places, np.full(5, k + 1.0 + j / 10)).solve(np.ones(5))[0] * (k + 1.0 + j / 10) for j in range(60)
        ]

    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(several, range(4)))
    np.testing.assert_allclose(found, 1.0)
    np.testing.assert_allclose(first.solve(np.ones(5)), 0.01)
    for _ in range(3):
        Cholmod(places, np.full(5, 2.0))
    np.testing.assert_allclose(first.log_determinant()[0], 5 * np.log(100.0))


# by products alone


def thing(states, sensors, rng, wide=3):
    """A positive definite matrix of a chain of states and of sensors of three biases, some of which stand alone."""
    n = states + wide * sensors
    rows = 0.3 * rng.normal(size=(4 * n, n)) * (rng.random((4 * n, n)) < 0.05)
    A = rows.T @ rows + np.diag(rng.uniform(0.5, 3.0, n))
    A[:states, :states] = np.diag(np.diag(A)[:states]) - 0.1 * (np.eye(states, k=1) + np.eye(states, k=-1))
    A += np.diag(np.maximum(0.0, 0.1 - np.linalg.eigvalsh(A)[0]) * np.ones(n))
    members = np.arange(wide * sensors).reshape(sensors, wide)
    alone, none = rng.random(members.shape) < 0.1, wide * sensors
    single = np.full((np.sum(alone), wide), none)
    single[:, 1] = members[alone]
    return A, np.concatenate([np.where(alone, none, members), single])


def by_products(A, states, members):
    """Its products, and which entries of the matrix they know."""
    i, j = np.triu_indices(len(A))
    some = np.flatnonzero(A[i, j])
    i, j = i[some].astype(np.int32), j[some].astype(np.int32)
    places = Entries(i, j, len(A), np.flatnonzero(i == j), states + members)
    return Iterative(SuperLU)(places, A[i, j])


@pytest.mark.ci
@pytest.mark.parametrize("seed", range(3))
def test_products_do_what_a_factor_does(seed):
    """Solves to 1e-8; log determinants and variances within 5 standard errors, which are small; draws in covariance."""
    rng = np.random.default_rng(seed)
    A, members = thing(40, 30, rng)
    found, right = by_products(A, 40, members), rng.normal(size=(len(A), 3))
    for given in (right, right[:, 0]):
        np.testing.assert_allclose(found.solve(given), np.linalg.solve(A, given), atol=1e-8)
    value, error = found.log_determinant()
    assert abs(value - np.linalg.slogdet(A)[1]) < 5 * error
    assert 0 < error < 1.0
    true = np.diag(np.linalg.inv(A))
    value, error = found.inverse_diagonal()
    assert (np.abs(value - true) <= 5 * error + 1e-12).all()
    assert 0.8 < np.std((value - true)[40:] / error[40:]) < 1.2
    draws = found.draw(rng, 20_000)
    white = np.linalg.cholesky(A).T @ draws.T
    np.testing.assert_allclose(white @ white.T / 20_000, np.eye(len(A)), atol=0.05)


@pytest.mark.ci
def test_products_of_some_columns_are_those_of_each(monkeypatch):
    """Where there is room for the bases of a few draws only, as many are made and as well."""
    A, members = thing(20, 10, np.random.default_rng(0))
    found = by_products(A, 20, members)
    monkeypatch.setattr("probcal.gaussian.iterative.NUMBERS", 30 * 30 * 7)  # seven columns
    draws = found.draw(np.random.default_rng(1), 3_000)
    np.testing.assert_allclose(draws.T @ draws / 3_000, np.linalg.inv(A), atol=0.15)
    value, error = found.log_determinant()
    assert abs(value - np.linalg.slogdet(A)[1]) < 5 * error


def test_products_that_are_not_positive_or_do_not_end_are_no_answer(monkeypatch):
    """A block that is not positive; blocks and states that are, and take more away from each other than there is."""
    A, members = thing(20, 10, np.random.default_rng(0))
    worse, coupled = A.copy(), A.copy()
    worse[20:, 20:] -= 5 * np.eye(30)
    with pytest.raises(np.linalg.LinAlgError, match="not positive definite"):
        by_products(worse, 20, members)
    coupled[0, 25] = coupled[25, 0] = 10.0
    found = by_products(coupled, 20, members)
    for ask in (lambda: found.solve(np.eye(50)[25]), lambda: found.draw(np.random.default_rng(0), 1)):
        with pytest.raises(np.linalg.LinAlgError, match="not positive definite"):
            ask()
    monkeypatch.setattr("probcal.gaussian.iterative.STEPS", 2)
    with pytest.raises(FitError, match="conjugate gradients did not end within 2 steps"):
        by_products(A, 20, members).solve(np.ones(50))
    with pytest.raises(FitError, match="draws of the biases did not end within 2 steps"):
        by_products(A, 20, members).draw(np.random.default_rng(0), 1)


@pytest.mark.slow
@pytest.mark.parametrize("least", [1e-3, 1e-5, 1e-7])
def test_draws_resolve_directions_that_data_leave_to_a_wide_prior(least, monkeypatch):
    """Of a spectrum with a tail towards zero: a root to 0.1 %, a log determinant to 1e-4 nats, also in few columns.

    The last entry of the first column is small long before the smallest eigenvalues are resolved.
    """
    A, members = thing(4, 200, np.random.default_rng(0))
    found = by_products(A, 4, members)
    spectrum = np.sort(np.append(np.linspace(0.3, 1.7, 560), np.geomspace(least, 0.1, 40)))
    found._white = lambda z: spectrum[:, None] * z
    start = np.random.default_rng(1).standard_normal((600, 6))
    start[:, 0] = np.eye(600)[3]  # ends after one step
    wanted = spectrum[:, None] ** -0.5 * start
    for numbers, columns in ((10**9, 6), (600 * 100 * 6, 1)):  # where there is room for all, and for 600 steps of one
        monkeypatch.setattr("probcal.gaussian.iterative.NUMBERS", numbers)
        drawn, form = found._lanczos(start, lambda values: values**-0.5)
        assert columns <= drawn.shape[1] == len(form) <= 6
        off = np.linalg.norm(drawn - wanted[:, : len(form)], axis=0) / np.linalg.norm(wanted[:, : len(form)], axis=0)
        assert off.max() < 1e-3
        form = found._lanczos(start, np.log)[1]
        true = np.sum(np.log(spectrum)[:, None] * start**2, 0)
        np.testing.assert_allclose(form, true[: len(form)], atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("library", LIBRARIES, indirect=True)
def test_a_fit_without_factors_of_the_biases_ends_where_the_dense_one_does(library, dense, monkeypatch):
    """Means within 1e-4 sds, sds, gamma and evidence within 6 of their standard errors, which are small."""
    free = fitted(pc.MAP(engine="iterative"), pc.Gaussian())
    a, b = (tree["calibration"].to_dataset() for tree in (dense, free))
    assert free.attrs["status"] == "converged"
    sd, error = a["sd"].values, b["sd_error"].values
    np.testing.assert_allclose(b["mean"].values / sd, a["mean"].values / sd, atol=1e-4)
    assert (np.abs(b["sd"].values / sd - 1.0) < 6 * error).all()
    assert 0 < error.max() < 0.06
    np.testing.assert_allclose(b["gamma"], a["gamma"], atol=0.1)
    off = free.attrs["log_evidence"] - dense.attrs["log_evidence"]
    assert abs(off) < 6 * free.attrs["log_evidence_error"]
    assert 0 < free.attrs["log_evidence_error"] < 0.5
    for name in ("car", "van", "mast"):
        one, other = (tree[f"track/{name}"].to_dataset() for tree in (dense, free))
        np.testing.assert_allclose(other["mean"], one["mean"], atol=1e-3)
        np.testing.assert_allclose(other["sd"], one["sd"], rtol=0.3)
    draws = free["posterior"]["bias"].values.reshape(-1, len(sd))
    np.testing.assert_allclose(draws.std(0) / b["sd"].values, 1.0, atol=0.2)
    assert "No factor of the biases was made: sds and evidence are estimated" in free.attrs["message"]
    states, called = JointPrecision.of(drawn()[0].model).states, {"cholmod": Cholmod, "superlu": SuperLU}[library]
    begin = called.__init__

    def small(self, places, values):
        assert places.size <= states, "an assessment makes no factor either"
        begin(self, places, values)

    monkeypatch.setattr(called, "__init__", small)
    judged = pc.assess(drawn()[0], free)["verdict"]["verdict"].values
    monkeypatch.undo()
    assert (judged == pc.assess(drawn()[0], dense)["verdict"]["verdict"].values).mean() > 0.7


# what is refused


def test_a_flat_prior_on_what_no_row_tells_is_no_fit():
    problem = drawn()[0]
    table = problem.measurements.table.frame.copy()
    table.loc[table["sensor"] == "b", "azimuth"] = np.nan  # then nothing tells how it is turned
    with pytest.raises(
        FitError, match=r"diverged: no row tells b\.heading; the estimate is invalid. Use a prior, or fix"
    ):
        pc.fit(pc.Problem(problem.network, MOTION, table), pc.MAP(engine="cholmod"), prior=pc.Flat())


def test_a_singular_matrix_is_no_fit(monkeypatch):
    def singular(*_):
        raise np.linalg.LinAlgError("not positive definite")

    monkeypatch.setattr(SuperLU, "__init__", singular)
    with pytest.raises(FitError, match="the information matrix is singular"):
        fitted(pc.MAP(engine="superlu"), pc.Flat())


def test_a_factor_that_memory_does_not_hold_is_replaced_by_products_or_said(monkeypatch):
    states, begin = JointPrecision.of(drawn()[0].model).states, SuperLU.__init__

    def full(self, places, values):
        if places.size > states:
            raise MemoryError("no room for a sparse factor")
        begin(self, places, values)

    monkeypatch.setattr(SuperLU, "__init__", full)
    monkeypatch.setattr("probcal.gaussian.choose.has_cholmod", lambda: False)
    monkeypatch.setattr("probcal.gaussian.choose.ROOM", 100)
    tree = fitted(pc.MAP(), pc.Gaussian())
    assert tree.attrs["status"] == "converged"
    assert "iterative" in tree.attrs["settings"]
    for method in (pc.MAP(engine="superlu"), pc.EA()):
        with pytest.raises(FitError, match=r'does not fit in memory: MAP\(engine="iterative"\) makes none'):
            fitted(method)
    states = 0
    with pytest.raises(FitError, match="not even without a factor: take fewer sensors or a shorter time"):
        fitted(pc.MAP(), pc.Gaussian())


@pytest.mark.parametrize("said", ["std::bad_alloc", "cholmod_analyze failed (status -2)"])
def test_a_library_that_has_no_room_says_so(said, monkeypatch):
    sparsax = pytest.importorskip("sparsax", reason="sparsax is an extra")

    def fails(*_):
        raise RuntimeError(f"XLA FFI call failed: {said}")

    monkeypatch.setattr(sparsax, "factor", fails)
    with pytest.raises(MemoryError, match="no room for a sparse factor"):
        Cholmod(Entries(np.zeros(1, np.int32), np.zeros(1, np.int32), 1, np.zeros(1, int)), np.ones(1))


@pytest.mark.parametrize(
    ("method", "prior", "settings", "said"),
    [
        (pc.EA(engine="cholmod", precisions="maximised"), None, {}, "precisions that are integrated or given"),
        (pc.MAP(engine="cholmod"), pc.Gaussian(), {"starts": 3}, "takes one start"),
        (pc.MAP(engine="cholmod"), pc.Gaussian(), {"save": ("states",)}, "keeps no draws of states or replicas"),
        (pc.EA(engine="iterative"), None, {}, "takes precisions that are given (MAP() with Gaussian() or Flat())"),
        (pc.MAP(engine="iterative"), pc.Gaussian(), {"starts": 3}, "takes one start"),
    ],
)
def test_what_a_sparse_fit_does_not_do_is_said(method, prior, settings, said):
    with pytest.raises(InputError) as error:
        pc.fit(drawn()[0], method, prior=prior, **settings)
    assert said in str(error.value)
    if method.engine == "iterative":
        assert '(engine="iterative") takes' in str(error.value)
    elif "save" not in settings:
        assert "on a network of this size is solved in sparse form, which takes" in str(error.value)


def test_forms_are_words():
    for method in (pc.EA, pc.MAP):
        with pytest.raises(InputError, match="give one of auto, dense, cholmod, superlu, iterative"):
            method(engine="thin")


def test_what_has_no_sparse_form_is_named(monkeypatch):
    problem = drawn()[0]
    assert pc.MAP().expands_by(problem.model) is None
    monkeypatch.setattr("probcal.gaussian.joint._drives", lambda part: np.zeros(len(part.L), bool))
    with pytest.raises(InputError, match='engine="cholmod" does not take a motion whose noise reaches only a part of'):
        pc.MAP(engine="cholmod").expands_by(problem.model)


def test_what_needs_the_whole_covariance_says_so():
    tree = fitted(pc.MAP(engine="cholmod"), pc.Gaussian())
    with pytest.raises(InputError, match="needs the covariance of all biases, which a large fit in sparse form"):
        of_biases(tree, drawn()[1])


@pytest.mark.ci
def test_a_sparse_fit_is_assessed_as_a_dense_one(dense):
    """The same innovations, contractions and verdicts; sums of squares over about the same degrees of freedom."""
    problem, simulated = drawn()
    truth = pc.Truth(simulated.tracks, dict.fromkeys(problem.labels, 0.0) | dict(simulated.biases))
    sparse = fitted(pc.MAP(engine="cholmod"), pc.Gaussian())
    wanted, found = (pc.assess(problem, tree, truth=truth) for tree in (dense, sparse))
    for name in ("nees_bias", "nees_bias_count", "nees_bias_upper"):
        assert found["epoch_check"].attrs[name] == pytest.approx(wanted["epoch_check"].attrs[name], rel=1e-3)
    a, b = (tree["epoch_check/car"].attrs["nees"] for tree in (wanted, found))
    assert b == pytest.approx(a, rel=0.15)
    np.testing.assert_allclose(found["datum_check"]["innovation"], wanted["datum_check"]["innovation"], atol=2e-3)
    assert found["datum_check"].attrs["used"] == pytest.approx(wanted["datum_check"].attrs["used"], rel=0.2)
    for name in ("sensor", "target"):
        a, b = (tree[f"{name}_check"].to_dataset() for tree in (wanted, found))
        np.testing.assert_allclose(b["nis"], a["nis"], rtol=0.1)
    a, b = (tree["channel_check"].to_dataset() for tree in (wanted, found))
    np.testing.assert_allclose(b["white"], a["white"], atol=0.02)
    a, b = (tree["verdict"].to_dataset() for tree in (wanted, found))
    np.testing.assert_allclose(b["contraction"], a["contraction"], atol=1e-4)
    assert b["verdict"].values.tolist() == a["verdict"].values.tolist()
    a, b = (tree["level_check"].to_dataset() for tree in (wanted, found))
    again = b["linearised"].values
    assert again.tolist() == [False, True, False, True]
    off = np.abs(b["factor"] - a["factor"]) / a["factor_sd"]
    assert (off < np.where(again, 0.02, 1.0)).all()
    np.testing.assert_allclose(b["factor_sd"][again], a["factor_sd"][again], rtol=1e-2)
    np.testing.assert_allclose(b["shift"][again], a["shift"][again], rtol=0.05, atol=0.01 * np.abs(a["shift"]).max())


@pytest.mark.slow
def test_levels_of_a_sound_network_are_found_right_by_one_look():
    """Near those that the dense form expands; of a std declared half what hangs on it is, and found as there."""
    places = [(0.0, 0.0), (400.0, 0.0), (0.0, 400.0), (400.0, 400.0)]
    nodes = [pc.Node(f"n{k}", place, scale={"position": 5.0} if k else None) for k, place in enumerate(places)]
    sound, wrong = (pc.Network([kind.on(node) for node in nodes]) for kind in (radar, half_radar))
    motion = pc.Target(pc.ConstantVelocity(1.0), {"position": (200.0, 50.0), "velocity": (0.0, 5.0)})
    table = pc.simulate(sound, motion, np.arange(300.0), key=7).table
    for network, expanded in ((sound, False), (wrong, True)):
        problem = pc.Problem(network, motion, table)
        trees = (calibrate(problem, pc.MAP(engine=form), prior=pc.Gaussian())[0] for form in ("dense", "cholmod"))
        wanted, found = (pc.assess(problem, tree)["level_check"].to_dataset() for tree in trees)
        assert ("shift" in found) is expanded
        assert found["level"].values.tolist() == wanted["level"].values.tolist()
        again = found["linearised"].values
        assert again.tolist() == [expanded, False, expanded], "the range, and the motion, which it disturbs"
        if expanded:
            assert np.isfinite(found["shift"]).all("bias_label").values.tolist() == again.tolist()
        off = np.abs(found["factor"] - wanted["factor"]) / wanted["factor_sd"]
        assert (off < np.where(again, 0.02, 1.0)).all()
        wider = found["factor_sd"].values / wanted["factor_sd"].values  # one look bounds it from above
        assert (wider < np.where(again, 1.01, [1.1, 1.1, 3.0])).all()
        assert (wider > 0.99).all()
        assert (found["square"] > found.attrs["limit"]).any() == expanded


@pytest.mark.ci
def test_data_that_scatter_more_than_declared_widen_a_sparse_fit():
    """By what the innovations call for: sd, interval, covariance of each sensor and draws together."""
    problem = drawn()[0]
    table = problem.measurements.table.frame.copy()
    table["range"] += np.random.default_rng(0).normal(0.0, 5.0, len(table))
    noisy = pc.Problem(problem.network, MOTION, table)
    dense, sparse = (calibrate(noisy, pc.MAP(engine=form), prior=pc.Gaussian())[0] for form in ("dense", "cholmod"))
    wanted, found = pc.assess(noisy, dense), pc.assess(noisy, sparse)
    assert "innovations reject the model" in found.attrs["message"]
    before, a, b = (tree["calibration"].to_dataset() for tree in (sparse, wanted, found))
    assert b["widened"].values.max() > 1.3
    np.testing.assert_allclose(b["widened"], a["widened"], rtol=0.25)
    np.testing.assert_allclose(b["sd"], before["sd"] * b["widened"])
    variance = SensorBlocks.read(b, b["bias_label"].values, "a test").variance
    np.testing.assert_allclose(variance, b["sd"] ** 2, rtol=1e-9)
    drawn_sd = [tree["posterior"]["bias"].std(("chain", "draw")).values for tree in (sparse, found)]
    np.testing.assert_allclose(drawn_sd[1], drawn_sd[0] * b["widened"].values)


@pytest.mark.parametrize("many", [False, True])
def test_tracks_of_a_sparse_calibration_have_the_covariance_of_each_sensor(dense, many, monkeypatch):
    """As the dense one with nothing between sensors, with all biases at once and by columns."""
    sparse = fitted(pc.MAP(engine="cholmod"), pc.Gaussian())
    apart = dense.copy(deep=True)
    group = apart["calibration"].to_dataset()
    owner = np.array(sparse["calibration"]["block"].values)
    group["covariance"] = group["covariance"] * (owner[:, None] == owner[None])
    apart["calibration"] = group
    wanted = pc.track(drawn()[0], apart)
    monkeypatch.setattr("probcal.gaussian.choose.prefers_sparse", lambda model: many)
    found, whole = pc.track(drawn()[0], sparse), pc.track(drawn()[0], apart)
    for name in ("car", "van", "mast"):
        one = wanted[f"track/{name}"].to_dataset()
        for tree, close in ((found, 1e-3), (whole, 1e-6)):
            other = tree[f"track/{name}"].to_dataset()
            for column in ("mean", "before"):
                np.testing.assert_allclose(other[column], one[column], rtol=close, atol=close)
            declared = [group["sd"] / group["widened"] for group in (other, one)]
            np.testing.assert_allclose(*declared, rtol=close, atol=close)
            np.testing.assert_allclose(other["widened"], one["widened"], rtol=0.25)  # each by draws of its own


def test_the_covariance_of_each_sensor_is_that_of_the_dense_form(dense):
    """Of any two biases of a sensor; what a drift and a picture of two biases read."""
    sparse = fitted(pc.MAP(engine="cholmod"), pc.Gaussian())
    group, whole = sparse["calibration"].to_dataset(), dense["calibration"]["covariance"]
    labels = group["bias_label"].values.tolist()
    assert sorted(np.bincount(group["block"].values)) == [1, 1, 4, 4, 5], "a radar also has the gain of its type"
    for chosen in (labels, labels[::-2], ["c.heading", "b.position_x", "b.range_offset"]):
        found = SensorBlocks.read(group, chosen, "a test").matrix()
        dims = {"bias_label": chosen, "bias_label_other": chosen}
        own = group["block"].sel(bias_label=chosen).values
        np.testing.assert_allclose(found, whole.sel(dims) * (own[:, None] == own[None]), rtol=1e-5, atol=1e-9)


def test_a_dense_form_that_fits_no_machine_is_refused(monkeypatch):
    monkeypatch.setattr("probcal.gaussian.room.ROOM", 100)
    with pytest.raises(InputError, match=r"the dense form of 15 biases and .* states takes .* GB"):
        check_room(drawn()[0].model)
    monkeypatch.setattr("probcal.gaussian.choose.ROOM", 0)
    with pytest.raises(InputError, match="log_evidence on a network of this size takes precisions and noise levels"):
        pc.log_evidence(drawn()[0])
    with jax.enable_x64(True), pytest.raises(InputError, match="in sparse form"):
        compress(drawn()[0].model, linearise_rows(drawn()[0].model, automatic_start(drawn()[0])))


def test_what_the_data_leave_open_is_named_as_in_the_dense_form(dense):
    """Combinations of single sensors by their information; those of all by the variance of their sum."""
    sparse = fitted(pc.MAP(engine="cholmod"), pc.Gaussian())
    a, b = (tree["direction"].to_dataset().sortby("information") for tree in (dense, sparse))
    assert a["direction"].values.tolist() == b["direction"].values.tolist()
    np.testing.assert_allclose(b["information"], a["information"], rtol=0.03)
    assert sparse.attrs["weak"] == len(b["direction"])


@cache
def unanchored():
    """Four radars whose common place and heading no row tells; each is displaced."""
    nodes = [
        pc.Node(name, place, scale={"position": 5.0, "heading": 0.05})
        for name, place in zip("abcd", [(0.0, 0.0), (400.0, 0.0), (0.0, 400.0), (400.0, 400.0)], strict=True)
    ]
    network = pc.Network([radar.on(node) for node in nodes])
    way = np.stack([np.linspace(50, 350, len(TIME)), 120 + 60 * np.sin(TIME / 5)], 1)
    run = pc.simulate(network, MOTION["car"], TIME, key=3, tracks={"car": way}, biases={})
    return network, run.table


@pytest.mark.slow
def test_what_all_sensors_share_is_open_in_both_forms():
    """A translation and a rotation of all nodes, one with the information the dense form has."""
    problem = pc.Problem(unanchored()[0], MOTION["car"], unanchored()[1])
    dense, sparse = (pc.fit(problem, pc.MAP(engine=form), prior=pc.Gaussian()) for form in ("dense", "cholmod"))
    names = [set(tree["direction"]["direction"].values.tolist()) for tree in (dense, sparse)]
    assert {name for name in names[0] if "all nodes" in name} == {name for name in names[1] if "all nodes" in name}
    assert {f"translation of all nodes along {axis}" for axis in "xy"} <= names[1] & names[0]
    assert "translation of all nodes along x" in sparse.attrs["message"]


@pytest.mark.ci
def test_a_network_that_ran_along_what_no_row_tells_is_no_answer():
    """All rows a mile off to one side: translated, and invalid."""
    network, table = unanchored()
    motion = pc.Target(pc.ConstantVelocity(1.0), start={"position": ((-150.0, 120.0), 1.0)})
    problem = pc.Problem(network, motion, table)
    tree = pc.fit(problem, pc.MAP(engine="cholmod"), prior=pc.Gaussian())
    assert tree.attrs["status"] == "along a gauge"
    assert "along translation of all nodes along x, which no row fixes: it is invalid" in tree.attrs["message"]


@pytest.mark.ci
@pytest.mark.parametrize("whole", [True, False], ids=["a matrix of all", "screened"])
@pytest.mark.parametrize("anchored", [True, False], ids=["anchored", "unanchored"])
def test_observability_by_the_sparse_engine_is_that_by_the_dense_one(whole, anchored, monkeypatch):
    """Shares, sds, leverages, tracks, what is open and what removes it, with a matrix of all biases and without."""
    problem = drawn()[0] if anchored else pc.Problem(unanchored()[0], MOTION["car"], unanchored()[1])
    with jax.enable_x64(True):
        point = automatic_start(problem)
    wanted = pc.observability(problem, point=point)
    monkeypatch.setattr("probcal.gaussian.choose.ROOM", 0)
    if not whole:
        monkeypatch.setattr("probcal.gaussian.sparse.WHOLE", 0)
    found = pc.observability(problem, point=point)
    for group, names in {"bias": ("share", "sd"), "datum": ("leverage",), "sensor": ("leverage",)}.items():
        for name in names:
            np.testing.assert_allclose(found[group][name], wanted[group][name], rtol=1e-5, atol=1e-7)
    assert found["bias"]["verdict"].values.tolist() == wanted["bias"]["verdict"].values.tolist()
    assert found["target"].attrs["motion"] == pytest.approx(wanted["target"].attrs["motion"], abs=1e-5)
    np.testing.assert_allclose(found["track/car"]["sd"], wanted["track/car"]["sd"], rtol=1e-6)
    assert found.attrs["status"] == wanted.attrs["status"]
    own, other = (tree["direction"].to_dataset().sortby("direction") for tree in (found, wanted))
    common = "all nodes" if not (whole or anchored) else ""  # of single sensors a screen names what all share, too
    assert {d for d in own["direction"].values if common in d} == {d for d in other["direction"].values if common in d}
    assert not any("not verified" in text for text in own["remedy"].values.tolist())
    if whole:
        if anchored:  # without the null space of the rows a gauge is one direction by itself
            assert own["remedy"].values.tolist() == other["remedy"].values.tolist()
            assert own["kind"].values.tolist() == other["kind"].values.tolist()
        np.testing.assert_allclose(found["bias"]["information"], wanted["bias"]["information"], rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(found["spectrum"]["information"], wanted["spectrum"]["information"], atol=1e-5)
    else:
        assert "rigid motions, common shifts" in found.attrs["screened"]


def test_what_a_screen_advises_removes_what_all_sensors_share():
    """Fixed, the biases that it names leave no direction of all nodes; without those of the last one is left."""
    network, table = unanchored()
    problem = pc.Problem(network, MOTION["car"], table)
    with jax.enable_x64(True):
        start = automatic_start(problem)
        found = shared_directions(problem, DenseEngine().at(problem.model, start))
    assert [own.kind for own in found][:3] == ["gauge"] * 3  # two translations and a rotation
    advised = [own.fix for own in found]
    assert all(advised)

    def left(fixed):
        rest = pc.Problem(network, MOTION["car"], table, fix=[label for own in fixed for label in own])
        return weak_of_all(pc.observability(rest, point=start._replace(z=np.zeros(len(rest.labels)))))

    assert not left(advised)
    assert left([advised[0]])


def weak_of_all(tree):
    """Directions that all nodes share."""
    named = tree["direction"]["direction"].values.tolist() if "direction" in tree.children else []
    return [name for name in named if any(word in name for word in ("all nodes", "rotation", "dilation"))]


@pytest.mark.ci
def test_check_of_a_large_network_says_what_is_open(monkeypatch, capsys, tmp_path):
    """The command line with the sparse form: biases that the data tell least of, directions, status, files."""
    monkeypatch.setattr("probcal.gaussian.choose.prefers_sparse", lambda model: True)
    monkeypatch.setattr("probcal.cli.files.MANY", 10)
    monkeypatch.setattr("probcal.cli.files.SHOWN", 5)
    given = {"side": 3, "targets": 1, "epochs": 40}
    outputs = Outputs(tmp_path, ("check.nc", "check.csv", "check.png"))
    ended = check.run(Path(__file__).parents[1] / "models" / "large_network.py", None, (), given, None, outputs)
    said = capsys.readouterr().out
    assert ended == 1
    assert "biases, those that the data tell least of" in said
    assert "translation of all nodes along x (gauge" in said
    assert "What would tell most (nats; weak directions left):\n  another pass, (" in said
    assert re.search(r"\n  a survey of radar_\d+\.position_\* to 0\.2 m: [\d.]+ of the other biases \(\d+\)\n", said)
    assert re.search(r"\n  one more radar at \([-\d., e+]+\) m: [\d.]+\n", said)
    assert {path.name for path in tmp_path.iterdir()} >= {"check.nc", "check.csv"}


def test_few_of_many_biases_at_an_epoch_take_the_sparse_form(monkeypatch):
    problem = drawn()[0]

    def engine(method=None, prior=None, starts=1):
        """The engine of the method that solves the problem; "dense" where kernels climb."""
        found = _on_engine(problem, method or pc.MAP(), prior or pc.Gaussian(), starts)
        return "dense" if found is None else found.engine

    assert engine() == "dense"
    monkeypatch.setattr("probcal.gaussian.choose.MANY", 5)
    monkeypatch.setattr("probcal.gaussian.choose.THIN", 100.0)
    assert engine() in ("cholmod", "superlu")
    assert engine(starts=2) == "dense"
    assert engine(pc.MAP(engine="dense")) == "dense"
    monkeypatch.setattr("probcal.gaussian.choose.THIN", 1e-6)
    assert engine() == "dense"


@pytest.mark.ci
def test_a_fit_of_many_data_keeps_what_a_mail_holds(monkeypatch, tmp_path):
    """Above `LARGE` data: the log-likelihood in sum, residuals and tracks to a small part of noise and sd."""
    problem = worlds.small()
    small = pc.fit(problem, pc.MAP(), prior=pc.Gaussian())
    monkeypatch.setattr("probcal.gaussian.draws.LARGE", 3)
    large = pc.fit(problem, pc.MAP(), prior=pc.Gaussian())
    assert "log_likelihood" not in large.children
    sums = small["log_likelihood"]["y"].sum("datum").values
    # a log-likelihood by datum is rounded to 1/256 of its spread
    np.testing.assert_allclose(large["log_likelihood_sum"]["y"].values, sums, atol=0.05)
    for name in ("before", "after"):
        whole, coarse = small["residual"][name].values, large["residual"][name].values
        std = small["residual"]["std"].values
        assert 0 < np.max(np.abs(whole - coarse) / std) <= 1 / 64
    for node in small["track"].children:
        whole, coarse = (tree["track"][node].to_dataset() for tree in (small, large))
        for name in ("mean", "sd", "before"):
            assert np.all(np.abs(whole[name] - coarse[name]) <= whole["sd"] / 64)
    judged = pc.assess(problem, large)
    assert any("keeps the log-likelihood of all" in text for text in judged["finding"]["sentence"].values)
    assert "sensitivity" in judged.children
    again = pc.load(pc.save(large, tmp_path / "fit.nc"))
    assert again["log_likelihood_sum"].equals(large["log_likelihood_sum"])
    both = pc.compare({"small": small, "large": large})
    assert any("too many for a fit to keep it" in text for text in both["finding"]["sentence"].values)


@pytest.fixture
def forced(request, monkeypatch):
    """The name of an engine, which is the one that is chosen, where the dense form fits no machine."""
    engines.world()  # its start is made by kernels
    engine = engines.named(request.param)
    if engine == "cholmod":
        pytest.importorskip("sparsax", reason="sparsax is an extra")
    for name in ("choose", "room"):
        monkeypatch.setattr(f"probcal.gaussian.{name}.ROOM", 0)
    monkeypatch.setattr("probcal.gaussian.choose.direct_engine", CALLED[engine])
    if request.param == "many":
        monkeypatch.setattr("probcal.gaussian.sparse.WHOLE", 0)
    return request.param


@pytest.mark.ci
@pytest.mark.parametrize("library", LIBRARIES, indirect=True)
def test_tracks_under_heavy_tails_are_those_of_the_dense_engine(library, monkeypatch):
    """Latent scales that follow from a calibration, and the tracks, to 1e-3 of their sds."""
    problem, (fit, _) = loud(), calibrate(loud(), pc.MAP(tolerance=1e-3, engine="dense"), prior=pc.Gaussian())
    wanted = pc.track(problem, fit)["track/t"].to_dataset()
    for name in ("choose", "room"):
        monkeypatch.setattr(f"probcal.gaussian.{name}.ROOM", 0)
    found = pc.track(problem, fit)["track/t"].to_dataset()
    np.testing.assert_allclose(found["weight_velocity"], wanted["weight_velocity"], rtol=1e-3)
    np.testing.assert_allclose((found["mean"] - wanted["mean"]) / wanted["sd"], 0.0, atol=1e-3)
    np.testing.assert_allclose(found["sd"], wanted["sd"], rtol=1e-3)


FORCED = ("cholmod", *(pytest.param(name, marks=pytest.mark.ci) for name in ("superlu", "many", "iterative")))
SHORT = {"fit", "next_anchors", "changes", "compare", *engines.NOT} - {"observability", "EA", "EMEA"}
TIERS = dict.fromkeys(("EA", "Gibbs", "MCMC"), pytest.mark.slow) | dict.fromkeys(SHORT, ())
CELLS = [pytest.param(name, marks=TIERS.get(name, pytest.mark.ci)) for name in (*engines.VERBS, *engines.METHODS)]


@pytest.mark.parametrize("forced", FORCED, indirect=True)
@pytest.mark.parametrize("name", CELLS)
def test_every_verb_and_method_runs_on_every_engine_or_says_why_not(name, forced, monkeypatch):
    """A verb answers with the numbers of the dense engine, a method with finite ones."""
    at = engines.world()

    def answer(engine):
        if name in engines.VERBS:
            return jax.tree.map(np.asarray, engines.VERBS[name](at, engine))
        problem = engines.unnamed() if name == "SelfConfiguration" else at.problem
        return calibrate(problem, engines.METHODS[name](engine))[0]["calibration"]["mean"].values

    if said := engines.NOT.get(name, {}).get(engines.KINDS[forced]):
        with pytest.raises(InputError, match=said):
            answer(forced)
        return
    found = answer(forced)
    assert all(np.isfinite(own).all() for own in jax.tree.leaves(found))
    if name in engines.VERBS:
        monkeypatch.undo()
        # of what draws estimate, of sensors as if independent, or of what climbs end at
        close = 0.1 if forced == "iterative" else engines.APART.get((name, forced), 1e-3)
        for own, wanted in zip(jax.tree.leaves(found), jax.tree.leaves(answer("dense")), strict=True):
            np.testing.assert_allclose(own, wanted, rtol=close, atol=close * np.abs(wanted).max())


@pytest.mark.ci
@pytest.mark.parametrize("step", [pc.EM(pc.Unscented()), pc.EMEA()], ids=lambda own: own.name)
def test_em_on_any_engine_is_that_of_the_dense_one(step):
    problem = worlds.small()
    start = float64(automatic_start)(problem)
    engined = (replace(step, iterations=20, engine=name) for name in ("dense", "superlu"))
    one, other = (calibrate(problem, own, start=start)[0]["calibration"] for own in engined)
    for name in ("mean", "sd", "gamma", "precision"):
        np.testing.assert_allclose(other[name], one[name], rtol=1e-9)


@pytest.mark.needs("particles", "tracking")
def test_the_table_of_engines_stands_in_the_guide():
    assert engines.table() in engines.GUIDE.read_text(), "run python tests/engines.py"


@pc.sensor(azimuth=pc.Channel("rad", std=0.01, wrap=True))
def turned_ear(target, pose, *, offset=pc.Bias("rad", 0.05)):
    """Azimuth with an offset that no data tell from a heading."""
    return dict(azimuth=bearing(pose.local(target.position)) + offset)


@pytest.mark.parametrize("library", LIBRARIES, indirect=True)
def test_what_has_no_bound_has_none_by_sparse_factors(library, monkeypatch):
    problem, truth = drawn()
    placed = [(turned_ear if s.type is ear else s.type).on(s.nodes[0]) for s in problem.network.sensors]
    problem = pc.Problem(pc.Network(placed), MOTION, problem.measurements.table)
    wanted = pc.bounds(problem, kind="parametric", truth=pc.Truth(truth.tracks))
    monkeypatch.setattr("probcal.gaussian.choose.ROOM", 0)
    for whole, close in ((100, 1e-6), (0, 1e-4)):
        monkeypatch.setattr("probcal.gaussian.sparse.WHOLE", whole)
        found = pc.bounds(problem, kind="parametric", truth=pc.Truth(truth.tracks))
        open_ = found["unbounded"]["bias_label"].values.tolist()
        assert set(open_) == {"d.heading", "e.heading", *(f"{s.name}.offset" for s in problem.network.sensors[3:])}
        assert open_ == wanted["unbounded"]["bias_label"].values.tolist()
        np.testing.assert_allclose(found["bias"]["sd"], wanted["bias"]["sd"], rtol=close)


def test_of_very_many_surveys_those_that_may_tell_most_are_looked_at(monkeypatch):
    problem, start = drawn()[0], engines.world().start
    every = pc.next_anchors(problem, point=start)
    assert every.attrs["looked"] == every.sizes["anchor"]
    for name, count in (("LOOKED", 5), ("LISTED", 1), ("AT_ONCE", 1)):
        monkeypatch.setattr(f"probcal.analysis.planning.{name}", count)
    few = pc.next_anchors(problem, point=start)
    assert few.attrs["looked"] == few.sizes["anchor"] < 5
    xr.testing.assert_allclose(few.isel(anchor=0), every.isel(anchor=0))


@pytest.mark.slow
def test_a_pass_is_seen_by_the_sensors_that_it_comes_near_to(monkeypatch):
    """Where sensors reach so far as they did, those beyond see nothing: as if they had no row."""
    gains = []
    for reached in (0.3, 1.0, 2.0):
        monkeypatch.setattr("probcal.analysis.additions.REACHED", reached)
        gains.append(pc.next_passes(drawn()[0], point=engines.world().start, passes=engines.LINES[:1])["gain"].item())
    assert 0 < gains[0] < gains[1] < gains[2]


@pc.sensor(delay=pc.Channel("m", std=1.0))
def difference(target, pose, other, *, lag=pc.Bias("m", 3.0)):
    """Difference of two distances."""
    return dict(delay=norm(target.position - pose.position) - norm(target.position - other.position) + lag)


@pc.sensor(range=pc.Channel("m", std=1.0))
def naive(target, pose, *, offset=pc.Bias("m", 3.0)):
    """Range without a derivative at zero."""
    return dict(range=jnp.sqrt(jnp.sum((target.position - pose.position) ** 2)) + offset)


@pytest.mark.slow
def test_planning_takes_second_nodes_whose_spread_another_sensor_reads(monkeypatch):
    """And nodes that move, biases that are fixed, a network small beside its ranges, a name that is taken."""
    nodes = [pc.Node("new 0", (0.0, 0.0), scale={"position": 1.0}), pc.Node("b", (20.0, 0.0), scale={"heading": 0.05})]
    moving = pc.Node("boat", path=pc.Path(TIME, np.stack([TIME, 10.0 + 0 * TIME], 1)), scale={"heading": 0.05})
    network = pc.Network([difference.on(*nodes), ear.on(nodes[1], name="ears"), radar.on(moving)])
    motion = pc.ConstantVelocity(1.0)
    way = np.stack([3_000 + 10 * TIME, 2_000 + 0 * TIME], 1)
    run = pc.simulate(network, motion, TIME, key=1, share=0.0, tracks={"target": way})
    problem = pc.Problem(network, motion, run.table, fix="*.gain")
    with jax.enable_x64(True):
        point = automatic_start(problem)
    lines, places = [[(2_000.0, 2_000.0), (3_000.0, 1_000.0)]], [(500.0, 300.0)]
    gains = []
    for room in (10**9, 0):
        monkeypatch.setattr("probcal.gaussian.choose.ROOM", room)
        gains.append(pc.next_passes(problem, point=point, passes=lines)["gain"].values)
        gains.append(pc.next_sensors(problem, point=point, places=places)["gain"].values)
    assert all((own > 0).any() for own in gains)
    for one, other in zip(gains[:2], gains[2:], strict=True):
        np.testing.assert_allclose(other, one, rtol=1e-4)


def test_what_planning_cannot_say_it_says(monkeypatch):
    network = pc.Network([naive.on(pc.Node(f"n{k}", (100.0 * k, 0.0))) for k in range(3)])
    way = np.stack([10.0 * TIME, 50.0 + 0 * TIME], 1)
    run = pc.simulate(network, pc.ConstantVelocity(1.0), TIME, key=1, tracks={"target": way})
    problem = pc.Problem(network, pc.ConstantVelocity(1.0), run.table)
    states = np.concatenate([way, np.tile([10.0, 0.0], (len(TIME), 1))], 1)
    point = Point((states,), (np.zeros_like(states),), np.zeros(len(problem.labels)), np.zeros(0))
    with pytest.raises(InputError, match="pass 0 runs over the place of a sensor that has no derivative there"):
        pc.next_passes(problem, point=point, passes=[[(0.0, 0.0), (0.0, 0.0)]])
    with pytest.raises(InputError, match=r"a further naive at \(.*\) m would stand where a target was seen, and has"):
        pc.next_sensors(problem, point=point, places=[way[3]])
    there = point._replace(states=(np.zeros_like(states),))
    with pytest.raises(InputError, match="no finite derivatives at the point where they are looked at"):
        pc.next_sensors(problem, point=there, places=[(5.0, 5.0)])
    for call, name, given in (
        (pc.next_passes, "passes", [[(0.0, np.nan), (1.0, 1.0)]]), (pc.next_sensors, "places", [(np.nan, 0.0)])
    ):  # fmt: skip
        with pytest.raises(InputError, match=rf"^{name} has shape .* of finite numbers"):
            call(problem, point=point, **{name: given})
    monkeypatch.setattr("probcal.analysis.additions.TOUCHED", 2)
    with pytest.raises(InputError, match="pass 0 would meet 3 biases, of which a matrix is made"):
        pc.next_passes(problem, point=point, passes=[[(0.0, 20.0), (100.0, 30.0)]])


@pytest.mark.ci
def test_bounds_that_rounding_hides_are_none(monkeypatch):
    def singular(*_):
        raise np.linalg.LinAlgError("not positive definite")

    monkeypatch.setattr("probcal.gaussian.choose.ROOM", 0)
    monkeypatch.setattr("probcal.gaussian.sparse.WHOLE", 0)
    monkeypatch.setattr("probcal.gaussian.joint.JointPrecision.under", singular)
    with pytest.raises(InputError, match=r'rounding hides which biases of so many have none; .* take kind="posterior"'):
        pc.bounds(drawn()[0], kind="hybrid", truth=drawn()[1], draws=1)
