"""Particles as a value that `track` takes as its smoother, and `EM` as its E-step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import jax
import numpy as np

from probcal.gaussian.mode import Point
from probcal.inference.method import Context, Iterated, MethodTask, ParticleSmoother
from probcal.particles.em import ParticleClimb
from probcal.particles.settings import ParticleSettings
from probcal.particles.weighted import track_by_particles
from probcal.priors import Prior
from probcal.problem import Problem

if TYPE_CHECKING:
    import xarray as xr


@dataclass(frozen=True)
class Particles(ParticleSettings, ParticleSmoother):
    """A particle filter of `count` particles and a smoother behind it, for `track`, and for `EM` as its E-step.

    `proposal`: "bootstrap" draws from the motion; "extended" and "laplace" from a Gaussian that has seen the rows of
    the epoch (one Gauss-Newton step, or several), for motions with a linear form; "auto" is extended for these,
    bootstrap for others. Resampled, systematically, where the
    effective number falls below `threshold` of them.

    `smoother`: "backward" draws paths backward in time at a cost linear in `count`, by `moves` independent Metropolis
    steps that begin at the ancestor (Bunch, Godsill 2013; Dau, Chopin 2023); "exact" draws them from all particles and
    "marginal" weighs these (Paper A 38-39), both at a quadratic cost; "genealogy" keeps the ancestors: all that is
    left for a motion without density.

    `m_step`, where it is an E-step: "averaged" is stochastic approximation, each step one pass of a filter that holds
    the last path, so that few particles will do and none is lost, averaged over the passes (Lindsten 2013; Delyon,
    Lavielle, Moulines 1999); "mean" linearises at the smoothed mean, or on the road that is nearest to it (Paper A
    20-21, 43); "paths" takes a Gauss-Newton step of the expectation over all smoothed particles. Over its first
    `tempered` iterations from biases of zero the log-likelihood counts less, at first by 1/50, so that particles that
    do not know the biases yet are not thrown off by rows that contradict each other (Ueda, Nakano 1998).

    Raises `InputError` for settings outside their ranges; what runs it, where cuthbert is not installed.

    >>> Particles(500).smoother
    'backward'
    """

    def task(self, method: Iterated, problem: Problem, prior: Prior, start: Point, context: Context) -> MethodTask:
        """The climb of EM whose E-step draws particles, from the biases of a start."""
        return ParticleClimb(method, problem, prior, start, context, self)

    def tracked(
        self, problem: Problem, z: np.ndarray, covariance: np.ndarray, levels: np.ndarray, key: jax.Array
    ) -> xr.DataTree:
        """Tracks by particles at biases z (M,) of a covariance (M, M)."""
        return track_by_particles(problem, self, z, covariance, levels, key)
