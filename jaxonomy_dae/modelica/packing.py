"""Opens all classes of a library: `python -m jaxonomy_dae.modelica pack all.zip --root libraries Modelica`.

Each class is opened, counted and translated into equations of a component. Those that come through go into one file
that `Library` reads without a front end, and all of them into a table beside it.
"""

import argparse
import csv
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from ..base.errors import JaxonomyDaeError, ModelError
from ..write.environment import EqnEnv
from .library import Library, component_of
from .open_class import OpenClass
from .shelf import pack
from .sources import Found, Sources

WITHOUT_COMPONENTS = frozenset({"Examples", "Icons", "Interfaces", "UsersGuide", "Types", "Internal"})  # packages


class Row(NamedTuple):
    """What became of a class: `translated`, `opened` if its equations are not translated, or `refused`; with the
    equations and unknowns that it lacks none of beside one equation for each of its `flows`, streams among them."""

    name: str
    state: str
    equations: int | str = ""
    unknowns: int | str = ""
    flows: int | str = ""
    reason: str = ""


def main(arguments: Sequence[str]) -> int:
    """Packs classes; returns 1 if none of them opens."""
    parser = argparse.ArgumentParser(
        prog="python -m jaxonomy_dae.modelica pack",
        description="Packs the classes of a Modelica library into one file.",
    )
    parser.add_argument("file", help="the file to write, such as analog.zip; a table stands beside it, analog.csv")
    parser.add_argument("packages", nargs="+", help="packages or classes, such as Modelica.Electrical.Analog")
    parser.add_argument("--root", action="append", default=[], help="a library's folder; may be repeated")
    asked = parser.parse_args(arguments)
    try:
        library, file = Library(asked.root), Path(asked.file)
        if file.suffix != ".zip":
            raise ModelError(f"a pack is a file .zip; got '{file}'")
        names = [n for package in asked.packages for n in components_in(Sources(library.sources), package)]
        rows, packed = [], []
        for name in names:
            row, found = tried(library, name)
            rows.append(row)
            packed += [found] if found is not None and row.state == "translated" else []
            print(f"{row.state:10} {name} {row.reason}", flush=True)
        pack(file, packed, {"packages": asked.packages})
        with file.with_suffix(".csv").open("w", newline="", encoding="utf-8") as table:
            csv.writer(table).writerows([Row._fields, *rows])
    except (JaxonomyDaeError, OSError) as error:
        print(error, file=sys.stderr)
        return 1
    print(f"{file}: {len(packed)} of {len(rows)} classes")
    return 0 if packed else 1


def components_in(sources: Sources, name: str) -> Iterator[str]:
    """The models and blocks of a package, in the order of their files; a class stands for itself.

    **Raises:**

    - `ModelError` for a name that no root holds.
    """
    found = sources.find(name)
    if not isinstance(found, Found):
        raise ModelError(f"there is no '{name}' in {', '.join(map(str, sources.roots))}")
    if found.source.kind in ("model", "block"):
        yield name
    elif found.source.kind == "package":
        for inner in dict.fromkeys(sources.names_in(found)):
            if inner not in WITHOUT_COMPONENTS:
                yield from components_in(sources, f"{name}.{inner}")


def tried(library: Library, name: str) -> tuple[Row, OpenClass | None]:
    """What becomes of a class, with 1 for parameters without a value."""
    try:
        found = library.opened(name)
    except ModelError as error:
        return Row(name, "refused", reason=" ".join(str(error).split())), None
    outside = {"parameter", "constant", "input"}
    unknowns = sum(not d.prefixes & outside and d.type != "String" for d in found.flat.model.declarations)
    counts = len(found.flat.model.equations), unknowns, sum(len(p.flows) + len(p.streams) for p in found.ports)
    values: dict[str, Any] = dict.fromkeys(found.required, 1.0)
    try:
        component_of(found)(EqnEnv(), "x", **values)
    # A library is packed as far as it goes: one class that fails is a row of the table.
    except (ModelError, ValueError, TypeError, RecursionError) as error:
        return Row(name, "opened", *counts, " ".join(str(error).split())), found
    return Row(name, "translated", *counts), found
