"""Every block of every page of the documentation runs, and prints what the page says."""

import pathlib
import re

import jax
import numpy as np
import pytest
from run_pages import BLOCK, DOCS, blocks_of, name_of, pages, program

NUMBER = r"-?\d+(?:\.\d*)?(?:e[+-]\d+)?"
QUICK = {"start/install.md", "start/first-model.md", "how-to/units.md"}  # in the default run
LANGUAGES = {"python", "text", "sh", "bash", "modelica", "json"}


def same_words(found, said):
    assert re.sub(NUMBER, "#", found).split() == re.sub(NUMBER, "#", said).split()


def unit_of(text):
    """One unit in the last place that a number shows; of an integer, zero."""
    mantissa, _, exponent = text.partition("e")
    return 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2])) if "." in mantissa else 0.0


def same_numbers(found, said):
    """Numbers agree up to one unit in the last place that the page shows, or to 3e-4 of them: tables of fits print six
    digits, more than runs at rtol 1e-6 determine. Numbers of steps agree within 3 %."""
    steps = r"(\d+)(?= steps)"
    for one, other in zip(re.findall(steps, found), re.findall(steps, said), strict=True):
        assert abs(int(one) - int(other)) <= 0.03 * int(other), f"{one} steps, the page says {other}"
    found, said = re.sub(steps, "", found), re.sub(steps, "", said)
    texts = re.findall(NUMBER, said)
    units = np.array([unit_of(text) for text in texts])
    shown = np.array(texts, float)
    allowed = np.maximum(1.01 * units, np.where(units > 0, 3e-4 * np.abs(shown), 0.0))
    assert (np.abs(np.array(re.findall(NUMBER, found), float) - shown) <= allowed).all(), f"{found}\n{said}"


def test_numbers_are_compared():
    same_numbers("C = 519.5 J/K, 300 steps, [1.  -0.25]", "C = 519.4 J/K, 301 steps, [1. -0.25]")
    for found, said in (("519.6", "519.4"), ("400 steps", "300 steps"), ("-1.0", "1.0"), ("1.2e-09", "1.2e-07")):
        with pytest.raises(AssertionError):
            same_numbers(found, said)
    with pytest.raises(AssertionError):
        same_words("293.1 K", "293.1 W")


def test_blocks_are_of_known_kinds():
    """A block runs, is output, or is marked as a fragment; nothing else is Python."""
    counts = {"run": 0, "fragment": 0}
    for page in (*sorted(DOCS.rglob("*.md")), DOCS.parent / "README.md"):
        text = page.read_text()
        assert text.count("```") == 2 * len(BLOCK.findall(text)), f"{page}: a block is not closed, or is indented"
        for block in blocks_of(text):
            assert block.language in LANGUAGES, f"{page}: {block.language}"
            if block.language == "python":
                compile(block.content, name_of(page), "exec")
                counts["run" if block.runs else "fragment"] += 1
        assert "FIGURE:" not in text, f"{page}: a figure is missing"
    assert counts["run"] > 120 and counts["fragment"] < 0.1 * counts["run"], counts


def test_figures_of_pages_exist():
    for page in DOCS.rglob("*.md"):
        for path in re.findall(r"!\[[^\]]*\]\(([^)#]+)", page.read_text()):
            assert (page.parent / path).exists(), f"{page}: {path}"


@pytest.fixture
def same_configuration():
    """What a page sets of JAX' cache is undone."""
    names = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")
    before = {name: getattr(jax.config, name) for name in names}
    yield
    for name, value in before.items():
        jax.config.update(name, value)


def with_marks(page: pathlib.Path):
    mark = pytest.mark.long("the pages that a reader runs first") if name_of(page) in QUICK else pytest.mark.slow
    return pytest.param(page, id=name_of(page), marks=[mark])


@pytest.mark.parametrize("page", [with_marks(page) for page in pages()])
def test_a_page_prints_what_it_says(page, capsys, tmp_path, monkeypatch, same_configuration):
    """Its blocks run in order, in one namespace, and what one prints stands in the block of text below it."""
    plt = pytest.importorskip("matplotlib.pyplot")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(plt, "show", lambda *_, **__: None)
    plt.switch_backend("Agg")
    names, printed, before = {"__name__": "page"}, "", None
    with jax.numpy_dtype_promotion("standard"):  # as in a notebook
        text = page.read_text()
        for k, block in enumerate(blocks_of(text)):
            if block.runs:
                assert not printed, f"what block {k} prints is not shown: {printed}"
                exec(program(page, text, block), names)
                printed = capsys.readouterr().out
                plt.close("all")
            elif block.language == "text" and not block.titled and before is not None and before.runs:
                same_words(printed, block.content)
                same_numbers(printed, block.content)
                printed = ""
            before = block
    assert not printed
