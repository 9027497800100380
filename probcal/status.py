"""How a fit ended: one enumeration for all methods, whose members say what they mean."""

from enum import StrEnum


class Status(StrEnum):
    """Status of a fit; as a string it is what the attribute `status` of a tree holds."""

    CONVERGED = "converged"
    SPENT = "iterations spent"
    NOT_CONVERGED = "not converged"
    AT_BOUND = "at bound"
    DIVERGED = "diverged"
    GAUGE = "along a gauge"
    MISFIT = "misfit"

    @property
    def said(self) -> str:
        """The words that follow the name of a method."""
        return WORDS[self]

    @property
    def valid(self) -> bool:
        """Whether the numbers are estimates at all."""
        return self not in (Status.AT_BOUND, Status.DIVERGED, Status.GAUGE, Status.MISFIT)

    @property
    def settled(self) -> bool:
        """Whether the method ended as it was asked to: it converged, or was to run so many iterations and did."""
        return self in (Status.CONVERGED, Status.SPENT)


WORDS = {
    Status.CONVERGED: "converged",
    Status.SPENT: "ran all its iterations, as asked",
    Status.NOT_CONVERGED: "did not converge",
    Status.AT_BOUND: "ended at bound: its numbers are no estimate",
    Status.DIVERGED: "diverged: its numbers are no estimate",
    Status.GAUGE: "ran along a gauge: its numbers are no estimate",
    Status.MISFIT: "explains nothing: its numbers are no estimate",
}
INVALID = tuple(str(status) for status in Status if not status.valid)  # of a fit or of a bias
