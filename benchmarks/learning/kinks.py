"""What bands of laws with kinks can cover: a prior of smoothness, the same everywhere or with local precisions.

    python benchmarks/learning/kinks.py [draws of the noise] [gap,stribeck,drag]

As in `allowed.py`, a law is a vector f of its values at 81 places of what the true run explores, straight between them,
and a record is J f + noise of 1 mm, with J from the variational equations along that run. Second and third differences
of f are normal around zero with two precisions, which the evidence chooses (MacKay 1992, Neural Computation 4:415).
With local precisions each difference has Student's distribution of ν degrees of freedom instead: its precision is
multiplied by (ν + 1)/(ν + α E h²), by expectation and maximization (Geweke 1993, J. Appl. Econometrics 8:S19).

A row gives medians of the error and of the band's standard deviation over the explored range, relative to the law's
size, and how much of the range the 95 % band covers. It needs NumPy and SciPy alone.
"""

import sys

import numpy as np
from scipy.integrate import solve_ivp

KNOTS, NOISE, SAMPLES, STEPS, SECONDS = 81, 1e-3, 200, 20, 6.0  # steps between two samples
ROUNDS, EVERY, SETTLED = 150, 5, 1e-3
FREEDOMS = (0, 3, 5)  # 0: the same precision everywhere


def gap(x):
    """(Force of a spring behind a gap, its slope)."""
    return 8.0 * (x - np.clip(x, -0.3, 0.3)), 8.0 * (abs(x) > 0.3)


def stribeck(v):
    """(Friction that falls before it rises, its slope)."""
    fall, sign = np.exp(-((v / 0.2) ** 2)), np.tanh(v / 0.05)
    slope = (1 + 0.5 * fall) * (1 - sign**2) / 0.05 - 0.5 * fall * 2 * v / 0.04 * sign + 0.3
    return (1 + 0.5 * fall) * sign + 0.3 * v, slope


def drag(v):
    """(Drag that grows with the square, its slope)."""
    return 0.3 * v * abs(v), 0.6 * abs(v)


# x'' = u(t) − d x' − g sin x − f: the law, of which state (0: x, 1: x') it is, u, d, g, and the start of x.
PLANTS = {
    "gap": (gap, 0, lambda t: 3.0 * np.sin(1.3 * t) + 2.0 * np.sin(3.1 * t), 0.5, 0.0, 0.0),
    "stribeck": (stribeck, 1, lambda t: 2.0 * np.sin(1.7 * t) + np.sin(4.1 * t), 0.0, 0.0, 0.0),
    "drag": (drag, 1, lambda t: 0.0 * t, 0.0, 9.81, 0.5),
}


def record(name):
    """(J, the law's values)."""
    law, of, force, damping, gravity, start = PLANTS[name]

    def field(t, s):
        return [s[1], force(t) - damping * s[1] - law(s[of])[0] - gravity * np.sin(s[0])]

    h = SECONDS / SAMPLES / STEPS
    run = solve_ivp(
        field, (0, SECONDS), [start, 0.0], "LSODA", dense_output=True, rtol=1e-10, atol=1e-12, max_step=0.01
    )
    states = run.sol(np.arange(2 * SAMPLES * STEPS + 1) * h / 2)
    seen = states[of]
    knots = np.linspace(seen.min(), seen.max(), KNOTS)
    hats = np.stack([np.interp(seen, knots, one) for one in np.eye(KNOTS)], axis=1)
    slope, pull = law(seen)[1], gravity * np.cos(states[0])

    def rate(moved, i):
        return np.stack([moved[1], -damping * moved[1] - slope[i] * moved[of] - pull[i] * moved[0] - hats[i]])

    moved, rows = np.zeros((2, KNOTS)), []
    for k in range(SAMPLES * STEPS):
        one = rate(moved, 2 * k)
        two = rate(moved + h / 2 * one, 2 * k + 1)
        three = rate(moved + h / 2 * two, 2 * k + 1)
        moved = moved + h / 6 * (one + 2 * two + 2 * three + rate(moved + h * three, 2 * k + 2))
        if (k + 1) % STEPS == 0:
            rows.append(moved[0])
    return np.array(rows), law(knots)[0]


def fitted(j, y, freedom):
    """(f, its standard deviations) from samples in units of the noise."""
    bends = [np.diff(np.eye(KNOTS), k, axis=0) * (KNOTS - 1) ** (k - 0.5) for k in (2, 3)]
    local, precision, data = [np.ones(len(b)) for b in bends], [1e-3, 1e-5], j.T @ j
    for turn in range(ROUNDS):
        parts = [(b.T * w) @ b for b, w in zip(bends, local, strict=True)]
        prior = sum(a * part for a, part in zip(precision, parts, strict=True))
        covariance = np.linalg.inv(data + prior)
        mean = covariance @ (j.T @ y)
        before, better = np.linalg.pinv(prior, rcond=1e-12, hermitian=True), []
        for a, part in zip(precision, parts, strict=True):
            determined = a * (np.sum(before * part) - np.sum(covariance * part))
            better.append(np.clip(max(determined, 1e-6) / (mean @ part @ mean), 1e-14, 1e8))
        change = max(abs(np.log(new / old)) for new, old in zip(better, precision, strict=True))
        precision = better
        if freedom and turn % EVERY == EVERY - 1:
            for k, b in enumerate(bends):
                squares = (b @ mean) ** 2 + np.sum((b @ covariance) * b, axis=1)
                local[k] = (freedom + 1) / (freedom + precision[k] * squares)
        if change < SETTLED and not freedom:
            break
    return mean, np.sqrt(np.diag(covariance))


def main(draws, names):
    print("| law | ν | error | stated | covered |\n|---|---|---|---|---|")
    for name in names:
        jacobian, law = record(name)
        j, size = jacobian / NOISE, np.sqrt(np.mean(law**2))
        for freedom in FREEDOMS:
            rows = []
            for seed in range(draws):
                mean, spread = fitted(j, j @ law + np.random.default_rng(seed).standard_normal(SAMPLES), freedom)
                off = mean - law
                rows.append(
                    [*(np.sqrt(np.mean(a**2)) / size for a in (off, spread)), np.mean(abs(off) <= 1.96 * spread)]
                )
            error, stated, covered = 100 * np.array(rows).T
            kind = freedom or "same everywhere"
            print(
                f"| {name} | {kind} | {np.median(error):.2f} % | {np.median(stated):.2f} % | {covered.mean():.1f} % |",
                flush=True,
            )


if __name__ == "__main__":
    given = [*sys.argv[1:], None, None]
    main(int(given[0] or 30), (given[1] or ",".join(PLANTS)).split(","))
