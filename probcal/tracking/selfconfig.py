"""Self-configuration: a method for detections that name no target, around one for rows that do."""

from dataclasses import dataclass
from typing import Any, ClassVar

from probcal.errors import InputError
from probcal.inference.run import Context, Method
from probcal.priors import Prior
from probcal.problem import Problem
from probcal.results.answer import Answer
from probcal.smoothing.mode import Point

STARTS = ("stated", "beliefs")


@dataclass(frozen=True)
class SelfConfiguration(Method):
    """Biases from detections that name no target: objects are tracked and the network fitted in turn, by EM.

    Each round tracks the objects at the biases of the last one, whose uncertainty counts as noise of each detection
    (`track_objects`: `objects` expected at first, `births` a second, `lifetime` in s, `most` tracks at a time, those
    `confirmed` count), and fits what belongs together, each pair of detection and track with its weight, by `method`.
    It ends when no bias moves by more than `tolerance` of its sd. The intervals are those of `method` given the weights
    of the last round. The stated poses, within their scales, are where it starts: objects that two sensors see must lie
    nearer to each other than to others. With `start="beliefs"` each sensor is first tracked alone, and belief
    propagation over the pairs finds where they stand (`propagate_beliefs`, scans within `window` s), however far that
    is within their scales. Raises `InputError` naming a setting that is none.

    >>> from probcal import EA
    >>> SelfConfiguration(EA()).iterations
    12
    """

    method: Method
    iterations: int = 12
    tolerance: float = 0.05
    objects: float = 3.0
    births: float = 0.02
    lifetime: float = 600.0
    most: int = 32
    confirmed: float = 0.9
    start: str = "stated"
    window: float | None = None

    name: ClassVar[str] = "self-configuration"

    def __post_init__(self):
        if not isinstance(self.method, Method) or isinstance(self.method, SelfConfiguration):
            raise InputError("SelfConfiguration(method): give the method that fits labelled rows, such as EA()")
        if self.start not in STARTS or not (self.window is None or self.window > 0):
            given = f'start="{self.start}", window={self.window}'
            raise InputError(f"SelfConfiguration({given}): start is stated or beliefs, window seconds above 0 or None")
        if self.iterations < 1 or not self.tolerance > 0:
            given = f"iterations={self.iterations}, tolerance={self.tolerance}"
            raise InputError(f"SelfConfiguration({given}): take 1 or more iterations and a positive tolerance")

    @property
    def expected(self) -> dict[str, Any]:
        """What is expected of objects."""
        return {name: getattr(self, name) for name in ("objects", "births", "lifetime")}

    @property
    def chances(self) -> dict[str, Any]:
        """The settings of `track_objects`."""
        return self.expected | {"most": self.most, "confirmed": self.confirmed}

    def first_prior(self) -> Prior:
        """That of the method within."""
        return self.method.first_prior()

    def takes(self, prior: Prior) -> bool:
        """What the method within takes."""
        return self.method.takes(prior)

    def note(self, prior: Prior) -> str:
        """What the intervals are worth: those of the method within, associations held."""
        return f"{self.method.note(prior)}; the associations are held at their weights"

    def answer(self, problem: Problem, prior: Prior, start: Point, context: Context) -> Answer:
        """That of the method within, where rows name their targets."""
        return self.method.answer(problem, prior, start, context)
