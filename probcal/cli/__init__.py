"""The command line: simulate, check, fit, track, watch, study, compare, report, sbc.

`commands` declares the options and checks them without jax, NumPy or pandas; the work of each command stands in a
module of its name, imported once its options hold. Bad input ends with exit code 2, a fit that is no answer, or a
problem that can have none, with 1.
"""

from probcal.cli.commands import app, main

__all__ = ["app", "main"]
