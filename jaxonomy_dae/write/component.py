"""The base class of everything a user models with."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import jax
import numpy as np
import sympy
from jax.core import Tracer

from ..base.errors import ModelError, UnknownAttribute, nearest
from .arrays import ComponentArray, make_array
from .connections import Connection, Signal, resolve_ends
from .construction import Construction
from .declarations import Account, Learned, Parameter, Value, Variable, full_name
from .delay_declarations import Delay, DelayDeclarations
from .energy_declarations import EnergyDeclarations
from .environment import EqnEnv
from .equations import residual_of
from .events import HeldBranch, When
from .interval import Interval, as_interval
from .mode_declarations import ModeDeclarations
from .names import check_name
from .networks import check_kind, count_outputs, of_scalars
from .place import line_of_caller
from .ports import Domain, Port
from .real_number import real_number
from .start_declarations import StartDeclarations
from .symbols import DiscreteSymbol, ParameterSymbol, PreviousSymbol, TimeSymbol, VariableSymbol

ChildT = TypeVar("ChildT", bound="Component")


class Component(StartDeclarations, EnergyDeclarations, DelayDeclarations, ModeDeclarations, metaclass=Construction):
    """The base class of all components: subclass it, and declare physics in `__init__`.

    ```python
    class Tank(Component):
        def __init__(self, ev, name, area=1.0, outlet=0.1, initial_level=1.0):
            super().__init__(ev, name)
            A = self.parameter("area", area, unit="m2")
            k = self.parameter("outlet", outlet)
            h0 = self.parameter("initial_level", initial_level, unit="m")
            h = self.variable("level", start=h0, fixed=True, unit="m")
            self.add_equations(Eq(A * der(h), -k * sqrt(h)))
    ```

    **Arguments:**

    - `ev`: the model's `EqnEnv`.
    - `name`: the component's name, without dots. The model's variables are then called `"name.variable"`.

    A variable of a child component is written as an attribute of the child, `self.r1.v`, or as `self.r1["v"]`.
    """

    def __init__(self, ev: EqnEnv, name: str):
        if not isinstance(ev, EqnEnv):
            raise ModelError(f"the first argument of a component is an EqnEnv; got {type(ev).__name__}")
        check_name(name, "component")
        self.ev = ev
        self.name = name
        self.parent: Component | None = None
        self.parameters: dict[str, Parameter] = {}
        self.variables: dict[str, Variable] = {}
        self.ports: dict[str, Port] = {}
        self.children: dict[str, Component | ComponentArray] = {}  # components and arrays of them
        self.equations: list[sympy.Expr] = []
        self.learned_terms: list[Learned] = []
        self.connections: list[Connection] = []
        self.signals: list[Signal] = []
        self.events: list[When] = []
        self.discrete_equations: dict[DiscreteSymbol, sympy.Basic] = {}
        self._solved = None  # the discrete equations, once they are written as events
        self.relations: list[float] = []
        self.as_written: dict[sympy.Expr, sympy.Expr] = {}
        self.held_branches: list[HeldBranch] = []
        self.delays: list[Delay] = []
        self.accounts: list[Account] = []
        self.tree_branches: list[tuple[Port, Port]] = []  # whose overdetermined quantities the equations relate
        self.tree_roots: list[Port] = []  # whose overdetermined quantities the equations determine
        self._line = line_of_caller()
        self._lines: dict[sympy.Expr, str] = {}  # of equations that were written on lines of their own
        self._sealed = False

    # --- names -------------------------------------------------------------------------------------------------

    @property
    def path(self) -> str:
        """The component's full name: `parent.child`."""
        return self.name if self.parent is None else f"{self.parent.path}.{self.name}"

    def outside_path(self) -> str:
        """The path of this component relative to the nearest ancestor whose declaration is not finished."""
        if not self._sealed:
            return ""
        above = "" if self.parent is None else self.parent.outside_path()
        return f"{above}{self.name}."

    def symbol(self, name: str) -> sympy.Symbol:
        """The symbol of a declared variable or parameter, for use in the component whose declaration is not
        finished."""
        if name in self.variables:
            return VariableSymbol(self.outside_path() + name)
        if name in self.parameters:
            kind = DiscreteSymbol if self.parameters[name].is_discrete else ParameterSymbol
            return kind(self.outside_path() + name)
        raise ModelError(
            f"component '{self.path}' has no variable or parameter '{name}': "
            + nearest(name, [*self.variables, *self.parameters])
        )

    __getitem__ = symbol

    def __getattr__(self, name: str) -> Any:
        # Reached only for names that are not plain attributes: declared symbols, ports, children.
        if name in _BASE_ATTRIBUTES and name not in self.__dict__:
            raise ModelError(f"{type(self).__name__}: its __init__ must begin with super().__init__(ev, name)")
        if not name.startswith("_"):
            for table in ("ports", "children"):
                if name in self.__dict__.get(table, ()):
                    return self.__dict__[table][name]
            declared = [*self.__dict__.get("variables", ()), *self.__dict__.get("parameters", ())]
            if name in declared:
                return self.symbol(name)
        tables = ("ports", "children", "variables", "parameters")
        declared = [n for table in tables for n in self.__dict__.get(table, ()) if "." not in n]
        raise UnknownAttribute(
            f"{type(self).__name__} '{self.__dict__.get('name', '')}' has no attribute '{name}'"
            + (f": {nearest(name, declared)}" if declared and not name.startswith("_") else "")
        )

    def __setattr__(self, name: str, value: object):
        # `self.v = self.variable("v")` is allowed and stores nothing: a stored symbol would keep the inside's name.
        if isinstance(value, VariableSymbol | ParameterSymbol):
            if name == value.name and (name in self.variables or name in self.parameters):
                return
            raise ModelError(
                f"component '{self.name}': cannot store the symbol '{value}' as attribute '{name}', because its name "
                f"changes when the component is seen from outside. Use a local Python variable; outside, the symbol is "
                f'`component["{value}"]`.'
            )
        super().__setattr__(name, value)

    def _check_open(self, what: str) -> None:
        if self._sealed:
            raise ModelError(f"component '{self.path}' is complete: {what} inside __init__ of its class")

    def _claim(self, name: str, what: str):
        self._check_open(f"declare its {what} '{name}'")
        check_name(name, what, f"component '{self.name}': ")
        for table, kind in (
            (self.parameters, "parameter"),
            (self.variables, "variable"),
            (self.ports, "port"),
            (self.children, "child component"),
        ):
            if name in table:
                raise ModelError(
                    f"component '{self.name}' uses the name '{name}' twice: it is a {kind} already; rename the {what}"
                )
        # Ports and children are reached as attributes. A variable of such a name can still be read as
        # `component["name"]`.
        if what in ("port", "child component") and hasattr(Component, name):
            raise ModelError(
                f"component '{self.name}': a {what} cannot be named '{name}', because every component has an "
                "attribute of that name; rename it"
            )
        if f"{name}[0]" in self.variables and not any(term.name == name for term in self.learned_terms):
            raise ModelError(f"component '{self.name}' uses the name '{name}' twice: it is a vector variable already")
        if any(term.name == name for term in self.learned_terms):
            raise ModelError(f"component '{self.name}' uses the name '{name}' twice: it is a learned term already")

    # --- declarations ------------------------------------------------------------------------------------------

    def parameter(
        self,
        name: str,
        value: Value,
        unit: str = "",
        bounds: "Interval | tuple[float, float]" = (-math.inf, math.inf),
    ) -> ParameterSymbol:
        """Declares a parameter: a number that is constant in time and can be set, trained and differentiated.

        **Arguments:**

        - `name`: its local name.
        - `value`: a finite number (a Python or NumPy scalar); or an expression in other parameters, of this component
            or given by its parent, such as `Resistor(ev, "a", R=R / 2)`: the parameter then follows those parameters
            when they are set or trained.
        - `unit`: shown in reports and plots, and compared by `AcausalCompiler(check_units=True)`.
        - `bounds`: the admissible values: a pair (low, high) of a closed interval, or an `Interval`, whose ends may be
            open. They hold wherever the parameter is set: in the declaration, `with_parameters`, `fit` and
            `initialize`.

        **Raises:**

        - `ModelError` if the value is not a finite number inside the bounds. The values of expressions are checked at
            compilation.
        """
        return ParameterSymbol(self._declare_parameter(name, "parameter", value, unit, bounds))

    def _declare_parameter(self, name: str, kind: str, value: Value, unit: str, bounds: Any = None) -> str:
        """Declares a parameter or a discrete variable; returns its name."""
        self._claim(name, kind)
        where = f"{kind} '{self.name}.{name}'"
        if not isinstance(unit, str):
            raise ModelError(f"{where}: unit is a text such as 'kg'; got {unit!r}")
        interval = Interval() if bounds is None else as_interval(bounds, where)
        if isinstance(value, sympy.Expr) and not value.is_number:
            self._check_parameters_only(value, f"the value of {where}")
        else:
            # A discrete variable may start at True or False: conditions are assigned to it as 1 and 0.
            if kind == "parameter" and isinstance(value, bool | np.bool_):
                raise ModelError(f"{where} must be a number; got {value}")
            value = real_number(
                value,
                where,
                ". To vary or differentiate it, compile once and use "
                f"`system.with_parameters({{'{self.name}.{name}': value}})`",
            )
            if value not in interval:
                raise ModelError(f"{where} must lie in {interval}; got {value:g}")
        self.parameters[name] = Parameter(name, value, unit, interval, kind != "parameter")
        return name

    @staticmethod
    def _check_parameters_only(value: sympy.Expr, what: str):
        wrong = sorted(
            (s for s in value.free_symbols if not isinstance(s, ParameterSymbol) or isinstance(s, PreviousSymbol)),
            key=str,
        )
        if wrong:
            raise ModelError(f"{what} may use parameters only; it uses '{wrong[0]}'")

    def _declare(self, name: str, kind: str, start=None, fixed=False, nominal=None, unit="", default=None, bounds=None):
        where = f"'{full_name(self.name, name)}'"
        if not isinstance(fixed, bool | np.bool_):
            raise ModelError(f"{where}: fixed is True or False; got {fixed!r}")
        if not isinstance(unit, str):
            raise ModelError(f"{where}: unit is a text such as 'm/s'; got {unit!r}")
        if nominal is not None and not 0 < real_number(nominal, f"the nominal value of {where}"):
            raise ModelError(f"the nominal value of {where} must be a positive number; got {nominal}")
        if fixed and start is None:
            raise ModelError(f"{where} is fixed at the start but has no start value: give `start=`")
        if start is not None:
            if not isinstance(start, sympy.Expr) or start.is_number:
                start = real_number(start, f"the start value of {where}")
            start = sympy.sympify(start)
            self._check_parameters_only(start, f"the start value of {where}")
        interval = Interval() if bounds is None else as_interval(bounds, where)
        if isinstance(start, sympy.Number) and float(start) not in interval:
            raise ModelError(f"the start value of {where} must lie in its bounds {interval}; got {start}")
        self.variables[name] = Variable(
            name=name,
            kind=kind,
            start=start,
            fixed=bool(fixed),
            nominal=float(nominal or 0.0),
            unit=unit,
            default=default,
            bounds=interval,
        )
        return VariableSymbol(name)

    def variable(
        self,
        name: str,
        start: Value | None = None,
        fixed: bool = False,
        nominal: float | None = None,
        unit: str = "",
        bounds: tuple[float, float] | Interval | None = None,
    ) -> VariableSymbol:
        """Declares a variable, an unknown function of time.

        **Arguments:**

        - `name`: its local name.
        - `start`: a number or an expression in parameters: its value at the initial time.
        - `fixed`: whether `start` must hold. If not, it is only a guess for the search for a consistent initial point.
        - `nominal`: a positive number, the typical size in the variable's unit. It scales tolerances and projections,
            and decides what counts as zero. By default it is 1 for tolerances; elsewhere sizes follow from values and
            equations.
        - `unit`: shown in reports and plots, and compared by `AcausalCompiler(check_units=True)`.
        - `bounds`: an interval that the search for a consistent initial point does not leave, for example `(0.0,
            math.inf)` for the argument of a logarithm or a root. It applies to states and to unknowns of nonlinear
            blocks. A start on a bound is moved inside.

        **Raises:**

        - `ModelError` for a start that is not a finite number or an expression in parameters, for a start out of its
            bounds, and for a nominal value that is not positive.
        """
        self._claim(name, "variable")
        return self._declare(name, "variable", start, fixed, nominal, unit, bounds=bounds)

    def vector(
        self,
        name: str,
        count: int,
        start: Any = None,
        fixed: bool = False,
        nominal: float | None = None,
        unit: str = "",
        bounds: tuple[float, float] | Interval | None = None,
    ) -> tuple[VariableSymbol, ...]:
        """Declares a vector of variables, `name[0]`, `name[1]`, …; returns their symbols.

        **Arguments:**

        - `name`: of the vector; in the solution, `solution["component.name[0]"]`.
        - `count`: how many entries.
        - `start`: a sequence with a start for each (None where there is none), or one for all.
        - `fixed`, `nominal`, `unit`, `bounds`: of all entries, as in `variable`. An entry without a start is not fixed.
        """
        self._claim(name, "variable")
        if not isinstance(count, int | np.integer) or isinstance(count, bool) or count < 1:
            raise ModelError(f"vector variable '{self.name}.{name}' needs a positive number of entries; got {count!r}")
        if isinstance(start, jax.Array) and not isinstance(start, Tracer):
            start = np.asarray(start)  # whose entries are read without a program
        is_sequence = isinstance(start, Sequence | np.ndarray) and not isinstance(start, str)
        starts = list(start) if is_sequence else [start] * count
        if len(starts) != count:
            raise ModelError(f"vector variable '{self.name}.{name}' needs {count} starts; got {len(starts)}")
        return tuple(
            self._declare(f"{name}[{k}]", "variable", s, fixed and s is not None, nominal, unit, bounds=bounds)
            for k, s in enumerate(starts)
        )

    def input(self, name: str, default: float | None = None, unit: str = "") -> VariableSymbol:
        """Declares an input: a function of time given to `simulate(inputs={"component.name": ...})`.

        If it has a `default`, it may be left out and is then constant.
        """
        self._claim(name, "input")
        if default is not None:
            default = real_number(default, f"the default of input '{self.name}.{name}'")
        return self._declare(name, "input", unit=unit, default=default)

    def output(self, name: str, expr: Value, unit: str = "") -> VariableSymbol:
        """Declares a variable that equals `expr`, to be read in the solution."""
        self._claim(name, "output")
        symbol = self._declare(name, "output", unit=unit)
        # Evaluated, `Eq` would try to decide whether the two are equal, and a long expression takes long.
        self.add_equations(sympy.Eq(symbol, expr, evaluate=False))
        return symbol

    def port(self, name: str, domain: Domain, nominal: Mapping[str, float] | None = None) -> Port:
        """Declares a port of the given domain; returns it, with its variables as attributes.

        `nominal` gives the usual sizes of some of them, by name: `{"m_flow": 1e-6}`. Where streams meet, a flow far
        below that counts as none.
        """
        self._claim(name, "port")
        if not isinstance(domain, Domain):
            raise ModelError(f"port '{self.name}.{name}' needs a Domain such as Electrical; got {domain!r}")
        known = [variable for variable, _ in domain.variables]
        for variable in nominal or ():
            if variable not in known:
                raise ModelError(f"port '{self.name}.{name}': nominal names '{variable}': {nearest(variable, known)}")
        port = Port(self, name, domain)
        self.ports[name] = port
        for variable, unit in domain.variables:
            self._declare(f"{name}.{variable}", "port", unit=unit, nominal=(nominal or {}).get(variable))
        return port

    def declare_branch(self, a: Port, b: Port) -> None:
        """Says that the equations determine the overdetermined quantities of one port from those of the other."""
        self._check_open("say which of its ports are branches")
        self.tree_branches.append((a, b))

    def declare_root(self, port: Port) -> None:
        """Says that the equations determine the overdetermined quantities of the port: a tree of connections begins
        there."""
        self._check_open("say which of its ports are roots")
        self.tree_roots.append(port)

    def learned(
        self,
        name: str,
        network: Callable,
        inputs: Sequence[object],
        outputs: int | None = None,
        kind: type | tuple[type, ...] | None = None,
    ) -> tuple[VariableSymbol, ...]:
        """Puts a network into the equations: its outputs are variables, one symbol each.

        **Arguments:**

        - `name`: of the network; its weights are `system.neural["component.name"]`, its outputs the variables
            `component.name` (one output) or `component.name[0]`, `component.name[1]`, …
        - `network`: a callable pytree, `network(u) -> (outputs,)`, such as an `equinox.nn.MLP`.
        - `inputs`: symbols of variables (or `ev.t`); `u` has shape `(len(inputs),)`, in this order.
        - `outputs`: the number of outputs. If left out, it is found by tracing the network.
        - `kind`: the class, or classes, of which the network must be an instance. Use it if the physics of the
            component relies on a property: `kind=jaxonomy_dae.learning.AbstractPassive` admits only laws that bring no
            energy in.

        **Returns:**

        A tuple of symbols. They can be used in any equation, also in algebraic ones. Index reduction differentiates the
        network with `jax.jvp`.

        **Raises:**

        - `ModelError` if the network does not accept shape `(len(inputs),)`, does not return a vector, or is not of the
            kind.
        """
        if kind is not None:
            check_kind(network, kind, f"learned term '{self.path}.{name}'")
        return self._opaque("learned term", name, network, inputs, outputs)

    def function(
        self, name: str, function: object, inputs: Sequence[object], outputs: int | None = None
    ) -> tuple[VariableSymbol, ...]:
        """Puts a JAX function into the equations as it is: the untrained twin of `learned`.

        **Arguments:**

        - `name`: its outputs are the variables `component.name` (one output) or `component.name[0]`, …
        - `function`: `function(x, y, …)` takes a scalar for each input and returns a scalar or a vector `(outputs,)`.
            Any function works that JAX can trace and differentiate, such as an interpolation table. If it is a pytree
            (an `equinox.Module`, or a method of one), the arrays in it are leaves of the system, and
            `system.partition("component.name")` makes them trainable.
        - `inputs`: symbols of variables (or `ev.t`), in this order.
        - `outputs`: the number of outputs. If left out, it is found by tracing the function.

        **Returns:**

        A tuple of symbols for use in any equation. Index reduction differentiates the function with `jax.jvp`.

        **Raises:**

        - `ModelError` if the function cannot be called with that many scalars.
        """
        if not callable(function):
            method = ": give its method .evaluate" if hasattr(function, "evaluate") else ""
            raise ModelError(f"function '{self.name}.{name}': the function must be callable; got {function!r}{method}")
        return self._opaque("function", name, of_scalars(function), inputs, outputs)

    def _opaque(self, what: str, name: str, network: Callable, inputs: Sequence[object], outputs: int | None):
        self._claim(name, what)
        where = f"{what} '{self.name}.{name}'"
        if not callable(network):
            raise ModelError(f"{where}: the {_noun(what)} must be callable; got {network!r}")
        if isinstance(inputs, sympy.Basic):
            raise ModelError(f"{where}: inputs is a list of symbols; write inputs=[{inputs}]")
        symbols = []
        for entry in inputs:
            entry = sympy.sympify(entry)
            if not isinstance(entry, VariableSymbol | TimeSymbol):
                raise ModelError(f"{where}: inputs are symbols of variables or ev.t; got '{entry}'")
            symbols.append(entry)
        found = count_outputs(network, len(symbols), where, noun=_noun(what))
        if outputs is not None and outputs != found:
            raise ModelError(f"{where}: expected {outputs} outputs, but the {_noun(what)} returns {found}")
        names = [name] if found == 1 else [f"{name}[{k}]" for k in range(found)]
        declared = tuple(self._declare(n, "learned") for n in names)
        self.learned_terms.append(Learned(name, network, tuple(symbols), declared, _noun(what)))
        return declared

    def add_equations(self, *equations: sympy.Basic) -> None:
        """Adds equations: SymPy `Eq`s, or expressions that are zero.

        **Raises:**

        - `ModelError` if an equation is trivially true or false, or contains a symbol that the component does not know.
        """
        self._check_open("add its equations")
        line = line_of_caller()
        for equation in equations:
            if not isinstance(equation, sympy.Basic | bool | int | float):
                raise ModelError(f"component '{self.name}': {equation!r} is not an equation")
            try:
                residual = residual_of(equation)
            except ModelError as error:
                raise ModelError(f"component '{self.name}': {error}") from None
            except TypeError:  # not even hashable, such as a matrix
                raise ModelError(f"component '{self.name}': {equation!r} is not an equation") from None
            self.equations.append(residual)
            if line != self._line:
                self._lines.setdefault(residual, line)

    # --- hierarchy ---------------------------------------------------------------------------------------------

    def add(self, child: ChildT) -> ChildT:
        """Adds a child component and returns it; its names become `"self.child.variable"`."""
        if not isinstance(child, Component):
            raise ModelError(f"component '{self.name}': only components can be added; got {type(child).__name__}")
        if child.parent is not None:
            raise ModelError(f"component '{child.name}' already belongs to '{child.parent.path}'")
        if child.ev is not self.ev:
            raise ModelError(
                f"component '{self.name}': its child '{child.name}' was made with another EqnEnv; give it self.ev"
            )
        self._claim(child.name, "child component")
        child.parent = self
        self.children[child.name] = child
        return child

    def add_array(
        self, name: str, kind: "type[Component]", shape: int | tuple[int, ...], /, *args: object, **kwargs: Any
    ) -> ComponentArray:
        """Adds an array of equal components and returns it. Its variables are called `"self.name[17].variable"`.

        **Arguments:**

        - `name`: of the array.
        - `kind`: the class of its components.
        - `shape`: how many, or a tuple for an array of several dimensions.
        - `args`, `kwargs`: for `kind(ev, name, *args, **kwargs)`. A NumPy array of the array's shape, alone or in a
            list, has one value for each component. All other arguments are the same for all components.

        All components of the array share one learned term or function of `kind`, `system.neural["self.name.term"]`.

        **Raises:**

        - `ModelError` for a shape that is not positive, for arrays of another shape, and for values that the component
            refuses.
        """
        self._claim(name, "child component")
        array = make_array(self.ev, name, kind, shape, args, kwargs)
        array.prototype.parent = self
        self.children[name] = array
        return array

    def connect(self, *ends: object) -> "Component":
        """Connects ports of this component and of its children, `connect(a.p, b.n, …)` or `connect(a, "p", b, "n")`; or
        signals: `connect(a.y, b.u)` lets the variable `y` of a child (or of this component) drive the input `u` of
        another child, which is then an ordinary unknown."""
        connection, signals = resolve_ends(ends, f"component '{self.name}'")
        if connection:
            self.connections.append(connection)
        self.signals.extend(signals)
        return self

    def __repr__(self):
        return f"{type(self).__name__}({self.path!r})"


# What `Component.__init__` sets. If one is missing, a subclass has not called it.
_BASE_ATTRIBUTES = (
    *"ev name parent parameters variables ports children equations".split(),
    *"learned_terms connections signals events discrete_equations relations as_written held_branches delays".split(),
    *"accounts tree_branches tree_roots".split(),
    *"_line _lines _sealed _solved".split(),
)


def _noun(what: str) -> str:
    return "network" if what == "learned term" else what


def line_of(component: Component, residual: sympy.Expr) -> str:
    """Where in the user's code an equation was added; for a component of the library, where that was made."""
    lines = component._lines
    return lines.get(component.as_written.get(residual, residual), component._line) if lines else component._line
