"""Values with intervals, to be printed."""

import dataclasses
import html
import math
from collections.abc import Mapping

import numpy as np

from ..base.errors import ModelError, nearest
from ..base.optional import Axes, new_axes


@dataclasses.dataclass(frozen=True)
class Row:
    """One value: its interval, which is infinite where it is not determined, its unit, and what is to be said of it."""

    name: str
    value: float
    low: float
    high: float
    unit: str
    note: str


@dataclasses.dataclass(frozen=True, repr=False)
class Table:
    """Rows by name: `table["cell.R0"].low`."""

    rows: tuple[Row, ...]
    level: float

    def __getitem__(self, name: str) -> Row:
        for row in self.rows:
            if row.name == name:
                return row
        raise ModelError(f"there is no row '{name}' in this table: " + nearest(name, [row.name for row in self.rows]))

    def __iter__(self):
        return iter(self.rows)

    def _cells(self) -> list[tuple[str, ...]]:
        found = [("", "value", f"{100 * self.level:g} % interval", "unit", "")]
        for row in self.rows:
            interval = f"[{row.low:.6g}, {row.high:.6g}]" if math.isfinite(row.high - row.low) else "—"
            found.append((row.name, f"{row.value:.6g}", interval, row.unit, row.note))
        return found

    def __repr__(self):
        cells = self._cells()
        widths = [max(len(line[k]) for line in cells) for k in range(5)]
        return "\n".join("  ".join(c.ljust(w) for c, w in zip(line, widths, strict=True)).rstrip() for line in cells)

    def plot(self, ax: Axes | None = None, *, true: Mapping[str, float] | None = None) -> Axes:
        """Draws the intervals relative to the values, with crosses at the `true` values that are given by name; returns
        Matplotlib axes."""
        rows = self.rows
        ax = new_axes(ax, 7.0, 0.38 * len(rows) + 1.2)
        for k, row in enumerate(rows):
            size = abs(row.value) or 1.0
            if np.isfinite(row.high - row.low):
                ends = [100 * (end - row.value) / size for end in (row.low, row.high)]
                ax.plot(ends, [k, k], color="C0", linewidth=5, alpha=0.45, solid_capstyle="butt")
                ax.plot(0, k, "o", color="C0", markersize=4)
            else:
                ax.axhspan(k - 0.3, k + 0.3, color="C3", alpha=0.15, linewidth=0)
            if true is not None and row.name in true:
                ax.plot(100 * (float(true[row.name]) - row.value) / size, k, "x", color="C3", markersize=7)
            if row.note:
                ax.annotate(
                    row.note, (0.995, k), xycoords=("axes fraction", "data"), ha="right", va="center", fontsize=8
                )
        ax.set_yticks(
            range(len(rows)), [f"{row.name} = {row.value:.4g}{' ' * bool(row.unit)}{row.unit}" for row in rows]
        )
        ax.set_ylim(len(rows) - 0.5, -0.5)
        ax.set_xlabel(f"{100 * self.level:g} % interval, relative to the value / %")
        ax.grid(True, axis="x", alpha=0.3)
        return ax

    def _repr_html_(self) -> str:
        rows = ("".join(f"<td>{html.escape(c)}</td>" for c in line) for line in self._cells())
        return f"<table>{''.join(f'<tr>{row}</tr>' for row in rows)}</table>"
