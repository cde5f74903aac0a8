"""On the page of errors, each row of a table becomes a heading that errors link to (a hook of MkDocs)."""

import re
from typing import Any

from jaxonomy_dae.base.errors.page import ROW, Entry

HEAD = re.compile(r"^\| text \|.*\n\|[-|]+\n", re.M)


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    if page.file.src_uri != "errors.md":
        return markdown
    return ROW.sub(_heading, HEAD.sub("", markdown))


def _heading(row: re.Match[str]) -> str:
    entry = Entry(*row.groups())
    return f"### `{entry.text}` {{#{entry.anchor}}}\n\n{entry.meaning}\n\n**Fix:** {entry.fix}\n"
