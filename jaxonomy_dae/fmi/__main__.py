"""FMUs on the command line: `python -m jaxonomy_dae.fmi validate|run|compile plant.fmu`."""

import argparse
import csv
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..base.errors import JaxonomyDaeError, ModelError
from ..base.optional import optional_module
from .from_sources import add_binaries


def main(arguments: Sequence[str] | None = None) -> int:
    """Checks, runs or compiles an FMU; returns 1 if that fails, with the reason on the standard error."""
    asked = _parser().parse_args(arguments)
    try:
        return asked.action(asked)
    except (JaxonomyDaeError, OSError) as error:
        print(error, file=sys.stderr)
        return 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m jaxonomy_dae.fmi", description="Functional Mock-up Units.")
    actions = parser.add_subparsers(required=True)
    for name, action, text in (
        ("validate", _validate, "prints what FMPy finds wrong with the description"),
        ("run", _run, "runs the FMU through FMPy and prints the last values of its outputs"),
        ("compile", _compile, "makes binaries of the sources and puts them into the FMU"),
    ):
        one = actions.add_parser(name, help=text)
        one.add_argument("file", type=Path)
        one.set_defaults(action=action)
        if name == "run":
            one.add_argument("--stop-time", type=float, help="in s; else the FMU's own")
            one.add_argument("--tolerance", type=float, help="relative; else the FMU's own")
            one.add_argument("--kind", choices=("ModelExchange", "CoSimulation"), help="else what FMPy prefers")
            one.add_argument("--csv", type=Path, help="a file for all saved values")
        if name == "compile":
            one.add_argument("--platform", action="append", default=[], help="as x86_64-windows; else this machine's")
    return parser


def _fmpy(path: Path) -> Any:
    found = optional_module("fmpy", "fmi", "FMUs are checked and run through FMPy")
    if not path.is_file():
        raise ModelError(f"there is no file '{path}'")
    return found


def _validate(asked: argparse.Namespace) -> int:
    _fmpy(asked.file)
    from fmpy.validation import validate_fmu

    try:
        problems = validate_fmu(str(asked.file))
    except Exception as error:  # FMPy raises what its readers of zip files and XML raise
        problems = [f"FMPy could not read it: {type(error).__name__}: {error}"]
    for problem in problems:
        print(f"{asked.file}: {problem}", file=sys.stderr)
    if not problems:
        print(f"{asked.file}: nothing found")
    return 1 if problems else 0


def _run(asked: argparse.Namespace) -> int:
    fmpy = _fmpy(asked.file)
    try:
        values = fmpy.simulate_fmu(
            str(asked.file), stop_time=asked.stop_time, relative_tolerance=asked.tolerance, fmi_type=asked.kind
        )
    except Exception as error:  # FMPy raises plain exceptions
        raise ModelError(f"{asked.file}: FMPy could not run it: {error}") from error
    names = values.dtype.names
    if asked.csv:
        with asked.csv.open("w", newline="") as file:
            csv.writer(file).writerows([names, *(row.tolist() for row in values)])
    for name in names:
        print(f"{name} = {values[name][-1]}")
    return 0


def _compile(asked: argparse.Namespace) -> int:
    for name in add_binaries(asked.file, asked.platform):
        print(name)
    return 0


if __name__ == "__main__":
    sys.exit(main())
