"""N simulations of one task in MuJoCo Warp, with the contract of a batch."""

from __future__ import annotations

from collections.abc import Sequence

from cathsim_dmc.simulation.batch import BatchSimulation
from cathsim_dmc.simulation.warp.devices import Device
from cathsim_dmc.simulation.warp.stepper import WarpStepper
from cathsim_dmc.tasks.navigation import Navigation


class WarpSimulation(BatchSimulation):
    """N simulations of one task on one device.

    They agree with those of `BatchSimulation` within single precision. On a GPU they
    differ from run to run, because it adds numbers in any order.

    Attributes:
        stepper: Does the physics steps.
    """

    stepper: WarpStepper

    def __init__(
        self,
        task: Navigation,
        num_simulations: int,
        *,
        device: str = "cuda",
        num_threads: int = 0,
        seeds: Sequence[int] | int = 0,
    ):
        """Compiles the task's model; the first step copies it to the device.

        Args:
            task: Task that belongs to no environment; from now on it is the batch's.
            num_simulations: N.
            device: Device of Warp, "cuda" for the first GPU.
            num_threads: Threads of the host, 0 for one per core.
            seeds: Seeds of the simulations, or of the first; the others count up.

        Raises:
            ImportError: if the extra `gpu` is not installed.
            NotImplementedError: if Warp does not support an option of the task.
            ValueError: as `BatchSimulation`, or if there is no such device.
        """
        self._device = Device(device)
        super().__init__(task, num_simulations, num_threads=num_threads, seeds=seeds)
        self.stepper.take(self.rollout)

    def _made_stepper(self, num_simulations: int, num_threads: int) -> WarpStepper:
        task, model = self.task, self._model
        return WarpStepper(task, model, num_simulations, self._device, num_threads)

    def close(self) -> None:
        """Frees the memory of the device; the next step allocates it again."""
        self.stepper.close()
