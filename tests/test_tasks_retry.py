"""Memory of the attempts along a route: the automaton, and what tasks make of it."""

import dataclasses
import json
import types

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_tasks_snapshot import undeclared

from cathsim_dmc import policies, suite
from cathsim_dmc.anatomy import phantoms
from cathsim_dmc.anatomy.tree_file import read_tree
from cathsim_dmc.physics.readings import part
from cathsim_dmc.simulation.batch import BatchSimulation
from cathsim_dmc.tasks import progress, retry, take_offs
from cathsim_dmc.tasks.objectives import Cannulation
from cathsim_dmc.tasks.retry import COAXIAL, SINGLE, Memory
from cathsim_dmc.tasks.route import Place, Route, locate, locate_each, look_ahead

SHORT = retry.RetrySettings(patience=5)


def begun(arc_length, insertion, **values):
    place = Place(np.array(arc_length), np.full(len(arc_length), -0.5))
    values = {name: np.array(value) for name, value in values.items()}
    return Memory.at(place, np.array(insertion))._replace(**values)


def goes_on(memory, arc_length, insertion, *, excess=-0.5, settings=SINGLE, **more):
    shape = memory.attempts.shape
    place = Place(np.full(shape, arc_length), np.full(shape, excess))
    inserted, pushed = np.full(shape, insertion), np.full(shape, more.pop("push", 0.0))
    return retry.advance(settings, memory, place, inserted, pushed, **more)


@pytest.mark.parametrize(
    ("before", "step", "after"),
    [
        ({"lost": 3}, {"excess": 0.9 * SINGLE.tolerance}, {"lost": 0}),
        ({"lost": 3}, {"excess": 1.1 * SINGLE.tolerance}, {"lost": 4}),
        ({"stale": 3}, {"arc_length": 0.1 + 0.9 * SINGLE.progress}, {"stale": 4}),
        ({"stale": 3}, {"arc_length": 0.1 + 1.1 * SINGLE.progress}, {"stale": 0}),
        ({"pressed": 1}, {"push": 0.9 * SINGLE.hard_push}, {"pressed": 0}),
        ({"pressed": 1}, {"push": 1.1 * SINGLE.hard_push}, {"pressed": 2}),
        (  # A withdrawal counts its own steps alone.
            {"retracting": True, "stale": 3, "lost": 3, "pressed": 1},
            {"arc_length": 0.11, "excess": 1.0, "push": 1.0},
            {"stale": 4, "lost": 0, "pressed": 0},
        ),
        (
            {"stale": SINGLE.patience, "best": 0.12},
            {},
            {"attempts": 1, "retracting": True, "stale": 0, "best": 0.1},
        ),
        (
            {"retracting": True, "turn": 0.08, "held": 0.05, "stale": 9},
            {},
            {"retracting": False, "held": 0.08, "stale": 0},
        ),
        # The barrier stays at the first hard push of several at one place.
        ({"pressed": 2, "barrier": 0.097}, {"push": 1.0}, {"barrier": 0.097}),
        ({"pressed": 2, "barrier": 0.093}, {"push": 1.0}, {"barrier": 0.1}),
        ({}, {"narrow": True}, {"given_up": True}),
        ({}, {"narrow": True, "excess": 1.0}, {"given_up": False}),
    ],
)
def test_what_a_control_step_changes(before, step, after):
    memory = begun([0.1], [0.08], **{name: [value] for name, value in before.items()})
    memory = goes_on(memory, **{"arc_length": 0.1, "insertion": 0.08, **step})
    found = {name: getattr(memory, name).item() for name in after}
    assert found == pytest.approx(after, abs=1e-12)


def test_a_head_that_stands_still_is_withdrawn_and_tried_again():
    memory, insertion, retracted = begun([0.1, 0.1], [0.08] * 2), np.full(2, 0.08), []
    for step in range(24):
        # The first gains a millimetre a step, the second nothing.
        place = Place(np.array([0.1 + 1e-3 * step, 0.1]), np.full(2, -0.5))
        memory = retry.advance(SHORT, memory, place, insertion, np.zeros(2))
        retracted.append(memory.retracting.copy())
        insertion = insertion - 1e-3 * memory.retracting
    retracted = np.array(retracted)
    assert not retracted[:, 0].any()
    assert memory.attempts.tolist() == [0, 1]
    begins, ends = np.flatnonzero(np.diff(retracted[:, 1].astype(int)))
    assert begins == SHORT.patience - 1
    assert (ends - begins) * 1e-3 == pytest.approx(SHORT.backoff, abs=1.1e-3)


def test_a_withdrawal_that_is_held_up_ends_inside_the_tube_alone():
    memory = begun([0.1], [0.08], retracting=[True], turn=[0.0], stale=[0])
    for _ in range(SINGLE.longest + 5):
        memory = goes_on(memory, 0.1, 0.08, excess=1.0)
    assert memory.retracting[0]
    assert not goes_on(memory, 0.1, 0.08).retracting[0]


@pytest.mark.parametrize("settings", [SINGLE, COAXIAL])
def test_a_hard_push_ends_an_attempt_and_several_at_one_place_all(settings):
    memory, retries = begun([0.1], [0.08]), []
    for _ in range(12 * settings.most_pushed):
        back = bool(memory.retracting[0])
        insertion = memory.turn[0] - 1e-6 if back else 0.08
        push = 0.0 if back else 2 * settings.hard_push
        memory = goes_on(
            memory, 0.09 if back else 0.1, insertion, push=push, settings=settings
        )
        retries.append(int(memory.attempts[0]))
        if memory.given_up[0]:
            break
    assert retries[settings.push_patience - 1 : settings.push_patience + 1] == [0, 1]
    assert memory.given_up[0] and memory.pushed[0] == settings.most_pushed
    last = memory.attempts[0]
    for _ in range(2 * settings.patience):
        memory = goes_on(memory, 0.1, 0.08, settings=settings)
    assert memory.attempts[0] == last and memory.given_up[0]
    # One that has come farther is not at that place any more.
    memory = begun([0.1], [0.08], pushed=[settings.most_pushed - 1], barrier=[0.05])
    memory = goes_on(memory, 0.1, 0.08, push=1.0, settings=settings)
    assert memory.pushed[0] == 0


def test_past_take_offs_that_lie_apart_a_harder_push_ends_an_attempt():
    memory = begun([0.1, 0.1], [0.08] * 2, last=[0.09, 0.11])
    for push, ended in (
        (0.9 * COAXIAL.hard_push, [0, 0]),
        (1.1 * COAXIAL.hard_push, [0, 1]),
        (1.1 * COAXIAL.deep_push, [1, 1]),
    ):
        after = memory
        for _ in range(COAXIAL.push_patience + 1):
            after = goes_on(after, 0.1, 0.08, push=push, settings=COAXIAL)
        assert after.attempts.tolist() == ended
    assert SINGLE.deep_push == SINGLE.hard_push


def test_a_shaft_that_buckles_is_taken_back_until_the_head_comes_with_it():
    memory = begun([0.1], [0.05])
    memory = goes_on(memory, 0.1, 0.05 + COAXIAL.slack + 1e-4, settings=COAXIAL)
    assert memory.retracting[0] and memory.taking_up[0] and memory.attempts[0] == 1
    # The head springs forward: on; it comes back: the slack is gone.
    memory = goes_on(memory, 0.104, 0.055, settings=COAXIAL)
    assert memory.retracting[0]
    memory = goes_on(memory, 0.104 - 0.5 * COAXIAL.give, 0.054, settings=COAXIAL)
    assert memory.retracting[0]
    came_back = 0.104 - 2 * COAXIAL.give
    memory = goes_on(memory, came_back, 0.052, settings=COAXIAL)
    assert not memory.retracting[0]
    assert memory.best[0] == pytest.approx(came_back)


def test_later_attempts_give_a_shaft_more_slack():
    """12, 18, 24 and 30 mm, and again from the first."""
    slack = 1e-3 * np.array([12, 18, 24, 30, 12])
    for shift, buckles in ((-1e-4, False), (1e-4, True)):
        memory = begun([0.1] * 5, [0.05] * 5, attempts=np.arange(5))
        memory = goes_on(memory, 0.1, 0.05 + slack + shift, settings=COAXIAL)
        assert (memory.retracting == buckles).all()
    memory = begun([0.1], [0.05], attempts=[3], ostium=[0.09])
    memory = goes_on(memory, 0.1, 0.05 + COAXIAL.slack + 1e-4, settings=COAXIAL)
    assert memory.retracting[0]  # beside a close take-off


def test_each_retry_withdraws_farther_up_to_the_fourth():
    """15, 22.5, 30 and 37.5 mm, and again from the first."""
    memory = begun([0.1] * 5, [0.08] * 5, attempts=np.arange(5))
    memory = memory._replace(stale=np.full(5, SINGLE.patience))
    ways = 0.08 - goes_on(memory, 0.1, 0.08).turn
    np.testing.assert_allclose(ways, 1e-3 * np.array([15, 22.5, 30, 37.5, 15]))


def test_pushes_are_counted_anew_where_nothing_is_left_to_withdraw():
    memory, attempts = begun([0.1], [1e-3]), []
    for _ in range(6):
        memory = goes_on(memory, 0.1, 1e-3, push=1.0)
        attempts.append(int(memory.attempts[0]))
    assert attempts == [0, 0, 1, 1, 1, 2] and SINGLE.push_patience == 2


def test_a_head_that_has_strayed_is_withdrawn_all_the_way():
    memory = begun([0.1], [0.05], lost=[COAXIAL.lost_patience])
    memory = goes_on(memory, 0.1, 0.05, excess=1.0, settings=COAXIAL)
    assert memory.retracting[0] and not memory.taking_up[0]
    came_back = 0.1 - 2 * COAXIAL.give
    memory = goes_on(memory, came_back, 0.045, settings=COAXIAL)
    assert memory.retracting[0]  # not yet back by `backoff`
    memory = goes_on(memory, 0.08, 0.05 - COAXIAL.backoff, settings=COAXIAL)
    assert not memory.retracting[0]


def test_a_head_that_goes_on_is_left_alone():
    memory = begun([0.0], [0.0])
    for number in range(1, 200):
        memory = goes_on(memory, 1e-3 * number, 1e-3 * number, settings=COAXIAL)
    assert memory.attempts[0] == 0 and not memory.retracting[0]


def test_attempts_differ_in_what_policies_see():
    memory = begun([0.1] * 8, [0.08] * 8, attempts=np.arange(8))
    for settings, coaxial in ((SINGLE, False), (COAXIAL, True)):
        insertion = np.full(8, 0.08)
        seen = retry.shown(settings, memory, insertion, np.zeros(8), coaxial)
        size = retry.COAXIAL_RETRY_ENTRIES if coaxial else retry.RETRY_ENTRIES
        assert seen.shape == (8, size) and np.abs(seen).max() <= 2.5
        rows = np.delete(seen, 4, axis=1)  # without their number
        distinct = {tuple(row) for row in rows.round(6)}
        assert len(distinct) == (8 if coaxial else 6)
    first = memory._replace(first=np.full(8, len(COAXIAL.pattern.leads) - 1))
    assert retry.lead(COAXIAL, first)[0] == COAXIAL.pattern.leads[-1]
    assert retry.lead(COAXIAL, first)[1] == COAXIAL.pattern.leads[0]
    # A policy knows the look-ahead on every route by the number of the attempt.
    factors = COAXIAL.close.lookahead_factors
    assert len(factors) == len(COAXIAL.pattern.lookahead_factors)
    close = memory._replace(ostium=np.where(np.arange(8) < 4, 0.1, np.inf))
    route = Route(np.zeros((2, 3)), np.full(2, 8e-3), np.array([0.0, 1.0]))
    ways = retry.lookahead(COAXIAL, close, route, np.full(8, 0.1))
    assert ways[:3].tolist() == [12e-3 * factor for factor in factors]
    wide = dataclasses.replace(route, radii=np.full(2, 20e-3))
    ways = retry.lookahead(COAXIAL, close, wide, np.full(8, 0.1))
    assert ways[:3].tolist() == [20e-3 * factor for factor in factors]
    leads = COAXIAL.close.leads * 4 + COAXIAL.pattern.leads
    assert retry.lead(COAXIAL, close).tolist() == list(leads)
    # Beyond the ostium by more than `held` the wire advances alone.
    deep = begun([0.1, 0.1], [0.08] * 2, ostium=[0.08, 0.09])
    assert retry.lead(COAXIAL, deep) == pytest.approx([0.04, COAXIAL.close.leads[0]])
    # It depends on the lumen at the shortest look-ahead, not at the head.
    narrows = Route(
        np.zeros((4, 3)),
        1e-3 * np.array([10, 10, 6, 6]),
        np.array([0, 0.105, 0.106, 1]),
    )
    first = begun([0.1], [0.08])
    way = retry.lookahead(SINGLE, first, narrows, first.arc_length)
    assert way == pytest.approx(1.5 * 6e-3)


def test_a_policy_sees_the_memory_in_its_scales():
    """10 mm are left to withdraw of the first; the wire of the second leads by 80."""
    memory = begun(
        [0.1, 0.1], [0.08] * 2, retracting=[True, False], turn=[0.07] * 2,
        stale=[30, 0], lost=[0, 30], attempts=[3, 2], taking_up=[True, False],
        ostium=[np.inf, 0.04], given_up=[False, True],
    )  # fmt: skip
    insertion, push = np.full(2, 0.08), np.array([0.3, -0.2])
    seen = retry.shown(COAXIAL, memory, insertion, push, True)
    turned = COAXIAL.pattern.leads[3] / 20e-3, np.cos(0.7), np.sin(0.7)
    expected = [
        [1, 0.5, 0.5, 0, 0.75, 1, 0, 0, 1, 0.3, 0, 1, *turned],
        [0, 0, 0, 2, 0.5, 0, 0, 1, 0, -0.2, 1, 0, 2, 1, 0],
    ]
    np.testing.assert_allclose(seen, expected, atol=1e-12)
    single = retry.shown(SINGLE, memory, insertion, push, False)
    assert single[0, 2:4] == pytest.approx([0.75, 0.0]) and single[1, 3] == 2.0
    np.testing.assert_array_equal(memory.steady, [0.1, np.nan])


def test_past_a_close_take_off_a_withdrawal_ends_in_the_middle_of_the_branch():
    def ends(arc_length, insertion, excess, **values):
        memory = begun(
            [0.24], [0.15], turn=[0.13], ostium=[0.22], retracting=[True], **values
        )
        memory = goes_on(memory, arc_length, insertion, excess=excess, settings=COAXIAL)
        return not memory.retracting[0]

    # A head that has strayed falls into the branch, or comes back before it.
    middle = COAXIAL.middle - 0.05
    assert ends(0.23, 0.14, middle) and not ends(0.23, 0.14, middle + 0.1)
    assert not ends(0.23, 0.12, 0.0) and ends(0.22, 0.12, 0.0)
    assert not ends(0.22, 0.14, middle) and not ends(0.222, 0.14, middle)
    # One that buckles takes the slack back.
    assert not ends(0.24, 0.14, middle, taking_up=[True], attempts=[1])
    assert ends(0.24, 0.12, middle, taking_up=[True], attempts=[1])
    stays = begun([0.24], [0.15], ostium=[0.22], stale=[COAXIAL.patience])
    stays = goes_on(stays, 0.24, 0.15, excess=middle, settings=COAXIAL)
    assert stays.retracting[0] and stays.attempts[0] == 1


def test_a_head_stays_where_it_was_on_the_route_as_long_as_a_tube_reaches_it():
    """A route that turns back from a narrow vessel into a wide one beside it."""
    x, y = np.arange(51) * 1e-3, np.arange(1, 15) * 1e-3
    there = np.stack([x, 0 * x], axis=1)
    across = np.stack([0 * y + x[-1], y], axis=1)
    back = np.stack([x[::-1], 0 * x + 15e-3], axis=1)
    flat = np.concatenate([there, across, back])
    points = np.column_stack([flat, np.zeros(len(flat))])
    radii = np.repeat([5e-3, 12e-3], [len(there) + len(across), len(back)])
    route = Route(points, radii, np.arange(len(points)) * 1e-3)
    for side, expected in ((4e-3, 20e-3), (6e-3, 95e-3)):
        head = np.array([[20e-3, side, 0.0]])
        place = locate(route, head, np.array([20e-3]))
        assert place.arc_length == pytest.approx(expected)
    assert place.excess == pytest.approx((15 - 6 - 12) / 12)
    assert locate(route, head, np.array([np.nan])).arc_length == place.arc_length
    # Elsewhere its nearest axis counts: not the widest room, nor what lies behind.
    head = np.array([[20e-3, 4.5e-3, 0.0]])
    for last, expected in ((np.nan, 20e-3), (112e-3, 20e-3), (95e-3, 95e-3)):
        place = locate(route, head, np.array([last]))
        assert place.arc_length == pytest.approx(expected)
        wanted = -0.1 if expected < 0.05 else (10.5 - 12) / 12
        assert place.excess == pytest.approx(wanted)


def test_what_lies_ahead_is_seen_in_the_frame_of_each_tip():
    """Routes along z and x, one of which ends ahead and goes straight on."""
    s = 1e-3 * np.arange(101)
    ways = np.eye(3)[[2, 0]]
    routes = [Route(s[:, None] * way, 3e-3 + 0.01 * s, s) for way in ways]
    chosen, along = np.array([1, 0, 1]), np.array([90e-3, 20e-3, 40e-3])
    head = along[:, None] * ways[chosen] + 1e-3 * np.array([0.0, 2.0, 0.0])
    frame = Rotation.random(3, random_state=0).as_matrix()
    place = locate_each(routes, chosen, head)
    np.testing.assert_allclose(place.arc_length, along)
    np.testing.assert_allclose(place.excess, 2e-3 / (3e-3 + 0.01 * along) - 1)
    ahead = look_ahead(routes, chosen, place, head, frame)
    there = along[:, None] + 5e-3 * np.arange(8)
    offset = there[..., None] * ways[chosen][:, None] - head[:, None]
    np.testing.assert_allclose(ahead.points, offset @ frame, atol=1e-12)
    np.testing.assert_allclose(ahead.radii, 3e-3 + 0.01 * np.minimum(there, 0.1))
    np.testing.assert_array_equal(ahead.excess, place.excess)


# In tasks.


def pushed(name, observation, steps=90, **options):
    """Simulations that a straight push leads astray."""
    task = suite.make_task(name, observation=observation, **options)
    simulation = BatchSimulation(task, 2, seeds=3, num_threads=1)
    action, steps_seen = np.zeros((2, task.num_actions)), [simulation.reset()]
    action[:, list(task.scene.catheter.translations)] = 1.0
    for _ in range(steps):
        steps_seen.append(simulation.step(action))
    return simulation, steps_seen


def test_a_memory_changes_nothing_that_others_see():
    """Neither one that a policy asks for, nor one that is observed."""
    _, alone = pushed("type1_lcca", "route")
    task = suite.make_task("type1_lcca", observation="route")
    asked = BatchSimulation(task, 2, seeds=3, num_threads=1)
    asked.reset()
    assert asked.rollout.memory.attempts.tolist() == [0, 0]
    observed, beside = pushed("type1_lcca", ["route", "route_retry"])
    action = np.zeros((2, task.num_actions))
    action[:, -1] = 1.0
    for before, after in zip(alone[1:], beside[1:], strict=True):
        step = asked.step(action)
        for key, value in before.observation.items():
            np.testing.assert_array_equal(step.observation[key], value, key)
            if not (observed.rollout.memory.attempts % 2).any():
                np.testing.assert_array_equal(after.observation[key], value, key)
    assert (asked.rollout.memory.attempts > 0).all()
    pairs = zip(asked.rollout.memory, observed.rollout.memory, strict=True)
    for one, other in pairs:
        np.testing.assert_array_equal(one, other)
    retracting = beside[-1].observation["route_retry"][:, 0]
    np.testing.assert_array_equal(retracting, observed.rollout.memory.retracting)


def test_the_memory_is_declared_and_goes_on_from_a_snapshot():
    simulation, _ = pushed("type1_lcca", ["route", "route_retry"], 60)
    assert (simulation.rollout.memory.attempts > 0).any()
    kept, action = simulation.snapshot(), np.ones((2, 21))
    expected = [simulation.step(action).observation["route_retry"] for _ in range(5)]
    other, _ = pushed("type1_lcca", ["route", "route_retry"], 3)
    other.restore(kept)
    for one in expected:
        np.testing.assert_array_equal(
            other.step(action).observation["route_retry"], one
        )
    assert undeclared(other) == set()


def test_only_one_memory_is_observed():
    options = {"fluoroscopy": {"view": [60, 0], "biplane": [-30, 0]}}
    both = ["route_retry", "biplane_retry"]
    with pytest.raises(ValueError, match="route_retry and biplane_retry.*leave one"):
        BatchSimulation(suite.make_task("type1_bca", observation=both, **options), 1)
    for others in ([], ["biplane_retry"]):
        pair = suite.make_task(
            "type1_bca_pair", observation=["route_turns", *others], **options
        )
        with pytest.raises(ValueError, match="add route_retry, and leave biplane"):
            BatchSimulation(pair, 1)


@pytest.fixture(scope="module")
def narrow(tmp_path_factory):
    """The Type-I phantom with a left common carotid that no 5F device enters."""
    content = json.loads((phantoms._DATA / "type1.json").read_text())
    radii = content["vessels"]["lcca"]["radii_mm"]
    radii[2:] = [0.8] * len(radii[2:])
    path = tmp_path_factory.mktemp("narrow") / "narrow.json"
    path.write_text(json.dumps(content))
    return read_tree(path).build("ascending")


def test_a_lumen_that_is_too_narrow_is_seen_a_centimetre_ahead(monkeypatch):
    monkeypatch.setattr(progress, "_ROOM", 9.0)
    task = suite.make_task("simple1_bca", observation=["route", "route_retry"])
    simulation = BatchSimulation(task, 1, seeds=0, num_threads=1)
    simulation.reset()
    rollout, route = simulation.rollout, Route.of(task.objective)
    least = 9.0 * task.scene.catheter.device.outer_radius
    tight = route.arc_length[route.radii < least][0]
    assert 0.03 < tight < route.arc_length[-1]
    one, first = np.arange(1), np.zeros(1, int)
    for before in (11.5e-3, 8.5e-3):
        place = np.atleast_1d(tight - before)
        there = rollout.resting._replace(head=route.at(place))
        rollout.progress.see(one, False, first, there, {})
        assert rollout.memory.arc_length == pytest.approx(place, abs=1e-3)
        assert rollout.memory.given_up.tolist() == [before < 10e-3]


@pytest.mark.slow
def test_an_episode_ends_gently_before_a_lumen_that_is_too_narrow(narrow):
    options = {"anatomy": narrow, "goal": "lcca", "random": 3, "give_up": True}
    environment = suite.load("cathsim", "navigate", {**options, "max_steps": 300})
    act = policies.in_environment(policies.make_policy("expert"), environment)
    timestep, largest = environment.reset(), 0.0
    while not timestep.last():
        timestep = environment.step(act(timestep))
        largest = max(largest, float(environment.task.wall_force.peak_sum))
    assert environment.task.termination == "given_up"
    assert timestep.discount == 0.0 and largest < 0.5


def test_the_expert_alone_needs_no_memory_in_the_task():
    """It begins one when it is asked, in the midst of an episode, too."""
    simulation, _ = pushed("type1_lcca", "tracking", 30)
    assert simulation.rollout.progress.memory is None
    view, expert = policies.View(simulation), policies.make_policy("expert")
    expert.reset(view, np.ones(2, bool))
    memory = simulation.rollout.memory
    assert (memory.best == memory.arc_length).all()
    for index in range(2):
        assert not part(memory, index).attempts
    assert not any(name.startswith("progress") for name in simulation.snapshot().arrays)


@pytest.mark.parametrize(
    ("places", "followed", "last"),
    [
        ([0.1], (0.1, False), np.inf),
        ([0.1, 0.125, 0.15, 0.19], (0.15, True), np.inf),
        ([0.1, 0.14, 0.16], (0.1, False), 0.16),
    ],
)
def test_take_offs_close_to_the_one_before_follow_the_first(
    monkeypatch, places, followed, last
):
    monkeypatch.setattr(take_offs, "take_offs", lambda route: places)
    assert take_offs.followed(None) == followed
    assert take_offs.last_apart(None) == last


@pytest.mark.parametrize(
    ("first", "steps", "expected"),
    [
        (7.0, [(60, 5.0, 1.0), (120, 3.4, 1.0)], [59, 119]),
        (8.0, [(60, 5.5, 0.3), (120, 3.9, 1.0)], [119]),  # straight on
        (8.0, [(60, 4.2, 1.0), (120, 2.5, 1.0)], [59]),  # narrow
        (8.0, [(60, 5.6, 1.0), (72, 3.9, 1.0)], [59]),  # within 15 mm
        (8.0, [(60, 7.0, 1.0), (120, 4.9, 0.2)], [119]),  # none, where it narrows
    ],
)
def test_a_take_off_is_where_a_wide_lumen_narrows_at_a_bend(first, steps, expected):
    found = take_offs.take_offs(stepped(first, steps))
    assert found == pytest.approx(1e-3 * np.array(expected))


def stepped(first, steps):
    """A route that goes on at places (mm) with other radii (mm), turned (rad)."""
    s, angle = np.arange(201), np.zeros(201)
    radii = np.full(201, first)
    for place, radius, turn in steps:
        radii[s >= place], angle[s >= place] = radius, angle[-1] + turn
    ways = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=1)
    return Route(1e-3 * np.cumsum(ways, axis=0), 1e-3 * radii, 1e-3 * s)


def test_each_simulation_remembers_on_the_route_of_its_anatomy(monkeypatch):
    """Take-offs of the first route are close; those of the second apart, and blunt."""
    monkeypatch.setattr(progress.Route, "of", lambda objective: objective)
    routes = (
        stepped(7.0, [(40, 7.0, 0.5), (60, 5.0, 1.0), (80, 3.4, 1.0)]),
        stepped(7.0, [(60, 5.0, 1.0), (120, 3.4, 1.0)]),
    )
    for route, end in zip(routes, (0.7e-3, 0.5e-3), strict=True):
        route.radii[150:] = np.linspace(3.4e-3, end, 51)
    devices = [types.SimpleNamespace(outer_radius=r) for r in (0.4e-3, 0.6e-3)]
    chain = types.SimpleNamespace(coaxial=True, devices=devices)
    scene = types.SimpleNamespace(catheter=chain)
    cases = [types.SimpleNamespace(scene=scene, objective=route) for route in routes]
    made = progress.Progress(["route_retry"], cases, 3, False)
    chosen, every = np.array([0, 1, 0]), np.arange(3)

    def seen(place, rows=every, begins=False):
        head = np.array([routes[number].points[place] for number in chosen])
        state = types.SimpleNamespace(
            head=head, insertion=np.full(3, 0.1), push_force=np.zeros(3)
        )
        made.see(rows, begins, chosen, state, {})
        made.restart(rows, chosen, state)  # leaves a memory of the state alone
        return made.memory

    begun = seen(20, begins=True)
    assert begun.ostium.tolist() == pytest.approx([0.079, np.inf, 0.079])
    assert begun.last.tolist() == pytest.approx([np.inf, 0.119, np.inf])
    assert begun.first.tolist() == [0, len(COAXIAL.pattern.leads) - 1, 0]
    # Only the second route becomes narrower than the leading device.
    made.memory = begun._replace(attempts=np.ones(3, int))
    assert seen(194).given_up.tolist() == [False, True, False]
    assert made.memory.attempts.tolist() == [1, 1, 1]
    np.testing.assert_array_equal(made.steady(every[1:2], True), [0.194, np.nan, 0.194])
    chosen[1] = 0
    again = seen(30, every[1:2], begins=True)
    assert again.arc_length.tolist() == [0.194, 0.03, 0.194]
    assert again.attempts.tolist() == [1, 0, 1] and again.ostium[1] == begun.ostium[0]
    of_images = progress.Progress(["biplane_retry"], cases, 3, False)
    images = {"biplane_place": np.full((3, 1), 0.1)}
    images["biplane_deviation"] = np.full((3, 1), -0.4)
    state = types.SimpleNamespace(insertion=np.zeros(3))
    of_images.see(every, True, chosen, state, images)
    assert (of_images.memory.arc_length == 0.1).all()
    assert (of_images.memory.excess == -0.4).all()
    assert progress.Progress([], cases, 3, True).state == ("memory",)


@pytest.mark.parametrize(
    ("name", "access", "goal", "expected"),
    [
        ("type2", "descending", "bca", True),  # out of the plane of the arch
        ("type3", "descending", "lcca", False),
        ("type3", "ascending", "lsa", True),  # nearly straight on
        ("type1", "ascending", "lcca", False),
    ],
)
def test_the_lead_follows_the_take_off(name, access, goal, expected):
    """A fixed lead of the wire reaches these branches where it is not blunt."""
    anatomy = phantoms.load(name, access=access)
    route = Route.of(Cannulation.to(anatomy, anatomy.goal(goal)))
    assert retry.blunt(COAXIAL, route) is expected
    assert not retry.blunt(SINGLE, route)
