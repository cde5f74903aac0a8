"""Numbers components, variables and parameters of a diagram, and finds what a path means to a component."""

import numpy as np

from ..errors import ModelError, nearest
from ..modeling.component import Component
from ..modeling.diagram import AcausalDiagram
from ..modeling.ports import Port

RELATION = ":relation["  # begins the path of a relation that is an event


class ModelNumbers:
    """Ids of everything in a diagram, in the order it was added."""

    def __init__(self, diagram: AcausalDiagram):
        self.components: list[Component] = []
        self.top = diagram.components
        stack = list(reversed(diagram.components.values()))
        while stack:
            component = stack.pop()
            self.components.append(component)
            stack.extend(reversed(component.children.values()))
        if not self.components:
            raise ModelError("the diagram has no components: add some with diagram.add(...)")
        self.index = {id(c): k for k, c in enumerate(self.components)}
        paths: dict[int, str] = {}
        for c in self.components:
            paths[id(c)] = c.name if c.parent is None else f"{paths[id(c.parent)]}.{c.name}"
        self.paths = [paths[id(c)] for c in self.components]
        n_variables = [len(c.variables) for c in self.components]
        n_parameters = [len(c.parameters) for c in self.components]
        self.first_variable = np.concatenate([[0], np.cumsum(n_variables)]).astype(np.int64)
        self.first_parameter = np.concatenate([[0], np.cumsum(n_parameters)]).astype(np.int64)
        # After all parameters follow the relations that are events, then what discrete variables were before an event,
        # in the order of these.
        flags = [parameter.is_discrete for c in self.components for parameter in c.parameters.values()]
        n_relations = [c.relations for c in self.components]
        self.first_relation = len(flags) + np.concatenate([[0], np.cumsum(n_relations)]).astype(np.int64)
        self.relations = np.arange(len(flags), int(self.first_relation[-1]))
        self.discrete = np.concatenate([np.flatnonzero(np.array(flags, bool)), self.relations])
        self.previous = np.full(int(self.first_relation[-1]), -1, np.int64)
        self.previous[self.discrete] = len(self.previous) + np.arange(len(self.discrete))
        # One position table for each distinct list of names.
        self._positions: dict[tuple[str, ...], dict[str, int]] = {}
        self.variable_positions = [self._position(tuple(c.variables)) for c in self.components]
        self.parameter_positions = [self._position(tuple(c.parameters)) for c in self.components]

    def _position(self, names: tuple[str, ...]) -> dict[str, int]:
        return self._positions.setdefault(names, {n: k for k, n in enumerate(names)})

    def resolve(self, k: int | None, path: str, table: str) -> int | None:
        """The id behind a path as component k sees it, or the diagram if k is None."""
        positions = self.variable_positions if table == "variables" else self.parameter_positions
        first = self.first_variable if table == "variables" else self.first_parameter
        component = None if k is None else self.components[k]
        while path.startswith("../"):
            if component is None:
                return None
            path, component = path[3:], component.parent
        if component is not None and path in positions[self.index[id(component)]]:
            j = self.index[id(component)]
            return int(first[j]) + positions[j][path]
        while "." in path:
            head, path = path.split(".", 1)
            children = self.top if component is None else component.children
            if head not in children:
                return None
            component = children[head]
            j = self.index[id(component)]
            if path in positions[j]:
                return int(first[j]) + positions[j][path]
        return None

    def variable(self, k: int, path: str) -> int:
        found = self.resolve(k, path, "variables")
        if found is None:
            component = self.components[k]
            inside = [
                *component.variables,
                *(f"{c.name}.{v}" for c in component.children.values() for v in c.variables),
            ]
            raise ModelError(
                f"component '{self.paths[k]}': the symbol '{path}' in its equations is not a variable of it or of a "
                "child component: " + nearest(path, inside)
            )
        return found

    def relation(self, k: int, number: int) -> int:
        """The place among the parameters of a relation that is an event of component k."""
        return int(self.first_relation[k]) + number

    def parameter(self, k: int, path: str) -> int:
        if path.startswith(RELATION):
            return self.relation(k, int(path[len(RELATION) : -1]))
        found = self.resolve(k, path, "parameters")
        if found is None:
            component = self.components[k]
            if path.startswith("../"):
                parent = "the diagram" if component.parent is None else f"'{component.parent.path}'"
                raise ModelError(
                    f"component '{self.paths[k]}' was given an expression in the parameter '{path[3:]}', which is not "
                    f"known in {parent}, where the component was added: add it where that parameter is declared"
                )
            raise ModelError(
                f"component '{self.paths[k]}': the symbol '{path}' in its equations is not a parameter of it or of a "
                "child component: " + nearest(path, component.parameters)
            )
        return found

    def port_variable(self, port: Port, name: str) -> int:
        k = self.index.get(id(port.component))
        if k is None:
            raise ModelError(f"{port!r} is connected, but its component is not part of the diagram: add it")
        return int(self.first_variable[k]) + self.variable_positions[k][f"{port.name}.{name}"]


def ids_of(model: ModelNumbers, members: list[int], paths: list[str], kind: str) -> np.ndarray:
    """Ids of `paths` in each member component, shape (members, paths)."""
    out = np.empty((len(members), len(paths)), np.int64)
    for j, path in enumerate(paths):
        positions = (model.variable_positions if kind == "variable" else model.parameter_positions)[members[0]]
        if path in positions:
            first = model.first_variable if kind == "variable" else model.first_parameter
            out[:, j] = first[members] + positions[path]
        else:
            resolve = model.variable if kind == "variable" else model.parameter
            out[:, j] = [resolve(k, path) for k in members]
    return out
