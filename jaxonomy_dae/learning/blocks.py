"""Where a learned block stands in a model."""

import dataclasses

from ..compile.lowering.plan import SystemPlan
from ..compile.model.opaque import OpaqueFunction, OpaqueTemplate


@dataclasses.dataclass(frozen=True)
class Block:
    """A network in the equations: how it is called, and the names of its inputs and outputs at each place where it
    stands (several in an array of components)."""

    opaque: OpaqueFunction
    inputs: tuple[tuple[str, ...], ...]  # (places, inputs), "time" among them
    outputs: tuple[str, ...]  # at the first place


def block_of(plan: SystemPlan, name: str) -> Block | None:
    """The block of a name; None for a sensor law, which stands in no equation."""
    names = plan.flat.variables.names
    places: list[tuple[str, ...]] = []
    outputs: dict[int, str] = {}
    opaque = None
    for group in plan.flat.groups:
        if not isinstance(group.template, OpaqueTemplate) or group.template.opaque.name != name:
            continue
        opaque = group.template.opaque
        outputs[group.template.output] = names[group.variable[0, 0]]
        if group.template.output == 0:
            for variables, orders in zip(group.variable[:, 1:], group.order[:, 1:], strict=True):
                row = [_derivative(names[v], int(q)) for v, q in zip(variables, orders, strict=True)]
                places.append(_with_time(row, opaque))
    for row in plan.flat.rows:
        if row.opaque.name == name:
            opaque = row.opaque
            outputs = {j: f"{name}[{j}]" for j in range(len(row.targets))}
            places.append(_with_time([names[v] for v in row.inputs], opaque))
    if opaque is None:
        return None
    return Block(opaque, tuple(places), tuple(outputs[j] for j in sorted(outputs)))


def _derivative(name: str, order: int) -> str:
    for _ in range(order):
        name = f"der({name})"
    return name


def _with_time(row: list[str], opaque: OpaqueFunction) -> tuple[str, ...]:
    rest = iter(row)
    return tuple("time" if j in opaque.time_positions else next(rest) for j in range(opaque.n_inputs))
