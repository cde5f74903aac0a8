"""The gallery's pages: the notebooks of `examples/gallery`, with their stored outputs (a hook of MkDocs)."""

import json
import pathlib
from typing import Any

from mkdocs.plugins import event_priority
from mkdocs.structure.files import File

TITLE = "Gallery"
NOTEBOOKS = pathlib.Path(__file__).parents[1] / "examples" / "gallery"


def notebooks() -> list[pathlib.Path]:
    return sorted(NOTEBOOKS.glob("*.ipynb"))


def title_of(notebook: pathlib.Path) -> str:
    """The heading with which it begins."""
    first = json.loads(notebook.read_text())["cells"][0]["source"]
    return "".join(first).partition("\n")[0].removeprefix("# ")


def on_config(config: Any) -> Any:
    pages = [{title_of(path): f"gallery/{path.name}"} for path in notebooks()]
    config.nav = [{TITLE: pages} if TITLE in entry else entry for entry in config.nav]
    return config


@event_priority(100)  # before mkdocs-jupyter looks for notebooks
def on_files(files: Any, config: Any) -> Any:
    for path in notebooks():
        source, site = str(NOTEBOOKS.parent), config.site_dir
        files.append(File(f"gallery/{path.name}", source, site, config.use_directory_urls))
    return files
