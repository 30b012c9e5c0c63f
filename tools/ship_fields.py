"""Writes the fields that come with the package, those of the measured phantoms.

Run it after a change of their centrelines, or of the code that builds fields:
tests/test_anatomy_field_cache.py says when.
"""

from cathsim_dmc.anatomy import field_cache, phantoms
from cathsim_dmc.anatomy.field import Field


def main() -> None:
    """Builds them anew and takes the place of those that are there."""
    anatomies = [phantoms.load(name) for name in phantoms.MEASURED]
    paths = [field_cache.shipped_path(one.tree, one.ends) for one in anatomies]
    for old in paths[0].parent.glob("*.field"):
        old.unlink()
    for anatomy, path in zip(anatomies, paths, strict=True):
        path.write_bytes(field_cache.packed(Field.of(anatomy.tree, anatomy.ends)))
        print(f"{anatomy.name}: {path.name}, {path.stat().st_size:,} bytes")


if __name__ == "__main__":
    main()
