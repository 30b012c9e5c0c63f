"""The grid of trainings: what its file may say, and which cells it makes."""

import dataclasses

import pytest

from cathsim_dmc.agents import ConfigError
from cathsim_dmc.benchmarks import GridError, read_grid
from cathsim_dmc.benchmarks.grid import choose

ROW = """
[[row]]
label = "PPO"
algorithm = "ppo"
preset = "demo"
observation = "internal"
tasks = ["type1_bca", "type1_lcca"]
seeds = [0, 1]
total_frames = 1000
"""


@pytest.fixture
def grid(tmp_path):
    def write(text):
        path = tmp_path / "grid.toml"
        path.write_text(text)
        return read_grid(path)

    return write


def test_first_seed_of_every_task_comes_first(grid):
    assert [cell.name for cell in grid(ROW)] == [
        "type1_bca-ppo-internal-demo-seed0",
        "type1_lcca-ppo-internal-demo-seed0",
        "type1_bca-ppo-internal-demo-seed1",
        "type1_lcca-ppo-internal-demo-seed1",
    ]


def test_a_cell_makes_the_settings_of_its_training(grid):
    more = "settings = { num_envs = 8, task_kwargs = { friction = 0.1 } }\n"
    config = grid(ROW + more)[3].config()
    assert (config.algorithm, config.task, config.seed) == ("ppo", "type1_lcca", 1)
    assert (config.total_frames, config.num_envs) == (1000, 8)
    assert config.task_kwargs == {"friction": 0.1}
    assert config.clip == 0.2  # of the preset


def test_settings_may_name_the_run_of_the_same_task(grid):
    more = 'settings = { initial_policy = "runs/{task}-bc" }\n'
    policies = [cell.config().initial_policy for cell in grid(ROW + more)[:2]]
    assert policies == ["runs/type1_bca-bc", "runs/type1_lcca-bc"]


def test_frames_may_differ_between_tasks(grid):
    text = ROW.replace("= 1000", "= { type1_bca = 500, type1_lcca = 700 }")
    assert [cell.total_frames for cell in grid(text)[:2]] == [500, 700]


def test_observations_are_joined_in_the_name(grid):
    cell = grid(ROW.replace('"internal"', '["goal", "force"]'))[0]
    assert cell.name == "type1_bca-ppo-goal+force-demo-seed0"
    assert cell.config().observation == ("goal", "force")


def test_two_rows_of_one_name_need_a_variant(grid):
    with pytest.raises(GridError, match="type1_bca-ppo-internal-demo-seed0.*variant"):
        grid(ROW + ROW)
    assert len(grid(ROW + ROW + 'variant = "wide"\n')) == 8


@pytest.mark.parametrize(
    "change",
    [
        ("total_frames", 'variant = "/../../../../escaped"\ntotal_frames'),
        ('"type1_bca"', '"/tmp/escaped"'),
        ('"type1_bca"', '"../escaped"'),
        ('"type1_bca"', '".."'),
        ('"internal"', '["a/b"]'),
        ('"internal"', '"a\\u0000b"'),
        ('"ppo"', '"..\\\\ppo"'),
        ('"demo"', f'"{"x" * 200}"'),
    ],
)
def test_a_name_that_leaves_its_folder_is_refused(grid, tmp_path, change):
    with pytest.raises(GridError, match=r"row 1: a cell is named .*may have letters"):
        grid(ROW.replace(*change))
    # However the cell is made.
    with pytest.raises(GridError):
        dataclasses.replace(grid(ROW)[0], variant="/../../escaped")


@pytest.mark.parametrize(
    ("change", "word"),
    [
        (("seeds = [0, 1]", "seeds = []"), "seeds"),
        (("seeds = [0, 1]", "seeds = [true]"), "seeds"),
        (("seeds = [0, 1]", "seed = 1"), "seed"),
        (('label = "PPO"', "label = 1"), "label"),
        (('"internal"', "[1]"), "observation"),
        (('label = "PPO"', ""), "label"),
        (("= 1000", "= 0"), "total_frames"),
        (("= 1000", "= { type1_bca = 5 }"), "type1_lcca"),
        (("= 1000", "= 1\nevaluation = { episodes = 0 }"), "episodes"),
        (("= 1000", "= 1\nevaluation = { seed = 0 }"), "seed"),
        (("= 1000", '= 1\nsettings = { task = "x" }'), "settings has task"),
        (("[[row]]", "[row]"), "row"),
        (("[[row]]", "extra = 1\n[[row]]"), "extra"),
        (("[[row]]", "[[row"), "cannot be read"),
        (("[[row]]", "a = " + "[" * 9_999), "cannot be read"),
        (("[[row]]", "#" * 2**20), "cannot be read .*too long for a grid"),
    ],
)
def test_a_bad_grid_is_refused_with_its_place(grid, change, word):
    with pytest.raises(GridError, match=word) as error:
        grid(ROW.replace(*change))
    assert "grid.toml" in str(error.value)


def test_options_of_a_task_that_are_no_table_make_a_cell_impossible(grid):
    cell = grid(ROW.replace("= 1000", "= 1\nsettings = { task_kwargs = [1] }"))[0]
    with pytest.raises(ConfigError, match="task_kwargs=.1. is not allowed"):
        cell.config()


def test_cells_are_chosen_by_parts_of_names_and_patterns(grid):
    cells = grid(ROW)
    assert choose(cells, []) == cells
    assert choose(cells, ["lcca", "*seed1"]) == cells[1:]
    with pytest.raises(GridError, match="'type3'.*type1_bca-ppo"):
        choose(cells, ["type3"])


def test_the_grid_that_ships_has_the_order_of_the_time_budget():
    cells = read_grid()
    labels = list(dict.fromkeys(cell.label for cell in cells))
    assert labels[:3] == ["PPO-Internal", "SAC-Internal", "PPO-Image"]
    four = {"type1_bca", "type1_lcca", "type2_bca", "type2_lcca"}
    assert {cell.task for cell in cells[:4]} == four
    assert {cell.seed for cell in cells[:4]} == {0}
    for cell in cells:
        try:
            cell.config()
        except ConfigError as error:
            # A preset may be under way, but fields and tasks must fit.
            assert "preset" in str(error)
