"""On the page of errors, each row of a table becomes a heading that can be linked (a hook of MkDocs)."""

import re
from typing import Any

ROW = re.compile(r"^\| `([^`]+)` \| (.+?) \| (.+?) \|$", re.M)
HEAD = re.compile(r"^\| text \|.*\n\|[-|]+\n", re.M)


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    if page.file.src_uri != "errors.md":
        return markdown
    return ROW.sub(r"### `\1`\n\n\2\n\n**Fix:** \3\n", HEAD.sub("", markdown))
