"""Cells of batteries as equivalent circuits, and packs of them.

Conventions: a cell has `v = p.v − n.v`, and `i` flows from `p` to `n` through it, so that a current i > 0 charges. The
state of charge `soc` is 1 where the cell is full and 0 where it is empty; neither is a limit.

Sources: G. L. Plett, Battery Management Systems, volume I: Battery Modeling (Artech House, 2015), chapter 2, for the
circuit; D. Bernardi, E. Pawlikowski and J. Newman (1985), J. Electrochem. Soc. 132:5, for the heat.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import sympy
from sympy import Max, exp

from ..base.errors import ModelError
from ..write import NONNEGATIVE, POSITIVE, Component, Electrical, Eq, EqnEnv, Interval, Thermal, Value, der, smooth
from ..write.arrays import ComponentArray
from .arguments import count, increasing, row
from .electrical.two_pin import TwoPin
from .interpolation import interpolated, known_kind
from .thermal import HeatCapacitor, ThermalConductor

GAS_CONSTANT = 8.31446261815324  # J/(mol·K), CODATA 2018
HOUR = 3600  # s
EFFICIENCY = Interval(0.0, 1.0, open_low=True)
Row: TypeAlias = Sequence[Value] | np.ndarray
Each: TypeAlias = Any  # a `Value` for all cells, or an array with one for each


class _Circuit(NamedTuple):
    """Expressions of a cell's equivalent circuit, of which the terminal voltage and the heat are made."""

    voltage: sympy.Expr
    current: sympy.Expr
    soc: sympy.Expr
    reacting: sympy.Expr  # the part of the current that charges or discharges
    table: sympy.Expr  # the open-circuit voltage in the table
    table_energy: sympy.Expr  # its integral over the charge, joule
    overpotentials: sympy.Expr  # the sum of those of the RC pairs
    heat: sympy.Expr  # what the RC pairs lose


class _CellData(NamedTuple):
    """What describes a cell: the arguments of `Cell`. In a pack, numbers may be arrays with one for each cell."""

    soc: Row
    ocv: Row
    Q: Each
    R0: Each
    R: Sequence[Each]
    C: Sequence[Each]
    eta: Each
    initial_soc: Each
    initial_voltage: Sequence[Each] | None
    kind: str

    def checked(self, name: str) -> "_CellData":
        """The rows as arrays, whose lengths agree. `name` is that of the component, for messages."""
        points = increasing(self.soc, name, "soc")
        ocv, R, C = row(self.ocv, name, "ocv"), row(self.R, name, "R"), row(self.C, name, "C")
        if len(ocv) != len(points):
            raise ModelError(f"'{name}': ocv has {len(ocv)} entries, soc has {len(points)}: they must agree")
        starts = None if self.initial_voltage is None else row(self.initial_voltage, name, "initial_voltage")
        if len(R) != len(C) or (starts is not None and len(starts) != len(R)):
            voltages = "no initial_voltage" if starts is None else f"{len(starts)} in initial_voltage"
            raise ModelError(
                f"'{name}' needs a resistance, a capacity and, if given, a voltage for each RC pair; got {len(R)} in "
                f"R, {len(C)} in C and {voltages}"
            )
        known_kind(self.kind, name)
        return self._replace(soc=points, ocv=ocv, R=R, C=C, initial_voltage=starts)


class _Cell(TwoPin):
    """The parts that cells share."""

    def _circuit(self, given: _CellData) -> _Circuit:
        given = given.checked(self.name)
        starts = [0.0] * len(given.R) if given.initial_voltage is None else given.initial_voltage
        volts = [self.parameter(f"ocv{k}", value, unit="V") for k, value in enumerate(given.ocv, start=1)]
        charge = HOUR * self.parameter("Q", given.Q, unit="A*h", bounds=POSITIVE)
        efficiency = self.parameter("eta", given.eta, unit="1", bounds=EFFICIENCY)
        start = self.parameter("initial_soc", given.initial_soc, unit="1")
        z = self.variable("soc", start=start, fixed=True, unit="1")
        voltage, current = self._two_pins()
        # No event where the current turns: with an efficiency near one the slope of soc hardly bends.
        reacting = current - (1 - efficiency) * smooth(Max(current, 0))
        self.add_equations(Eq(charge * der(z), reacting))
        overpotentials, heat = sympy.Integer(0), sympy.Integer(0)
        for k, (resistance, capacity, start) in enumerate(zip(given.R, given.C, starts, strict=True), start=1):
            r = self.parameter(f"R{k}", resistance, unit="Ohm", bounds=POSITIVE)
            c = self.parameter(f"C{k}", capacity, unit="F", bounds=POSITIVE)
            v0 = self.parameter(f"initial_voltage{k}", start, unit="V")
            v = self.variable(f"v{k}", start=v0, fixed=True, unit="V")
            self.add_equations(Eq(c * der(v), current - v / r))
            self.declare_energy(c * v**2 / 2)
            overpotentials += v
            heat += v**2 / r
        table, integral = interpolated(z, np.asarray(given.soc), volts, given.kind)
        return _Circuit(voltage, current, z, reacting, table, charge * integral, overpotentials, heat)


class Cell(_Cell):
    """A cell as an equivalent circuit with n pairs of a resistor and a capacitor (Plett 2015, chapter 2):

        v = ocv + R0·i + v_1 + … + v_n
        3600·Q·d(soc)/dt = i where the cell is discharged, eta·i where it is charged
        C_k·d(v_k)/dt = i − v_k/R_k

    The open-circuit voltage `ocv` (volt) is interpolated in a table over the state of charge `soc`. It stores
    3600·Q·∫ ocv d(soc) from the table's first point on, and C_k·v_k²/2; it loses R0·i² + Σ v_k²/R_k, and the part
    1 − eta of the power ocv·i that charges.

    **Arguments:**

    - `soc`: increasing, shape (m,), m ≥ 2. `ocv`: the m voltages there, the parameters `ocv1`, `ocv2`, … Outside of the
        points the last piece goes on.
    - `Q` > 0: the capacity (ampere hour).
    - `R0` > 0: the series resistance (ohm).
    - `R`, `C`: the resistances (ohm) and capacities (farad) of the pairs, each > 0: the parameters `R1`, `C1`, …
    - `eta`: the coulombic efficiency, 0 < eta ≤ 1.
    - `initial_soc`: the state of charge at the start. `initial_voltage`: the voltages of the pairs at the start;
        default: zero, as in a cell at rest.
    - `kind`: of the interpolation, 'linear' or 'cubic', as in `signal.Table1D`.

    **Raises:**

    - `ModelError` if `soc` is not increasing or has less than two points, or if numbers of entries disagree.
    """

    def __init__(
        self,
        ev: EqnEnv,
        name: str,
        soc: Row,
        ocv: Row,
        Q: Value = 1.0,
        R0: Value = 0.01,
        R: Sequence[Value] = (),
        C: Sequence[Value] = (),
        eta: Value = 1.0,
        initial_soc: Value = 1.0,
        initial_voltage: Sequence[Value] | None = None,
        kind: str = "linear",
    ):
        super().__init__(ev, name)
        resistance = self.parameter("R0", R0, unit="Ohm", bounds=POSITIVE)
        c = self._circuit(_CellData(soc, ocv, Q, R0, R, C, eta, initial_soc, initial_voltage, kind))
        voltage = self.output("ocv", c.table, unit="V")
        self.add_equations(Eq(c.voltage, voltage + resistance * c.current + c.overpotentials))
        self.declare_energy(c.table_energy)
        self.declare_dissipation(resistance * c.current**2, c.heat, voltage * (c.current - c.reacting))


class HeatedCell(_Cell):
    """A `Cell` that has a temperature T, that of the port `heat`, at which its heat leaves:

        v = ocv + r·i + v_1 + … + v_n,   r = R0·exp(Ea/R_gas·(1/T − 1/T_ref))
        ocv = table(soc) + dUdT·(T − T_ref)
        3600·Q·d(soc)/dt = j,   j = i where the cell is discharged, eta·i where it is charged
        C_k·d(v_k)/dt = i − v_k/R_k
        heat.Q_flow = −[r·i² + Σ v_k²/R_k + ocv·(i − j) + dUdT·T·j]

    The last term of the heat is the reversible one, of the reaction's entropy (Bernardi, Pawlikowski & Newman 1985,
    with one reaction and no mixing); R_gas = 8.314 J/(mol·K). The cell stores 3600·Q·∫ (table − dUdT·T_ref) d(soc) and
    C_k·v_k²/2. Its heat capacity is not in it: connect a `thermal.HeatCapacitor`.

    **Arguments:**

    - `Ea`: the activation energy of the series resistance (joule per mole), `R0` > 0 (ohm) at `T_ref` > 0 (kelvin).
    - `dUdT`: the entropic coefficient (volt per kelvin).
    - All other arguments are those of `Cell`.

    **Raises:**

    - `ModelError` as `Cell`.
    """

    def __init__(
        self,
        ev: EqnEnv,
        name: str,
        soc: Row,
        ocv: Row,
        Q: Value = 1.0,
        R0: Value = 0.01,
        R: Sequence[Value] = (),
        C: Sequence[Value] = (),
        eta: Value = 1.0,
        initial_soc: Value = 1.0,
        initial_voltage: Sequence[Value] | None = None,
        kind: str = "linear",
        Ea: Value = 0.0,
        dUdT: Value = 0.0,
        T_ref: Value = 298.15,
    ):
        super().__init__(ev, name)
        resistance = self.parameter("R0", R0, unit="Ohm", bounds=POSITIVE)
        activation = self.parameter("Ea", Ea, unit="J/mol")
        entropy = self.parameter("dUdT", dUdT, unit="V/K")
        reference = self.parameter("T_ref", T_ref, unit="K", bounds=POSITIVE)
        heat = self.port("heat", Thermal)
        c = self._circuit(_CellData(soc, ocv, Q, R0, R, C, eta, initial_soc, initial_voltage, kind))
        voltage = self.output("ocv", c.table + entropy * (heat.T - reference), unit="V")
        # A parameter for its unit's sake: a plain number in an equation has none, and `check_units` would object.
        gas = self.parameter("gas_constant", GAS_CONSTANT, unit="J/(mol*K)", bounds=POSITIVE)
        r = self.output("r", resistance * exp(activation / gas * (1 / heat.T - 1 / reference)), unit="Ohm")
        lost = r * c.current**2 + c.heat + voltage * (c.current - c.reacting)
        self.add_equations(
            Eq(c.voltage, voltage + r * c.current + c.overpotentials),
            Eq(heat.Q_flow, -(lost + entropy * heat.T * c.reacting)),
        )
        self.declare_energy(c.table_energy, -HOUR * self.symbol("Q") * entropy * reference * c.soc)


# What may be one value for a pack or one for each of its cells: unit and bounds.
_OF_CELLS: dict[str, tuple[str, Interval]] = {
    "Q": ("A*h", POSITIVE),
    "R0": ("Ohm", POSITIVE),
    "eta": ("1", EFFICIENCY),
    "initial_soc": ("1", Interval()),
    "Ea": ("J/mol", Interval()),
    "dUdT": ("V/K", Interval()),
    "T_ref": ("K", POSITIVE),
    "C_heat": ("J/K", POSITIVE),
    "G_coolant": ("W/K", NONNEGATIVE),
    "initial_temperature": ("K", Interval()),
}


def _shape(name: str, series: int, parallel: int) -> tuple[int, int]:
    return count(series, name, "series"), count(parallel, name, "parallel")


class _Pack(Component):
    """Rows of cells in parallel, one after the other in series, from `p` to `n`."""

    def _each(self, what: str, value: Each, shape: tuple[int, int], unit: str, bounds: Interval) -> Each:
        """Declares one quantity of the cells: a parameter of the pack where one value holds for all cells, else one
        value per cell."""
        if not np.ndim(value):
            return self.parameter(what, value, unit=unit, bounds=bounds)
        if np.shape(value) != shape:
            raise ModelError(
                f"'{self.name}': {what} has shape {np.shape(value)}: give one value for all cells, or one for each in "
                f"shape {shape}"
            )
        # `add_array` gives one entry to each cell of an array, and all of a list to each cell.
        return np.asarray(value)

    def _values(self, shape: tuple[int, int], values: dict[str, Each]) -> dict[str, Each]:
        return {what: self._each(what, value, shape, *_OF_CELLS[what]) for what, value in values.items()}

    def _cells(
        self, kind: type[Component], shape: tuple[int, int], given: _CellData, more: dict[str, Each]
    ) -> ComponentArray:
        """Adds the cells and connects them; returns them, an array of the given shape."""
        given = given.checked(self.name)
        p, n = self.port("p", Electrical), self.port("n", Electrical)
        volts = [self.parameter(f"ocv{k}", value, unit="V") for k, value in enumerate(given.ocv, start=1)]
        options: dict[str, object] = {}
        for what, unit, bounds in (("R", "Ohm", POSITIVE), ("C", "F", POSITIVE), ("initial_voltage", "V", Interval())):
            row = getattr(given, what)
            if row is not None:
                options[what] = [self._each(f"{what}{k}", v, shape, unit, bounds) for k, v in enumerate(row, start=1)]
        own = {what: getattr(given, what) for what in ("Q", "R0", "eta", "initial_soc")}
        options |= self._values(shape, own | more)
        # A list, so that each cell gets all points.
        points = np.asarray(given.soc).tolist()
        cells = self.add_array("cell", kind, shape, points, volts, kind=given.kind, **options)
        self.connect(p, cells[0].p)
        self.connect(cells[:-1].n, cells[1:].p)
        self.connect(cells[:, :-1].n, cells[:, 1:].n)
        self.connect(cells[-1].n, n)
        return cells


class Pack(_Pack):
    """A pack of `Cell`s: `series` rows one after the other between `p` and `n`, each of `parallel` cells side by side.

    The cells are an array of shape (series, parallel), from `p` on: `pack.cell.soc`, `pack.cell[0,1].soc`.

    **Arguments:**

    - `series`, `parallel`: how many, each ≥ 1.
    - All other arguments are those of `Cell`. `Q`, `R0`, `eta`, `initial_soc` and the entries of `R`, `C` and
        `initial_voltage` are one value for all cells, a parameter of the pack, or an array of shape (series, parallel)
        with the parameters of the cells.

    **Raises:**

    - `ModelError` for a pack without cells and for arrays of another shape; otherwise as `Cell`.
    """

    def __init__(
        self,
        ev: EqnEnv,
        name: str,
        series: int,
        parallel: int,
        soc: Row,
        ocv: Row,
        Q: Each = 1.0,
        R0: Each = 0.01,
        R: Sequence[Each] = (),
        C: Sequence[Each] = (),
        eta: Each = 1.0,
        initial_soc: Each = 1.0,
        initial_voltage: Sequence[Each] | None = None,
        kind: str = "linear",
    ):
        super().__init__(ev, name)
        data = _CellData(soc, ocv, Q, R0, R, C, eta, initial_soc, initial_voltage, kind)
        self._cells(Cell, _shape(name, series, parallel), data, {})


class HeatedPack(_Pack):
    """A `Pack` of `HeatedCell`s with heat capacities, between which and to a coolant heat flows:

        C_heat·dT/dt = (heat of the cell) + G_coolant·(coolant.T − T) + Σ G_neighbour·(T_neighbour − T)

    Neighbours are the next cell in a row and the cell of the same place in the next row. The temperature of
    `cell[0,1]` is `body[0,1].T`, the heat from it to the coolant `cooling[0,1].Q_flow`.

    **Arguments:**

    - `C_heat` > 0: the heat capacity of a cell (joule per kelvin). `G_coolant` ≥ 0: the conductance from a cell to the
        port `coolant` (watt per kelvin). `initial_temperature` (kelvin) holds at the start. One value for all cells or
        an array, as in `Pack`, and so are `Ea`, `dUdT` and `T_ref`.
    - `G_neighbour` ≥ 0: the conductance between neighbours (watt per kelvin).
    - The others are those of `Pack` and `HeatedCell`.

    **Raises:**

    - `ModelError` as `Pack`.
    """

    def __init__(
        self,
        ev: EqnEnv,
        name: str,
        series: int,
        parallel: int,
        soc: Row,
        ocv: Row,
        Q: Each = 1.0,
        R0: Each = 0.01,
        R: Sequence[Each] = (),
        C: Sequence[Each] = (),
        eta: Each = 1.0,
        initial_soc: Each = 1.0,
        initial_voltage: Sequence[Each] | None = None,
        kind: str = "linear",
        Ea: Each = 0.0,
        dUdT: Each = 0.0,
        T_ref: Each = 298.15,
        C_heat: Each = 50.0,
        G_neighbour: Value = 0.5,
        G_coolant: Each = 0.1,
        initial_temperature: Each = 298.15,
    ):
        super().__init__(ev, name)
        shape = _shape(name, series, parallel)
        data = _CellData(soc, ocv, Q, R0, R, C, eta, initial_soc, initial_voltage, kind)
        cells = self._cells(HeatedCell, shape, data, {"Ea": Ea, "dUdT": dUdT, "T_ref": T_ref})
        thermal = {"C_heat": C_heat, "G_coolant": G_coolant, "initial_temperature": initial_temperature}
        each = self._values(shape, thermal)
        between = self.parameter("G_neighbour", G_neighbour, unit="W/K", bounds=NONNEGATIVE)
        coolant = self.port("coolant", Thermal)
        bodies = self.add_array("body", HeatCapacitor, shape, each["C_heat"], each["initial_temperature"])
        cooling = self.add_array("cooling", ThermalConductor, shape, each["G_coolant"])
        self.connect(cells.heat, bodies.heat, cooling.port_a)
        self.connect(cooling.port_b, coolant)
        if parallel > 1:
            beside = self.add_array("beside", ThermalConductor, (series, parallel - 1), between)
            self.connect(bodies[:, :-1].heat, beside.port_a)
            self.connect(bodies[:, 1:].heat, beside.port_b)
        if series > 1:
            below = self.add_array("below", ThermalConductor, (series - 1, parallel), between)
            self.connect(bodies[:-1].heat, below.port_a)
            self.connect(bodies[1:].heat, below.port_b)
