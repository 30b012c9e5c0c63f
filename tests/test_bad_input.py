"""Bad values at every entry: refused, by name, before anything is written."""

import dataclasses
import math

import numpy as np
import pytest
from bad_values import NONE, Tally, flag, number, options, pixels, span, whole, word
from hypothesis import strategies as st

import cathsim_dmc.gym  # noqa: F401  registers the ids
from cathsim_dmc import suite
from cathsim_dmc.agents import learners
from cathsim_dmc.anatomy.arch import arch
from cathsim_dmc.anatomy.centreline import Centreline
from cathsim_dmc.anatomy.parts import Goal, Inlet, Surface
from cathsim_dmc.anatomy.scan.importer import import_scan
from cathsim_dmc.entities import devices
from cathsim_dmc.imaging.options import FluoroscopyOptions
from cathsim_dmc.physics.randomisation import Randomisation
from cathsim_dmc.tasks.config import NavigationConfig

ARCH = arch.ARCHES["simple1"]
POSITIVE = number(positive=True)

TASK = {
    "observation": word(),
    "device": word(),
    "rotation": flag(),
    "max_steps": whole(1),
    "give_up": flag(),
    "friction": number(0, 2),
    "shaft_link": number(2e-3, 0.1),
    "sheath_clearance": number(0.1e-3, 2e-3, optional=True),
    "working_length": number(0.02, 3, optional=True),
    "physics_timestep": number(4e-5, 0.005),
    "solver_tolerance": number(1e-12, 1e-4),
    "outside_range": flag(),
    "fluoroscopy": options() | NONE,
    "endoluminal_size": pixels(),
    "cameras": options() | NONE,
    "randomisation": options() | NONE,
    "vessel": options() | NONE,
    "goal_radius": number(0, 1, positive=True, optional=True),  # None: the usual one
    "reward": options() | NONE,
    "start_along_route": span(0, 0.95),
    "devices": st.sampled_from(["x", 1, [], [1], (None,), {}, ["x"], True]),
    "effects": st.sampled_from(["x", 1, [1], [None], {}, True, None]),
    "lead": number(0, 0.3),
    "lumen_friction": number(0, 2),
    "random": whole(0, 2**32 - 1, optional=True),
}
# Whether these name anything is known where the scene is built.
CONFIG = TASK.keys() - {"observation", "device", "devices", "goal_radius", "reward"}
CONFIG -= {"random"}
NAVIGATE = {"anatomy": word(), "goal": word(), "access": word(optional=True)}
ARCHES = {"arches": word(), "pool": whole(1, 1000), "first": whole(0, 10_000)}
FLUOROSCOPY = {
    "view": word().filter(lambda value: value != (1, 2))
    | st.tuples(number(-360, 360), st.just(0)),
    "biplane": word(optional=True).filter(lambda value: value != (1, 2))
    | st.tuples(st.just(0), number(-89, 89)),
    "third": word(optional=True).filter(lambda value: value != (1, 2))
    | st.tuples(st.just(0), number(-89, 89)),
    "roadmap_errors": options() | NONE,
    "size": pixels(),
    "magnification": number(0.01, 1000),
    "centre": st.tuples(st.just(0), number(-10, 10), st.just(0)),
    "contrast": number(0, 1e4).filter(lambda value: not isinstance(value, bool)),
    "noise": flag(),
    "kerma": number(0, 1, positive=True),
    "gain": number(0, 1000, positive=True),
    "blur": number(0, 0.1),
    "roadmap": number(0, 1),
    "source_detector": number(0.75, 10),
    "source_isocentre": number(0.05, 1.1),
    "detector_size": number(1e-3, 10),
}
RANDOMISATION = {
    "friction": span(0, 2),
    "stiffness": span(0.01, 100),
    "loss": span(0, 100),
    "viscosity": span(0, 100),
    "start_radius": number(0, 0.02),
    "view": span(-90, 90),
    "gain": span(0.01, 100),
    "kerma": span(1e-3, 1e6),
    "goal_shift": span(-1, 1),
    "roll": span(-7, 7),
    "delay": span(0, 250, integers=True),
    "start_insertion": span(0, 1),
    "tracking_noise": number(0, 0.01),
}
BRANCH = {
    "radius": number(1.5e-3, 12e-3),
    "end_radius": number(1e-3, 12e-3),
    "take_off": number(-1.3, 1.3),
    "length": number(40e-3, 150e-3),
    "bend_radius": number(3e-3, 10),
    "bend_azimuth": number(-7, 7),
    "second_bend_radius": number(3e-3, 10, optional=True),
    "second_bend_azimuth": number(-7, 7),
    "lean": number(-1.3, 1.3),
}
ARCH_FIGURES = {
    "bovine": flag(),
    "bca": options() | NONE,
    "lcca": options() | NONE,
    "lsa": options() | NONE,
    "aberrant": options(),
    "plane_rotation": number(-math.pi, math.pi),
    "bca_drop": number(0, 4),
    **{
        name: number(4e-3, 0.4)
        for name in (
            "ascending_radius",
            "bca_level_radius",
            "lcca_level_radius",
            "lsa_level_radius",
            "descending_radius",
            "ascending_length",
            "descending_length",
            "arch_radius",
            "arch_height",
            "bca_lcca_spacing",
            "lcca_lsa_spacing",
        )
    },
    **{name: number(-1, 1) for name in ("ascending_bend", "descending_bend")},
    **{name: number(-0.6, 0.6) for name in ("plane_tilt", "bow", "sway")},
}
DEVICE = {
    "name": word().filter(lambda value: not isinstance(value, str)),
    "outer_radius": POSITIVE,
    "linear_density": POSITIVE,
    "shaft": options() | NONE,
    "tip": options() | NONE,
    "tip_length": POSITIVE,
    "tip_links": whole(1, 200),
    "steering_angle": number(0, math.pi / 2),
    "tip_shape": word().filter(lambda value: value != ""),
}
SECTION = {"bending_stiffness": POSITIVE, "torsional_stiffness": POSITIVE}
DISCRETISATION = {
    "working_length": POSITIVE,
    "shaft_link": POSITIVE,
    "torsion_joints": whole(0),
}
TRAINING = {
    "task": word().filter(lambda value: not isinstance(value, str) or not value),
    "observation": st.sampled_from(["", 1, None, [], [1], {}, 1.5]),
    "task_kwargs": st.sampled_from(
        [None, 1, "x", [1], {"a": object()}, {"a": math.nan}]
    ),
    "num_envs": whole(1),
    "num_threads": whole(1, optional=True),
    "seed": whole(0),
    "total_frames": whole(1),
    "training_reward": st.sampled_from(["x", 1, [], {"path": "x"}, {1: 2.0}, True]),
    "training_max_steps": whole(1, optional=True),
    "training_start": span(0, 1.0),
    "initial_policy": st.sampled_from([1, True, [], {}, 1.5]),
    "initial_std": number(positive=True, optional=True),
    "hidden": st.sampled_from([(), [], 64, "64", (0,), (-1,), (1.5,), None]),
    "activation": word(),
    "cnn_features": whole(1),
    "subtract_background": flag(),
    "simulation_device": word(),
    "logger": word(optional=True),
    "modules": st.sampled_from([1, 1.5, True, {}, [1], (1,)]),
    "convolutions": st.sampled_from(
        [
            *(None, 1, "x", (), [], {}, True, ((1.5, 8, 4),)),
            *(((32, 8),), ((0, 8, 4),), ((32, -8, 4),), (("a", 8, 4),), (32, 8, 4)),
            *(((True, 8, 4),), ((None, 8, 4),), ((32, [8], 4),)),
        ]
    ),
    "learning_rate": POSITIVE,
    "gamma": number(0, 1, positive=True),
    "observation_clip": POSITIVE,
    "normalisation_frames": whole(0),
    "checkpoint_frames": whole(1),
    "checkpoint_seconds": POSITIVE,
    "keep_checkpoints": whole(1),
    "metrics_frames": whole(1),
    "torch_threads": whole(1),
    "collector": word(),
    "collectors": whole(1),
}
CRITIC = {
    "critic_observation": st.sampled_from(["", 1, [], [1], {}, 1.5, (), True]),
    "torch_compile": flag(),
    "anneal": flag(),
}
PPO = CRITIC | {
    "steps_per_update": whole(1),
    "minibatch_size": whole(1),
    "epochs": whole(1),
    "gae_lambda": number(0, 1),
    "clip": POSITIVE,
    "entropy_coefficient": number(0),
    "value_coefficient": number(0),
    "max_grad_norm": POSITIVE,
    "target_kl": number(positive=True, optional=True),
    "initial_deviation": POSITIVE,
    "noise_correlation": number(0, 1),
    "noise_shared": number(0, 1),
}
SAC = CRITIC | {
    "batch_size": whole(1),
    "tau": number(0, 1, positive=True),
    "replay_frames": whole(1),
    "replay_bytes": whole(1),
    "random_frames": whole(0),
    "steps_per_env": whole(1),
    "updates_per_frame": POSITIVE,
    "initial_alpha": POSITIVE,
    "target_entropy": number(optional=True),
    "demonstrations": st.sampled_from([1, True, [], {}, 1.5]),
}
SCAN = {
    "units": word(optional=True),
    "mesh_frame": word(optional=True),
    "axes": word(optional=True),
    "inlet": st.one_of(word(optional=True), st.tuples(number(), st.just(0.0))),
    "rename": st.sampled_from([1, "x", ["a"], {"a": 1}, {1: "a"}]),
    "centreline_paths": st.sampled_from(["x.csv", 1, [1], None, [None]]),
}
PLACE = {"name": "g", "vessel": "v", "position": np.zeros(3), "arc_length": 0.0}
INLET = {
    "vessel": "v",
    "position": np.zeros(3),
    "direction": np.ones(3),
    "radius": 0.01,
}
NUMBERS = st.one_of(
    st.sampled_from(["x", None, [], {}, [[1]], 1j, math.nan]),
    # NumPy takes true for 1, where other numbers stand beside it.
    st.tuples(
        number().filter(lambda value: not isinstance(value, bool)),
        st.just(0.0),
        st.just(1.0),
    ),
)


def _replaced(template):
    return lambda **change: dataclasses.replace(template, **change)


def _scan(path):
    # An option is refused before the file is read; so there need be none.
    return lambda **change: import_scan(path, **change)


def entries(folder):
    """Name of an entry, what takes one field, and bad values by field."""
    section = devices.STEERABLE_5F.shaft
    return [
        ("task options", lambda **o: suite.make_task("type1_bca", **o), TASK),
        ("task navigate", lambda **o: suite.make_task("navigate", **o), NAVIGATE),
        ("task arch_bca", lambda **o: suite.make_task("arch_bca", **o), ARCHES),
        ("NavigationConfig", NavigationConfig, {k: TASK[k] for k in CONFIG}),
        ("FluoroscopyOptions", FluoroscopyOptions, FLUOROSCOPY),
        ("Randomisation", Randomisation, RANDOMISATION),
        ("ArchParameters", _replaced(ARCH), ARCH_FIGURES),
        ("BranchParameters", _replaced(ARCH.bca), BRANCH),
        ("Device", _replaced(devices.STEERABLE_5F), DEVICE),
        ("Section", _replaced(section), SECTION),
        (
            "Arc",
            _replaced(devices.Arc(0.01, 1.0)),
            {"radius": POSITIVE, "angle": number()},
        ),
        ("Discretisation", devices.Discretisation, DISCRETISATION),
        ("PPO settings", lambda **o: learners.make_config("ppo", **o), TRAINING | PPO),
        ("SAC settings", lambda **o: learners.make_config("sac", **o), TRAINING | SAC),
        ("import_scan", _scan(folder / "none.stl"), SCAN),
        ("Goal", lambda **o: Goal(**{**PLACE, **o}), {"position": NUMBERS}),
        (
            "Inlet",
            lambda **o: Inlet(**{**INLET, **o}),
            {"position": NUMBERS, "direction": NUMBERS, "radius": POSITIVE},
        ),
        (
            "Centreline",
            lambda **o: Centreline(**{"points": np.eye(3), "radii": np.ones(3), **o}),
            {"points": NUMBERS, "radii": NUMBERS},
        ),
        (
            "Surface",
            lambda **o: Surface(**{"vertices": np.eye(3), "faces": [[0, 1, 2]], **o}),
            {"vertices": NUMBERS, "faces": NUMBERS},
        ),
    ]


# What a message says in place of the field's name.
SAYS = {
    "size": "size",
    "centreline_paths": "centreline",
    "points": "centreline",
    "radii": "centreline",
    "reward": "reward",
    "random": "random",
    "training_start": "start",
}


def try_values(tally, folder, examples):
    for name, call, fields in entries(folder):
        for field, bad in fields.items():
            word = SAYS.get(field, field)

            def check(value, call=call, name=name, field=field, word=word):
                tally.refused(name, lambda: call(**{field: value}), [word])

            tally.draw(bad, examples, check)


def test_every_field_is_tried():
    """A field that is added later must be told here what it does not take."""
    for kind, tried in (
        (NavigationConfig, TASK),
        (FluoroscopyOptions, FLUOROSCOPY),
        (Randomisation, RANDOMISATION),
        (devices.Discretisation, DISCRETISATION),
        (learners.LEARNERS["ppo"].config, TRAINING | PPO),
        (learners.LEARNERS["sac"].config, TRAINING | SAC),
    ):
        fields = {field.name for field in dataclasses.fields(kind)}
        assert not fields - tried.keys() - {"torch_device"}, kind.__name__


def settled(tally, folder):
    assert not list(folder.iterdir()), "something was written"
    print(tally.report())
    shown = "\n".join(sorted(set(tally.wrong))[:200])
    assert not tally.wrong, f"{len(tally.wrong)} of {tally.tried.total()}:\n{shown}"


@pytest.mark.parametrize("examples", [2, pytest.param(20, marks=pytest.mark.slow)])
def test_bad_values_are_refused_by_name(tmp_path, examples):
    tally = Tally()
    try_values(tally, tmp_path, examples)
    settled(tally, tmp_path)
    assert tally.tried.total() > 100 * examples
