"""Writes the clips of README and docs/gallery.md, each with its command.

    python docs/scripts/gallery.py [NAME …]

Writes docs/images/gallery/NAME.webp, for all or the given names, and prints the grid of
the page; "cannulation" is the film at the top of the README,
docs/images/cannulation.webp. Needs no OpenGL; the same seeds give the same clips.
"""

import argparse
import dataclasses
from pathlib import Path

from cathsim_dmc.agents import load_policy  # must be imported before dm_control

import figures  # isort: skip
import cathsim_dmc  # isort: skip
from cathsim_dmc.agents.evaluation import EVALUATION_SEED  # isort: skip
from cathsim_dmc.agents.policies import task_and_options  # isort: skip
from cathsim_dmc import suite  # isort: skip
from cathsim_dmc.pictures.animation import animate  # isort: skip

DOCS = Path(__file__).parents[1]
FOLDER = DOCS / "images" / "gallery"
LIMIT = 3_000_000  # bytes, all clips together
CLIP = {"frames": 36, "width": 400, "quality": 50}
FILM = {"frames": 72, "width": 780, "quality": 72}
COLUMNS = 3


@dataclasses.dataclass(frozen=True)
class Clip:
    """A film of an episode, as `cathsim record` makes it."""

    name: str
    caption: str
    policy: str
    task: str
    seed: int
    steps: int | None = None
    own_task: bool = False  # whether the policy's own task, not in the command
    options: dict[str, object] = dataclasses.field(default_factory=dict)

    @property
    def command(self) -> str:
        parts = ["cathsim record", self.policy]
        parts += [] if self.own_task else [f"--task {self.task}"]
        parts += [f"--{name} {value}" for name, value in self.options.items()]
        parts += [f"--seed {self.seed}"] if self.seed != EVALUATION_SEED else []
        parts += [f"--max-steps {self.steps}"] if self.steps else []
        return " ".join([*parts, f"--film {self.name}.webp"])


def _shipped(task: str, caption: str) -> Clip:
    return Clip(
        task, caption, f"pretrained:{task}", task, EVALUATION_SEED, own_task=True
    )


# A row for each family: published tasks, femoral access, any arch, coaxial devices.
CLIPS = (
    _shipped("type1_bca", "PPO, Type I, brachiocephalic artery"),
    _shipped("type1_lcca", "PPO, Type I, left common carotid"),
    _shipped("type2_lcca", "PPO, Type II, left common carotid"),
    Clip(
        "femoral", "Expert from the groin, Type III", "expert", "femoral_type3_lcca", 1
    ),
    Clip("bovine", "Expert, bovine arch", "expert", "femoral_bovine_lcca", 1),
    Clip(
        "living",
        "Expert, living vessel",
        "expert",
        "femoral_type1_lcca",
        1,
        options={"vessel": "living"},
    ),
    Clip(
        "arch",
        "Navigator, random arch that it has not seen",
        "pretrained:navigator",
        "arch_any",
        EVALUATION_SEED,
        own_task=True,
        options={"first": 7, "pool": 1},
    ),
    Clip(
        "navigate",
        "Expert in any anatomy, such as your scan's folder",
        "expert",
        "navigate",
        1,
        options={"anatomy": "type2", "goal": "bca", "access": "descending"},
    ),
    Clip("simple", "Expert, drawn arch", "expert", "simple1_lcca", 1),
    Clip(
        "pair",
        "Learnt from the expert, guidewire in catheter",
        "pretrained:femoral_type1_lcca_pair",
        "femoral_type1_lcca_pair",
        EVALUATION_SEED,
        own_task=True,
    ),
    Clip(
        "wire",
        "Expert, guidewire alone: it does not reach",
        "expert",
        "femoral_type1_bca_wire",
        1,
        200,
    ),
    Clip("jam", "A straight push passes and jams", "push", "type1_lcca", 0, 120),
    Clip(
        "recovery",
        "Navigator, bovine arch: it withdraws and tries again",
        "pretrained:navigator",
        "femoral_bovine_lcca",
        1,
    ),
    Clip(
        "image",
        "Navigator that sees three views alone, Type II",
        "pretrained:navigator_image",
        "type2_lcca",
        1,
    ),
    Clip(
        "pair_any",
        "Wire in catheter, to a vertebral artery of an arch not seen before",
        "pretrained:navigator_pair",
        "neck_any_pair",
        EVALUATION_SEED,
        own_task=True,
        options={"first": 7, "pool": 1, "arches": "test_neck", "goal": "lva"},
    ),
)


README = Clip("cannulation", "", "expert", "femoral_type1_lcca", 3)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    clips = {clip.name: clip for clip in (*CLIPS, README)}
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {[*clips]}")
    names = parser.parse_args().names
    if unknown := set(names) - clips.keys():
        parser.error(f"no clips {sorted(unknown)}; there are {[*clips]}")
    FOLDER.mkdir(exist_ok=True)
    for clip in clips.values():
        if names and clip.name not in names:
            continue
        policy = load_policy(clip.policy, clip.seed)
        task, kwargs = task_and_options(policy, clip.task, clip.options)
        kwargs["observation"] = policy.observation or "tracking"
        env = suite.load("cathsim", task, kwargs)
        episode = cathsim_dmc.record(
            env, policy, seed=clip.seed, max_steps=clip.steps, task_name=clip.task
        )
        folder, options = (FOLDER.parent, FILM) if clip is README else (FOLDER, CLIP)
        path = folder / f"{clip.name}.webp"
        animate(episode, env.task.scene.anatomy.surface, path, **options)
        size = path.stat().st_size
        print(f"{path.name}: {size / 1e3:.0f} kB, {episode.termination}", flush=True)
        if size > LIMIT:
            raise SystemExit(f"{path.name} is larger than {LIMIT} bytes")
    total = sum(path.stat().st_size for path in FOLDER.glob("*.webp"))
    if total > LIMIT:
        raise SystemExit(f"the clips have {total} bytes, more than {LIMIT}")


def grid(folder: str) -> list[str]:
    """The clips as a table of Markdown, with pictures under a folder."""
    rows = []
    for first in range(0, len(CLIPS), COLUMNS):
        row = CLIPS[first : first + COLUMNS]
        rows.append([f"![{clip.caption}]({folder}/{clip.name}.webp)" for clip in row])
        rows.append([f"{clip.caption}<br>`{clip.command}`" for clip in row])
    return figures.grid(rows[0], rows[1:])


if __name__ == "__main__":
    main()
    print("\n".join(grid("images/gallery")))
