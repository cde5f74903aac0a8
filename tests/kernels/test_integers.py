"""Sets of integers, beside NumPy's and Python's own."""

import numpy as np
import pytest

from jaxonomy_dae.compile.model.identity import Identity
from jaxonomy_dae.graph.structure.integers import distinct, equal_rows


@pytest.mark.parametrize("shape", [(0,), (1,), (40,), (7, 5)])
def test_distinct_integers_are_those_of_a_set(shape):
    numbers = np.random.default_rng(1).integers(-5, 20, shape)
    found = distinct(numbers)
    assert found.tolist() == sorted(set(numbers.ravel().tolist()))
    assert found.dtype == numbers.dtype


def test_equal_rows_are_found_in_the_order_of_their_first():
    rng = np.random.default_rng(2)
    columns = [rng.integers(0, 3, 60), rng.integers(-1, 2, 60), np.zeros(60, np.uint8)]
    by_row: dict[tuple, list[int]] = {}
    for k, row in enumerate(zip(*(column.tolist() for column in columns), strict=True)):
        by_row.setdefault(row, []).append(k)
    assert [members.tolist() for members in equal_rows(columns)] == list(by_row.values())
    assert equal_rows([np.zeros(0, np.int64)]) == []


def test_identity_does_not_ask_whether_equal_parts_are_one_object():
    """Parts that stand at many places are digested once, and the digest still follows their values and order."""
    one, same, other = np.arange(3), np.arange(3), np.arange(4)
    assert Identity.of([one, one, other]).digest == Identity.of([one, same, other]).digest
    digests = {
        Identity.of(parts).digest for parts in ([one, one, other], [one, other, one], [one, other], [other, one])
    }
    assert len(digests) == 4
