"""First mode of a free end: chain of links against beam."""

from collections.abc import Iterator

import mujoco
import numpy as np
from scipy.linalg import eigh

from cathsim_dmc.entities.coaxial import moved_mass
from cathsim_dmc.entities.devices import DEVICES, Discretisation
from cathsim_dmc.validation.checks import Check
from cathsim_dmc.validation.rig import Rig

FREE = 0.12  # m, length of the free end
MODE_BOUND = 10.0  # % of the frequency
_ELEMENTS = 240


def beam_frequency(lengths: np.ndarray, bending: np.ndarray, mass: float) -> float:
    """First frequency (Hz) of a stepped cantilever, by Hermite finite elements.

    Args:
        lengths: (S,) lengths of uniform sections from the clamp on, m.
        bending: (S,) bending stiffness EI of the sections, N·m².
        mass: Mass per length, kg/m.
    """
    edges = np.linspace(0.0, lengths.sum(), _ELEMENTS + 1)
    h, middles = edges[1], (edges[1:] + edges[:-1]) / 2
    section = np.searchsorted(np.cumsum(lengths), middles)
    stiff = np.array(
        [[12, 6, -12, 6], [6, 4, -6, 2], [-12, -6, 12, -6], [6, 2, -6, 4]], float
    )
    heavy = np.array(
        [[156, 22, 54, -13], [22, 4, 13, -3], [54, 13, 156, -22], [-13, -3, -22, 4]],
        float,
    )  # slopes times the length of an element
    size = 2 * _ELEMENTS + 2
    k, m = np.zeros((2, size, size))
    for one in range(_ELEMENTS):
        own = slice(2 * one, 2 * one + 4)
        k[own, own] += bending[section[one]] / h**3 * stiff
        m[own, own] += mass * h / 420 * heavy
    found = eigh(k[2:, 2:], m[2:, 2:], eigvals_only=True, subset_by_index=(0, 0))
    return float(np.sqrt(found[0]) / (2 * np.pi))


def chain_frequency(rig: Rig) -> float:
    """First frequency (Hz) of a straight chain in a plane with a fixed base."""
    model, data = rig.model, rig.data
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    names = (f"{rig.name}/bend_x_{n}" for n in range(1, len(rig.lengths)))
    joints = [model.joint(name).id for name in names]
    dofs = model.jnt_dofadr[joints]
    stiffness = np.diag(model.jnt_stiffness[joints])
    found = eigh(stiffness, mass[np.ix_(dofs, dofs)], eigvals_only=True)
    return float(np.sqrt(found[0]) / (2 * np.pi))


def frequencies(device: str) -> tuple[float, float]:
    """First frequencies (Hz) of chain and beam, for a free end of a device in blood."""
    rig = Rig(device, Discretisation(working_length=FREE), straight=True)
    rig.compile()
    lengths, bending, _ = rig.sections
    mass = moved_mass(rig.catheter.devices)
    return chain_frequency(rig), beam_frequency(lengths, bending, mass)


def checks() -> Iterator[Check]:
    """Checks of the first mode of every device of the library."""
    for device in DEVICES:
        name = f"first mode of a free end of {1e3 * FREE:g} mm, {device}"
        chain, beam = frequencies(device)
        yield Check.deviation(name, chain, beam, MODE_BOUND, "Hz")
