"""The wings: folders of the package that the core never imports. This table is the only way from the core to them.

Any wing may be deleted. The core then leaves out its names, methods, commands and pictures, and a call that asks for
one by name raises `WingMissing`.
"""

from collections.abc import Iterator, Mapping
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

from probcal.errors import InputError

WINGS = ("adapters", "doa", "particles", "roads", "rss", "stream", "studies", "tracking")
NAMES = {  # public names of `probcal` by module
    "probcal.particles.clouds": "particle_filter",
    "probcal.particles.gibbs": "ParticleGibbs",
    "probcal.particles.particles": "Particles",
    "probcal.roads": "LeavingRoad Road RoadNetwork match_track read_roads",
    "probcal.stream.online": "AugmentedFilter Jumps Online ParticleFilter",
    "probcal.studies.coverage": "coverage_table",
    "probcal.studies.fits": "load_study",
    "probcal.studies.sbc": "sbc",
    "probcal.studies.study": "study",
    "probcal.tracking.gospa": "gospa",
    "probcal.tracking.objects": "Objects track_objects",
    "probcal.tracking.phd": "Intensities phd_filter",
    "probcal.tracking.poses.propagation": "Beliefs propagate_beliefs separable_likelihood",
    "probcal.tracking.registration": "Registration register_tracks",
    "probcal.tracking.sampler.associations": "sample_associations",
    "probcal.tracking.selfconfig": "SelfConfiguration",
}
PARTS = {  # functions of wings that verbs of the core call, by module
    "probcal.particles.starts": "solve_by_particles",
    "probcal.tracking.tracks": "track_detections",
}
PICTURES = {  # public names of `probcal.plots` by module
    "probcal.roads.plots": "plot_particles plot_roads",
    "probcal.studies.plot_sbc": "draw_sbc plot_coverage plot_ranks",
    "probcal.studies.plot_study": "draw_study plot_study",
}
METHODS = {  # methods by name on the command line; the module of each has it in its METHODS
    "em-particles": "probcal.particles.methods",
    "em-ea-particles": "probcal.particles.methods",
    "particle-gibbs": "probcal.particles.methods",
    "self-config": "probcal.tracking.methods",
    "self-config-beliefs": "probcal.tracking.methods",
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
    """True if the wing of a module is installed; the core is."""
    wing = module.split(".")[1] if "." in module else ""
    return wing not in WINGS or (Path(__file__).parent / wing / "__init__.py").is_file()


def check_wing(module: str, name: str) -> None:
    """Raise `WingMissing` for a name where the wing of its module is not installed."""
    if not installed(module):
        raise WingMissing(f"{name} needs the folder probcal/{module.split('.')[1]}, which is not installed")


def check_method_installed(name: str) -> None:
    """Raise `WingMissing` for a method of the command line whose wing is not installed."""
    check_wing(METHODS.get(name, ""), name)


def loaded(module: str, name: str) -> ModuleType:
    """The module of a name, imported; raises `WingMissing` where its wing is not installed."""
    check_wing(module, name)
    return import_module(module)


def of_wing(name: str) -> Any:
    """The value of a name of `NAMES` or `PARTS`."""
    module = next(module for module, names in {**NAMES, **PARTS}.items() if name in names.split())
    return getattr(loaded(module, name), name)


class WithWings[Value](Mapping[str, Value]):
    """Values of the core by name, and those of installed wings, whose module is imported when one is asked for."""

    def __init__(self, core: Mapping[str, Value], wings: Mapping[str, str], table: str):
        self._core, self._wings, self._table = core, wings, table

    def __getitem__(self, name: str) -> Value:
        if name in self._core:
            return self._core[name]
        return getattr(loaded(self._wings[name], name), self._table)[name]

    def __iter__(self) -> Iterator[str]:
        yield from self._core
        yield from (name for name, module in self._wings.items() if installed(module))

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def __contains__(self, name: object) -> bool:
        return any(name == known for known in self)
