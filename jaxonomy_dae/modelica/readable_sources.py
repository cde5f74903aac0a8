"""Copies of libraries in which rumoca reads all parameters.

rumoca 0.10.2 takes a parameter that is bound to a look-up in a table for an unknown with an equation, so that Clutch,
Brake and OneWayClutch of the Modelica library have one equation too many. In the copy, an initial equation gives such a
parameter its value. Folders without one are links to the originals, and no line moves.
"""

import os
import re
import shutil
from pathlib import Path

_LOOK_UP = "getTable1DValue"
# parameter Type name(modifiers) = binding "comment";
_BOUND = re.compile(
    r"\bparameter\s+(?P<type>[\w.]+)\s+(?P<name>\w+)\s*(?P<modifiers>\([^();]*\))?\s*="
    r"(?P<binding>[^;\"]*\bgetTable1DValue\w*\s*\([^;\"]*)(?P<comment>\"[^\"]*\"\s*)?;"
)
_EQUATIONS = re.compile(r"^[ \t]*equation\b", re.M)


def with_readable_parameters(root: Path, copies: Path) -> Path:
    """The folder `root`, or a copy of it below the folder `copies` if a file in it has to be changed."""
    changed = {}
    for file in root.rglob("*.mo"):
        text = file.read_text(encoding="utf-8", errors="replace")
        if _LOOK_UP in text and (new := _by_initial_equations(text)) != text:
            changed[file.relative_to(root)] = new
    if not changed:
        return root
    copy = copies / str(len(list(copies.iterdir())))
    _mirror(root, copy, Path(), changed)
    return copy


def _by_initial_equations(text: str) -> str:
    """The text with initial equations in place of bindings to look-ups in tables, before the equations that follow."""
    out, done, equations = "", 0, []
    for found in re.finditer(f"{_BOUND.pattern}|{_EQUATIONS.pattern}", text, re.M):
        out += text[done : found.start()]
        done = found.end()
        if found["name"]:
            binding = found["binding"]
            equations.append(f"{found['name']} = {' '.join(binding.split())};")
            modifiers = ", ".join(filter(None, [(found["modifiers"] or "()")[1:-1], "fixed = false"]))
            lines = "\n" * (found[0].count("\n") - (found["comment"] or "").count("\n"))
            out += f"parameter {found['type']} {found['name']}({modifiers}){lines} {found['comment'] or ''};"
        else:
            out += f"initial equation {' '.join(equations)} equation" if equations else found[0]
            equations = []
    return out + text[done:]


def _mirror(root: Path, copy: Path, inside: Path, changed: dict[Path, str]) -> None:
    """Makes the folder `copy/inside` with links into `root/inside`, and with the changed files."""
    folders = {parent for file in changed for parent in file.parents}
    (copy / inside).mkdir(parents=True)
    for entry in os.scandir(root / inside):
        place = inside / entry.name
        if place in changed:
            (copy / place).write_text(changed[place], encoding="utf-8")
        elif place in folders:
            _mirror(root, copy, place, changed)
        elif entry.is_dir():
            _link(Path(entry.path).resolve(), copy / place)
        else:  # rumoca would follow a link from package.mo to the original library
            shutil.copyfile(entry.path, copy / place)


def _link(folder: Path, link: Path) -> None:
    try:
        link.symlink_to(folder, target_is_directory=True)
    except OSError:  # links need a privilege on Windows
        shutil.copytree(folder, link)
