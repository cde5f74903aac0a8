"""What a record allows: how well any method with generic smoothness can know the drag law of a pendulum.

    python benchmarks/learning/allowed.py [draws of the noise]

Around the true law, runs are linear in small changes of it. So a law is a vector f of its values at 81 speeds, straight
between them, and a record is J f + noise of 1 mm, with J from the variational equations along the true run. The prior
is that of `learning/smoothness.py`: second and third derivatives are normal around zero with two precisions. The
evidence chooses these from the record (restricted likelihood; Patterson & Thompson 1971, Biometrika 58:545); an oracle
chooses those with the least error. What is known beforehand restricts f. Errors are root mean squares over the explored
range, relative to the law's size: medians over the draws.
"""

import sys

import numpy as np

DRAG, GRAVITY, START, NOISE, SAMPLES, STEPS = 0.3, 9.81, 0.5, 1e-3, 200, 30  # steps between two samples
KNOTS = 81
PRECISIONS = 10.0 ** np.arange(-10, 7)


def slopes(s, knots):
    """Those of angle, angular velocity, and the derivatives of both by the law's values, shape (2, 1 + knots)."""
    a, w = s[:, 0]
    values = np.zeros(len(knots))
    k = int(np.clip((w - knots[0]) / (knots[1] - knots[0]), 0, len(knots) - 2))
    share = (w - knots[k]) / (knots[1] - knots[0])
    values[k : k + 2] = 1 - share, share
    out = np.empty_like(s)
    out[0] = s[1]
    out[1, 0] = -GRAVITY * np.sin(a) - DRAG * w * abs(w)
    out[1, 1:] = -GRAVITY * np.cos(a) * s[0, 1:] - 2 * DRAG * abs(w) * s[1, 1:] - values
    return out


def record(seconds):
    """(speeds of the law's values, J, speeds along the run)."""
    widest = START * np.sqrt(GRAVITY)
    knots = np.linspace(-widest, widest, KNOTS)
    s, h = np.zeros((2, 1 + KNOTS)), seconds / SAMPLES / STEPS
    s[0, 0] = START
    rows, seen = [], []
    for k in range(SAMPLES * STEPS):
        one = slopes(s, knots)
        two = slopes(s + h / 2 * one, knots)
        three = slopes(s + h / 2 * two, knots)
        s = s + h / 6 * (one + 2 * two + 2 * three + slopes(s + h * three, knots))
        if (k + 1) % STEPS == 0:
            rows.append(s[0, 1:])
            seen.append(s[1, 0])
    return knots, np.array(rows), np.array(seen)


def restricted(known, knots):
    """Columns of what the law may be: by numbers c, f = B c."""
    eye, half = np.eye(KNOTS), KNOTS // 2
    if known == "nothing":
        return eye
    if known == "zero at rest":
        return np.delete(eye, half, axis=1)
    return (eye - eye[::-1])[:, half + 1 :]  # odd


def errors(knots, jacobian, basis, inside, draws):
    """(those by evidence, those of the oracle), of each draw."""
    law = DRAG * knots * abs(knots)
    j, h = jacobian @ basis / NOISE, (knots[1] - knots[0]) / (knots[-1] - knots[0])
    bends = [np.diff(np.eye(KNOTS), k, axis=0) @ basis / h ** (k - 0.5) for k in (2, 3)]
    data = j.T @ j
    chosen, best = np.full((2, draws), np.inf)
    worth = np.full(draws, -np.inf)
    noise = np.random.default_rng(0).standard_normal((draws, SAMPLES))
    seen = jacobian @ law / NOISE + noise
    for alpha in PRECISIONS:
        for beta in PRECISIONS:
            prior = alpha * bends[0].T @ bends[0] + beta * bends[1].T @ bends[1]
            values = np.linalg.eigvalsh(prior)
            values = values[values > 1e-10 * values[-1]]
            whole = data + prior
            found = np.linalg.solve(whole, j.T @ seen.T)
            left = np.sum(seen**2, axis=1) - np.sum((j.T @ seen.T) * found, axis=0)
            evidence = 0.5 * (np.sum(np.log(values)) - np.linalg.slogdet(whole)[1] - left)
            off = (basis @ found - law[:, None])[inside]
            error = np.sqrt(np.mean(off**2, axis=0) / np.mean(law[inside] ** 2))
            chosen = np.where(evidence > worth, error, chosen)
            worth, best = np.maximum(evidence, worth), np.minimum(error, best)
    return chosen, best


def power(knots, jacobian, inside, draws):
    """Errors of a law c |v|^p, of which c and p are fitted."""
    law = DRAG * knots * abs(knots)
    with np.errstate(divide="ignore", invalid="ignore"):
        logs = np.where(knots == 0, 0.0, law * np.log(abs(knots)))
    basis = np.stack([law, logs], axis=1)
    noise = NOISE * np.random.default_rng(0).standard_normal((draws, SAMPLES))
    off = (basis @ np.linalg.lstsq(jacobian @ basis, noise.T, rcond=None)[0])[inside]
    return np.sqrt(np.mean(off**2, axis=0) / np.mean(law[inside] ** 2))


def main(draws):
    print("| record | what is known of the law | by evidence | oracle |\n|---|---|---|---|")
    for seconds in (6, 20):
        knots, jacobian, seen = record(seconds)
        inside = (knots >= seen.min()) & (knots <= seen.max())
        for known in ("nothing", "zero at rest", "a function of the speed alone"):
            found = errors(knots, jacobian, restricted(known, knots), inside, draws)
            by, oracle = (100 * np.median(each) for each in found)
            print(f"| {seconds} s | {known} | {by:.2f} % | {oracle:.2f} % |", flush=True)
        by = 100 * np.median(power(knots, jacobian, inside, draws))
        print(f"| {seconds} s | a power of the speed | {by:.2f} % | |", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 200)
