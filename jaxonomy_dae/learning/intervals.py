"""Linear intervals of what was estimated, as a table."""

from typing import TYPE_CHECKING

import numpy as np

from .table import Row, Table

if TYPE_CHECKING:
    from .estimate import Estimate


def intervals(estimate: "Estimate", level: float) -> Table:
    """As `Estimate.table`: parameters and starts, with what is to be said of each."""
    c, factor, point = estimate.objective.coordinates, estimate.quantile(level), estimate.point
    low, high = c.z_bounds
    natural = c.natural(point)
    moved, rows = set(np.flatnonzero(estimate.objective.free)), []
    scalars = np.array([not name.endswith("]") for name in c.names])  # such as a sensor law's gain
    for k in np.flatnonzero(~c.is_weight | scalars).tolist():
        z, spread, note = point[k], estimate.spread[k], ""
        ends = z - factor * spread, z + factor * spread
        if k not in moved:
            note = "frozen" if c.fixed[k] else "held out: fitted to this experiment alone"
        elif z <= low[k] or z >= high[k]:
            note = f"bound reached: {natural[k]:g}"
        elif spread >= 1:
            note = "not determined"
        inside = (-np.inf, np.inf)
        if np.isfinite(spread):
            inside = np.clip([c.natural_at(k, e) for e in ends], c.low[k], c.high[k])
        rows.append(Row(c.names[k], float(natural[k]), float(inside[0]), float(inside[1]), c.units[k], note))
    return Table(tuple(rows), level)
