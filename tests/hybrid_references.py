"""What is known of problems with events: closed forms evaluated in extended precision, and loops in NumPy."""

import numpy as np

# A ball dropped from 1 m with g = 9.81 and a restitution of 0.8: times of bounces, its height at t = 3 and its
# derivatives by e, g and the first height, that of the sixth time by e.
BOUNCES = [0.451523640985731, 1.1739614665629, 1.75191172702464, 2.21427193539402, 2.58416010208954, 2.88007063544594]
HEIGHT = 0.0687074609657657
SLOPES = [1.16388772098508, -0.00234772681723926, 0.0917386610428829]
SIXTH_BY_E = 7.78065538147

# Length 1, 5.2 m/s at the lowest point, g = 9.81: it goes slack where v²/L = −g·y/L, the bob flies a parabola back to
# the circle, and the speed along the radius is lost there. Closed forms, evaluated with mpmath.
SLACK, TAUT = 0.487173065075081, 0.487173065075081 + 0.620541476212468
AT_1_5 = np.array([-0.711904658648973, -0.702276125889161])
BY_V0 = np.array([0.688280822774, -0.69771747341])

G, HEAVY, LIGHT = 9.81, 1.0, 0.3


def falling_balls(T, e):
    """Heights and speeds of two balls, the light one above the heavy one, from bounce to bounce."""
    t, times = 0.0, []
    h, v = np.array([1.0, 1.5]), np.zeros(2)
    while True:
        floor = (v[0] + np.sqrt(v[0] ** 2 + 2 * G * h[0])) / G
        meet = (h[1] - h[0]) / (v[0] - v[1]) if v[0] > v[1] else np.inf
        s = min(floor, meet, T - t)
        h, v, t = h + v * s - G * s * s / 2, v - G * s, t + s
        if t >= T:
            return h, times
        times.append(t)
        if floor < meet:
            h[0], v[0] = 0.0, -e * v[0]
        else:
            total, apart = HEAVY * v[0] + LIGHT * v[1], e * (v[0] - v[1])
            h[1], v = h[0], np.array([total - LIGHT * apart, total + HEAVY * apart]) / (HEAVY + LIGHT)


def commensurate_counts(n):
    """Three counters at 0.1, 0.2 and 0.3 s that read each other, in integers: what they are in each of n tenths."""
    rows, a, b, c = [], 0, 0, 0
    for k in range(n):
        before, a = a, a + 1
        b += 100 * a if k % 2 == 0 else 0
        c += 1000 * before + b if k % 3 == 0 else 0
        rows.append((a, b, c))
    return np.array(rows)
