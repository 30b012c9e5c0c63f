"""Definitions of the suite's own tasks."""

import dataclasses
from collections.abc import Iterator

from cathsim_dmc.tasks import placement
from cathsim_dmc.tasks.definition import TaskDefinition

_ARTERIES = {
    "bca": "the brachiocephalic artery",
    "lcca": "the left common carotid",
    "lsa": "the left subclavian artery",
}
_PHANTOMS = {
    "type1": "Type-I phantom",
    "type2": "Type-II phantom",
    "simple1": "Idealised Type-I arch",
    "simple2": "Idealised Type-II arch",
    "type3": "Type-III arch",
    "bovine": "Bovine arch",
}
# Working lengths by access, m, for the longest routes to BCA and LCCA, 0.167 and
# 0.274 m, see `placement`.
_ARCH_LENGTHS = {"ascending": 0.24, "descending": placement.COMMON_LENGTH}
# Access, prefix of the name, anatomies ("arch" for random ones) and goals.
_TABLE = (
    ("ascending", "", ("type1", "type2", "simple1", "simple2"), ("bca", "lcca")),
    ("descending", "femoral_", ("type1", "type2", "type3", "bovine"), _ARTERIES),
    ("ascending", "", ("arch",), ("bca", "lcca")),
    ("descending", "femoral_", ("arch",), ("bca", "lcca")),
)
# Devices of the tasks with that suffix, from the innermost outwards.
COAXIAL = {
    "wire": (("wire_035_glide",), "with a guidewire that is pushed and turned"),
    "pair": (
        ("wire_035_glide", "berenstein_5f"),
        "with a guidewire in a catheter, both pushed and turned",
    ),
}


def definitions() -> Iterator[tuple[str, TaskDefinition, tuple[str, ...]]]:
    """Yields each task's name, definition and tags: "easy", "hard" or none."""
    single = list(_single())
    yield from single
    for name, definition, _ in single:
        for suffix, (chosen, words) in COAXIAL.items():
            variant = dataclasses.replace(
                definition,
                description=f"{definition.description.rstrip('.')}, {words}.",
                options={**definition.options, "devices": chosen},
            )
            yield f"{name}_{suffix}", variant, ("hard",)
    description = "Any anatomy, such as an imported scan: reach a goal."
    yield "navigate", TaskDefinition(description, None, None), ()


def _single() -> Iterator[tuple[str, TaskDefinition, tuple[str, ...]]]:
    """Yields the tasks with the default device."""
    rows = [(*row[:2], a, g) for row in _TABLE for a in row[2] for g in row[3]]
    for access, prefix, anatomy, goal in rows:
        drawn = anatomy == "arch"
        where = "A random arch in each episode" if drawn else _PHANTOMS[anatomy]
        definition = TaskDefinition(
            f"{where}: cannulate {_ARTERIES[goal]} from the {access} aorta.",
            None if drawn else anatomy,
            goal,
            access,
            # One length for all arches of the sets, in every pool.
            options={"working_length": _ARCH_LENGTHS[access]} if drawn else {},
            random_arch=drawn,
        )
        easy = goal == "bca" and not (drawn or prefix)
        yield f"{prefix}{anatomy}_{goal}", definition, ("easy" if easy else "hard",)
    definition = TaskDefinition(
        "A random arch, access and branch in each episode.",
        None,
        "any",
        "any",
        options={"working_length": placement.COMMON_LENGTH},
        random_arch=True,
    )
    yield "arch_any", definition, ("hard",)
    definition = TaskDefinition(
        "A random arch with the arteries of neck and arms, from the descending aorta.",
        None,
        "any",
        "descending",
        options={"working_length": 0.44, "arches": "neck"},
        random_arch=True,
    )
    yield "neck_any", definition, ("hard",)
