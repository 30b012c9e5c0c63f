"""Anatomies that come with the package, by name."""

from functools import lru_cache
from pathlib import Path

from cathsim_dmc import bounds
from cathsim_dmc.anatomy.anatomy import Anatomy
from cathsim_dmc.anatomy.arch import arch
from cathsim_dmc.anatomy.builder import ACCESSES
from cathsim_dmc.anatomy.tree_file import read_tree

_DATA = Path(__file__).parent / "data"
MEASURED = ("type1", "type2")  # the published silicone phantoms; docs/anatomies.md
# Those that come as a file of centrelines, `data/<name>.json`.
TREES = MEASURED
PHANTOMS = (*TREES, *arch.ARCHES)


def load(name: str, *, access: str = "ascending") -> Anatomy:
    """Anatomy called `name` in `PHANTOMS`; equal calls give the same object.

    Args:
        access: "ascending" enters at the aortic root, "descending" (as from the
            femoral artery) at the end of the descending aorta.

    Raises:
        ValueError: if there is no such phantom or access; the message lists them.
    """
    bounds.choice("phantom", name, PHANTOMS)
    bounds.choice("access", access, ACCESSES)
    if name in TREES:
        return _built(name, access)
    return arch.build_arch(arch.ARCHES[name], name, access=access)


@lru_cache(maxsize=8)
def _built(name: str, access: str) -> Anatomy:
    return read_tree(_DATA / f"{name}.json").build(access)
