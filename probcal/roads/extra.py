"""networkx and shapely, which come with the extra `probcal[roads]`: imported where they are first used."""

from importlib import import_module
from typing import Any

from probcal.errors import InputError


class Extra:
    """A module of the extra; asking for a name of one that is missing raises `InputError`."""

    def __init__(self, name: str):
        self._name = name

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        try:
            return getattr(import_module(self._name), name)
        except ModuleNotFoundError:
            raise InputError('road networks need networkx and shapely: pip install "probcal[roads]"') from None


networkx: Any = Extra("networkx")
shapely: Any = Extra("shapely")
