"""Scripted policies and the base class of all policies; numpy without torch."""

import inspect
from collections.abc import Callable

from cathsim_dmc import bounds
from cathsim_dmc.policies.expert import ExpertPolicy, Teacher
from cathsim_dmc.policies.policy import Policy, View, in_environment
from cathsim_dmc.policies.scripted import Curl, Idle, Push, Random, RandomCurl

# Policies by name; to add one, write a class and add a line here.
POLICIES: dict[str, Callable[[int], Policy]] = {
    "random": Random,
    "push": Push,
    "expert": ExpertPolicy,
    "idle": Idle,
    "curl": Curl,
    "random_curl": RandomCurl,
}


def make_policy(name: str, seed: int = 0) -> Policy:
    """Returns a new policy by its name in `POLICIES`.

    Args:
        seed: Seed of the policy for the first simulation; those of the others count
            up.

    Raises:
        ValueError: there is no policy of that name; lists the names. Or its entry in
            `POLICIES` makes no policy.
    """
    make = POLICIES[bounds.choice("policy", name, POLICIES)]
    seed = bounds.seed("seed", seed)
    try:
        inspect.signature(make).bind(seed)
    except TypeError:
        bounds.refuse(f"POLICIES[{name!r}]", make, "a class or function of a seed")
    made = make(seed)
    return bounds.instance(f"POLICIES[{name!r}](seed)", made, Policy)


__all__ = ["POLICIES", "Policy", "Teacher", "View", "in_environment", "make_policy"]
