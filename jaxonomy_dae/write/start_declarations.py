"""How a component prescribes what holds at the initial time beside the starts of its variables."""

from collections.abc import Callable

import sympy

from ..base.errors import ModelError
from .declarations import INITIALLY, START, Value, Variable
from .equations import residual_of
from .symbols import VariableSymbol


class StartDeclarations:
    """The part of `Component` that concerns starts of derivatives and initial equations."""

    # Attributes and methods of the other parts of `Component`.
    name: str
    variables: dict[str, Variable]
    equations: list[sympy.Expr]
    _check_open: Callable[[str], None]
    add_equations: Callable[..., None]
    _declare: Callable[..., VariableSymbol]

    def start(self, derivative: object, value: Value, fixed: bool = False) -> None:
        """Prescribes a derivative at the initial time: `self.start(der(x), 2.0)`.

        **Arguments:**

        - `derivative`: `der(x)`, `der(der(x))`, … of a variable of this component or of a child.
        - `value`: a number or an expression in parameters.
        - `fixed`: whether it must hold. If not, it is a guess for the search for a consistent initial point. A guess
            matters if the equations have several solutions for the derivative, or leave it free.

        **Raises:**

        - `ModelError` if the first argument is not the derivative of a variable, if this derivative already has a
            start, and for wrong values as in `variable`.
        """
        if not isinstance(derivative, VariableSymbol) or not derivative.order:
            mend = (
                "; for the variable itself, say start= where it is declared"
                if str(derivative) in self.variables
                else ""
            )
            found = f"got {derivative}{mend}"
            raise ModelError(f"component '{self.name}': start takes a derivative such as der(x); {found}")
        name = f"{derivative}{START}"
        if name in self.variables:
            raise ModelError(f"component '{self.name}': {derivative} has a start already")
        self._check_open(f"say the start of {derivative}")
        self.add_equations(sympy.Eq(self._declare(name, "start", value, fixed), derivative, evaluate=False))

    def initially(self, *equations: sympy.Basic) -> None:
        """Adds equations that hold at the initial time: `self.initially(Eq(der(T), 0))` starts at rest.

        Each equation replaces one fixed start. Starts that are not fixed give way.

        **Arguments:**

        - `equations`: SymPy `Eq`s, or expressions that are zero, in variables, their derivatives and parameters.

        **Raises:**

        - `ModelError` for what is not an equation.
        """
        self._check_open("add its initial equations")
        for equation in equations:
            try:
                residual = residual_of(equation)
            except (ModelError, TypeError) as error:
                raise ModelError(f"component '{self.name}': initially: {error}") from None
            number = sum(name.startswith(INITIALLY) for name in self.variables)
            symbol = self._declare(f"{INITIALLY}[{number}]", "event", 0.0, True)
            self.equations.append(symbol - residual)
