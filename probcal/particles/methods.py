"""The methods by particles, by their names on the command line: method, and the prior where not the method's first."""

from probcal.inference.em import EM, EMEA
from probcal.inference.method import Method
from probcal.particles.gibbs import ParticleGibbs
from probcal.particles.particles import Particles
from probcal.priors import Prior

METHODS: dict[str, tuple[Method, Prior | None]] = {
    "em-particles": (EM(Particles(200), iterations=200), None),
    "em-ea-particles": (EMEA(Particles(200)), None),
    "particle-gibbs": (ParticleGibbs(), None),
}
