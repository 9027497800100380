"""The status of a fit: one enumeration for all methods, and the rules that decide."""

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
        """True if the numbers are estimates at all."""
        return self not in (Status.AT_BOUND, Status.DIVERGED, Status.GAUGE, Status.MISFIT)

    @property
    def settled(self) -> bool:
        """True if the method ended as it was asked to: it converged, or was to run so many iterations and did."""
        return self in (Status.CONVERGED, Status.SPENT)

    @property
    def explains(self) -> bool:
        """True if the model explains the data at all."""
        return self is not Status.MISFIT

    @property
    def again(self) -> bool:
        """True if a run with other random numbers may end otherwise."""
        return self in (Status.NOT_CONVERGED, Status.MISFIT)


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
    Status.GAUGE,
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
CLIMB = (  # the first of them that holds, of tracks by particles too
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
        "left",
        Status.NOT_CONVERGED,
        "What is left of the rows has a mean square of {left:.1f} where 1 is expected: another optimum may"
        " explain them, or the noise std is too small. Take {better} or further starts.",
    ),
    Rule(
        "lost",
        Status.NOT_CONVERGED,
        "What is left of the rows has a mean square of {lost:.1f} where 1 is expected: particles lost a target,"
        " or its motion, the calibration or the noise std is not right. Take more particles.",
    ),
    Rule(
        "alike",
        Status.NOT_CONVERGED,
        "At some epoch only {alike} of the smoothed particles differ, so that their spread says little: take more"
        ' of them, or Particles(proposal="extended") where the motion has a linear form.',
    ),
    Rule(
        "ahead",
        Status.NOT_CONVERGED,
        "The slope of the likelihood where the fit ended asks for a step of {ahead:.1f} sd per bias: it is not the"
        " top. Take {better} or more iterations.",
    ),
    Rule(
        "inexact",
        Status.NOT_CONVERGED,
        "The sd of {inexact[0]} has a Monte Carlo error of {inexact[1]:.0%} after {inexact[2]} filters: take more"
        " particles.",
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
        "All {iterations} iterations were run, as asked; {moved}.",
    ),
    Rule("spent", Status.SPENT, ""),
    Rule(
        "moving",
        Status.NOT_CONVERGED,
        "The fit did not converge in {iterations} iterations: {moving}; allow more.",
    ),
    Rule(
        "iterations",
        Status.NOT_CONVERGED,
        "The fit did not converge in {iterations} iterations: allow more, or fix what the data leave open.",
    ),
)
CHAINS = (  # the gravest of those that hold; all are said
    Rule("misfit", Status.MISFIT, "{misfit}"),
    Rule("objects", Status.CONVERGED, "{objects[0]:.2f} objects in {objects[1]} scans."),
    Rule("note", Status.CONVERGED, "{note}"),
    Rule("stopped", Status.NOT_CONVERGED, "{stopped}; --resume goes on."),
    Rule(
        "single",
        Status.CONVERGED,
        "One chain alone does not show whether it has mixed; take 2 or more.",
    ),
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
        "The delayed-acceptance rate is {accepted[0]:.1%}: biases move only through HMC steps.",
    ),
    Rule(
        "hmc",
        Status.NOT_CONVERGED,
        "The HMC acceptance rate of a chain is {hmc[0]:.1%}: its tracks hardly move; take NUTS().",
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
    Rule(
        "renewed",
        Status.NOT_CONVERGED,
        "A sweep renews {renewed[0]:.0%} of the paths only: take more particles.",
    ),
    Rule(
        "full",
        Status.CONVERGED,
        "All {full[0]} objects are there in {full[1]:.0%} of the draws: give most= room for more.",
    ),
)
STREAM = (
    Rule("unexplained", Status.MISFIT, ""),  # the watch over the sensors names them
    Rule("narrow", Status.NOT_CONVERGED, "Intervals may be too narrow."),
    Rule("windows", Status.NOT_CONVERGED, "{windows} did not come to rest: fit the rows as a batch."),
    Rule(
        "astray",
        Status.NOT_CONVERGED,
        "{astray} began where the first rows do not give a place: declare the start,"
        " Target(motion, start={{...}}), or take a lag.",
    ),
    Rule(
        "ancestors",
        Status.NOT_CONVERGED,
        "{ancestors} of the first particles are left: take more, or AugmentedFilter() where it serves.",
    ),
)
OBJECTS = (  # of detections that name no target
    Rule(
        "moving",
        Status.NOT_CONVERGED,
        "{method} did not come to rest in {rounds} rounds: objects and biases still change.",
    ),
    Rule(
        "apart",
        Status.NOT_CONVERGED,
        "The objects of {apart} do not tell how they stand to the other sensors: their"
        " biases are not found; give more common objects that turn, or state the pose.",
    ),
    Rule(
        "rivals",
        Status.NOT_CONVERGED,
        "Several poses explain the detections as well (how many): {rivals}. Survey one of these, or give objects"
        " that turn.",
    ),
    Rule(
        "disagree",
        Status.MISFIT,
        "{disagree[0]} should see {disagree[1]} and never does, {disagree[2]} should see {disagree[3]} and never"
        " does: the two differ by what no bias allows for. Check their clocks and Detection(...), or give the sensor"
        " a bias for it.",
    ),
)
FOUND = (  # of an answer that is looked at again; a fact may hold several times
    Rule(
        "clocks",
        Status.NOT_CONVERGED,
        "The times of the rows have not converged: from round to round there still moves {clocks}.",
    ),
    Rule("unseen", Status.NOT_CONVERGED, "{unseen} while other answers were looked for."),
    Rule("interrupted", Status.NOT_CONVERGED, ""),
    Rule(
        "gauge",
        Status.GAUGE,
        "The estimate ran {gauge.far:.1f} prior sd along {gauge.name}, which no row fixes: it is invalid. Survey"
        " or fix what holds it.",
    ),
    Rule(
        "along",
        Status.CONVERGED,
        "The estimate lies {along.far:.1f} prior sd along {along.name}: check the stated network.",
    ),
    Rule(
        "strained",
        Status.CONVERGED,
        'The start of target "{strained[0]}" was never declared and strains the fit by {strained[1]:.1f} sd: declare'
        " it, Target(motion, start={{...}}).",
    ),
    Rule("equal", Status.CONVERGED, "Another answer fits as well ({equal[0]:.1f} nats apart): {equal[1]}."),
    Rule("worse", Status.CONVERGED, "Another answer fits {worse[0]:.1f} nats worse only: {worse[1]}."),
    Rule(
        "node",
        Status.CONVERGED,
        "Survey on which side of the path such a node stands, or narrow its scale to less than that.",
    ),
    Rule(
        "side",
        Status.CONVERGED,
        "Survey a position off that {side}, or declare on which side a target starts, Target(motion, start={{...}}).",
    ),
)


def judge(rules: Sequence[Rule], facts: Mapping[str, Any], status: Status = Status.CONVERGED) -> tuple[Status, str]:
    """The gravest status, and all sentences, of the rules whose facts hold; of a climb the first of them alone.

    `status` is what an answer has that is judged again.
    """
    known = [rule for rule in rules if facts.get(rule.fact)][: 1 if rules is CLIMB else None]
    said = " ".join(rule.sentence for rule in known if rule.sentence).format(**facts)
    return min([status, *(rule.status for rule in known)], key=GRAVITY.index), said
