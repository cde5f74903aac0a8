"""One page for each object of the API (a hook of MkDocs).

The pages in `docs/api` list objects, `::: name` with options below it, among text. Built, each object has a page of its
own, and the list has links to them, each with the first sentence of what it links to.
"""

import importlib
import inspect
import pathlib
import re
from typing import Any

FOLDER = pathlib.Path(__file__).parent / "api"
TITLE = "API"
OBJECT = re.compile(r"^::: ([\w.]+)\n((?:    .*\n)*)", re.M)


def groups() -> list[pathlib.Path]:
    return sorted(path for path in FOLDER.glob("*.md") if path.stem != "index")


def title_of(path: pathlib.Path) -> str:
    return path.read_text().partition("\n")[0].removeprefix("# ")


def found(name: str) -> Any:
    module, _, last = name.rpartition(".")
    return getattr(importlib.import_module(module), last)


def file_of(name: str) -> str:
    """The page of an object; where files are told apart without case, classes and functions must differ."""
    last = name.rpartition(".")[2]
    return f"{last}-class" if inspect.isclass(found(name)) else last


def first_sentence(name: str) -> str:
    text = " ".join((inspect.getdoc(found(name)) or "").partition("\n\n")[0].split())
    return re.split(r"(?<=[.:])\s", text)[0].rstrip(":.") + "." if text else ""


def overview(path: pathlib.Path) -> str:
    """A page of the folder with a link in place of each object."""

    def link(match: re.Match[str]) -> str:
        return f"- [`{match[1].rpartition('.')[2]}`]({file_of(match[1])}.md): {first_sentence(match[1])}\n"

    return OBJECT.sub(link, re.sub(r"(?<!\n)\n(?=::: )", "\n\n", path.read_text())).replace("\n\n- [`", "\n- [`", 0)


def object_page(name: str, options: str) -> str:
    return f"::: {name}\n{options or '    options:' + chr(10)}      heading_level: 1\n"


def index() -> str:
    lines = ["# API", "", "Every public name, one page each.", ""]
    lines += [f"- [{title_of(path)}]({path.name})" for path in groups()]
    return "\n".join(lines) + "\n"


def on_config(config: Any) -> Any:
    nav: list[Any] = ["api/index.md"]
    for path in groups():
        names = [match[1] for match in OBJECT.finditer(path.read_text())]
        nav.append(
            {title_of(path): [f"api/{path.name}", *({n.rpartition(".")[2]: f"api/{file_of(n)}.md"} for n in names)]}
        )
    config.nav = [{TITLE: nav} if TITLE in entry else entry for entry in config.nav]
    return config


def on_files(files: Any, config: Any) -> Any:
    from mkdocs.structure.files import File

    files.append(File.generated(config, "api/index.md", content=index()))
    for path in groups():
        for match in OBJECT.finditer(path.read_text()):
            files.append(File.generated(config, f"api/{file_of(match[1])}.md", content=object_page(match[1], match[2])))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    source = FOLDER / pathlib.Path(page.file.src_uri).name
    listed = page.file.src_uri.startswith("api/") and source in groups()
    return overview(source) if listed else markdown
