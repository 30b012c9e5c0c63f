"""Upload to a hub: policies with a card and a page, datasets."""

import json
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cathsim_dmc.agents import hub, pretrained
from cathsim_dmc.agents.checkpoint import read_newest
from cathsim_dmc.analysis.force_statistics import millinewtons
from cathsim_dmc.recording.dataset import DatasetError, recordings_in

_PAGE = """\
---
library_name: cathsim_dmc
tags: [endovascular-navigation, reinforcement-learning, robotics, mujoco, dm_control]
---
# {name}

{what}

```sh
{command}   # needs its extra `hub`
```
"""


def upload(source: str | Path, text: str, *, private: bool = True) -> str:
    """Upload a policy or a dataset to the hub.

    Args:
        source: A run, a checkpoint, "pretrained:NAME" or a `.safetensors` file with its
            card; or the directory of a dataset or of recorded episodes.
        text: "hf:OWNER/NAME".
        private: Whether a repository that is made is private.

    Returns:
        The reference with its commit, which `load_policy` and `--demonstrations` take.

    Raises:
        CheckpointError: there is no such policy, or it is damaged.
        ValueError: the text is no reference, or the hub refuses.
        ModuleNotFoundError: the extra `hub` is not installed.
    """
    place = hub.parse(text, pinned=False)
    with tempfile.TemporaryDirectory() as folder:
        data = _data_of(source)
        if data:
            for file in data:
                target = Path(folder) / file.relative_to(source)
                target.parent.mkdir(exist_ok=True)
                shutil.copyfile(file, target)
            _write_page(Path(folder), place.name, "Demonstrations.", (
                f"cathsim train TASK --algo bc --demonstrations hf:{place.repository}"
                "@COMMIT --out RUN"
            ))  # fmt: skip
            return hub.upload(Path(folder), text, "dataset", private)
        card = _write_policy(source, Path(folder), place.name)
        _write_page(Path(folder), place.name, _summary(card), (
            f"cathsim eval hf:{place.repository}@COMMIT"
        ))  # fmt: skip
        done = hub.upload(Path(folder), f"hf:{place.repository}", "model", private)
    own = place.name != place.repository.partition("/")[2]
    return f"{done}#{place.name}" if own else done


def _data_of(source: str | Path) -> list[Path]:
    """Return the files of a dataset; none if the source is a policy."""
    folder = Path(source)
    if not folder.is_dir() or (folder / "checkpoints").exists():
        return []
    found = recordings_in(folder) + sorted(folder.glob("data/*.hdf5"))
    described = folder / "data" / "metadata.json"
    if found and found[0].suffix == ".hdf5" and not described.is_file():
        raise DatasetError(f"{folder} lacks data/metadata.json")
    return found + [described] * described.is_file()


def _write_policy(source: str | Path, folder: Path, name: str) -> dict[str, Any]:
    """Write weights and card of a policy under a name; return the card."""
    path = pretrained.pretrained_path(source)
    if path is not None:
        old, network, _, _ = pretrained.read_pretrained(path)
        state, card = network.state_dict(), {**old}
        for part in ("format", "name", "sha256"):
            card.pop(part)
    else:
        one, state = read_newest(source, lambda read: (read, read.policy_state()))
        judged = Path(source) / "evaluation.json"
        evaluation = {}
        if judged.is_file():
            found = json.loads(judged.read_text())
            # `evaluate` writes one result, `cathsim eval` that of the baseline, too.
            found = found if "summary" in found else found.get("policy", {})
            # Only of this checkpoint, not of another policy or an earlier one.
            if found.get("settings", {}).get("frames") == one.frames:
                evaluation = found
        card = {
            "task": one.config.task,
            "task_kwargs": dict(one.config.task_kwargs),
            "config": one.config.to_dict(),
            "shapes": one.shapes.to_dict(),
            "training": {
                "frames": one.frames,
                "seconds": round(one.seconds, 1),
                "seed": one.config.seed,
            },
            "evaluation": evaluation,
            "versions": dict(one.versions),
        }
    pretrained.write(folder, name, state, card)
    return card


def _summary(card: Mapping[str, Any]) -> str:
    """Return two sentences: what the policy is, and its success, where, and force."""
    config, training = card["config"], card["training"]
    text = (
        f"Policy of the task `{card['task']}` of cathsim_dmc, observation "
        f"`{config['observation']}`, {config['algorithm']}, {training['frames']:,} "
        "frames."
    )
    judged = card["evaluation"]
    summary, settings = judged.get("summary", {}), judged.get("settings", {})
    if "success" not in summary:
        return f"{text} Not evaluated."
    forces = summary.get("forces", {})
    # As `EpisodeForces.max_force`.
    force = summary.get("max_force") or forces.get("mean_max") or forces.get("max")
    rate = f"{100 * summary['success']:.0f} % of {summary['episodes']} episodes"
    # A card without these is of a policy that ships, evaluated on its task.
    where = f" of `{judged['task']}`" if "task" in judged else ""
    if "protocol" in settings:
        where += f", protocol {settings['protocol']}"
    if options := settings.get("task_kwargs"):
        where += f", options `{json.dumps(options)}`"
    with_force = ""
    if isinstance(force, Mapping) and "maximum" in force:
        largest = force["maximum"]
        with_force = f", max force {millinewtons(largest['mean'])} mN"
    return f"{text} Success {rate}{where}{with_force}."


def _write_page(folder: Path, name: str, what: str, command: str) -> None:
    page = _PAGE.format(name=name, what=what, command=command)
    (folder / "README.md").write_text(page, encoding="utf-8")
