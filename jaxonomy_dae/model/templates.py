"""Templates: canonical residuals with slots.

An equation of the model is a template and a row of integers that fill its slots. All symbolic work — derivatives,
partial derivatives, solving for a slot, code generation — is done here, once per distinct equation shape.

A slot is a pair (base, q): the q-th time derivative of what stands in base slot `base`. A template as written has the
slots (0, 0), (1, 0), …; its derivative has slots with higher q too. The residual functions take lists of slot values
in the order of `template.slots`, parameter values and coefficients, all scalars or arrays of one shape.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import sympy

from ..modeling.symbols import TIME, ParameterSymbol, TimeSymbol, VariableSymbol

Slot = tuple[int, int]
Kernel = Callable[..., Any]


def _slot_symbol(slot: Slot) -> sympy.Symbol:
    return sympy.Symbol(f"s{slot[0]}_{slot[1]}", real=True)


def _parameter_symbol(k: int) -> sympy.Symbol:
    return sympy.Symbol(f"p{k}", real=True)


_NUMPY = {"numpy": np, "jax": jnp}


def _float_constants(expression: Any) -> Any:
    """Exact constants that are no integers become floats, so that kernels keep the dtype of their arguments."""
    constants = [e for e in expression.atoms(sympy.Rational, sympy.NumberSymbol) if not e.is_Integer]
    return expression.xreplace({c: sympy.Float(c, 17) for c in constants})


def _compile(arguments: Sequence[sympy.Symbol], expressions: Sequence[sympy.Expr], backend: str) -> Kernel:
    """A function of the arguments that returns a tuple, in NumPy or in JAX."""
    xp = _NUMPY[backend]
    names: dict[str, Any] = {"Heaviside": lambda x, h=0.5: xp.heaviside(x, h), "sign": xp.sign, "Abs": xp.abs}
    expressions = [_float_constants(e) for e in expressions]
    printer = "jax" if backend == "jax" else "numpy"
    function = sympy.lambdify(list(arguments), tuple(expressions), modules=[names, printer], cse=True)
    return function


class Template:
    """A symbolic residual in slots, parameters and time."""

    def __init__(self, expression: sympy.Expr, slots: tuple[Slot, ...], n_parameters: int):
        self.expression = expression
        self.slots = slots
        self.n_parameters = n_parameters
        self.key = f"{sympy.srepr(expression)}|{slots}|{n_parameters}"
        self._kernels: dict[Any, Kernel] = {}

    n_coefficients = 0
    opaque: "OpaqueFunction | None" = None

    def __reduce__(self):
        return template_of, (self.expression, self.slots, self.n_parameters)  # kernels are made again

    @property
    def arguments(self) -> list[sympy.Symbol]:
        """The symbols of the slots, of the parameters, and of time."""
        parameters = [_parameter_symbol(k) for k in range(self.n_parameters)]
        return [*map(_slot_symbol, self.slots), *parameters, TIME]

    @functools.cached_property
    def partials(self) -> tuple[sympy.Expr, ...]:
        """∂(residual)/∂(slot) for each slot."""
        return tuple(sympy.diff(self.expression, _slot_symbol(s)) for s in self.slots)

    @functools.cached_property
    def _partial_slots(self) -> tuple[frozenset[int], ...]:
        position: dict[Any, int] = {_slot_symbol(s): k for k, s in enumerate(self.slots)}
        return tuple(frozenset(position[f] for f in p.free_symbols if f in position) for p in self.partials)

    @functools.cached_property
    def derivative(self) -> "Template":
        """The template of the residual's time derivative."""
        total = sympy.diff(self.expression, TIME)
        slots = set(self.slots)
        for slot, partial in zip(self.slots, self.partials, strict=True):
            if partial != 0:
                raised = (slot[0], slot[1] + 1)
                slots.add(raised)
                total += partial * _slot_symbol(raised)
        used = total.free_symbols
        kept = tuple(s for s in sorted(slots) if _slot_symbol(s) in used)
        return Template(total, kept, self.n_parameters)

    def is_affine_in(self, positions: Sequence[int]) -> bool:
        """Whether the residual is affine, jointly, in the slots at these positions."""
        chosen = set(positions)
        return all(not (self._partial_slots[k] & chosen) for k in positions)

    def coefficient_is_constant(self, position: int) -> bool:
        """Whether ∂(residual)/∂(slot) depends on parameters and numbers only."""
        return not self._partial_slots[position] and TIME not in self.partials[position].free_symbols

    def coefficient_never_vanishes(self, position: int) -> bool:
        """Whether ∂(residual)/∂(slot) is a nonzero number or a product of parameters, safe to divide by."""
        partial: Any = self.partials[position]
        if not self.coefficient_is_constant(position):
            return False
        return (
            partial.is_Number
            or partial.is_Symbol
            or all(f.is_Number or f.is_Symbol or (f.is_Pow and f.base.is_Symbol) for f in partial.as_ordered_factors())
        )

    def _kernel(self, key: Any, expressions: Callable[[], Sequence[sympy.Expr]], backend: str) -> Kernel:
        if (key, backend) not in self._kernels:
            self._kernels[key, backend] = _compile(self.arguments, expressions(), backend)
        return self._kernels[key, backend]

    def residual(self, slots, parameters, coefficients, t, networks, backend="jax") -> Any:
        """The residual's value."""
        return self._kernel("residual", lambda: [self.expression], backend)(*slots, *parameters, t)[0]

    def partial_values(self, slots, parameters, coefficients, t, networks, backend="jax") -> tuple:
        """The values of all partial derivatives, one for each slot."""
        return self._kernel("partials", lambda: self.partials, backend)(*slots, *parameters, t)

    def solve(self, position: int, slots, parameters, coefficients, t, networks, backend="jax") -> Any:
        """The value of the slot at `position` for which the residual, affine in it, is zero."""

        def solved():
            symbol = _slot_symbol(self.slots[position])
            return [-self.expression.subs(symbol, 0) / self.partials[position]]

        slots = list(slots)
        slots[position] = 0.0
        return self._kernel(("solve", position), solved, backend)(*slots, *parameters, t)[0]


class LinearTemplate:
    """Σ coefficient·slot = 0 with numeric coefficients that belong to the instance, for any number of slots."""

    opaque = None
    n_parameters = 0

    def __init__(self, n: int, q: int = 0):
        self.slots: tuple[Slot, ...] = tuple((k, q) for k in range(n))
        self.n_coefficients = n
        self._q = q
        self.key = f"linear|{n}|{q}"

    @functools.cached_property
    def derivative(self) -> "LinearTemplate":
        return LinearTemplate(self.n_coefficients, self._q + 1)

    def is_affine_in(self, positions) -> bool:
        return True

    def coefficient_is_constant(self, position: int) -> bool:
        return True

    def coefficient_never_vanishes(self, position: int) -> bool:
        return True

    def residual(self, slots, parameters, coefficients, t, networks, backend="jax"):
        total = 0.0
        for c, s in zip(coefficients, slots, strict=True):
            total = total + _scaled(c, s)
        return total

    def partial_values(self, slots, parameters, coefficients, t, networks, backend="jax"):
        return tuple(coefficients)

    def solve(self, position, slots, parameters, coefficients, t, networks, backend="jax"):
        divisor = coefficients[position]
        total = None
        for k, s in enumerate(slots):
            if k != position:
                term = _scaled(-coefficients[k] / divisor, s)
                total = term if total is None else total + term
        return 0.0 if total is None else total


def _scaled(c, s):
    if np.ndim(c) == 0:
        if c == 1:
            return s
        if c == -1:
            return -s
        return float(c) * s
    if np.all(c == 1):
        return s
    if np.all(c == -1):
        return -s
    return (jnp.asarray(c, s.dtype) if isinstance(s, jax.Array) else c) * s


class OpaqueFunction:
    """A network in the equations: which weights it reads, and how it is called.

    `index` is the position of the weights in the compiled system's networks; `function` is None for a callable pytree
    (the weights are called), else a plain `function(t, u, theta)`. `time_positions` are the entries of u that are time.
    """

    def __init__(self, index: int, name: str, function: Callable | None, n_inputs: int, time_positions: frozenset[int]):
        self.index = index
        self.name = name
        self.function = function
        self.n_inputs = n_inputs
        self.time_positions = time_positions

    def __call__(self, weights: Any, t, u):
        """The outputs, in the dtype of `u`; the weights are used in their own."""
        dtypes = [leaf.dtype for leaf in jax.tree.leaves(weights) if hasattr(leaf, "dtype")]
        floating = [d for d in dtypes if jnp.issubdtype(d, jnp.floating)]
        dtype = floating[0] if floating else u.dtype
        inside = u.astype(dtype)
        out = weights(inside) if self.function is None else self.function(jnp.asarray(t, dtype), inside, weights)
        return out.astype(u.dtype)

    def derivatives(self, weights, order: int, t, inputs: list[list]):
        """The `order`-th time derivative of the outputs; inputs[k] lists the non-time inputs' k-th derivatives."""

        def level(k: int):
            if k == 0:
                return lambda time, u: self(weights, time[0], u[0])
            below = level(k - 1)

            def function(time, u):
                return jax.jvp(below, (time[:k], u[:k]), (time[1 : k + 1], u[1 : k + 1]))[1]

            return function

        zero, one = jnp.zeros_like(t), jnp.ones_like(t)
        time = [t, one, *[zero] * order][: order + 1]
        us = []
        for k in range(order + 1):
            source = iter(inputs[k])
            entries = [time[k] if j in self.time_positions else next(source) for j in range(self.n_inputs)]
            us.append(jnp.stack([jnp.asarray(e, t.dtype) for e in entries]))
        return level(order)(time, us)


class OpaqueTemplate:
    """y − N(u)[output] = 0, or its q-th time derivative; base slot 0 is y, the others are the non-time inputs."""

    n_parameters = 0
    n_coefficients = 0

    def __init__(self, opaque: OpaqueFunction, output: int, q: int = 0):
        self.opaque = opaque
        self.output = output
        self._q = q
        self._n = opaque.n_inputs - len(opaque.time_positions)
        self.slots: tuple[Slot, ...] = ((0, q), *((1 + k, r) for r in range(q + 1) for k in range(self._n)))
        self.key = f"network|{opaque.index}|{output}|{q}|{opaque.n_inputs}|{sorted(opaque.time_positions)}"

    @functools.cached_property
    def derivative(self) -> "OpaqueTemplate":
        return OpaqueTemplate(self.opaque, self.output, self._q + 1)

    def is_affine_in(self, positions) -> bool:
        return list(positions) == [0]

    def coefficient_is_constant(self, position: int) -> bool:
        return position == 0

    coefficient_never_vanishes = coefficient_is_constant

    def _network(self, inputs, t, networks, like):
        n = self._n
        grouped = [list(inputs[r * n : (r + 1) * n]) for r in range(self._q + 1)]
        t = jnp.asarray(t, like.dtype)
        return networks.evaluate(self.opaque, self._q, t, grouped)[self.output]

    def residual(self, slots, parameters, coefficients, t, networks, backend="jax"):
        like = jnp.asarray(slots[0], dtype=None if hasattr(slots[0], "dtype") else jnp.asarray(t).dtype)
        out = like - self._network(slots[1:], t, networks, like)
        return np.asarray(out) if backend == "numpy" else out

    def solve(self, position, slots, parameters, coefficients, t, networks, backend="jax"):
        if position != 0:
            raise AssertionError("a network is solved for its outputs only")
        return self._network(slots[1:], t, networks, jnp.asarray(t))

    def partial_values(self, slots, parameters, coefficients, t, networks, backend="jax"):
        values = jnp.stack([jnp.asarray(s, jnp.asarray(t).dtype) for s in slots])
        return tuple(jax.jacfwd(lambda v: self.residual(list(v), (), (), t, networks))(values))


AnyTemplate = Template | LinearTemplate | OpaqueTemplate


@functools.lru_cache(maxsize=4096)
def template_of(expression: sympy.Expr, slots: tuple[Slot, ...], n_parameters: int) -> Template:
    """The one template of this canonical residual."""
    return Template(expression, slots, n_parameters)


def canonical(
    residual: sympy.Expr, variables: Sequence[VariableSymbol], parameters: Sequence[ParameterSymbol]
) -> Template:
    """The template of a residual: slot k stands for variables[k], parameter k for parameters[k]."""
    replaced: dict[sympy.Symbol, sympy.Symbol] = {v: _slot_symbol((k, 0)) for k, v in enumerate(variables)}
    replaced |= {p: _parameter_symbol(k) for k, p in enumerate(parameters)}
    slots = tuple((k, 0) for k in range(len(variables)))
    return template_of(residual.xreplace(replaced), slots, len(parameters))


def linear_coefficients(residual: sympy.Expr, variables: Sequence[VariableSymbol]) -> tuple[float, ...] | None:
    """The coefficients of a residual that is a linear form in its variables with numeric coefficients, else None."""
    if any(isinstance(s, ParameterSymbol | TimeSymbol) for s in residual.free_symbols):
        return None
    found: dict[Any, float] = dict.fromkeys(variables, 0.0)
    for term in sympy.Add.make_args(residual):
        factor, rest = term.as_coeff_Mul()
        if rest not in found or not factor.is_finite:
            return None
        found[rest] += float(factor)
    return tuple(found.values())
