"""The lines of one function in C: places of its arrays, loops, calls."""

import collections
import contextlib
import itertools
import re
from collections.abc import Iterator, Sequence
from typing import Any, Protocol

import numpy as np

from ..base.errors import ModelError
from .array_operations import ARRAY_OPERATIONS
from .c_function import CFunction
from .c_types import c_type, number
from .elementwise import ELEMENTWISE, Cell
from .straight import (
    CALLS,
    Atom,
    Constant,
    Kind,
    Operation,
    Straight,
    function_of,
    is_uniform,
    known,
    where_written,
)
from .writer import Value

SHORT = 32  # entries: arrays up to this length are local to their function, where compilers keep them in registers
LOCAL = 8192  # bytes that local arrays of one function may take up: targets may have little room on the stack
ALIGNED = 16  # bytes: a multiple of the size of every number
ALIASES = {"reshape", "squeeze", "expand_dims"}  # arrays with the entries of another one, in the same order
# Operations that copy one of the arrays that they read, by its number, and change some entries of it.
IN_PLACE = {
    "scatter": 0, "scatter-add": 0, "scatter_add": 0, "scatter-sub": 0, "scatter-mul": 0, "scatter-min": 0,
    "scatter-max": 0, "dynamic_update_slice": 0, "triangular_solve": 1,
}  # fmt: skip


class File(Protocol):
    """The C file that functions stand in."""

    def table(self, value: np.ndarray) -> str:
        """The name of a constant array."""
        ...

    def use(self, text: str) -> None:
        """Notes which helpers a line calls."""

    def inner(self, program: Any, values: Sequence[Constant | None]) -> CFunction:
        """A program that is called, for these values of its first arguments, as far as they are known."""
        ...


class Body:
    """The lines of one function."""

    def __init__(self, source: File, program: Straight, values: Sequence[Constant | None]):
        self.source, self.program = source, program
        self.lines: list[str] = []
        self.own = self.inner_work = self.local = 0  # bytes in `w`, those of functions called, and local ones
        self._indent = self._now = 0
        self._names = itertools.count()
        self._free: list[tuple[int, int]] = []  # (bytes, offset) of places that nobody reads any more
        self._taken: dict[int, tuple[int, int]] = {}  # by value
        self._alias: dict[int, int] = {}
        self._values: dict[int, Value] = {}
        self._constants: dict[int, Constant] = {}  # what the program closes over
        self._declared: dict[str, int] = {}  # the names of local values, and how often they stand where they are made
        self._inputs: list[str] = []  # the names of arguments
        self._group: list[Operation] = []
        for number_, constant in zip(program.arguments, values, strict=False):
            if constant is not None:
                self._constants[number_] = constant
        self.arguments = [a for a in program.arguments if a not in self._constants]
        self._reads: collections.Counter[int] = collections.Counter()  # how often each value is read
        self._last = self._last_uses()
        for k, argument in enumerate(self.arguments):
            self._inputs.append(f"a{k}")
            self._values[argument] = Value(f"a{k}", program.kinds[argument])
        self._place = self._result_places()

    # --- what the lines are made of --------------------------------------------------------------------------------

    def line(self, text: str) -> None:
        self.source.use(text)
        self.lines.append("  " * self._indent + text)

    def name(self) -> str:
        return f"v{next(self._names)}"

    @contextlib.contextmanager
    def block(self, head: str) -> Iterator[None]:
        """A block of lines in braces."""
        self.line(f"{head} {{")
        self._indent += 1
        yield
        self._indent -= 1
        self.line("}")

    @contextlib.contextmanager
    def loops(self, shape: Sequence[int]) -> Iterator[list[str]]:
        """Nested loops over the indices of a shape."""
        if 0 in shape:  # compilers would see what is inside
            lines, self.lines = self.lines, []
            yield ["0"] * len(shape)
            self.lines = lines
            return
        with contextlib.ExitStack() as stack:
            indices = []
            for n in shape:
                if n == 1:
                    indices.append("0")
                    continue
                i = f"i{next(self._names)}"
                stack.enter_context(self.block(f"for (int {i} = 0; {i} < {n}; ++{i})"))
                indices.append(i)
            yield indices

    def constant(self, constant: Constant) -> Value:
        value = constant.value
        kind = Kind(value.shape, value.dtype)
        if not kind.shape:
            return Value(number(value.item(), kind.dtype), kind, value)
        return Value(self.source.table(value), kind, value)

    def known(self, atom: Atom) -> Constant | None:
        return atom if isinstance(atom, Constant) else self._constants.get(atom)

    def value(self, atom: Atom) -> Value:
        constant = self.known(atom)
        if constant is not None:
            return self.constant(constant)
        assert isinstance(atom, int)
        return self._values[atom]

    def scratch(self, kind: Kind) -> Value:
        """An array, or a scalar that can be assigned, for use on the way; it keeps its place."""
        name = self.name()
        if not kind.shape:
            self.line(f"{c_type(kind.dtype)} {name};")
        else:
            self._declare(name, kind, None)
        return Value(name, kind)

    @contextlib.contextmanager
    def lent(self, kind: Kind) -> Iterator[Value]:
        """An array whose place is free again afterwards."""
        size = -(-max(kind.size, 1) * np.dtype(kind.dtype).itemsize // ALIGNED) * ALIGNED
        name, offset, t = self.name(), self._room(size), c_type(kind.dtype)
        self._declared[name] = 2
        self.line(f"{t} *const {name} = ({t} *)(void *)(w + {offset});")
        yield Value(name, kind)
        self._free.append((size, offset))

    def _declare(self, name: str, kind: Kind, owner: int | None) -> None:
        size = max(kind.size, 1) * np.dtype(kind.dtype).itemsize
        self._declared[name] = 2
        if kind.size <= SHORT and self.local + size <= LOCAL:
            self.local += size
            # Nothing is written into an array without entries, and compilers warn of reading one.
            self.line(f"{c_type(kind.dtype)} {name}[{max(kind.size, 1)}]{'' if kind.size else ' = {0}'};")
            return
        size = -(-size // ALIGNED) * ALIGNED
        offset = self._room(size)
        if owner is not None:
            self._taken[owner] = size, offset
        t = c_type(kind.dtype)
        self.line(f"{t} *const {name} = ({t} *)(void *)(w + {offset});")

    def _room(self, size: int) -> int:
        """The offset of a place of so many bytes: the smallest free one, else a new one."""
        fitting = [place for place in self._free if place[0] >= size]
        if not fitting:
            self.own += size
            return self.own - size
        best = min(fitting)
        self._free.remove(best)
        if best[0] > size:
            self._free.append((best[0] - size, best[1] + size))
        return best[1]

    def call(self, function: CFunction, given: Sequence[str], results: Sequence[str]) -> None:
        """Calls a function; results are pointers. Its room lies behind the room of this function, whose size is known
        at the end: it is a macro until then."""
        self.inner_work = max(self.inner_work, function.work)
        self.line(f"{function.name}({', '.join([*given, *results])}, w + @OWN@);")

    # --- what is read when ------------------------------------------------------------------------------------------

    def _root(self, number_: int) -> int:
        return self._alias.get(number_, number_)

    def _last_uses(self) -> dict[int, int]:
        """For each value, the place of the last operation that reads it, through its aliases."""
        last: dict[int, int] = {}
        operations = self.program.operations
        for k, operation in enumerate(operations):
            reads = [self._root(a) for a in operation.given if isinstance(a, int)]
            if self._begins(operation) is not None:
                assert isinstance(operation.given[0], int)
                self._alias.update(dict.fromkeys(operation.results, self._root(operation.given[0])))
            last.update(dict.fromkeys(reads, k))
            self._reads.update(reads)
        self._reads.update(self._root(a) for a in self.program.results if isinstance(a, int))
        last.update({self._root(a): len(operations) for a in self.program.results if isinstance(a, int)})
        return last

    def _result_places(self) -> dict[int, int]:
        """Arrays that are computed where a result is wanted, so that they need not be copied."""
        computed = {
            r
            for o in self.program.operations
            if o.primitive not in ALIASES and self._begins(o) is None
            for r in o.results
        }
        places: dict[int, int] = {}
        for k, atom in enumerate(self.program.results):
            if isinstance(atom, int) and atom in computed and self.program.kinds[atom].shape:
                places.setdefault(atom, k)
        return places

    def _release(self, now: int) -> None:
        """Frees the places of values that were read last; what the present loop reads stays."""
        waiting = {self._root(a) for o in self._group for a in o.given if isinstance(a, int)}
        for owner in [o for o in self._taken if self._last.get(o, now) <= now and o not in waiting]:
            self._free.append(self._taken.pop(owner))

    # --- writing -----------------------------------------------------------------------------------------------------

    def write(self) -> None:
        """Writes all operations, and the results."""
        for k, operation in enumerate(self.program.operations):
            self._now = k
            self._operation(operation)
            self._release(k)
        self._flush()
        for k, atom in enumerate(self.program.results):
            value, kind = self.value(atom), self.program.kind(atom)
            if not kind.shape:
                self.line(f"*o{k} = {value.text};")
            elif self._place.get(atom if isinstance(atom, int) else -1) != k:
                if kind.size:
                    self.line(f"memcpy(o{k}, {value.text}, {kind.size} * sizeof *o{k});")
                else:
                    self.line(f"(void)o{k};")
            elif not kind.size:
                self.line(f"(void)o{k};")
        used = collections.Counter(words("\n".join(self.lines)))
        self.lines = [line.replace("w + @OWN@", f"w + {self.own}" if self.own else "w") for line in self.lines]
        quiet = [name for name in (*self._inputs, "w") if name not in used]
        quiet += [name for name, n in self._declared.items() if used[name] <= n]  # what reads them is empty
        self.lines += [f"(void){name};" for name in quiet]

    @property
    def work(self) -> int:
        return self.own + self.inner_work

    def _operation(self, operation: Operation) -> None:
        name, kinds = operation.primitive, [self.program.kinds[r] for r in operation.results]
        pending = {r for o in self._group for r in o.results}
        reads_pending = any(isinstance(a, int) and self._root(a) in pending for a in operation.given)
        picks = self._picks(operation)
        if self._is_entrywise(operation) or picks is not None:
            if picks is not None and reads_pending:
                self._flush()
            if not kinds[0].shape:
                if picks is None:
                    text = self._cell(operation, [self.value(a).text for a in operation.given])
                else:
                    text = self.value(operation.given[0]).at(str(int(picks)))
                self._scalar(operation.results[0], kinds[0], text)
                return
            if self._group and self.program.kinds[self._group[0].results[0]].shape != kinds[0].shape:
                self._flush()
            self._group.append(operation)
            return
        if reads_pending:
            self._flush()
        if name in ALIASES:
            given = self.value(operation.given[0])
            self._alias_of(operation.results[0], given, kinds[0])
            return
        begins = self._begins(operation)
        if begins is not None:
            given = self.value(operation.given[0])
            for result, begin, kind in zip(operation.results, begins, kinds, strict=True):
                text = f"({given.text} + {begin})" if begin and kind.shape else given.text
                self._values[result] = Value(text if kind.shape else f"{given.text}[{begin}]", kind)
            return
        self._other(operation, kinds)

    def _begins(self, operation: Operation) -> list[int] | None:
        """For results whose entries stand together in what the operation reads first: where each of them begins. They
        have no place of their own."""
        if (
            not isinstance(operation.given[0] if operation.given else None, int)
            or operation.given[0] in self._constants
        ):
            return None
        name, params, shape = operation.primitive, operation.params, self.program.kind(operation.given[0]).shape
        if name in ALIASES:
            return [0]
        kinds = [self.program.kinds[r] for r in operation.results]
        if name == "slice":
            if any(step != 1 for step in params["strides"] or ()) or shape[1:] != kinds[0].shape[1:] or 0 in shape:
                return None
            return [params["start_indices"][0] * int(np.prod(shape[1:], dtype=int))]
        if name in ("split", "unstack") and all(n == 1 for n in shape[: params["axis"]]) and 0 not in shape:
            sizes = [kind.size for kind in kinds]
            return [sum(sizes[:k]) for k in range(len(sizes))]
        return None

    def _alias_of(self, result: int, given: Value, kind: Kind) -> None:
        if bool(given.kind.shape) == bool(kind.shape):
            self._values[result] = Value(given.text, kind)
        elif kind.shape:  # one entry that was a scalar
            name = self.name()
            self.line(f"const {c_type(kind.dtype)} {name}[1] = {{{given.text}}};")
            self._declared[name] = 1
            self._values[result] = Value(name, kind)
        else:
            self._values[result] = Value(f"{given.text}[0]", kind)

    def _scalar(self, result: int, kind: Kind, text: str) -> None:
        name = self.name()
        self.line(f"const {c_type(kind.dtype)} {name} = {text};")
        self._declared[name] = 1
        self._values[result] = Value(name, kind)

    def _picks(self, operation: Operation) -> np.ndarray | None:
        """For a gather that picks single entries at known places, and for a slice of a vector: their numbers in the
        shape of the result."""
        if operation.primitive == "slice":
            (begin, *others), (end, *_) = operation.params["start_indices"], operation.params["limit_indices"]
            step = (operation.params["strides"] or (1,))[0]
            return None if others or end <= begin or self._begins(operation) else np.arange(begin, end, step)
        if operation.primitive != "gather":
            return None
        places, numbers = self.known(operation.given[1]), operation.params["dimension_numbers"]
        shape, sizes = self.program.kind(operation.given[0]).shape, operation.params["slice_sizes"]
        whole = tuple(range(len(shape)))
        if places is None or numbers.collapsed_slice_dims != whole or numbers.start_index_map != whole or not shape:
            return None
        if any(n != 1 for n in sizes) or not places.value.size:
            return None
        inside = (places.value >= 0) & (places.value < np.array(shape))
        if not inside.all():
            return None
        return np.asarray(np.ravel_multi_index(tuple(np.moveaxis(places.value, -1, 0)), shape))

    def _picked(self, operation: Operation, picks: np.ndarray) -> str:
        """The entry that a gather picks in the loop over i."""
        source, flat = self.value(operation.given[0]), picks.ravel()
        step = int(flat[1] - flat[0]) if len(flat) > 1 else 0
        if (np.diff(flat) == step).all():
            place = f"{int(flat[0])} + i * {step}" if step != 1 else f"{int(flat[0])} + i"
            return source.at(place if step else str(int(flat[0])))
        return source.at(f"{self.source.table(flat.astype(np.int32))}[i]")

    def _is_entrywise(self, operation: Operation) -> bool:
        """True for operations entry by entry, and for those that repeat a scalar."""
        if operation.primitive in ELEMENTWISE:
            return True
        if operation.primitive != "broadcast_in_dim":
            return False
        return not self.program.kind(operation.given[0]).shape

    def _cell(self, operation: Operation, given: Sequence[str]) -> str:
        """The expression of one entry."""
        out = self.program.kinds[operation.results[0]].dtype
        if operation.primitive == "broadcast_in_dim":
            return given[0]
        types = [np.dtype(self.program.kind(a).dtype) for a in operation.given]
        try:
            return ELEMENTWISE[operation.primitive](Cell(given, types, np.dtype(out), operation.params))
        except (KeyError, NotImplementedError):
            raise self._refused(operation) from None

    def _refused(self, operation: Operation) -> ModelError:
        what = operation.primitive
        if "callback" in what or what in ("ffi_call", "infeed", "outfeed"):
            return ModelError(
                f"a function of this model calls the host (JAX primitive '{what}'){where_written(operation)}, which C "
                "code cannot: write it with jax.numpy"
            )
        return ModelError(
            f"there is no C code for the JAX primitive '{what}'{where_written(operation)}: write the function with "
            "other operations of jax.numpy"
        )

    def _flush(self) -> None:
        """Writes the loop of the operations entry by entry that have been put off."""
        group, self._group = self._group, []
        if not group:
            return
        inner_reads = collections.Counter(self._root(a) for o in group for a in o.given if isinstance(a, int))
        kind = self.program.kinds[group[0].results[0]]
        stored = {}
        for operation in group:
            (result,) = operation.results
            if self._reads[result] > inner_reads[result]:  # others read it, too
                stored[result] = self._result(result)
        if not kind.size:
            return
        inside: dict[int, str] = {}

        def entry(atom: Atom) -> str:
            if isinstance(atom, int) and atom in inside:
                return inside[atom]
            constant = self.known(atom)
            if constant is not None and is_uniform(constant.value):
                return number(constant.value.ravel()[0], constant.value.dtype)  # no table of equal numbers
            value = self.value(atom)
            return value.at(_repeated("i", value.kind.shape, kind.shape))

        with self.block(f"for (int i = 0; i < {kind.size}; ++i)"):
            for operation in group:
                (result,) = operation.results
                own = self.program.kinds[result]
                picks = self._picks(operation)
                if picks is not None:
                    text = self._picked(operation, picks)
                else:
                    text = self._cell(operation, [entry(a) for a in operation.given])
                inside[result] = name = self.name()
                self.line(f"const {c_type(own.dtype)} {name} = {text};")
                if result in stored:
                    self.line(f"{stored[result].text}[i] = {name};")

    def _taken_over(self, operation: Operation) -> Value | None:
        """For an operation that changes some entries of an array: this array, if nobody reads it afterwards."""
        (result, *others), given = operation.results, operation.given[IN_PLACE[operation.primitive]]
        if others or result in self._place or not isinstance(given, int) or given in self._constants:
            return None
        root, value, kind = self._root(given), self._values[given], self.program.kinds[result]
        read = [self._root(a) for a in operation.given if isinstance(a, int)]
        read += [self._root(a) for o in self._group for a in o.given if isinstance(a, int)]
        if self._last.get(root) != self._now or read.count(root) > 1 or value.text not in self._declared:
            return None
        if kind.size != self.program.kinds[root].size or not kind.shape or value.text.startswith("o"):
            return None
        if root in self._taken:
            self._taken[result] = self._taken.pop(root)
        self._values[result] = found = Value(value.text, kind)
        return found

    def _result(self, result: int) -> Value:
        """A place for a value that is computed."""
        kind = self.program.kinds[result]
        if result in self._place:
            value = Value(f"o{self._place[result]}", kind)
        else:
            name = self.name()
            if kind.shape:
                self._declare(name, kind, result)
            else:
                self.line(f"{c_type(kind.dtype)} {name};")
            value = Value(name, kind)
        self._values[result] = value
        return value

    def _other(self, operation: Operation, kinds: Sequence[Kind]) -> None:
        """Calls of functions, and operations that are more than one entry."""
        name = operation.primitive
        if name not in CALLS and name not in ARRAY_OPERATIONS:
            raise self._refused(operation)
        given = [self.value(a) for a in operation.given]
        results = [self._taken_over(operation)] if name in IN_PLACE else []
        results = [r for r in results if r] or [self._result(r) for r in operation.results]
        if name in CALLS:
            program, closed = function_of(operation)
            self.apply(program, closed, given, results)
        else:
            try:
                ARRAY_OPERATIONS[name](self, operation.params, given, results)
            except NotImplementedError:
                raise self._refused(operation) from None
        self._declared |= {v.text: 2 for r, v in zip(operation.results, results, strict=True) if r not in self._place}

    def apply(self, program: Any, closed: Sequence[Any], given: Sequence[Value], results: Sequence[Value]) -> None:
        """Calls a program with what it closes over and values. What it closes over is part of what is called, and so
        are arrays and integers that are known: code that is made for them is shorter than code for any."""
        values = [*map(known, closed), *map(_part_of_what_is_called, given)]
        passed = [v.text for v, value in zip(given, values[len(closed) :], strict=True) if value is None]
        self.call(self.source.inner(program, values), passed, [v.pointer for v in results])

    def apply_closed(self, program: Any, given: Sequence[Value], results: Sequence[Value]) -> None:
        """Calls a closed program with values."""
        self.apply(program.jaxpr, program.consts, given, results)


def _part_of_what_is_called(value: Value) -> Constant | None:
    """What is known of a value: nothing of numbers of floating point, with others of which a function may be called."""
    found = value.known
    return None if found is None or (not found.ndim and found.dtype.kind == "f") else Constant(found)


def _repeated(i: str, own: Sequence[int], shape: Sequence[int]) -> str:
    """The number of the entry that stands for entry i of a shape, along whose axes an array may have one entry only."""
    if tuple(own) == tuple(shape) or not own:
        return i
    terms, inner, own_inner, total = [], 1, 1, int(np.prod(shape))
    for n, m in zip(reversed(shape), reversed(own), strict=True):
        if m != 1:
            digit = i if inner == 1 else f"{i} / {inner}"
            digit = digit if inner * n == total else f"{digit} % {n}"
            terms.append(digit if own_inner == 1 else f"{digit} * {own_inner}")
        inner, own_inner = inner * n, own_inner * m
    return " + ".join(terms) or "0"


def words(text: str) -> list[str]:
    return re.findall(r"[A-Za-z_]\w*", text)
