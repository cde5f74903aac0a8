"""Deliberate faults, one for each room of the package, and the tests that must notice them.

`python -m benchmarks.faults` copies the package and its tests to a temporary folder, puts in one fault after the other
and runs the tests named beside it until the first failure. A fault that passes is a hole in the tests: it is printed as
such, and the exit status is 1. Names of rooms choose among them: `python -m benchmarks.faults linear`.
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
QUICK_COMPILES = (  # as the Makefile has it
    "--xla_cpu_use_fusion_emitters=false --xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
)


@dataclasses.dataclass(frozen=True)
class Fault:
    """In `file`, the only occurrence of `right` becomes `wrong`; `tests`, of the default run, must fail."""

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
        'multiply(n, apply("log", base), inner[1])',
        'multiply(apply("log", base), inner[1])',
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
        "solve/linear/inverse.py",
        "left_side=True, lower=False) * unit[..., None, :]",
        "left_side=True, lower=False)",
        "tests/kernels/test_computed_once.py tests/kernels/test_stable_blocks.py tests/kernels/test_large_blocks.py",
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
        "reached = state.x + before * delay",
        "reached = state.x - before * delay",
        "tests/kernels/test_event_map.py",
    ),
    Fault(
        "compile/diagnosis/wording.py",
        '"Connect a Ground to one of its nodes"',
        '"Connect a Resistor to one of its nodes"',
        "tests/compiler",
    ),
    Fault(
        "compile/passes/order_blocks.py",
        "np.stack([needs[outside], block[outside]], axis=1)",
        "np.stack([block[outside], needs[outside]], axis=1)",
        "tests/compiler/test_structure.py tests/kernels",
    ),
    Fault(
        "compile/lowering/gather.py",
        "return times(float(self.factor[0]), value)",
        "return value",
        "tests/kernels/test_names.py tests/kernels",
    ),
    Fault(
        "run/system/parameters.py",
        "numbers <= high)\n        if not right.all():",
        "numbers <= low)\n        if not right.all():",
        "tests/compiler tests/kernels/test_parameter_expressions.py",
    ),
    Fault(
        "run/start/stages.py",
        "q[:n].T @ -residual",
        "q[:n].T @ residual",
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
        "jnp.lexsort((found.imag, -found.real))",
        "jnp.lexsort((found.imag, found.real))",
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
        "compile/model/group.py",
        "return self._stacked(out) * self.factor",
        "return self._stacked(out)",
        "tests/compiler tests/kernels/test_names.py",
    ),
]


def caught_by(fault: Fault, folder: Path) -> str:
    """The first test that fails with the fault in place; empty if none does."""
    path = folder / "jaxonomy_dae" / fault.file
    text = path.read_text()
    assert text.count(fault.right) == 1, f"{fault.file} has {fault.right!r} {text.count(fault.right)} times"
    path.write_text(text.replace(fault.right, fault.wrong))
    try:
        command = [sys.executable, "-m", "pytest", "-x", "-p", "no:cacheprovider", *fault.tests.split()]
        flags = f"{os.environ.get('XLA_FLAGS', '')} {QUICK_COMPILES}"
        environment = {**os.environ, "XLA_FLAGS": flags, "PYTHONDONTWRITEBYTECODE": "1"}
        run = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    finally:
        path.write_text(text)
    failed = re.search(r"^(?:FAILED|ERROR) (\S+)", run.stdout, re.MULTILINE)
    return failed[1] if failed else ""


def main() -> int:
    rooms = sys.argv[1:]
    missed = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for part in ("jaxonomy_dae", "tests", "benchmarks", "docs", "examples", ".ci"):
            shutil.copytree(ROOT / part, folder / part, ignore=shutil.ignore_patterns("__pycache__"))
        for part in ("pyproject.toml", "README.md", "CHANGELOG.md", "Makefile", "mkdocs.yml"):
            shutil.copy(ROOT / part, folder / part)
        for fault in FAULTS:
            room = fault.file.split("/")[0].removesuffix(".py")
            if rooms and room not in rooms:
                continue
            found = caught_by(fault, folder)
            missed += not found
            print(f"{fault.file:<40} {fault.right!r} -> {fault.wrong!r}: {found or 'NOT CAUGHT'}", flush=True)
    return min(missed, 1)


if __name__ == "__main__":
    sys.exit(main())
