"""Expressions, conditions and functions in the dictionary of rumoca, as parts of a syntax tree.

Expressions are numbered; their operands and subscripts stand in lists of their own, in the order of the expressions.
"""

import bisect
import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NoReturn

from ..base.errors import ModelError
from . import tree

Places = Mapping[tuple[int, int], int]  # the value of a domain's binder, by the numbers of the domain and the binder
Json = Mapping[str, Any]


_BINARY = {
    "add": "+", "subtract": "-", "multiply": "*", "divide": "/", "power": "^",
    "elementwise_add": ".+", "elementwise_subtract": ".-", "elementwise_multiply": ".*", "elementwise_divide": "./",
    "elementwise_power": ".^", "equal": "==", "not_equal": "<>", "less": "<", "less_equal": "<=", "greater": ">",
    "greater_equal": ">=", "and": "and", "or": "or",
}  # fmt: skip
_BUILTIN = {"no_event": "noEvent", "outer_product": "outerProduct", "semi_linear": "semiLinear"}
SCALAR = {"real": "Real", "integer": "Integer", "boolean": "Boolean", "string": "String", "enumeration": "Integer"}
PREFIX = {"parameter", "constant", "input", "output"}
VARIABLE = PREFIX | {"state", "algebraic", "discrete_real", "discrete_value"}
# A quotient of a model's variables takes the numbers of seven expressions: its value, and six for its jumps, which the
# dictionary leaves out.
_NUMBERS_OF_QUOTIENT = 7


class RumocaExpressions:
    """What the numbers of a dictionary stand for.

    - `storage`: the dictionary's lists.
    - `variables`, `types`: those of the model.
    """

    def __init__(self, dae: Json, name: str):
        self.name = name
        self.lines = _Lines(dae.get("source_map") or {})
        s = self.storage = dae["storage"]
        self.variables: Sequence[Json] = s["variables"]
        self.types: Sequence[Json] = s["value_types"]
        self.functions: Sequence[Json] = s["functions"]
        self.operands: Sequence[int] = s["expressions"]["operands"]
        self.subscripts: Sequence[Json] = s["expressions"]["subscripts"]
        provenance = s["expressions"].get("provenance") or ()
        self.nodes: dict[int, tuple[str, Any, int, Json]] = {}  # (kind, contents, first operand or subscript, where)
        number = operand = subscript = 0
        for node, where in itertools.zip_longest(s["expressions"]["nodes"], provenance):
            kind, inside = next(iter(node.items()))
            count = inside if isinstance(inside, Mapping) else {}
            of_subscripts = "subscript_count" in count
            self.nodes[number] = kind, inside, subscript if of_subscripts else operand, where or {}
            operand += count.get("operand_count", 0)
            subscript += count.get("subscript_count", 0)
            number += _NUMBERS_OF_QUOTIENT if kind == "runtime_quotient_owner" and "model" in count["kind"] else 1

    def classes(self) -> list[tree.Class]:
        """The records and functions of the model; each result of a function is a function of its own."""
        records = [self._record(t) for t in self.types if t["scalar"] == "record"]
        functions = ((k, o) for k, f in enumerate(self.functions) for o in range(len(f["outputs"])))
        return records + [self._function(k, o) for k, o in functions]

    def _record(self, of: Json) -> tree.Class:
        fields = [(f["name"], self.types[f["value_type"]]) for f in of["record_fields"]]
        declared = [_declared(frozenset(), n, t) for n, t in fields]
        return tree.Class("record", of["record_name"], tuple(declared))

    def binders(self, domain: int) -> list[tuple[tuple[int, int], range]]:
        """The binders of a domain and of those around it, with their values."""
        of = self.storage["domains"][domain]
        outer = [] if of.get("parent") is None else self.binders(of["parent"])
        own = enumerate(of["domain"]["binders"])
        return outer + [((domain, k), _values(b)) for k, b in own]

    def condition(self, number: int) -> tree.Expression:
        entry = self.storage["conditions"][number]
        node = entry["node"]
        if node == "initial":
            return tree.Call("initial", (), ())
        if node == "always":
            return tree.Truth(True)
        if not isinstance(node, Mapping):
            self.refuse(f"the condition '{node}'", entry.get("provenance"))
        kind, inside = next(iter(node.items()))
        if kind == "relation":
            return self.expression(self.storage["relations"][inside]["relation"]["expression"], {})
        if kind == "discrete":
            return self.expression(inside, {})
        if kind == "clock":
            return self.clock(inside)
        if kind == "not":
            return tree.Unary("not", self.condition(inside))
        if kind in ("and", "or"):
            return tree.Binary(kind, self.condition(inside["lhs"]), self.condition(inside["rhs"]))
        if kind == "any_rise":
            parts = [self.condition(inside[side]) for side in ("lhs", "rhs")]
            return tree.Array(tuple(p for e in parts for p in (e.entries if isinstance(e, tree.Array) else (e,))))
        self.refuse(f"a condition of the kind '{kind}'", entry.get("provenance"))

    def clock(self, number: int) -> tree.Call:
        """The condition that a clock ticks."""
        clock = self.storage["clocks"][number]
        lattice = clock["kind"].get("periodic", {}).get("lattice")
        if lattice is None:
            self.refuse(f"a clock of the kind '{next(iter(clock['kind']))}'", clock.get("provenance"))
        phase, period = (tree.Number(lattice[k]["num"] / lattice[k]["den"]) for k in ("phase", "period"))
        return tree.Call("sample", (phase, period), ())

    def interval(self, number: int) -> tree.Expression:
        """The seconds between two ticks of a clock."""
        return self.clock(number).arguments[1]

    # --- expressions -------------------------------------------------------------------------------------------------

    def variable(self, number: int, subscripts: tuple[tree.Expression, ...] = ()) -> tree.Reference:
        return tree.Reference((self.variables[number]["name"],), (subscripts,))

    def expression(self, number: int, places: Places) -> tree.Expression:
        if number not in self.nodes:
            raise ModelError(f"{self.name}: the dictionary has no expression {number}, but reads it")
        kind, inside, first, where = self.nodes[number]
        if kind == "literal":
            return _literal(inside)
        if kind == "coordinate":
            return self._coordinate(inside, (), places, where)
        if kind == "unary":
            e = self.expression(inside["operand"], places)
            return (
                e
                if inside["operator"] == "plus"
                else _negated(e)
                if inside["operator"] == "negate"
                else tree.Unary("not", e)
            )
        if kind == "binary":
            sides = (self.expression(inside["lhs"], places), self.expression(inside["rhs"], places))
            return _change(tree.Binary(_BINARY[inside["operator"]], *sides))
        if kind == "index":
            return self._indexed(inside, first, places)
        if kind == "comprehension":
            # The domain around it is that of a loop, or of the array that the whole equation is about.
            own = [(key, values) for key, values in self.binders(inside["domain"]) if key[0] == inside["domain"]]
            names = [b["display_name"] for b in self.storage["domains"][inside["domain"]]["domain"]["binders"]]
            # rumoca lets the first iterator count the rows: the last one does (section 10.4.1.1). What it writes itself
            # for arrays has their order.
            if not all(name.startswith(("__", "vectorized_call_")) for name in names):
                own.reverse()
            return self._comprehended(own, inside["body"], places)
        if kind == "field":
            field = self.types[self._record_type(inside["base"])]["record_fields"][inside["field"]]["name"]
            return tree.Part(self.expression(inside["base"], places), field, ())
        if kind == "function_value":
            return tree.Reference((self._names(inside["function"])[inside["value"]],))
        if kind == "call":
            _, owner, first, _ = self.nodes[inside["owner"]]
            arguments = self._arguments(owner, first, places)
            return tree.Call(self._function_name(inside["function"], inside["output"]), arguments, ())
        if kind == "range":
            step = inside["explicit_step_expression"]
            first, last = (self.expression(inside[f"{end}_expression"], places) for end in ("start", "stop"))
            return tree.Range(first, tree.Number(1) if step is None else self.expression(step, places), last)
        if kind == "array_update":
            return self._updated(number)
        if kind == "clock_transfer":
            return self._transferred(inside, where, places)
        if kind == "runtime_quotient_owner":
            sides = (self.expression(inside["lhs"], places), self.expression(inside["rhs"], places))
            return tree.Call(inside["builtin"], sides, ())
        if kind not in ("conditional", "array", "builtin", "record"):
            self.refuse(f"an expression of the kind '{kind}'", where)
        arguments = self._arguments(inside, first, places)
        if kind == "conditional":
            pairs = zip(arguments[:-1:2], arguments[1::2], strict=True)
            return tree.Choice(tuple(pairs), arguments[-1])
        if kind == "array":
            return tree.Array(arguments)
        if kind == "record":
            return tree.Call(self.types[inside["value_type"]]["record_name"], arguments, ())
        if inside["builtin"].startswith("promoted_cat"):
            parts = (tree.Call("promote", (a, tree.Number(2)), ()) for a in arguments)
            return tree.Call("cat", (tree.Number(int(inside["builtin"][-1])), *parts), ())
        builtin: str = inside["builtin"]
        return tree.Call(_BUILTIN.get(builtin, builtin), arguments, ())

    def _transferred(self, inside: Json, where: Json, places: Places) -> tree.Expression:
        """A value at the ticks of another clock: the last one that it had at its own."""
        kind, count = next(iter(inside["kind"].items()))
        if kind == "shift_sample" and not count["counter"] < count["resolution"]:
            self.refuse("a shift by a whole interval of a clock or more", where)
        if kind not in ("sub_sample", "super_sample", "shift_sample"):
            self.refuse(f"the conversion '{kind}' of a clock", where)
        return self.expression(inside["source"], places)

    def _arguments(self, inside: Json, first: int, places: Places) -> tuple[tree.Expression, ...]:
        return tuple(self.expression(k, places) for k in self.operands[first : first + inside["operand_count"]])

    def _coordinate(
        self, c: Any, subscripts: tuple[tree.Expression, ...], places: Places, where: Json
    ) -> tree.Expression:
        if c == "time":
            return tree.Reference(("time",))
        if not isinstance(c, Mapping):
            self.refuse(f"'{c}'", where)
        kind, inside = next(iter(c.items()))
        if kind in VARIABLE:
            return self.variable(inside, subscripts)
        if kind == "derivative":
            return tree.Call("der", (self.variable(inside, subscripts),), ())
        if kind.startswith("pre_") and kind[4:] in VARIABLE:
            return tree.Call("pre", (self.variable(inside, subscripts),), ())
        if kind == "previous":
            of = self.storage["previous_values"][inside]["variable"]
            return tree.Call("pre", (self.variable(of, subscripts),), ())
        if kind == "clock_interval":
            return self.interval(inside)
        if kind == "condition":
            return self.condition(inside)
        if kind == "terminal":
            return tree.Call("terminal", (), ())
        if kind == "binder":
            key = inside["domain"], inside["ordinal"]
            return tree.Number(places[key]) if key in places else tree.Reference((_binder(*key),))
        if kind == "function_parameter":
            name = self.functions[inside["function"]]["parameters"][inside["ordinal"]]["name"]
            return tree.Reference((name,), (subscripts,))
        if kind == "delay":
            return self._delay(self.storage["delays"][inside], places, where)
        self.refuse(f"'{kind}'", where)

    def _delay(self, delay: Json, places: Places, where: Json) -> tree.Expression:
        """delay(e, T), or delay(e, T, Tmax)."""
        kind, given = next(iter(delay["kind"].items()))
        if kind not in ("parameter_delay", "bounded_delay"):
            self.refuse(f"a delay of the kind '{kind}'", where)
        # What must be constant is an expression and its value, the delay of a bounded one an expression alone.
        parts = [given[name] for name in ("delay_time", "delay_max") if name in given]
        numbers = [part["expression"] if isinstance(part, Mapping) else part for part in parts]
        arguments = tuple(self.expression(n, places) for n in (delay["source"], *numbers))
        return tree.Call("delay", arguments, ())

    def _indexed(self, inside: Json, first: int, places: Places) -> tree.Expression:
        subscripts: list[tree.Expression] = []
        for s in self.subscripts[first : first + inside["subscript_count"]]:
            if s["kind"] == "whole":
                subscripts.append(tree.Whole())
            else:
                subscripts.append(self.expression(next(iter(s["kind"].values())), places))
        kind, base, _, where = self.nodes[inside["base"]]
        if kind == "coordinate" and base != "time":
            return self._coordinate(base, tuple(subscripts), places, where)
        return tree.Part(self.expression(inside["base"], places), None, tuple(subscripts))

    def _comprehended(
        self, binders: Sequence[tuple[tuple[int, int], range]], body: int, places: Places
    ) -> tree.Expression:
        if not binders:
            return self.expression(body, places)
        (key, values), *rest = binders
        return tree.Array(tuple(self._comprehended(rest, body, {**places, key: v}) for v in values))

    def _updated(self, number: int) -> tree.Expression:
        """An array of a function with one entry changed, whose place is constant."""
        _, inside, first, where = self.nodes[number]
        whole = self.expression(inside["base"], {})
        subscript = self.subscripts[first]["kind"]
        place = self.expression(subscript["index"], {}) if "index" in subscript else None
        if isinstance(whole, tree.Reference):
            size = self.types[self._value_type(self.nodes[inside["base"]][1])]["dimensions"][0]
            whole = tree.Array(tuple(tree.Reference(whole.parts, ((tree.Number(k + 1),),)) for k in range(size)))
        if not isinstance(whole, tree.Array) or not isinstance(place, tree.Number) or inside["subscript_count"] != 1:
            self.refuse("a changed entry of an array of several dimensions, or at a place that is not constant,", where)
        entries = list(whole.entries)
        entries[int(place.value) - 1] = self.expression(inside["value"], {})
        return tree.Array(tuple(entries))

    def _value_type(self, inside: Json) -> int:
        """The type of a result or local variable of a function."""
        f = self.functions[inside["function"]]
        return [*f["outputs"], *f["locals"]][inside["value"]]["value_type"]

    def _record_type(self, number: int) -> int:
        """The type of an expression that is a record."""
        kind, inside, first, where = self.nodes[number]
        if kind == "record":
            return inside["value_type"]
        if kind == "call":
            return self.functions[inside["function"]]["outputs"][inside["output"]]["value_type"]
        if kind == "function_value":
            return self._value_type(inside)
        if kind == "conditional":
            return self._record_type(self.operands[first + 1])
        self.refuse(f"a field of an expression of the kind '{kind}'", where)

    # --- functions ---------------------------------------------------------------------------------------------------

    def _names(self, function: int) -> list[str]:
        """The names of a function's results and local variables, by their numbers."""
        f = self.functions[function]
        return [v["name"] for v in (*f["outputs"], *f["locals"])]

    def _function_name(self, function: int, output: int = 0) -> str:
        """Functions of one name differ in the sizes of their arrays; each result is a function of its own."""
        f = self.functions[function]
        return (
            f["name"] if f.get("external") is not None else f"{f['name']}:{function}" + (f".{output}" if output else "")
        )

    def _function(self, function: int, output: int) -> tree.Class:
        """A function whose first result is the given one."""
        f = self.functions[function]
        outputs = sorted(f["outputs"], key=lambda o: o is not f["outputs"][output])
        body = [s for each in f["statements"] for s in self._statement(function, each)]
        declared = [_declared(frozenset({"input"}), p["name"], self.types[p["value_type"]]) for p in f["parameters"]]
        for prefix, values in (("output", outputs), ("protected", f["locals"])):
            declared += [_declared(frozenset({prefix}), v["name"], self.types[v["value_type"]]) for v in values]
        external = None if f.get("external") is None else str(f["external"].get("name") or f["name"])
        name, algorithms = self._function_name(function, output), (tuple(body),) if body else ()
        return tree.Class("function", name, tuple(declared), algorithms=algorithms, external=external)

    def _statement(self, function: int, statement: Json) -> Iterator[tree.Statement]:
        kind, inside = next(iter(statement.items()))
        names = self._names(function)
        line = self.line(inside.get("provenance"))
        if kind == "assignment":
            yield self._assignment(names[inside["target"]], inside["rhs"], line)
        elif kind == "assignment_group":  # all of them read what was before the first
            each = inside["assignments"]
            for k, a in enumerate(each):
                yield tree.Assignment(tree.Reference((f":{k}",)), self.expression(a["rhs"], {}), line)
            for k, a in enumerate(each):
                yield tree.Assignment(tree.Reference((names[a["target"]],)), tree.Reference((f":{k}",)), line)
        elif kind == "for":
            ranges = [
                (_binder(*key), tree.Range(*map(tree.Number, (r.start, r.step, r[-1] if r else r.start - r.step))))
                for key, r in self.binders(inside["domain"])
                if key[0] == inside["domain"]
            ]
            body = [s for each in inside["statements"] for s in self._statement(function, each)]
            yield tree.Loop(tuple(ranges), None, tuple(body), line)
        elif kind != "assertion":  # as everywhere, they are not checked
            self.refuse(f"a statement of the kind '{kind}'", inside.get("provenance"))

    def _assignment(self, target: str, rhs: int, line: int) -> tree.Assignment:
        """An assignment to a variable, or to one entry of it."""
        kind, inside, first, _ = self.nodes[rhs]
        if kind == "array_update" and self.nodes[inside["base"]][0] == "function_value":
            place = self._indexed({"base": inside["base"], "subscript_count": inside["subscript_count"]}, first, {})
            subscripts = place.subscripts if isinstance(place, tree.Part) else ()
            return tree.Assignment(tree.Reference((target,), (subscripts,)), self.expression(inside["value"], {}), line)
        return tree.Assignment(tree.Reference((target,)), self.expression(rhs, {}), line)

    # --- places in the source ----------------------------------------------------------------------------------------

    def line(self, where: Json | None) -> int:
        return self.lines.of((where or {}).get("span"))

    def refuse(self, what: str, where: Json | None) -> NoReturn:
        line = self.line(where)
        raise ModelError(f"{self.name}{f', line {line}' if line else ''}: {what} is not read")


class _Lines:
    """Numbers of lines in the source files, from places counted in bytes."""

    def __init__(self, source_map: Json):
        self.texts = {file[0]: file[2] for file in source_map.get("files", ())}
        self.ends: dict[Any, list[int]] = {}

    def of(self, span: Json | None) -> int:
        if not span or span.get("source") not in self.texts:
            return 0
        source = span["source"]
        if source not in self.ends:
            text = self.texts[source].encode()
            self.ends[source] = [i for i, c in enumerate(text) if c == 10]
        return bisect.bisect_left(self.ends[source], span["start"]) + 1


def _declared(prefixes: frozenset[str], name: str, of: Json) -> tree.Declaration:
    """A parameter or variable of a function, or a field of a record."""
    kind = of.get("record_name") or SCALAR[of["scalar"]]
    return tree.Declaration(prefixes, kind, name, tuple(map(tree.Number, of["dimensions"])), {}, None, "", 0)


def _literal(value: Json) -> tree.Expression:
    kind, inside = next(iter(value.items()))
    if kind == "boolean":
        return tree.Truth(inside)
    return tree.Text(inside) if kind == "string" else tree.Number(inside)


def _negated(e: tree.Expression) -> tree.Expression:
    return tree.Number(-e.value) if isinstance(e, tree.Number) else tree.Unary("-", e)


def _change(e: tree.Binary) -> tree.Expression:
    """`edge(b)` and `change(b)`, which rumoca writes with `pre(b)`."""
    other = e.right.operand if isinstance(e.right, tree.Unary) and e.right.operator == "not" else e.right
    if isinstance(other, tree.Call) and other.function == "pre" and other.arguments == (e.left,):
        if e.operator == "<>" and other is e.right:
            return tree.Call("change", other.arguments, ())
        if e.operator == "and" and other is not e.right:
            return tree.Call("edge", other.arguments, ())
    return e


def _values(binder: Json) -> range:
    """The values of a binder, the last one included; its step may be negative."""
    step = binder["step"]
    return range(binder["lower"], binder["upper"] + (1 if step > 0 else -1), step)


def _binder(domain: int, ordinal: int) -> str:
    return f"binder {domain}.{ordinal}"
