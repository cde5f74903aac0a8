"""Parameters: one flat array with names."""

import dataclasses
import functools
import html
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ...base.errors import ModelError, nearest
from ...compile.model.array_names import ArrayNames
from ...compile.model.names import Names
from ...compile.model.starts import Formulas
from ...compile.model.tables import complete
from ...host.cache import compiled
from ...host.staging import is_staged, is_traced, on_device, picked
from ...write.interval import Interval, closed_ends
from ...write.real_number import is_unknown_to_jax, real_number
from .bounds import Ends
from .sections import HTML_SHOWN, SHOWN


@dataclasses.dataclass(frozen=True)
class ParameterNames:
    """The name table: static, compared by its digest."""

    names: Names = dataclasses.field(compare=False, hash=False)
    units: list[str] = dataclasses.field(compare=False, hash=False)
    intervals: list[Interval] = dataclasses.field(compare=False, hash=False)
    dependents: tuple[Formulas, ...] = dataclasses.field(compare=False, hash=False)
    expressions: dict[int, str] = dataclasses.field(compare=False, hash=False)
    arrays: ArrayNames = dataclasses.field(default_factory=ArrayNames, compare=False, hash=False)
    digest: str = ""

    def __content__(self) -> tuple[str, tuple]:
        """For `host/content.py`."""
        return self.digest, ()

    def index(self, name: str) -> int:
        found = self.names.number.get(name)
        if found is None:
            raise ModelError(f"'{name}' is not a parameter: " + nearest(name, self.names))
        return found

    def entries(self, name: str) -> np.ndarray | None:
        """The indices of the parameters behind the name of an array, in its shape; None if it is not that of one."""
        return None if name in self.names else self.arrays.parameters(name)

    def one_by_one(self, name: str) -> list[str]:
        """The names of the entries of an array of parameters; the name itself if it is not that of one."""
        found = self.entries(name)
        return [name] if found is None else [self.names[k] for k in found.ravel().tolist()]

    def settable(self, name: str) -> int:
        """The index of a parameter that does not depend on others."""
        k = self.index(name)
        if k in self.expressions:
            roots = " or ".join(f"'{self.names[p]}'" for p in self._roots(k))
            raise ModelError(
                f"parameter '{name}' is {self.expressions[k]}, computed from others: set or train {roots} instead"
            )
        return k

    def _roots(self, k: int) -> list[int]:
        """The settable parameters from which a dependent one is computed in the end."""
        found, waiting = set(), [k]
        while waiting:
            k = waiting.pop()
            if k in self.expressions:
                waiting.extend(int(p) for g in self.dependents for p in g.parameter[g.target == k].ravel())
            else:
                found.add(k)
        return sorted(found)

    def complete(self, array: Any) -> Any:
        """All values, shape (*batch, n), with the dependent ones computed from the others: by NumPy where they are
        known."""
        if not self.dependents or isinstance(array, np.ndarray) or is_staged(array):
            return complete(self.dependents, array)
        if is_traced(array):
            return _completed(self, array)
        return on_device(complete(self.dependents, np.array(array)))

    def given(self, chosen: np.ndarray) -> "ParameterNames":
        """A copy of the table in which these parameters are given even where they were computed from others."""
        if not any(int(k) in self.expressions for k in chosen):
            return self
        dependents = tuple(
            group.take(rows) for group in self.dependents if (rows := ~np.isin(group.target, chosen)).any()
        )
        expressions = {k: text for k, text in self.expressions.items() if k not in chosen}
        # The digest alone tells tables apart, so it must say what was taken out.
        digest = f"{self.digest} given {list(map(int, chosen))}"
        return dataclasses.replace(self, dependents=dependents, expressions=expressions, digest=digest)

    @functools.cached_property
    def bounds(self) -> Float[np.ndarray, "n 2"]:
        """The least and the greatest admissible value of each parameter."""
        return closed_ends(self.intervals)

    @functools.cached_property
    def ends(self) -> Ends:
        """The bounds of each parameter, shape (n,)."""
        return Ends.of(self.intervals)

    def check(self, entries: np.ndarray, values: Float[np.ndarray, "*batch"]) -> None:
        """Checks values of parameters at indices, in whose shape their trailing axes are.

        **Raises:**

        - `ModelError` for the first one that is not finite, or out of its bounds.
        """
        numbers = np.broadcast_to(values, np.broadcast_shapes(values.shape, entries.shape))
        wrong = np.argwhere(~self.ends.take(entries).admit(numbers))
        if len(wrong):
            k = int(np.broadcast_to(entries, numbers.shape)[tuple(wrong[0])])
            got = numbers[tuple(wrong[0])]
            raise ModelError(f"parameter '{self.names[k]}' must lie in {self.intervals[k]}; got {got:g}")

    def chosen(self, names: Iterable[str]) -> dict[str, np.ndarray]:
        """The indices of parameters that can be set, by their names and those of arrays, in the arrays' shapes.

        **Raises:**

        - `ModelError` for an unknown name, one that is computed from others, and one that is given twice.
        """
        seen: set[int] = set()
        out = {}
        for name in names:
            entries = self.entries(name)
            if entries is None:
                entries = np.array(self.index(name))
            members = entries.ravel().tolist()
            if not seen.isdisjoint(members):
                twice = self.names[min(seen.intersection(members))]
                raise ModelError(f"parameter '{twice}' is given twice, by its own name and as part of an array")
            seen.update(members)
            for k in members:
                self.settable(self.names[k])
            out[name] = entries
        return out


class Parameters(eqx.Module):
    """All parameters of a system: `parameters["pend.m"]`; `parameters.array` has shape `(len(parameters),)`.

    `free` holds the values of parameters that `AcausalSystem.partition` took apart to be trained; they override the
    entries of `values` at `free_index`. Those that lie out of their bounds are read as not-a-number. In a batch of
    systems, shapes get its axes in front.
    """

    values: Float[Array, "*batch n"]
    free: Float[Array, "*batch k"] | None
    free_index: tuple[int, ...] = eqx.field(static=True)
    table: ParameterNames = eqx.field(static=True)

    @property
    def array(self) -> Float[Array, "*batch n"]:
        """All values, in the order of `names`."""
        if self.free is None or not self.free_index:
            return self.table.complete(self.values)
        batch = jnp.broadcast_shapes(self.values.shape[:-1], self.free.shape[:-1])
        values = jnp.broadcast_to(self.values, (*batch, self.values.shape[-1]))
        chosen = np.array(self.free_index)
        return self.table.complete(values.at[..., chosen].set(_inside(self.free, self.table.ends.take(chosen))))

    @property
    def known(self) -> Float[np.ndarray, " n"] | None:
        """All values of one system, outside jit; None of a batch, and of what holds only some of them."""
        return None if self.batch else self._as_given()

    def _as_given(self) -> Float[np.ndarray, "*batch n"] | None:
        """All values as they are given, not as they are read, outside jit; None of what holds only some of them."""
        parts = [self.values, self.free] if self.free_index else [self.values]
        if not all(_is_array(part) and not is_traced(part) for part in parts):
            return None
        values = np.array(self.values)
        if self.free_index:
            free = np.asarray(self.free)
            values = np.array(np.broadcast_to(values, (*free.shape[:-1], values.shape[-1])))
            values[..., list(self.free_index)] = free
        return self.table.complete(values)

    @property
    def names(self) -> list[str]:
        """The parameters' names."""
        return list(self.table.names)

    def __getitem__(self, name: str) -> Any:
        entries = self.table.entries(name)
        if entries is not None:
            if not self.free_index:
                return picked(self.array, (..., entries))
            # One by one: entries of an array may stand in either part, and may be computed from others.
            parts = [self[self.table.names[k]] for k in entries.ravel().tolist()]
            return jnp.stack(parts, axis=-1).reshape(*parts[0].shape, *entries.shape)
        k = self.table.index(name)
        if k in self.table.expressions:
            if self.values is None or (self.free_index and self.free is None):
                raise ModelError(
                    f"parameter '{name}' is {self.table.expressions[k]}, which a part of a partitioned system cannot "
                    "compute: join both with equinox.combine"
                )
            return picked(self.array, (..., k))
        if k in self.free_index:
            part, place = self.free, self.free_index.index(k)
        else:
            part, place = self.values, k
        if part is None:
            raise ModelError(
                f"parameter '{name}' is in the other part of a partitioned system: join both with equinox.combine"
            )
        return picked(part, (..., place))

    def __contains__(self, name: object) -> bool:
        return isinstance(name, str) and (name in self.table.names or self.table.entries(name) is not None)

    def __iter__(self) -> Iterator[str]:
        return iter(self.table.names)

    def __len__(self) -> int:
        return len(self.table.names)

    def items(self) -> list[tuple[str, Any]]:
        """Pairs of name and value."""
        array = self.array
        return [(name, picked(array, (..., k))) for k, name in enumerate(self.table.names)]

    def merged(self) -> "Parameters":
        """The values with nothing set apart."""
        return Parameters(self.array, None, (), self.table)

    def settled(self) -> "Parameters":
        """The values with nothing set apart, and none that is computed from others: for a program that sets none, and
        would compute these wherever it reads one."""
        computed = np.array(sorted(self.table.expressions), np.int64)
        return Parameters(self.array, None, (), self.table.given(computed))

    def freed(self, names: tuple[str, ...]) -> "Parameters":
        """The values with the named ones set apart in `free`."""
        index = tuple(dict.fromkeys(self.table.settable(n) for name in names for n in self.table.one_by_one(name)))
        if not index:
            return self.merged()
        array = self.array
        return Parameters(array, array[..., np.array(index)], index, self.table)

    def replaced(self, new: Mapping[str, Any]) -> "Parameters":
        """The parameters with new values, which may be tracers; a batch takes one value for all or one for each.

        **Raises:**

        - `ModelError` for an unknown name, a parameter that is an expression in others, or a value of the wrong shape,
            that is not a finite real number, or is out of the bounds. Traced values out of their bounds become
            not-a-number.
        """
        if not isinstance(new, Mapping):
            raise ModelError(f"parameters are given by names, {{'m.k': 2.0}}; got {type(new).__name__}")
        array = self.array
        batch = array.shape[:-1]
        chosen = self.table.chosen(new)
        given: dict[str, Any] = {}
        for name, entries in chosen.items():
            value = new[name]
            if entries.ndim:
                value = np.asarray(value) if isinstance(value, list | tuple) else value
                value = self._checked_array(name, entries, value, batch)
            else:
                value = self._checked(int(entries), value, batch)
            given[name] = value
        # Inside of jit the operations join the program around them. Under `grad` and `vmap` alone JAX would run them
        # one by one, so they are a program. Values that are known are set by NumPy.
        if is_staged((array, given)):
            array = _with_values(self.table, array, given)
        elif is_traced((array, given)):
            # Numbers go as arrays: as Python numbers, each value would make a program of its own.
            array = _set(self.table, array, {n: v if is_traced(v) else on_device(v) for n, v in given.items()})
        else:
            array = np.array(array)
            for name, value in given.items():
                array[..., chosen[name]] = np.asarray(value)
            array = on_device(complete(self.table.dependents, array))
        changed = Parameters(array, None, (), self.table)
        problem = changed.problem
        if problem is not None:
            raise ModelError(problem)
        return changed

    @property
    def are_admitted(self) -> Bool[Array, "*batch"]:
        """True if all values are finite and within their bounds."""
        return jnp.all(self.table.ends.admit(self.array), axis=-1)

    @property
    def problem(self) -> str | None:
        """The first parameter that is not finite or out of its bounds, in words; None if all are right, and of values
        that are not known."""
        values = self._as_given()
        if values is None:
            return None
        right = self.table.ends.admit(values)
        if right.all():
            return None
        k = int(np.argmin(right.reshape(-1, right.shape[-1]).all(axis=0)))
        name, text, interval = self.table.names[k], self.table.expressions.get(k), self.table.intervals[k]
        found = _text(values[..., k])
        if text is not None:
            return f"parameter '{name}' is {text} and must lie in {interval}; got {found}"
        if not np.isfinite(values[..., k]).all():
            return f"parameter '{name}' is not finite: {found}. Set it with system.with_parameters"
        return f"parameter '{name}' must lie in {interval}; got {found}. Set it with system.with_parameters"

    def _checked(self, k: int, value: Any, batch: tuple[int, ...]) -> Any:
        name = self.table.names[k]
        where = f"parameter '{name}'"
        if is_unknown_to_jax(value):
            value = real_number(value, where)
        shape = jnp.shape(value)
        if batch and shape not in ((), batch):
            raise ModelError(f"{where} needs a scalar or, in this batch of systems, shape {batch}; got shape {shape}")
        if not batch and shape:
            raise ModelError(
                f"{where} is a scalar; got shape {shape}. For a batch of systems, use "
                f"equinox.filter_vmap(lambda v: system.with_parameters({{'{name}': v}}))(values)"
            )
        if jnp.issubdtype(jnp.result_type(value), jnp.complexfloating):
            raise ModelError(f"{where} must be a real number; got the complex number {value}")
        if is_traced(value):
            return value
        numbers = np.array([real_number(number, where) for number in np.ravel(np.asarray(value))])
        self.table.check(np.array(k), self._as_kept(numbers))
        return value

    def _checked_array(self, name: str, entries: np.ndarray, value: Any, batch: tuple[int, ...]) -> Any:
        """The values of an array of parameters: a number for all of them, or an array of their shape."""
        shape, where = np.shape(value), f"parameter '{name}'"
        if isinstance(value, str) or shape not in ((), entries.shape, (*batch, *entries.shape)):
            found = repr(value) if isinstance(value, str) else f"shape {shape}"
            raise ModelError(f"{where} is an array of shape {entries.shape}: give a number or that shape; got {found}")
        if jnp.issubdtype(jnp.result_type(value), jnp.complexfloating):
            raise ModelError(f"{where} must be real; got {jnp.result_type(value)}")
        if is_traced(value):
            return value
        self.table.check(entries, self._as_kept(np.asarray(value)))
        return value

    def _as_kept(self, numbers: np.ndarray) -> np.ndarray:
        """Numbers in the precision of all values: in single precision, the end of an interval is the number next to
        it."""
        with np.errstate(over="ignore"):  # said as infinite
            return numbers.astype(self.values.dtype)

    @property
    def batch(self) -> tuple[int, ...]:
        """The shape of a batch of systems; () for one, and for what holds no values."""
        shapes = [leaf.shape[:-1] for leaf in (self.values, self.free) if leaf is not None and _is_array(leaf)]
        return shapes[0] if shapes else ()

    def _repr_html_(self) -> str:
        """A table for notebooks: names, values, units, admissible values, and what dependent ones are computed from."""
        if self.values is None or self.free_index and self.free is None or not _is_array(self.values):
            return f"<code>{html.escape(repr(self))}</code>"
        rows = []
        for k, (name, value) in enumerate(self.items()[:HTML_SHOWN]):
            interval, text = self.table.intervals[k], self.table.expressions.get(k, "")
            bounds = "" if interval == Interval() else str(interval)
            cells = (name, _text(value), self.table.units[k], bounds, text and f"= {text}")
            rows.append("<tr>" + "".join(f"<td>{html.escape(c)}</td>" for c in cells) + "</tr>")
        more = f"<p>… and {len(self) - HTML_SHOWN} more</p>" if len(self) > HTML_SHOWN else ""
        head = "".join(f"<th>{h}</th>" for h in ("parameter", "value", "unit", "bounds", "depends on"))
        return f"<table><tr>{head}</tr>{''.join(rows)}</table>{more}"

    def __repr__(self):
        if not _is_array(self.values):  # the trained part of a partitioned system, or a mask
            if self.free is None or not _is_array(self.free):
                return f"Parameters({len(self)} names, no values)"
            shown = [f"{self.table.names[k]}={_text(self.free[..., j])}" for j, k in enumerate(self.free_index)]
            return f"Parameters({_some(shown)}; the others are in the frozen part)"
        apart: dict[int, str] = {}
        array = self.values
        if self.free_index and not _is_array(self.free):  # the frozen part
            apart = {k: "not known here" for k in self.table.expressions} | {k: "set apart" for k in self.free_index}
        else:
            array = self.array
        shown = [f"{name}={apart.get(k) or _text(array[..., k])}" for k, name in enumerate(self.table.names[:SHOWN])]
        batch = f"batch of shape {array.shape[:-1]}: " if array.ndim > 1 else ""
        return f"Parameters({batch}{_some(shown, len(self))})"


def _with_values(table: ParameterNames, array: Any, given: Mapping[str, Any]) -> Any:
    """All values with those given, where some are traced: what is out of its bounds becomes not-a-number."""
    for name, entries in table.chosen(given).items():
        value = jnp.asarray(given[name], array.dtype)
        if is_traced(value):
            value = _inside(value, table.ends.take(entries))
        array = array.at[..., entries].set(value)
    array = complete(table.dependents, array)
    if is_traced(array):
        chosen = np.array(list(table.expressions), np.int64)
        ends = table.ends.take(chosen)
        array = array if ends.are_none else array.at[..., chosen].set(_inside(array[..., chosen], ends))
    return array


@compiled
def _set(table: ParameterNames, array: Any, given: dict[str, Any]) -> Any:
    """`_with_values` under `jax.grad` and `jax.vmap` outside of jit: one program."""
    return _with_values(table, array, given)


@compiled
def _completed(table: ParameterNames, array: Any) -> Any:
    return complete(table.dependents, array)


def _inside(values: Any, ends: Ends) -> Any:
    """The values, with not-a-number for those out of their bounds, and so for the derivatives of what reads them."""
    # A sum: where the result does not count, its cotangent is zero, and derivatives by other values are not touched.
    return values if ends.are_none else values + jnp.where(ends.admit(values), 0.0, jnp.nan)


def _is_array(leaf: Any) -> bool:
    return eqx.is_array(leaf)


def _text(value: Any) -> str:
    if is_traced(value):
        return str(value)
    return f"{float(value):g}" if np.ndim(value) == 0 else np.array2string(np.asarray(value), threshold=6, precision=6)


def _some(shown: list[str], count: int | None = None) -> str:
    more = ", …" if (count or len(shown)) > SHOWN else ""
    return ", ".join(shown[:SHOWN]) + more
