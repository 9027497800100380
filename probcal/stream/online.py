"""Calibration of a stream: rows in, biases and tracks out, with memory that does not grow."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from contextlib import contextmanager
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal import linalg
from probcal.errors import InputError, nearest
from probcal.inference.widen import widening_factors
from probcal.labels import NOBODY, label_parts
from probcal.lazy import Later
from probcal.linalg import cholesky, invert
from probcal.modes.grid import NEAR
from probcal.network import Network
from probcal.priors import AnyPrior, Gaussian, Horseshoe, Prior, as_prior
from probcal.problem import Problem, fixed_biases
from probcal.results.answer import HALF
from probcal.results.read import apply, held_by
from probcal.status import STREAM, Status, judge
from probcal.stream.arrivals import Arrivals, Batch, padded, refused_rows
from probcal.stream.counted import Counted
from probcal.stream.filters import belief as beliefs
from probcal.stream.filters import particles
from probcal.stream.filters.belief import Augmented
from probcal.stream.filters.filtering import RULES, FilterForm, FilterGiven, RowPoints
from probcal.stream.filters.lag import Window, run_plain, run_window
from probcal.stream.filters.particles import Cloud
from probcal.stream.filters.starts import FIRST, place_new
from probcal.stream.identity import declared_identity
from probcal.stream.relearnt import relearnt
from probcal.stream.surveillance import ChangePoint, StreamData, Surveillance, data_in_order
from probcal.stream.watched import calibration_tree
from probcal.table import read_table
from probcal.types import float64

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr
else:
    pd = Later("pandas")
    xr = Later("xarray")

LIVE, BULK = 1, 16  # lags of a window beside the one that stays, of few rows and of many
PLAIN = (1, 32, 512)  # epochs of a call of the plain filter
ANCESTORS = 50  # particles of the start of which some must be left for intervals to be worth what they say
RECENT = 300  # rows that are kept for the tree
MANY = 3000  # biases beyond which the dense covariance of the filter is no use
RESTLESS = 0.1  # sd by which the points of a window may move in its last pass without a doubt of its intervals
LOOK = 8  # epochs between two moments at which a plain filter compares the biases
SEGMENTS = 4  # parts of a lag, at the ends of which a window may be left


@dataclass(frozen=True)
class Jumps:
    """Detection of biases that jump, by a test of each bias from each of some times on (Willsky and Jones 1976).

    A jump has the prior N(0, (`scale` declared scales)^2); a bias has jumped where the odds for it exceed a bound that
    a stream without jumps exceeds at most `false_alarms` times in an hour (Ville 1939, over all biases and starting
    times). `starts` starting times are kept over the last `within` s. Raises `InputError` for numbers that are not
    positive.

    >>> Jumps(within=30.0).starts
    12
    """

    false_alarms: float = 0.1
    within: float = 60.0
    scale: float = 1.0
    starts: int = 12

    def __post_init__(self):
        for name in ("false_alarms", "within", "scale", "starts"):
            value = getattr(self, name)
            if not (isinstance(value, (int, float)) and np.isfinite(value) and value > 0):
                raise InputError(f"Jumps({name}={value!r}): give a positive number")

    def bound(self, biases: int) -> float:
        """Log odds at which a bias is said to have jumped."""
        tests = biases * self.starts * 3600.0 / self.within  # that begin in an hour
        return float(np.log(tests / self.false_alarms))


@dataclass(frozen=True)
class AugmentedFilter:
    """The augmented-state filter: states of all targets and biases together (thesis 4.3), by square roots.

    `by` "extended", "unscented" or "cubature" says how rows are linearised when they arrive. `lag` epochs stay in a
    window that is linearised again until no point moves by `tolerance` sd, at most `passes` times: over a window that
    holds the whole recording this ends at the batch answer. 0 is the plain filter, which cannot mend how it began: it
    wants targets whose start is declared or whose first rows give their place, and says with `Update.settled` where one
    had neither. `walk` gives biases, by label or
    pattern, the std of a random walk over one second, in their unit; others are constant. Those in `consider` are not
    estimated: their uncertainty counts, their value stays (Schmidt 1966). `jumps` finds biases that jump. `gate` is
    the probability of a datum of the right model to be left out as an outlier; 0 takes all. Raises `InputError` for a
    setting that is none.

    >>> AugmentedFilter(lag=0, walk={"*.heading": 1e-4}).by
    'extended'
    """

    by: str = "extended"
    lag: int = 32
    walk: Any = ()
    consider: Any = ()
    jumps: Jumps | None = None
    passes: int = 10
    tolerance: float = 0.02
    gate: float = 1e-6

    def __post_init__(self):
        _check_gate(self)
        if self.by not in RULES:
            raise InputError(
                f'AugmentedFilter(by="{self.by}"): give one of {", ".join(RULES)}{nearest(self.by, RULES)}'
            )
        if not (isinstance(self.lag, int) and self.lag >= 0 and self.lag % SEGMENTS == 0):
            raise InputError(f"AugmentedFilter(lag={self.lag!r}): give 0 or a number of epochs that 4 divides")
        if not (isinstance(self.passes, int) and self.passes > 0):
            raise InputError(f"AugmentedFilter(passes={self.passes!r}): give 1 or more")
        if self.jumps is not None and self.consider:
            raise InputError(
                "AugmentedFilter: biases that are only considered cannot be tested for jumps; drop one of both"
            )
        consider = (self.consider,) if isinstance(self.consider, str) else tuple(map(str, self.consider))
        object.__setattr__(self, "walk", _walks("AugmentedFilter", self.walk))
        object.__setattr__(self, "consider", consider)


@dataclass(frozen=True)
class ParticleFilter:
    """The Rao-Blackwellised particle filter: `count` paths are drawn, the biases given each are Gaussian.

    For any motion, roads too, and states that are far from Gaussian; biases should enter nearly linearly. `walk` is
    that of `AugmentedFilter`. Particles are resampled where the effective number of them falls below `threshold` of
    them; `seed` seeds all draws. The biases of a long stream rest on ever fewer of the first particles, so that its
    intervals get too narrow: where fewer than 50 are left `Update.settled` is false. `AugmentedFilter` has no such
    limit. `gate` is that of `AugmentedFilter`. Raises `InputError` for a setting that is none.

    >>> ParticleFilter(500).threshold
    0.5
    """

    count: int = 1000
    walk: Any = ()
    threshold: float = 0.5
    seed: int = 0
    gate: float = 1e-6

    lag: ClassVar[int] = 0
    by: ClassVar[str] = "extended"
    consider: ClassVar[tuple[str, ...]] = ()
    jumps: ClassVar[Jumps | None] = None

    def __post_init__(self):
        _check_gate(self)
        if not (isinstance(self.count, int) and self.count > 1):
            raise InputError(f"ParticleFilter(count={self.count!r}): give 2 or more, some hundred as a rule")
        if not (isinstance(self.threshold, (int, float)) and 0 <= self.threshold <= 1):
            raise InputError(f"ParticleFilter(threshold={self.threshold!r}): give a share of the particles, 0 to 1")
        object.__setattr__(self, "walk", _walks("ParticleFilter", self.walk))


class Jump(NamedTuple):
    """A bias that jumped."""

    label: str
    since: float  # s, the starting time that explains the data best
    found: float  # s, of the epoch up to which the data were used
    size: float  # in the unit of the bias
    sd: float
    log_odds: float
    bound: float  # s after `since` at which a jump of this size can be expected to be found, at the soonest


class Update(NamedTuple):
    """The results of new rows."""

    time: float  # s, of the last epoch
    epochs: int  # that were filtered for good
    tracks: pd.DataFrame  # time, target, each state component and its sd, of those epochs
    jumps: tuple[Jump, ...]
    passes: int  # most times that a window was linearised again
    settled: bool  # all windows came to rest; each new target was placed; enough of the first particles are left
    refused: pd.DataFrame  # line and reason of rows that were left out


class Online:
    """Calibrates a network from a stream of rows: `update` takes some, `biases` and `tracks` say what is known.

    `motion` is one motion for all targets, or a mapping by name, as in `Problem`; a target of which no start is
    declared starts where the first rows let it. The prior of the biases is Gaussian, of the declared scales, or
    `calibration`, a tree of an earlier fit: biases that it held fixed stay so, and rows that it has counted are
    refused. `epoch` puts rows at common epochs of that length in s, as in `Problem`. `targets` are carried at once; of
    a new one beyond them that which has been silent for longest is given up. Unknown noise levels are held at their
    guess, or at what `calibration` has. Raises `InputError` for what cannot be calibrated online.

    >>> online = Online(network, motion, AugmentedFilter(lag=0))
    >>> news = online.update(run.table)
    >>> online.counts["rows"] == len(run.table)
    True
    """

    @float64
    def __init__(
        self,
        network: Network,
        motion: Any,
        method: AugmentedFilter | ParticleFilter | None = None,
        *,
        prior: Prior | None = None,
        calibration: xr.DataTree | None = None,
        fix: Any = (),
        epoch: float | None = None,
        targets: int = 16,
    ):
        self.method = AugmentedFilter() if method is None else method
        if not isinstance(self.method, (AugmentedFilter, ParticleFilter)):
            raise InputError(f"Online(method={method!r}): give AugmentedFilter(...) or ParticleFilter(...)")
        if not (isinstance(targets, int) and targets > 0):
            raise InputError(f"Online(targets={targets!r}): give 1 or more")
        self.prior = Gaussian() if prior is None else prior
        if not isinstance(self.prior, Gaussian):
            raise InputError(
                f"Online(prior={type(self.prior).__name__}()): the filter takes Gaussian(); sparse priors are laid on"
                " what it found, online.under(Horseshoe())"
            )
        for what, patterns in (("walk", dict(self.method.walk)), ("consider", self.method.consider)):
            for pattern in patterns:
                _chosen(network.labels, pattern, what)
        if epoch is not None and not (isinstance(epoch, (int, float)) and np.isfinite(epoch) and epoch > 0):
            raise InputError(f"Online(epoch={epoch!r}): give the length of common epochs in s, or leave it out")
        held = {} if calibration is None else held_by(calibration, network.labels)
        fixed = held | fixed_biases(network, fix)
        counted = None if calibration is None else Counted.of(calibration)
        linear = isinstance(self.method, AugmentedFilter)
        self.arrivals = Arrivals(network, motion, fixed, targets, linear, epoch, counted)
        self.network, self.calibration = network, calibration
        self.pending: pd.DataFrame | None = None
        self.cloud: Cloud | None = None
        self.recent: pd.DataFrame | None = None  # the last rows that the model explains
        self.last: pd.DataFrame | None = None  # the last rows of any kind
        self.lately: pd.DataFrame | None = None  # tracks of the last rows, by particles
        self.points: dict[tuple[float, str], tuple[Any, Any]] = {}
        self.belief: Any = None  # `Augmented` up to the rows that were filtered for good
        self.end: Any = None  # `Augmented` with those in the window
        self.log_evidence = 0.0
        self.epochs = 0  # that particles have seen
        self.time = -np.inf
        self.ready: Problem | None = None  # the template that `given` belongs to
        self.walked = -np.inf
        self.since: list[float] = []
        self.jumps: list[Jump] = []
        self.doubts: Counter[str] = Counter()  # windows that did not rest, targets that began astray
        self.check = Surveillance(network, float(self.method.gate))

    # what is known

    @cached_property
    def identity(self) -> dict[str, str]:
        """Digests and settings of all that was declared, by name: what a stored state belongs to."""
        arrivals = self.arrivals
        return declared_identity(
            self.network, arrivals.motion, self.calibration, prior=self.prior, epoch=arrivals.epoch,
            fixed_biases=sorted(arrivals.fixed.items()), number_of_targets=arrivals.most,
        )  # fmt: skip

    @property
    def counts(self) -> dict[str, int]:
        """Rows that came, how many of them were late, repeated or refused; outliers; targets that were given up."""
        names = ("rows", "late", "duplicates", "refused", "retired")
        return {name: self.arrivals.counts[name] for name in names} | {"outliers": self.check.outliers}

    @property
    def message(self) -> str:
        """Reasons against the answer, each with its remedy; empty if there are none."""
        return f"{self._judged()[1]} {self.check.text()}".strip()

    def _judged(self) -> tuple[Status, str]:
        """The status, and why intervals may be too narrow."""
        windows, astray, left = self.doubts["windows"], self.doubts["targets"], ANCESTORS
        if self.cloud is not None:
            left = particles.ancestors(self.cloud)
        facts = {
            "windows": f"{windows} window{'s' * (windows > 1)}" if windows else "",
            "astray": f"{astray} target{'s' * (astray > 1)}" if astray else "",
            "ancestors": str(left) if left < ANCESTORS else "",
        }
        return judge(STREAM, facts | {"narrow": any(facts.values()), "unexplained": bool(self.check.unexplained)})

    @property
    def alarmed(self) -> bool:
        """True if the answer is not valid, or if a sensor changed, drifts or was left out for a time."""
        return not self.status.valid or bool(self.check.events)

    @property
    def status(self) -> Status:
        """Status of the calibration, by the rules of fits."""
        return self._judged()[0]

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of the biases that are estimated."""
        return self._problem.labels

    @property
    def _problem(self) -> Problem:
        if self.arrivals.template is None:
            if refused := self.counts["refused"]:
                raise InputError(f"nothing is known: all {refused} rows were refused; Update.refused names the reasons")
            raise InputError("nothing is known before the first rows; call update(rows)")
        return self.arrivals.template

    @property
    @float64
    def biases(self) -> pd.DataFrame:
        """Each bias as all rows so far have it, those in the window too: label, unit, mean, sd, interval, gamma."""
        problem, end = self._problem, self.end
        z, root = np.asarray(end.mean), np.asarray(end.root)
        before = np.sqrt(np.diag(invert(np.asarray(problem.first_precision(self.prior).matrix()))))
        sd = np.sqrt((root**2).sum(1))
        sd = sd * widening_factors(sd, before, self.inflation)
        scales = problem.scales
        return pd.DataFrame(
            {
                "unit": [bias.unit for bias in problem.biases],
                "mean": z * scales,
                "sd": sd * scales,
                "lower": (z - HALF * sd) * scales,
                "upper": (z + HALF * sd) * scales,
                "gamma": np.clip(1.0 - (sd / before) ** 2, 0.0, 1.0),
                "scale": scales,
            },
            index=pd.Index(problem.labels, name="bias"),
        )

    @property
    def inflation(self) -> np.ndarray:
        """Factor (M,) of the part of the variance of each bias that comes from the data, as the innovations have it.

        The largest of the channels that read it, and not less than the mean of all.
        """
        wide, seen = self.check.wide, self.check.tallies.seen - self.check.tallies.held
        factor = np.full(len(self.labels), float(np.average(wide, weights=seen)) if seen.any() else 1.0)
        for k in np.flatnonzero(wide > 1.0):
            mine = self.read_by(self.check.owners[k])
            factor[mine] = np.maximum(factor[mine], wide[k])
        return factor

    def read_by(self, sensor: str) -> np.ndarray:
        """Numbers of the biases that a sensor reads and no other shares by its type."""
        placed = next(own for own in self.arrivals.network.sensors if own.name == sensor)
        owners = {placed.name, *(node.name for node in placed.nodes)}
        return np.flatnonzero([label_parts(label)[0] in owners for label in self.labels])

    @float64
    def under(self, prior: AnyPrior, *, key: int = 0) -> pd.DataFrame:
        """`biases` under a sparse prior in the place of the declared scales: online evidence approximation.

        What the rows say of the biases is a Gaussian likelihood, whatever the prior: a hierarchical one is integrated
        over its precisions as `EA` does, `ARD()` takes those of largest evidence (Paper B 24-25). Raises `InputError`
        where biases walk, jumped or are only considered, or the stream began from an earlier calibration: there is no
        prior of them that could be replaced.
        """
        if self.method.walk or self.method.consider or self.jumps or self.calibration is not None:
            raise InputError(
                "under(prior): biases that walk, jumped, are only considered or come from an earlier calibration have"
                " no prior that could be replaced; fit the rows as a batch"
            )
        problem = self._problem
        precision = problem.first_precision(self.prior)
        chosen = as_prior(prior, Horseshoe(), problem.network.labels)
        moments = relearnt(problem, chosen, precision, np.asarray(self.end.mean), np.asarray(self.end.root), key)
        scales, sd = problem.scales, np.sqrt(np.diag(moments.covariance))
        return self.biases.assign(
            mean=moments.mean * scales, sd=sd * scales, lower=moments.lower * scales, upper=moments.upper * scales,
            gamma=moments.gamma,
        )  # fmt: skip

    def tree(self) -> xr.DataTree:
        """The calibration as a fit leaves it, for `track`, `save` and `Online(calibration=...)`; of its data the last.

        Raises `InputError` before the first rows.
        """
        return calibration_tree(self)

    # rows in

    def run(self, chunks: Iterable[Any]) -> Iterator[Update]:
        """Updates of one table of rows after another; what is still in the window at the end stays there."""
        for rows in chunks:
            yield self.update(rows)

    @float64
    def update(self, rows: Any) -> Update:
        """Filter a table of rows: a path, a DataFrame, in any order.

        Rows that cannot be meant, such as a mark for a missing value or degrees for radians, are left out and named
        in `Update.refused`. Raises `InputError` naming a row that cannot be read; nothing of the table is used then.
        """
        table = read_table(rows)
        with self._unchanged_if_refused():
            frame, refused = self.arrivals.admit(table, self.pending, self.walked if self._moves else -np.inf)
            batch = None if frame.empty else self.arrivals.compiled(frame, table.source)
            if batch is None:
                return self._nothing()._replace(refused=refused)
            self.prepare()
            update = self._filter(frame, batch, everything=False)
            return update._replace(refused=pd.concat([refused, update.refused], ignore_index=True))

    @float64
    def finish(self) -> Update:
        """Filter for good what is still in the window: the stream has ended, or the lag is not to be waited for."""
        batch = None
        if self.pending is not None and not self.pending.empty:
            batch = self.arrivals.compiled(self.pending, "the window")
        if batch is None or self.pending is None:
            return self._nothing()
        with self._unchanged_if_refused():
            return self._filter(self.pending, batch, everything=True)

    @contextmanager
    def _unchanged_if_refused(self) -> Iterator[None]:
        """Restores the filter if the code inside fails or is interrupted: no row counts twice or in part."""
        own = self.__dict__ | {"doubts": self.doubts.copy(), "check": self.check.copy()}
        beside = self.arrivals.copy()
        try:
            yield
        except BaseException:
            self.__dict__, self.arrivals = own, beside
            raise

    def _nothing(self) -> Update:
        return Update(self.time, 0, self._tracks([]), (), 0, True, refused_rows())

    @property
    def _moves(self) -> bool:
        """True if biases may move, so that the order of rows of different targets matters."""
        return bool(self.method.walk) or self.method.jumps is not None

    def prepare(self) -> None:
        """The belief before the first rows, and what stays the same."""
        problem = self._problem
        if self.belief is not None and problem is self.ready:
            return
        self.ready = problem
        M = problem.model.biases
        if M > MANY:
            raise InputError(
                f"{M} biases are too many for an online filter, which takes {MANY}; fix some, or fit a batch"
            )
        if self.belief is None:
            z, root = self._first(problem)
            bias = np.tile(np.arange(M), self._starts)
            self.since = [-np.inf] * self._starts
            self.belief = beliefs.empty(z, root, (), jnp.asarray(bias, int))
        levels = self.levels(problem)
        if isinstance(self.method, ParticleFilter):
            self._populate(problem, self.method)
        held = len(self.belief.slots)
        shapes = [(self.arrivals.most, p.drift.shape[1]) for p in problem.model.recursions[held:]]
        fresh = beliefs.empty(self.belief.mean, self.belief.root, tuple(shapes), self.belief.candidates.bias)
        self.belief = self.belief._replace(slots=self.belief.slots + fresh.slots)
        walk, considered = np.zeros(M), np.zeros(M, bool)
        for pattern, std in self.method.walk:
            chosen = _chosen(problem.labels, pattern, "walk")
            walk[chosen] = std / problem.scales[chosen]
        for pattern in self.method.consider:
            considered[_chosen(problem.labels, pattern, "consider")] = True
        self.given = FilterGiven(jax.device_put(levels), jax.device_put(walk), jax.device_put(considered))
        self.check.reads = {name: frozenset(self.read_by(name).tolist()) for name in self.check.reads}
        self.form = FilterForm(
            self.method.by, bool(walk.any()), bool(considered.any()), not self.method.lag, float(self.method.gate)
        )

    def levels(self, problem: Problem) -> np.ndarray:
        """Log factors (H,) of the unknown noise levels: as the calibration has them, else those of their guesses."""
        if self.calibration is None:
            return np.zeros(len(problem.levels))
        return apply(problem, self.calibration).levels

    @property
    def _starts(self) -> int:
        return 0 if self.method.jumps is None else self.method.jumps.starts

    def _first(self, problem: Problem) -> tuple[jax.Array, jax.Array]:
        """Mean and root of the biases before the stream."""
        if self.calibration is not None:
            known = apply(problem, self.calibration)
            return jax.device_put(known.z), jax.device_put(cholesky(_positive(known.covariance)))
        matrix = np.asarray(problem.first_precision(self.prior).matrix())
        root = cholesky(_positive(invert(matrix)))
        return jnp.zeros(problem.model.biases), jax.device_put(root)

    # epochs through the filter

    def _filter(
        self, frame: pd.DataFrame, batch: Batch, *, everything: bool, restarted: Set[str] = frozenset()
    ) -> Update:
        if isinstance(self.method, ParticleFilter):
            return self._by_particles(frame, batch, self.method)
        problem = self._problem
        K, begun, jumps, frames = len(batch.time), 0, list[Jump](), []
        points = self._points(batch)
        elapsed = np.diff(batch.time, prepend=self.walked if np.isfinite(self.walked) else batch.time[0])
        most, doubts = 0, self.doubts.total()
        change: ChangePoint | None = None  # the next one, up to which epochs are filtered for good
        placed, left_out = 0, list[StreamData]()
        while begun < K:
            if change is not None and change.epoch == begun:
                if change.target:
                    break
                jumps += self._begin_anew(change)
                change = None
            left = (K if change is None else change.epoch) - begun
            count, size, segments = self._window(left)
            new = max(begun, placed)
            self.doubts["targets"] += self._place(batch, points, new, begun + count - new)
            placed = max(placed, begun + count)
            window = Window(
                padded(_part(batch.epochs, begun, begun + count), size),
                _long(elapsed[begun : begun + count], size),
                jax.tree.map(lambda leaf, a=begun, b=begun + count, n=size: _long(leaf[a:b], n), points),
            )
            model = problem.model
            if self.method.lag == 0:
                ends, left_over, moments = run_plain(self.form, model, self.given, self.belief, window)
                stack, kept = jax.tree.map(lambda leaf: np.asarray(leaf)[None], ends), left_over.kept
                xs, sds, done = left_over.x, left_over.sd, np.array([count])
                looked = np.unique(np.append(np.arange(LOOK - 1, count, LOOK), count - 1))
                history = [np.asarray(part)[looked] for part in moments]
                evidence = np.array([_evidence(left_over.kept)])
            else:
                passed = run_window(
                    self.form, model, self.given, self.belief, window, self.method.passes, self.method.tolerance,
                    segments,
                )  # fmt: skip
                stack, xs, sds = jax.tree.map(np.asarray, passed.beliefs), passed.smoothed.x, passed.smoothed.sd
                kept, forced = passed.data, points.verdict
                points = jax.tree.map(lambda old, new, a=begun, n=count: _over(old, new, a, n), points, passed.points)
                points = points._replace(verdict=forced)
                done = np.minimum(np.arange(1, segments + 1) * (size // segments), count)
                evidence = np.asarray(passed.log_evidence)
                looked, history = done - 1, [stack.mean, np.square(stack.root).sum(2)]
                most = max(most, int(passed.passes))
                self.doubts["windows"] += not passed.moved <= max(self.method.tolerance, RESTLESS)
            data = self._data(batch, begun, count, kept)
            if change is None and (found := self._changed(data, begun, restarted)) is not None:
                change = found
                continue
            lag = 0 if (everything or change is not None) and count == left else self.method.lag
            jump = self._jump(stack, done, batch.time[begun : begun + count])
            leaving = jump[0] if jump is not None else int(np.searchsorted(done, count - lag, side="right")) - 1
            if leaving < 0:
                break
            self.belief = jax.tree.map(lambda leaf, s=leaving: leaf[s], stack)
            if not np.isfinite(self.belief.mean).all():
                raise InputError(
                    f"the filter left the finite numbers at time {batch.time[begun]:g}; state where the targets start,"
                    " or take a lag"
                )
            if jump is not None:
                self.belief = beliefs.jumped(self.belief, jax.device_put(jump[1]), jump[3], jump[4])
                jumps.append(jump[2])
                self.since = [float(batch.time[begun + int(done[leaving]) - 1])] * self._starts
            taken = int(done[leaving])
            looked = looked[looked < taken]
            self._follow(batch.time[begun + looked], *(part[: len(looked)] for part in history))
            gone = StreamData(*(column[data.epoch < taken] for column in data))
            self.check.add(gone)
            if jump is not None:
                m = jump[1] % problem.model.biases
                self.check.explain({own for own in self.check.owners if m in self.read_by(own)}, jump[2].since)
            left_out.append(StreamData(*(column[gone.held] for column in gone)))
            self.log_evidence += float(evidence[: leaving + 1].sum())
            frames.append(self._rows_of(batch, begun, taken, xs, sds))
            self.walked = float(batch.time[begun + taken - 1])
            begun += taken
            self._renew()
            if count == left and jump is None and change is None:
                break
        self.arrivals.settled(batch, frame, begun)
        self.pending = frame[batch.row >= begun].reset_index(drop=True)
        self._remember(frame, batch, np.concatenate([*(part.row for part in left_out), data.row[data.held]]))
        self._keep(batch, points, begun)
        self.time = max(self.time, float(batch.time[-1]))
        self.end = self.belief if begun == K else jax.tree.map(lambda leaf: leaf[-1], stack)
        self.jumps = [*self.jumps, *jumps]
        tracks = self._tracks(frames)
        there = tracks["target"] != NOBODY
        settled = self.doubts.total() == doubts
        tracks = tracks[there].reset_index(drop=True)
        news = Update(self.time, begun, tracks, tuple(jumps), most, settled, self._outliers(frame, left_out))
        if change is None or change.epoch > begun:
            return news
        return self._joined(news, self._restarted(change.name, everything, restarted))

    def _restarted(self, name: str, everything: bool, restarted: Set[str]) -> Update:
        """Filter on with a target that begins anew, as one that has just come."""
        assert self.pending is not None
        self.check.restarts += 1
        self.check.targets.pop(name, None)
        own = self.arrivals.targets[name]
        own.time, own.keys = -np.inf, ()
        self.points = {key: point for key, point in self.points.items() if key[1] != name}
        batch = self.arrivals.compiled(self.pending, "the window")
        assert batch is not None
        return self._filter(self.pending, batch, everything=everything, restarted={*restarted, name})

    @staticmethod
    def _joined(first: Update, second: Update) -> Update:
        """Two updates as one."""
        return Update(
            second.time, first.epochs + second.epochs, pd.concat([first.tracks, second.tracks], ignore_index=True),
            first.jumps + second.jumps, max(first.passes, second.passes), first.settled and second.settled,
            pd.concat([first.refused, second.refused], ignore_index=True),
        )  # fmt: skip

    def _follow(self, times: np.ndarray, means: Any, variances: Any) -> None:
        """Look for biases that moved although they are constant, by their moments (S, M) at some times."""
        still = (np.asarray(self.given.walk) == 0) & ~np.asarray(self.given.considered)
        steps = zip(times.tolist(), np.asarray(means), np.asarray(variances), strict=True)
        self.check.follow(self.labels, steps, still)

    def _data(self, batch: Batch, begun: int, count: int, kept: Sequence[Any]) -> StreamData:
        """The data of `count` epochs as a pass left them."""
        parts = []
        for own, owner, numbers in zip(kept, batch.owners, batch.numbers, strict=True):
            epoch, datum = np.nonzero((owner[begun : begun + count, :, 0] >= 0) & (np.asarray(own.spread)[:count] > 0))
            of = begun + epoch, datum
            told = (
                np.asarray(column)[epoch, datum] for column in (own.residual, own.spread, own.lead, own.slope, own.held)
            )
            parts.append(StreamData(
                owner[of][:, 0], epoch, owner[of][:, 1], batch.time[of[0]], batch.target[of[0]], *numbers[of].T, *told
            ))  # fmt: skip
        return data_in_order(parts)

    def _outliers(self, frame: pd.DataFrame, parts: Sequence[StreamData]) -> pd.DataFrame:
        """Line and reason of data of a frame that were held back for good."""
        lines, reasons = list[Any](), list[str]()
        for row, k, value, residual in ((*of,) for part in parts for of in zip(
            part.row, part.channel, part.value, part.residual, strict=True
        )):  # fmt: skip
            lines.append(frame["line"].iloc[row])
            name = f"{self.check.owners[k]}.{self.check.names[k]}"
            reasons.append(f"{name} of {value:.6g} lies {abs(residual):.3g} sd from its prediction: left out")
        return refused_rows(lines, reasons)

    def _changed(self, data: StreamData, begun: int, restarted: Set[str]) -> ChangePoint | None:
        """A sensor or target that changed among the epochs from `begun` on, to be filtered again from there."""
        names = {str(name) for name in np.unique(data.target)} - restarted - {NOBODY}
        restarts = {name for name in names if "position" not in self.arrivals.target(name).start}
        while (found := self.check.change(data, restarts)) is not None:
            label = self.labels[found.bias] if found.bias >= 0 else ""
            if found.target or self.check.begin_anew(found, label, self.method.jumps is not None):
                return found._replace(epoch=begun + found.epoch)
        return None

    def _begin_anew(self, change: ChangePoint) -> tuple[Jump, ...]:
        """The bias that jumped where it is now, or all that a sensor reads as uncertain as its change calls for.

        The jump, where jumps are looked for.
        """
        self.check.snapshots = []
        columns, shift = self._step_of(change)
        belief, slots = beliefs.dispersed(
            self.belief, self.belief.slots, jax.device_put(columns), jax.device_put(-shift)
        )
        self.belief = belief._replace(slots=slots)
        if self.method.jumps is None or change.bias < 0:
            return ()
        candidates = self.belief.candidates.bias.shape[0]
        self.belief = beliefs.renewed(self.belief, jnp.ones(candidates, bool))
        self.since = [self.walked] * self._starts
        scale, odds = self._problem.scales[change.bias], 0.5 * (3.0 * change.size / change.sd) ** 2
        size, sd = float(change.size * scale), float(change.sd * scale)
        return (
            Jump(self.labels[change.bias], change.since, change.found, size, sd, odds, change.found - change.since),
        )

    def _spread(self, change: ChangePoint) -> Cloud:
        """The same in every particle."""
        assert self.cloud is not None
        columns, shift = self._step_of(change)
        root = jax.vmap(lambda own: linalg.tria(jnp.concatenate([own, columns], 1)))(self.cloud.root)
        return self.cloud._replace(root=root, mean=self.cloud.mean + shift[None])

    def _step_of(self, change: ChangePoint) -> tuple[np.ndarray, np.ndarray]:
        """Covariance columns (M, q) and mean (M,) of a step of the biases."""
        own = [change.bias] if change.bias >= 0 else self.read_by(change.name)
        columns, shift = np.zeros((len(self.labels), len(own))), np.zeros(len(self.labels))
        columns[own, np.arange(len(own))] = change.sd if change.bias >= 0 else max(change.size, 1.0)
        shift[own] = change.size if change.bias >= 0 else 0.0
        return columns, shift

    def _explained(self, batch: Batch) -> Any:
        """The epochs of a batch without the rows of sensors that are left out."""
        if not self.check.lost:
            return batch.epochs
        begun, rows = [0] * len(batch.owners), list[Any]()
        for _, _, r, seen in self._problem.model.each_block(batch.epochs.rows):
            mask = np.asarray(seen.mask)
            size = mask.shape[1] * mask.shape[2]
            owner = batch.owners[r][:, begun[r] : begun[r] + size, 0].reshape(mask.shape)
            begun[r] += size
            lost = np.isin(self.check.owners[owner], list(self.check.lost))
            rows.append(seen._replace(mask=np.where((owner >= 0) & lost, 0.0, mask)))
        return batch.epochs._replace(rows=tuple(rows))

    def _remember(self, frame: pd.DataFrame, batch: Batch, held: np.ndarray) -> None:
        """Keep the last rows of which nothing was held back (of a frame, by number)."""
        there = batch.row >= 0
        good = there & ~np.isin(np.arange(len(frame)), held)
        self.last = frame[there].tail(RECENT).reset_index(drop=True)
        if self.recent is None or good.any():
            self.recent = frame[good if good.any() else there].tail(RECENT).reset_index(drop=True)

    def _populate(self, problem: Problem, method: ParticleFilter) -> None:
        """Particles with the slots of every form of a motion."""
        slots = dataclasses.replace(problem.model, targets=(self.arrivals.most,) * len(problem.model.recursions))
        fresh = particles.first_cloud(slots.initial(), self.belief.mean, self.belief.root, method.count)
        if self.cloud is not None:
            states = (*self.cloud.states, *fresh.states[len(self.cloud.states) :])
            fresh = self.cloud._replace(states=states)
        self.cloud = fresh

    def _by_particles(self, frame: pd.DataFrame, batch: Batch, method: ParticleFilter) -> Update:
        """Filter epochs by particles."""
        assert self.cloud is not None
        K, begun, frames, left_out = len(batch.time), 0, [], list[StreamData]()
        elapsed = np.diff(batch.time, prepend=self.walked if np.isfinite(self.walked) else batch.time[0])
        while begun < K:
            count, size, _ = self._window(K - begun)
            key = jax.random.fold_in(jax.random.key(method.seed), self.epochs)
            cloud, left = particles.run_particles(
                self._problem.model, self.given, self.cloud, padded(_part(batch.epochs, begun, begun + count), size),
                _long(elapsed[begun : begun + count], size), key, walks=bool(method.walk), threshold=method.threshold,
                odds=float(method.gate),
            )  # fmt: skip
            evidence = np.asarray(left.log_evidence)[:count]
            if not np.isfinite(evidence).all():
                when = batch.time[begun + int(np.flatnonzero(~np.isfinite(evidence))[0])]
                raise InputError(
                    f"no particle explains the rows at time {when:g}; take more, or state where the targets start"
                )
            self.cloud = cloud
            data = self._data(batch, begun, count, left.kept)
            while (found := self.check.change(data, frozenset())) is not None:  # its rows are behind
                if self.check.begin_anew(found, self.labels[found.bias] if found.bias >= 0 else "", False):
                    self.cloud = self._spread(found)
            self.check.add(data)
            left_out.append(StreamData(*(column[data.held] for column in data)))
            self.log_evidence += float(evidence.sum())
            frames.append(self._rows_of(batch, begun, count, left.x, left.sd))
            begun, self.epochs = begun + count, self.epochs + count
        mean, covariance = particles.bias_moments(self.cloud)
        root = cholesky(_positive(np.asarray(covariance)))
        self.belief = self.end = self.belief._replace(mean=np.asarray(mean), root=root)
        self.walked = self.time = max(self.time, float(batch.time[-1]))
        self.arrivals.settled(batch, frame, K)
        self.pending = frame.iloc[:0]
        self._remember(frame, batch, np.concatenate([part.row for part in left_out]))
        self.lately = self._tracks(frames)
        settled = particles.ancestors(self.cloud) >= ANCESTORS
        return Update(self.time, K, self.lately, (), 0, settled, self._outliers(frame, left_out))

    def _window(self, left: int) -> tuple[int, int, int]:
        """Epochs of the next call, what they are padded to, and into how many parts it falls."""
        lag = self.method.lag
        if not lag:
            few = PLAIN[:-1] if self.method.jumps is not None else PLAIN
            size = next((size for size in few if size >= left), few[-1])
            return min(left, size), size, 1
        many = LIVE if left <= (1 + LIVE) * lag or self.method.jumps is not None else BULK
        size = (1 + many) * lag
        return min(left, size), size, (1 + many) * SEGMENTS

    def _points(self, batch: Batch) -> RowPoints:
        """The last linearisation points of a batch's epochs, and possible places of new targets."""
        problem = self._problem
        K, M = len(batch.time), problem.model.biases
        xs = [np.zeros((K, p.drift.shape[1])) for p in problem.model.recursions]
        z, there = np.zeros((K, M)), np.zeros(K, bool)
        recursion = np.asarray(batch.epochs.recursion)
        for k in range(K) if self.points else ():
            old = self.points.get((float(batch.time[k]), str(batch.target[k])))
            if old is not None:
                xs[recursion[k]][k], z[k], there[k] = old[0], old[1], True
        verdict = tuple(np.zeros(owner.shape[:2], np.int8) for owner in batch.owners)
        found: Any = RowPoints(tuple(xs), z, there, verdict)  # type: ignore[arg-type]
        return found

    def _place(self, batch: Batch, points: Any, begun: int, count: int) -> int:
        """Points of the targets that begin among `count` epochs, in place, as the biases are known before them.

        How many of them a plain filter cannot begin there: neither their first rows nor a start give their place.
        """
        astray, epochs = 0, self._explained(batch)
        problem, belief, K = self._problem, self.belief, len(batch.time)
        xs, z, there, verdict = points
        recursion, first = np.asarray(batch.epochs.recursion), np.asarray(batch.epochs.first)
        for k in (begun + np.flatnonzero((first & ~there)[begun : begun + count])).tolist():
            r, name = int(recursion[k]), batch.target[k]
            mine = np.flatnonzero((batch.target == name) & (np.arange(K) >= k))[: self._looked_at(batch, k)]
            few = padded(jax.tree.map(lambda leaf, mine=mine: leaf[mine], epochs), FIRST)
            span = problem.epochs[r].position
            many = (batch.owners[r][k, :, 0] >= 0).sum() > problem.network.dimension + 1
            gate = float(self.method.gate)
            x, far = place_new(problem.model, self.given, belief, few, r, span, self.arrivals.tried, gate)
            if gate and many:  # its prior lets all in
                verdict[r][k] = np.where(np.asarray(far), beliefs.HOLD, beliefs.DECIDE)
            if self.method.lag:
                xs[r][mine], z[mine], there[mine] = np.asarray(x), np.asarray(belief.mean), True
            elif "position" not in self.arrivals.target(str(name)).start:
                batch.epochs.move[r].drift[k] = np.asarray(x)  # of a start that is wide: what is linearised first
            else:
                xs[r][k], z[k], there[k] = np.asarray(x), np.asarray(belief.mean), True
            if not self.method.lag and self._looked_at(batch, k) > 1:
                wide = np.sqrt((batch.epochs.move[r].L[k] ** 2).sum(1))[slice(*span)].max()
                area = self.arrivals.area
                assert area is not None
                astray += not wide <= NEAR * area.extent
        return astray

    def _looked_at(self, batch: Batch, k: int) -> int:
        """Epochs by which a new target is placed: a plain filter takes its first where that has data enough."""
        data = sum(int((np.asarray(seen.mask[k]) > 0).sum()) for seen in batch.epochs.rows)
        return 1 if not self.method.lag and data >= self._problem.network.dimension else FIRST

    def _keep(self, batch: Batch, points: RowPoints, begun: int) -> None:
        """Points of the epochs that stay in the window."""
        recursion = np.asarray(batch.epochs.recursion)
        self.points = {
            (float(batch.time[k]), str(batch.target[k])): (points.x[recursion[k]][k], points.z[k])
            for k in range(begun, len(batch.time))
            if points.there[k]
        }

    def _renew(self) -> None:
        """Let the oldest candidates begin anew where it is time."""
        if self.method.jumps is None:
            return
        every = self.method.jumps.within / self.method.jumps.starts
        if self.walked - max(self.since) >= every:
            self._renew_oldest()

    def _renew_oldest(self) -> None:
        """Let the oldest candidates begin anew."""
        oldest = int(np.argmin(self.since))
        M = self._problem.model.biases
        columns = np.repeat(np.arange(self._starts) == oldest, M)
        self.belief = beliefs.renewed(self.belief, jax.device_put(columns))
        self.since = [*self.since[:oldest], self.walked, *self.since[oldest + 1 :]]

    def _jump(self, stack: Augmented, done: np.ndarray, times: np.ndarray) -> Any:
        """The first part at the end of which some candidate exceeds the bound, it, the `Jump`, size and variance."""
        jumps = self.method.jumps
        if jumps is None:
            return None
        problem, told = self._problem, stack.candidates
        M = problem.model.biases
        information, score = np.asarray(told.information), np.asarray(told.score)
        since = np.repeat(self.since, M)
        precision = information + jumps.scale**-2
        odds = 0.5 * score**2 / precision - 0.5 * np.log1p(jumps.scale**2 * information)
        odds = np.where(np.isfinite(since)[None], odds, -np.inf)
        bound = jumps.bound(M)
        found = np.flatnonzero(odds.max(1) > bound)
        if not len(found):
            return None
        part = int(found[0])
        which = int(np.argmax(odds[part]))
        m, size = which % M, score[part, which] / precision[part, which]
        scale, end = problem.scales[m], float(times[int(done[part]) - 1])
        started = since[which] if np.isfinite(since[which]) else float(times[0])
        later = [own for own in self.since if own > started]
        gap = min([*later, end]) - started  # it may have begun so much later, and then is larger
        undated = size * gap / max(end - started, 1e-9)
        variance = 1.0 / precision[part, which] + undated**2
        share = 2.0 * bound / size**2 / max(information[part, which], 1e-300)
        own = Jump(
            problem.labels[m], float(started), end, float(size * scale), float(scale * np.sqrt(variance)),
            float(odds[part, which]), float(min(share, 1.0) * (end - started)),
        )  # fmt: skip
        return part, which, own, jax.device_put(size), jax.device_put(variance)

    # what is known

    def _rows_of(self, batch: Batch, begun: int, taken: int, xs: Sequence[Any], sds: Sequence[Any]) -> Any:
        recursion = np.asarray(batch.epochs.recursion)[begun : begun + taken]
        parts = []
        for r, (x, sd) in enumerate(zip(xs, sds, strict=True)):
            mine = np.flatnonzero(recursion == r)
            names = self.arrivals.components(r)
            frame = pd.DataFrame({"time": batch.time[begun + mine], "target": batch.target[begun + mine]})
            values, stds = np.asarray(x)[mine], np.asarray(sd)[mine]
            for j, name in enumerate(names):
                frame[name], frame[f"{name}_sd"] = values[:, j], stds[:, j]
            parts.append(frame)
        return pd.concat(parts, ignore_index=True) if len(parts) > 1 else parts[0]

    def _tracks(self, frames: Sequence[Any]) -> pd.DataFrame:
        if not frames:
            return pd.DataFrame({"time": np.zeros(0), "target": np.zeros(0, str)})
        return pd.concat(frames, ignore_index=True).sort_values("time", kind="stable", ignore_index=True)


def _check_gate(method: Any) -> None:
    """Raise `InputError` unless the gate of a filter is a probability of rare data."""
    if not (isinstance(method.gate, (int, float)) and 0 <= method.gate <= 0.01):
        raise InputError(
            f"{type(method).__name__}(gate={method.gate!r}): give the probability of a datum to be left out, 0 to 0.01"
        )


def _walks(name: str, given: Any) -> tuple[tuple[str, float], ...]:
    """Patterns of biases and the standard deviation of their walk; raises `InputError` for one that is not positive."""
    pairs = given.items() if isinstance(given, Mapping) else given
    walk = tuple((str(pattern), float(std)) for pattern, std in pairs)
    for pattern, std in walk:
        if not (np.isfinite(std) and std > 0):
            raise InputError(f'{name}: walk of "{pattern}" is {std:g}; give a positive std for one second')
    return walk


def _chosen(labels: Sequence[str], pattern: str, what: str) -> np.ndarray:
    """Numbers of the biases that a pattern matches; raises `InputError` where it matches none."""
    found = [m for m, label in enumerate(labels) if label == pattern or fnmatchcase(label, pattern)]
    if not found:
        raise InputError(f'AugmentedFilter: {what} "{pattern}" matches no bias{nearest(pattern, labels)}')
    return np.array(found)


def _positive(matrix: np.ndarray) -> np.ndarray:
    """A covariance that has a Cholesky factor, biases that are known exactly given a variance of rounding."""
    return matrix + 1e-12 * np.eye(len(matrix))


def _part(epochs: Any, start: int, stop: int) -> Any:
    return jax.tree.map(lambda leaf: leaf[start:stop], epochs)


def _long(array: np.ndarray, size: int) -> Any:
    """An array with zeros behind it up to a size."""
    more = size - len(array)
    return np.concatenate([array, np.zeros((more, *array.shape[1:]), array.dtype)]) if more else array


def _over(old: np.ndarray, new: jax.Array, begun: int, count: int) -> np.ndarray:
    """An array with some of it replaced."""
    after = old.copy()
    after[begun : begun + count] = np.asarray(new)[:count]
    return after


def _evidence(kept: Any) -> float:
    total = 0.0
    for own in kept:
        variance, innovation = np.asarray(own.variance), np.asarray(own.innovation)
        used = variance > 0
        total -= 0.5 * float((innovation[used] ** 2 + np.log(variance[used])).sum())
    return total
