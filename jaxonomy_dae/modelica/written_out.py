"""What stands for several, written out: loops of equations, and arrays of variables, entry by entry."""

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from ..base.errors import ModelError
from . import tree

Range = Callable[[tree.Expression | None], list]  # the values of a range, which are known now


def unrolled(statements: tuple[tree.Statement, ...], values_of: Range) -> tuple[tree.Statement, ...]:
    """Equations without loops. `values_of` gives the numbers over which an iterator runs.

    **Raises:**

    - `ModelError` for a range that is not known while the model is read, with the line of the loop.
    """
    return tuple(each for s in statements for each in _without_loops(s, values_of))


def _without_loops(s: tree.Statement, values_of: Range) -> Iterator[tree.Statement]:
    if isinstance(s, tree.Branches):
        yield s._replace(branches=tuple((c, unrolled(body, values_of)) for c, body in s.branches))
    elif isinstance(s, tree.Loop) and s.condition is None:
        (name, over), *more = s.iterators
        inner = s.body if not more else (s._replace(iterators=tuple(more)),)
        try:
            values = values_of(over)
        except ModelError as error:
            raise ModelError(f"line {s.line}: the range of '{name}': {error}") from None
        for value in values:
            yield from unrolled(_with(inner, {name: tree.Number(value)}), values_of)
    else:
        yield s


def entries_of(
    d: tree.Declaration, sizes: Sequence[int], is_array: Callable[[tree.Expression], bool]
) -> Iterator[tree.Declaration]:
    """The declarations of the entries of an array; values and modifiers that are arrays are taken apart."""

    def part(e: tree.Expression, place: tuple[int, ...]) -> tree.Expression:
        for k in place:
            if not isinstance(e, tree.Array):
                return tree.Part(e, None, tuple(map(tree.Number, place))) if is_array(e) else e
            e, place = e.entries[k - 1], place[1:]
        return e

    def of_entry(modifiers: tree.Modifiers, place: tuple[int, ...]) -> tree.Modifiers:
        return {k: of_entry(v, place) if isinstance(v, dict) else part(v, place) for k, v in modifiers.items()}

    if 0 in sizes:  # the empty array is all that there is to know
        yield d._replace(prefixes=frozenset({"constant"}), dimensions=(), value=_empty(sizes))
        return
    for place in itertools.product(*(range(1, n + 1) for n in sizes)):
        yield d._replace(
            name=tree.entry_name(d.name, place), dimensions=(),
            modifiers=of_entry(d.modifiers, place),
            value=None if d.value is None else part(d.value, place),
        )  # fmt: skip


def fields_of(d: tree.Declaration, record: tree.Class) -> Iterator[tree.Declaration]:
    """The declarations of the fields of a variable that is a record. What fields read of each other is what they read
    of this variable."""
    own = {f.name: tree.Reference((d.name, f.name), ((), ())) for f in record.declarations}
    for f in record.declarations:
        modifiers, value = _renamed((f.modifiers, f.value), own)
        given = d.modifiers.get(f.name)
        if isinstance(given, dict):
            modifiers, value = modifiers | given, given.get("=", value)
        elif given is not None:
            value = given
        yield f._replace(
            prefixes=d.prefixes | f.prefixes, name=f"{d.name}.{f.name}", modifiers=modifiers, line=d.line,
            value=value if d.value is None else tree.Part(d.value, f.name, ()),
        )  # fmt: skip


def _renamed(part: Any, names: Mapping[str, tree.Reference]) -> Any:
    """A part of the tree with longer names for some variables."""
    if isinstance(part, dict):
        return {k: _renamed(v, names) for k, v in part.items()}
    if isinstance(part, tree.Reference) and part.parts[0] in names:
        longer, subscripts = names[part.parts[0]], _renamed(part.subscripts, names)
        return tree.Reference((longer.parts[0], *part.parts), ((), *subscripts))
    if isinstance(part, tuple):
        parts = [_renamed(p, names) for p in part]
        return type(part)(*parts) if hasattr(part, "_fields") else tuple(parts)
    return part


def _empty(sizes: Sequence[int]) -> tree.Array:
    return tree.Array((_empty(sizes[1:]),) * sizes[0] if sizes[0] else ())


def _with(part: Any, values: Mapping[str, tree.Number]) -> Any:
    """A part of the tree with numbers for iterators."""
    if isinstance(part, tree.Reference) and part.path in values and not any(part.subscripts):
        return values[part.path]
    if isinstance(part, tree.Comprehension | tree.Loop):
        hidden = {name for name, _ in part.iterators}
        values = {n: v for n, v in values.items() if n not in hidden}
    if isinstance(part, tuple):
        parts = [_with(p, values) for p in part]
        return type(part)(*parts) if hasattr(part, "_fields") else tuple(parts)
    return part
