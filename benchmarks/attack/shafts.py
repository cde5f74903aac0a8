"""Shafts in a row with elastic couplings, sharp backlash, clutches and a brake, turned and pressed by tables of time,
against SciPy's DOP853 stopped and started anew wherever a mode changes."""

import copy
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from sympy import Piecewise

from jaxonomy_dae import AcausalDiagram, Component, EqnEnv, Rotational, der
from jaxonomy_dae.library import rotational, signal
from jaxonomy_dae.library.friction import Brake, Clutch
from jaxonomy_dae.write import Eq

from .case import Case, Variant, diagram_of, drawn, log_uniform, names, numbers_of, varied
from .drives import motion_of
from .pieces import CLOSE, Delicate, course_of, in_pieces

STUCK, FREE = 0, 2  # modes of friction, beside 1 and -1


class Play(Component):
    """Backlash with corners: tau = c·(phi_rel ∓ gap/2) + d·w_rel beyond the gap, 0 within it."""

    def __init__(self, ev: EqnEnv, name: str, gap: float, c: float, d: float):
        super().__init__(ev, name)
        gap_, c_, d_ = self.parameter("gap", gap), self.parameter("c", c), self.parameter("d", d)
        a, b = self.port("flange_a", Rotational), self.port("flange_b", Rotational)
        phi, w, tau = self.variable("phi_rel"), self.variable("w_rel"), self.variable("tau")
        law = Piecewise(
            (c_ * (phi - gap_ / 2) + d_ * w, phi > gap_ / 2),
            (c_ * (phi + gap_ / 2) + d_ * w, phi < -gap_ / 2),
            (0, True),
        )
        self.add_equations(Eq(phi, b.phi - a.phi), Eq(w, der(phi)), Eq(b.tau, tau), Eq(a.tau + b.tau, 0), Eq(tau, law))


class Table(Component):
    """y, linear between points in time and constant beyond them, as one writes it."""

    def __init__(self, ev: EqnEnv, name: str, times: Sequence[float], heights: Sequence[float]):
        super().__init__(ev, name)
        ts = [self.parameter(f"t{k}", t) for k, t in enumerate(times)]
        values = [self.parameter(f"y{k}", y) for k, y in enumerate(heights)]
        pieces: list[Any] = [(values[0], ev.t < ts[0])]
        for k in range(len(ts) - 1):
            slope = (values[k + 1] - values[k]) / (ts[k + 1] - ts[k])
            pieces.append((values[k] + slope * (ev.t - ts[k]), ev.t < ts[k + 1]))
        self.output("y", Piecewise(*pieces, (values[-1], True)))


class Now(Component):
    """y = t."""

    def __init__(self, ev: EqnEnv, name: str):
        super().__init__(ev, name)
        self.output("y", ev.t)


class Train:
    """Shafts in a row. `springs`: (c, d) by the number of the shaft behind, 0 for one to the ground; `plays`:
    (gap, c, d); `frictions`: (torque of full pressure, peak, table of pressure) between a shaft and the one before it,
    or the ground for `brake`."""

    def __init__(self, rng: np.random.Generator):
        n = int(rng.integers(1, 5))
        self.end = float(rng.uniform(1, 4))
        self.inertias = [log_uniform(rng, -0.5, 0.5) for _ in range(n)]
        self.springs, self.plays, self.frictions = {}, {}, {}
        for k in range(n):
            if rng.random() < 0.5:
                self.springs[k] = (log_uniform(rng, 0, 2), log_uniform(rng, -2, 0))
            if k and rng.random() < 0.4:
                self.plays[k] = (log_uniform(rng, -1.5, -0.3), log_uniform(rng, 1, 3), log_uniform(rng, -1, 0.5))
            if k and rng.random() < 0.6:
                self.frictions[k] = self._friction(rng)
        self.brake = int(rng.integers(n)) if rng.random() < 0.5 or not (self.frictions or self.plays) else None
        if self.brake is not None:
            self.frictions["brake"] = self._friction(rng)
        self.torque = self._table(rng, -4, 4)
        self.starts = [(0.0, float(rng.normal()) * 2) for _ in range(n)]
        self.together = n > 1 and rng.random() < 0.3  # two at the start
        if self.together:
            self.starts[1] = self.starts[0]
        # Tables written as equations, whose numbers are parameters; the others are from the library.
        self.written = {key for key in ("torque", *self.frictions) if rng.random() < 0.6}
        self._turn()

    def _turn(self) -> None:
        self.corners = sorted(
            {
                t
                for ts, _ in [self.torque, *(table for _, _, table in self.frictions.values())]
                for t in ts
                if t < self.end
            }
        )

    def other(self, rng: np.random.Generator) -> "Train":
        """The same parts with other numbers, tables of the library excepted."""
        out = copy.copy(self)
        out.inertias = [varied(rng, J) for J in self.inertias]
        out.springs = {k: (varied(rng, c), varied(rng, d)) for k, (c, d) in self.springs.items()}
        out.plays = {k: (varied(rng, gap), varied(rng, c), varied(rng, d)) for k, (gap, c, d) in self.plays.items()}

        def table(key, old: tuple[list[float], list[float]]) -> tuple[list[float], list[float]]:
            stretch = rng.uniform(0.7, 1.0)
            return ([t * stretch for t in old[0]], [varied(rng, y) for y in old[1]]) if key in self.written else old

        out.frictions = {
            key: (varied(rng, full), peak, table(key, old)) for key, (full, peak, old) in self.frictions.items()
        }
        out.torque = table("torque", self.torque)
        out.starts = [(0.0, float(rng.normal()) * 2) for _ in self.starts]
        if self.together:
            out.starts[1] = out.starts[0]
        out._turn()
        return out

    def _table(self, rng: np.random.Generator, low: float, high: float) -> tuple[list[float], list[float]]:
        count = int(rng.integers(2, 6))
        ts = np.sort(rng.uniform(0.05, 0.95, count)) * self.end
        while np.diff(ts).min() < 0.02:
            ts = np.sort(rng.uniform(0.05, 0.95, count)) * self.end
        return ts.tolist(), rng.uniform(low, high, count).tolist()

    def _friction(self, rng: np.random.Generator) -> tuple[float, float, tuple[list[float], list[float]]]:
        peak = float(rng.choice([1.0, rng.uniform(1, 1.5)]))
        return log_uniform(rng, -0.3, 0.8), peak, self._table(rng, -0.5 if rng.random() < 0.5 else 0.1, 1.5)

    def ends(self, key) -> tuple[int | None, int]:
        """The shafts that a friction presses together; None is the ground."""
        if key == "brake":
            assert self.brake is not None
            return None, self.brake
        return key - 1, key

    def relative(self, key, y: np.ndarray) -> float:
        a, b = self.ends(key)
        n = len(self.inertias)
        return y[n + b] - (0.0 if a is None else y[n + a])

    def pressure(self, key, t: float) -> float:
        return float(np.interp(t, *self.frictions[key][2]))

    def limit(self, key, t: float) -> float:
        return self.frictions[key][0] * max(self.pressure(key, t), 0.0)

    def moments(self, t: float, y: np.ndarray, modes: dict) -> tuple[np.ndarray, dict]:
        """Accelerations, and the torques of what sticks."""
        n = len(self.inertias)
        phi, w = y[:n], y[n:]
        out = np.zeros(n)
        out[-1] += np.interp(t, *self.torque)

        def between(k: int, tau: float) -> None:
            out[k] -= tau
            if k:
                out[k - 1] += tau

        for k, (c, d) in self.springs.items():
            between(k, c * (phi[k] - (phi[k - 1] if k else 0.0)) + d * (w[k] - (w[k - 1] if k else 0.0)))
        for k, (gap, c, d) in self.plays.items():
            side = modes["play", k]
            if side:
                between(k, c * (phi[k] - phi[k - 1] - side * gap / 2) + d * (w[k] - w[k - 1]))
        stuck = [key for key in self.frictions if modes[key] == STUCK]
        rows = np.zeros((len(stuck), n))
        for key in self.frictions:
            a, b = self.ends(key)
            if modes[key] in (1, -1):
                tau = modes[key] * self.limit(key, t)
                out[b] -= tau
                if a is not None:
                    out[a] += tau
            elif modes[key] == STUCK:
                rows[stuck.index(key), b] = 1.0
                if a is not None:
                    rows[stuck.index(key), a] = -1.0
        inverse = 1 / np.array(self.inertias)
        held = np.linalg.solve((rows * inverse) @ rows.T, rows @ (inverse * out)) if stuck else np.zeros(0)
        return inverse * (out - rows.T @ held), dict(zip(stuck, held, strict=True))

    def slopes(self, t: float, y: np.ndarray, modes: dict) -> np.ndarray:
        return np.concatenate([y[len(self.inertias) :], self.moments(t, y, modes)[0]])

    def guards(self, modes: dict) -> list[tuple[Callable, Callable]]:
        """(guard, what changes when it falls through zero) of all that may happen."""
        out = []
        for key, (_, peak, _) in self.frictions.items():
            mode = modes[key]

            def become(t, y, key=key, value=FREE):
                modes[key] = value

            if mode == FREE:
                out.append(
                    (lambda t, y, key=key: -self.pressure(key, t), lambda t, y, key=key: self._press(key, t, y, modes))
                )
                continue
            out.append((lambda t, y, key=key: self.pressure(key, t), become))
            if mode == STUCK:
                for sign in (1, -1):
                    out.append(
                        (
                            lambda t, y, key=key, sign=sign, most=peak: (
                                most * self.limit(key, t) - sign * self.moments(t, y, modes)[1].get(key, 0.0)
                            ),
                            lambda t, y, b=become, sign=sign: b(t, y, value=sign),
                        )
                    )
            else:
                out.append(
                    (lambda t, y, key=key, mode=mode: mode * self.relative(key, y),
                     lambda t, y, key=key: self._stick(key, t, y, modes))
                )  # fmt: skip
        for k, (gap, _, _) in self.plays.items():
            for side in (1, -1):

                def beyond(t, y, k=k, side=side, gap=gap):
                    return side * (y[k] - y[k - 1]) - gap / 2

                if modes["play", k] == 0:
                    out.append(
                        (
                            lambda t, y, f=beyond: -f(t, y),
                            lambda t, y, k=k, side=side: modes.__setitem__(("play", k), side),
                        )
                    )
                elif modes["play", k] == side:
                    out.append((beyond, lambda t, y, k=k: modes.__setitem__(("play", k), 0)))
        return out

    def _press(self, key, t: float, y: np.ndarray, modes: dict) -> None:
        w = self.relative(key, y)
        if abs(w) < 1e-4:
            raise Delicate("pressed at standstill")
        modes[key] = int(np.sign(w))

    def _stick(self, key, t: float, y: np.ndarray, modes: dict) -> None:
        a, b = self.ends(key)
        n = len(self.inertias)
        y[n + b] = 0.0 if a is None else y[n + a]
        modes[key] = STUCK
        self.hold(key, t, y, modes)

    def hold(self, key, t: float, y: np.ndarray, modes: dict) -> None:
        """What sticks slides on if its torque is too large."""
        most, torque = self.frictions[key][1] * self.limit(key, t), self.moments(t, y, modes)[1][key]
        if abs(abs(torque) - most) < CLOSE:
            raise Delicate("at the verge of sliding")
        if abs(torque) > most:
            modes[key] = int(np.sign(torque))

    def begun(self) -> tuple[np.ndarray, dict]:
        y = np.array([p for p, _ in self.starts] + [w for _, w in self.starts])
        modes: dict[Any, Any] = {("play", k): 0 for k in self.plays}
        for key in self.frictions:
            modes[key] = FREE if self.pressure(key, 0.0) <= 0 else int(np.sign(self.relative(key, y)))
        for key in [key for key in self.frictions if modes[key] == STUCK]:
            self.hold(key, 0.0, y, modes)
        self.settled(0.0, y, modes)
        return y, modes

    def settled(self, t: float, y: np.ndarray, modes: dict) -> None:
        for key, torque in self.moments(t, y, modes)[1].items():
            if abs(torque) > self.frictions[key][1] * self.limit(key, t) - CLOSE:
                raise Delicate("one change makes another")

    def run(self, ts: np.ndarray) -> np.ndarray:
        y, modes = self.begun()
        out, self.changes = in_pieces(
            self.slopes, self.guards, y, modes, ts, self.corners, self.end, changed=self.settled
        )
        return out


def make(seed: int, variants: int = 0) -> Case:
    """Shafts over some seconds."""
    rng = np.random.default_rng([seed, 41])
    while True:
        train = Train(rng)
        ts, values = course_of(rng, train)
        if values is not None and train.changes:
            break
    ev, diagram, _, which = _built([seed, 42], train)
    changes = train.changes

    def variant(numbers: np.random.Generator) -> Variant | None:
        other = train.other(numbers)
        then, found = course_of(numbers, other)
        if found is None:
            return None
        return Variant(numbers_of(_built([seed, 42], other)[2]), {}, motion_of(which, then, found))

    return Case(
        ev, diagram, {}, {}, motion=motion_of(which, ts, values), always_moves=True,
        variants=drawn(variants, [seed, 41], variant),
        note=f"{len(train.inertias)} shafts, {len(train.frictions)} clutches and brakes, {len(train.plays)} plays, "
        f"{changes} changes",
    )  # fmt: skip


def _source(written: bool, ev: EqnEnv, label: Any, table: tuple[list[float], list[float]]) -> tuple[Any, list, list]:
    """A port, the parts behind it, and their connections: a table as equations of its own or from the library."""
    ts, values = table
    if written:
        part = Table(ev, next(label), ts, values)
        return part.y, [part], []
    now = Now(ev, next(label))
    xs, ys = [-1.0, *ts, 100.0], [values[0], *values, values[-1]]
    part = signal.Table1D(ev, next(label), xs, ys, events=True)
    return part.y, [now, part], [[now.y, part.u]]


def _built(seed: list[int], train: Train) -> tuple[EqnEnv, AcausalDiagram, list[Any], list[str]]:
    """The model, its parts, and the names of angles and speeds."""
    rng = np.random.default_rng(seed)
    ev, n = EqnEnv(), len(train.inertias)
    label = iter(names(rng, 8 * n + 12))
    ground = rotational.FixedAngle(ev, next(label))
    shafts = [rotational.Inertia(ev, next(label), J, *at) for J, at in zip(train.inertias, train.starts, strict=True)]
    parts: list[Any] = [ground, *shafts]
    floor, at, wires = [ground.flange], [[s.flange_a] for s in shafts], []
    between: list[tuple[int, Any]] = [
        (k, rotational.SpringDamper(ev, next(label), *own)) for k, own in train.springs.items()
    ]
    between += [(k, Play(ev, next(label), *own)) for k, own in train.plays.items()]
    for key, (full, peak, table) in train.frictions.items():
        mu = float(rng.uniform(0.2, 0.9))
        part: Any = (Brake if key == "brake" else Clutch)(ev, next(label), mu, full / mu, 1.0, peak)
        port, behind, more = _source(key in train.written, ev, label, table)
        parts += behind
        wires += [*more, [port, part.u]]
        if key == "brake":
            parts.append(part)
            at[train.ends(key)[1]].append(part.flange)
        else:
            between.append((key, part))
    for k, part in between:
        parts.append(part)
        (at[k - 1] if k else floor).append(part.flange_a)
        at[k].append(part.flange_b)
    torque = rotational.Torque(ev, next(label))
    port, behind, more = _source("torque" in train.written, ev, label, train.torque)
    parts += [torque, *behind]
    wires += [*more, [port, torque.tau]]
    at[-1].append(torque.flange)
    which = [f"{s.name}.{x}" for x in ("phi", "w") for s in shafts]
    if len(floor) == 1:
        parts.remove(ground)
        floor = []
    return ev, diagram_of(rng, parts, [floor, *at, *wires]), parts, which
