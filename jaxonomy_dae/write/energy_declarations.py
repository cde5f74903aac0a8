"""How a component declares the energy that it stores, and the power that it loses or brings in."""

from collections.abc import Callable

import sympy

from ..base.errors import ModelError
from .declarations import Account


class EnergyDeclarations:
    """The part of `Component` that concerns its accounts of energy."""

    # Attributes and methods of the other parts of `Component`.
    name: str
    accounts: list[Account]
    symbol: Callable[[str], sympy.Symbol]
    _check_open: Callable[[str], None]

    def declare_energy(self, *expressions: object) -> None:
        """Declares the energy that the component stores (joule): `self.declare_energy(m * v**2 / 2)`.

        `solution.energy()` reads the declarations of energy, dissipation and supply, and
        `jaxonomy_dae.testing.assert_energy_balance` compares them. They are not equations, and simulations do not
        compute them.

        **Arguments:**

        - `expressions`: expressions in variables, their derivatives and parameters of this component or of its
            children, or names of its variables. Several are added up.

        **Raises:**

        - `ModelError` for an argument that is not an expression or a name; for unknown symbols, at compilation.
        """
        self._declare_accounts("energy", expressions)

    def declare_dissipation(self, *expressions: object) -> None:
        """Declares the power that the component loses to outside the model (watt): `d * v**2`. Heat that leaves through
        a thermal port is not lost. Otherwise as `declare_energy`."""
        self._declare_accounts("dissipation", expressions)

    def declare_supply(self, *expressions: object) -> None:
        """Declares the power that the component brings into the model from outside (watt). It is negative if the
        component takes power out. Otherwise as `declare_energy`."""
        self._declare_accounts("supply", expressions)

    def _declare_accounts(self, kind: str, expressions: tuple[object, ...]):
        self._check_open(f"declare its {kind}")
        for given in expressions:
            # Not by `sympify`, which reads texts as SymPy's own names: "E" is 2.718 there.
            expression = self.symbol(given) if isinstance(given, str) else given
            if isinstance(given, int | float):
                expression = sympy.sympify(given)
            if not isinstance(expression, sympy.Expr):
                raise ModelError(
                    f"component '{self.name}': {kind} is an expression in variables and parameters, or the name of a "
                    f"variable; got {given!r}"
                )
            self.accounts.append(Account(kind, expression))
