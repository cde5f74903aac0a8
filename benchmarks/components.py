"""Every component of the library beside its references: writes docs/components.md.

    python -m benchmarks.components

Runs the tests that declare references (tests/component_references.py), measures their errors, and writes the table. If
a test fails, it is named, and the page stays as it was.
"""

import importlib
import pathlib
import sys
import time

import jax

ROOT = pathlib.Path(__file__).parents[1]
PAGE = ROOT / "docs" / "components.md"
HEAD = """# Components and their references

Every component of the library is checked against something that this package did not compute: a closed form, SciPy's
solution of equations derived by hand, a published result. The errors below are the largest of all values compared in a
test that depend on the component, relative to the largest value of the reference; what is allowed is the tolerance of
that test, and comes from where the list at the end of the page says. The page is written by

    python -m benchmarks.components

which runs the tests named in the last column. A component without a reference fails `tests/test_components.py`.
"""


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    sys.path[:0] = [str(ROOT / folder) for folder in ("tests", "tests/kernels", "tests/plants", "benchmarks", "docs")]
    from component_references import CHECKS, Measurement
    from library_pages import classes_of, domains

    for path in sorted((ROOT / "tests").rglob("test_library_*.py")):
        importlib.import_module(path.stem)
    for name in ("test_events", "test_modelica_examples", "test_pendulum", "test_rotational"):
        importlib.import_module(name)
    found: dict[str, dict[str, Measurement]] = {}
    failed: list[str] = []
    for name, check in CHECKS.items():
        start = time.perf_counter()
        try:
            found[name] = check.run()
        except AssertionError as error:
            failed.append(f"{name}: {error}")
        print(f"{time.perf_counter() - start:6.1f} s  {name}", flush=True)
        jax.clear_caches()
    if failed:
        sys.exit("\n".join(failed))

    lines, used = [HEAD], {}
    for domain in domains():
        lines += [
            f"## {domain.capitalize()}",
            "",
            "| Component | Reference | Error | Allowed | Test |",
            "|---" * 5 + "|",
        ]
        for cls in classes_of(domain):
            for name, check in CHECKS.items():
                if cls not in check.references:
                    continue
                text, labels = check.references[cls]
                worst = max((found[name][label] for label in labels), key=lambda m: m.error / m.allowed)
                number = used.setdefault(name, len(used) + 1)
                link = f"[{cls.__name__}](library/{domain}.md#{cls.__name__.lower()})"
                lines.append(f"| {link} | {text} | {worst.error:.1e} | {worst.allowed:.1e} | {number} |")
        lines.append("")
    lines += ["## Tests, and where their tolerances come from", ""]
    lines += [f"{number}. `{name}`: {CHECKS[name].origin}." for name, number in used.items()]
    PAGE.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
