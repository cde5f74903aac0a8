"""Tables to which the steps of a solve append rows.

A table inside the state is part of every state that is kept for reverse mode: in the runs of a bouncing ball, the log
of a hundred events took 2.4 of 2.6 kB of each of 385 kept states. So a step returns the few rows that it appends, and
the loop over the steps writes them to a table beside the state.
"""

import abc
import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from ...base.aliases import Numeric, State

NOTED = "noted"  # the entry of a step's dense output that holds the rows it appends


class AbstractAppending(eqx.Module):
    """A state whose steps append rows to a table.

    - `table`: arrays of which the first axis counts the rows; None where the table is kept elsewhere.

    A step from y0 to y1 appends the first `y1.count - y0.count` of the rows that its dense output has as `NOTED`, in
    the structure of `table`.
    """

    table: eqx.AbstractVar[PyTree]

    @property
    @abc.abstractmethod
    def count(self) -> Numeric:
        """The number of rows so far, those for which there was no room included."""


def apart(y: State) -> tuple[PyTree, PyTree]:
    """Returns (the state without its table, the table), for a state of any kind."""
    return (dataclasses.replace(y, table=None), y.table) if isinstance(y, AbstractAppending) else (y, None)


def together(y: State, table: PyTree) -> State:
    """The state with its table put back."""
    return dataclasses.replace(y, table=table) if isinstance(y, AbstractAppending) else y


def appended(table: PyTree, noted: PyTree, y0: State, y1: State) -> PyTree:
    """The table after a step from y0 to y1 that noted these rows."""
    if table is None:
        return None

    def one(table: PyTree, rows: PyTree) -> PyTree:
        # Rows that are not appended have a place past the end of the table, so that no branch is needed.
        return table.at[_places(table, rows, y0, y1)].set(rows, mode="drop") if table.shape[0] else table

    return jax.tree.map(one, table, noted)


def appended_transposed(cotangent: PyTree, noted: PyTree, y0: State, y1: State) -> PyTree:
    """The cotangents of the rows that a step from y0 to y1 noted, given the table's."""

    def one(cotangent: PyTree, rows: PyTree) -> PyTree:
        if not cotangent.shape[0]:
            return jnp.zeros_like(rows)
        return cotangent.at[_places(cotangent, rows, y0, y1)].get(mode="fill", fill_value=0)

    return jax.tree.map(one, cotangent, noted)


def _places(table: PyTree, rows: PyTree, y0: State, y1: State) -> Numeric:
    """Where in the table the rows go; past its end for those that are not appended."""
    places = y0.count.astype(jnp.int32) + jnp.arange(rows.shape[0], dtype=jnp.int32)
    return jnp.where(places < y1.count.astype(jnp.int32), places, table.shape[0])
