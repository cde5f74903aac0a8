"""Pages of the documentation print what they say."""

import pathlib
import re

import jax
import numpy as np
import pytest

DOCS = pathlib.Path(__file__).parents[2] / "docs"
NUMBER = r"-?\d+(?:\.\d*)?"


def blocks_of(page):
    """The fenced blocks of a page, (language, content), in order."""
    return re.findall(r"^```(\w+)\n(.*?)^```$", (DOCS / page).read_text(), re.M | re.S)


def same_words(found, said):
    assert re.sub(NUMBER, "#", found).split() == re.sub(NUMBER, "#", said).split()


def same_numbers(found, said):
    """Numbers agree up to one unit in the last place that the page shows."""
    texts = re.findall(NUMBER, said)
    units = np.array([10.0 ** -len(text.partition(".")[2]) if "." in text else 0.0 for text in texts])
    distance = np.abs(np.array(re.findall(NUMBER, found), float) - np.array(texts, float))
    assert (distance <= 1.01 * units).all(), f"{found}\n{said}"


def test_numbers_are_compared():
    same_numbers("C = 519.5 J/K, 3 steps, [1.  -0.25]", "C = 519.4 J/K, 3 steps, [1. -0.25]")
    for found, said in (("519.6", "519.4"), ("4 steps", "3 steps"), ("-1.0", "1.0")):
        with pytest.raises(AssertionError):
            same_numbers(found, said)
    with pytest.raises(AssertionError):
        same_words("293.1 K", "293.1 W")


@pytest.fixture
def same_configuration():
    """What a page sets of JAX' cache is undone."""
    names = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")
    before = {name: getattr(jax.config, name) for name in names}
    yield
    for name, value in before.items():
        jax.config.update(name, value)


@pytest.mark.slow
@pytest.mark.parametrize("page, least", [("tutorial.md", 11), ("saving.md", 3)])
def test_a_page_prints_what_it_says(page, least, capsys, tmp_path, monkeypatch, same_configuration):
    """Its blocks run in order, in one namespace, and what one prints stands in the block of text below it."""
    monkeypatch.chdir(tmp_path)
    names, printed, compared = {}, "", 0
    with jax.numpy_dtype_promotion("standard"):  # as in a notebook
        for k, (language, content) in enumerate(blocks_of(page)):
            if language == "python":
                assert not printed, f"what block {k} prints is not shown: {printed}"
                exec(compile(content, f"{page}, block {k}", "exec"), names)
                printed = capsys.readouterr().out
            else:
                same_words(printed, content)
                same_numbers(printed, content)
                printed, compared = "", compared + 1
    assert not printed and compared >= least
