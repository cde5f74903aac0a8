"""Carries out the functions and algorithms of a flat Modelica text, statement by statement.

An `if` whose condition is not constant is carried out in both branches, and a choice joins what they assign. Loops must
have constant bounds, but for `while`: one whose condition is not constant is repeated when the model is computed.
"""

from collections.abc import Mapping
from itertools import islice

import sympy

from ..base.errors import ModelError, nearest
from ..write.automatic_events import smooth
from . import tree
from .builtin import FUNCTIONS, applied, filled, sizes
from .definitions import assigned_in
from .evaluate import Evaluator, Names, beginning, index_of, with_end
from .loops import JUMPS, MOST, at, carried, placed, repeated
from .values import Record, Results, Value, as_number, both, chosen, either, is_condition, negated

MOST_ROUNDS = 100_000  # of a loop that is carried out while the model is read
LONG = 30  # nodes of an expression of a function that gets a name; a sum of three products has ten
DEEPEST = 200  # calls within calls; Python's own limit lies at a thousand frames


class Interpreter(Evaluator):
    """Evaluates what stands in a flat model, and carries out its functions."""

    # --- functions ---------------------------------------------------------------------------------------------------

    def call(self, name: str, arguments: list[Value], named: dict[str, Value]) -> Value:
        """The results of a function: one value, or a list of several."""
        last = name.rpartition(".")[2]
        for known in (name, last):
            if known in self.externals:
                return self.externals[known](*arguments, **named)
        function = self.classes.get(name)
        if function is None or function.external is not None:
            if name.startswith("Modelica.Math.") and last in FUNCTIONS:
                return applied(last, arguments, named)
        if function is None:
            more = "; load(…, roots=[…]) reads it from the sources of its library" if "." in name else ""
            near = nearest(name, [*FUNCTIONS, *self.classes])
            raise ModelError(f"the function '{name}' is not known: {near}{more}")
        if function.kind == "record":
            return self._record(function, arguments, named)
        inputs = [d for d in function.declarations if "input" in d.prefixes]
        given = dict(zip((d.name for d in inputs), arguments, strict=False)) | named
        if function.external is not None:
            external = self.externals.get(function.external)
            if external is None:
                raise ModelError(f"the function '{name}' calls '{function.external}', which is written in C")
            local, _ = self._declared(tuple(inputs), given)
            return external(*(local[d.name] for d in inputs))
        known = [d for d in inputs if d.name in given and (d.type in tree.BUILT_IN or d.type in self.classes)]
        arrays = {d.name for d in known if len(sizes(given[d.name])) > len(d.dimensions)}
        return self._for_entries(name, given, arrays) if arrays else self._carried_out(function, given)

    def _record(self, record: tree.Class, arguments: list[Value], named: dict[str, Value]) -> Record:
        """A record from the values of its fields. Those that cannot be modified are not arguments (section 12.6), but
        front ends may write all fields of a record that they have computed."""
        fields = [d.name for d in record.declarations]
        if len(arguments) < len(fields):
            fixed = {d.name for d in record.declarations if d.value is not None and d.prefixes & {"constant", "final"}}
            fields = [name for name in fields if name not in fixed]
        given = dict(zip(fields, arguments, strict=False)) | named
        for d in record.declarations:
            if d.name not in given and d.value is None:
                raise ModelError(f"the argument '{d.name}' is missing")
        local, _ = self._declared(record.declarations, given)
        return Record({d.name: local[d.name] for d in record.declarations})

    def _for_entries(self, name: str, given: dict[str, Value], arrays: set[str]) -> Value:
        """A function whose arguments have more dimensions than it declares is applied to their entries (section
        12.4.6)."""
        counts = {len(given[a]) for a in arrays}
        if len(counts) > 1:
            raise ModelError(f"'{name}' of arrays of {' and '.join(map(str, sorted(counts)))} entries")
        found = [self.call(name, [], given | {a: given[a][k] for a in arrays}) for k in range(counts.pop())]
        if found and isinstance(found[0], Results):
            return Results(map(list, zip(*found, strict=True)))
        return found

    def _declared(
        self, declarations: tuple[tree.Declaration, ...], given: dict[str, Value]
    ) -> tuple[dict[str, Value], Names]:
        """The first values of the variables of a function or record, and a view of all names; a variable whose value
        reads another one comes after it, wherever that is declared (section 12.4.4)."""
        local: dict[str, Value] = {}
        waiting = {d.name: d for d in declarations}
        inner = self.local_names(local, self.names)

        def names(name: str) -> Value:
            settle(beginning(name))
            return inner(name)

        def settle(name: str) -> None:
            d = waiting.pop(name, None)
            if d is None:
                return
            local[name] = None  # while its own value is looked for
            if name in given:
                local[name] = self._named(given[name])
            elif d.value is not None:
                local[name] = self._named(self.evaluate(d.value, names))
            elif "input" in d.prefixes:
                raise ModelError(f"the argument '{name}' is missing")
            else:
                local[name] = self._unset(d, names)

        for d in declarations:
            settle(d.name)
        return local, names

    def _carried_out(self, function: tree.Class, given: dict[str, Value]) -> Value:
        if self.depth > DEEPEST:
            raise ModelError(f"the function '{function.name}' calls itself too often")
        before, guards, self.quiet, self.depth = self.quiet, len(self.guards), True, self.depth + 1
        try:
            local, names = self._declared(function.declarations, given)
            for statements in function.algorithms:
                self.execute(statements, local, names)
        except ModelError as error:
            raise ModelError(f"{function.name}: {error}") from None
        finally:
            self.quiet, self.depth = before, self.depth - 1
            del self.guards[guards:]
        outputs = [local[d.name] for d in function.declarations if "output" in d.prefixes]
        return outputs[0] if len(outputs) == 1 else Results(outputs)

    def _named(self, value: Value) -> Value:
        """A value of a function by names for what is long in it."""
        if isinstance(value, list):
            return [self._named(v) for v in value]
        if isinstance(value, Record):
            return Record({k: self._named(v) for k, v in value.items()})
        if not self.depth or not isinstance(value, sympy.Expr):
            return value
        return value if sum(1 for _ in islice(sympy.preorder_traversal(value), LONG)) < LONG else self.give_name(value)

    def _unset(self, d: tree.Declaration, names: Names) -> Value:
        """What a variable of a function holds before it is assigned."""
        of = self.classes.get(d.type)
        empty: Value = None
        if of is not None and of.kind in ("record", "class") and not of.literals and of.external is None:
            empty = Record({f.name: self._unset(f, names) for f in of.declarations})
        counts = []
        for dimension in d.dimensions:
            if isinstance(dimension, tree.Whole):
                return None
            counts.append(self.count(dimension, names))
        if isinstance(empty, Record):
            one = d._replace(dimensions=d.dimensions[1:])
            return [self._unset(one, names) for _ in range(counts[0])] if counts else empty
        return filled(None, *counts)

    # --- statements --------------------------------------------------------------------------------------------------

    def assigned_by(self, statements: tuple[tree.Statement, ...], first: Mapping[str, Value] | None = None) -> dict:
        """What an algorithm of the model assigns; `first` are values before it."""
        local: dict[str, Value] = dict(first or {})
        self.execute(statements, local, self.local_names(local, self.names))
        return local

    def execute(self, statements: tuple[tree.Statement, ...], local: dict[str, Value], names: Names) -> None:
        """Carries out an algorithm; assigns to `local`.

        `return` and `break` become truths in `local`, conditions under a condition that is not constant. What follows
        is carried out where they do not hold.
        """
        for s in statements:
            ended = either(local.get("return", False), local.get("break", False))
            if ended is True:
                return
            if ended is False:
                self._statement(s, local, names)
                continue
            copied = dict(local)
            self.guards.append(negated(ended))
            self._statement(s, copied, self.local_names(copied, names))
            self.guards.pop()
            self._join(ended, dict(local), copied, local)

    def _statement(self, s: tree.Statement, local: dict[str, Value], names: Names) -> None:
        if isinstance(s, tree.Assignment | tree.Equality):
            found = (self.results if isinstance(s.left, tree.Several) else self.evaluate)(s.right, names)
            self._assign(s.left, self._named(found), local, names)
        elif isinstance(s, tree.Branches):
            self._branches(s, local, names)
        elif isinstance(s, tree.Loop):
            self._loop(s, local, names)
        elif isinstance(s, tree.Jump):
            local[s.kind] = True
        # What stands alone is a check or a message: assert, print.

    def _join(self, condition: Value, a: dict[str, Value], b: dict[str, Value], local: dict[str, Value]) -> None:
        """Assigns what two branches assign: that of `a` where the condition holds."""
        quiet = self.quiet or condition in self.quieted
        for name in a | b:
            otherwise = False if name in ("return", "break") else local.get(name)
            joined = _joined(condition, a.get(name, otherwise), b.get(name, otherwise), quiet)
            local[name] = self._named_truth(joined) if name in JUMPS else self._named(joined)

    def _named_truth(self, value: Value) -> Value:
        """Whether a jump has happened, by a name for what is long: all that follows asks for it."""
        if isinstance(value, bool):
            return value
        number = smooth(as_number(value))
        named = self._named(number)
        return value if named is number else sympy.Eq(named, 1)

    def _assign(self, target: tree.Expression, value: Value, local: dict[str, Value], names: Names) -> None:
        if isinstance(target, tree.Several):
            for each, v in zip(target.entries, value, strict=False):
                if each is not None:
                    self._assign(each, v, local, names)
            return
        if not isinstance(target, tree.Reference):
            raise ModelError("only variables can be assigned")
        if len(target.parts) == 1 and not target.subscripts[0]:
            self._assign_whole(target.parts[0], _copied(value), local)
            return
        entry = self._entry_name(target, names)
        if entry is not None and (entry in local or target.parts[0] not in local):
            local[entry] = value
            return
        local[target.parts[0]] = self._changed(
            local.get(target.parts[0]), target.subscripts[0], target.parts[1:], target.subscripts[1:], value, names
        )

    def _assign_whole(self, name: str, value: Value, local: dict[str, Value]) -> None:
        """Assigns to a variable; one by one to the entries of an array of the model, which are declared one by one."""
        if name not in local and isinstance(value, list) and name in self.entries:
            local.update(self.entries_of(name, value))
        else:
            local[name] = value

    def _changed(self, old: Value, subscripts: tuple, parts: tuple, rest: tuple, value: Value, names: Names) -> Value:
        """An array or record with one place changed."""
        if subscripts:
            first, *others = subscripts
            entries = list(old) if isinstance(old, list) else []
            if isinstance(first, tree.Whole):
                where: Value = list(range(1, len(entries) + 1))
            else:
                where = self.evaluate(first, with_end(names, len(entries)))
            if not isinstance(where, list | int | float):
                raise ModelError(f"the place of an assigned entry must be constant; got {where}")
            if not isinstance(where, list):
                where, value = [where], [value]
            for k, v in zip(where, value, strict=True):
                at = index_of(k, len(entries))
                entries[at] = self._changed(entries[at], tuple(others), parts, rest, v, names)
            return entries
        if parts:
            record = Record(old if isinstance(old, dict) else {})
            record[parts[0]] = self._changed(record.get(parts[0]), rest[0], parts[1:], rest[1:], value, names)
            return record
        return _copied(value)

    def _branches(self, s: tree.Branches, local: dict[str, Value], names: Names) -> None:
        """An `if`; a branch whose condition is not constant is carried out on a copy."""
        for k, (condition, body) in enumerate(s.branches):
            holds = self.evaluate(condition, names)
            if holds is False:
                continue
            if holds is True:
                self.execute(body, local, names)
                return
            rest = s._replace(branches=s.branches[k + 1 :])
            results = []
            # The branches that remain are an `if` of their own, so that only two are joined at a time.
            for condition, statements in ((holds, body), (negated(holds), (rest,))):
                copied = dict(local)
                self.guards.append(condition)
                self.execute(statements, copied, self.local_names(copied, names))
                self.guards.pop()
                results.append(copied)
            self._join(holds, results[0], results[1], local)
            return

    def _loop(self, s: tree.Loop, local: dict[str, Value], names: Names) -> None:
        outer = local.get("break", False)
        if s.condition is None:
            self._rounds(s.iterators, s.body, local, names)
        else:
            self._while(s, s.condition, local, names)
        local["break"] = outer

    def _while(self, s: tree.Loop, condition: tree.Expression, local: dict[str, Value], names: Names) -> None:
        for _ in range(MOST_ROUNDS):
            # Behind a jump the condition need not have a value, as one that reads the entry after the last one.
            ended = either(*(local.get(j, False) for j in JUMPS))
            holds = ended is not True and both(self.evaluate(condition, names), negated(ended))
            if not isinstance(holds, bool):
                self._repeated(s, condition, local, names)
                return
            if not holds:
                return
            self.execute(s.body, local, names)
        raise ModelError(f"a while loop takes more than {MOST_ROUNDS} rounds")

    def _repeated(self, s: tree.Loop, condition: tree.Expression, local: dict[str, Value], names: Names) -> None:
        """A loop of which it is not known how often it is carried out."""
        body = s.body
        written = [e for e in tree.each_part(body) if isinstance(e, tree.Jump)]
        changed = [name.partition("[")[0].partition(".")[0] for name in assigned_in(body)]
        for jump in {e.kind for e in written}:
            local.setdefault(jump, False)
            changed.append(jump)
        state = carried(list(dict.fromkeys(changed)), local)
        inside = dict(local)
        placed([(c.path, c.value) for c in state if c.before is not None], inside)
        # Names would be equations of the model, outside of the loop, where what a round reads has no value.
        named, guards, self.named, self.guards = self.named, self.guards, lambda e: e, []
        try:
            within = self.local_names(inside, names)
            ended = either(*(inside.get(j, False) for j in JUMPS))
            goes_on = both(self.evaluate(condition, within), negated(ended))
            self.execute(body, inside, within)
        finally:
            self.named, self.guards = named, guards
        after = [at(inside, c.path) for c in state]
        state = [c._replace(is_truth=c.is_truth or is_condition(v)) for c, v in zip(state, after, strict=True)]
        function, others = repeated(goes_on, state, after)
        before = [0.0 if c.before is None else as_number(c.before) for c in state]
        found = self.opaque(function, [*others, *before], len(state), f"while on line {s.line} within {MOST} rounds")
        ends = [sympy.Eq(e, 1) if c.is_truth else e for c, e in zip(state, found, strict=True)]
        placed([(c.path, v) for c, v in zip(state, ends, strict=True)], local)

    def _rounds(self, iterators: tuple, body: tuple, local: dict[str, Value], names: Names) -> None:
        (name, over), *rest = iterators
        # The iterator of a loop hides a variable of its name, which is as it was afterwards.
        was_there, shadowed = name in local, local.get(name)
        for value in self._range_of(over, names):
            if local.get("return") is True or local.get("break") is True:
                break
            local[name] = value
            if rest:
                self._rounds(tuple(rest), body, local, names)
            else:
                self.execute(body, local, names)
        local.pop(name, None)
        if was_there:
            local[name] = shadowed


def _joined(condition: Value, a: Value, b: Value, quiet: bool) -> Value:
    """What two branches assign; one that does not assign does not count, also for a field or an entry."""
    if a is b:
        return a
    if a is None or b is None:
        return b if a is None else a
    if isinstance(a, Record) and isinstance(b, Record):
        return Record({k: _joined(condition, a.get(k), b.get(k), quiet) for k in a | b})
    if isinstance(a, list) and isinstance(b, list) and len(a) == len(b):
        return [_joined(condition, x, y, quiet) for x, y in zip(a, b, strict=True)]
    return chosen(condition, a, b, quiet)


def _copied(value: Value) -> Value:
    """Arrays are values: no two names share one."""
    if isinstance(value, list):
        return [_copied(v) for v in value]
    return Record({k: _copied(v) for k, v in value.items()}) if isinstance(value, Record) else value
