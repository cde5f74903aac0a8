"""Masses that fall on each other and on the ground, with random masses, restitutions and starts, against parabolas from
impact to impact by NumPy."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import compiled

import jaxonomy_dae.library.translational as line
from jaxonomy_dae import EqnEnv, simulate
from jaxonomy_dae.library.contacts import HardStop

G, N, END, MOST = 9.81, 3, 2.0, 120
KINDS = ("m{}.m", "s{}.restitution", "m{}.initial_position", "m{}.initial_velocity")


def from_impact_to_impact(p):
    """(positions, speeds, how many impacts) at the end, for parameters in the order of `KINDS`; the restitutions are
    those with the ground and with the mass below."""
    m, e, s, v = (row.copy() for row in np.reshape(p, (4, N)))
    t, count, last = 0.0, 0, None
    while count <= MOST:
        # None meets the one whom it has just left, but the lowest the ground.
        down = 2 * v[0] / G if last == 0 else (v[0] + np.sqrt(v[0] ** 2 + 2 * G * s[0])) / G
        times = [down] + [
            -(s[k] - s[k - 1]) / (v[k] - v[k - 1]) if v[k] < v[k - 1] and last != k else np.inf for k in range(1, N)
        ]
        k = int(np.argmin(times))
        dt = min(times[k], END - t)
        s, v, t = s + v * dt - G * dt**2 / 2, v - G * dt, t + dt
        if dt < times[k]:
            return s, v, count
        count, last = count + 1, k
        if k == 0:
            s[0], v[0] = 0.0, -e[0] * v[0]
        else:
            pulse = m[k - 1] * m[k] / (m[k - 1] + m[k]) * (1 + e[k]) * (v[k] - v[k - 1])
            s[k] = s[k - 1]
            v[k - 1], v[k] = v[k - 1] + pulse / m[k - 1], v[k] - pulse / m[k]
    return None


@functools.cache
def tower():
    ev = EqnEnv()
    ground = line.FixedPosition(ev, "ground")
    masses = [line.Mass(ev, f"m{k}", 1.0, float(k + 1), 0.0) for k in range(N)]
    stops = [HardStop(ev, f"s{k}", restitution=0.9, rest_speed=0.0) for k in range(N)]
    weights = [line.Force(ev, f"w{k}") for k in range(N)]
    joints = [(ground.flange, stops[0].flange_a)]
    for k in range(N):
        above = [stops[k + 1].flange_a] if k + 1 < N else []
        joints.append((stops[k].flange_b, masses[k].flange, weights[k].flange, *above))
    return compiled(ground, *masses, *stops, *weights, connect=joints)


def run(p):
    names = [kind.format(k) for kind in KINDS for k in range(N)]
    system = tower().with_parameters(dict(zip(names, p, strict=True)))
    inputs = {f"w{k}.f": -G * p[k] for k in range(N)}
    solution = simulate(
        system, END, ts=jnp.array([END]), inputs=inputs, rtol=1e-10, atol=1e-10, max_events=MOST + 5
    )  # fmt: skip
    found = jnp.stack([solution[f"m{k}.{n}"][-1] for n in "sv" for k in range(N)])
    return found, jnp.sum(jnp.isfinite(solution.events.ts))


@pytest.mark.slow
def test_random_towers():
    @jax.jit
    @functools.partial(jax.grad, has_aux=True)
    def ran(p):
        found, impacts = run(p)
        return found[:N].sum(), (found, impacts)

    rng, compared = np.random.default_rng(0), 0
    while compared < 8:
        p = np.concatenate([
            rng.uniform(0.3, 3.0, N), rng.uniform(0.5, 1.0, N), np.cumsum(rng.uniform(0.2, 1.0, N)),
            rng.uniform(-2.0, 2.0, N),
        ])  # fmt: skip
        known, moved = from_impact_to_impact(p), from_impact_to_impact(p * (1 + 1e-9))
        if known is None or moved is None or known[2] != moved[2]:
            continue  # impacts that accumulate, or whose order is about to change
        expected = np.concatenate(known[:2])
        amplified = np.abs(np.concatenate(moved[:2]) - expected).max() / 1e-9
        gradient, (found, impacts) = ran(p)
        assert int(impacts) == known[2]
        # Between impacts all is polynomial: rounding and the search for events, a few 1e-12, by how much the problem
        # amplifies them from impact to impact.
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-11 * (1 + amplified))

        def total(p):
            return from_impact_to_impact(p)[0].sum()

        h = 1e-7
        differences = np.array([(total(p + h * d) - total(p - h * d)) / (2 * h) for d in np.eye(len(p))])
        scale = np.abs(differences).max()
        np.testing.assert_allclose(gradient, differences, rtol=0, atol=1e-5 * scale)  # rounding/h
        compared += 1
