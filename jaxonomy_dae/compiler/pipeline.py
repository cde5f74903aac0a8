"""The compiler: all passes in order."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from ..diagnosis.redundant_constraints import ModelAt, dependent_constraints
from ..diagnosis.starts import check_equal_starts, dependent_starts, note_several_guesses
from ..diagnosis.structure import check_structure
from ..diagnosis.unused_parameters import note_unused
from ..diagnosis.wording import itemised, listed
from ..errors import ModelError, StructuralError, nearest
from ..model.consistent_point import initial_point
from ..model.extended import Extended
from ..model.group import Point
from ..model.incidence import incidence
from ..model.quantities import QuantityMap, declared_scale, map_quantities, name_quantities
from ..model.tables import ZERO, AliasTable, EquationGroup, FlatModel, locate, provenance_of
from ..model.typical_sizes import error_sizes, unrounded_sizes
from ..structure.pantelides import match_highest
from .differentiate_equations import differentiate_equations
from .eliminate_aliases import eliminate_aliases
from .order_blocks import Blocks, order_blocks
from .resolve_cancellation import reduce_with_cancellation, zero_pivots
from .select_states import StateSelection, select_states


@dataclasses.dataclass(frozen=True)
class CompiledModel:
    """What the passes found, in the order they found it."""

    flat: FlatModel
    alias: AliasTable
    groups: tuple[EquationGroup, ...]  # after alias elimination and the resolution of cancellations
    extended: Extended
    variables: QuantityMap
    selection: StateSelection
    blocks: Blocks
    mode: str
    quantity_name: tuple[str, ...]


def compile_flat(flat: FlatModel, mode: str, prefer_states: Sequence[str]) -> CompiledModel:
    """Runs the passes on a flattened model."""
    groups, alias = eliminate_aliases(flat)
    is_input = flat.variables.is_input
    roots = np.arange(len(flat.variables)) == alias.root
    column = np.full(len(flat.variables), -1, np.int64)
    unknown = np.flatnonzero(roots & ~is_input)
    column[unknown] = np.arange(len(unknown))
    signature = incidence(groups, column, len(unknown))
    named = np.flatnonzero(alias.root != ZERO)
    least = np.zeros(len(flat.variables), np.int64)  # the highest derivative of each root that a variable is equal to
    np.maximum.at(least, alias.root[named], alias.order[named])
    matching = match_highest(signature, least[unknown])
    check_structure(flat, groups, alias, signature, unknown, matching)
    started = check_equal_starts(flat, groups, alias)
    groups, signature, offsets, notes = reduce_with_cancellation(
        groups, signature, column, least[unknown], matching,
        flat.parameters.values, flat.parameters.names, flat.parameters.discrete,
    )  # fmt: skip
    zero = zero_pivots(groups, signature, offsets, column, flat.parameters.values)
    if len(zero):
        raise StructuralError(_zero_pivot(flat, groups, int(zero[0])))
    inputs = np.flatnonzero(roots & is_input)
    column[inputs] = len(unknown) + np.arange(len(inputs))
    extended = differentiate_equations(groups, offsets, column, is_input, least, len(unknown))
    variables = map_quantities(alias, extended.quantities)
    starts = (*started, *dependent_starts(flat, variables, extended), *note_several_guesses(flat, variables))
    names = name_quantities(flat, variables, extended.quantities)
    preferred = _preferred(flat, variables, prefer_states)
    merit = _merit(flat, variables, extended, preferred)

    def point() -> Point:
        return initial_point(flat, variables, extended)

    def dependent(settled: np.ndarray) -> list[str]:
        model = ModelAt(flat, alias, variables, groups, extended, settled, point())
        return [str(found) for found in dependent_constraints(model)]

    scale = _scale(flat, variables, extended)
    selection = select_states(
        groups,
        extended,
        mode,
        lambda q: merit[q],
        scale,
        point,
        lambda: error_sizes(flat, variables, extended, flat.parameters.values),
        lambda q: names[q],
        lambda e: str(provenance_of(groups, int(e))),
        dependent,
    )
    left_out = _not_followed(flat, variables, prefer_states, selection.states)
    more = (*_loose_ports(flat), *note_unused(flat), *starts, *notes, *left_out, *selection.notes)
    selection = dataclasses.replace(selection, notes=more)
    known = np.zeros(extended.quantities.n, bool)
    known[selection.states] = True
    known[extended.quantities.n_unknown :] = True
    blocks = order_blocks(extended, known, selection.constraints)
    if isinstance(blocks, np.ndarray):
        left = [provenance_of(groups, int(extended.base[e])) for e in blocks]
        raise StructuralError(
            "\n".join(
                [
                    "after index reduction nothing is left for these equations to determine: they follow from the "
                    "others, or contradict them. Remove or change one of:",
                    *itemised(left),
                ]
            )
        )
    _check_row_targets(flat, variables, selection, names, mode)
    return CompiledModel(flat, alias, groups, extended, variables, selection, blocks, mode, tuple(names))


def _scale(flat: FlatModel, variables: QuantityMap, extended: Extended) -> np.ndarray:
    """The sizes by which variables are compared as states: as declared, or what their equations imply."""
    declared = declared_scale(flat, variables, extended)
    if not extended.level.any():
        return np.where(declared == 0.0, 1.0, declared)
    return np.where(declared == 0.0, unrounded_sizes(flat, variables, extended), declared)


def _zero_pivot(flat: FlatModel, groups: tuple[EquationGroup, ...], equation: int) -> str:
    group, place = locate(groups, equation)
    parameters = group.parameter[place].tolist()
    values = [f"{flat.parameters.names[p]} = {flat.parameters.values[p]:g}" for p in dict.fromkeys(parameters)]
    return (
        f"the equation {group.provenance[place]} determines nothing for {', '.join(values)}: the "
        "coefficient of what it should determine is zero. Give other values, or leave the component out."
    )


def _loose_ports(flat: FlatModel) -> tuple[str, ...]:
    loose = [name for name, is_loose in zip(flat.ports.names, flat.ports.is_loose.tolist(), strict=True) if is_loose]
    return (f"nothing is connected to {listed(loose, 12)}: nothing flows there",) if loose else ()


def _preferred(flat: FlatModel, variables: QuantityMap, names: Sequence[str]) -> dict[int, int]:
    """How strongly each quantity was asked for as a state."""
    index = {n: k for k, n in enumerate(flat.variables.names)}
    out = {}
    full = [n for name in names for n in _entries(flat, name)]
    for k, name in enumerate(full):
        if name not in index:
            raise ModelError(f"prefer_states: '{name}' is not a variable: " + nearest(name, index))
        q, _ = variables[index[name]]
        if q >= 0:
            out.setdefault(q, len(full) - k)
    return out


def _not_followed(flat: FlatModel, variables: QuantityMap, names: Sequence[str], states: np.ndarray) -> tuple[str, ...]:
    """A note on what was asked for as a state and is none, for others were better pivots, or no equation
    differentiates it."""
    index = {n: k for k, n in enumerate(flat.variables.names)}
    full = [n for name in names for n in _entries(flat, name)]
    chosen = set(states.tolist())
    left = [n for n in full if variables[index[n]][0] not in chosen]
    if not left:
        return ()
    is_none, it = ("is no state", "it") if len(left) == 1 else ("are no states", "them")
    return (f"prefer_states: {listed(left, 12)} {is_none}: the states and inputs determine {it}",)


def _entries(flat: FlatModel, name: str) -> list[str]:
    """The names of the entries of an array of variables; the name itself if it is not that of one."""
    ids = flat.arrays.variables(name)
    return [name] if ids is None else [flat.variables.names[v] for v in ids.ravel().tolist()]


def _merit(flat: FlatModel, variables: QuantityMap, extended: Extended, preferred: dict[int, int]) -> list[tuple]:
    """How much each quantity should be a state: asked for, fixed at the start, given a start."""
    quantities = extended.quantities
    fixed = np.zeros(quantities.n, int)
    started = np.zeros(quantities.n, int)
    chosen = flat.variables.start.is_given & (variables.quantity >= 0)
    started[variables.quantity[chosen]] = 1
    fixed[variables.quantity[chosen & flat.variables.fixed]] = 1
    return [(preferred.get(q, 0), f, s) for q, (f, s) in enumerate(zip(fixed.tolist(), started.tolist(), strict=True))]


def _check_row_targets(flat: FlatModel, variables: QuantityMap, selection: StateSelection, names: list[str], mode: str):
    states = set(selection.states.tolist())
    listed = ", ".join(repr(names[q]) for q in selection.states[:12])
    for row in flat.rows:
        if mode != "dummy_derivatives":
            raise ModelError(
                f"neural block '{row.opaque.name}': inject='row' adds to rows of a minimal set of states, so it needs "
                f"state_selection='dummy_derivatives'; this compiler has '{mode}'. For a real force, use "
                "inject='equation'."
            )
        for v in row.targets:
            if variables[v][0] not in states:
                name = flat.variables.names[v]
                raise ModelError(
                    f"neural block '{row.opaque.name}': its target '{name}' is not a state, so it has no row to "
                    f"add to. The states are {listed}. To make it one, compile with prefer_states=['{name}']; or "
                    "use inject='equation', which does not need a state."
                )
