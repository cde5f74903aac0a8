"""rumoca, which flattens Modelica source (extra `modelica`), and what it says of a source that it refuses."""

import re
import shutil
import tempfile
import weakref
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from ..base.errors import ModelError, nearest
from ..base.optional import optional_module
from .readable_sources import with_readable_sources
from .rumoca_expressions import Json
from .sources import first_broken

_PLACE = re.compile(r"× (?P<what>[^\n]*)\s+╭─\[[^\]]*?:(?P<line>\d+):(?P<column>\d+)\]")
_UNRESOLVED = re.compile(r"unresolved (type reference|function call|component reference|[\w ]+): '([^']+)'")
_UNBALANCED = re.compile(r"unbalanced model: (\d+) equations, (\d+) unknowns")
_UNROOTED = re.compile(
    r"Connections\.branch\(([^,]+), ([^)]+)\) belongs to a virtual connection graph component with no"
)
_DECIDES = re.compile(
    r"not parameter-evaluable: unknown variable: ([\w.]+)|unresolved component dimension for [\w.]+: (\w+)"
)
_CONDITION = re.compile(r"conditional component `([\w.]+)` requires parameter expression")
_UNCLOCKED = re.compile(
    r"unresolved clock schedule|no exact connected clock owner|no inferred clock constructor"
    r"|must belong to a proven clock partition|the required exact clock owner|requires an owning clocked when-clause"
)
_NOT_LOADED = re.compile(r"Failed to load source root")
_CLASS = re.compile(r"\b(?:model|class|block)\s+(\w+)")


class Unrooted(ModelError):
    """An overdetermined record, `record`, belongs to a graph without a root."""

    def __init__(self, message: str, record: str):
        super().__init__(message)
        self.record = record


class Unbalanced(ModelError):
    """A model has other than one equation for each unknown; `missing` are those that it lacks."""

    def __init__(self, message: str, missing: int):
        super().__init__(message)
        self.missing = missing


class Unclocked(ModelError):
    """Nothing in a model says when a clock ticks."""


class Flattened(NamedTuple):
    """A model as rumoca has flattened it: its name, its equations (`dae`), and its variables as the source declares
    them (`flat`)."""

    name: str
    dae: Json
    flat: Json


class FrontEnd:
    """A session of rumoca with libraries. It reads them when the first model is asked for, which takes some 20 s for
    the Modelica library, and keeps what it has read."""

    def __init__(self, roots: Sequence[str | Path] = ()):
        self.roots = [Path(root) for root in roots]
        self.rumoca = optional_module("rumoca", "modelica", "Modelica source is flattened by rumoca")
        self.session: Any = None
        self.readable: list[Path] = []

    def flatten(
        self, text: str | None, model: str | None, file: Path | None = None, called: str | None = None
    ) -> Flattened:
        """Flattens a model of a text, of a file, or, if both are None, of the libraries. Messages name it `called`.

        **Raises:**

        - `ModelError` with what rumoca refuses, and with the place in the text where it says one.
        """
        session = self._opened()
        try:
            if text is None or file is not None:
                found = session.load(str(file or self._outermost(model or "")), model=model)
            else:
                found = session.loads(text, model=model)
            return Flattened(found.name, found.to_dict("dae"), found.to_dict("flat"))
        except (self.rumoca.RumocaError, RuntimeError) as error:
            said = self._said(text or "", model, str(error), called or model)
            if record := _UNROOTED.search(str(error)):
                raise Unrooted(
                    f"'{called or model}': nothing is the root of the graph of '{record[1]}' and '{record[2]}': "
                    "open a part of a model that has the root (Connections.root) inside, as source=…",
                    record[1],
                ) from None
            if counts := _UNBALANCED.search(str(error)):
                raise Unbalanced(said, int(counts[2]) - int(counts[1])) from None
            raise (Unclocked if _UNCLOCKED.search(str(error)) else ModelError)(said) from None
        except BaseException as error:
            if type(error).__name__ != "PanicException":  # of a Rust library: no Exception, and not importable
                raise
            raise ModelError(f"rumoca {self.rumoca.version()} fails at '{model}': {error}") from None

    def _opened(self) -> Any:
        if self.session is None:
            # rumoca asks for the folder that holds that of a library.
            folders = [root.parent if (root / "package.mo").exists() else root for root in self.roots]
            if any(f.is_dir() for f in folders):
                copies = Path(tempfile.mkdtemp(prefix="modelica-"))
                weakref.finalize(self, shutil.rmtree, copies, True)
                folders = with_readable_sources(folders, copies)
            self.readable = folders
            self.session = self.rumoca.Session(roots=[str(root) for root in self.readable])
        return self.session

    def _outermost(self, name: str) -> Path:
        """The file of the outermost package of a class."""
        first = name.partition(".")[0]
        for root in self.readable:
            for file in (root / first / "package.mo", root / f"{first}.mo", root):
                if file.is_file() and (file is not root or root.stem == first):
                    return file
        where = ", ".join(map(str, self.roots)) or "none is given"
        raise ModelError(f"'{name}' is in none of the roots: {where}; roots=[…] names the folder that holds '{first}'")

    def _said(self, text: str, model: str | None, error: str, called: str | None) -> str:
        """What rumoca found wrong, with its place."""
        if _NOT_LOADED.search(error) and (broken := first_broken(self.roots)):
            return broken
        error = error.partition("\nRelated failures")[0]
        error = re.sub(rf"\b{re.escape(model)}\b(?! =)", called, error) if model and called else error
        # A syntax error has a place in the text, which the error of the flattening does not say.
        wrong = [d.message for d in self.rumoca.validate_source(text, model=model) if d.rule == "syntax-error"]
        if place := _PLACE.search("\n".join(wrong)):
            return f"Modelica, line {place['line']}, column {place['column']}: {place['what'].strip()}"
        # A type that is not found explains other names that are not: it is said first.
        unresolved = sorted(
            (m.groups() for m in _UNRESOLVED.finditer(error)), key=lambda each: each[0] != "type reference"
        )
        if unresolved:
            kind, name = unresolved[0]
            at = re.search(rf"(?<![\w.]){re.escape(name)}(?!\w)", text)
            line = f", line {text.count(chr(10), 0, at.start()) + 1}" if at else ""
            more = "" if self.roots else "; roots=[…] names the folders of the libraries that the source uses"
            return f"Modelica{line}: the {kind} '{name}' is not found{more if '.' in name else ''}"
        known = _CLASS.findall(text)
        last = (model or "").rpartition(".")[2]
        if last and last not in known and not self.roots:
            return f"there is no model '{model}': {nearest(last, known)}"
        if counts := _UNBALANCED.search(error):
            equations, unknowns = map(int, counts.groups())
            which = "are too many" if equations > unknowns else "lack one"
            counts = f"{_count(equations, 'equation')} for {_count(unknowns, 'unknown')}"
            return f"'{called or last}' has {counts}; rumoca does not say which of them {which}"
        if found := _CONDITION.search(error):
            return (
                f"nothing says whether there is a '{found[1]}': the class gives no value to the parameter that decides "
                "it; component(…, parameter=True)"
            )
        if found := _DECIDES.search(error):
            name = found[1] or found[2]
            return f"the class gives no value to '{name}', which decides its equations: component(…, {name}=…)"
        return f"rumoca {self.rumoca.version()}: {error}"


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
