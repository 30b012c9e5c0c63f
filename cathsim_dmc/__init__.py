"""Endovascular navigation tasks on dm_control composer and MuJoCo.

    env = cathsim_dmc.suite.load("cathsim", "type1_lcca", {"random": 0})
    episode = cathsim_dmc.record(env, "expert", "episode.webp", seed=0)

Functions that look at an environment or an episode (`help(cathsim_dmc.show)`):

    record       plays an episode with a policy; writes it as a film or a recording
    show         draws anatomy, device, goal and contact forces of a state
    plot         draws forces, insertion and distance of an episode over time
    forces       contacts and forces of a state, in newtons
    fluoroscopy  X-ray image of a state

Packages (`help(cathsim_dmc.suite)`), imported when they are first used:

    suite        tasks by name: load, make_task, register
    simulation   many simulations at once; TorchRL and Gymnasium environments
    policies     scripted policies, base class of all policies
    agents       learners, training, evaluation, pretrained policies: load_policy
    tasks        rewards, observations, options and randomisation of a task
    entities     devices, sheath, phantom and follower robot
    anatomy      vessels: phantoms, random arches, scans
    imaging      fluoroscopy
    recording    episodes and their files
    pictures     figures, films and readouts of forces
    analysis     force statistics, heatmaps, intervals
    validation   physics against closed forms
    physics      effects on a simulation, drives, readings, forces
    bridge       policies that drive a robot
    play         cannulation by hand
    gym          registers the tasks with Gymnasium

The command `cathsim --help` does most of this without Python.
"""

import importlib
import warnings

__version__ = "0.3.0.dev0"

# MuJoCo's window library warns at import on a machine without a display. Only viewers
# need a display, and they raise errors of their own.
warnings.filterwarnings("ignore", message=".*DISPLAY environment variable is missing.*")

_SUBMODULES = (
    "agents",
    "analysis",
    "anatomy",
    "bridge",
    "entities",
    "gym",
    "imaging",
    "physics",
    "pictures",
    "play",
    "policies",
    "recording",
    "simulation",
    "suite",
    "tasks",
    "validation",
)
# Functions of `cathsim_dmc.pictures` that the package itself offers too.
_FUNCTIONS = ("fluoroscopy", "forces", "plot", "record", "show")


def __getattr__(name: str):
    # Lazy, so that `import cathsim_dmc` loads neither dm_control nor torch.
    if name in _FUNCTIONS:
        return getattr(importlib.import_module(f"{__name__}.pictures"), name)
    if name in _SUBMODULES:
        return importlib.import_module(f"{__name__}.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    public = {name for name in globals() if name not in ("importlib", "warnings")}
    return sorted(public.union(_SUBMODULES, _FUNCTIONS))
