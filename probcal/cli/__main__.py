"""`python -m probcal.cli`."""

from probcal.cli.commands import main

main()
