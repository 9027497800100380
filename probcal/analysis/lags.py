"""Clocks whose rows the fit explains badly."""

from probcal.analysis.check import Case, Checked, check
from probcal.modes.clocks import EXPLAINED, turning_time


@check()
def check_lags(case: Case) -> Checked:
    """Why clocks are in doubt whose rows the fit explains badly: another lag may explain them.

    The slope tells of lags within the reach of the search alone, however much sds are widened.
    """
    problem, mean = case.fit.problem, case.innovations.spread(slice(None))
    if not problem.timed or mean < EXPLAINED:
        return Checked()
    reach = turning_time(problem, case.fit.point)
    said = f"a lag more than {reach:.2g} s away may explain innovations of mean square {mean:.2g}"
    return Checked(doubts={"weak": {m: said for m, label in enumerate(problem.labels) if label in problem.timed}})
