"""Policies that are not learnt, and what every policy is: numpy, no torch."""

from collections.abc import Callable

from cathsim_dmc import bounds
from cathsim_dmc.policies.expert import ExpertPolicy, Teacher
from cathsim_dmc.policies.policy import Policy, View, in_environment
from cathsim_dmc.policies.scripted import Curl, Idle, Push, Random, RandomCurl

# Policies by name: a new one is a class and a line here.
POLICIES: dict[str, Callable[[int], Policy]] = {
    "random": Random,
    "push": Push,
    "expert": ExpertPolicy,
    "idle": Idle,
    "curl": Curl,
    "random_curl": RandomCurl,
}


def make_policy(name: str, seed: int = 0) -> Policy:
    """The policy of a name.

    Args:
        seed: Seed of the policy's own randomness, for the first simulation; those of
            the others count up.

    Raises:
        ValueError: there is none of that name; lists those that exist.
    """
    return POLICIES[bounds.choice("policy", name, POLICIES)](bounds.seed("seed", seed))


__all__ = ["POLICIES", "Policy", "Teacher", "View", "in_environment", "make_policy"]
