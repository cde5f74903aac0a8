"""How reports are shown: a head, and sections of lines, as text or as HTML that folds."""

import abc
import html
from collections.abc import Sequence

SHOWN = 12
HTML_SHOWN = 200


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
        """The same for a notebook: sections that fold."""
        head, sections = self._contents()
        out = [f"<p>{'<br>'.join(html.escape(line) for line in head)}</p>"]
        for title, entries in sections:
            items = "".join(f"<li><code>{html.escape(e)}</code></li>" for e in entries[:HTML_SHOWN])
            more = f"<li>… and {len(entries) - HTML_SHOWN} more</li>" if len(entries) > HTML_SHOWN else ""
            opened = " open" if len(entries) <= SHOWN else ""
            out.append(f"<details{opened}><summary>{html.escape(title)}</summary><ul>{items}{more}</ul></details>")
        return "".join(out)


def some(names: Sequence[str]) -> str:
    """Names, and of long lists how many there are."""
    return ", ".join(names[:SHOWN]) + (f", … ({len(names)} in all)" if len(names) > SHOWN else "")
