"""Writes the fields that ship with the package, for all phantoms and accesses.

Run it after a change of their centrelines, or of the code that builds fields;
tests/test_anatomy_field_cache.py fails when it is needed.
"""

import argparse
from pathlib import Path

import cathsim_dmc.anatomy
from cathsim_dmc.anatomy import field_cache, phantoms
from cathsim_dmc.anatomy.builder import ACCESSES
from cathsim_dmc.anatomy.field import Field

DATA = Path(cathsim_dmc.anatomy.__file__).parent / "data"


def main() -> None:
    """Builds all fields, and replaces the files that are there."""
    paths = []
    for name in phantoms.PHANTOMS:
        fields = {}
        for access in ACCESSES:
            one = phantoms.load(name, access=access)
            content = one.tree, one.ends
            fields[field_cache.shipped_name(*content)] = Field.of(*content)
        paths.append(field_cache.ship(DATA, fields))
        print(f"{name}: {paths[-1].name}, {paths[-1].stat().st_size:,} bytes")
    for old in set(DATA.glob("*.field")) - set(paths):
        old.unlink()


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    main()
