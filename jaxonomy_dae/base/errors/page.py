"""The page of errors, as data: which entry explains a message."""

import functools
import pathlib
import re
from typing import NamedTuple

PAGE = "docs/errors.md"
WORDS = 6  # of a text that its anchor is made of
ROW = re.compile(r"^\| `([^`]+)` \| (.+?) \| (.+?) \|$", re.M)
GAP = "…"  # in the page, for names and numbers


class Entry(NamedTuple):
    """A row of the page: a part of messages, what it means, and how to mend it."""

    text: str
    meaning: str
    fix: str

    @property
    def anchor(self) -> str:
        """The name by which the page's headings are linked."""
        return "-".join(re.findall(r"[a-z0-9]+", self.text.lower())[:WORDS])


@functools.cache
def entries() -> tuple[Entry, ...]:
    """All entries, in the order of the page; none if the page was not installed."""
    here = pathlib.Path(__file__)
    # In a wheel the page lies beside this file, in a checkout among the others.
    places = [here.with_name("errors.md"), here.parents[3] / PAGE]
    page = next((place for place in places if place.exists()), None)
    return () if page is None else tuple(Entry(*row) for row in ROW.findall(page.read_text(encoding="utf-8")))


@functools.cache
def _patterns() -> tuple[tuple[re.Pattern[str], Entry], ...]:
    # A gap ends with its line, so that one entry does not join two sentences of a message.
    return tuple((re.compile(r"[^\n]*?".join(map(re.escape, entry.text.split(GAP)))), entry) for entry in entries())


def entry_for(message: str) -> Entry | None:
    """The first entry of the page that explains a message; None if there is none."""
    return next((entry for pattern, entry in _patterns() if pattern.search(message)), None)
