"""Work and precision on eleven published DAE problems, beside SUNDIALS IDA, CasADi's IDAS and SciPy's Radau.

    python benchmarks/work_precision.py                                   # everything: long
    python benchmarks/work_precision.py -p robertson andrews -s bdf idas  # some problems and solvers
    python benchmarks/work_precision.py -t 1e-4 1e-6                      # some tolerances

The other programs come with `pip install 'jaxonomy_dae[bench]'`; what is missing is left out.

Solvers: `bdf` and `rodas5p` are ours; problems published with index 1 are solved as a `DAETerm`, the others as the
compiled model (and all of them so with `--models`). `tsit5` is our explicit default on the compiled model. `ida` is
SUNDIALS IDA through scikit-sundae with residuals in Python: its steps compare, its times do not. `idas` is CasADi's
IDAS without algebraic unknowns in the error test, which suits it best here; `idas-full` has them in. `radau` is
SciPy's, on the ODE that elimination leaves. Where the published index is above 1, these get the constraints
differentiated by hand, so their solutions drift off them.

Digits are the least number of correct digits of any compared component at the end, errors below `Problem.scale` being
absolute; they end where the reference does. Times: the first call with all compiling, then the best of repeated ones.
"""

import argparse
import math
import sys
from collections.abc import Callable

import jax
import numpy as np
from testset import PROBLEMS, Problem, competitors, ours
from testset.competitors import NotApplicable
from testset.outcome import Outcome, best_of

from jaxonomy_dae import solvers

jax.config.update("jax_enable_x64", True)

OURS = ("bdf", "rodas5p", "tsit5")
OTHERS = {
    "ida": competitors.ida,
    "idas": competitors.casadi_idas,
    "idas-full": lambda *args, **kwargs: competitors.casadi_idas(*args, **kwargs, suppress=False),
    "radau": competitors.scipy_radau,
}
TOLERANCES = (1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9)
SMALL = 30  # unknowns up to which times are compared with IDAS
IDAS = ("idas", "idas-full")
IDA_FAMILY = ("ida", *IDAS)


def our_solver(name: str):
    """The solver object, None for the default of `simulate`."""
    return {"bdf": lambda: solvers.BDF(), "rodas5p": lambda: solvers.Rodas5P(), "tsit5": lambda: None}[name]()


def program_of(problem: Problem, name: str, models: bool):
    """Our program for a problem, and what it is given: 'raw' equations or the compiled 'model'."""
    if name == "tsit5" and problem.stiff:
        raise NotApplicable("stiff: an explicit solver would take forever")
    solver = our_solver(name)
    if problem.given and name != "tsit5" and not models:
        return ours.raw_program(problem, solver), "raw"
    return ours.model_program(problem, solver), "model"


def runs(problem: Problem, name: str, tolerances, models: bool):
    """(form, rtol, outcome) for every tolerance."""
    if name in OURS:
        program, form = program_of(problem, name, models)
        for rtol in tolerances:
            yield form, rtol, ours.outcome(problem, program, **problem.tolerances(rtol), repeat=best_of)
    else:
        form = "raw" if problem.given else "by hand"
        for rtol in tolerances:
            yield form, rtol, OTHERS[name](problem, **problem.tolerances(rtol), repeat=best_of)


def digits_of(problem: Problem, outcome: Outcome) -> float:
    """Correct digits, none beyond those of the reference."""
    return -math.inf if outcome.failure else min(problem.correct_digits(outcome.values), problem.digits)


def number(value: int) -> str:
    return "-" if value < 0 else str(value)


HEADER = (
    f"{'problem':22}{'solver':10}{'form':9}{'rtol':>6} {'digits':>6} {'steps':>7} {'reject':>7} {'jac':>6} {'fact':>6}"
    f" {'first s':>9} {'steady ms':>10}"
)


def line(problem: Problem, name: str, form: str, rtol: float, outcome: Outcome) -> str:
    head = f"{problem.name:22}{name:10}{form:9}{rtol:6.0e} "
    if outcome.failure:
        return head + f"failed: {outcome.failure}"
    return head + (
        f"{digits_of(problem, outcome):6.2f} {number(outcome.steps):>7} {number(outcome.rejected):>7}"
        f" {number(outcome.jacobians):>6} {number(outcome.factorisations):>6}"
        f" {outcome.first:9.3f} {1e3 * outcome.steady:10.3f}"
    )


def at_digits(
    problem: Problem, results: dict[float, Outcome], digits: np.ndarray, cost: Callable[[Outcome], float]
) -> np.ndarray:
    """What so many digits cost: log₁₀(cost) interpolated over the digits of the runs, NaN outside."""
    known = sorted(
        (digits_of(problem, o), math.log10(cost(o)))
        for o in results.values()
        if not o.failure and cost(o) > 0 and digits_of(problem, o) < problem.digits
    )
    if len(known) < 2:
        return np.full(len(digits), np.nan)
    x, y = np.array(known).T
    return 10 ** np.interp(digits, x, y, left=np.nan, right=np.nan)


def at_equal_digits(problems, table, rivals, cost: Callable[[Outcome], float]) -> None:
    """Our costs relative to those of the best rival at equal digits: geometric means over the digits both reach."""
    digits = np.arange(1.0, 12.01, 0.25)
    for problem in problems:
        others = [
            at_digits(problem, table[problem.name, n], digits, cost) for n in rivals if (problem.name, n) in table
        ]
        for name in OURS if others else ():
            if (problem.name, name) in table:
                ratio = at_digits(problem, table[problem.name, name], digits, cost) / np.fmin.reduce(others)
                both = np.isfinite(ratio)
                if both.any():
                    mean, low, high = np.exp(np.log(ratio[both]).mean()), ratio[both].min(), ratio[both].max()
                    span = f"{digits[both].min():.1f} to {digits[both].max():.1f} digits"
                    print(f"  {problem.name:22}{name:10}{mean:6.2f}   ({low:.2f} to {high:.2f}; {span})")


def summary(problems, table) -> None:
    """Steps relative to IDA and times relative to IDAS at equal digits, times relative to IDAS at equal tolerance."""
    print("\nSteps for equal digits, relative to the best of IDA and IDAS (geometric mean over the digits both reach)")
    at_equal_digits(problems, table, IDA_FAMILY, lambda o: o.steps)
    small = [p for p in problems if len(p.index_one().y0) <= SMALL]
    print(f"\nSteady time for equal digits, relative to IDAS (the faster variant), up to {SMALL} unknowns")
    at_equal_digits(small, table, IDAS, lambda o: o.steady)
    print(f"\nSteady time relative to IDAS (the faster variant) at equal tolerance, up to {SMALL} unknowns")
    for problem in small:
        rivals = [table[problem.name, n] for n in IDAS if (problem.name, n) in table]
        if not rivals:
            continue
        for name in OURS:
            mine = table.get((problem.name, name), {})
            ratios = {}
            for rtol, outcome in mine.items():
                times = [r[rtol].steady for r in rivals if rtol in r and not r[rtol].failure]
                if times and not outcome.failure:
                    ratios[rtol] = outcome.steady / min(times)
            if ratios:
                shown = "  ".join(f"{rtol:.0e}: {ratio:.2f}" for rtol, ratio in ratios.items())
                print(f"  {problem.name:22}{name:10}{shown}")


def main(arguments=None):
    names = [*OURS, *OTHERS]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-p", "--problems", nargs="+", choices=PROBLEMS, default=list(PROBLEMS), metavar="PROBLEM")
    parser.add_argument("-s", "--solvers", nargs="+", choices=names, default=names, metavar="SOLVER")
    parser.add_argument("-t", "--tolerances", nargs="+", type=float, default=TOLERANCES, metavar="RTOL")
    parser.add_argument("--models", action="store_true", help="index-1 problems as compiled models too")
    options = parser.parse_args(arguments)
    table: dict[tuple[str, str], dict[float, Outcome]] = {}
    problems = [PROBLEMS[name] for name in options.problems]
    print(HEADER)
    for problem in problems:
        for name in options.solvers:
            try:
                for form, rtol, outcome in runs(problem, name, options.tolerances, options.models):
                    table.setdefault((problem.name, name), {})[rtol] = outcome
                    print(line(problem, name, form, rtol, outcome))
                    sys.stdout.flush()
            except NotApplicable as reason:
                print(f"{problem.name:22}{name:10}not applicable: {reason}")
    summary(problems, table)


if __name__ == "__main__":
    main()
