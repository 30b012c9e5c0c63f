"""Optional packages, which the extras of this package install."""

import importlib


def require(extra: str, *modules: str) -> None:
    """Imports modules that belong to an extra of the package.

    Args:
        extra: Name in `project.optional-dependencies` of pyproject.toml.
        *modules: Names of modules.

    Raises:
        ModuleNotFoundError: if one is missing; the message says how to install it.
    """
    for module in modules:
        try:
            importlib.import_module(module)
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError(
                f"{error.name} is not installed; {adding(extra)}", name=error.name
            ) from error


def adding(extra: str) -> str:
    """Returns the instruction for installing an extra."""
    command = f"pip install -c constraints.txt -e '.[{extra}]'"
    return f"in a checkout of cathsim-dmc, `{command}` adds it"
