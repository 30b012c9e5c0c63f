"""The cells of the varied protocol."""

import robust

from cathsim_dmc import suite


def test_cells_of_arches_play_every_held_out_arch():
    cells = [*robust.arches(), *robust.variants()]
    assert [cell.episodes for cell in cells] == [98] * 6 + [96]
    for cell in cells:
        assert set(cell.options) <= set(suite.task_options(cell.task))


def test_an_episode_is_counted_for_the_kind_of_its_arch():
    variants = next(robust.variants())
    kinds = {robust._kind(variants, {"arch": number}) for number in range(4)}
    assert kinds == {
        "III normal", "II bovine_trunk", "II bovine_branch", "II aberrant"
    }  # fmt: skip
    assert robust._kind(variants, {}) is None
