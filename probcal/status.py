"""How a fit ended: one enumeration for all methods, and the rules that decide."""

from collections.abc import Mapping, Sequence
from enum import StrEnum
from typing import Any, NamedTuple


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

    @property
    def unsettled(self) -> "Status":
        """The status of a fit of which something is left to do."""
        return Status.NOT_CONVERGED if self.settled else self


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
GRAVITY = (
    Status.MISFIT,
    Status.DIVERGED,
    Status.AT_BOUND,
    Status.NOT_CONVERGED,
    Status.SPENT,
    Status.CONVERGED,
)


class Rule(NamedTuple):
    """The status that follows from a fact, and a sentence with the remedy, facts in braces."""

    fact: str
    status: Status
    sentence: str


DIVERGED = "The fit diverged: {}; the estimate is invalid. "
CLIMB = (  # the first of them that holds
    Rule("misfit", Status.MISFIT, "{misfit}"),
    Rule(
        "far",
        Status.DIVERGED,
        DIVERGED.format("{far} lie more than {limit:g} scales from the stated value")
        + "Use a prior, or fix some biases.",
    ),
    Rule(
        "singular",
        Status.DIVERGED,
        DIVERGED.format("the information matrix is singular") + "Use a prior, or fix some biases.",
    ),
    Rule(
        "refused",
        Status.DIVERGED,
        DIVERGED.format("it never left its start, since no step fitted better")
        + "Check units, the time column, sentinels such as -9999 and the noise std, or give a start.",
    ),
    Rule(
        "outside",
        Status.AT_BOUND,
        "{outside} lie more than {limit:g} scales from the stated value: the estimate is invalid."
        " Check labels, units and the declared scales.",
    ),
    Rule(
        "low",
        Status.AT_BOUND,
        "The precision of {low} stands at its lower bound: the estimate is invalid.",
    ),
    Rule(
        "fallen",
        Status.NOT_CONVERGED,
        "The evidence fell by {fallen:.3g} nats below its best on the way: the fit ran to a place"
        " that the data as a whole do not favour. Survey or fix more, state narrower scales, or take a sampler.",
    ),
    Rule("converged", Status.CONVERGED, ""),
    Rule("cut", Status.NOT_CONVERGED, "{cut}, before it converged: this is the best estimate so far."),
    Rule(
        "moved",
        Status.SPENT,
        "All {iterations} iterations were run, as asked; the last moved the objective by {moved}.",
    ),
    Rule("spent", Status.SPENT, ""),
    Rule(
        "iterations",
        Status.NOT_CONVERGED,
        "The fit did not converge in {iterations} iterations: allow more, or fix what the data leave open.",
    ),
)
CHAINS = (  # the gravest of those that hold; all are said
    Rule("misfit", Status.MISFIT, "{misfit}"),
    Rule("note", Status.CONVERGED, "{note}"),
    Rule("stopped", Status.NOT_CONVERGED, "{stopped}; --resume goes on."),
    Rule(
        "r_hat",
        Status.NOT_CONVERGED,
        "The chains have not mixed: r_hat of {r_hat[0]} is {r_hat[1]:.3f}; take more draws.",
    ),
    Rule(
        "few",
        Status.NOT_CONVERGED,
        "Only {few[1]:.0f} effective draws of {few[0]}; take more draws.",
    ),
    Rule(
        "sides",
        Status.CONVERGED,
        "The posterior has {sides[0]} modes, of weights {sides[1]}; r_hat is within modes.",
    ),
    Rule(
        "unsure",
        Status.NOT_CONVERGED,
        "The chains hardly jump between the modes, so that their weights are not known; take more draws.",
    ),
    Rule(
        "divergences",
        Status.NOT_CONVERGED,
        "{divergences} divergences: take NUTS with a higher target (0.95){or}.",
    ),
    Rule(
        "depth",
        Status.CONVERGED,
        "{depth:.0%} of the trees reached the greatest depth: the step is short (dense=True may help).",
    ),
    Rule(
        "bfmi",
        Status.NOT_CONVERGED,
        "BFMI {bfmi[0]:.2f} is below {bfmi[1]}: the energy is hardly explored; take more draws.",
    ),
    Rule(
        "accepted",
        Status.CONVERGED,
        "The delayed-acceptance rate is {accepted:.1%}: biases move only through HMC steps.",
    ),
    Rule(
        "hmc",
        Status.NOT_CONVERGED,
        "The HMC acceptance rate of a chain is {hmc:.1%}: its tracks hardly move; take NUTS().",
    ),
    Rule("turns", Status.NOT_CONVERGED, "A chain takes {turns[0]:.1%} of its {turns[1]}."),
    Rule(
        "fitting",
        Status.CONVERGED,
        "Pareto k-hat of the guide is {fitting[0]:.2f}, below {fitting[1]:g}: it stands for the posterior.",
    ),
    Rule(
        "unfitting",
        Status.NOT_CONVERGED,
        "Pareto k-hat of the guide is {unfitting[0]:.2f}, not below {unfitting[1]:g}: it does not"
        " fit the posterior; fit with NUTS() or Collapsed().",
    ),
    Rule(
        "far",
        Status.DIVERGED,
        "Some biases lie far from the stated values: use a prior, or fix some.",
    ),
)


def judge(rules: Sequence[Rule], facts: Mapping[str, Any]) -> tuple[Status, str]:
    """Status and sentences of the rules whose facts are known; of a climb the first of them alone."""
    known = [rule for rule in rules if rule.fact in facts][: 1 if rules is CLIMB else None]
    said = " ".join(rule.sentence for rule in known if rule.sentence).format(**facts)
    return min((rule.status for rule in known), key=GRAVITY.index, default=Status.CONVERGED), said
