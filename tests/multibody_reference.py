"""Rigid bodies on pins, in NumPy and SciPy: Newton's and Euler's equations with multipliers (Haug 1989, section 11.2).

Places are complex numbers. A body's are those of its first pin; its centre of mass lies at `centre` along its own axes.
The accelerations that keep the pins closed are integrated by DOP853: over times of a few swings the pins open by less
than the tolerance of the integration.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import scipy.integrate

GROUND = -1


@dataclasses.dataclass(frozen=True)
class Mechanism:
    """Bodies and pins.

    - `mass`, `inertia` (about the centre of mass), `gravity` (complex), `centre` (complex): of each body.
    - `pins`: pairs of ends, each a body and a place on it (complex); the place is absolute on GROUND.
    - `torque`: on bodies, against the ground. `spring`: two ends, stiffness, damping and relaxed length.
    """

    mass: np.ndarray
    inertia: np.ndarray
    gravity: np.ndarray
    centre: np.ndarray
    pins: Sequence[tuple[tuple[int, complex], tuple[int, complex]]]
    torque: Mapping[int, float] = dataclasses.field(default_factory=dict)
    spring: tuple[tuple[int, complex], tuple[int, complex], float, float, float] | None = None

    def place(self, q: np.ndarray, end: tuple[int, complex]) -> tuple[complex, complex]:
        """Where an end is, and the lever from its body's centre of mass."""
        body, on = end
        if body == GROUND:
            return on, 0.0
        lever = (on - self.centre[body]) * np.exp(1j * q[2 * len(self.mass) + body])
        return q[body] + 1j * q[len(self.mass) + body] + lever, lever

    def closure(self, q: np.ndarray) -> np.ndarray:
        """What the pins are open by: x and y of each."""
        gaps = np.array([self.place(q, a)[0] - self.place(q, b)[0] for a, b in self.pins])
        return np.concatenate([gaps.real, gaps.imag])

    def jacobian(self, q: np.ndarray) -> np.ndarray:
        n, rows = len(self.mass), len(self.pins)
        out = np.zeros((2 * rows, 3 * n))
        for k, pair in enumerate(self.pins):
            for sign, end in zip((1.0, -1.0), pair, strict=True):
                body = end[0]
                if body != GROUND:
                    turned = 1j * self.place(q, end)[1]
                    out[k, body] += sign
                    out[rows + k, n + body] += sign
                    out[k, 2 * n + body] += sign * turned.real
                    out[rows + k, 2 * n + body] += sign * turned.imag
        return out

    def accelerations(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        n = len(self.mass)
        speed = v[2 * n :]
        force, torque = self.mass * self.gravity, np.zeros(n)
        for body, value in self.torque.items():
            torque[body] += value
        if self.spring is not None:
            one, other, stiffness, damping, relaxed = self.spring
            (a, lever_a), (b, lever_b) = self.place(q, one), self.place(q, other)
            along = (b - a) / abs(b - a)
            drift = [
                0.0 if end[0] == GROUND else v[end[0]] + 1j * v[n + end[0]] + 1j * speed[end[0]] * lever
                for end, lever in ((one, lever_a), (other, lever_b))
            ]
            stretching = (np.conj(along) * (drift[1] - drift[0])).real
            pull = (stiffness * (abs(b - a) - relaxed) + damping * stretching) * along
            for end, lever, f in ((one, lever_a, pull), (other, lever_b, -pull)):
                if end[0] != GROUND:
                    force[end[0]] += f
                    torque[end[0]] += (np.conj(lever) * f).imag
        # What the levers' turning adds to the second derivatives of the gaps: −ω²·lever.
        turning = np.zeros(len(self.pins), complex)
        for k, pair in enumerate(self.pins):
            for sign, end in zip((1.0, -1.0), pair, strict=True):
                if end[0] != GROUND:
                    turning[k] += sign * self.place(q, end)[1] * speed[end[0]] ** 2
        g = self.jacobian(q)
        inverse = 1.0 / np.concatenate([self.mass, self.mass, self.inertia])
        free = inverse * np.concatenate([force.real, force.imag, torque])
        wanted = np.concatenate([turning.real, turning.imag])
        multipliers = np.linalg.solve((g * inverse) @ g.T, wanted - g @ free)
        return free + inverse * (g.T @ multipliers)

    def start(
        self, guess: Any, angles: Sequence[tuple[np.ndarray, float]], speeds: Sequence[float]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Positions near the angles guessed, and speeds: `angles` are rows of what is given of the bodies' angles, with
        their values, and `speeds` their derivatives."""
        n = len(self.mass)
        given = np.array([np.concatenate([np.zeros(2 * n), row]) for row, _ in angles])
        values = np.array([value for _, value in angles])
        q = np.concatenate([np.zeros(2 * n), np.asarray(guess, float)])

        def step(residual, chosen=slice(None)):
            matrix = np.concatenate([self.jacobian(q), given])
            return np.linalg.lstsq(matrix[:, chosen], -residual, rcond=None)[0]

        # With the angles guessed the places follow, as well as they can; then Newton's method for all.
        q[: 2 * n] += step(np.concatenate([self.closure(q), given @ q - values]), slice(2 * n))
        for _ in range(30):
            change = step(np.concatenate([self.closure(q), given @ q - values]))
            q += change
            if np.abs(change).max() < 1e-15:
                break
        return q, step(-np.concatenate([np.zeros(2 * len(self.pins)), np.asarray(speeds, float)]))

    def solve(
        self, q: np.ndarray, v: np.ndarray, ts: np.ndarray, rtol: float = 1e-12
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Angles (bodies, times), speeds of the angles, and places of the centres of mass (complex)."""
        n, half = len(self.mass), len(q)

        def slopes(t, y):
            return np.concatenate([y[half:], self.accelerations(y[:half], y[half:])])

        solved = scipy.integrate.solve_ivp(
            slopes, (ts[0], ts[-1]), np.concatenate([q, v]), "DOP853", ts, rtol=rtol, atol=0.1 * rtol
        )
        assert solved.success
        y = solved.y
        return y[2 * n : 3 * n], y[half + 2 * n :], y[:n] + 1j * y[n : 2 * n]
