"""Which starts determine a model must not hang on how many quantities it has."""

import numpy as np
import pytest
from problems import compiled
from sympy import Eq

from jaxonomy_dae import Component, EqnEnv, der
from jaxonomy_dae.run.start.rows import initial_rows, supports


class Sums(Component):
    """x' = y − x, y' = x − 2·y, u = x + y and w = 3·(x + y) + 2, beside a chain of n lags with a nonlinear end each."""

    def __init__(self, ev, name, n):
        super().__init__(ev, name)
        x, y, u, w = self.variable("x"), self.variable("y"), None, None
        u, w = self.variable("u", start=1.0, fixed=True), self.variable("w", start=5.0, fixed=True)
        z = [self.variable(f"z{k}", start=0.5, fixed=True) for k in range(n)]
        p = [self.variable(f"p{k}", start=0.5) for k in range(n)]
        self.add_equations(
            Eq(der(x), y - x), Eq(der(y), x - 2 * y), Eq(u, x + y), Eq(w, 3 * (x + y) + 2),
            *(Eq(der(a), (b if k else u) - a) for k, (a, b) in enumerate(zip(z, [x, *z], strict=False))),
            *(Eq(q + q**3, a) for a, q in zip(z, p, strict=True)),
        )  # fmt: skip


@pytest.mark.parametrize("n", [10, 400])
def test_starts_that_numbers_make_dependent(n):
    """w follows from u, with which it can be matched all the same. Of more than 600 quantities rows were only matched:
    both starts were kept as independent, and none was left for x or y."""
    plan = compiled(Sums(EqnEnv(), "c", n)).plan
    rows = initial_rows(plan, ())
    assert [rows.kept[k].name for k in rows.redundant] == ["c.w"]
    (support,) = supports(plan, ()).values()
    assert [row.name for row in support] == ["c.u"]
    assert not rows.settled and rows.n_soft >= 1
    assert np.count_nonzero(rows.independent) == n + 2  # z, u, and one of x and y
