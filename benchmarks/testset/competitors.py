"""Other programs on the index-1 equations: SUNDIALS IDA (scikit-sundae), IDAS (CasADi), and SciPy's Radau.

Each function takes a `Problem` and tolerances, and returns an `Outcome` or raises `NotApplicable`. IDA calls its
residual in Python, so its steps compare, its times do not; CasADi's IDAS runs compiled residuals and exact Jacobians.
"""

from collections.abc import Callable

import numpy as np
import scipy.integrate

from .index_one import IndexOne
from .outcome import Outcome, timed
from .problem import Problem

MAX_STEPS = 1_000_000


class NotApplicable(Exception):
    """The solver cannot take this problem; says why."""


def _slopes(one: IndexOne, t: float) -> np.ndarray:
    """Some dy/dt with M·dy/dt = F(t, y0), those of algebraic unknowns by a difference quotient where that is easy.

    IDA extrapolates with it, and gives up if the first steps predict algebraic unknowns badly.
    """
    right = one.numpy(t, one.y0)
    if not one.linear:
        return np.linalg.lstsq(one.matrix(), right, rcond=None)[0]
    n, h = one.split(), 1e-7
    x0, slope = one.y0[:n], right[:n]
    return np.concatenate([slope, (one.algebraics(t + h, x0 + h * slope) - one.y0[n:]) / h])


def ida(problem: Problem, rtol: float, atol: float, repeat: Callable[[float], int]) -> Outcome:
    """IDA on 0 = M·dy/dt − F(t, y), dense, its own difference quotients for the Jacobian."""
    try:
        from sksundae.ida import IDA
    except ImportError:
        raise NotApplicable("scikit-sundae is not installed (pip install 'jaxonomy_dae[bench]')") from None
    one = problem.index_one()
    mass = one.matrix()

    def residual(t, y, yp, res):
        res[:] = mass @ yp - one.numpy(t, y)

    algebraic = np.flatnonzero(~mass.any(axis=0)).tolist()
    slopes = _slopes(one, problem.t0)

    def solve():
        options = dict(rtol=rtol, atol=atol, max_num_steps=MAX_STEPS)
        solver = IDA(residual, algebraic_idx=algebraic or None, **options)
        return solver.solve(np.array([problem.t0, problem.t1]), one.y0, slopes)

    solution, first, _ = timed(solve, 0)
    if not solution.success:
        return Outcome(failure=str(solution.message))
    _, _, steady = timed(solve, repeat(first))
    return Outcome(
        one.values(solution.y[-1]),
        steps=len(solution.t) - 1,
        jacobians=solution.njev,
        first=first,
        steady=min(first, steady),
    )


def _semi_explicit(one: IndexOne) -> tuple[int, np.ndarray, np.ndarray]:
    """(n, A, B) with y = B·(x, z) and A·M·B = diag(1ₙ, 0), so that (x', 0) = A·F(t, y): from M's singular values."""
    if one.mass.ndim == 1 and np.array_equal(one.mass, np.arange(len(one.mass)) < int((one.mass != 0).sum())):
        return one.split(), np.eye(len(one.mass)), np.eye(len(one.mass))
    left, singular, right = np.linalg.svd(one.matrix())
    n = int((singular > 1e-12 * singular[0]).sum())
    scale = np.concatenate([1 / singular[:n], np.full(len(singular) - n, 1 / singular[0])])
    return n, scale[:, None] * left.T, right.T


def casadi_idas(
    problem: Problem, rtol: float, atol: float, repeat: Callable[[float], int], suppress: bool = True
) -> Outcome:
    """IDAS on x' = f, 0 = g, with CasADi's exact Jacobians.

    `suppress` leaves algebraic unknowns out of the error test, which serves IDAS better on all these problems: fewer
    steps for as many digits. The starts given are consistent, slopes too.
    """
    try:
        import casadi
    except ImportError:
        raise NotApplicable("CasADi is not installed (pip install 'jaxonomy_dae[bench]')") from None
    one = problem.index_one()
    n, a, b = _semi_explicit(one)
    unknowns, t = casadi.SX.sym("y", len(one.y0)), casadi.SX.sym("t")
    plain = np.array_equal(b, np.eye(len(b)))
    right = one.casadi(t, unknowns if plain else casadi.DM(b) @ unknowns)
    right = right if plain else casadi.DM(a) @ right
    w0 = np.linalg.solve(b, one.y0)
    slopes = (a @ one.numpy(problem.t0, one.y0))[:n]
    options = dict(reltol=rtol, abstol=atol, max_num_steps=MAX_STEPS, disable_internal_warnings=True)
    options |= dict(suppress_algebraic=suppress, calc_ic=False, init_xdot=slopes.tolist())
    dae = dict(t=t, x=unknowns[:n], z=unknowns[n:], ode=right[:n], alg=right[n:])
    if n == len(w0):
        dae = dict(t=t, x=unknowns, ode=right)
    start = {"x0": w0[:n]} | ({"z0": w0[n:]} if n < len(w0) else {})

    def build():
        return casadi.integrator("idas", "idas", dae, problem.t0, problem.t1, options)

    integrator = None

    def solve():
        nonlocal integrator
        integrator = integrator or build()
        return integrator(**start)

    try:
        end, first, _ = timed(solve, 0)
    except RuntimeError as error:
        line = next((part for part in str(error).splitlines() if "IDA" in part), str(error).splitlines()[-1])
        return Outcome(failure=line.strip()[:160])
    _, _, steady = timed(solve, repeat(first))
    y = b @ np.concatenate([np.asarray(end["xf"]).ravel(), np.asarray(end["zf"]).ravel()])
    stats = integrator.stats()  # pyright: ignore[reportOptionalMemberAccess]
    return Outcome(
        one.values(y),
        steps=int(stats["nsteps"]),
        rejected=int(stats["netfails"]),
        factorisations=int(stats["nlinsetups"]),
        first=first,
        steady=steady,
    )


def scipy_radau(problem: Problem, rtol: float, atol: float, repeat: Callable[[float], int]) -> Outcome:
    """SciPy's Radau on the ODE that is left when algebraic unknowns are eliminated in closed form."""
    one = problem.index_one()
    if not one.linear:
        raise NotApplicable("its algebraic equations are nonlinear: no ODE in closed form")

    def solve():
        x0 = one.y0[: one.split()]
        return scipy.integrate.solve_ivp(
            one.ode, (problem.t0, problem.t1), x0, method="Radau", rtol=max(rtol, 3e-14), atol=atol
        )

    solution, first, _ = timed(solve, 0)
    if not solution.success:
        return Outcome(failure=solution.message)
    _, _, steady = timed(solve, repeat(first))
    x = solution.y[:, -1]
    return Outcome(
        one.values(np.concatenate([x, one.algebraics(problem.t1, x)])),
        steps=len(solution.t) - 1,
        jacobians=int(solution.njev),
        factorisations=int(solution.nlu),
        first=first,
        steady=min(first, steady),
    )


def no_repeat(seconds: float) -> int:
    """Where only the values count."""
    return 0
