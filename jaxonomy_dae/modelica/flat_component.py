"""A flat Modelica model as a component."""

from collections.abc import Sequence

from ..base.errors import ModelError, nearest
from ..write.component import Component
from ..write.environment import EqnEnv
from .continuous import write_equation
from .flat_model import FlatModel
from .laws import equation_of, write_law
from .scope import Scope, located
from .semi_linear import with_chains_solved
from .starts import hold_waiting, in_order, write_initial_algorithm, write_initial_equation
from .values import as_number
from .whens import read_followed, read_section, read_when


class FlatComponent(Component):
    """A flat Modelica model as a component. Its names are those of the text, with dots and brackets.

    **Arguments:**

    - `ev`: the model's `EqnEnv`.
    - `name`: the component's name.
    - `flat`: the model, as `load` returns it.
    - `outputs`: names of Boolean and Integer variables that the solution shall contain. It always contains those that a
        `when` assigns or `pre(…)` reads.
    - `numbers`: names of parameters that are written as their values, so that they cannot be changed. A resistance of
        zero makes two potentials one; as a parameter it would have to determine a current, which the compiler refuses.

    **Raises:**

    - `ModelError` for constructs that cannot be translated, with the line of the text; and for a law, of `flat.replace`
        or `flat.add_term`, of a variable that is not defined by exactly one equation of the form `variable = …`.
    """

    def __init__(
        self, ev: EqnEnv, name: str, flat: FlatModel, outputs: Sequence[str] = (), numbers: Sequence[str] = ()
    ):
        super().__init__(ev, name)
        for number in numbers:
            if not any(number == d.name and "parameter" in d.prefixes for d in flat.model.declarations):
                known = [d.name for d in flat.model.declarations]
                raise ModelError(f"numbers: '{flat.name}' has no parameter '{number}': {nearest(number, known)}")
        self._write(flat, Scope(flat, self, frozenset(numbers)), outputs)

    def _write(self, flat: FlatModel, scope: Scope, outputs: Sequence[str]) -> None:
        """Declares what the text declares, and adds its equations and events."""
        self.flat = flat
        found = scope.definitions
        scope.declare_variables()
        # Before anything is written, so that an equation with a law in its place is left out.
        replaced = {variable: equation_of(scope, variable) for variable in flat.laws}
        equations = [s for s in found.equations if not any(s is r.statement for r in replaced.values())]
        equations = with_chains_solved(equations, scope.interpreter.name_of)
        discrete = scope.discrete
        for name in found.followed:
            located(flat.name, scope.declared[name].line, read_followed, scope, name)
        for s in found.whens:
            located(flat.name, s.line, read_when, scope, s)
        for section in found.sections:
            located(flat.name, section[0].line, read_section, scope, section)
        # After all whens, and before equations: these read relations by the truths that whens keep.
        discrete.share_relations()
        for write, statements in (
            (write_equation, equations),
            (write_initial_equation, in_order(scope, found.initial)),
        ):
            for s in statements:
                located(flat.name, s.line, write, scope, s)
        hold_waiting(scope)
        for statements in filter(None, flat.model.initial_algorithms):
            located(flat.name, statements[0].line, write_initial_algorithm, scope, statements)
        for variable, law in flat.laws.items():
            located(flat.name, replaced[variable].statement.line, write_law, scope, replaced[variable], law)
        for output in outputs:
            if output not in scope.declared:
                raise ModelError(
                    f"outputs: '{flat.name}' has no variable '{output}': {nearest(output, scope.declared)}"
                )
            if output not in self.variables and output not in self.parameters:
                self.output(output, as_number(scope.value(output)))
        discrete.write()

    # Names of a flat text have dots and brackets, which those of other components must not have.
    def _claim(self, name: str, what: str):
        self._check_open(f"declare its {what} '{name}'")
        if name in self.variables or name in self.parameters:
            raise ModelError(f"component '{self.name}' uses the name '{name}' twice")
