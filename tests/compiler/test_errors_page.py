"""Every text in the page of errors is one that the package says."""

import ast
import functools
import pathlib
import re

import pytest

import jaxonomy_dae
from jaxonomy_dae import ModelError
from jaxonomy_dae.base.errors.page import GAP, entries, entry_for

DOCS = pathlib.Path(__file__).parents[2] / "docs"


def text_of(node: ast.AST) -> str | None:
    """A text as it is written, with `…` for what is filled in."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return re.sub(r"\{\w*\}", GAP, node.value)
    if isinstance(node, ast.JoinedStr):
        return "".join(str(v.value) if isinstance(v, ast.Constant) else GAP for v in node.values)
    return None


@functools.cache
def said() -> str:
    """All texts of the package but docstrings, a line each."""
    lines = []
    for path in pathlib.Path(jaxonomy_dae.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.Expr):  # a docstring's parent
                lines += [t for child in ast.iter_child_nodes(node) if (t := text_of(child)) is not None]
    return "\n".join(lines)


def rows() -> list[tuple[str, str, str]]:
    """(text, meaning, mend) of all tables."""
    found = []
    for line in (DOCS / "errors.md").read_text().splitlines():
        cells = [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]]
        if len(cells) == 3 and cells[0] not in ("text", "---"):
            found.append(tuple(cells))
    return found


def test_there_are_rows():
    assert len(rows()) > 50
    assert not [row for row in rows() if not all(row)], "a cell is empty"
    texts = [row[0] for row in rows()]
    assert len(texts) == len({*texts})


@pytest.mark.parametrize("text", [row[0] for row in rows()])
def test_the_package_says_it(text):
    assert re.fullmatch("`[^`]{12,}`", text), "one text in backticks, long enough to be told from others"
    assert text[1:-1] in said(), text


def test_anchors_are_unique():
    anchors = [entry.anchor for entry in entries()]
    assert len(anchors) == len({*anchors}) == len(rows())


@pytest.mark.parametrize("entry", entries(), ids=lambda entry: entry.anchor)
def test_a_text_leads_to_its_entry(entry):
    """An error that begins and ends with other words, and has names in the gaps, is explained by its own entry."""
    message = f"component 'a': {entry.text.replace(GAP, 'some.name')} (line 3)\nand more."
    assert entry_for(message) is entry


def test_an_error_names_its_entry():
    error = ModelError("component 'c' is complete: add its equations inside __init__ of its class")
    assert error.__notes__ == ["Explained in docs/errors.md#component-is-complete-inside-init-of"]
    assert error.explanation.startswith("Something was added after the component was made. Fix: Move it")
    other = ModelError("there is no text like this")
    assert not hasattr(other, "__notes__") and other.explanation == ""
