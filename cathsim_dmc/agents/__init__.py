"""Agents: learners and demonstrations, training, evaluation, checkpoints."""

# isort: off
import os
import sys
import warnings

# With OpenGL, loading dm_control before torchrl ends in a segmentation fault inside
# triton. The other order is safe, and so is any order without OpenGL.
if (
    os.environ.get("MUJOCO_GL") in ("egl", "osmesa")
    and "dm_control.mujoco" in sys.modules
    and "torchrl" not in sys.modules
):
    raise ImportError(
        f"MUJOCO_GL={os.environ['MUJOCO_GL']} and dm_control was imported before "
        "torchrl, which crashes; import torchrl or cathsim_dmc.agents first, or set "
        "MUJOCO_GL=disable"
    )

# TorchRL 0.14 warns of classes of its own at import; dm_control has all deprecation
# warnings shown, unless a filter is added after its import.
warnings.filterwarnings("ignore", message=".*WeightUpdaterBase is deprecated.*")
import torchrl.collectors  # noqa: F401

# isort: on

from cathsim_dmc.agents.checkpoint import Checkpoint, CheckpointError
from cathsim_dmc.agents.config import ConfigError, TrainingConfig
from cathsim_dmc.agents.demonstrations import record_demonstrations
from cathsim_dmc.agents.evaluation import EvaluationResult, evaluate
from cathsim_dmc.agents.learners import LEARNERS, make_config
from cathsim_dmc.agents.policies import load_policy
from cathsim_dmc.agents.ppo import PPOConfig
from cathsim_dmc.agents.sac import SACConfig
from cathsim_dmc.agents.submission import record_actions
from cathsim_dmc.agents.training import TrainingResult, train
from cathsim_dmc.simulation.environments import make_env

__all__ = [
    "LEARNERS", "Checkpoint", "CheckpointError", "ConfigError", "EvaluationResult",
    "PPOConfig", "SACConfig", "TrainingConfig", "TrainingResult", "evaluate",
    "load_policy", "make_config", "make_env", "record_actions",
    "record_demonstrations", "train",
]  # fmt: skip
