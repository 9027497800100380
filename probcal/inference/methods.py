"""The methods as values, their names on the command line, and which priors each takes.

To add one: a module next to this one with a frozen dataclass that inherits `inference.run.Method`, entered here; of a
wing, in its own METHODS and in `probcal/wings.py`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from probcal.errors import InputError
from probcal.inference.collapsed import Collapsed
from probcal.inference.ea import EA, MAP, LeastSquares
from probcal.inference.em import EM, EMEA
from probcal.inference.joint_gibbs import Gibbs
from probcal.inference.mcmc import MCMC
from probcal.inference.method import Method
from probcal.inference.nuts import NUTS
from probcal.inference.run import Maximiser
from probcal.inference.svi import SVI
from probcal.lazy import pd
from probcal.priors import PRIORS, AnyPrior, BernoulliGaussian, Flat, Gaussian, Laplace, Prior, as_prior
from probcal.problem import Problem, check_linear
from probcal.wings import METHODS as OF_WINGS
from probcal.wings import WithWings

# names on the command line: method, and the prior it means where that is not the method's first
METHODS = WithWings[tuple[Method, Prior | None]](
    {
        "ea": (EA(), None),
        "ea-maximised": (EA(precisions="maximised"), None),
        "ea-printed": (EA.as_printed(), None),
        "ea-em": (EA.as_printed(update="em", iterations=2000), None),
        "em-ea": (EMEA(), None),
        "em": (EM(), None),
        "em-ml": (EM(), Flat()),
        "map": (MAP(), None),
        "map-l1": (MAP(), Laplace()),
        "ml": (MAP(), Flat()),
        "nls": (LeastSquares(), None),
        "mcmc": (MCMC(), None),
        "collapsed": (Collapsed(), None),
        "collapsed-spike": (Collapsed(), BernoulliGaussian()),
        "nuts": (NUTS(), None),
        "gibbs": (Gibbs(), None),
        "svi": (SVI(), None),
    },
    OF_WINGS,
    "METHODS",
)


def choose_prior(method: Method, prior: AnyPrior, labels: Sequence[str] = ()) -> Prior:
    """The prior of a fit of biases of these labels: the given one if the method takes it, else the method's first.

    A kind may be Gaussian under every prior, as a survey is. Precisions that are maximised in a climb are those of one
    sparse prior.
    """
    found = as_prior(prior, method.first_prior(), labels)
    kinds = [one for _, one in found.kinds if not isinstance(one, Gaussian)]
    for one in (found, *kinds):
        if not method.takes(one):
            allowed = ", ".join(name for name, known in PRIORS.items() if method.takes(known))
            raise InputError(f"{method.name} does not take the prior {type(one).__name__}; it takes: {allowed}")
    alone = replace(found, correlation=(), kinds=())
    climbs = [one for one in (alone, *kinds) if isinstance(method, Maximiser) and method.climbs_under(one).learns]
    if climbs and any(one != alone for one in kinds):
        raise InputError(
            f"{method.name} maximises the precisions of one sparse prior: give the other kinds Gaussian(), or take"
            " priors whose precisions EA() integrates, such as Horseshoe() and ARD(rate=0.5)"
        )
    return found


def check_problem(problem: Problem, *, linear: bool = True) -> None:
    """Raise `InputError` for a single row, a motion that is not `linear`, no free biases or sensors without rows."""
    if linear:
        check_linear(problem)
    source = problem.measurements.table.source
    if problem.measurements.measured.any(1).sum() < 2:
        raise InputError(f"{source} has one measured row only; a fit needs at least two")
    if not problem.labels:
        raise InputError("the problem has no free bias; declare a Bias, a survey or a scale, or use track()")
    if problem.silent:
        raise InputError(f'{source} has no row of sensor "{problem.silent[0]}"; add rows or take it out of the network')


def table() -> pd.DataFrame:
    """A table of the priors (columns, by command-line name) that each method (rows, by class)
    takes."""
    first = {type(method).__name__: method for method, _ in reversed(list(METHODS.values()))}
    known = {name: first[name] for name in dict.fromkeys(type(method).__name__ for method, _ in METHODS.values())}
    rows = {name: ["yes" if one.takes(prior) else "" for prior in PRIORS.values()] for name, one in known.items()}
    return pd.DataFrame.from_dict(rows, orient="index", columns=list(PRIORS))
