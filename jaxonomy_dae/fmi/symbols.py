"""Programs evaluated on arrays of symbols of CasADi: the alphabet of `emit_c`, for expressions in place of C.

NumPy moves entries about; an entry that is computed is an expression, `casadi.SX`.
"""

import functools
import itertools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ..base.errors import ModelError
from .dependencies import MOVES, REDUCES, moved
from .straight import CALLS, Constant, Operation, function_of, known, straight, where_written

# Primitives that CasADi has under another name, or as an operator; those not listed here or below have the same name.
_NAMES = {
    "asin": "arcsin", "acos": "arccos", "atan": "arctan", "atan2": "arctan2", "asinh": "arcsinh", "acosh": "arccosh",
    "atanh": "arctanh", "abs": "fabs", "max": "fmax", "min": "fmin", "rem": "fmod", "eq": "eq", "and": "logic_and",
    "or": "logic_or", "not": "logic_not",
}  # fmt: skip
_SAME = {
    "exp", "log", "expm1", "log1p", "sin", "cos", "tan", "sinh", "cosh", "tanh", "sqrt", "erf", "floor", "ceil", "sign",
    "lt", "le", "gt", "ge", "ne",
}  # fmt: skip
_OWN: dict[str, Callable[..., Any]] = {
    "add": lambda a, b: a + b, "add_any": lambda a, b: a + b, "sub": lambda a, b: a - b, "mul": lambda a, b: a * b,
    "div": lambda a, b: a / b, "neg": lambda a: -a, "pow": lambda a, b: a**b, "square": lambda a: a * a,
    "rsqrt": lambda a: 1 / a**0.5, "logistic": lambda a: 1 / (1 + (-a).exp()), "exp2": lambda a: 2**a,
    "copy": lambda a: a, "stop_gradient": lambda a: a, "name": lambda a: a, "is_finite": lambda a: a - a == 0,
    "reduce_precision": lambda a: a, "cbrt": lambda a: a.sign() * a.fabs() ** (1 / 3),
}  # fmt: skip
_PAIRS = {"sum": "add", "prod": "mul", "max": "max", "min": "min", "and": "and", "or": "or"}


class Symbols:
    """Evaluates programs on arrays whose entries are symbols; those that are known stay numbers."""

    def __init__(self, casadi: Any):
        self._casadi = casadi

    def closed(self, program: Any, given: Sequence[np.ndarray]) -> list[np.ndarray]:
        return self.run(program.jaxpr, [*(known(c).value for c in program.consts), *given])

    def run(self, inside: Any, given: Sequence[np.ndarray]) -> list[np.ndarray]:
        program = straight(inside, [g if g.dtype != object else None for g in given])
        values: dict[int, np.ndarray] = dict(zip(program.arguments, given, strict=True))

        def read(atom: Any) -> np.ndarray:
            return atom.value if isinstance(atom, Constant) else values[atom]

        for operation in program.operations:
            operands = [read(a) for a in operation.given]
            if all(o.dtype != object for o in operands) and operation.primitive not in CALLS:
                results = self._of_numbers(operation, operands)
            elif operation.primitive in MOVES:
                results = self._moved(program, operation, operands)
            else:
                results = self._of_symbols(operation, operands)
            values.update(zip(operation.results, map(_array, results), strict=True))
        return [read(a) for a in program.results]

    def _of_numbers(self, operation: Operation, operands: Sequence[np.ndarray]) -> list[np.ndarray]:
        found = operation.source_primitive.bind(*operands, **operation.params)
        return [np.asarray(f) for f in (found if operation.source_primitive.multiple_results else [found])]

    def _moved(self, program: Any, operation: Operation, operands: Sequence[np.ndarray]) -> list[np.ndarray]:
        def value(atom: Any) -> np.ndarray | None:
            own = operands[operation.given.index(atom)]
            return own if own.dtype != object else None

        places = moved(program, operation, value)
        if places is None:
            raise self._refused(operation, "whose places depend on values")
        every = np.concatenate([np.zeros(1, object), *(o.astype(object).ravel() for o in operands)])
        return [every[p] for p in places]

    def _of_symbols(self, operation: Operation, operands: list[np.ndarray]) -> list[np.ndarray]:
        name, params = operation.primitive, operation.params
        if name in CALLS:
            inner, closed = function_of(operation)
            return self.run(inner, [*(known(c).value for c in closed), *operands])
        if name == "cond":
            cases = [self.closed(branch, operands[1:]) for branch in params["branches"]]
            return [self._chosen(operands[0], list(case)) for case in zip(*cases, strict=True)]
        if name == "scan":
            return self._scanned(params, operands)
        if name in REDUCES and (pair := _PAIRS.get(name.removeprefix("reduce_"))):
            axes = tuple(params["axes"])
            kept = [n for d, n in enumerate(operands[0].shape) if d not in axes]
            rows = np.moveaxis(operands[0], axes, range(len(axes))).reshape(-1, *kept)
            if len(rows):
                return [functools.reduce(functools.partial(self._entrywise, operation, pair), list(map(_array, rows)))]
        if name == "dot_general":
            return [self._product(operation, *operands)]
        if name == "select_n":
            return [self._chosen(operands[0], operands[1:])]
        if name == "clamp":
            low, x, high = operands
            return [self._entrywise(operation, "min", self._entrywise(operation, "max", x, low), high)]
        if name == "integer_pow":
            power = np.full((), int(params["y"]))
            return [self._entrywise(operation, "pow", operands[0], power)]
        if name == "convert_element_type":
            return [operands[0]]
        return [self._entrywise(operation, name, *operands)]

    def _entrywise(self, operation: Operation, name: str, *operands: np.ndarray) -> np.ndarray:
        function = _OWN.get(name) or getattr(self._casadi, _NAMES.get(name, name if name in _SAME else ""), None)
        if function is None:
            raise self._refused(operation, "")
        symbol = self._casadi.SX
        own = np.frompyfunc(lambda *entries: function(*map(symbol, map(_number, entries))), len(operands), 1)
        return _array(own(*map(_array, operands)))

    def _chosen(self, which: np.ndarray, cases: Sequence[np.ndarray]) -> np.ndarray:
        """The case with the number `which`, entry by entry; the first or the last beyond them."""
        symbol, if_else = self._casadi.SX, self._casadi.if_else
        out = cases[-1]
        for k in range(len(cases) - 2, -1, -1):
            choose = np.frompyfunc(
                lambda w, a, b, k=k: if_else(symbol(_number(w)) <= k, symbol(_number(a)), symbol(_number(b))), 3, 1
            )
            out = _array(choose(which, cases[k], out))
        return out

    def _product(self, operation: Operation, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        (over_a, over_b), (batch_a, batch_b) = operation.params["dimension_numbers"]
        free_a = [d for d in range(a.ndim) if d not in (*over_a, *batch_a)]
        free_b = [d for d in range(b.ndim) if d not in (*over_b, *batch_b)]
        shape = [a.shape[d] for d in (*batch_a, *free_a)] + [b.shape[d] for d in free_b]
        n, m = int(np.prod([a.shape[d] for d in batch_a])), int(np.prod([a.shape[d] for d in over_a]))
        rows = a.transpose(*batch_a, *free_a, *over_a).reshape(n, -1, m)
        columns = b.transpose(*batch_b, *over_b, *free_b).reshape(n, m, -1)
        out = np.zeros((n, rows.shape[1], columns.shape[2]), object)
        for at in itertools.product(*map(range, out.shape)):
            out[at] = sum(x * y for x, y in zip(rows[at[0], at[1]], columns[at[0], :, at[2]], strict=True))
        return out.reshape(shape)

    def _scanned(self, params: Any, operands: list[np.ndarray]) -> list[np.ndarray]:
        a, b = params["num_consts"], params["num_carry"]
        carried, collected = operands[a : a + b], []
        order = range(params["length"])
        for k in reversed(order) if params["reverse"] else order:
            found = self.closed(params["jaxpr"], [*operands[:a], *carried, *(_array(o[k]) for o in operands[a + b :])])
            carried = found[:b]
            collected.append([f.astype(object) for f in found[b:]])
        collected = collected[::-1] if params["reverse"] else collected
        return [*carried, *(np.stack(c) for c in zip(*collected, strict=True))]

    def _refused(self, operation: Operation, more: str) -> ModelError:
        return ModelError(
            f"CasADi has no expression for the JAX primitive '{operation.primitive}'"
            + (f", {more}," if more else "")
            + f"{where_written(operation)}: write the function with other operations of jax.numpy"
        )


def _array(value: Any) -> np.ndarray:
    """A value as an array; NumPy gives entries of arrays of objects as they are."""
    if isinstance(value, np.ndarray | np.generic):
        return np.asarray(value)
    out = np.empty((), object)
    out[()] = value
    return out


def _number(entry: Any) -> Any:
    """A number of Python's, for CasADi takes no others."""
    return entry.item() if isinstance(entry, np.generic) else entry
