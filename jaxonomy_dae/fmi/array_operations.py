"""Primitives that are more than one entry at a time, in C: for each, what writes its lines."""

from . import control_flow, gathers, matrices, moving, reductions

ARRAY_OPERATIONS = {
    **moving.OPERATIONS, **gathers.OPERATIONS, **reductions.OPERATIONS, **matrices.OPERATIONS,
    **control_flow.OPERATIONS,
}  # fmt: skip
