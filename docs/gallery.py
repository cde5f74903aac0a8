"""The gallery: an overview, and the notebooks of `examples` with their stored outputs (a hook of MkDocs)."""

import base64
import dataclasses
import functools
import json
import os
import pathlib
from typing import Any

from mkdocs.plugins import event_priority
from mkdocs.structure.files import File

TITLE = "Gallery"
REPOSITORY = "jaxonomy-dae/jaxonomy_dae"  # on GitHub
EXAMPLES = pathlib.Path(__file__).parents[1] / "examples"


@dataclasses.dataclass(frozen=True)
class Entry:
    """A notebook: its file without suffix, the one idea that it teaches, and the processor time of a first run, if it
    was measured."""

    stem: str
    idea: str
    time: str = ""

    @property
    def path(self) -> pathlib.Path:
        inside = EXAMPLES / "gallery" / f"{self.stem}.ipynb"
        return inside if inside.exists() else EXAMPLES / f"{self.stem}.ipynb"


# By level; in each, the easier ones first.
LEVELS: dict[str, tuple[Entry, ...]] = {
    "First": (
        Entry(
            "neural_dae_pendulum_drag",
            "A network inside a constraint: constraint forces respond to it.",
            "one to two minutes",
        ),
        Entry("motor_control", "Library parts, a controller, and gains trained by a gradient.", "30 seconds"),
        Entry("linkage", "A closed loop of joints, and derivatives of its motion.", "20 seconds"),
        Entry("circuit", "Frequency responses, and parts identified from one.", "20 seconds"),
    ),
    "Learning laws": (
        Entry("clogged_filter", "A network in an algebraic equation.", "50 seconds"),
        Entry("slider_crank", "A coefficient that multiplies a constraint force nobody measured.", "40 seconds"),
        Entry("bounce", "Gradients through jumps, and a policy trained through them.", "100 seconds"),
        Entry("sticking_friction", "A friction law with modes: stick and slip.", "40 seconds"),
        Entry("positioning", "A sampled neural controller trained through friction that sticks.", "50 seconds"),
    ),
    "Engineering studies": (
        Entry("battery_pack", "Arrays of cells with heat; which cell is bad?", "40 seconds"),
        Entry("house", "Identify, control and design a house by one model.", "60 seconds"),
        Entry("modelica", "Models read from Modelica: gradients, a fit, a thousand runs.", "40 seconds"),
        Entry("out_and_back", "A learned model as an FMU: run, tuned and taken back in.", "40 seconds"),
        Entry("next_experiment", "Which experiment tells most, before it is made.", "30 seconds"),
    ),
    "Measured data": (
        Entry("battery_pulses", "A cell's equivalent circuit from measured pulses.", "40 seconds"),
        Entry("overflowing_tanks", "Physics and a learned correction on a public benchmark.", "50 seconds"),
        Entry("measured_house", "Equations with errors: a Kalman filter inside the fit.", "30 seconds"),
    ),
}
DOWNLOADS = {"battery_pulses", "overflowing_tanks", "measured_house"}


def entries() -> list[Entry]:
    return [entry for level in LEVELS.values() for entry in level]


def notebooks() -> list[pathlib.Path]:
    return [entry.path for entry in entries()]


def introduction_of(notebook: pathlib.Path) -> list[str]:
    """The paragraphs of the cell with which it begins; the first is the heading."""
    return "".join(json.loads(notebook.read_text())["cells"][0]["source"]).split("\n\n")


def title_of(notebook: pathlib.Path) -> str:
    return introduction_of(notebook)[0].removeprefix("# ")


@functools.cache
def last_figure_of(notebook: pathlib.Path) -> tuple[str, bytes]:
    """The last figure that is stored in it: the suffix of its kind, and what it holds."""
    outputs = [o.get("data", {}) for c in json.loads(notebook.read_text())["cells"] for o in c.get("outputs", ())]
    last = next(data for data in reversed(outputs) if {"image/svg+xml", "image/png"} & {*data})
    if "image/svg+xml" in last:
        return "svg", "".join(last["image/svg+xml"]).encode()
    return "png", base64.b64decode("".join(last["image/png"]))


def colab_button(entry: Entry) -> str:
    """A link that opens the notebook of the main branch in Colab."""
    path = entry.path.relative_to(EXAMPLES.parent).as_posix()
    return f"[Open in Colab](https://colab.research.google.com/github/{REPOSITORY}/blob/main/{path}){{ .md-button }}"


def overview() -> str:
    """The first page: what each notebook teaches, how long it runs, and its last figure."""
    lines = [
        "# Gallery",
        "",
        "Longer studies, ordered by level. Each teaches one idea and says what it could not show. Open a notebook from",
        "the folder `examples` of the repository, or download it here. Times are processor time of a first",
        "run, most of it compilation, where XLA optimizes little.",
        "",
        "In Colab, run this cell first:",
        "",
        '```python title="Fragment"',
        f'%pip install "jaxonomy_dae[plot] @ git+https://github.com/{REPOSITORY}"',
        "```",
        "",
    ]
    for level, members in LEVELS.items():
        lines += [f"## {level}", ""]
        for entry in members:
            name = os.path.relpath(entry.path, EXAMPLES / "gallery")
            data = " Downloads its data once." if entry.stem in DOWNLOADS else ""
            lines += [f"### [{title_of(entry.path)}]({name})", ""]
            download = f'[Download]({entry.stem}.txt){{ download="{entry.path.name}" }}'
            time = f" *About {entry.time}.*" if entry.time else ""
            lines += [f"{entry.idea}{time}{data} {download} {colab_button(entry)}"]
            lines += ["", f"[![The last figure]({entry.stem}.{last_figure_of(entry.path)[0]})]({name})", ""]
    return "\n".join(lines)


def on_config(config: Any) -> Any:
    pages: list[Any] = ["gallery/index.md"]
    for level, members in LEVELS.items():
        pages.append(
            {level: [{title_of(entry.path): entry.path.relative_to(EXAMPLES).as_posix()} for entry in members]}
        )
    config.nav = [{TITLE: pages} if TITLE in entry else entry for entry in config.nav]
    return config


@event_priority(100)  # before mkdocs-jupyter looks for notebooks
def on_files(files: Any, config: Any) -> Any:
    files.append(File.generated(config, "gallery/index.md", content=overview()))
    for path in notebooks():
        site = config.site_dir
        files.append(File(path.relative_to(EXAMPLES).as_posix(), str(EXAMPLES), site, config.use_directory_urls))
        suffix, figure = last_figure_of(path)
        files.append(File.generated(config, f"gallery/{path.stem}.{suffix}", content=figure))
        files.append(File.generated(config, f"gallery/{path.stem}.txt", content=path.read_text()))
    return files
