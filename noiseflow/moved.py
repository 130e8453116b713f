"""Old import paths of moved modules: they work for one more version, with a `DeprecationWarning`."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Mapping, Sequence
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any


class _OldModule(ModuleType):
    """A module under its old name, which forwards all attributes to the new one."""

    def __init__(self, name: str, new: str) -> None:
        super().__init__(name)
        self.__dict__["_new"] = new

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(import_module(self.__dict__["_new"]), name)

    def __dir__(self) -> list[str]:
        return dir(import_module(self.__dict__["_new"]))

    def __call__(self, *args: Any, **options: Any) -> Any:
        """Call the function of the same name, so that importing ``noiseflow.fit`` does not hide ``noiseflow.fit()``."""
        return getattr(self, self.__name__.rsplit(".", 1)[1])(*args, **options)


class _Finder(MetaPathFinder, Loader):
    def __init__(self, moved: Mapping[str, str]) -> None:
        self.moved = moved

    def find_spec(self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None) -> Any:
        return ModuleSpec(fullname, self) if fullname in self.moved else None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        new = self.moved[spec.name]
        warnings.warn(f"{spec.name} has moved; import {new}", DeprecationWarning, stacklevel=2)
        return _OldModule(spec.name, new)

    def exec_module(self, module: ModuleType) -> None:
        """Do nothing; the new module is imported on first use."""


def keep_old_paths(package: str, moved: Mapping[str, str]) -> None:
    """Make ``import package.old`` find ``package.new`` for every pair old → new of `moved`, given without the package."""
    sys.meta_path.append(_Finder({f"{package}.{old}": f"{package}.{new}" for old, new in moved.items()}))
