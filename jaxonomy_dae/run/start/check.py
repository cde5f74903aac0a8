"""Whether an initial point may be used, and the error that says why not."""

import warnings
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ...base.errors import InitializationError
from ...base.tolerances import solved
from ...host.staging import is_traced
from ...solve.methods.rows import not_a_number
from ..system.input_values import input_values
from .initialize import InitialPoint, is_consistent
from .report import InitializationReport, outranked
from .rows import initial_rows


def check(
    system: Any, found: InitialPoint, t0: Any, inputs: Any, initial: Any, solve_for: tuple[str, ...] = (),
    running: bool = False, throw: bool | None = None, stacklevel: int | None = None,
) -> InitialPoint:  # fmt: skip
    """Returns the point; raises an `InitializationError` if it is not consistent, if a block of equations is singular
    there, or if a parameter solved for is out of its bounds. With `throw=False`, and where values are traced, it is
    then not-a-number; traced and with `throw=True` it is an error while running. While a program is `running`,
    functions of time in `inputs` may hold what is traced.

    With a `stacklevel`, warns of declared starts that do not hold: of as much as is known where values are traced."""
    table = system.parameters.table
    low, high = table.bounds[np.array([table.index(n) for n in solve_for], np.int64)].T
    driving = input_values(system.plan, inputs, t0, found.x.dtype) if running else ()
    traced = is_traced((found, system, t0, driving))
    if traced or throw is False:
        if stacklevel is not None and throw is not False:
            warn_of_outranked(system, initial, solve_for, stacklevel + 1)
        slack = _slack(found, low, high)
        outside = jnp.any(~((found.solved >= low - slack) & (found.solved <= high + slack)))
        if throw is not True:
            fine = (is_consistent(found) & ~outside)[None]
            both = jnp.append(found.x, found.solved)[None]
            n, sources = len(found.x), (system, t0, inputs, initial)
            both = not_a_number(both, fine, *sources)[0]
            return found._replace(x=both[:n], solved=both[n:])
        x = eqx.error_if(
            found.x,
            ~is_consistent(found),
            "no consistent initial point: fixed starts contradict the equations, or the search failed. "
            "system.initialization_report() outside jit gives the names",
        )
        if not solve_for:
            return found._replace(x=x)
        solved = eqx.error_if(found.solved, outside, f"a parameter of {list(solve_for)} is out of its bounds")
        return found._replace(x=x, solved=solved)
    report = InitializationReport(system, found, t0, inputs, initial, solve_for)
    problem = report.problem
    if problem is not None:
        raise InitializationError(problem)
    if stacklevel is not None:
        for text in report.warnings:
            warnings.warn(text, RuntimeWarning, stacklevel=stacklevel + 1)
    if not solve_for:
        return found
    solved = np.asarray(found.solved)
    slack = np.asarray(_slack(found, low, high))
    for name, value, a, b, off in zip(solve_for, solved, low, high, slack, strict=True):
        if not a - off <= value <= b + off:
            raise InitializationError(
                f"solve_for: the values given need {name} = {value:.6g}, which is out of its bounds [{a:g}, {b:g}]. "
                "Give other values in initial={...}, or start the search elsewhere with "
                f"system.with_parameters({{'{name}': guess}})"
            )
    return found


def warn_of_outranked(system: Any, initial: Any, solve_for: tuple[str, ...], stacklevel: int) -> None:
    """Warns of fixed starts that give way to values given, whatever these are."""
    table = system.parameters.table
    rows = initial_rows(system.plan, tuple(sorted(initial or ())), tuple(table.index(n) for n in solve_for))
    if rows.dropped:
        text = outranked(rows, [f"'{row.name}'" for row in rows.dropped])
        warnings.warn(text, RuntimeWarning, stacklevel=stacklevel + 1)


def _slack(found: InitialPoint, low: np.ndarray, high: np.ndarray) -> Any:
    """The distance by which rounding may put parameters solved for out of their bounds, shape (solved,)."""
    bounds = np.maximum(np.where(np.isfinite(low), np.abs(low), 0), np.where(np.isfinite(high), np.abs(high), 0))
    return solved(found.x.dtype) * jnp.maximum(jnp.abs(found.solved), jnp.asarray(bounds, found.x.dtype))
