"""Reads the equations that rumoca makes of a Modelica model: the dictionary `model.to_dict("dae")`.

rumoca flattens, connects and sorts; its parameters stay symbols. The dictionary holds variables, numbered expressions,
and lists of what determines what: residuals of the continuous equations, owners of discrete variables, actions at
events. Here it becomes the record that `read_base` makes of a text.
"""

import itertools
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any, TypeAlias

from ..base.errors import ModelError
from . import tree
from .clocked import with_clocked_equations
from .flat_model import FlatModel
from .rumoca_expressions import PREFIX, SCALAR, VARIABLE, Json, Places, RumocaExpressions

Target: TypeAlias = str | tuple[str, int]  # what an action acts on: a variable, a state set anew, the end of the run
SCHEMA = 43  # of the dictionary; rumoca changes it between its versions, and says nothing of the changes
VERSION = "0.10.2"  # of rumoca, which writes that schema
_PREFERENCE = {"Never": "never", "Avoid": "avoid", "Default": "default", "Prefer": "prefer", "Always": "always"}


def read_rumoca(dae: Json, name: str = "model") -> FlatModel:
    """A flat model from the equations that rumoca has made.

    **Arguments:**

    - `dae`: what `rumoca.Session().load(path, model=name).to_dict("dae")` returns.
    - `name`: the model's name.

    **Raises:**

    - `ModelError` for a schema other than the one that was tried, with the version to install; for a construct that is
        not read, by its name and line.
    """
    _check_schema(dae)
    return _Reader(RumocaExpressions(dae, name)).model()


def read_open(dae: Json, name: str, flows: Collection[str]) -> FlatModel:
    """As `read_rumoca`, without the equations `flow = 0` of the given flows of connectors, and with parameters that
    have no value.

    **Raises:**

    - `ModelError` as `read_rumoca`; and if one of the flows has no such equation.
    """
    _check_schema(dae)
    return _Reader(RumocaExpressions(dae, name), frozenset(flows)).model()


def _check_schema(dae: Json) -> None:
    schema = dae.get("schema_version")
    if schema != SCHEMA or "storage" not in dae:
        found = f"this is schema {schema}" if schema is not None else "this dictionary names no schema"
        raise ModelError(
            f'read_rumoca reads schema {SCHEMA} of to_dict("dae"), as rumoca {VERSION} writes it; {found}. '
            f'pip install "rumoca=={VERSION}"'
        )


class _Reader:
    def __init__(self, of: RumocaExpressions, flows: frozenset[str] | None = None):
        self.of = of
        self.flows = flows  # of open connectors; None for a model that is complete
        self.single = {v["name"] for v in of.variables if not of.types[v["value_type"]]["dimensions"]}

    def _continuous(self) -> list[Json]:
        """The continuous equations, without those that close open connectors: one for each of their flows."""
        ops = self.of.storage["continuous_equation_operations"]
        if not self.flows:
            return ops
        closed = [self._set_to_zero(op) for op in ops]
        # Flows of an array of connectors are closed by one equation for all, under the name of the array.
        owner = {flow: flow if flow in closed else re.sub(r"\[[\d,]*\]$", "", flow) for flow in sorted(self.flows)}
        for flow, name in owner.items():
            if closed.count(name) != 1:
                count = f"{closed.count(name)} equations of the flattening close '{flow}'"
                raise ModelError(f"{self.of.name}: {count}; 1 was expected")
        return [op for op, name in zip(ops, closed, strict=True) if name not in set(owner.values())]

    def _set_to_zero(self, op: Json) -> str:
        """The flow that an equation of a connection sets to zero; the empty text for all others."""
        kind, inside = next(iter(op.items()))
        if (inside.get("provenance") or {}).get("origin") != {"generated": "flow_balance_equation"}:
            return ""
        bodies = [inside["residual"]] if kind == "residual" else inside["bodies"]
        e = self.of.expression(bodies[0], {})
        return e.path if isinstance(e, tree.Reference) and not any(e.subscripts) else ""

    def model(self) -> FlatModel:
        s = self.of.storage
        equations = [e for op in self._continuous() for e in self._equations(op)]
        always = [e for activation, _, _, e in self._of_discrete() if activation == "always"]
        clocked, others = with_clocked_equations(self.of, always)
        equations += others
        equations += [*clocked, *self._whens()]
        initial = [e for op in s["initialization_equation_operations"] for e in self._equations(op)]
        for each in (*s["initial_discrete_values"], *s["initial_parameter_values"]):
            line = self.of.line(each.get("provenance"))
            initial.append(tree.Equality(self.of.variable(each["target"]), self.of.expression(each["value"], {}), line))
        declarations = [d for v in self.of.variables for d in self._declarations(v)]
        model = tree.Class("model", self.of.name, tuple(declarations), tuple(equations), tuple(initial))
        return FlatModel(model, {c.name: c for c in self.of.classes()})

    # --- declarations ------------------------------------------------------------------------------------------------

    def _declarations(self, v: Json) -> Iterator[tree.Declaration]:
        """A variable; an array as its entries, so that each parameter of an array is a parameter."""
        at, role = v["attributes"], v["role"]
        of = self.of.types[v["value_type"]]
        if of["scalar"] not in SCALAR or role not in VARIABLE:
            self.of.refuse(f"the variable '{v['name']}' of the kind {of['scalar']} {role}", v.get("declaration"))
        prefixes = {role} & PREFIX | ({"discrete"} if role == "discrete_real" else set())
        constant = role in ("parameter", "constant")
        if 0 in of["dimensions"]:  # no entries: the empty array is all that there is to know
            empty = tree.Array((tree.Array(()),) * of["dimensions"][0])
            yield tree.Declaration(frozenset({"constant"}), SCALAR[of["scalar"]], v["name"], (), {}, empty, "", 0)
            return
        for k, place in enumerate(itertools.product(*(range(1, n + 1) for n in of["dimensions"]))):
            fixed = at.get("fixed")
            modifiers: tree.Modifiers = {
                "stateSelect": tree.Reference(("StateSelect", _PREFERENCE[at["state_select"]]), ((), ()))
            }
            if at.get("unit") is not None:
                modifiers["unit"] = tree.Text(at["unit"])
            if fixed is not None:
                modifiers["fixed"] = tree.Truth(fixed[k] if len(fixed) > 1 else fixed[0])
            for key in ("start", "nominal", "min", "max"):
                if at.get(key) is not None and not (key == "start" and self._is_default(at[key], v)):
                    modifiers[key] = self._entry(at[key], place)
            if of["scalar"] == "enumeration" and not constant:
                modifiers.setdefault("start", tree.Number(1))  # its first literal
            value = self._entry(at["binding"], place) if at.get("binding") is not None else None
            is_bound = value is not None or "start" in modifiers or modifiers.get("fixed") == tree.Truth(False)
            if constant and not is_bound and self.flows is None:
                raise ModelError(f"{self.of.name}: the parameter '{v['name']}' has no value")
            name = tree.entry_name(v["name"], place) if place else v["name"]
            line = self.of.line(v.get("declaration"))
            comment = at.get("description") or ""
            yield tree.Declaration(frozenset(prefixes), SCALAR[of["scalar"]], name, (), modifiers, value, comment, line)

    def _is_default(self, start: int, v: Json) -> bool:
        """True for a start that rumoca adds: it stands where the variable does."""
        declared = (v.get("declaration") or {}).get("span")
        return declared is not None and self.of.nodes[start][3].get("span") == declared

    def _entry(self, number: int, place: tuple[int, ...]) -> tree.Expression:
        """One entry of an array; a value that is no array counts for all entries."""
        e = self.of.expression(number, {})
        if self._is_one_number(e):
            return e
        for depth, k in enumerate(place):
            if isinstance(e, tree.Array):
                e = e.entries[k - 1]
            else:
                return tree.Part(e, None, tuple(map(tree.Number, place[depth:])))
        return e

    def _is_one_number(self, e: tree.Expression) -> bool:
        """True for what is seen to be no array: numbers, variables without dimensions, and sums and so on of these."""
        if isinstance(e, tree.Reference):
            return e.path in self.single and not any(e.subscripts)
        if isinstance(e, tree.Binary):
            return self._is_one_number(e.left) and self._is_one_number(e.right)
        if isinstance(e, tree.Unary):
            return self._is_one_number(e.operand)
        if isinstance(e, tree.Choice):
            return all(map(self._is_one_number, [*(value for _, value in e.branches), e.otherwise]))
        return isinstance(e, tree.Number | tree.Truth | tree.Text)

    # --- equations ---------------------------------------------------------------------------------------------------

    def _equations(self, op: Json) -> Iterator[tree.Statement]:
        kind, inside = next(iter(op.items()))
        line = self.of.line(inside.get("provenance"))
        if kind == "residual":
            yield self._equality(inside["residual"], {}, line)
        elif kind == "structured":
            view = inside["scalar_view"]
            binders = self.of.binders(inside["domain"])
            if view == "RowMajorProjection":
                binders = []
            elif isinstance(view, Mapping):
                binders = binders[: view["BinderPrefixProjection"]["binder_count"]]
            for places in _places(binders):
                for body in inside["bodies"]:
                    yield self._equality(body, places, line)
        else:
            self.of.refuse(f"an equation of the kind '{kind}'", inside.get("provenance"))

    def _equality(self, residual: int, places: Places, line: int) -> tree.Equality:
        e = self.of.expression(residual, places)
        if isinstance(e, tree.Binary) and e.operator in ("-", ".-"):
            return tree.Equality(e.left, e.right, line)
        return tree.Equality(e, tree.Number(0.0), line)

    def _of_discrete(self) -> Iterator[tuple[Any, str, Json | None, tree.Equality]]:
        """(activation, variable, where it stands, equation) of all equations of discrete variables."""
        for owner in self.of.storage["discrete_value_owners"]:
            for branch in owner["branches"]:
                where = branch.get("provenance") or owner.get("provenance")
                for target, value in zip(owner["targets"], branch["values"], strict=True):
                    left, right = self.of.variable(target), self.of.expression(value["value"], {})
                    yield branch["activation"], left.path, where, tree.Equality(left, right, self.of.line(where))
        for each in self.of.storage["discrete_real_equations"]:
            where = each.get("provenance")
            e = self._equality(each["residual"], {}, self.of.line(where))
            yield each["activation"], e.left.path if isinstance(e.left, tree.Reference) else "", where, e

    # --- events ------------------------------------------------------------------------------------------------------

    def _whens(self) -> list[tree.Branches]:
        """The actions at events, those of one trigger together. Triggers that act on one variable are branches of one
        `when` in their order: Modelica allows one `when` for each variable."""
        bodies: dict[int, list[tuple[Target, tree.Expression | None, tree.Statement]]] = {}
        targets: dict[Target, list[int]] = {}
        for target, trigger, guard, statement in self._actions():
            bodies.setdefault(trigger, []).append((target, self._guard(guard, trigger), statement))
            targets.setdefault(target, []).append(trigger)
        chains = {trigger: [trigger] for trigger in bodies}
        for together in targets.values():
            chain = list(dict.fromkeys(t for first in together for t in chains[first]))
            chains.update({t: chain for t in chain})
        out = []
        for chain in {id(c): c for c in chains.values()}.values():
            branches = tuple((self.of.condition(t), tuple(_guarded(bodies[t]))) for t in chain)
            out.append(tree.Branches("when", branches, bodies[chain[0]][0][2].line))
        return out

    def _actions(self) -> Iterator[tuple[Target, int, int, tree.Statement]]:
        """(what is acted on, trigger, guard, statement) of all actions at events, in order."""
        s = self.of.storage
        in_steps: set[str] = set()
        for transaction in s["model_event_transactions"]:  # of a `when` in an algorithm
            in_steps |= {self.of.variables[t["variable"]]["name"] for t in transaction["targets"]}
            for step in transaction["steps"]:
                for d in step["definitions"]:
                    line = self.of.line(d.get("provenance") or step.get("provenance") or transaction.get("provenance"))
                    target, value = self.of.variable(d["target"]["variable"]), self.of.expression(d["value"], {})
                    yield target.path, step["trigger"], step["guard"], tree.Assignment(target, value, line)
        for activation, target, where, e in self._of_discrete():
            # Variables of an algorithm stand here, too, without the order of its steps.
            if activation != "always" and target not in in_steps:
                yield target, *self._when(activation, where), e
        for action in s["event_actions"]:
            kind, inside = next(iter(action["kind"].items()))
            line = self.of.line(action.get("provenance"))
            if kind == "reinitialize":
                state = self.of.variable(inside["state"])
                call = tree.Call("reinit", (state, self.of.expression(inside["value"], {})), ())
                yield ("reinit", inside["state"]), action["trigger"], action["guard"], tree.Effect(call, line)
            elif kind == "terminate":
                call = tree.Call("terminate", (self.of.expression(inside["message"], {}),), ())
                yield ("terminate", line), action["trigger"], action["guard"], tree.Effect(call, line)
            elif kind != "assert":
                self.of.refuse(f"the action '{kind}' at an event", action.get("provenance"))

    def _when(self, activation: Any, where: Json | None) -> tuple[int, int]:
        if not (isinstance(activation, Mapping) and "when" in activation):
            self.of.refuse(f"the activation {activation!r}", where)
        return activation["when"]["trigger"], activation["when"]["guard"]

    def _guard(self, guard: int, trigger: int) -> tree.Expression | None:
        """What has to hold beside a trigger; None if nothing has to."""
        if guard == trigger:
            return None
        node = self.of.storage["conditions"][guard]["node"]
        if isinstance(node, Mapping) and "and" in node:
            left, right = (self._guard(node["and"][side], trigger) for side in ("lhs", "rhs"))
            return right if left is None else left if right is None else tree.Binary("and", left, right)
        return self.of.condition(guard)


def _places(binders: Sequence[tuple[tuple[int, int], range]]) -> Iterator[Places]:
    """All values of the binders together."""
    for values in itertools.product(*(r for _, r in binders)):
        yield dict(zip((key for key, _ in binders), values, strict=True))


def _guarded(body: Sequence[tuple[Target, tree.Expression | None, tree.Statement]]) -> Iterator[tree.Statement]:
    """The statements of one trigger. Those with guards stand in an `if`; later ones are its further branches where they
    act on one variable, and assignments take place one after the other."""
    chains: dict[Target, list[tuple[tree.Expression, tuple[tree.Statement, ...]]]] = {}
    for target, guard, statement in body:
        if guard is None:
            yield statement
        elif isinstance(statement, tree.Assignment):
            yield tree.Branches("if", ((guard, (statement,)),), statement.line)
        else:
            chains.setdefault(target, []).append((guard, (statement,)))
    for branches in chains.values():
        yield tree.Branches("if", tuple(branches), branches[0][1][0].line)
