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

LONGEST = 64  # steps from one draw to the next: chains that have not mixed by then would hardly ever


@dataclass(frozen=True)
class MCMC(Sampler):
    """Exact posterior of biases, hyper-parameters and trajectories, drawn until it is known well enough.

    Takes `Gibbs` where a network is large, else `Collapsed`, and `NUTS` where a pilot run says that its leaps would
    hardly be taken. Goes on until every bias, noise level and hyper-parameter has `effective` effective draws and an
    r_hat as of chains that have mixed; `limit=` of `fit` ends it earlier, and what has not mixed is named. Of each of
    `chains` at most `draws` are kept. Raises `InputError` for less than one effective draw.
    """

    chains: int = 4
    warmup: int = 100
    draws: int = 500
    effective: int = 400

    name = "MCMC"
    priors = Collapsed.priors
    atoms = True
    roomy = False

    def __post_init__(self):
        super().__post_init__()
        if self.effective < 1:
            raise InputError(f"MCMC(effective={self.effective}): it must be at least 1")

    def suited(self, problem: Problem) -> Method:
        """The sampler for a problem."""
        sampler = Collapsed if choose(problem.model).cheap else Gibbs
        return sampler(
            chains=self.chains, warmup=self.warmup, draws=self.draws, patience=LONGEST, effective=self.effective
        )

    def check_kept(self, problem: Problem, keep: tuple[str, ...]) -> None:
        """Raise `InputError` where draws of states are asked for that would take too much room."""
        self.suited(problem).check_kept(problem, keep)
