"""How reports are shown: a head, and sections of lines, as text or as HTML that folds."""

import abc
import html
import math
import re
from collections.abc import Sequence

SHOWN = 12  # entries of a section in a text
HTML_SHOWN = 200  # and in a notebook, where sections fold


class Sections(abc.ABC):
    """A report that prints itself."""

    @abc.abstractmethod
    def _contents(self) -> tuple[list[str], list[tuple[str, list[str]]]]:
        """The lines of the head, and sections as (title, entries)."""

    def __str__(self):
        head, sections = self._contents()
        lines = list(head)
        for title, entries in sections:
            more = [f"    … and {len(entries) - SHOWN} more"] if len(entries) > SHOWN else []
            lines += [f"{title}:", *(f"    {e}" for e in entries[:SHOWN]), *more]
        return "\n".join(lines)

    __repr__ = __str__

    def _repr_html_(self) -> str:
        """The report for a notebook: sections that fold."""
        head, sections = self._contents()
        out = [f"<p>{'<br>'.join(html.escape(line) for line in head)}</p>"]
        for title, entries in sections:
            items = "".join(f"<li><code>{html.escape(e)}</code></li>" for e in entries[:HTML_SHOWN])
            more = f"<li>… and {len(entries) - HTML_SHOWN} more</li>" if len(entries) > HTML_SHOWN else ""
            opened = " open" if len(entries) <= SHOWN else ""
            out.append(f"<details{opened}><summary>{html.escape(title)}</summary><ul>{items}{more}</ul></details>")
        return "".join(out)


def some(names: Sequence[str]) -> str:
    """Names in a list; of long lists the first ones, and how many there are."""
    return ", ".join(names[:SHOWN]) + (f", … ({len(names)} in all)" if len(names) > SHOWN else "")


def folded(names: Sequence[str]) -> list[str]:
    """The names in order, those that differ in whole ranges of indices as one: `cell[0…49].v`."""
    alike: dict[str, list[str]] = {}
    for name in names:
        alike.setdefault(_INDEX.sub("[]", name), []).append(name)
    return [name for group in alike.values() for name in _as_one(group)]


def _as_one(names: list[str]) -> list[str]:
    places = [tuple(map(int, re.findall(r"\d+", " ".join(_INDEX.findall(name))))) for name in names]
    ranges = [range(min(column), max(column) + 1) for column in zip(*places, strict=True)]
    # Whole ranges only: where one index is missing, a range would claim a name that the model does not have.
    if len(names) < 2 or len(set(places)) != math.prod(map(len, ranges)) or len(set(places)) != len(names):
        return names
    written = iter(f"{r[0]}…{r[-1]}" if len(r) > 1 else str(r[0]) for r in ranges)
    return [_INDEX.sub(lambda found: re.sub(r"\d+", lambda _: next(written), found[0]), names[0])]


_INDEX = re.compile(r"\[\d+(?:, ?\d+)*\]")
