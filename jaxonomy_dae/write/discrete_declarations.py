"""How a component declares equations of discrete variables, which are solved at events."""

from collections.abc import Iterator

import sympy
from sympy.logic.boolalg import Boolean

from ..base.aliases import Expression
from ..base.errors import ModelError
from .automatic_events import ROUNDING
from .choices import exchanged
from .declarations import Parameter
from .discrete_equations import DiscreteEquations
from .events import Assign
from .interval import Interval
from .relation_declarations import RelationDeclarations
from .symbols import DiscreteSymbol, EarlierSymbol, PreviousSymbol, TimeSymbol, VariableSymbol
from .truths import as_number

_JUMPING = (sympy.Piecewise, sympy.core.relational.Relational, sympy.sign, sympy.Heaviside, *ROUNDING)


class DiscreteDeclarations(RelationDeclarations):
    """The part of `Component` that concerns discrete equations."""

    parameters: dict[str, Parameter]
    discrete_equations: dict[DiscreteSymbol, Expression]
    _solved: DiscreteEquations | None

    def discrete_equation(self, variable: sympy.Symbol, value: object) -> None:
        """Says what a discrete variable is, in terms of others and of what they were before: an equation that is solved
        at each instant at which something jumps.

        ```python
        on = self.discrete("on")
        self.discrete_equation(on, Or(T < low, And(Eq(pre(on), 1), T < high)))       # a thermostat
        ```

        At an instant all discrete equations are solved with `pre(…)` held. If a variable then differs from its value
        before, `pre(…)` becomes that, and they are solved again, until nothing changes: the event iteration of the
        Modelica Language Specification (appendix B). Equations may read each other's new values in any order, but not
        in a circle. Derivatives pass through the iteration as through one map.

        **Arguments:**

        - `variable`: a discrete variable of this component, as `self.discrete(…)` returns. Its start is what it was
            before the initial time, at which its equation holds, too. No event may assign it.
        - `value`: a condition, which is 1 where it holds and 0 elsewhere, or an expression. Variables that change in
            time stand in conditions, or in branches of a `Piecewise` that are there for an instant. `pre(d)` is d in
            the iteration before: what `edge(b)` is in Modelica is `And(Eq(b, 1), Eq(pre(b), 0))`.

        **Raises:**

        - `ModelError` for what is not a discrete variable of this component, for a second equation, for a value that
            changes between events, and for `pre(y)` of a variable that does.
        """
        self._check_open("add its discrete equations")
        where = f"component '{self.name}': discrete_equation"
        if not isinstance(variable, DiscreteSymbol) or variable.path not in self.parameters:
            raise ModelError(
                f"{where} takes a discrete variable of the component, as self.discrete(…) returns; got {variable}"
            )
        if variable in self.discrete_equations:
            raise ModelError(f"{where}: '{variable}' has an equation already: join them, by a Piecewise or an Or")
        found = sympy.sympify(value)
        if isinstance(value, str) or not isinstance(found, sympy.Expr | Boolean):
            raise ModelError(f"{where}({variable}, …): the value is a condition or an expression; got {value!r}")
        earlier = sorted((s for s in found.free_symbols if isinstance(s, EarlierSymbol)), key=str)
        if earlier:
            y = earlier[0].path
            raise ModelError(
                f"{where}({variable}, …): {earlier[0]} is not kept: '{y}' changes between events. Write {y} for "
                f"what it is at the instant, or let an event assign it to a discrete variable, "
                f"self.when(…, assign(d, pre({y})))"
            )
        flows = next(_flowing(found), None)
        if flows is not None:
            raise ModelError(
                f"{where}({variable}, …): the value changes with '{flows}' between events, and a discrete variable "
                f"does not: compare it in a condition, read it in a branch of a Piecewise, or write self.output(…)"
            )
        self.discrete_equations[variable] = found

    def _unshown(self, name: str, start: float) -> DiscreteSymbol:
        """Declares a discrete variable that is not shown."""
        self.parameters[name] = Parameter(name, start, "", Interval(), True)
        return DiscreteSymbol(name)

    def _with_events(self) -> None:
        if self.discrete_equations:
            self._solved = self._written_equations()
        super()._with_events()

    def _written_equations(self) -> DiscreteEquations:
        """The discrete equations, written as events."""
        equations = self.discrete_equations
        for event in self.events:
            for action in event.actions:
                if isinstance(action, Assign) and action.target in equations:
                    raise ModelError(
                        f"component '{self.name}': when({event.text}) assigns '{action.target}', which a discrete "
                        "equation says: let the equation read what the event assigns to another variable"
                    )
        found = DiscreteEquations(self)
        read = {s for value in equations.values() for s in value.free_symbols if isinstance(s, PreviousSymbol)}
        for variable, value in equations.items():
            found.before(variable.path)
            if not isinstance(value, Boolean):
                found.reals.add(variable.path)
        before: dict[sympy.Basic, sympy.Basic] = {s: found.before(s.path) for s in sorted(read, key=str)}
        for variable, value in equations.items():
            # Whole parts first: relations that contain them then compare variables.
            jumps = found.kept.with_jumps_as_variables(exchanged(value, before))
            found.give(variable.path, as_number(found.kept.in_discrete(jumps)), always=True)
        others = (DiscreteSymbol(s.path) for s in sorted(read, key=str))
        found.remembered += [d for d in others if d not in equations]
        found.share_relations()
        found.write()
        return found

    def _as_kept(self, equation: sympy.Expr) -> sympy.Expr:
        if self._solved is None or any(str(s).startswith(":") for s in equation.free_symbols):
            return equation
        return self._solved.kept.in_equations(equation)


def _flowing(value: Expression) -> Iterator[Expression]:
    """The variables, and time, that a value follows between events."""
    walk = sympy.preorder_traversal(value)
    for e in walk:
        if isinstance(e, _JUMPING):
            walk.skip()
        elif isinstance(e, VariableSymbol | TimeSymbol):
            yield e
