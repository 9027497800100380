"""Self-configuration: a method for detections that name no target, around one for rows that do."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from probcal.errors import FitError, InputError
from probcal.gaussian.mode import Point
from probcal.inference.method import Context, FitLabelled, Method, MethodTask
from probcal.lazy import Later
from probcal.priors import Prior
from probcal.problem import Problem
from probcal.results.answer import Answer
from probcal.status import OBJECTS, judge
from probcal.tracking.configure import Configured, Rounds, configure
from probcal.tracking.groups import belief_group, disagreeing, with_objects

if TYPE_CHECKING:
    import xarray as xr
else:
    xr = Later("xarray")

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
        """The settings of expected objects: number, births and lifetime."""
        return {name: getattr(self, name) for name in ("objects", "births", "lifetime")}

    @property
    def chances(self) -> dict[str, Any]:
        """The settings of `track_objects`."""
        return self.expected | {"most": self.most, "confirmed": self.confirmed}

    def first_prior(self) -> Prior:
        """That of the method within."""
        return self.method.first_prior()

    def takes(self, prior: Prior) -> bool:
        """Returns True if the method within takes this prior."""
        return self.method.takes(prior)

    def note(self, prior: Prior) -> str:
        """The validity of the intervals: that of the method within, associations held."""
        return f"{self.method.note(prior)}; the associations are held at their weights"

    def configured(
        self, problem: Problem, prior: Prior, context: Context, fit: FitLabelled
    ) -> tuple[xr.DataTree, Answer]:
        """The fit of detections that name no target, with the objects that were found as groups of the tree."""
        how = Rounds(
            self.name, self.method, self.iterations, self.tolerance, self.start == "beliefs", self.window,
            self.expected, self.chances,
        )  # fmt: skip
        with context.monitor.interruptible():
            found = configure(problem, how, prior, context)
        if silent := found.labelled.silent:
            raise FitError(
                f"No detection of {', '.join(silent)} belongs to an object that is confirmed: all count as clutter, and"
                " its biases are not found. Take it out of the network, or check its clock, its stated pose and"
                " Detection(...)."
            )
        tree, answer = fit(found.labelled, self.method)
        if answer.status.settled:
            status, said = judge(OBJECTS, _facts(found, answer.posterior.summary.mean, self.name), answer.status)
            answer = replace(answer, status=status, message=f"{said} {answer.message}".strip())
            tree.attrs |= {"status": str(answer.status), "message": answer.message}
        objects, scans = len(found.objects.names), len(problem.scans or ())
        said = f"{objects} objects in {scans} scans, found in {found.rounds} rounds of {self.name}."
        tree.attrs |= {"rounds": found.rounds, "message": f"{said} {tree.attrs['message']}".strip()}
        tree = with_objects(tree, found.objects, found.problem, answer.posterior.summary.mean)
        if found.beliefs is not None:
            tree["belief"] = xr.DataTree(belief_group(found.beliefs))
        if len(found.rates):
            tree["rate"] = xr.DataTree(found.rates.rename_axis("line").to_xarray())
        return tree, answer

    def task(self, problem: Problem, prior: Prior, start: Point, context: Context) -> MethodTask:
        """That of the method within, where rows name their targets."""
        return self.method.task(problem, prior, start, context)


def _facts(found: Configured, z: np.ndarray, name: str) -> dict[str, Any]:
    """Objects and biases that do not agree, in the names of `probcal.status.OBJECTS`. Biases z (M,)."""
    beliefs = found.beliefs
    rivals = {} if beliefs is None else beliefs.rivals
    return {
        "method": name, "rounds": found.rounds, "moving": not found.rests,
        "apart": "" if beliefs is None else ", ".join(beliefs.apart),
        "rivals": ", ".join(f"{name} ({1 + count})" for name, count in rivals.items()),
        "disagree": next(iter(disagreeing(found.problem, found.objects, z)), ()),
    }  # fmt: skip
