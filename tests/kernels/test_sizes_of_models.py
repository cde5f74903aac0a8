"""What initialization decides must not hang on how many quantities a model has."""

import numpy as np
import pytest
from problems import compiled
from sympy import Eq

from jaxonomy_dae import Component, EqnEnv, der
from jaxonomy_dae.compile.model import consistent_point
from jaxonomy_dae.compile.model.consistent_point import initial_point
from jaxonomy_dae.compile.model.tables import Declared
from jaxonomy_dae.run.start import rows, sparse_newton


class TwoGuesses(Component):
    """x + y = 3 with guesses of one for both, beside a chain of n lags."""

    def __init__(self, ev, name, n):
        super().__init__(ev, name)
        x, y, f = self.variable("x", start=1.0), self.variable("y", start=1.0), self.variable("f")
        z = [self.variable(f"z{k}", start=0.5, fixed=True) for k in range(n)]
        chain = (Eq(der(a), b - a) for a, b in zip(z, [x, *z], strict=False))
        self.add_equations(Eq(der(x), f - x), Eq(der(y), f - 2 * y), Eq(x + y, 3.0), *chain)


def test_guesses_share_whatever_the_size(monkeypatch):
    """Guesses that cannot all hold share what is open: the nearest point is x = y = 1.5. Of more than 600 quantities
    the first guess held, and y was 2, without a word."""
    monkeypatch.setattr(rows, "DECOMPOSED_UPTO", 0)
    chosen = rows.initial_rows(compiled(TwoGuesses(EqnEnv(), "c", 3)).plan, ())
    assert [row.name for row in chosen.kept[-2:]] == ["c.x", "c.y"]
    assert chosen.n_soft == 2 and chosen.independent[-2:] == (True, False)


def test_guesses_of_models_too_large_to_share(monkeypatch):
    """Where the nearest point would take too long, the report says which guess gave way."""
    monkeypatch.setattr(rows, "DECOMPOSED_UPTO", 0)
    monkeypatch.setattr(rows, "DENSE_UPTO", 0)
    (note,) = compiled(TwoGuesses(EqnEnv(), "c", 4)).initialization_report().notes
    assert "'c.y' gave way to those before" in note


class Nearly(Component):
    """a + b = c and a + (1 + e)·b = d, where c and d are given, beside n lags."""

    def __init__(self, ev, name, n, e):
        super().__init__(ev, name)
        f, g, e = self.variable("f"), self.variable("g"), self.parameter("e", e)
        starts = {"a": 1.0, "b": 1.0, "c": 2.0, "d": 2 + e}
        a, b, c, d = (self.variable(name, start=start, fixed=name in "cd") for name, start in starts.items())
        z = [self.variable(f"z{k}", start=0.5, fixed=True) for k in range(n)]
        self.add_equations(
            Eq(der(a), f - a), Eq(der(b), g - b), Eq(der(c), -c), Eq(der(d), -d), Eq(a + b, c), Eq(a + (1 + e) * b, d),
            *(Eq(der(x), y - x) for x, y in zip(z, [a, *z], strict=False)),
        )  # fmt: skip


@pytest.mark.long("compiles the sparse search of starts, with the dense one behind it")
@pytest.mark.parametrize("n, is_sparse", [(2, False), (3, True)])
def test_starts_that_hardly_determine_the_point(monkeypatch, n, is_sparse):
    """From 128 unknowns on, whose rows are sparse, nothing was said of the condition of the initial equations."""
    if is_sparse:
        monkeypatch.setattr(sparse_newton, "SPARSE_FROM", 0)
        monkeypatch.setattr(sparse_newton, "SPARSE_DENSITY", 1.0)
    system = compiled(Nearly(EqnEnv(), "c", n, 0.5), state_selection="projection")
    for e, is_poor in ((1e-12, True), (0.5, False)):
        report = system.with_parameters({"c.e": e}).initialization_report()
        assert report.consistent and (np.ndim(report._found.jacobian) == 1) == is_sparse
        assert any("the initial equations are ill-conditioned" in note for note in report.notes) == is_poor


@pytest.mark.parametrize("e", [0.5, 1e-4])
def test_points_of_the_compiler(monkeypatch, e):
    """Least squares by singular values and by a sparse factorization find the same consistent point."""
    plan = compiled(Nearly(EqnEnv(), "c", 3, e), state_selection="projection").plan
    declared, found = Declared(plan.flat.parameters.everything(np.array([e])), {}), []
    for few in (0, 10**6):
        monkeypatch.setattr(consistent_point, "DECOMPOSED_UPTO", few)
        found.append(initial_point(plan.model, declared).values)
    np.testing.assert_allclose(found[0], found[1], rtol=1e-9, atol=1e-9)
