"""Samplers whose chains move in the frame of a pose."""

from abc import ABC

from probcal.gaussian.mode import Point
from probcal.inference.method import Context
from probcal.inference.posterior import conclude_draws
from probcal.inference.sampler import Sampler
from probcal.inference.sampling import sample
from probcal.priors import Prior
from probcal.problem import Problem
from probcal.results.answer import Answer


class FramedSampler(Sampler, ABC):
    """A sampler with `first` and a pure `step` on the frame."""

    def answer(self, problem: Problem, prior: Prior, start: Point, context: Context) -> Answer:
        """Draws of the posterior around a start, and what they say."""
        run = sample(
            problem, self, prior, start, context.key, monitor=context.monitor, storage=context.storage,
            threads=context.threads, fallback=context.fallback,
        )  # fmt: skip
        return conclude_draws(problem, prior, run)
