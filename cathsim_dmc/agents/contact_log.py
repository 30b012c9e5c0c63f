"""Wall contacts of an evaluation, for its heatmap."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from torchrl.envs import EnvBase

from cathsim_dmc import suite
from cathsim_dmc.analysis import heatmap
from cathsim_dmc.anatomy.scan.aorta import is_upright

# Positions (K, 3), m, and magnitudes (K,), N, of the contacts of a control step.
_Step = tuple[np.ndarray, np.ndarray]


def _joined(steps: Sequence[_Step]) -> _Step:
    positions = np.concatenate([position for position, _ in steps])
    return positions, np.concatenate([magnitude for _, magnitude in steps])


class ContactLog:
    """An observer that collects the contacts with the wall."""

    def __init__(self):
        self._steps: list[_Step] = [(np.zeros((0, 3)), np.zeros(0))]

    def __call__(self, env: EnvBase, running: np.ndarray) -> None:
        """Adds the contacts at the end of a control step."""
        found = env.base_env.simulation.contacts()
        present = found.present & running[:, None]
        self._steps.append((found.position[present], found.magnitude[present]))

    def join(self, logs: Sequence["ContactLog"]) -> None:
        """Adds contacts of episodes that were played separately, step by step."""
        for number in range(max((len(log._steps) for log in logs), default=0)):
            found = [log._steps[number] for log in logs if number < len(log._steps)]
            self._steps.append(_joined(found))

    def contacts(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions (K, 3), m, world frame, and magnitudes (K,), N."""
        return _joined(self._steps)

    def draw(self, result: Any, path: Path) -> None:
        """Writes the heatmap of an `EvaluationResult` as PNG, if of one anatomy.

        Otherwise removes that of an earlier evaluation.
        """
        task = suite.make_task(result.task, **result.settings["task_kwargs"])
        if task.num_anatomies > 1:
            path.unlink(missing_ok=True)
            return
        title = f"{result.task}, {result.policy}: {len(result.episodes)} episodes"
        anatomy = task.scene.anatomy
        positions, magnitudes = self.contacts()
        upright, surface = is_upright(anatomy), anatomy.surface
        heatmap.heatmap(positions, magnitudes, surface, path, title, upright)
