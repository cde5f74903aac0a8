"""Figures of solutions, with Matplotlib (extra `plot`)."""

from typing import TYPE_CHECKING, Any

import numpy as np

from .errors import ModelError

if TYPE_CHECKING:
    from .solution import Solution


def _pyplot() -> Any:
    try:
        import matplotlib.pyplot as plt
    except ImportError as error:
        raise ImportError("plotting needs Matplotlib: pip install 'jaxonomy_dae[plot]'") from error
    return plt


def plot_solution(solution: "Solution", *names: str, ax: Any = None) -> Any:
    """Draws variables over time, and returns the axes.

    **Arguments:**

    - `names`: of variables; default: the differential states.
    - `ax`: Matplotlib axes to draw into; new ones by default.
    """
    plt = _pyplot()
    names = names or tuple(n for n in solution.system.states if n in solution)
    if not names:
        raise ModelError("nothing to plot: the system has no states; name some variables")
    if ax is None:
        _, ax = plt.subplots(figsize=(7.0, 3.5), layout="constrained")
    units = dict(zip(solution.system.plan.flat.variables.names, solution.system.plan.flat.variables.unit, strict=True))
    time = np.asarray(solution.ts)
    shown = [units.get(n, "") for n in names]
    common = shown[0] if len(set(shown)) == 1 else None
    for name, unit in zip(names, shown, strict=True):
        label = name if common is not None or not unit else f"{name} [{unit}]"
        ax.plot(time, np.asarray(solution[name]), label=label, linewidth=1.6)
    ax.set_xlabel("time [s]")
    if common:
        ax.set_ylabel(f"{names[0]} [{common}]" if len(names) == 1 else f"[{common}]")
    elif len(names) == 1:
        ax.set_ylabel(names[0])
    ax.grid(True, alpha=0.3)
    if len(names) > 1:
        ax.legend()
    return ax
