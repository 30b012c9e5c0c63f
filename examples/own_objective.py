"""A user's own objective: reach the branch with little force on the wall.

`python examples/own_objective.py` registers a task with this objective and trains PPO
on it for 20,000 frames. In this process the task works like every other task of
`cathsim_dmc.suite`; in the folder of this file, `cathsim eval RUN --import
own_objective` makes it known to the command line.
"""

import argparse
import dataclasses
from pathlib import Path

from cathsim_dmc import agents, suite
from cathsim_dmc.tasks.objectives import Cannulation

TASK = "gentle_type1_lcca"


@dataclasses.dataclass(frozen=True)
class GentleCannulation(Cannulation):
    """Cannulation with a penalty on the largest contact above 0.1 N."""

    TERMS = {
        **Cannulation.TERMS,
        "hard_contact": lambda self, m: (m.wall_force.mean_max - 0.1).clip(min=0.0),
    }


def gentle(
    anatomy, goal, *, tolerance_weight: float = 1.0, farthest_shift: float = 0.0
):
    """The objective of the task; keyword arguments become options of the task.

    `farthest_shift` is no option: the task passes how far it may shift the goal, m.
    """
    reward = {"distance": -1.0, "success": 10.0, "hard_contact": -tolerance_weight}
    return GentleCannulation.to(
        anatomy, goal, reward=reward, farthest_shift=farthest_shift
    )


suite.register(
    TASK,
    suite.TaskDefinition(
        "Type-I phantom: cannulate the LCCA gently.", "type1", "lcca", objective=gentle
    ),
)

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("runs/own_objective"))
    parser.add_argument("--frames", type=int, default=20_000)
    options = parser.parse_args()
    # The run keeps the name of this module, which evaluations import.
    config = agents.make_config(
        "ppo", "demo", task=TASK, total_frames=options.frames, modules=["own_objective"]
    )
    print(agents.train(config, options.out))
