"""The wings: folders of the package that the core never imports. This table is the only way from the core to them.

Any wing may be deleted. The core then leaves out its names, methods, commands and pictures, and a call that asks for
one by name raises `WingMissing`.
"""

from importlib import import_module
from pathlib import Path
from types import ModuleType

from probcal.errors import InputError

WINGS = ("adapters", "doa", "roads", "rss", "stream", "studies")
NAMES = {  # public names of `probcal` by module
    "probcal.roads": "LeavingRoad Road RoadNetwork match_track read_roads",
    "probcal.stream.online": "AugmentedFilter Jumps Online ParticleFilter",
    "probcal.studies.coverage": "coverage_table",
    "probcal.studies.fits": "load_study",
    "probcal.studies.sbc": "sbc",
    "probcal.studies.study": "study",
}
PICTURES = {  # public names of `probcal.plots` by module
    "probcal.roads.plots": "plot_particles plot_roads",
    "probcal.studies.plot_sbc": "draw_sbc plot_coverage plot_ranks",
    "probcal.studies.plot_study": "draw_study plot_study",
}
COMMANDS = {  # commands of the command line; the module of each defines NAME_command
    "levels": "probcal.rss.command",
    "sbc": "probcal.studies.commands",
    "study": "probcal.studies.commands",
    "watch": "probcal.stream.command",
}


class WingMissing(InputError, ImportError):
    """A name whose wing is not installed."""


def installed(module: str) -> bool:
    """Whether the wing of a module is installed; the core is."""
    wing = module.split(".")[1] if "." in module else ""
    return wing not in WINGS or (Path(__file__).parent / wing / "__init__.py").is_file()


def loaded(module: str, name: str) -> ModuleType:
    """The module, imported; raises `WingMissing` where its wing is not installed, for what `name` says."""
    if not installed(module):
        raise WingMissing(f"{name} needs the folder probcal/{module.split('.')[1]}, which is not installed")
    return import_module(module)
