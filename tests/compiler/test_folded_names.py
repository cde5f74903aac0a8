"""Names of arrays in reports."""

import pytest

from jaxonomy_dae.run.system.sections import folded


@pytest.mark.parametrize(
    "names, shown",
    [
        ([f"cell[{k}].v" for k in range(50)], ["cell[0…49].v"]),
        (["a.x", "cell[0].x", "b.x", "cell[1].x"], ["a.x", "cell[0…1].x", "b.x"]),
        ([f"der(cell[{k}].v)" for k in range(3)] + ["cell[0].v"], ["der(cell[0…2].v)", "cell[0].v"]),
        ([f"wall[{i},{j}].T" for i in range(2) for j in range(3)], ["wall[0…1,0…2].T"]),
        ([f"room[{i}].wall[1].T[{j}]" for i in range(2) for j in range(2)], ["room[0…1].wall[1].T[0…1]"]),
        (["cell[0].v", "cell[2].v"], ["cell[0].v", "cell[2].v"]),  # not all between
        (["cell[3].v"], ["cell[3].v"]),
        ([], []),
    ],
)
def test_whole_ranges_of_indices_are_one_name(names, shown):
    assert folded(names) == shown
