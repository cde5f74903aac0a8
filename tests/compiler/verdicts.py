"""Models at singular positions, where entries of Jacobians are rounding errors, and beside them; and what is judged of
them in NumPy alone. Run as a script, it prints all verdicts, to compare those of other kernels of BLAS."""

import dataclasses
import json
import math
from collections.abc import Callable

import numpy as np
from attack.singular import Loop
from sympy import cos, sin

import jaxonomy_dae.library.planar as pl
from jaxonomy_dae import AcausalDiagram, Component, EqnEnv, StructuralError
from jaxonomy_dae.compile.lowering.lower import lower
from jaxonomy_dae.compile.model.consistent_point import initial_point
from jaxonomy_dae.compile.model.declared import start_guess
from jaxonomy_dae.compile.passes.flatten import flatten
from jaxonomy_dae.compile.passes.pipeline import compile_flat
from jaxonomy_dae.run.start.singular_blocks import examine_blocks
from jaxonomy_dae.write import Eq, der

MODES = ("auto", "dummy_derivatives", "projection")
FOUR = 4 * np.finfo(float).eps


def loop(starts, closure):
    ev = EqnEnv()
    inertias = [1.0 + 0.1 * k for k in range(len(starts))]
    return AcausalDiagram().add(Loop(ev, "loop", starts, inertias, closure))


def four_bar(start, coupler_start=0.0, rocker_start=None, lengths=(0.8, 2.0, 0.8, 2.0)):
    """Crank, coupler, rocker and base; the angles of the first three."""

    def closure(self, crank, coupler, rocker):
        a, b, c, d = (self.parameter(name, value) for name, value in zip("abcd", lengths, strict=True))
        return (
            a * cos(crank) + b * cos(coupler) - c * cos(rocker) - d,
            a * sin(crank) + b * sin(coupler) - c * sin(rocker),
        )

    return loop((start, coupler_start, start if rocker_start is None else rocker_start), closure)


def slider_crank(start, rod_start=0.0, crank_length=0.5, rod_length=1.5):
    """The angles of crank and rod, and the place of the slider."""
    place = crank_length * math.cos(start) + rod_length * math.cos(rod_start)

    def closure(self, crank, rod, s):
        r, length = self.parameter("r", crank_length), self.parameter("l", rod_length)
        return r * cos(crank) + length * cos(rod) - s, r * sin(crank) + length * sin(rod)

    return loop((start, rod_start, place), closure)


def in_line():
    """Two bodies of the library, of length 1, between pins at a distance of 2."""
    ev, diagram = EqnEnv(), AcausalDiagram()
    one, two = pl.MassiveLink(ev, "one", 1.0, guess_x=0.5), pl.MassiveLink(ev, "two", 1.0, guess_x=1.5)
    west, east = pl.World(ev, "west"), pl.World(ev, "east", 2.0)
    pins = [pl.Revolute(ev, name) for name in ("first", "second", "third")]
    diagram.add(west, east, one, two, *pins)
    ends = [west.frame, one.frame_a, one.frame_b, two.frame_a, two.frame_b, east.frame]
    for k, pin in enumerate(pins):
        diagram.connect(ends[2 * k], pin.frame_a)
        diagram.connect(pin.frame_b, ends[2 * k + 1])
    return diagram


def pendulum(theta, length=1.0):
    ev = EqnEnv()
    return AcausalDiagram().add(pl.PlanarPendulum(ev, "pend", initial_theta=theta, L=length))


class _Lever(Component):
    """A force that carries the torque of a weight on a lever at the angle phi: where it has no arm, nothing determines
    it."""

    def __init__(self, ev, name, start):
        super().__init__(ev, name)
        start = self.parameter("start", start)
        arm = self.parameter("arm", 0.3)
        phi = self.variable("phi", start=start, fixed=True)
        force = self.variable("force")
        self.add_equations(Eq(der(phi), 1.0), Eq(arm * sin(phi) * force, 2 + cos(phi)))


def lever(start):
    ev = EqnEnv()
    return AcausalDiagram().add(_Lever(ev, "lever", start))


class _Knee(Component):
    """Two bars of equal length in a toggle: the forces in them carry a load across their line."""

    def __init__(self, ev, name, start):
        super().__init__(ev, name)
        start = self.parameter("start", start)
        phi = self.variable("phi", start=start, fixed=True)
        one, two = self.variable("one"), self.variable("two")
        self.add_equations(
            Eq(der(phi), 0.1),
            Eq(one * sin(phi) + two * sin(phi), 3.0),
            Eq(one * cos(phi) - two * cos(phi), phi),
        )


def knee(start):
    ev = EqnEnv()
    return AcausalDiagram().add(_Knee(ev, "knee", start))


@dataclasses.dataclass(frozen=True)
class Model:
    make: Callable[[], AcausalDiagram]
    expected: str
    modes: tuple[str, ...] = MODES


PI = math.pi
MINIMAL = ("dummy_derivatives",)
AUTO = ("auto",)  # without hidden constraints all modes are the same
MODELS = {
    "parallelogram at 0": Model(lambda: four_bar(0.0), "refused"),
    "parallelogram at pi": Model(lambda: four_bar(PI), "refused", MINIMAL),
    "parallelogram at 1": Model(lambda: four_bar(1.0), "regular", MINIMAL),
    "kite that is folded": Model(lambda: four_bar(0.0, 0.0, PI, (1.5, 1.0, 0.5, 3.0)), "refused", MINIMAL),
    "two bodies in line": Model(in_line, "refused", MINIMAL),
    "slider-crank at 0": Model(lambda: slider_crank(0.0), "regular", ("auto", "dummy_derivatives")),
    "slider-crank at -3 pi": Model(lambda: slider_crank(-3 * PI), "regular", MINIMAL),
    "slider-crank of equal bars, upright": Model(lambda: slider_crank(PI / 2, -PI / 2, 0.5, 0.5), "refused", MINIMAL),
    "pendulum at pi / 2": Model(lambda: pendulum(PI / 2), "regular"),
    "pendulum at -pi": Model(lambda: pendulum(-PI), "regular", MINIMAL),
    "pendulum of 1e-12 m": Model(lambda: pendulum(PI / 2, 1e-12), "regular", MINIMAL),
    "pendulum of 1e9 m": Model(lambda: pendulum(PI, 1e9), "regular", MINIMAL),
    **{f"lever at {k} pi": Model(lambda k=k: lever(k * PI), "refused", AUTO) for k in (0, 1, 2, -3)},
    **{f"lever at {phi:g}": Model(lambda p=phi: lever(p), "regular", AUTO) for phi in (1.0, 1e-6, 1e-9)},
    **{f"knee at {k} pi / 2": Model(lambda k=k: knee(k * PI / 2), "refused", AUTO) for k in (0, 1, 2, 3)},
    "knee at 1e-9": Model(lambda: knee(1e-9), "regular", AUTO),
}


def moved(values: np.ndarray, which: np.ndarray, seed: int | None) -> np.ndarray:
    """Numbers off by ±4 eps, zeros too, where `which` is true."""
    if seed is None:
        return values
    signs = np.random.default_rng(seed).choice([-1.0, 1.0], len(values))
    return np.where(which, values + FOUR * signs * np.where(values == 0.0, 1.0, values), values)


def verdict(diagram: AcausalDiagram, mode: str, seed: int | None = None) -> str:
    """What the compiler, or else the examination of the start, says; the start's parameters and the states off by some
    roundings."""
    flat = flatten(diagram)
    is_start = np.zeros(len(flat.parameters), bool)
    for group in flat.variables.start.groups:
        is_start[group.parameter] = True
    parameters = moved(flat.declares.values, is_start, seed)
    declared = dataclasses.replace(flat.declares, values=parameters)
    flat = dataclasses.replace(flat, declared=declared)
    try:
        plan = lower(compile_flat(flat, mode, ()))
    except StructuralError:
        return "refused"
    at = initial_point(plan.model, declared)
    values = at.values[:-1].copy()
    _, fixed = start_guess(plan.model, parameters)
    values[list(fixed)] = list(fixed.values())
    x = values[[*plan.states, *plan.carried]]
    x = moved(x, np.ones(len(x), bool), seed)
    found = examine_blocks(plan, parameters, at.networks.weights, 0.0, x, lambda: np.zeros(0))
    return "refused" if any(finding.singular for finding in found) else "regular"


if __name__ == "__main__":
    singular = {name: model for name, model in MODELS.items() if model.expected == "refused"}
    print(json.dumps({name: verdict(model.make(), model.modes[-1]) for name, model in singular.items()}))
