"""Numbers components, variables and parameters of a diagram, and finds what a path means to a component."""

import dataclasses
import functools
from collections.abc import Iterable, Sequence
from typing import cast

import numpy as np

from ...base.errors import ModelError, nearest
from ...write.arrays import ComponentArray
from ...write.component import Component
from ...write.declarations import around_path
from ...write.diagram import AcausalDiagram
from ..model.array_names import ArrayEntry, ArrayNames
from ..model.names import Names, Paths

RELATION = ":relation["  # begins the path of a relation that is an event


@dataclasses.dataclass(eq=False)
class Instances:
    """All instances of one component object: one, or as many as the arrays have that it is in.

    Instance i of the model is component `number[i]`; the ids of its variables begin at `variable[i]`, …
    """

    component: Component
    parent: "Instances | None"
    up: np.ndarray  # the instance of the parent that each belongs to
    array: ComponentArray | None  # whose prototype the component is
    shape: tuple[int, ...]  # of all arrays that it is in, the outermost first
    path: str  # without indices
    number: np.ndarray
    variable: np.ndarray
    parameter: np.ndarray
    relation: np.ndarray
    port: np.ndarray
    variable_positions: dict[str, int]
    parameter_positions: dict[str, int]

    def __len__(self):
        return len(self.number)


def _own(c: Component) -> tuple[int, ...]:
    """The numbers of components, variables, parameters, relations and ports that a component itself is and has."""
    return 1, len(c.variables), len(c.parameters), len(c.relations), len(c.ports)


def _child(entry: Component | ComponentArray) -> tuple[Component, ComponentArray | None]:
    return (cast(Component, entry.prototype), entry) if isinstance(entry, ComponentArray) else (entry, None)


class ModelNumbers:
    """Ids of everything in a diagram, in the order it was added."""

    def __init__(self, diagram: AcausalDiagram):
        if not diagram.components:
            raise ModelError("the diagram has no components: add some with diagram.add(...)")
        self.top = diagram.components
        self.instances: list[Instances] = []
        # One position table for each distinct list of names.
        self._positions: dict[tuple[str, ...], dict[str, int]] = {}
        self._number(self._counted())
        self.of: dict[int, Instances] = {id(i.component): i for i in self.instances}
        self.paths = Paths(self._paths())
        # After all parameters follow the relations that are events, then what discrete variables were before an event,
        # in the order of these. Declared ones come first, those that are not shown after the others.
        shown, unshown = self._declared_discretes(False), self._declared_discretes(True)
        self.n_shown = len(shown)
        self.relations = self.n_parameters + np.arange(self.n_relations)
        self.discrete = np.concatenate([shown, unshown, self.relations])
        self.previous = np.full(self.n_parameters + self.n_relations, -1, np.int64)
        self.previous[self.discrete] = len(self.previous) + np.arange(len(self.discrete))

    def _declared_discretes(self, unshown: bool) -> np.ndarray:
        """The discrete variables that components have declared, those whose names begin with a colon or the others."""
        found = [np.zeros(0, np.int64)]
        for i in self.instances:
            declared = i.component.parameters.items()
            places = [k for k, (n, p) in enumerate(declared) if p.is_discrete and n.startswith(":") == unshown]
            if places:
                found.append((i.parameter[:, None] + np.array(places)).ravel())
        return np.sort(np.concatenate(found))

    def _counted(self) -> dict[int, np.ndarray]:
        """For each component object, by id, the numbers (as of `_own`) of everything that one instance of it is and has
        inside."""
        order: list[Component] = []
        waiting = [_child(c)[0] for c in self.top.values()]
        while waiting:
            component = waiting.pop()
            order.append(component)
            waiting.extend(_child(c)[0] for c in component.children.values())
        counts: dict[int, np.ndarray] = {}
        # In reverse, so that what a component holds is counted before it.
        for component in reversed(order):
            inside = self._sizes(component.children, counts)
            counts[id(component)] = np.sum([np.array(_own(component)), *inside], axis=0)
        return counts

    @staticmethod
    def _sizes(children: dict[str, Component | ComponentArray], counts: dict[int, np.ndarray]) -> list[np.ndarray]:
        """For each child or array, the numbers of everything that it is and has inside."""
        found = [_child(entry) for entry in children.values()]
        return [counts[id(child)] * (array.size if array else 1) for child, array in found]

    def _number(self, counts: dict[int, np.ndarray]):
        """Lists all instances, a component before its children, the instances of an array one after the other."""
        stack: list[tuple[Component | ComponentArray, Instances | None, np.ndarray]] = []

        def push(children: dict[str, Component | ComponentArray], parent: Instances | None, first: np.ndarray):
            """`first` has the ids from which those of the children go on, shape (instances of the parent, 5)."""
            if children:
                sizes = np.cumsum(self._sizes(children, counts), axis=0)
                starts = [first, *(first + size for size in sizes[:-1])]
                stack.extend(reversed([(c, parent, f) for c, f in zip(children.values(), starts, strict=True)]))

        total = np.sum(self._sizes(self.top, counts), axis=0)
        self.n_components, self.n_variables, self.n_parameters, self.n_relations, self.n_ports = map(
            int, total.tolist()
        )
        push(self.top, None, np.array([[0, 0, 0, self.n_parameters, 0]]))
        while stack:
            entry, parent, first = stack.pop()
            component, array = _child(entry)
            up = np.arange(len(first))
            shape = parent.shape if parent else ()
            if array:
                stride = counts[id(component)]
                first = (first[:, None] + np.arange(array.size)[:, None] * stride).reshape(-1, len(stride))
                up = np.repeat(up, array.size)
                shape = (*shape, *array.shape)
            number, variable, parameter, relation, port = first.T
            found = Instances(
                component=component,
                parent=parent,
                up=up,
                array=array,
                shape=shape,
                path=component.name if parent is None else f"{parent.path}.{component.name}",
                number=number,
                variable=variable,
                parameter=parameter,
                relation=relation,
                port=port,
                variable_positions=self._position(tuple(component.variables)),
                parameter_positions=self._position(tuple(component.parameters)),
            )
            self.instances.append(found)
            push(component.children, found, first + np.array(_own(component)))

    def _paths(self) -> list[str]:
        paths = [""] * self.n_components
        for i in self.instances:
            above = [""] if i.parent is None else [f"{paths[k]}." for k in i.parent.number.tolist()]
            name = i.component.name
            labels = [""] if i.array is None else i.array.labels()
            own = [f"{p}{name}{label}" for p in above for label in labels]
            for k, path in zip(i.number.tolist(), own, strict=True):
                paths[k] = path
        return paths

    @functools.cached_property
    def variable_names(self) -> Names:
        """The full names of all variables, by id."""
        own = [(i.variable, map(around_path, i.component.variables)) for i in self.instances]
        return self._names(own, self.n_variables)

    @functools.cached_property
    def parameter_names(self) -> Names:
        """The full names of all declared parameters, by id."""
        own = [(i.parameter, (("", f".{name}") for name in i.component.parameters)) for i in self.instances]
        return self._names(own, self.n_parameters)

    @functools.cached_property
    def port_names(self) -> Names:
        """The full names of all ports, by id."""
        own = [(i.port, (("", f".{port.name}") for port in i.component.ports.values())) for i in self.instances]
        return self._names(own, self.n_ports)

    def _names(self, own: Sequence[tuple[np.ndarray, Iterable[tuple[str, str]]]], n: int) -> Names:
        """The names of what components declare: for each of `instances`, the first id of each and the texts around its
        path."""
        owner, piece, pieces = np.empty(n, np.int32), np.empty(n, np.int32), {}
        for i, (first, texts) in zip(self.instances, own, strict=True):
            numbers = [pieces.setdefault(text, len(pieces)) for text in texts]
            if len(i) == 1:
                inside = slice(int(first[0]), int(first[0]) + len(numbers))
                owner[inside], piece[inside] = i.number[0], numbers
            elif numbers:
                at = first[:, None] + np.arange(len(numbers))
                owner[at], piece[at] = i.number[:, None], numbers
        return Names(self.paths, owner, piece, tuple(pieces))

    def _position(self, names: tuple[str, ...]) -> dict[str, int]:
        return self._positions.setdefault(names, {n: k for k, n in enumerate(names)})

    def resolve(self, i: Instances | None, path: str, table: str) -> np.ndarray | None:
        """The ids behind a path as each instance of i sees it, or the diagram if i is None."""
        n = 1 if i is None else len(i)
        at, rows = i, np.arange(n)
        below, rows_below = None, rows
        while path.startswith("../"):
            if at is None:
                return None
            below, rows_below = at, rows
            path, rows, at = path[3:], at.up[rows], at.parent
        if ":" in path and below is not None and below.array is not None:  # what an array was given for its instances
            array, _, argument = path.partition(":")
            name = below.array.arguments.get(argument) if array == below.array.name else None
            return None if name is None else below.parameter[rows_below] + below.parameter_positions[name]
        while True:
            if at is not None:
                own = at.variable_positions if table == "variables" else at.parameter_positions
                if path in own:
                    return (at.variable if table == "variables" else at.parameter)[rows] + own[path]
            head, dot, path = path.partition(".")
            children = self.top if at is None else at.component.children
            name, bracket, index = head.partition("[")
            entry = children.get(head) if not bracket else children.get(name)
            if not dot or entry is None:
                return None
            child, array = _child(entry)
            if (array is None) == bool(bracket):
                return None
            if array is not None:
                try:
                    place = np.ravel_multi_index([int(k) for k in index.rstrip("]").split(",")], array.shape)
                except ValueError:
                    return None
                rows = rows * array.size + place
            at = self.of[id(child)]

    def variable(self, i: Instances, path: str) -> np.ndarray:
        """The ids of a variable, shape (instances,)."""
        found = self.resolve(i, path, "variables")
        if found is None:
            inside = [*i.component.variables]
            for c in i.component.children.values():
                child, array = _child(c)
                inside += [f"{child.name}{array.label(0) if array else ''}.{v}" for v in child.variables]
            raise ModelError(
                f"component '{self.path(i)}': the symbol '{path}' in its equations is not a variable of it or of a "
                "child component: " + nearest(path, inside)
            )
        return found

    def parameter(self, i: Instances, path: str) -> np.ndarray:
        """The ids of a parameter, or of a relation that is an event, shape (instances,)."""
        if path.startswith(RELATION):
            return i.relation + int(path[len(RELATION) : -1])
        found = self.resolve(i, path, "parameters")
        if found is None:
            component = i.component
            if path.startswith("../") and ":" in path:
                array, _, argument = path.rpartition("/")[2].partition(":")
                raise ModelError(
                    f"array '{array}': '{argument}' has a value for each component, and "
                    f"{type(self._prototype(i, array)).__name__} uses it in an equation, a start or an expression: "
                    f"declare it there, self.parameter('{argument}', {argument}), and use the symbol that this returns"
                )
            if path.startswith("../"):
                parent = "the diagram" if component.parent is None else f"'{component.parent.path}'"
                raise ModelError(
                    f"component '{self.path(i)}' was given an expression in the parameter '{path[3:]}', which is not "
                    f"known in {parent}, where the component was added: add it where that parameter is declared"
                )
            raise ModelError(
                f"component '{self.path(i)}': the symbol '{path}' in its equations is not a parameter of it or of a "
                "child component: " + nearest(path, component.parameters)
            )
        return found

    @staticmethod
    def _prototype(i: Instances, array: str) -> Component:
        while i.parent is not None and (i.array is None or i.array.name != array):
            i = i.parent
        return i.component

    def path(self, i: Instances) -> str:
        """The full name of the first instance."""
        return self.paths[i.number[0]]


class Members:
    """All instances of several component objects of one shape, in the model's order."""

    def __init__(self, model: ModelNumbers, parts: Sequence[Instances]):
        self.model, self.parts = model, parts
        number = np.concatenate([i.number for i in parts])
        self.order = np.argsort(number, kind="stable")
        self.number = number[self.order]
        self._first = {
            "variable": np.concatenate([i.variable for i in parts])[self.order],
            "parameter": np.concatenate([i.parameter for i in parts])[self.order],
        }

    def ids(self, paths: Sequence[str], kind: str) -> np.ndarray:
        """Ids of `paths` in each, shape (instances, paths)."""
        out = np.empty((len(self.number), len(paths)), np.int64)
        one = self.parts[0]
        positions = one.variable_positions if kind == "variable" else one.parameter_positions
        resolve = self.model.variable if kind == "variable" else self.model.parameter
        for j, path in enumerate(paths):
            if path in positions:
                out[:, j] = self._first[kind] + positions[path]
            else:
                out[:, j] = np.concatenate([resolve(i, path) for i in self.parts])[self.order]
        return out


def array_names(model: ModelNumbers) -> ArrayNames:
    """The meaning of names without indices: the entries of arrays that they stand for."""
    entries = {}
    for i in model.instances:
        if not i.shape:
            continue
        levels, at, level = [], i, i.path.count(".")
        while at is not None:
            if at.array is not None:
                levels.append((level, len(at.array.shape)))
            at, level = at.parent, level - 1
        entries[i.path] = ArrayEntry(
            i.shape, tuple(reversed(levels)), i.variable, i.parameter, i.variable_positions, i.parameter_positions
        )
    return ArrayNames(entries)
