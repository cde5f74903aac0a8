"""Executes notebooks in place, with figures stored as SVG; prints the processor time of each.

    python docs/execute_notebooks.py examples/gallery/circuit.ipynb

Notebooks with measured data read the folder that `JAXONOMY_DAE_DATA` names, or download.
"""

import os
import pathlib
import re
import resource
import sys
import tempfile

import nbclient
import nbformat

# Figures have a white ground of their own, the same file for the same figure, and text as paths: no font is needed.
SETTINGS = """
c = get_config()
c.InlineBackend.figure_formats = {"svg"}
c.InlineBackend.rc = {"svg.hashsalt": "gallery", "figure.facecolor": "white", "path.simplify_threshold": 0.5}
c.InlineBackend.print_figure_kwargs = {"bbox_inches": "tight", "metadata": {"Date": None}}
"""


def spent() -> float:
    """The processor time of all processes that have ended, in seconds."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def without_paths(warnings: str) -> str:
    """Warnings as users read them, without the files and lines of this machine."""
    lines = re.findall(r"(\w+Warning: .*)", warnings)
    return "\n".join(lines) + "\n" if lines else warnings


def main(paths: list[str]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        profile = pathlib.Path(folder) / "profile_default"
        profile.mkdir()
        (profile / "ipython_kernel_config.py").write_text(SETTINGS)
        os.environ["IPYTHONDIR"] = folder
        os.environ.pop("MPLBACKEND", None)
        for path in map(pathlib.Path, paths):
            before = spent()
            notebook = nbformat.read(path, as_version=4)
            client = nbclient.NotebookClient(notebook, timeout=None, resources={"metadata": {"path": str(path.parent)}})
            try:
                client.execute()
            except nbclient.exceptions.CellExecutionError as error:
                print(f"{path.name}: {error}", flush=True)
                continue
            for cell in notebook.cells:
                cell.metadata.pop("execution", None)  # times of day
                for output in cell.get("outputs", ()):
                    if output.get("name") == "stderr":
                        output.name, output.text = "stdout", without_paths(output.text)
            text = nbformat.writes(notebook)
            path.write_text(re.sub(r"[ \t]+(?=\\n)", "", text).rstrip() + "\n")
            print(
                f"{path.name}: {spent() - before:.0f} processor seconds, {path.stat().st_size / 1000:.0f} kB",
                flush=True,
            )


if __name__ == "__main__":
    main(sys.argv[1:])
