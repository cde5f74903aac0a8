"""Reads a model from a file or a text: Base Modelica by itself, Modelica with its libraries by rumoca."""

import dataclasses
import re
from collections.abc import Sequence
from pathlib import Path

from .complete import completed
from .external_objects import with_external_objects
from .flat_model import FlatModel, flat_of
from .front_end import FrontEnd
from .kept_inputs import with_starts_of_inputs
from .left_out import LEFT_OUT
from .model_algorithms import with_algorithms
from .read_base import read_base, read_modifiers
from .read_rumoca import read_rumoca
from .roots import ROOT
from .sources import Sources
from .tree import Modifiers

DEFINED = frozenset({*LEFT_OUT, ROOT})  # functions that texts need not hold


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
    written = str(source) if is_text else Path(source).read_text(encoding="utf-8")
    text = written.removeprefix("\ufeff")  # a byte order mark, which rumoca does not read
    is_base = text.startswith("//! base")
    is_modelica = not is_text and str(source).endswith(".mo") and not is_base
    if model is None and (is_base or not roots) and not is_modelica:
        flat = flat_of(read_base(text))
        return completed(flat, Sources(roots), DEFINED) if roots else flat
    # rumoca reads a file itself; one that begins with what it does not read is given as a text.
    return _by_rumoca(text, None if is_text or text != written else Path(source), model, roots)


def _by_rumoca(text: str, file: Path | None, model: str | None, roots: Sequence[str | Path]) -> FlatModel:
    found = FrontEnd(roots).flatten(text, model, file)
    name = found.name.rpartition(".")[2]
    flat = with_external_objects(read_rumoca(found.dae, name), found.flat)
    flat = with_starts_of_inputs(with_algorithms(flat, Sources(roots)))
    annotation = _annotation(text, name)
    return dataclasses.replace(flat, model=flat.model._replace(annotation=annotation))


def _annotation(text: str, name: str) -> Modifiers:
    """The annotation of a class, as far as it is about the experiment."""
    body = re.search(rf"\b(?:model|class|block)\s+{re.escape(name)}\b(.*?)\bend\s+{re.escape(name)}\s*;", text, re.S)
    found = re.search(r"\bexperiment\s*(\([^()]*\))", body[1]) if body else None
    return {"experiment": read_modifiers(found[1])} if found else {}
