"""A policy under the varied protocol: held-out arches, phantoms, one change at a time.

python benchmarks/robust.py pretrained:navigator --out runs/navigator.jsonl
python benchmarks/robust.py expert --out runs/expert.jsonl --only anatomies
python benchmarks/robust.py pretrained:navigator_pair --pair --out runs/pair.jsonl

Every cell becomes a line of the file when it has been played; the same command
continues with the missing cells. With --ray the machines of a Ray cluster play them,
see docs/cluster.md. docs/scripts/robust.py makes the tables of docs/robustness.md.
"""

import dataclasses
import json
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal, get_args

import judgement
import numpy as np
import torch
import tyro

# torchrl must be imported before dm_control.
from cathsim_dmc.agents import evaluation, protocols  # isort: skip

from cathsim_dmc import cluster, files, suite
from cathsim_dmc.agents.policies import load_policy
from cathsim_dmc.agents.results import SAFE_FORCES
from cathsim_dmc.anatomy import Anatomy
from cathsim_dmc.anatomy.arch import arch
from cathsim_dmc.anatomy.arch.tree import arch_tree
from cathsim_dmc.anatomy.builder import GOAL_DEPTH, VesselPlace
from cathsim_dmc.anatomy.centreline import VesselTree
from cathsim_dmc.tasks.anatomies import GOALS as WITH_NECK
from cathsim_dmc.tasks.anatomies import load_anatomy

GOALS = ("bca", "lcca", "lsa")
ACCESSES = ("ascending", "descending")
PHANTOMS = ("type1", "type2", "type3", "bovine")
PAIR = suite.COAXIAL["pair"][0]  # with femoral access
# Randomised properties of device and surroundings, one at a time.
CHANGES = {
    "none": {},
    **{
        name: {name: getattr(protocols.VARIED_RANGES, name)}
        for name in (
            *("friction", "stiffness", "loss", "viscosity", "roll", "delay"),
            *("start_radius", "start_insertion", "tracking_noise"),
        )
    },
    "goal": {"goal_shift": (-5e-3, 5e-3)},
}
# Radii, m, to which a branch narrows, too narrow for some devices or all; and length,
# m, past its ostium over which it tapers.
NARROW, TAPER = (0.6e-3, 0.8e-3, 1.0e-3, 1.2e-3), 10e-3
Part = Literal["arches", "neck", "variants", "anatomies", "changes", "narrow"]


@dataclasses.dataclass(frozen=True)
class Cell:
    """Episodes that are evaluated together."""

    part: str
    labels: Mapping[str, str | None]
    task: str
    options: dict
    episodes: int
    protocol: str = "varied"


def _accesses(pair):
    return ACCESSES[1:] if pair else ACCESSES


def _arch(pair):
    return "arch_any_pair" if pair else "arch_any"


def arches(pool=None, pair=False):
    """The first `pool` held-out arches, or all, once for each branch and access."""
    pool = pool or len(arch.arch_set("test"))
    for goal in GOALS:
        for access in _accesses(pair):
            where = {"goal": goal, "access": access}
            options = {**where, "arches": "test", "pool": pool}
            yield Cell("arches", where, _arch(pair), options, pool)


def neck(pool=None, pair=False):
    """The first `pool` held-out arches with a neck, or all, once for each goal."""
    pool = pool or len(arch.arch_set("test_neck"))
    for goal in WITH_NECK:
        where = {"arches": "test_neck", "goal": goal}
        task = "neck_any_pair" if pair else "neck_any"
        yield Cell("neck", where, task, {**where, "pool": pool}, pool)


def variants(pair=False, episodes=4):
    """Held-out arches of type III, bovine and aberrant ones, with a cell for each.

    The branch and the access of an arch follow from its number. A pool cannot hold
    arches with different numbers of goals.
    """
    access = ACCESSES[1] if pair else "any"
    where = {"goal": "any", "access": access, "arches": "test_variants", "pool": 1}
    for number, seed in enumerate(arch.arch_set("test_variants")):
        options = {**where, "first": number}
        yield Cell("variants", {"arch": seed.name}, _arch(pair), options, episodes)


def anatomies(names, pair=False, wanted=GOALS, episodes=20):
    """Branches of phantoms, from each access, and of imported anatomies."""
    driven = {"devices": PAIR} if pair else {}
    for name in names:
        goals = load_anatomy(name).goals
        for goal in (goal for goal in wanted if goal in goals):
            for access in _accesses(pair) if name in PHANTOMS else (None,):
                where = {"anatomy": name, "goal": goal, "access": access}
                options = {key: value for key, value in where.items() if value}
                options |= driven
                yield Cell("anatomies", where, "navigate", options, episodes)


def narrowed(seed: arch.ArchSeed, branch: str, radius: float) -> Anatomy:
    """An arch with femoral access, one branch of which narrows to a radius, m."""
    tree = arch_tree(seed.parameters())
    vessel, line = tree.vessel(branch), tree.vessel(branch).centreline
    ways = np.linalg.norm(np.diff(line.points, axis=0), axis=1)
    behind = (np.append(0.0, ways.cumsum()) - vessel.ostium) / TAPER
    left = np.clip(1.0 - behind, 0.0, 1.0)
    radii = np.minimum(line.radii, radius + left * (line.radii - radius))
    vessel = dataclasses.replace(
        vessel, centreline=dataclasses.replace(line, radii=radii)
    )
    tree = VesselTree({**tree.vessels, branch: vessel})
    goal = VesselPlace(branch, GOAL_DEPTH, past_ostium=True)
    inlet = VesselPlace(tree.root.name, np.inf)
    return Anatomy.from_tree(tree, seed.name, inlet=inlet, goals={branch: goal})


def narrow(pair=False, branch="lcca"):
    """Held-out arches with a branch that is too narrow, for each of `NARROW`."""
    for radius in NARROW:
        for seed in arch.arch_set("test")[:3]:
            where = {"arch": seed.name, "radius": f"{1e3 * radius:g}"}
            options = {"anatomy": narrowed(seed, branch, radius), "goal": branch}
            options |= {"give_up": True, **({"devices": PAIR} if pair else {})}
            yield Cell("narrow", where, "navigate", options, 2)


def changes(pair=False, episodes=20):
    """One change at a time on a phantom."""
    where = {"anatomy": "type1", "goal": "lcca"}
    if pair:
        where |= {"access": ACCESSES[1], "devices": PAIR}
    device = {"devices": ("wire_035_glide", "vertebral_5f")}
    for name, ranges in CHANGES.items():
        options = {**where, "randomisation": ranges or False}
        yield Cell("changes", {"change": name}, "navigate", options, episodes, "")
    for name, options in (
        ("device", device if pair else {"device": "steerable_4f"}),
        ("anatomy", {"anatomy": "type2"}),
        ("time step", {"physics_timestep": 2e-3}),
    ):
        options = {**where, **options}
        yield Cell("changes", {"change": name}, "navigate", options, episodes, "")


def play(policy: str, cell: Cell, player=None, threads: int | None = None) -> dict:
    """Plays a cell and returns its line; `player` is the policy if it is loaded."""
    began, player = time.monotonic(), player or load_policy(policy)
    # A policy that reads images needs the planes that it was trained with.
    planes = (player.task_kwargs or {}).get("fluoroscopy")
    seen = {} if planes is None else {"fluoroscopy": planes}
    found = evaluation.evaluate(
        player,
        cell.task,
        cell.episodes,
        protocol=cell.protocol or "published",
        task_kwargs={**seen, **cell.options},
        num_threads=threads,
    )
    reached = found.values("success") > 0
    sums = found.values("forces.largest_sum")
    drawn = found.conditions or ({},) * cell.episodes
    return {
        "policy": policy,
        "part": cell.part,
        **cell.labels,
        "episodes": cell.episodes,
        "success": found.successes,
        "safe": [int((reached & (sums <= limit)).sum()) for limit in SAFE_FORCES],
        "given_up": sum(one.given_up for one in found.episodes),
        "steps": round(float(found.values("length").mean()), 1),
        "mean_force": round(float(found.values("forces.mean_force").mean()), 6),
        "largest_sum": round(float(sums.max()), 4),
        "by_device": _shares([_device(cell, one) for one in drawn], reached),
        "by_kind": _shares([_kind(cell, one) for one in drawn], reached),
        "missed_arches": [
            one["arch"]
            for one, good in zip(drawn, reached, strict=True)
            if "arch" in one and not good
        ],
        "seconds": round(time.monotonic() - began, 1),
        "date": time.strftime("%Y-%m-%d"),
        "commit": judgement.commit(),
    }


def _play_apart(job):
    """The line of a cell, played in a process of a cluster."""
    policy, cell, player, threads, of_torch = job
    torch.set_num_threads(of_torch)  # rounding depends on it
    return play(policy, cell, player, threads)


def _device(cell, drawn):
    """Name of the device of an episode; the names of all coaxial devices."""
    own = suite.TASKS[cell.task].options.get("devices", ())
    devices = cell.options.get("devices", own)
    return " in ".join(devices) or drawn.get("device")


def _kind(cell, drawn):
    """Kind of the arch of an episode, such as "II bovine_trunk"."""
    if "arches" not in cell.options:
        return None
    number = drawn.get("arch", cell.options.get("first"))
    seed = arch.arch_set(cell.options["arches"])[number]
    return f"{seed.arch_type} {seed.variant}"


def _shares(groups, reached):
    """Lists [successes, episodes] by group."""
    counts = {}
    for group, good in zip(groups, reached, strict=True):
        count = counts.setdefault(group or "default", [0, 0])
        count[0] += int(good)
        count[1] += 1
    return counts


@dataclasses.dataclass(frozen=True)
class Selection:
    """Which cells to play.

    Attributes:
        only: Parts to play.
        anatomy: Names or directories of the anatomies of the part `anatomies`.
        goals: Branches of these anatomies, of those that they have.
        pair: Whether a guidewire in a catheter is driven from the groin.
        pool: Number of held-out arches of the parts `arches` and `neck`, the first
            ones; all by default.
        max_steps: Number of control steps after which an episode is cut off; that of
            the task by default.
        episodes: Number of episodes of a cell of `anatomies` or `changes`.
    """

    only: tuple[Part, ...] = get_args(Part)
    anatomy: tuple[str, ...] = PHANTOMS
    goals: tuple[str, ...] = GOALS
    pair: bool = False
    pool: int | None = None
    max_steps: int | None = None
    episodes: int = 20

    def cells(self):
        """Yields the cells in order."""
        makers = {
            "arches": lambda: arches(self.pool, self.pair),
            "neck": lambda: neck(self.pool, self.pair),
            "variants": lambda: variants(self.pair),
            "anatomies": lambda: anatomies(
                self.anatomy, self.pair, self.goals, self.episodes
            ),
            "changes": lambda: changes(self.pair, self.episodes),
            "narrow": lambda: narrow(self.pair),
        }
        for cell in (cell for part in self.only for cell in makers[part]()):
            labels, options = dict(cell.labels), dict(cell.options)
            if self.pair:
                labels["devices"] = "pair"
            if self.max_steps is not None:
                options["max_steps"] = self.max_steps
            yield dataclasses.replace(cell, labels=labels, options=options)


def main(
    policy: Annotated[str, tyro.conf.Positional],
    out: Path,
    selection: Annotated[Selection, tyro.conf.OmitArgPrefixes],
    ray: bool = False,
    processors: int = 1,
) -> None:
    """Play the cells that are missing in a file.

    Args:
        policy: Run, checkpoint, `pretrained:NAME` or a name of `cathsim eval`.
        out: File with a line of JSON for each cell.
        selection: Which cells to play.
        ray: Whether the machines of a Ray cluster play the cells.
        processors: Number of processors of a cell on the cluster.
    """
    lines = out.read_text().splitlines() if out.exists() else []
    done, missing = [json.loads(line) for line in lines], []
    files.require_file(out, make=True)
    for cell in selection.cells():
        key = {"policy": policy, "part": cell.part, **cell.labels}
        if not any(key.items() <= line.items() for line in done):
            missing.append(cell)
    played = enumerate(play(policy, cell) for cell in missing)
    if ray:
        own = load_policy(policy), processors, torch.get_num_threads()
        jobs = [(policy, cell, *own) for cell in missing]
        played = cluster.over(_play_apart, jobs, processors)
    found = {}
    for number, line in played:
        found[number], cell = json.dumps(line), missing[number]
        with out.open("a") as file:
            file.write(found[number] + "\n")
        print(cell.part, cell.labels, line["success"], "of", cell.episodes)
    if ray:  # the cluster finishes cells in another order
        lines += [found[number] for number in sorted(found)]
        files.write_text(out, "".join(f"{line}\n" for line in lines))


if __name__ == "__main__":
    try:
        tyro.cli(main)
    except (ValueError, OSError, ImportError) as error:
        sys.exit(f"robust: {error}")
