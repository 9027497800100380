"""Samples of data associations, objects and biases together: exact association where a problem is small."""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal.errors import InputError
from probcal.inference.hierarchy import Hierarchy, Phi, hierarchy_of
from probcal.inference.mixed import R_HAT, mixing
from probcal.inference.posterior import mixed_of
from probcal.lazy import pd, xr
from probcal.noise import Unknown
from probcal.priors import PRECISION_BOUNDS, AnyPrior, Gaussian, Prior, as_prior
from probcal.problem import Problem
from probcal.results.groups import bias_coords, constant_group
from probcal.results.read import apply
from probcal.results.schema import INTERVAL
from probcal.simulate import Key, as_key
from probcal.status import CHAINS, judge
from probcal.tracking.entry import asked
from probcal.tracking.objects import Objects, track_objects
from probcal.tracking.sampler.moves import ALL_SCANS, MOVES, ONE_SCAN, SWAP, TRACK, Standing, move
from probcal.tracking.sampler.sampled import Association, Recording, first_of, places
from probcal.tracking.scan import View
from probcal.types import float64

SWEEP = (SWAP, TRACK, ONE_SCAN, TRACK, ALL_SCANS)  # moves between two draws
PAIRS = 2000  # of detections and slots, at most
SLOTS = 8  # at most: one scan is drawn by a sum over their subsets
CHUNK = 50  # draws of a compiled pass
LISTED = 0.01  # probability below which a pair is not listed
TOGETHER = 200  # detections up to which every two have their probability of being of one object
FULL = 0.01  # share of draws with an object in every slot from which on it is said
SURE = 0.5  # share of a detection from which a track holds it at the start
ROUNDS = 5  # of relabelling
NUMBERS = 1.05  # r_hat above which counts have not mixed: where one is rare, that of good draws varies more
BEGIN = 2**31 - 1  # number of the key of the first hyper-parameters, beyond all passes


class Chain(NamedTuple):
    """The state of a chain."""

    at: Standing  # of density minus infinity before the first move, which is then taken
    phi: Phi  # hyper-parameters of the prior


class AssociationDraw(NamedTuple):
    """One draw as it is kept."""

    a: Association
    z: jax.Array  # (M,)
    mean: jax.Array  # (M,) of the biases given the association
    covariance: jax.Array  # (M, M)
    gamma: jax.Array  # (M,) 1 - alpha Sigma given the hyper-parameters too
    density: jax.Array  # ()
    taken: jax.Array  # (S,) which moves of the sweep were


@partial(jax.jit, static_argnames=("views", "hierarchy"))
def run_pass(
    scene: Recording,
    views: tuple[View, ...],
    hierarchy: Hierarchy,
    schedule: jax.Array,
    chains: Chain,
    key: jax.Array,
    number: jax.Array,
) -> tuple[Chain, AssociationDraw]:
    """The `CHUNK` draws (C, N) of all chains in one pass by its number, each after the moves of a schedule (S,)."""
    learnt = jnp.asarray(hierarchy.learnt, int)

    def sweep(chain: Chain, key: jax.Array) -> tuple[Chain, AssociationDraw]:
        keys = jax.random.split(key, 3)
        own = scene._replace(prior=scene.prior._replace(alpha=hierarchy.alpha(chain.phi, scene.prior.alpha)))

        def one(at: Standing, given: Any) -> tuple[Standing, jax.Array]:
            return move(own, views, given[0], at, given[1])

        at, taken = jax.lax.scan(one, chain.at, (schedule, jax.random.split(keys[0], len(schedule))))
        z = at.z + jax.random.normal(keys[1], at.z.shape) @ at.root
        phi = chain.phi
        for k, update in enumerate(hierarchy.updates()):
            phi = update(phi, z[learnt], jax.random.fold_in(keys[2], k))
        covariance = at.root.T @ at.root
        gamma = jnp.clip(1.0 - own.prior.alpha * jnp.diagonal(covariance), 0.0, 1.0)
        return Chain(at, phi), AssociationDraw(at.a, z, at.z, covariance, gamma, at.density, taken)

    def one(chains: Chain, key: jax.Array) -> tuple[Chain, AssociationDraw]:
        return jax.vmap(sweep)(chains, jax.random.split(key, len(chains.at.density)))

    chains, drawn = jax.lax.scan(one, chains, jax.random.split(jax.random.fold_in(key, number), CHUNK))
    return chains, jax.tree.map(lambda leaf: leaf.swapaxes(0, 1), drawn)


@float64
def sample_associations(
    problem: Problem,
    *,
    prior: AnyPrior = None,
    objects: float = 3.0,
    most: int = 4,
    draws: int = 1000,
    warmup: int = 200,
    chains: int = 4,
    key: Key = 0,
    start: xr.DataTree | None = None,
) -> xr.DataTree:
    """Sample which detection is of which object, which objects there are, and the biases, from detections without name.

    Up to `most` objects, each there from the first scan to the last, their number Poisson of mean `objects` and cut
    there; missed and false detections as `Detection` says. `prior` of the biases is `Gaussian()` by default, or one
    whose hyper-parameters are drawn too. Each of the `chains` makes `draws` after `warmup`, seeded by `key`; even ones
    begin at the tracks of `track_objects`, odd ones without any object. `start`, a fit of the same network, says where
    the biases lie about which tracks and modes are looked for. Trajectories and biases are integrated by Laplace's
    formula at their joint mode: exact where sensors are linear and Gaussian and see all. Levels and rates are known.

    Returns a tree with the groups `posterior` (bias (chain, draw, bias_label), number of objects), `association` (row,
    track, probability, slots matched from draw to draw), `object` (probability of each track to be there), `together`
    (probability that two rows are of one object, whatever its name; of 200 rows at most), `calibration`, `mixed` and
    `sample_stats`. The attribute `status` is "not converged" where r_hat or effective draws say so. Raises `InputError`
    without detections, and where they or their slots are too many.

    >>> sample_associations(problem)
    Traceback (most recent call last):
    probcal.errors.InputError: sample_associations: no row leaves its target open, nothing is to be associated; use fit
    """
    chosen = as_prior(prior, Gaussian(), problem.network.labels)
    _check(problem, chosen, objects, most, draws, warmup, chains)
    clock = time.perf_counter()
    known = None if start is None else apply(problem, start)
    problem = problem if known is None else known.problem
    z = np.zeros(len(problem.labels)) if known is None else known.z
    covariance = np.eye(len(z)) if known is None else known.covariance
    scene, views, rows = scene_of(problem, chosen, objects, z)
    found = track_objects(problem, z, covariance, objects=objects, confirmed=SURE)
    hierarchy = hierarchy_of(chosen, problem)
    state = begun_at(_starts(found, rows, most, chains), len(z), hierarchy, as_key(key))
    sampled = run_passes(scene, views, hierarchy, state, SWEEP, warmup + draws, as_key(key))
    kept = jax.tree.map(lambda leaf: leaf[:, warmup:], sampled)
    tree = _tree(problem, kept, rows, SWEEP)
    tree.attrs |= {
        "method": "association sampler", "prior": chosen.title(problem.biases),
        "data": problem.measurements.table.source,
        "settings": f"objects={objects}, most={most}, draws={draws}, warmup={warmup}, chains={chains}, {chosen!r}",
        "seed": int(key) if isinstance(key, (int, np.integer)) else -1, "seconds": time.perf_counter() - clock,
        "interval_probability": INTERVAL,
    }  # fmt: skip
    if len(found.names) > most:
        said = f"The tracker confirms {len(found.names)} tracks, more than most={most}: the longest ones are the start."
        tree.attrs["message"] = f"{tree.attrs['message']} {said}"
    return tree


def scene_of(problem: Problem, prior: Prior, objects: float, z: np.ndarray) -> tuple[Recording, tuple[View, ...], Any]:
    """The data for the moves, the views, and the table row of each scan slot (K, D), -1 if none."""
    own, watch, views, _, _, cloud = asked(
        "sample_associations", problem, None, None, objects=objects, births=1.0, lifetime=1.0, most=1, sensors=()
    )
    scans, numbers = own.scans, np.array(watch.scans.number)
    assert scans is not None
    time = np.asarray(own.model.recursions[0].time)
    epoch = np.minimum(np.searchsorted(time, scans.time), len(time) - 1)
    first = first_of(watch, views, cloud, jax.device_put(z))
    place = places(numbers, own.row_index)
    precision = problem.first_precision(prior)
    put = jax.device_put
    scene = Recording(watch, put(epoch), put(place), first, put(z), put(precision), put(float(objects)))
    there = np.isin(numbers, np.flatnonzero(scans.detected))
    return scene, views, np.where(there, numbers, -1)


def begun_at(first: Association, biases: int, hierarchy: Hierarchy, key: jax.Array) -> Chain:
    """Chains before their first move, at associations (C, ...), hyper-parameters drawn from their prior."""
    C, phi = len(first.present), dict[str, jax.Array]()
    if hierarchy.updates():
        phi = jax.vmap(hierarchy.draw)(jax.random.split(jax.random.fold_in(key, BEGIN), C))
    nowhere: Any = (np.full(C, -np.inf), np.zeros((C, biases)), np.zeros((C, biases, biases)))
    return jax.device_put(Chain(Standing(first, *nowhere), phi))


def run_passes(
    scene: Recording, views: tuple[View, ...], hierarchy: Hierarchy, chains: Chain, schedule: Sequence[int], draws: int,
    key: jax.Array,
) -> AssociationDraw:  # fmt: skip
    """As many draws (C, N) of all chains, on the host."""
    passes, moves = -(-draws // CHUNK), jax.device_put(np.array(schedule))
    parts = []
    for number in range(passes):
        chains, drawn = run_pass(scene, views, hierarchy, moves, chains, key, number)
        parts.append(jax.device_get(drawn))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves, 1)[:, :draws], *parts)


def _check(problem: Problem, prior: Prior, objects: float, most: int, draws: int, warmup: int, chains: int) -> None:
    """Raise `InputError` for what cannot be sampled."""
    if not (isinstance(most, int) and 1 <= most <= SLOTS):
        raise InputError(f"sample_associations(most={most!r}): give 1 to {SLOTS} objects at most")
    if min(draws, chains) < 1 or warmup < 0:
        given = f"draws={draws}, warmup={warmup}, chains={chains}"
        raise InputError(f"sample_associations({given}): take 1 or more draws and chains, warmup 0 or more")
    every = (prior, *(one for _, one in prior.kinds))
    if not all(isinstance(one, Gaussian) or (one.hierarchical and one.dense) for one in every):
        raise InputError(
            f"sample_associations(prior={type(prior).__name__}()): associations are weighed by evidence, which needs a"
            " density of the biases that integrates: Gaussian(), ARD(rate=0.5), Laplace() or Horseshoe()"
        )
    scans = problem.scans
    if scans is None:
        raise InputError("sample_associations: no row leaves its target open, nothing is to be associated; use fit")
    named = int((~problem.measurements.detection).sum())
    if named:
        raise InputError(
            f"sample_associations: {named} rows name their target; give the detections alone, as in"
            " problem.select(problem.measurements.detection)"
        )
    if problem.levels or problem.model.tailed:
        raise InputError(
            "sample_associations: noise levels must be known and the motion Gaussian; give each std as a number, and"
            " motions without noise="
        )
    told = [placed.detection for placed in problem.network.sensors if placed.detection is not None]
    if any(isinstance(rate, Unknown) for own in told for rate in (own.probability, own.clutter)):
        raise InputError(
            "sample_associations: the rates of Detection(probability, clutter) must be known; give numbers, such as"
            " SelfConfiguration finds"
        )
    detections = int(scans.count.sum())
    if not 0 < detections * most <= PAIRS:
        raise InputError(
            f"sample_associations: {detections} detections and most={most} make {detections * most} pairs, of which 1"
            f" to {PAIRS} are sampled; take fewer scans, or fit with SelfConfiguration(EA())"
        )


def _starts(found: Objects, rows: np.ndarray, most: int, chains: int) -> Association:
    """The starts of chains: even ones at the tracks with most detections, odd ones empty."""
    K, D = rows.shape
    choice, there = np.full((chains, most, K), D), np.zeros((chains, most), bool)
    held = found.rows[found.rows["weight"] > SURE].groupby("track")["weight"].sum()
    for t, name in enumerate(held.sort_values(ascending=False).index[:most]):
        own = found.rows[(found.rows["track"] == name) & (found.rows["weight"] > SURE)]
        for row in own.sort_values("weight")["row"]:
            for k, d in np.argwhere(rows == row):
                choice[::2, t, k] = d
        there[::2, t] = True
    return Association(choice, there)


# what the draws say


def matched(a: Association, density: np.ndarray, D: int) -> Association:
    """Associations (S, T, K) with their slots put in one order, by agreement with the mean of the others.

    The first mean is the likeliest draw; a slot without an object is alike to no other.
    """
    from scipy.optimize import linear_sum_assignment  # loaded where it is used

    choice = np.where(a.present[:, :, None], a.choice, D + 1)
    S, T, K = choice.shape
    mean = np.eye(D + 2)[choice[np.argmax(density)]]  # (T, K, D + 2)
    for _ in range(ROUNDS):
        agreement = mean[:, np.arange(K)[None, None], choice].sum(3)  # (T, S, T)
        order = np.array([linear_sum_assignment(-agreement[:, s])[1] for s in range(S)])
        choice = np.take_along_axis(choice, order[:, :, None], 1)
        mean = np.stack([(choice == d).mean(0) for d in range(D + 2)], 2)
        if (order == np.arange(T)).all():
            break
    order = np.argsort(-(choice <= D).any(2).mean(0), kind="stable")
    choice = choice[:, order]
    return Association(np.minimum(choice, D), (choice <= D).all(2))


def _tree(problem: Problem, kept: AssociationDraw, rows: np.ndarray, schedule: Sequence[int]) -> xr.DataTree:
    """The tree of the draws."""
    (C, N), M, D = kept.density.shape, kept.z.shape[2], rows.shape[1]
    flat = Association(*(leaf.reshape(C * N, *leaf.shape[2:]) for leaf in kept.a))
    flat = matched(flat, np.ravel(kept.density), D)
    T, number = flat.present.shape[1], np.asarray(kept.a.present).sum(2)
    sample = {"chain": np.arange(C), "draw": np.arange(N)}
    names = [f"track_{t}" for t in range(T)]
    shares = np.stack([(flat.choice == d).mean(0) for d in range(D)], 2)  # (T, K, D)
    t, k, d = np.nonzero((shares >= LISTED) & (rows >= 0)[None])
    pairs = pd.DataFrame({"row": rows[k, d], "track": np.array(names)[t], "probability": shares[t, k, d]})
    pairs = pairs.sort_values(["row", "track"], ignore_index=True)
    density = kept.density.round(6)  # an association has one density, but for rounding
    scalars = np.stack([number, (kept.a.choice < D).sum((2, 3)), density], 2).astype(float)
    with np.errstate(invalid="ignore", divide="ignore"):  # ranks of whole numbers
        mixed = mixing(np.concatenate([kept.z, scalars], 2))
    if C > 1:
        mixed["r_hat"][M:] = [split_r_hat(scalars[:, :, k]) for k in range(scalars.shape[2])]
    moves = [MOVES[m] for m in schedule]
    taken = np.stack([kept.taken[:, :, np.array(schedule) == m].mean(2) for m in dict.fromkeys(schedule)], 2)
    groups = {
        "posterior": xr.Dataset(
            {
                "bias": (("chain", "draw", "bias_label"), kept.z * problem.scales),
                "objects": (("chain", "draw"), number),
            },
            coords={**sample, **bias_coords(problem)},
        ),
        "association": pairs.rename_axis("pair").to_xarray(),
        "object": xr.Dataset(
            {"probability": ("track", flat.present.mean(0)), "detections": ("track", shares.sum((1, 2)))},
            coords={"track": names},
        ),
        "calibration": _calibration(problem, kept, mixed),
        "constant_data": constant_group(problem),
        "mixed": xr.Dataset(
            {name: ("quantity", values[M:]) for name, values in mixed.items()},
            coords={"quantity": ["objects", "assigned", "lp"]},
        ),
        "sample_stats": xr.Dataset(
            {"lp": (("chain", "draw"), kept.density), "accepted": (("chain", "draw", "move"), taken)},
            coords={**sample, "move": list(dict.fromkeys(moves))},
        ),
    }
    if (rows >= 0).sum() <= TOGETHER:
        groups["together"] = co_association(flat, rows)
    tree = xr.DataTree.from_dict(groups)
    status, message = judge(CHAINS, _facts(problem, mixed, number, C, T))
    tree.attrs |= {"status": str(status), "message": message, "objects": float(number.mean())}
    return tree


def split_r_hat(draws: np.ndarray) -> float:
    """The split R-hat of chains (C, N): spread between halves over that within; allows ties."""
    n = draws.shape[1] // 2
    halves = np.concatenate([draws[:, :n], draws[:, -n:]]) if n > 1 else draws
    n = halves.shape[1]
    between, within = halves.mean(1).var(ddof=1), halves.var(1, ddof=min(1, n - 1)).mean()
    if within == 0:
        return np.inf if between > 0 else 1.0
    return float(np.sqrt(between / within + (n - 1) / n))


def co_association(a: Association, rows: np.ndarray) -> xr.Dataset:
    """Probability that two detections are of one object, and on the diagonal that one is of any."""
    there = np.argwhere(rows >= 0)
    there = there[np.argsort(rows[there[:, 0], there[:, 1]])]
    of = (a.choice[:, :, there[:, 0]] == there[None, None, :, 1]).reshape(-1, len(there)).astype(np.float32)
    value = (of.T @ of) / len(a.choice)
    own = rows[there[:, 0], there[:, 1]]
    return xr.Dataset({"probability": (("row", "row_other"), value)}, coords={"row": own, "row_other": own})


def _calibration(problem: Problem, kept: AssociationDraw, mixed: dict[str, np.ndarray]) -> xr.Dataset:
    """One entry a bias; mean and covariance are those of the draws' Gaussians, mixed."""
    scales, M = problem.scales, kept.z.shape[2]
    means = kept.mean.reshape(-1, M)
    mean, within = means.mean(0), kept.covariance.mean((0, 1))
    covariance = within + (means - mean).T @ (means - mean) / len(means)
    lower, upper = np.percentile(kept.z, [50 * (1 - INTERVAL), 50 * (1 + INTERVAL)], axis=(0, 1))
    variance, gamma = np.diag(covariance), kept.gamma.mean((0, 1))
    kinds = np.array([bias.kind for bias in problem.biases], str)
    columns = {
        "mean": mean * scales, "sd": np.sqrt(variance) * scales, "lower": lower * scales, "upper": upper * scales,
        "scale": scales, "gamma": gamma, "precision": np.clip((1 - gamma) / variance, *PRECISION_BOUNDS),
        "status": kinds, "kind": kinds, **{name: values[:M] for name, values in mixed.items()},
    }  # fmt: skip
    values: dict[str, Any] = {name: ("bias_label", column) for name, column in columns.items()}
    values["covariance"] = (("bias_label", "bias_label_other"), covariance * np.outer(scales, scales))
    return xr.Dataset(values, coords={**bias_coords(problem), "bias_label_other": list(problem.labels)})


def _facts(
    problem: Problem, mixed: dict[str, np.ndarray], number: np.ndarray, chains: int, most: int
) -> dict[str, Any]:
    """The facts that hurt of the draws, in the names of `probcal.status.CHAINS`."""
    names = [*problem.labels, "the number of objects", "the number of detections of objects", "the log density"]
    limits = np.where(np.arange(len(names)) < len(problem.labels), R_HAT, NUMBERS)
    full = float((number == most).mean())
    return {
        "objects": (number.mean(), len(problem.scans or ())), "single": "r_hat" not in mixed,
        "full": (most, full) if full > FULL else (), **mixed_of(names, mixed, chains, limits),
    }  # fmt: skip
