"""A Ray cluster of two nodes on this machine, whose second one can be killed."""

import contextlib
import os
import sys

import pytest

HERE = os.path.dirname(__file__)
# Ray gives a node 30 s to come up, which is short beside other work, and kills workers
# when all processes of the machine together take much memory.
PATIENCE = {
    "RAY_memory_monitor_refresh_ms": "0",
    "RAY_raylet_start_wait_time_s": "300",
    "RAY_agent_register_timeout_ms": "300000",
    # What is deleted after Ray has ended would start it again and wait.
    "RAY_ENABLE_AUTO_CONNECT": "0",
    "MUJOCO_GL": "disable",
    "OMP_NUM_THREADS": "1",
}
# A silent node is lost after a second or two, not after 15.
HEALTH = {
    "health_check_initial_delay_ms": 2_000,
    "health_check_period_ms": 500,
    "health_check_timeout_ms": 5_000,
    "health_check_failure_threshold": 3,
}


class TwoNodes:
    """A cluster of nodes with one processor each."""

    def __init__(self):
        from ray.cluster_utils import Cluster

        head = {"num_cpus": 1, "include_dashboard": False, "_system_config": HEALTH}
        self._cluster = Cluster(initialize_head=True, head_node_args=head)
        self.address, self._second = self._cluster.address, None
        self.restore()

    @property
    def second(self):
        """Identity of the second node."""
        return self._second.node_id

    def restore(self):
        """Adds the second node unless it is there."""
        if self._second is None:
            self._second = self._cluster.add_node(num_cpus=1)

    def kill(self):
        """Ends all processes of the second node at once, as when power is lost."""
        node, self._second = self._second, None
        self._cluster.remove_node(node, allow_graceful=False)

    def shutdown(self):
        self._cluster.shutdown()


@contextlib.contextmanager
def two_nodes():
    """Starts the cluster and connects to it, as `ray start` and RAY_ADDRESS would."""
    from cathsim_dmc import cluster

    with pytest.MonkeyPatch.context() as patch:
        # Nodes give their environment to the processes that they start.
        own = os.pathsep.join(dict.fromkeys([HERE, *filter(None, sys.path)]))
        for name, value in {**PATIENCE, "PYTHONPATH": own}.items():
            patch.setenv(name, value)
        nodes = TwoNodes()
        try:
            patch.setenv("RAY_ADDRESS", nodes.address)
            cluster.connect()
            yield nodes
        finally:
            import ray

            ray.shutdown()
            nodes.shutdown()
