"""Systems of library components beside their references: writes docs/systems.md.

    python -m benchmarks.systems

Runs each system of test_systems.py and test_systems_mechanical.py, and the battery pack of test_library_battery.py, all
in tests/plants, with the solver that `simulate` chooses. A system that misses its tolerance ends the run.
"""

import inspect
import pathlib
import sys
import time

import jax

ROOT = pathlib.Path(__file__).parents[1]
PAGE = ROOT / "docs" / "systems.md"
HEAD = """# Systems and their references

Plants of library components, compiled as they are written and run with the solver that `simulate` chooses, at rtol 1e-9
(the battery pack: 1e-8). *Error* is the largest of all variables compared with the reference, each relative to its
largest value: a closed form, or SciPy's solution of equations derived by hand. *Energy* is the largest error of what is
stored, supplied and lost, as the components declare it, relative to the largest of these terms. The page is written by

    python -m benchmarks.systems

Tests compare gradients of most of these systems too: of one output by every parameter that can be set, with differences
of the reference to 1e-5 of the largest derivative (each in units of its parameter's value), and of some of them reverse
with forward mode to 1e-8.

| System | Equations | States | Solver | Error | Energy |
|---|---|---|---|---|---|
"""


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    sys.path[:0] = [str(ROOT / folder) for folder in ("tests", "tests/plants", "benchmarks", "docs")]
    import test_library_battery
    import test_systems
    import test_systems_mechanical
    from reference_systems import check_solution, system_of

    rows = []
    for reference in (*test_systems.SYSTEMS, *test_systems_mechanical.SYSTEMS, test_library_battery.pack_of_384):
        start = time.perf_counter()
        found = check_solution(reference)
        _, system = system_of(reference)
        text = " ".join((inspect.getdoc(reference) or "").split()).partition(". ")[0].rstrip(".")
        name = f"`{reference.__module__}.{reference.__name__}`"
        rows.append(
            f"| {name}: {text} | {system.plan.flat.n_equations} | {len(system.states)} | "
            f"{found.solver} | {found.error:.1e} | {found.energy:.1e} |"
        )
        print(f"{time.perf_counter() - start:6.1f} s  {reference.__name__}", flush=True)
        system_of.cache_clear()
        jax.clear_caches()
    PAGE.write_text(HEAD + "\n".join(rows) + "\n")


if __name__ == "__main__":
    main()
