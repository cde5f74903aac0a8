"""Runs the blocks of a page of the documentation; writes what they print, and draw, into the page.

    python docs/run_pages.py docs/how-to/inputs.md docs/start/first-model.md

All blocks of a page that are marked `python` run in order, in one namespace. The block of text below one holds what
it prints. A block with a title, such as `python title="Fragment"`, is not run. What a block draws becomes a figure in
`docs/images/pages/`, for light and for dark pages; a line `FIGURE: description` says where it goes.
`tests/plants/test_printing_pages.py` runs the same blocks and compares.
"""

import contextlib
import dataclasses
import io
import os
import pathlib
import re
import sys
import tempfile
import time
from typing import Any

DOCS = pathlib.Path(__file__).parent
BLOCK = re.compile(r"^```(\w+)([^\n]*)\n(.*?)^```$\n?", re.M | re.S)
INK, PAPER_INK = "#1f2328", "#e6edf3"  # of light and of dark pages
WIDTH = 5.8  # inches, so that letters stay legible on a screen of 400 px
STYLE = {
    "text.color": INK, "axes.edgecolor": INK, "axes.labelcolor": INK, "xtick.color": INK, "ytick.color": INK,
    "axes.spines.top": False, "axes.spines.right": False, "font.size": 10.5, "svg.hashsalt": "pages",
    "legend.frameon": False,
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Block:
    """A fenced block: its language, whether it has a title, what it holds, and where it begins and ends in the page."""

    language: str
    titled: bool
    content: str
    begin: int
    end: int

    @property
    def runs(self) -> bool:
        return self.language == "python" and not self.titled


def blocks_of(text: str) -> list[Block]:
    return [Block(m[1], "title=" in m[2], m[3], m.start(), m.end()) for m in BLOCK.finditer(text)]


def pages() -> list[pathlib.Path]:
    """Pages with blocks that run, relative to the folder of the documentation; the README among them."""
    found = [*sorted(DOCS.rglob("*.md")), DOCS.parent / "README.md"]
    return [path for path in found if any(block.runs for block in blocks_of(path.read_text()))]


def name_of(page: pathlib.Path) -> str:
    return os.path.relpath(page, DOCS)


def figures_of(page: pathlib.Path) -> str:
    """The beginning of the names of a page's figures."""
    return name_of(page).removesuffix(".md").replace(os.sep, "-").strip(".-")


def program(page: pathlib.Path, text: str, block: Block) -> Any:
    """A block as compiled code. Messages name its lines as those of a script that holds all blocks of the page."""
    before = "".join(other.content for other in blocks_of(text[: block.begin]) if other.runs)
    return compile("\n" * before.count("\n") + block.content, f"{page.stem}.py", "exec")


def save_figures(names: list[str]) -> None:
    """Saves the open figures for light and dark pages, and closes them."""
    import matplotlib.pyplot as plt

    for number, name in zip(plt.get_fignums(), names, strict=True):
        drawn, figure = io.StringIO(), plt.figure(number)
        width, height = figure.get_size_inches()
        figure.set_size_inches(WIDTH, height * (0.5 + 0.5 * WIDTH / width))
        figure.savefig(drawn, format="svg", transparent=True, metadata={"Date": None})
        for kind, ink in (("light", INK), ("dark", PAPER_INK)):
            text = "\n".join(line.rstrip() for line in drawn.getvalue().replace(INK, ink).splitlines()) + "\n"
            (DOCS / "images" / "pages" / f"{name}-{kind}.svg").write_text(text)
    plt.close("all")


def run(page: pathlib.Path) -> str:
    """Runs a page's blocks and returns its text with what they print and draw."""
    import matplotlib.pyplot as plt

    text = page.read_text()
    blocks, names, outputs, drawn = blocks_of(text), {"__name__": "page"}, {}, 0
    here, began = os.getcwd(), time.process_time()
    stem, figures = figures_of(page), []
    shows = "FIGURE: " in text or f"images/pages/{stem}-" in text
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        try:
            for k, block in enumerate(blocks):
                if not block.runs:
                    continue
                said = io.StringIO()
                with plt.rc_context(STYLE), contextlib.redirect_stdout(said):
                    exec(program(page, text, block), names)
                    new = [f"{stem}-{drawn + j + 1}" for j in range(len(plt.get_fignums()))] if shows else []
                    save_figures(new) if shows else plt.close("all")
                drawn, figures = drawn + len(new), figures + new
                outputs[k] = said.getvalue()
        finally:
            os.chdir(here)
    written, at = [], 0
    for k, block in enumerate(blocks):
        written.append(text[at : block.begin])
        at = block.end
        if block.language == "text" and not block.titled and k and blocks[k - 1].runs:
            continue  # what was printed before
        written.append(text[block.begin : block.end])
        if outputs.get(k):
            written.append(f"\n```text\n{outputs[k].rstrip()}\n```\n")
            if k + 1 < len(blocks) and blocks[k + 1].language == "text" and not blocks[k + 1].titled:
                at = blocks[k + 1].end if not text[block.end : blocks[k + 1].begin].strip() else at
    found = "".join([*written, text[at:]])
    up = "docs/" if page.parent == DOCS.parent else "../" * (len(page.relative_to(DOCS).parts) - 1)
    for name in figures:
        image = (
            f"![\\1]({up}images/pages/{name}-light.svg#only-light)\n![\\1]({up}images/pages/{name}-dark.svg#only-dark)"
        )
        if f"{name}-light.svg" not in found:
            found, replaced = re.subn(r"^FIGURE: (.*)$", image, found, count=1, flags=re.M)
            if not replaced:
                print(f"{name_of(page)}: no line FIGURE: for {name}", file=sys.stderr)
    count = sum(block.runs for block in blocks)
    print(f"{name_of(page)}: {count} blocks, {drawn} figures, {time.process_time() - began:.1f} processor seconds")
    return found


def main(arguments: list[Any]) -> None:
    for argument in arguments:
        page = pathlib.Path(argument).resolve()
        page.write_text(run(page))


if __name__ == "__main__":
    main(sys.argv[1:])
