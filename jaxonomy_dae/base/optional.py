"""Packages that only some features need."""

import importlib
import re
from typing import TYPE_CHECKING, Any

from .errors import MissingPackage

if TYPE_CHECKING:
    from matplotlib.axes import Axes
else:
    Axes = object  # Matplotlib may be missing

# What an axis shows if several variables of one unit share it.
QUANTITIES = {
    "m": "Position", "m/s": "Velocity", "m/s2": "Acceleration", "rad": "Angle", "rad/s": "Angular velocity",
    "N": "Force", "N*m": "Torque", "K": "Temperature", "degC": "Temperature", "W": "Power", "J": "Energy",
    "V": "Voltage", "A": "Current", "C": "Charge", "Pa": "Pressure", "bar": "Pressure", "kg/s": "Mass flow",
    "kg": "Mass", "m3": "Volume", "s": "Time",
}  # fmt: skip


def optional_module(module: str, extra: str, need: str) -> Any:
    """A package that comes with an extra.

    **Raises:**

    - `MissingPackage` that says what needs it, and how it is installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise MissingPackage(f"{need}: pip install 'jaxonomy_dae[{extra}]'") from error


def pyplot() -> Any:
    """`matplotlib.pyplot` (extra `plot`)."""
    return optional_module("matplotlib.pyplot", "plot", "plotting needs Matplotlib")


def new_axes(ax: Axes | None, width: float = 7.0, height: float = 3.5) -> Axes:
    """The Matplotlib axes given, or new ones."""
    return pyplot().subplots(figsize=(width, height), layout="constrained")[1] if ax is None else ax


def axis_label(name: str, unit: str | None) -> str:
    """A quantity and its unit, as in `Angle / rad`; the quantity alone if it is a number."""
    if not unit or unit == "1":
        return name
    return f"{name} / ({unit})" if re.search(r"[*/]", unit) else f"{name} / {unit}"


def legend_beside(ax: Axes, of: Axes | None = None) -> None:
    """Draws the legend of these axes, or of others, to the right of them, where it covers no data."""
    ax.legend(
        *(of or ax).get_legend_handles_labels(),
        loc="center left",
        bbox_to_anchor=(1.0, 0.5),
        frameon=False,
        fontsize="small",
    )
