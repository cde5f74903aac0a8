"""Long irregular chains of assignments become one sparse system.

Given the steps in order, after repetitions have been found: where many thin steps are left, consecutive ones whose
equations are affine in all of their unknowns together are merged into one sparse step. Its matrix is a permuted
triangular one, so that solving it is the substitution the steps would have been, but the traced program has one kernel
for each template instead of one for each step.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from ...solve.linear import sparse
from .loops import Loop
from .schedule import AnyStep, SparseStep, Step, StepEquation

MANY = 150  # thin steps in a row that are worth merging: written out they cost XLA seconds
LEAST = 50  # steps in one merged system
THIN = 64  # blocks in a step


def merge_thin(steps: Sequence[AnyStep | Loop], n_quantities: int, without_package: int) -> list[AnyStep | Loop]:
    """The steps, long runs of thin ones merged; systems of more than `without_package` unknowns only where a sparse
    solver is installed."""
    out: list[AnyStep | Loop] = []
    run: list[Step] = []
    for step in [*steps, None]:
        if isinstance(step, Step) and not step.carried and step.n <= THIN:
            run.append(step)
            continue
        out.extend(_merged(run, n_quantities, without_package) if len(run) >= MANY else run)
        run = []
        if step is not None:
            out.append(step)
    return out


def _merged(run: Sequence[Step], n_quantities: int, without_package: int) -> list[AnyStep]:
    out: list[AnyStep] = []
    inside = np.zeros(n_quantities + 1, bool)  # the last entry is the constant zero
    current: list[Step] = []

    def flush():
        size = sum(step.n * len(step.unknown) for step in current)
        worthwhile = len(current) >= LEAST and (size <= without_package or sparse.available())
        out.extend([_one(current)] if worthwhile else current)
        current.clear()
        inside[:] = False

    for step in run:
        own = np.concatenate(step.unknown)
        inside[own] = True
        # A product of two unknowns of the system is not linear: the system ends before it.
        if current and not all(_is_affine(e, inside) for e in step.equations):
            flush()
            inside[own] = True
        current.append(step)
    flush()
    return out


def _is_affine(equation: StepEquation, inside: np.ndarray) -> bool:
    """True if all instances are affine, jointly, in the slots that are `inside`."""
    distinct = np.unique(inside[equation.quantity], axis=0)
    return all(equation.template.is_affine_in([int(k) for k in np.flatnonzero(mask)]) for mask in distinct)


def _one(steps: Sequence[Step]) -> SparseStep:
    grouped: dict[str, list[StepEquation]] = {}
    for step in steps:
        for equation in step.equations:
            grouped.setdefault(equation.template.key, []).append(equation)
    joined = map(StepEquation.joined, grouped.values())
    equations = tuple(dataclasses.replace(e, local=(-1,) * len(e.local)) for e in joined)
    unknown = np.concatenate([quantities for step in steps for quantities in step.unknown])
    blocks = tuple(np.zeros(len(e.equation), np.int64) for e in equations)
    return SparseStep(steps[0].level, equations, (unknown,), np.zeros(len(unknown), np.int64), blocks, True)
