"""The compiler: all passes in order.

Given a flattened model, returns the tables that lowering turns into a plan. The order has reasons:

1. Aliases go first. Most equations of a diagram are connections. A velocity that is replaced by the derivative of its
   position lowers the index, too, so that the passes behind see a smaller problem.
2. The structure is checked before any derivative is taken: missing or excess equations are explained in the equations
   that the user wrote.
3. Cancellation and index reduction alternate, since equations in which highest derivatives cancel must be combined
   before they are differentiated. Then all equations are differentiated, once, as often as these passes found.
4. States are selected after that, because the hidden constraints decide between candidates.
5. Blocks are ordered last, with states and inputs known.

Every variable that a pass removes is found again: aliases through `AliasTable`, everything else as a quantity that the
blocks determine.
"""

import dataclasses
from collections.abc import Sequence

from ...base.errors import ModelError
from ...graph.structure.pantelides import match_highest
from ..diagnosis.starts import check_equal_starts, dependent_starts, note_several_guesses
from ..diagnosis.structure import check_structure
from ..diagnosis.unused_parameters import note_unused
from ..diagnosis.wording import listed
from ..model.entries import incidence
from ..model.quantities import ReducedModel, map_quantities
from ..model.tables import FlatModel
from .check_pivots import check_pivots
from .differentiate_equations import differentiate_equations
from .eliminate_aliases import eliminate_aliases
from .number_columns import number_columns
from .order_blocks import Blocks, order_blocks
from .preferences import merits, note_not_followed
from .resolve_cancellation import reduce_with_cancellation
from .select_states import StateSelection, select_states


@dataclasses.dataclass(frozen=True)
class CompiledModel:
    """The results of the passes, in the order in which they were found."""

    reduced: ReducedModel
    selection: StateSelection
    blocks: Blocks
    mode: str


def compile_flat(flat: FlatModel, mode: str, prefer_states: Sequence[str]) -> CompiledModel:
    """Runs the passes on a flattened model.

    **Arguments:**

    - `mode`: how states are selected, as in `AcausalCompiler`; `prefer_states`: names of variables.

    **Raises:**

    - `ModelError`, `StructuralError` as `AcausalCompiler`.
    """
    # The graph passes below see one column for each quantity that is left, whatever its number of names.
    groups, alias = eliminate_aliases(flat)
    columns = number_columns(flat, alias)
    signature = incidence(groups, columns.number, columns.n_unknown)
    # One matching serves twice: it shows missing and excess equations here, and index reduction starts from it.
    matching = match_highest(signature, columns.least_of_unknown)
    check_structure(flat, groups, alias, signature, columns.unknown, matching)
    # Starts are compared in the equations that the user wrote, before any are combined.
    equal = check_equal_starts(flat, groups, alias)

    # Parameters take part with their values: whether derivatives cancel may depend on them. The combination that is
    # found holds for all values, or guards itself.
    groups, signature, offsets, cancelled = reduce_with_cancellation(
        groups, signature, columns, matching, flat.parameters, flat.declares.values
    )
    # Only now is it known which equation alone determines which highest derivative: its coefficient must not be zero.
    check_pivots(groups, signature, offsets, columns, flat.parameters, flat.declares.values)
    extended = differentiate_equations(groups, offsets, columns)
    model = ReducedModel(flat, alias, groups, extended, map_quantities(alias, extended.quantities))

    selection = select_states(model, mode, merits(model, prefer_states))
    # Blocks are those of the unknowns that are neither states nor inputs, so they follow the selection.
    blocks = order_blocks(model, selection)
    # A row of the states can be corrected only where the target has one, which is known from here on.
    _check_row_targets(model, selection, mode)
    notes = (
        *_loose_ports(flat),
        *note_unused(flat),
        *equal,
        *dependent_starts(model),
        *note_several_guesses(model),
        *cancelled,
        *note_not_followed(model, prefer_states, selection.states),
        *selection.notes,
    )
    return CompiledModel(model, dataclasses.replace(selection, notes=notes), blocks, mode)


def _loose_ports(flat: FlatModel) -> tuple[str, ...]:
    """A note on ports that nothing is connected to."""
    loose = [name for name, is_loose in zip(flat.ports.names, flat.ports.is_loose.tolist(), strict=True) if is_loose]
    return (f"nothing is connected to {listed(loose, 12)}: nothing flows there",) if loose else ()


def _check_row_targets(model: ReducedModel, selection: StateSelection, mode: str):
    states = set(selection.states.tolist()) if model.flat.rows else set()
    for row in model.flat.rows:
        if mode != "dummy_derivatives":
            raise ModelError(
                f"neural block '{row.opaque.name}': inject='row' adds to rows of a minimal set of states, so it needs "
                f"state_selection='dummy_derivatives'; this compiler has '{mode}'. For a real force, use "
                "inject='equation'."
            )
        for v in row.targets:
            if model.variables[v][0] not in states:
                name = model.flat.variables.names[v]
                listed = ", ".join(repr(model.names[q]) for q in selection.states[:12])
                raise ModelError(
                    f"neural block '{row.opaque.name}': its target '{name}' is not a state, so it has no row to "
                    f"add to. The states are {listed}. To make it one, compile with prefer_states=['{name}']; or "
                    "use inject='equation', which does not need a state."
                )
