"""A model: components, the connections between them, and learned corrections."""

from ..base.errors import ModelError
from .arrays import ComponentArray, make_array
from .component import Component
from .connections import Connection, Signal, resolve_ends
from .environment import EqnEnv
from .names import check_name
from .neural import NeuralDAEBlock
from .ports import Owner, Port


class AcausalDiagram:
    """The top level of a model.

    ```python
    diagram = AcausalDiagram()
    diagram.add(source, resistor, ground)
    diagram.connect(source.p, resistor.p)
    diagram.connect(resistor, "n", ground, "p")
    ```

    Connecting a port adds its component to the diagram. Use `add` for all other components, such as those that are
    connected by signals only.
    """

    def __init__(self, name: str | None = None):
        if name is not None and not isinstance(name, str):
            raise ModelError(f"the name of a diagram is a text; got {_described(name)}")
        self.name = name
        self.components: dict[str, Component | ComponentArray] = {}
        self.connections: list[Connection] = []
        self.signals: list[Signal] = []
        self.blocks: dict[str, NeuralDAEBlock] = {}

    def add(self, *components: Component) -> "AcausalDiagram":
        """Adds components to the model.

        **Raises:**

        - `ModelError` if a name is used twice, or a component already belongs to another one.
        """
        for component in components:
            if isinstance(component, ComponentArray) and self.components.get(component.name) is component:
                continue
            if not isinstance(component, Component):
                raise ModelError(f"only components can be added to a diagram; got {_described(component)}")
            if component.parent is not None:
                raise ModelError(f"component '{component.path}' is part of '{component.parent.path}': add that one")
            other = next(iter(self.components.values()), component)
            if component.ev is not other.ev:
                raise ModelError(
                    f"components '{other.name}' and '{component.name}' were made with two EqnEnvs: make all components "
                    "of a diagram with the same one"
                )
            known = self.components.get(component.name)
            if known is component:
                continue
            if known is not None:
                raise ModelError(
                    f"two components are named '{component.name}': rename one of them, or make a new diagram if this "
                    "is the same model again"
                )
            if component.name in self.blocks:
                raise ModelError(f"'{component.name}' names a neural block already: rename the component")
            self.components[component.name] = component
        return self

    def add_array(
        self,
        ev: EqnEnv,
        name: str,
        kind: type[Component],
        shape: int | tuple[int, ...],
        /,
        *args: object,
        **kwargs: object,
    ) -> ComponentArray:
        """Adds an array of equal components, as `Component.add_array` does, and returns it.

        **Raises:**

        - `ModelError` as `Component.add_array`, and if the name is already used.
        """
        check_name(name, "component")
        if name in self.components or name in self.blocks:
            raise ModelError(f"the diagram has '{name}' already: give the array another name")
        if any(c.ev is not ev for c in self.components.values()):
            raise ModelError(
                f"array '{name}' was given another EqnEnv than the diagram's components: make all with the same one"
            )
        array = make_array(ev, name, kind, shape, args, kwargs)
        self.components[name] = array
        return array

    def connect(self, *ends: object) -> "AcausalDiagram":
        """Connects ports: `connect(a.p, b.n, …)`, or `connect(a, "p", b, "n")`. Connects signals: `connect(a.y, b.u)`
        lets the variable `y` of `a` drive the input `u` of `b`, which is then an ordinary unknown.

        **Raises:**

        - `ModelError` if a port does not exist or the ports are of different domains.
        """
        # Now: a signal becomes a symbol, which does not tell the object that has it.
        for end in ends:
            if isinstance(end, Component):
                self.add(_top(end))
        connection, signals = resolve_ends(ends, "diagram")
        self.signals.extend(signals)
        if connection:
            for end in connection.ends:
                if isinstance(end, Port):
                    self.add(_top(end.component))
            self.connections.append(connection)
        return self

    def add_neural_correction_block(self, block: NeuralDAEBlock) -> "AcausalDiagram":
        """Adds a learned correction. Several corrections of one target add up.

        **Raises:**

        - `ModelError` if the name is used already.
        """
        if not isinstance(block, NeuralDAEBlock):
            raise ModelError(f"expected a NeuralDAEBlock; got {type(block).__name__}")
        if block.name in self.blocks or block.name in self.components:
            raise ModelError(f"the name '{block.name}' is used twice: rename the neural block")
        self.blocks[block.name] = block
        return self


def _described(wrong: object) -> str:
    if isinstance(wrong, list | tuple):
        return f"a {type(wrong).__name__}: write diagram.add(*components)"
    if isinstance(wrong, ComponentArray):
        return f"the array '{wrong.path}': diagram.add_array makes and adds one"
    if isinstance(wrong, type):
        return f'the class {wrong.__name__}: make a component of it, {wrong.__name__}(ev, "name")'
    return type(wrong).__name__


def _top(component: Owner) -> Component:
    """The outermost component that contains this one."""
    while component.parent is not None:
        component = component.parent
    assert isinstance(component, Component)
    return component
