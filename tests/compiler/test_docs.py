"""The documentation: public names are in it, and the pages of the library say what the components declare."""

import importlib
import pathlib
import re

import jax
import numpy as np
import pytest
from library_pages import classes_of, components_of, domains, equation_text, overview, page, text_of
from sympy import Abs, Eq, Max, Piecewise, Rational, Symbol, exp, pi, sqrt, symbols

DOCS = pathlib.Path(__file__).parents[2] / "docs"
MODULES = ("solvers", "linear", "learning", "plotting", "testing")


def public_names() -> list[str]:
    """What can be imported: re-exports, and what modules without a folder define."""
    found = []
    for name in ("", *MODULES):
        module = importlib.import_module(f"jaxonomy_dae.{name}".rstrip("."))
        path = pathlib.Path(module.__file__ or "")
        own = re.findall(r" as (\w+)$" if path.name == "__init__.py" else r"^def ([a-z]\w*)", path.read_text(), re.M)
        found += [f"{module.__name__}.{n}" for n in own]
    return found


def test_public_names_are_found():
    names = public_names()
    assert {"jaxonomy_dae.simulate", "jaxonomy_dae.linear.KLU", "jaxonomy_dae.testing.assert_energy_balance"} <= {
        *names
    }
    assert len(names) > 50


@pytest.mark.parametrize("name", public_names())
def test_every_public_name_is_in_the_api(name):
    last = name.rpartition(".")[2]
    text = "\n".join(path.read_text() for path in sorted((DOCS / "api").glob("*.md")))
    assert re.search(rf"^::: jaxonomy_dae\.([\w.]+\.)?{last}$|`{last}`", text, re.M), name


def test_every_name_in_the_api_exists():
    for path in sorted((DOCS / "api").glob("*.md")):
        for name in re.findall(r"^::: ([\w.]+)$", path.read_text(), re.M):
            module, _, last = name.rpartition(".")
            assert hasattr(importlib.import_module(module), last), name


def test_what_components_inherit_is_in_the_api():
    text = (DOCS / "api" / "modeling.md").read_text()
    assert "::: jaxonomy_dae.Component\n    options:\n      inherited_members: true\n" in text  # when, discrete, …


def test_all_domains_have_pages():
    assert {
        "contacts", "electrical", "friction", "hydraulic", "planar", "rotational", "signal", "thermal", "translational",
        "transmissions",
    } <= {*domains()}  # fmt: skip
    text = overview()
    for domain in domains():
        assert f"({domain}.md)" in text
        for cls in classes_of(domain):
            assert cls.__name__ in text and not cls.__name__.startswith("_")


@pytest.mark.parametrize("domain", domains())
def test_pages_have_what_components_declare(domain):
    sections = re.split(r"^## ", page(domain), flags=re.M)[1:]
    for component, section in zip(components_of(domain), sections, strict=True):
        assert section.startswith(type(component).__name__ + "\n")
        hidden = ("port", "start", "event")
        names = [*component.parameters, *(n for n, v in component.variables.items() if v.kind not in hidden)]
        for name in (*names, *component.ports, *component.children):
            assert f"`{name}`" in section
        assert "```text" in section and "Piecewise" not in section and ":relation" not in section
        assert "**" not in re.sub(r"\*\*(Arguments|Raises):\*\*", "", section)


def test_a_section():
    electrical = page("electrical")
    start = electrical.index("## Capacitor")
    assert electrical[start : electrical.index("## Inductor")] == (
        "## Capacitor\n\n"
        "```python\nCapacitor(ev, name, C=1.0, initial_voltage=None)\n```\n\n"
        "C·dv/dt = i, `C` > 0 in farad. A given `initial_voltage` (volt) holds at the start; otherwise 0 is a guess.\n"
        "\n"
        "Ports: `p`, `n` (Electrical: `v` [V], `i` [A]).\n\n"
        "| Parameter | Default | Unit | Bounds |\n| --- | --- | --- | --- |\n"
        "| `C` | `1` | F | > 0 |\n| `initial_voltage` | `0` | V |  |\n\n"
        "| Variable | Unit | Start |\n| --- | --- | --- |\n"
        "| `v` | V | `initial_voltage` (a guess) |\n| `i` | A |  |\n\n"
        "```text\nv = p.v − n.v\ni = p.i\nn.i + p.i = 0\nC·der(v) = i\n```\n\n"
    )


def test_events_and_parts():
    electrical = page("electrical")
    assert "when u > threshold, while closed = 0: closed becomes 1" in electrical
    assert "0 = v − Ron·i if closed = 1, i − Goff·v otherwise" in electrical
    assert "| `inductor` | Inductor |" in electrical and "inductor.n — emf.p" in electrical
    signal = page("signal")
    assert "every period seconds: held becomes u" in signal
    assert "y = height·(1 if t ≥ start_time, 0 otherwise) + offset" in signal


a, b, x = symbols("a b x", real=True)


@pytest.mark.parametrize(
    "expression, text",
    [
        (a * (b + 1), "(1 + b)·a"),
        (-a / b, "−a/b"),
        (a / (2 * b), "a/(2·b)"),
        (-(a + b) * x, "−(a + b)·x"),
        (a - (b + x) * 2, "a − 2·b − 2·x"),
        (sqrt(a**2 + b**2), "√(a² + b²)"),
        (1 / sqrt(a), "1/√(a)"),
        (a**-2, "1/a²"),
        (a ** Rational(1, 4), "a^(1/4)"),
        (a**b, "a^b"),
        ((a + b) ** (b - 1), "(a + b)^(b − 1)"),
        (1.0 * a, "a"),
        (-2.5e-7 * a, "−2.5e−07·a"),
        (2 * pi * a, "2·π·a"),
        (Abs(a - b) * exp(-a), "|a − b|·exp(−a)"),
        (Piecewise((a, x >= 0), (Max(a, b), True)) * 2, "2·(a if x ≥ 0, Max(a, b) otherwise)"),
        (Symbol("t"), "t"),
    ],
)
def test_expressions_as_text(expression, text):
    assert text_of(expression) == text


def test_equations_as_text():
    assert equation_text(Eq(a, b)) == "a = b"
    assert equation_text(a - b) == "0 = a − b"


def test_the_gallery_has_an_overview():
    gallery = pytest.importorskip("gallery")  # a hook, which needs MkDocs
    text = gallery.overview()
    for path in gallery.notebooks():
        section = text[text.index(f"]({path.name})") :]
        assert re.match(r"\]\([^)]+\)\n\n[^#]+\.\n\n\[!", section)  # heading, whole sentences, figure
        assert f"({path.stem}.png)" in section
        assert gallery.last_figure_of(path).startswith(b"\x89PNG")
    assert len(gallery.notebooks()) > 4


# --- the tutorial ------------------------------------------------------------------------------------------------

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


@pytest.mark.slow
def test_the_tutorial_prints_what_it_says(capsys):
    """Its blocks run in order, in one namespace, and what one prints stands in the block of text below it."""
    names, printed, compared = {}, "", 0
    with jax.numpy_dtype_promotion("standard"):  # as in a notebook
        for k, (language, content) in enumerate(blocks_of("tutorial.md")):
            if language == "python":
                assert not printed, f"what block {k} prints is not shown: {printed}"
                exec(compile(content, f"tutorial, block {k}", "exec"), names)
                printed = capsys.readouterr().out
            else:
                same_words(printed, content)
                same_numbers(printed, content)
                printed, compared = "", compared + 1
    assert not printed and compared > 10
