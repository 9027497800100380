"""Names that are imported when they are first used: those of a package (PEP 562), and heavy modules."""

import sys
from collections.abc import Mapping
from contextlib import suppress
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

from probcal.wings import installed, loaded


class LazyPackage(ModuleType):
    """A package that loads a public name, or a submodule, when it is asked for."""

    _homes: dict[str, str]  # the module of each public name

    def __getattr__(self, name: str) -> Any:
        if name in self._homes:
            value = getattr(loaded(self._homes[name], name), name)
            setattr(self, name, value)
            return value
        if name == "__version__":
            with suppress(ImportError):  # a package that is not installed has none
                return import_module("importlib.metadata").version(self.__name__)
        module = f"{self.__name__}.{name}"
        if not name.startswith("_"):
            try:
                return loaded(module, module)
            except ModuleNotFoundError as error:
                if error.name != module:
                    raise
        raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}", name=name, obj=self)

    def __setattr__(self, name: str, value: Any) -> None:
        """The import of a submodule binds it to its name, which is left to the function of that name."""
        if isinstance(value, ModuleType) and self._homes.get(name) == value.__name__:
            value = getattr(value, name)
        super().__setattr__(name, value)

    def __dir__(self) -> list[str]:
        return sorted({*super().__dir__(), *self.__dict__["__all__"]})


def lazy(package: str, homes: Mapping[str, str], submodules: str = "") -> list[str]:
    """Make a package lazy and return its `__all__`: `homes` gives the public names of each module, by spaces.

    Names whose wing is not installed are left out of `__all__`.
    """
    module = sys.modules[package]
    found = {name: home for home, names in homes.items() for name in names.split()}
    module.__dict__["_homes"] = found
    module.__class__ = LazyPackage
    return sorted([*(name for name, home in found.items() if installed(home)), *submodules.split()])


class Later:
    """A module, or a namespace in one, that is imported when a name of it is first used."""

    def __init__(self, path: str):
        self._path = path

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        # the whole package first, its parts as attributes: ArviZ puts a lazy numpyro into sys.modules, of which
        # `import numpyro.infer` would run the parts twice
        root, *parts = self._path.split(".")
        found = import_module(root)
        for part in parts:
            found = getattr(found, part)
        return getattr(found, name)


if TYPE_CHECKING:  # slow to load: options are checked, and help is printed, without them
    import pandas as pd
    import xarray as xr
else:
    pd, xr = Later("pandas"), Later("xarray")
