"""Arrays of components: one component object stands for all instances, and what differs between them is data."""

import inspect
import itertools
import math
import operator
from collections.abc import Iterator
from typing import Any, Protocol, TypeGuard

import jax
import numpy as np
import sympy
from jax.core import Tracer

from ..base.errors import ModelError
from .construction import Construction
from .declarations import Account, EachValue, Parameter, Variable
from .environment import EqnEnv
from .events import Sampled, When
from .ports import Port
from .symbols import ParameterSymbol, VariableSymbol


class Prototype(Protocol):
    """A component, as arrays of it see it. Components make arrays, and so import this module."""

    ev: EqnEnv
    name: str
    parent: Any  # the component that contains it, or None
    parameters: dict[str, Parameter]
    variables: dict[str, Variable]
    ports: dict[str, Port]
    children: dict[str, "Prototype | ComponentArray"]  # components and arrays of them
    equations: list[sympy.Expr]
    accounts: list[Account]
    events: list[When]

    @property
    def path(self) -> str: ...

    def outside_path(self) -> str: ...

    def symbol(self, name: str) -> sympy.Symbol: ...


class ComponentArray:
    """Equal components under one name, made by `add_array`.

    It is indexed like a NumPy array: `cells[0]` is a component, `cells[:-1]`, `cells[1, :]` and `cells[[0, 2]]` are
    parts of the array. Attributes are those of all components chosen: `cells[1:].p` is an array of ports, for
    `connect`, `cells.v` one of symbols.
    """

    def __init__(
        self,
        prototype: Prototype,
        shape: tuple[int, ...],
        arguments: dict[str, str | None] | None = None,
        numbers: np.ndarray | None = None,
        inner: Any = None,
        above: str | None = None,
    ):
        self.prototype = prototype
        self.shape = shape  # of the whole array
        self.arguments = arguments or {}  # with one value an instance: the parameter of the prototype that has them
        self.numbers = np.arange(math.prod(shape)).reshape(shape) if numbers is None else numbers  # of those chosen
        self.inner: Prototype = inner or prototype  # the prototype, or a component inside it
        self.above = above  # the path of the one instance that contains the array, if it was reached through that

    @property
    def name(self) -> str:
        """The array's name in the component or diagram that has it."""
        return self.prototype.name

    @property
    def path(self) -> str:
        """The array's full name."""
        return self.prototype.path

    @property
    def ev(self) -> EqnEnv:
        """The environment of its components."""
        return self.prototype.ev

    @property
    def parent(self) -> Prototype | None:
        """The component that has it."""
        return self.prototype.parent

    @property
    def size(self) -> int:
        """The number of instances in the whole array."""
        return math.prod(self.shape)

    def label(self, number: int) -> str:
        """The index of an instance as names have it: `[17]`, `[2,3]`."""
        return "[" + ",".join(map(str, np.unravel_index(number, self.shape))) + "]"

    def labels(self) -> list[str]:
        """The indices of all instances."""
        return [f"[{','.join(index)}]" for index in itertools.product(*(map(str, range(n)) for n in self.shape))]

    def instance(self, number: int) -> str:
        """The path of what was chosen of an instance, as the component now being written sees it, with a final dot."""
        above, inside = self.above, ""
        at: Any = self.inner
        while at is not self.prototype:
            inside, at = f"{at.name}.{inside}", at.parent
        if above is None:
            above = "" if self.parent is None else self.parent.outside_path()
        return f"{above}{self.name}{self.label(number)}.{inside}"

    def _chosen(self, numbers: np.ndarray, inner: Prototype) -> "ComponentArray":
        return ComponentArray(self.prototype, self.shape, self.arguments, numbers, inner, self.above)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, str):
            if index in self.inner.ports or index in self.inner.children:
                return getattr(self, index)
            return self.symbols(self.inner.symbol(index), index)
        try:
            return self._chosen(np.asarray(self.numbers[index]), self.inner)
        except (IndexError, TypeError, ValueError) as error:
            raise ModelError(f"array '{self.path}' has shape {self.numbers.shape}: {error}") from None

    def __getattr__(self, name: str) -> Any:
        # `copy` and `pickle` ask an object for private names before it has attributes: `self.inner` would call this
        # method again.
        if name.startswith("_"):
            raise AttributeError(name)
        inner = self.inner
        if name in inner.ports:
            return PortArray(inner.ports[name], self)
        if name in inner.children:
            child = inner.children[name]
            if not isinstance(child, ComponentArray):
                return self._chosen(self.numbers, child)
            if self.numbers.ndim:
                raise ModelError(f"'{self.path}.{name}' is an array in an array: choose one component of '{self.path}'")
            above = self.instance(int(self.numbers))
            return ComponentArray(child.prototype, child.shape, child.arguments, above=above)
        if name in inner.variables or name in inner.parameters:
            return self.symbols(inner.symbol(name), name)
        raise AttributeError(f"{type(inner).__name__} has no attribute '{name}'")

    def symbols(self, symbol: sympy.Symbol, name: str) -> Any:
        """The symbol that a declared name has in each component: an array of symbols, or that of one component."""
        found = np.empty(self.numbers.shape, object)
        for place, number in np.ndenumerate(self.numbers):
            path = self.instance(int(number)) + name
            found[place] = (
                VariableSymbol(path, symbol.order) if isinstance(symbol, VariableSymbol) else type(symbol)(path)
            )
        return found if found.ndim else found[()]

    def __len__(self) -> int:
        if not self.numbers.ndim:
            raise TypeError(f"'{self.path}{self.label(int(self.numbers))}' is one component")
        return len(self.numbers)

    def __iter__(self) -> Iterator[Any]:
        return (self[k] for k in range(len(self)))

    def __repr__(self):
        kind = type(self.inner).__name__
        if not self.numbers.ndim:
            return f"{kind}({self.instance(int(self.numbers))[:-1]!r})"
        part = " of them" if self.numbers.size < self.size else ""
        return f"{kind}({self.inner.path!r}, {' × '.join(map(str, self.numbers.shape))}{part})"


class PortArray:
    """A port of all components chosen of an array; its variables are attributes, arrays of symbols."""

    def __init__(self, port: Port, chosen: ComponentArray):
        self.port = port
        self.chosen = chosen

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        symbol = getattr(self.port, name)  # which raises for what the domain lacks
        return self.chosen.symbols(symbol, f"{self.port.name}.{name}")

    def __getitem__(self, index: object) -> "PortArray":
        return PortArray(self.port, self.chosen[index])

    def __len__(self) -> int:
        return len(self.chosen)

    def __repr__(self):
        return f"{self.described}: {self.port.domain.name} port{'s' if self.chosen.numbers.ndim else ''}"

    @property
    def described(self) -> str:
        """Its name, and how many ports it has."""
        numbers = self.chosen.numbers
        if not numbers.ndim:
            return f"{self.chosen.path}{self.chosen.label(int(numbers))}.{self.port.name}"
        return f"{self.chosen.path}.{self.port.name} ({' × '.join(map(str, numbers.shape))})"


def make_array(
    ev: EqnEnv, name: str, kind: type, shape: int | tuple[int, ...], args: tuple, kwargs: dict[str, object]
) -> ComponentArray:
    """An array of components `kind(ev, name, *args, **kwargs)`; arrays among the arguments hold one value for each.

    **Raises:**

    - `ModelError` for a shape that is not positive, arrays of another shape, and values that are not finite numbers or
        are out of the bounds of the parameter that they are given for.
    """
    where = f"array '{name}'"
    sizes = _sizes(shape, where)
    if not isinstance(kind, Construction):
        raise ModelError(
            f"{where}: the class of its components is needed, as in add_array(…, Resistor, 10); got {kind!r}"
        )
    values: dict[str, np.ndarray] = {}
    names = list(inspect.signature(kind.__init__).parameters)[3:]  # after self, ev, name
    given = [_each(v, names[k] if k < len(names) else str(k), sizes, name, values) for k, v in enumerate(args)]
    marked = {k: _each(v, k, sizes, name, values) for k, v in kwargs.items()}
    try:
        prototype = kind(ev, name, *given, **marked)
    except ModelError as error:
        lists = [k for k, v in kwargs.items() if isinstance(v, list | tuple) and np.shape(_regular(v)) == sizes]
        if not lists:
            raise
        raise ModelError(f"{error}. Values of {lists[0]} for each component are given as a NumPy array") from None
    return ComponentArray(prototype, sizes, _give_values(prototype, values, sizes))


def _regular(value: list | tuple) -> Any:
    """The list itself; None if its parts differ in length."""
    try:
        np.shape(value)
    except ValueError:
        return None
    return value


def _sizes(shape: int | tuple[int, ...], where: str) -> tuple[int, ...]:
    try:
        found = tuple(operator.index(n) for n in (shape if isinstance(shape, tuple | list) else (shape,)))
    except TypeError:
        raise ModelError(f"{where}: its shape is a positive integer or a tuple of them; got {shape!r}") from None
    if not found or min(found) < 1:
        raise ModelError(f"{where}: its shape is a positive integer or a tuple of them; got {shape!r}")
    return found


def _each(value: object, name: str, shape: tuple[int, ...], array: str, values: dict[str, np.ndarray]) -> object:
    """An argument as the prototype gets it. In place of an array it gets a symbol, and the array is added to
    `values`."""
    where = f"array '{array}'"
    if isinstance(value, Tracer):
        raise ModelError(
            f"{where}: {name} must be concrete when the model is written. To vary or differentiate it, compile once "
            "and use system.with_parameters"
        )
    if isinstance(value, tuple | list) and any(_is_array(v) for v in value):
        return [_each(v, f"{name}[{k}]", shape, array, values) for k, v in enumerate(value)]
    if not _is_array(value):
        return value
    if value.shape != shape:
        raise ModelError(
            f"{where} has shape {shape}, but the values of {name} have shape {value.shape}: give one for each "
            "component; what is the same for all is a number, a tuple or a list"
        )
    try:
        if np.issubdtype(value.dtype, np.complexfloating):
            raise TypeError
        numbers = np.asarray(value, np.float64).ravel()
    except (TypeError, ValueError):
        raise ModelError(
            f"{where}: the values of {name} must be real numbers; got {_kind_of(value)}. A factor that is a parameter "
            "goes to the component as an argument of its own"
        ) from None
    if not np.isfinite(numbers).all():
        wrong = int(np.flatnonzero(~np.isfinite(numbers))[0])
        raise ModelError(f"{where}: the values of {name} must be finite; got {numbers[wrong]} at position {wrong}")
    values[name] = numbers
    return ParameterSymbol(f"{array}:{name}")


def _is_array(value: object) -> TypeGuard[np.ndarray | jax.Array]:
    return isinstance(value, np.ndarray | jax.Array) and value.ndim > 0


def _kind_of(value: Any) -> str:
    """The kind of entries in a NumPy array, in words, for an error message."""
    kinds = {"c": "complex numbers", "U": "texts", "S": "texts"}
    if value.dtype == object:
        return f"entries of type {type(value.flat[0]).__name__}" if value.size else "no numbers"
    return kinds.get(value.dtype.kind, f"entries of type {value.dtype}")


def _give_values(prototype: Prototype, values: dict[str, np.ndarray], shape: tuple[int, ...]) -> dict[str, str | None]:
    """Gives parameters of the prototype, and of what is inside it, the values of the instances; returns the parameter
    of the prototype that has those of each argument."""
    if not values:
        return {}
    arguments: dict[str, str | None] = dict.fromkeys(values)
    unused = set(values)
    whole = ComponentArray(prototype, shape)
    waiting = [(prototype, 1)]
    while waiting:
        component, depth = waiting.pop()
        # A symbol gets one more `../` at each level that it is handed down (`symbols.seen_from_child`).
        symbols = {ParameterSymbol(f"{'../' * depth}{prototype.name}:{name}"): v for name, v in values.items()}
        read = [*component.equations, *(v.start for v in component.variables.values() if v.start is not None)]
        read += [p.value for p in component.parameters.values() if isinstance(p.value, sympy.Expr)]
        read += [account.expression for account in component.accounts]
        read += [part for when in component.events if isinstance(when.clock, Sampled)
                 for part in (when.clock.period, when.clock.offset) if part is not None]  # fmt: skip
        used_here = set().union(*(expression.free_symbols for expression in read))
        unused -= {str(s).rpartition(":")[2] for s in used_here & set(symbols)}
        for parameter in list(component.parameters.values()):
            if not isinstance(parameter.value, sympy.Expr) or not parameter.value.free_symbols <= set(symbols):
                continue
            used = sorted(parameter.value.free_symbols, key=str)
            # SciPy, too: NumPy has no error function, gamma function and the like.
            numbers = sympy.lambdify(used, parameter.value, ["scipy", "numpy"])(*(symbols[s] for s in used))  # type: ignore[index]
            numbers = np.broadcast_to(np.asarray(numbers, np.float64), (math.prod(shape),))
            for k, number in enumerate(numbers.tolist()):
                if number not in parameter.bounds:
                    inside = f"{component.path.removeprefix(prototype.path)}.{parameter.name}"
                    raise ModelError(
                        f"parameter '{prototype.name}{whole.label(k)}{inside}' must lie in {parameter.bounds}; "
                        f"got {number:g}"
                    )
            component.parameters[parameter.name] = parameter.with_value(EachValue(numbers, prototype))
            # Expressions that stay symbolic, because they read other parameters too, read an argument from here.
            if component is prototype and len(used) == 1 and parameter.value is used[0]:
                arguments[str(used[0]).rpartition(":")[2]] = parameter.name
        for child in component.children.values():
            waiting.append((child.prototype if isinstance(child, ComponentArray) else child, depth + 1))
    if unused:
        name = sorted(unused)[0]
        raise ModelError(
            f"array '{prototype.name}': '{name}' has a value for each component, but {type(prototype).__name__} does "
            "not use it in a parameter or an equation. What chooses between equations must be the same for all"
        )
    return arguments
