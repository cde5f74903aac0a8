"""Copies of libraries in which rumoca reads all parameters and all equations of complex numbers.

rumoca 0.10.2 takes a parameter that is bound to a look-up in a table for an unknown with an equation, so that Clutch,
Brake and OneWayClutch of the Modelica library have one equation too many. In the copy, an initial equation gives such a
parameter its value. It asks for the instants of `sample` before a run begins: a parameter that is the initial time is
zero in the copy, where runs begin. It demands that parameters are constant that decide whether `Streams.error` is
called, as those of LimPID. In the copy, this is an assertion. `complex_sources`, `boolean_connections`, `kept_inputs`
and `model_algorithms` say what else it does not read. Folders without such files are links to the originals, and no
line moves.
"""

import contextlib
import gzip
import hashlib
import json
import os
import re
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path

from ..host.kept import folder_of
from .boolean_connections import with_single_connections
from .complex_sources import with_real_equations
from .kept_files import contents, write
from .kept_inputs import with_kept_inputs
from .model_algorithms import without_algorithms
from .sources import Sources

_FORMAT = 6  # to be raised with every change of what is changed in sources
_LOOK_UP = "getTable1DValue"
# parameter Type name(modifiers) = binding "comment";
_BOUND = re.compile(
    r"\bparameter\s+(?P<type>[\w.]+)\s+(?P<name>\w+)\s*(?P<modifiers>\([^();]*\))?\s*="
    r"(?P<binding>[^;\"]*\bgetTable1DValue\w*\s*\([^;\"]*)(?P<comment>\"[^\"]*\"\s*)?;"
)
# parameter Type name(fixed = false) …; initial equation … name = time;
_START = re.compile(
    r"(?P<declared>\bparameter\s+[\w.]+\s+(?P<name>\w+)\s*)\(\s*fixed\s*=\s*false\s*\)"
    r"(?P<between>(?:(?!\b(?:end|model|block|class)\s+\w+).)*?\binitial\s+equation\b"
    r"(?:(?!\b(?:end|equation|algorithm)\b).)*?)\b(?P=name)\s*=\s*time\s*;",
    re.S,
)
# if condition then Streams.error(message); end if;
_ERROR = "Streams.error"
_REFUSED = re.compile(
    r"\bif\b(?P<condition>[^;\"]*?)\bthen\s+(?:\w+\.)*Streams\.error\s*\("
    r"(?P<message>(?:[^;\"]|\"(?:[^\"\\]|\\.)*\")*)\)\s*;\s*end\s+if\s*;"
)
_EQUATIONS = re.compile(r"^[ \t]*equation\b", re.M)


def with_readable_sources(roots: Sequence[Path], copies: Path) -> list[Path]:
    """The folders `roots`; in place of one in which a file is changed, a copy of it below the folder `copies`."""
    sources = Sources(roots)
    return [_readable(root, copies, sources) if root.is_dir() else root for root in roots]


def _readable(root: Path, copies: Path, sources: Sources) -> Path:
    changed = _kept(root, sources)
    if not changed:
        return root
    copy = copies / str(len(list(copies.iterdir())))
    _mirror(root, copy, Path(), {Path(name): text for name, text in changed.items()})
    return copy


def _kept(root: Path, sources: Sources) -> dict[str, str]:
    """The files that are changed, kept for the next process: to find them takes some 10 s for the Modelica library."""
    folder = folder_of("modelica")
    if folder is None:
        return dict(_changed(root, sources))
    # All roots count, since types of a file may be defined in another library.
    told = json.dumps([_FORMAT, [contents(r, folder) for r in sources.roots], str(root)])
    path = folder / "readable" / f"{hashlib.sha256(told.encode()).hexdigest()}.gz"
    with contextlib.suppress(OSError, EOFError, ValueError):
        return json.loads(gzip.decompress(path.read_bytes()))
    changed = dict(_changed(root, sources))
    write(path, gzip.compress(json.dumps(changed).encode(), 6))
    return changed


def _changed(root: Path, sources: Sources) -> Iterator[tuple[str, str]]:
    for file in sorted(root.rglob("*.mo")):
        text = file.read_text(encoding="utf-8-sig", errors="replace")
        new = _by_initial_equations(text) if _LOOK_UP in text else text
        new = _by_assertions(new) if _ERROR in new else new
        new = _START.sub(r"\g<declared> = 0\g<between>", new)
        new = without_algorithms(sources, new)
        new = with_kept_inputs(sources, new)
        new = with_real_equations(sources, new)
        new = with_single_connections(sources, new)
        if new != text:
            yield str(file.relative_to(root)), new


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


def _by_assertions(text: str) -> str:
    """The text with assertions in place of conditions that do nothing but end a run with an error."""

    def assertion(found: re.Match[str]) -> str:
        condition = found["condition"].strip()
        if re.search(r"\b(if|then|elseif|else)\b", condition):
            return found[0]
        new = f"assert(not ({condition}), {found['message']});"
        return new + "\n" * (found[0].count("\n") - new.count("\n"))

    return _REFUSED.sub(assertion, text)


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
