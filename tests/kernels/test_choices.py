"""Choices whose conditions hold other choices: SymPy multiplies these out when it makes one of them."""

import sympy

from jaxonomy_dae.write.choices import by_conditions, exchanged

DEPTH = 6  # multiplied out, some thousand branches


def test_parts_are_exchanged_where_branches_stand_in_conditions():
    """Each step adds 1 or 2 to x, as what came before is below k or not."""
    x, y = sympy.symbols("x y")
    chain = x
    for k in range(DEPTH):
        chain = by_conditions((chain + 1, sympy.Lt(chain, k, evaluate=False)), (chain + 2, sympy.true))
    found = exchanged(chain, {x: y + 0.5})
    assert found.free_symbols == {y}

    def by_hand(value):
        for k in range(DEPTH):
            value += 1 if value < k else 2
        return value

    for start in (-30.25, -3.75, 0.0, 7.5):
        assert _value(found, {y: start}, {}) == by_hand(start + 0.5)


def test_what_is_not_there_changes_nothing():
    x, y, z = sympy.symbols("x y z")
    choice = by_conditions((x, sympy.Gt(y, 0, evaluate=False)), (2 * x, sympy.true))
    assert exchanged(choice, {z: y}) is choice
    assert by_conditions((x, sympy.false), (y, sympy.true), (z, sympy.true)) is y


def _value(e, at, known):
    """The number of an expression, or the truth of a condition, part by part."""
    if e not in known:
        if e in at:
            known[e] = at[e]
        elif isinstance(e, sympy.Piecewise):
            known[e] = next(_value(p.args[0], at, known) for p in e.args if _value(p.args[1], at, known))
        elif e.is_Atom:
            known[e] = bool(e) if e in (sympy.true, sympy.false) else float(e)
        elif isinstance(e, sympy.Lt):
            known[e] = _value(e.args[0], at, known) < _value(e.args[1], at, known)
        else:
            assert isinstance(e, sympy.Add)
            known[e] = sum(_value(part, at, known) for part in e.args)
    return known[e]
