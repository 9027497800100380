"""Declaration of a sensor type: the physics of one sensor that sees one target, as a function."""

import hashlib
import inspect
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from probcal.detection import Detection
from probcal.errors import InputError, check_known, nearest
from probcal.fingerprint import computes
from probcal.labels import AXES, check_name
from probcal.noise import AdditiveNoise, Bernoulli, Family, Growing, Grows, Heard, Memory, Normal, check_level
from probcal.types import PoseView, TargetView, untraceable

VECTORS = ("position", "velocity", "acceleration", "moment")  # have one value an axis without being declared so
PERIODS = {"rad": 2 * np.pi, "deg": 360.0}
WORDS = {  # unit: words that stand for it where the symbol is asked for, in the singular
    "m": ("meter", "metre"), "km": ("kilometer", "kilometre"), "cm": ("centimeter", "centimetre"),
    "mm": ("millimeter", "millimetre"), "ft": ("foot", "feet"), "mi": ("mile",), "rad": ("radian",), "deg": ("degree",),
    "s": ("second", "sec"), "ms": ("millisecond",), "min": ("minute",), "h": ("hour",), "Hz": ("hertz",),
    "kHz": ("kilohertz",), "dB": ("decibel",), "dBm": (), "%": ("percent",),
}  # fmt: skip


def meant_unit(unit: str) -> str | None:
    """The symbol of a unit that is written as a word or in other letters, None where it is none of
    `WORDS`."""
    if unit in WORDS:
        return None
    word = unit.strip().lower()
    for symbol, words in WORDS.items():
        other = {symbol.lower()} if len(symbol) > 1 else set()
        if {word, word.removesuffix("s")} & {*words, *other}:
            return symbol
    return None


def _check_unit(kind: str, unit: Any) -> None:
    """Raise `InputError` for a unit that is no text, or the word for one."""
    if not isinstance(unit, str):
        raise InputError(f'{kind}({unit!r}, ...): the first argument is the unit, a string such as "m"')
    if meant := meant_unit(unit):
        raise InputError(f'{kind}: the unit "{unit}" is not known; write "{meant}"')


@dataclass(frozen=True)
class Drift:
    """The drift of a bias: constant from each of the `times` (T,) to the next, the first also
    before it.

    `times` are seconds of the table (of its first row on, where the table has dates).

    `std`, in the bias's unit s^-1/2, makes a random walk: a step over dt has the known standard deviation
    std * sqrt(dt). `scale`, in its unit, is that of every step and governed by the prior chosen at the fit: a sparse
    one finds jumps. Raises `InputError` unless one of the two is positive and the times increase.

    >>> Drift([0.0, 60.0, 120.0], scale=0.5).scale
    0.5
    """

    times: Any
    std: float | None = None
    scale: float | None = None

    def __post_init__(self):
        given = np.asarray(self.times)
        times = given.astype(float) if given.dtype.kind in "iuf" else np.full(1, np.nan)  # no dates
        if times.ndim != 1 or len(times) < 2 or not np.isfinite(times).all() or not (np.diff(times) > 0).all():
            raise InputError(
                "Drift: times are those at which the pieces start, in seconds of the table, two or more, increasing"
            )
        if np.diff(times).min() < 1e-3:
            raise InputError("Drift: times are less than a millisecond apart; merge those pieces")
        if (self.std is None) == (self.scale is None):
            raise InputError(
                "Drift: give either std (a random walk of known level) or scale (steps that the prior governs)"
            )
        size = self.std if self.scale is None else self.scale
        if not isinstance(size, (int, float)) or not (np.isfinite(size) and size > 0):
            raise InputError(f"Drift: {'std' if self.scale is None else 'scale'} is {size}; it must be positive")
        object.__setattr__(self, "times", tuple(times.tolist()))

    @property
    def steps(self) -> tuple[tuple[float, float], ...]:
        """Time of each step, and its standard deviation in the bias's unit."""
        gaps = np.diff(self.times)
        sizes = np.full(len(gaps), self.scale) if self.std is None else self.std * np.sqrt(gaps)
        return tuple(zip(self.times[1:], sizes.tolist(), strict=True))


ZEROS = ("expected", "none", "learnt")


@dataclass(frozen=True)
class Bias:
    """An unknown parameter of a sensor: its unit, prior scale (standard deviation) and nominal value.

    The function receives nominal + bias, tables report the bias. `shared="type"` gives one bias to all
    sensors of the type. With a `drift` it changes in time: `<label>@<time>` is its step at that time, to the
    millisecond.

    `zeros` says how a sparse prior treats this kind of bias. "expected": many are zero, and the prior
    finds those that are not. "none": none is zero, as antenna delays; the kind is Gaussian of its
    scale. "learnt": the kind has hyper-parameters of its own, by which the data say whether few are
    zero or most (`Prior.adaptive`). `Gaussian` and `Flat` take all kinds alike. A pattern in the
    prior of a fit (`prior={"*.delay": Gaussian()}`) is above the declaration.

    >>> Bias("m", 5.0).scale
    5.0
    >>> Bias("m", 0.3, zeros="none").zeros
    'none'
    """

    unit: str
    scale: float
    nominal: float = 0.0
    shared: str | None = None
    drift: Drift | None = None
    zeros: str = "expected"

    def __post_init__(self):
        _check_unit("Bias", self.unit)
        if self.zeros not in ZEROS:
            raise InputError(f"Bias({self.unit!r}, zeros={self.zeros!r}): zeros is one of {', '.join(ZEROS)}")
        if not (np.isfinite(self.scale) and self.scale > 0):
            raise InputError(
                f"Bias({self.unit!r}, scale={self.scale}): the scale must be positive; to fix a bias use fix="
            )
        if not np.isfinite(self.nominal):
            raise InputError(f"Bias({self.unit!r}, nominal={self.nominal}): the nominal value must be finite")
        if self.shared not in (None, "type"):
            raise InputError(f'Bias({self.unit!r}, shared={self.shared!r}): shared is None or "type"')
        if not isinstance(self.drift, Drift | None):
            raise InputError(f"Bias({self.unit!r}, drift={self.drift!r}): give Drift(times, std=...) or scale=...")


@dataclass(frozen=True)
class Channel:
    """One measured quantity: its unit, noise level (a number or `Unknown`), noise family and wrapping.

    `wrap=True` compares angles around the circle; `per_axis=True` makes one channel a coordinate
    (`position_x`, `position_y`, ...). `compass=True`: tables hold bearings clockwise from north, which are turned into
    mathematical angles (from east, counter-clockwise) when they are read, and back when they are written. With
    `std=Grows(std, slope)` the noise grows with the predicted value; with a `memory` a part of it is correlated in
    time.

    >>> Channel("rad", std=0.01, wrap=True).period  # doctest: +ELLIPSIS
    6.28...
    """

    unit: str
    std: Any = 1.0  # a level, or `Grows`
    noise: Family = field(default_factory=Normal)
    wrap: bool = False
    per_axis: bool = False
    compass: bool = False
    memory: Memory | None = None

    def __post_init__(self):
        _check_unit("Channel", self.unit)
        if not hasattr(self.noise, "log_likelihood"):
            raise InputError(
                f"Channel({self.unit!r}, noise={self.noise!r}): give a noise family such as StudentT(4), Mixture(), "
                f"Bernoulli() or probcal.noise.Normal(); probcal.Gaussian is a prior"
            )
        if isinstance(self.std, Grows):
            if isinstance(self.noise, Heard) or not isinstance(self.noise, AdditiveNoise) or self.wrap:
                raise InputError(f"Channel({self.unit!r}, std=Grows(...)): the noise must be additive, and not wrap")
            object.__setattr__(self, "noise", Growing(self.noise, self.std.slope))
            object.__setattr__(self, "std", self.std.std)
        if not isinstance(self.noise, Bernoulli):
            check_level(self.std, f"Channel({self.unit!r}): std", by=True)
        if self.wrap and self.unit not in PERIODS:
            raise InputError(f"Channel({self.unit!r}, wrap=True): only angles in rad or deg wrap")
        if self.wrap and isinstance(self.noise, Heard):
            raise InputError(f"Channel({self.unit!r}, wrap=True): an angle has no least value; give another noise")
        if self.memory is not None and not (
            isinstance(self.memory, Memory) and isinstance(self.noise, AdditiveNoise | Growing)
        ):
            raise InputError(
                f"Channel({self.unit!r}, memory={self.memory!r}): give Memory(std, time), with noise that is additive"
            )
        if self.memory is not None and isinstance(self.noise, Heard):
            raise InputError(f"Channel({self.unit!r}, memory=...): a floor has no memory; give another noise")
        if self.compass and not self.wrap:
            raise InputError(f"Channel({self.unit!r}, compass=True): a compass bearing wraps; give wrap=True too")

    @property
    def period(self) -> float | None:
        """Length of the circle in the channel's unit, or None."""
        return PERIODS[self.unit] if self.wrap else None

    def turned(self, value: Any) -> Any:
        """A value of a table as the sensor function counts it, or the other way: a compass bearing is mirrored."""
        return PERIODS[self.unit] / 4 - value if self.compass else value


@dataclass(frozen=True, eq=False)
class SensorType:
    """A declared sensor type; `on(node)` places one, `on(a, b, ...)` one that uses several nodes."""

    name: str
    function: Callable[..., Mapping[str, Any]]
    channels: Mapping[str, Channel]
    biases: Mapping[str, Bias]
    arity: int
    target_components: frozenset[str]  # what the function reads; "at" where it extrapolates
    pose_components: frozenset[str]
    dimensions: tuple[int, ...]  # those in which the function works
    vectors: frozenset[str] = frozenset(VECTORS)  # components of targets and poses with one value an axis
    clocked: bool = False  # whether rows are taken at the time of their node's clock (`clocks.by_clock`)

    @cached_property
    def fingerprint(self) -> str:
        """The digest of the type's function and declarations: types of equal digest are equal and
        share compiled kernels.

        It covers the operations and constants of the function, its channels and biases. Raises `InputError` where the
        function computes something else at every call.
        """
        parts = [self._computes(dimension) for dimension in self.dimensions]
        if parts != [self._computes(dimension) for dimension in self.dimensions]:
            raise InputError(
                f"sensor {self.name}: the function computes something else at every call; leave random numbers to the"
                " noise of its channels"
            )
        declared = (self.name, self.arity, sorted(self.target_components), sorted(self.pose_components))
        text = repr((declared, list(self.channels.items()), list(self.biases.items()), self.dimensions, parts))
        return hashlib.sha256(text.encode()).hexdigest()

    def _computes(self, dimension: int) -> str:
        """Digest of what the function computes in 2-D or 3-D."""

        def stated(names: set[str]) -> dict[str, jax.ShapeDtypeStruct]:
            return {n: jax.ShapeDtypeStruct((dimension,) if n in self.vectors else (), float) for n in sorted(names)}

        moving = {"velocity", "acceleration"} if "at" in self.target_components else set()
        target = stated({"position"} | set(self.target_components) - {"at"} | moving)
        pose = stated({"position", "heading", "pitch", "roll"} | set(self.pose_components))

        def one(target: Any, poses: list[Any], biases: Mapping[str, Any]) -> Mapping[str, Any]:
            views = [PoseView("the node", parts) for parts in poses]
            return self.function(TargetView("the target", target), *views, **biases)

        return computes(one, target, [pose] * self.arity, stated(set(self.biases)))

    def __eq__(self, other: object) -> bool:
        return self is other or (isinstance(other, SensorType) and self.fingerprint == other.fingerprint)

    def __hash__(self) -> int:
        return hash(self.fingerprint)

    @property
    def reads_target(self) -> bool:
        """True where the function reads its target; the distance between two nodes does not."""
        return bool(self.target_components)

    def on(self, *nodes: Any, name: str | None = None, detection: Detection | None = None) -> "Sensor":
        """Place a sensor of this type on its node(s); the name defaults to that of the node(s).

        With `detection` its rows need not name a target: they are detections, those of one time a scan.
        """
        if len(nodes) != self.arity:
            raise InputError(f"{self.name} uses {self.arity} node(s), {len(nodes)} given")
        if detection is not None and not isinstance(detection, Detection):
            raise InputError(
                f"{self.name}: detection is {type(detection).__name__}; give Detection(probability, clutter)"
            )
        if detection is not None:
            known = {f"{n}_{axis}" if c.per_axis else n for n, c in self.channels.items() for axis in AXES}
            for channel, _ in detection.limits:
                check_known(channel, known, f'{self.name}: detection limits "{channel}"')
        name = "-".join(str(node.name) for node in nodes) if name is None else str(name)
        check_name(f"{self.name}: a sensor", name)
        return Sensor(self, tuple(nodes), name, detection)

    def expand(self, dimension: int) -> tuple[tuple[str, Channel], ...]:
        """Scalar channels by name, those declared per axis once a coordinate."""
        named: list[tuple[str, Channel]] = []
        for name, channel in self.channels.items():
            axes = [f"_{axis}" for axis in AXES[:dimension]] if channel.per_axis else [""]
            named += [(name + axis, channel) for axis in axes]
        return tuple(named)

    def evaluate(self, target: TargetView, poses: list[PoseView], biases: Mapping[str, Any]) -> jax.Array:
        """Predicted values of one row, shape (channels,), in the order of `expand`."""
        values = self.function(target, *poses, **biases)
        parts = [jnp.atleast_1d(jnp.asarray(values[name])) for name in self.channels]
        for name, part in zip(self.channels, parts, strict=True):
            width = target.position.shape[0] if self.channels[name].per_axis else 1
            if part.shape != (width,):
                raise InputError(
                    f'sensor {self.name}: channel "{name}" has shape {part.shape}, expected '
                    f"{(width,) if self.channels[name].per_axis else 'a scalar'}"
                )
        return jnp.concatenate(parts)


@dataclass(frozen=True, eq=False)
class Sensor:
    """A placed sensor: its type, its node(s) and its unique name, which the table's `sensor` column holds."""

    type: SensorType
    nodes: tuple[Any, ...]
    name: str
    detection: Detection | None = None  # where its rows need not name a target
    # its biases that were calibrated: nominal is the value
    known: Mapping[str, Bias] = field(default_factory=dict)


class _Probe:
    """Stands for a target or a pose at decoration: answers any component and records what is asked for.

    `strict` answers NumPy vectors, which complain where a jax array clamps the index of an axis it lacks.
    """

    def __init__(self, dimension: int, asked: set[str], vectors: frozenset[str], strict: bool = False):
        self._dimension = dimension
        self._vectors = vectors
        self._asked = asked
        self._ones = np.ones if strict else jnp.ones

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        self._asked.add(name)
        return self._ones(self._dimension if name in self._vectors else ())

    def at(self, dt: Any) -> "_Probe":
        self._asked |= {"position", "at"}
        return self

    def turn(self, vector: Any) -> Any:
        self._asked |= {"heading"} | ({"pitch", "roll"} if self._dimension == 3 else set())
        return vector - self._ones(self._dimension)

    def local(self, point: Any) -> Any:
        self._asked.add("position")
        return self.turn(point)


def _probe(
    function: Callable, arity: int, biases: Mapping[str, Bias], vectors: frozenset[str]
) -> tuple[Any, set[str], set[str], list[int]]:
    """Call the function on probes in 2-D, then 3-D: its channels, what it asks for, and where it works."""
    failure = None
    returned = None
    target_asked = set()
    pose_asked = set()
    dimensions = []
    for dimension in (2, 3):
        target: set[str] = set()
        pose: set[str] = set()

        def call(
            strict: bool, dimension: int = dimension, target: set[str] = target, pose: set[str] = pose
        ) -> Mapping[str, Any]:
            poses = [_Probe(dimension, pose, vectors, strict) for _ in range(arity)]
            return function(
                _Probe(dimension, target, vectors, strict), *poses, **{name: jnp.ones(()) for name in biases}
            )

        try:
            found = jax.eval_shape(partial(call, False))
        except Exception as error:  # whatever the user's function raises is reported with its name
            failure = error
            continue
        try:
            jax.eval_shape(partial(call, True))
        except IndexError as error:
            failure = error
            continue
        except Exception:  # a function that cannot work on NumPy vectors has passed on those of jax
            pass
        returned = found
        target_asked |= target
        pose_asked |= pose
        dimensions.append(dimension)
    if failure is not None and returned is None:
        reason = untraceable(failure) or f"the function failed on a trial call: {failure}"
        raise InputError(f"sensor {function.__name__}: {reason}") from failure
    return returned, target_asked, pose_asked, dimensions


def sensor(
    *, vectors: Iterable[str] = (), **channels: Channel
) -> Callable[[Callable[..., Mapping[str, Any]]], SensorType]:
    """Declare a sensor type from a function `f(target, pose, *, bias=Bias(...))` that returns its channels.

    The function sees one target and a pose for each of its nodes, and returns a dict of scalars by
    channel name; keyword-only arguments are its biases. It is traced by jax: write `jnp.` for `np.`
    and `math.`, and `jnp.where(condition, a, b)` for `if`.

    The target offers, in the common frame:

    - `position`, `velocity`, `acceleration` (d,) in m, m/s, m/s^2, as far as its motion has them;
    - each further component of the motion by its name, such as `power` of `RandomWalk("power", "dB", 1.0)`;
    - `at(dt)`: the target dt seconds later, along velocity and acceleration.

    A pose offers, with its biases added:

    - `position`, `velocity` (d,), the velocity that of its `Path`, else 0;
    - `heading` in rad from the x axis (east), counter-clockwise; in 3-D `pitch`, positive with the nose up, and
      `roll`, positive with the left side up;
    - `clock` in m, `time_offset` in s, and what the node states, such as `gain` of `Node(..., gain=0.0)`;
    - `local(point)`: a point in the node's own axes, from the node: x ahead, y left, z up;
    - `turn(vector)`: a vector in these axes.

    `vectors` names the further components with one value per axis, as in `vectors=("wind",)`;
    position, velocity, acceleration and moment need no name. `probcal.geometry` has `norm`,
    `bearing` and `elevation` with finite gradients. Raises `InputError` naming function and
    argument.

    >>> from probcal.geometry import norm
    >>> @sensor(range=Channel("m", std=0.5))
    ... def sounder(target, pose, *, offset=Bias("m", 2.0)):
    ...     return {"range": norm(target.position - pose.position) + offset}
    >>> list(sounder.biases)
    ['offset']
    """
    if isinstance(vectors, (str, Channel)) or not all(isinstance(name, str) for name in vectors):
        raise InputError(f'sensor vectors={vectors!r}: give the names of components, as in vectors=("wind",)')
    known = frozenset((*VECTORS, *vectors))
    for name, channel in channels.items():
        if not isinstance(channel, Channel):
            raise InputError(f"sensor channel {name}={channel!r}: give Channel(unit, std=...)")
    if not channels:
        raise InputError('sensor() needs at least one channel, such as @sensor(range=Channel("m", std=1.0))')

    def declare(function: Callable[..., Mapping[str, Any]]) -> SensorType:
        label = function.__name__
        positional, biases = [], {}
        for parameter in inspect.signature(function).parameters.values():
            if parameter.kind is parameter.KEYWORD_ONLY:
                if not isinstance(parameter.default, Bias):
                    raise InputError(f'sensor {label}: argument "{parameter.name}" needs Bias(unit, scale) as default')
                biases[parameter.name] = parameter.default
            elif parameter.kind in (parameter.POSITIONAL_ONLY, parameter.POSITIONAL_OR_KEYWORD):
                if isinstance(parameter.default, Bias):
                    raise InputError(
                        f'sensor {label}: argument "{parameter.name}" is a bias: write a * before the first bias, as in'
                        f" def {label}(target, pose, *, {parameter.name}=Bias(...))"
                    )
                positional.append(parameter.name)
            else:
                raise InputError(f'sensor {label}: argument "*{parameter.name}" is not allowed')
        arity = len(positional) - 1
        if arity < 1:
            raise InputError(
                f"sensor {label}: the arguments are (target, pose, *, biases), with one pose for each node,"
                f" found ({', '.join(positional)})"
            )
        returned, target_asked, pose_asked, dimensions = _probe(function, arity, biases, known)
        if not isinstance(returned, Mapping) or set(returned) != set(channels):
            found = sorted(returned) if isinstance(returned, Mapping) else type(returned).__name__
            wrong = next((n for n in found if n not in channels), None) if isinstance(returned, Mapping) else None
            hint = nearest(wrong, channels) if wrong else ""
            raise InputError(f"sensor {label}: returns {found}, but the declared channels are {sorted(channels)}{hint}")
        for name, value in returned.items():
            if jnp.issubdtype(value.dtype, jnp.complexfloating):
                raise InputError(f'sensor {label}: channel "{name}" is complex; return its real part')
        return SensorType(
            name=label,
            function=function,
            channels=dict(channels),
            biases=biases,
            arity=arity,
            target_components=frozenset(target_asked),
            pose_components=frozenset(pose_asked),
            dimensions=tuple(dimensions),
            vectors=known,
        )

    return declare
