"""Masses in a row with springs, dry friction that sticks and elastic stops, moved by ramps or a sine, against SciPy's
DOP853 stopped and started anew wherever a mode changes."""

import copy
from collections.abc import Callable
from typing import Any

import numpy as np

from jaxonomy_dae import EqnEnv
from jaxonomy_dae.library import signal, translational
from jaxonomy_dae.library.friction import StickingFriction

from .case import Case, Motion, Variant, diagram_of, drawn, log_uniform, names, numbers_of, varied
from .pieces import CLOSE, Delicate, course_of, in_pieces

TRAJECTORY = 50e-6  # of a variable's size, at the default tolerances: fifty times rtol


class Row:
    """Masses in a row. `friction`: (sliding, breakaway) of each against the ground, or None. `springs`: (K, D, length)
    between neighbours, the first to the ground. `stops`: (K, D, length) of a mass against the ground, by number, which
    push it up. `force`: of time, on the last mass; `corners`: where that is not smooth."""

    def __init__(self, rng: np.random.Generator):
        n = int(rng.integers(1, 4))
        self.masses = [log_uniform(rng, -0.5, 0.5) for _ in range(n)]
        self.springs = [(log_uniform(rng, 0, 2), log_uniform(rng, -2, 0), 0.0) for _ in range(n)]
        self.starts = [(0.3 * float(rng.normal()), float(rng.normal())) for _ in range(n)]
        self.friction: list[tuple[float, float] | None] = []
        for _ in range(n):
            c = log_uniform(rng, -1, 0.5)
            self.friction.append(None if rng.random() < 0.3 else (c, c * float(rng.choice([1.0, rng.uniform(1, 1.5)]))))
        self.stops = {
            k: (log_uniform(rng, 2, 4), log_uniform(rng, -1, 1), float(rng.uniform(-0.5, -0.1)))
            for k in range(n)
            if rng.random() < 0.5
        }
        self.end = float(rng.uniform(2, 6))
        self.ramps: list[tuple[float, float, float]] = []  # height, duration, start
        self.sine: tuple[float, float, float] | None = None
        if rng.random() < 0.7:
            for _ in range(2):
                self.ramps.append(
                    (5 * float(rng.normal()), float(rng.uniform(0.1, 2)), float(rng.uniform(0.1, self.end)))
                )
        else:
            self.sine = log_uniform(rng, 0, 1), log_uniform(rng, -0.5, 0.5), float(rng.uniform(-3, 3))
        self._turn()

    def _turn(self) -> None:
        self.corners = sorted(t for _, d, s in self.ramps for t in (s, s + d) if t < self.end)

    def other(self, rng: np.random.Generator) -> "Row":
        """The same parts with other numbers."""
        out = copy.copy(self)
        out.masses = [varied(rng, m) for m in self.masses]
        out.springs = [(varied(rng, k), varied(rng, d), length) for k, d, length in self.springs]
        out.starts = [(0.3 * float(rng.normal()), float(rng.normal())) for _ in self.starts]
        out.friction = [own and (f * own[0], f * own[1]) for own in self.friction if (f := varied(rng, 1.0))]
        out.stops = {k: (varied(rng, K), varied(rng, d), varied(rng, at)) for k, (K, d, at) in self.stops.items()}
        out.ramps = [(varied(rng, h), varied(rng, d), varied(rng, start)) for h, d, start in self.ramps]
        if self.sine:
            amplitude, f, _ = self.sine
            out.sine = varied(rng, amplitude), varied(rng, f), float(rng.uniform(-3, 3))
        out._turn()
        return out

    def force(self, t: float) -> float:
        if self.sine:
            amplitude, f, phase = self.sine
            return amplitude * np.sin(2 * np.pi * f * t + phase)
        return sum(h * min(max((t - s) / d, 0.0), 1.0) for h, d, s in self.ramps)

    def pulls(self, t: float, y: np.ndarray, modes: dict) -> np.ndarray:
        """The forces on the masses, friction apart."""
        n = len(self.masses)
        s, v = y[:n], y[n:]
        out = np.zeros(n)
        out[-1] += self.force(t)
        for k, (stiffness, damping, length) in enumerate(self.springs):
            f = stiffness * (s[k] - (s[k - 1] if k else 0.0) - length) + damping * (v[k] - (v[k - 1] if k else 0.0))
            out[k] -= f
            if k:
                out[k - 1] += f
        for k, (stiffness, damping, length) in self.stops.items():
            mode = modes["stop", k]
            if mode is not None:
                pushed = stiffness * (length - s[k])
                out[k] += pushed - {-1: -pushed, 1: pushed, 0: damping * v[k]}[mode]
        return out

    def slopes(self, t: float, y: np.ndarray, modes: dict) -> np.ndarray:
        n = len(self.masses)
        v, pulls = y[n:], self.pulls(t, y, modes)
        a = np.zeros(n)
        for k, m in enumerate(self.masses):
            own, mode = self.friction[k], modes["friction", k]
            a[k] = 0.0 if mode == 0 else (pulls[k] - (mode * own[0] if own else 0.0)) / m
        return np.concatenate([np.where([modes["friction", k] == 0 for k in range(n)], 0.0, v), a])

    def guards(self, modes: dict) -> list[tuple[Callable, Callable]]:
        """(guard, what changes when it falls through zero) of all that may happen."""
        n, out = len(self.masses), []
        for k, own in enumerate(self.friction):
            if own is None:
                continue
            mode = modes["friction", k]
            if mode:
                out.append(
                    (lambda t, y, k=k, mode=mode: mode * y[n + k], lambda t, y, k=k: self._stick(k, t, y, modes))
                )
            else:
                out += [
                    (lambda t, y, k=k, b=own[1], sign=sign: b - sign * self.pulls(t, y, modes)[k],
                     lambda t, y, k=k, sign=sign: modes.__setitem__(("friction", k), sign))
                    for sign in (1, -1)
                ]  # fmt: skip
        for k, (stiffness, damping, length) in self.stops.items():
            key, mode = ("stop", k), modes["stop", k]
            if mode is None:
                out.append((lambda t, y, k=k, length=length: y[k] - length, lambda t, y, k=k: self._touch(k, y, modes)))
                continue
            out.append((lambda t, y, k=k, length=length: length - y[k],
                        lambda t, y, key=key: modes.__setitem__(key, None)))  # fmt: skip
            for sign in (-1, 1):  # the damper at a limit, or not

                def margin(t, y, k=k, sign=sign, a=(stiffness, damping, length)):
                    return a[0] * (a[2] - y[k]) - sign * a[1] * y[n + k]

                if mode == 0:
                    out.append((margin, lambda t, y, key=key, sign=sign: modes.__setitem__(key, sign)))
                elif mode == sign:
                    out.append((lambda t, y, m=margin: -m(t, y), lambda t, y, key=key: modes.__setitem__(key, 0)))
        return out

    def _stick(self, k: int, t: float, y: np.ndarray, modes: dict) -> None:
        y[len(self.masses) + k] = 0.0
        modes["friction", k] = 0
        own, pull = self.friction[k], self.pulls(t, y, modes)[k]
        assert own is not None
        if abs(abs(pull) - own[1]) < CLOSE:
            raise Delicate("at the verge of sliding")
        if abs(pull) > own[1]:
            modes["friction", k] = int(np.sign(pull))

    def _touch(self, k: int, y: np.ndarray, modes: dict) -> None:
        modes["stop", k] = -1 if y[len(self.masses) + k] < 0 else 1  # without depth, the damper is at its limit

    def run(self, ts: np.ndarray) -> np.ndarray:
        n = len(self.masses)
        y = np.array([s for s, _ in self.starts] + [v for _, v in self.starts])
        modes: dict[Any, Any] = {("friction", k): int(np.sign(y[n + k])) for k in range(n)}
        modes |= {("stop", k): None for k in self.stops}
        if any(y[k] < length + 1e-3 for k, (_, _, length) in self.stops.items()):
            raise Delicate("begins within a stop")
        return in_pieces(self.slopes, self.guards, y, modes, ts, self.corners, self.end)[0]


def make(seed: int, variants: int = 0) -> Case:
    """A drive over some seconds."""
    rng = np.random.default_rng([seed, 37])
    while True:
        row = Row(rng)
        ts, values = course_of(rng, row)
        if values is not None:
            break
    ev, diagram, parts, which = _built([seed, 38], row)

    def variant(numbers: np.random.Generator) -> Variant | None:
        other = row.other(numbers)
        then, found = course_of(numbers, other)
        if found is None:
            return None
        return Variant(numbers_of(_built([seed, 38], other)[2]), {}, motion_of(which, then, found))

    return Case(
        ev, diagram, {}, {}, motion=motion_of(which, ts, values), always_moves=True,
        variants=drawn(variants, [seed, 37], variant),
        note=f"{len(row.masses)} masses, {sum(own is not None for own in row.friction)} stick, {len(row.stops)} stops, "
        f"{'a sine' if row.sine else 'ramps'}",
    )  # fmt: skip


def motion_of(which: list[str], ts: np.ndarray, values: np.ndarray) -> Motion:
    """By positions, then speeds."""
    n = len(which) // 2
    sizes = [max(np.abs(values[:, :n]).max(), 0.1)] * n + [max(np.abs(values[:, n:]).max(), 0.1)] * n
    allowed = {name: TRAJECTORY * size for name, size in zip(which, sizes, strict=True)}
    return Motion(ts, dict(zip(which, values.T, strict=True)), allowed, rtol=1e-6, atol=1e-9)


def _built(seed: list[int], row: Row) -> tuple[EqnEnv, Any, list[Any], list[str]]:
    """The model, its parts, and the names of positions and speeds."""
    rng = np.random.default_rng(seed)
    ev, n = EqnEnv(), len(row.masses)
    label = iter(names(rng, 4 * n + 8))
    ground = translational.FixedPosition(ev, next(label))
    masses = [translational.Mass(ev, next(label), m, *at) for m, at in zip(row.masses, row.starts, strict=True)]
    parts: list[Any] = [ground, *masses]
    floor, at = [ground.flange], [[m.flange] for m in masses]
    for k, spring in enumerate(row.springs):
        part = translational.SpringDamper(ev, next(label), *spring)
        parts.append(part)
        (at[k - 1] if k else floor).append(part.flange_a)
        at[k].append(part.flange_b)
    fixed: list[tuple[int, Any]] = [(k, StickingFriction(ev, next(label), *own))
                                    for k, own in enumerate(row.friction) if own]  # fmt: skip
    fixed += [(k, translational.ElasticStop(ev, next(label), *own)) for k, own in row.stops.items()]
    for k, part in fixed:
        parts.append(part)
        floor.append(part.flange_a)
        at[k].append(part.flange_b)
    force = translational.Force(ev, next(label))
    at[-1].append(force.flange)
    if row.sine:
        amplitude, f, phase = row.sine
        source = signal.Sine(ev, next(label), amplitude, f, phase)
        drive, wires = [source], [[source.y, force.f]]
    else:
        one, two = (signal.Ramp(ev, next(label), *ramp) for ramp in row.ramps)
        both = signal.Sum(ev, next(label))
        drive, wires = [one, two, both], [[one.y, both.u1], [two.y, both.u2], [both.y, force.f]]
    parts += [force, *drive]
    which = [f"{m.name}.{x}" for x in "sv" for m in masses]
    return ev, diagram_of(rng, parts, [floor, *at, *wires]), parts, which
