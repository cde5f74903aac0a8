"""The gallery: an overview, and the notebooks of `examples/gallery` with their stored outputs (a hook of MkDocs)."""

import base64
import json
import pathlib
from typing import Any

from mkdocs.plugins import event_priority
from mkdocs.structure.files import File

TITLE = "Gallery"
NOTEBOOKS = pathlib.Path(__file__).parents[1] / "examples" / "gallery"


def notebooks() -> list[pathlib.Path]:
    return sorted(NOTEBOOKS.glob("*.ipynb"))


def introduction_of(notebook: pathlib.Path) -> list[str]:
    """The paragraphs of the cell with which it begins; the first is the heading."""
    return "".join(json.loads(notebook.read_text())["cells"][0]["source"]).split("\n\n")


def title_of(notebook: pathlib.Path) -> str:
    return introduction_of(notebook)[0].removeprefix("# ")


def last_figure_of(notebook: pathlib.Path) -> bytes:
    """The last figure that is stored in it, a PNG."""
    cells = json.loads(notebook.read_text())["cells"]
    figures = [o["data"]["image/png"] for c in cells for o in c.get("outputs", ()) if "image/png" in o.get("data", ())]
    return base64.b64decode("".join(figures[-1]))


def overview() -> str:
    """The first page: what each notebook is about, with its last figure."""
    lines = ["# Gallery", "", "Notebooks to read from top to bottom, or to run: they lie in `examples/gallery`.", ""]
    for path in notebooks():
        title, about = introduction_of(path)[:2]
        sentences = about[: about.rindex(".") + 1]  # what comes after begins a list
        lines += [f"## [{title.removeprefix('# ')}]({path.name})", "", sentences, ""]
        lines += [f"[![The last figure]({path.stem}.png)]({path.name})", ""]
    return "\n".join(lines)


def on_config(config: Any) -> Any:
    pages = ["gallery/index.md", *({title_of(path): f"gallery/{path.name}"} for path in notebooks())]
    config.nav = [{TITLE: pages} if TITLE in entry else entry for entry in config.nav]
    return config


@event_priority(100)  # before mkdocs-jupyter looks for notebooks
def on_files(files: Any, config: Any) -> Any:
    files.append(File.generated(config, "gallery/index.md", content=overview()))
    for path in notebooks():
        source, site = str(NOTEBOOKS.parent), config.site_dir
        files.append(File(f"gallery/{path.name}", source, site, config.use_directory_urls))
        files.append(File.generated(config, f"gallery/{path.stem}.png", content=last_figure_of(path)))
    return files
