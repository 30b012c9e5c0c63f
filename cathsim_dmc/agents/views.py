"""Views of the simulations of TorchRL environments."""

from typing import Any, cast

from torchrl.envs import EnvBase

from cathsim_dmc.policies import View


class _ForeignView:
    def __init__(self, env: EnvBase):
        (self.num_simulations,) = env.batch_size
        self.num_actions = int(env.action_spec.shape[-1])

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(
            f"the policy asks for {name!r}, which only environments of "
            "cathsim_dmc.simulation know"
        )


def view_of(env: EnvBase) -> View:
    """The view of the simulations of a TorchRL environment."""
    base = getattr(env, "base_env", env)
    if hasattr(base, "simulation"):
        return View(base.simulation)
    # Whatever a policy asks of it beyond its numbers is an error that says so.
    return cast(View, _ForeignView(env))
