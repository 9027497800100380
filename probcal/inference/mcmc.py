"""Full Bayes by whichever sampler suits the problem, until so many draws are effective."""

from __future__ import annotations

from dataclasses import dataclass

from probcal.errors import InputError
from probcal.gaussian.choose import choose
from probcal.inference.collapsed import Collapsed
from probcal.inference.joint_gibbs import Gibbs
from probcal.inference.method import Method
from probcal.inference.sampler import Sampler
from probcal.problem import Problem

LONGEST = 64  # steps from one draw to the next, at which chains that have not mixed are given up


@dataclass(frozen=True)
class MCMC(Sampler):
    """Exact posterior of biases, hyper-parameters and trajectories, until it is known well enough.

    Takes `Gibbs` where a network is large, else `Collapsed`, and `NUTS` where a pilot run says that
    its leaps would hardly be taken. Goes on until every bias, noise level and hyper-parameter has
    `effective` effective draws and an r_hat as of chains that have mixed; `limit=` of `fit` ends it
    earlier, and what has not mixed is named. Of each of `chains` at most `draws` are kept. Raises
    `InputError` for more effective draws than these, or less than one.
    """

    chains: int = 4
    warmup: int = 100
    draws: int = 500
    effective: int = 400

    name = "MCMC"
    priors = Collapsed.priors
    atoms = True
    chooses = True

    def __post_init__(self):
        super().__post_init__()
        most = self.chains * self.draws
        if not 1 <= self.effective <= most:
            text = f"a number from 1 to the {most} draws that {self.chains} chains keep"
            raise InputError(f"MCMC(effective={self.effective}): give {text}, or more draws")

    def suited(self, problem: Problem) -> Method:
        """The sampler for a problem."""
        sampler = Collapsed if choose(problem.model).cheap else Gibbs
        sizes = {"chains": self.chains, "warmup": self.warmup, "draws": self.draws}
        return sampler(**sizes, patience=LONGEST, effective=self.effective)

    def check_kept(self, problem: Problem, keep: tuple[str, ...]) -> None:
        """Raise `InputError` where draws of states are asked for that would take too much room."""
        self.suited(problem).check_kept(problem, keep)
