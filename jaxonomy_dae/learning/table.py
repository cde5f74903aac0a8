"""Values with intervals, to be printed."""

import dataclasses
import html
import math
from collections.abc import Mapping
from typing import Any

from .figures import plot_table


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
        return next(row for row in self.rows if row.name == name)

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

    def plot(self, ax: Any = None, *, true: Mapping[str, float] | None = None) -> Any:
        """Draws the intervals relative to the values, with crosses at `true` values by name, where these are known;
        returns Matplotlib axes."""
        return plot_table(self, ax, true)

    def _repr_html_(self) -> str:
        rows = ("".join(f"<td>{html.escape(c)}</td>" for c in line) for line in self._cells())
        return f"<table>{''.join(f'<tr>{row}</tr>' for row in rows)}</table>"
