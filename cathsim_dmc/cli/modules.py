"""Modules of users that are imported before a command: tasks, devices, algorithms.

They are entry points of installed packages in the group `cathsim.tasks`, and modules
named by `--import`. Modules that a file names are never imported.
"""

import argparse
import importlib
import os
import sys
from importlib import metadata
from typing import NamedTuple

from cathsim_dmc import files
from cathsim_dmc.cli.options import say

GROUP = "cathsim.tasks"
# Commands that name a task.
COMMANDS = (
    *"train list eval table submit record demos play serve drive export".split(),
    "replay-error",
)


class Own(NamedTuple):
    """Modules to import for a command.

    Attributes:
        names: Modules that `--import` names.
        points: Entry points of installed packages.
    """

    names: tuple[str, ...] = ()
    points: tuple[metadata.EntryPoint, ...] = ()

    @classmethod
    def of(cls, arguments: list[str]) -> "Own":
        """Reads the arguments of the command line, the command first.

        Called before the module of the command is imported.
        """
        if arguments[0] not in COMMANDS:
            return cls()
        parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
        parser.add_argument("--import", action="append", nargs="?", dest="names")
        named = parser.parse_known_args(arguments)[0].names or []
        names = [one for one in named if one is not None]  # None: refused by tyro later
        own = cls(tuple(names), tuple(metadata.entry_points(group=GROUP)))
        if any(own):
            # The modules may import torchrl, which must precede dm_control.
            importlib.import_module("torchrl")
        return own

    def load(self) -> None:
        """Imports the modules; reports and skips installed packages that fail.

        Raises:
            ValueError: a named module does not exist or cannot be imported.
        """
        for point in self.points:
            _load(point)
        for name in self.names:
            _import(name)


def _import(name: str) -> None:
    here = os.getcwd()
    if here not in sys.path:
        sys.path.append(here)  # last, so that no local file hides a package
    if not all(part.isidentifier() for part in name.split(".")):
        raise ValueError(
            f"--import {name}: give the name of a module, as in Python's import, "
            "without .py"
        )
    try:
        importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{name}.".startswith(f"{error.name}."):
            raise  # the missing module is one that the named module imports
        raise ValueError(
            f"--import {name}: no such module in Python's path, nor in {here}"
        ) from error
    except Exception as error:
        with files.refused(ValueError, f"--import {name} fails", Exception):
            raise error


def _load(point: metadata.EntryPoint) -> None:
    try:
        found = point.load()
        if callable(found):
            found()
    except Exception as error:
        line = " ".join(str(error).split())
        owner = point.dist.name if point.dist else "an installed package"
        say(
            f"cathsim: {owner} is left out: its entry point {point.name} = "
            f"{point.value} fails: {type(error).__name__}: {line}"
        )
