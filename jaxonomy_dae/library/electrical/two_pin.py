"""What components with two pins share.

Conventions: potential `v` in volt, current `i` in ampere counted positive into a pin. A two-pin component has
`v = p.v − n.v`, and `i` flows from `p` to `n`.
"""

import sympy

from ...write import Component, Electrical, Eq


class TwoPin(Component):
    """Two pins and one current: v = p.v − n.v, i = p.i = −n.i."""

    def _two_pins(self, v: dict | None = None, i: dict | None = None) -> tuple[sympy.Symbol, sympy.Symbol]:
        p, n = self.port("p", Electrical), self.port("n", Electrical)
        voltage = self.variable("v", **(v or {"unit": "V"}))
        current = self.variable("i", **(i or {"unit": "A"}))
        self.add_equations(Eq(voltage, p.v - n.v), Eq(current, p.i), Eq(p.i + n.i, 0))
        return voltage, current


class TwoPorts(Component):
    """Two pairs of pins, 1 and 2: v1 = p1.v − n1.v, i1 = p1.i = −n1.i, and the same with 2."""

    def _two_ports(self, **declared: dict) -> tuple[sympy.Symbol, sympy.Symbol, sympy.Symbol, sympy.Symbol]:
        """v1, i1, v2, i2; `declared` are options of these variables."""
        symbols = []
        for k in (1, 2):
            p, n = self.port(f"p{k}", Electrical), self.port(f"n{k}", Electrical)
            v = self.variable(f"v{k}", **declared.get(f"v{k}", {"unit": "V"}))
            i = self.variable(f"i{k}", **declared.get(f"i{k}", {"unit": "A"}))
            self.add_equations(Eq(v, p.v - n.v), Eq(i, p.i), Eq(p.i + n.i, 0))
            symbols += [v, i]
        v1, i1, v2, i2 = symbols
        return v1, i1, v2, i2
