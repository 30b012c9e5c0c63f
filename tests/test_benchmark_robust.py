"""The cells of the varied protocol."""

import robust

from cathsim_dmc import suite


def test_cells_of_arches_play_every_held_out_arch():
    whole, single = [*robust.arches()], [*robust.variants()]
    assert [cell.episodes for cell in whole] == [98] * 6
    assert [cell.options["first"] for cell in single] == list(range(48))
    for cell in whole + single:
        assert set(cell.options) <= set(suite.task_options(cell.task))


def test_a_pair_is_driven_from_the_groin_in_every_part():
    parts = {
        "arches": [*robust.arches(pair=True)],
        "variants": [*robust.variants(pair=True)],
        "anatomies": [*robust.anatomies(robust.PHANTOMS, pair=True)],
        "changes": [*robust.changes(pair=True)],
    }
    counts = {part: len(cells) for part, cells in parts.items()}
    assert counts == {
        "arches": 3, "variants": 48, "anatomies": 12, "changes": 14
    }  # fmt: skip
    for cell in (cell for cells in parts.values() for cell in cells):
        assert cell.options["access"] == "descending"
        assert set(cell.options) <= set(suite.task_options(cell.task))
        assert robust._device(cell, {}).startswith("wire_035_glide in ")
    wanted = robust.anatomies(("type1",), True, ("lsa", "nowhere"))
    assert [cell.labels["goal"] for cell in wanted] == ["lsa"]


def test_a_branch_narrows_behind_its_ostium_to_the_radius_that_is_asked_for():
    cells = [*robust.narrow()]
    assert len(cells) == 12 and sum(cell.episodes for cell in cells) == 24
    for cell in cells[::5]:
        assert set(cell.options) <= set(suite.task_options(cell.task))
        anatomy, radius = cell.options["anatomy"], 1e-3 * float(cell.labels["radius"])
        route = anatomy.route("lcca")
        assert route.radii[-10:].max() < radius + 1e-6
        assert route.radii.min() > radius - 1e-6


def test_an_episode_is_counted_for_the_kind_of_its_arch():
    kinds = [robust._kind(cell, {}) for cell in robust.variants()]
    assert kinds[:4] == [
        "III normal", "II bovine_trunk", "II bovine_branch", "II aberrant"
    ]  # fmt: skip
    pool = next(robust.arches())
    assert [robust._kind(pool, {"arch": n}) for n in (0, 1)] == [
        "I normal",
        "II normal",
    ]
    assert robust._kind(next(robust.changes()), {}) is None
