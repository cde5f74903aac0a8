"""Deliberate faults, one for each room of the package, and the tests that must notice them.

`python -m benchmarks.faults` copies the package and its tests to a temporary folder, puts in one fault after the other
and runs the tests named beside it: those of `make test` until the first failure, and where none fails, those that are
slow. A fault that passes is a hole in the tests: the exit status is 1. It is 1, too, if `make test` alone misses more
than a sixth. Names of rooms choose among the faults: `python -m benchmarks.faults solve`. With `--matrix`, all quick
tests of those files run, and all that notice are named: a test that stands alone in a row may not become slow.
"""

import dataclasses
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
# What tests read.
FOLDERS = ("jaxonomy_dae", "tests", "benchmarks", "docs", "examples", ".ci", ".github", "conda")
FILES = ("pyproject.toml", "README.md", "CHANGELOG.md", "CITATION.cff", ".zenodo.json", "Makefile", "mkdocs.yml")
QUICK_COMPILES = (  # as the Makefile has it
    "--xla_cpu_use_fusion_emitters=false --xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
)


FLAT_TEXTS = "tests/compiler/test_modelica_text.py tests/compiler/test_modelica_components.py"


@dataclasses.dataclass(frozen=True)
class Fault:
    """In `file`, the only occurrence of `right` becomes `wrong`; one of `tests` must fail, of `make test` if it may."""

    file: str
    right: str
    wrong: str
    tests: str


FAULTS = [
    Fault(
        "base/optional.py",
        "jaxonomy_dae[{extra}]",
        "jaxonomy_dae[{module}]",
        "tests/compiler/test_errors.py",
    ),
    Fault(
        "graph/expressions/differentiate.py",
        'multiply(n, apply("log", base))',
        'apply("log", base)',
        "tests/kernels/test_expressions.py tests/kernels/test_functions.py",
    ),
    Fault(
        "graph/units/unit.py",
        '_si("W", kg=1, m=2, s=-3)',
        '_si("W", kg=1, m=2, s=-2)',
        "tests/compiler/test_units.py",
    ),
    Fault(
        "write/neural.py",
        "if found != len(self.targets):",
        "if found < len(self.targets):",
        "tests/compiler",
    ),
    Fault(
        "graph/structure/pantelides.py",
        "return Offsets(np.array(c_list, np.int64),",
        "return Offsets(1 + np.array(c_list, np.int64),",
        "tests/compiler/test_structure.py tests/compiler/test_index_reduction.py",
    ),
    Fault(
        "graph/judgement/rank.py",
        "errors = np.maximum(np.where(np.isfinite(errors), errors, size), EPS * size)",
        "errors = EPS * size",
        "tests/kernels/test_rank.py tests/compiler/test_verdicts.py",
    ),
    Fault(
        "solve/linear/dense.py",
        "return unit[..., None] * back(y, order)",
        "return back(y, order)",
        "tests/kernels/test_dense_factors.py tests/kernels/test_stable_blocks.py tests/kernels/test_large_blocks.py",
    ),
    Fault(
        "solve/adjoint/reverse_step.py",
        "seeds = seeds if ct is None else seeds + ct * move",
        "seeds = seeds if ct is None else seeds - ct * move",
        "tests/kernels/test_hybrid_runs.py tests/kernels/test_stored_adjoint.py",
    ),
    Fault(
        "solve/methods/rodas5p.py",
        "A[2, :2] = 2.849394379747939,",
        "A[2, :2] = 2.849394379747938 + 1e-3,",
        "tests/kernels/test_dae_orders.py tests/kernels/test_dae_solvers.py",
    ),
    Fault(
        "solve/events/event_map.py",
        "instant.there, state.x + instant.slope * delay)",
        "instant.there, state.x - instant.slope * delay)",
        "tests/kernels/test_event_map.py",
    ),
    Fault(
        "solve/events/iteration.py",
        "circles = (count > 0) & ~moved",
        "circles = (count < 0) & ~moved",
        "tests/kernels/test_event_map.py",
    ),
    Fault(
        "solve/events/search.py",
        "jnp.where(jnp.abs(truncated - middle) <= radius, truncated,",
        "jnp.where(jnp.abs(truncated - middle) >= radius, truncated,",
        "tests/kernels/test_event_map.py",
    ),
    Fault(
        "solve/events/looking.py",
        "(problem.facts.only_kinks | ~monotone)",
        "(problem.facts.only_kinks | monotone)",
        "tests/kernels/test_event_map.py tests/plants/test_conditions.py",
    ),
    Fault(
        "write/event_declarations.py",
        "if is_strict(watchable):",
        "if not is_strict(watchable):",
        "tests/kernels/test_event_map.py tests/plants/test_conditions.py",
    ),
    Fault(
        "write/mode_declarations.py",
        "part = below / jump",
        "part = above / jump",
        "tests/plants/test_sliding.py",
    ),
    Fault(
        "write/discrete_equations.py",
        "*(Assign(self.before(m.path), n) for m, n in new.items()),",
        "",
        f"{FLAT_TEXTS} tests/plants/test_discrete_equations.py",
    ),
    Fault(
        "write/discrete_equations.py",
        "goes_on = functools.reduce(either, moves, self.phase(AT_FIRST))",
        "goes_on = self.phase(AT_FIRST)",
        f"{FLAT_TEXTS} tests/plants/test_discrete_equations.py",
    ),
    Fault(
        "write/discrete_equations.py",
        "        replaced |= new",
        "        replaced |= {}",
        f"{FLAT_TEXTS} tests/plants/test_discrete_equations.py",
    ),
    Fault(
        "write/discrete_equations.py",
        'acts = self._truth("acts", both(rises, negated(before)))',
        'acts = self._truth("acts", rises)',
        f"{FLAT_TEXTS} tests/plants/test_modelica_texts.py",
    ),
    Fault(
        "write/discrete_equations.py",
        "rises = both(now, plain(sympy.Eq(was, 0)))",
        "rises = now",
        f"{FLAT_TEXTS} tests/plants/test_modelica_texts.py",
    ),
    Fault(
        "compile/diagnosis/wording.py",
        '"Connect a Ground to one of its nodes"',
        '"Connect a Resistor to one of its nodes"',
        "tests/compiler",
    ),
    Fault(
        "compile/passes/order_blocks.py",
        "distinct(needs[outside] * np.int64(n_blocks) + block[outside])",
        "distinct(block[outside] * np.int64(n_blocks) + needs[outside])",
        "tests/compiler/test_structure.py tests/kernels/test_passes.py tests/kernels/test_nonlinear_blocks.py",
    ),
    Fault(
        "compile/lowering/gather.py",
        "return times(float(self.factor[0]), value)",
        "return value",
        "tests/kernels/test_names.py tests/kernels/test_nonlinear_blocks.py tests/kernels/test_initialization.py "
        "tests/kernels/test_linear_models.py tests/plants/test_energy.py",
    ),
    Fault(
        "run/system/bounds.py",
        "below = (x < high)",
        "below = (x < low)",
        "tests/compiler tests/kernels/test_parameter_expressions.py",
    ),
    Fault(
        "run/start/stages.py",
        "-unit * least_squares(matrix, value)",
        "unit * least_squares(matrix, value)",
        "tests/kernels/test_starts_in_stages.py",
    ),
    Fault(
        "run/simulation/energy_balance.py",
        "error = (stored - (supplied - lost))",
        "error = (stored - (supplied + lost))",
        "tests/plants/test_energy.py",
    ),
    Fault(
        "run/system/bounds.py",
        "up, down = low + jnp.exp(distance), high - jnp.exp(-distance)",
        "up, down = low + jnp.exp(distance), high + jnp.exp(-distance)",
        "tests/kernels/test_bounded_coordinates.py",
    ),
    Fault(
        "analysis/state_space.py",
        "-found.real, -slowness",
        "-found.real, slowness",
        "tests/plants/test_analysis.py",
    ),
    Fault(
        "plotting.py",
        "(ts <= time.max() + slack)",
        "(ts >= time.max() + slack)",
        "tests/plants/test_events.py",
    ),
    Fault(
        "testing/energy.py",
        "<= rtol:",
        "<= 1e3 * rtol:",
        "tests/plants/test_energy.py",
    ),
    Fault(
        "library/electrical/passive.py",
        "Eq(inductance * der(current), voltage)",
        "Eq(inductance * der(current), -voltage)",
        "tests/plants/test_library_electrical.py",
    ),
    Fault(
        "base/private_names.py",
        "    except (ImportError, AttributeError) as error:\n        raise MissingName",
        "    except ImportError as error:\n        raise MissingName",
        "tests/compiler/test_private_names.py",
    ),
    Fault(
        "host/cache.py",
        "if not program.calls]",
        "if program.calls]",
        "tests/kernels/test_program_cache.py",
    ),
    Fault(
        "host/kept.py",
        '"processor": _machine(),',
        '"processor": "",',
        "tests/kernels/test_kept_programs.py",
    ),
    Fault(
        "learning/noise.py",
        "slope[far] = k / np.abs(v[far])",
        "slope[far] = k",
        "tests/kernels/test_noise.py",
    ),
    Fault(
        "modelica/operations.py",
        "_relation(lambda a, b: a <= b",
        "_relation(lambda a, b: a < b",
        f"{FLAT_TEXTS} tests/compiler/test_modelica_library.py tests/plants/test_modelica.py",
    ),
    Fault(
        "fmi/elementwise.py",
        'return f"(-{cell.given[0]})"',
        'return f"({cell.given[0]})"',
        "tests/plants/test_fmu.py",
    ),
    Fault(
        "compile/model/group.py",
        "return self._stacked(out) * self.factor",
        "return self._stacked(out)",
        "tests/compiler tests/kernels/test_names.py",
    ),
]


MISSED_BY_QUICK_TESTS = 1 / 6  # the share of the faults that the slow tests alone may notice


def noticed_by(fault: Fault, folder: Path, *, slow: bool, all_of_them: bool) -> list[str]:
    """The tests that fail with the fault in place: the first one, or all."""
    path = folder / "jaxonomy_dae" / fault.file
    text = path.read_text()
    assert text.count(fault.right) == 1, f"{fault.file} has {fault.right!r} {text.count(fault.right)} times"
    path.write_text(text.replace(fault.right, fault.wrong))
    try:
        command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-m", "slow" if slow else "not slow"]
        flags = f"{os.environ.get('XLA_FLAGS', '')} {QUICK_COMPILES}"
        environment = {**os.environ, "XLA_FLAGS": flags, "PYTHONDONTWRITEBYTECODE": "1"}
        command += [*([] if all_of_them else ["-x"]), *fault.tests.split()]
        run = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    finally:
        path.write_text(text)
    return re.findall(r"^(?:FAILED|ERROR) (\S+)", run.stdout, re.MULTILINE)


def main() -> int:
    matrix = "--matrix" in sys.argv
    rooms = [name for name in sys.argv[1:] if not name.startswith("-")]
    chosen = [fault for fault in FAULTS if not rooms or fault.file.split("/")[0].removesuffix(".py") in rooms]
    quick = both = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for part in FOLDERS:
            shutil.copytree(ROOT / part, folder / part, ignore=shutil.ignore_patterns("__pycache__"))
        for part in FILES:
            shutil.copy(ROOT / part, folder / part)
        for fault in chosen:
            found = noticed_by(fault, folder, slow=False, all_of_them=matrix)
            quick += bool(found)
            if found:
                said = ", ".join(found)
            else:
                found = noticed_by(fault, folder, slow=True, all_of_them=False)
                said = f"no quick test, {found[0]}" if found else "NO TEST"
            both += bool(found)
            print(f"{fault.file:<40} {fault.right!r} -> {fault.wrong!r}: {said}", flush=True)
    print(f"of {len(chosen)} faults, make test notices {quick}, both sets {both}")
    return int(both < len(chosen) or quick < (1 - MISSED_BY_QUICK_TESTS) * len(chosen))


if __name__ == "__main__":
    sys.exit(main())
