"""Reads a model from a file or a text: Base Modelica by itself, Modelica with its libraries by rumoca."""

import dataclasses
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..base.errors import ModelError, nearest
from ..base.optional import optional_module
from .complete import completed
from .flat_model import FlatModel, flat_of
from .left_out import LEFT_OUT
from .library import Library
from .read_base import read_base, read_modifiers
from .read_rumoca import read_rumoca
from .roots import ROOT
from .tree import Modifiers

_PLACE = re.compile(r"× (?P<what>[^\n]*)\s+╭─\[[^\]]*?:(?P<line>\d+):(?P<column>\d+)\]")
_UNRESOLVED = re.compile(r"unresolved (type reference|function call|component reference|[\w ]+): '([^']+)'")
_UNBALANCED = re.compile(r"unbalanced model: (\d+) equations, (\d+) unknowns")
DEFINED = frozenset({*LEFT_OUT, ROOT})  # functions that texts need not hold
_CLASS = re.compile(r"\b(?:model|class|block)\s+(\w+)")


def load(source: str | Path, model: str | None = None, roots: Sequence[str | Path] = ()) -> FlatModel:
    """Reads a model in Base Modelica, or in Modelica.

    Base Modelica is read without other packages. Modelica source is flattened by rumoca (extra `modelica`): files
    `.mo` that do not begin with `//! base`, and whatever `model` is given for, or `roots` without that beginning.

    **Arguments:**

    - `source`: the path of a file, or the text itself.
    - `model`: the full name of the model, such as `"Circuits.RC"`; the only one of the source if left out.
    - `roots`: folders or files of the libraries that a model in Modelica uses. For Base Modelica, the folders where
        functions and records are defined that the text calls but does not hold.

    **Raises:**

    - `ModelError` for what is not Modelica, with line and column; for a text in Base Modelica that does not hold
        exactly one model; for names that neither the source nor the roots hold.
    - `MissingPackage` for Modelica source without rumoca.
    """
    is_text = isinstance(source, str) and ("\n" in source or not source.endswith((".bmo", ".mo")))
    text = str(source) if is_text else Path(source).read_text(encoding="utf-8")
    is_base = text.startswith("//! base")
    is_modelica = not is_text and str(source).endswith(".mo") and not is_base
    if model is None and (is_base or not roots) and not is_modelica:
        flat = flat_of(read_base(text))
        return completed(flat, Library(roots), DEFINED) if roots else flat
    return _by_rumoca(text, None if is_text else Path(source), model, roots)


def _by_rumoca(text: str, file: Path | None, model: str | None, roots: Sequence[str | Path]) -> FlatModel:
    rumoca = optional_module("rumoca", "modelica", "Modelica source is flattened by rumoca")
    try:
        session = rumoca.Session(roots=[str(root) for root in roots])
        found = session.loads(text, model=model) if file is None else session.load(str(file), model=model)
        dae = found.to_dict("dae")
    except (rumoca.RumocaError, RuntimeError) as error:
        raise ModelError(_said(rumoca, text, model, roots, str(error))) from None
    name = found.name.rpartition(".")[2]
    flat = read_rumoca(dae, name)
    annotation = _annotation(text, name)
    return dataclasses.replace(flat, model=flat.model._replace(annotation=annotation))


def _said(rumoca: Any, text: str, model: str | None, roots: Sequence[str | Path], error: str) -> str:
    """What rumoca found wrong, with its place."""
    found = [d.message for d in rumoca.validate_source(text, model=model) if d.rule == "syntax-error"]
    if place := _PLACE.search("\n".join(found)):
        return f"Modelica, line {place['line']}, column {place['column']}: {place['what'].strip()}"
    unresolved = sorted((m.groups() for m in _UNRESOLVED.finditer(error)), key=lambda each: each[0] != "type reference")
    if unresolved:
        kind, name = unresolved[0]
        at = re.search(rf"(?<![\w.]){re.escape(name)}(?!\w)", text)
        line = f", line {text.count(chr(10), 0, at.start()) + 1}" if at else ""
        more = "" if roots else "; roots=[…] names the folders of the libraries that the source uses"
        return f"Modelica{line}: the {kind} '{name}' is not found{more if '.' in name else ''}"
    known = _CLASS.findall(text)
    last = (model or "").rpartition(".")[2]
    if last and last not in known and not roots:
        return f"there is no model '{model}': {nearest(last, known)}"
    if counts := _UNBALANCED.search(error):
        equations, unknowns = map(int, counts.groups())
        few = "; rumoca does not say which of them are too many"
        return f"'{model or last}' has {_count(equations, 'equation')} for {_count(unknowns, 'unknown')}{few}"
    return f"rumoca {rumoca.version()}: {error}"


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def _annotation(text: str, name: str) -> Modifiers:
    """The annotation of a class, as far as it is about the experiment."""
    body = re.search(rf"\b(?:model|class|block)\s+{re.escape(name)}\b(.*?)\bend\s+{re.escape(name)}\s*;", text, re.S)
    found = re.search(r"\bexperiment\s*(\([^()]*\))", body[1]) if body else None
    return {"experiment": read_modifiers(found[1])} if found else {}
