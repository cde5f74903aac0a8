"""The documentation: public names are in it, and the pages of the library say what the components declare."""

import functools
import importlib
import pathlib
import re

import pytest
from library_latex import equation, name_text
from library_pages import classes_of, components_of, domains, overview, text_of
from library_pages import page as write_page
from sympy import Abs, Eq, Max, Piecewise, Rational, Symbol, exp, pi, sqrt, symbols

DOCS = pathlib.Path(__file__).parents[2] / "docs"
MODULES = ("solvers", "linear", "learning", "plotting", "testing")


def public_names() -> list[str]:
    """What can be imported: re-exports, and what a module defines that has none."""
    found = []
    for name in ("", *MODULES):
        module = importlib.import_module(f"jaxonomy_dae.{name}".rstrip("."))
        file = pathlib.Path(module.__file__ or "")
        text = (file if name else file.with_name("names.py")).read_text()
        own = re.findall(r"^from .* as (\w+)$", text, re.M) or re.findall(r"^def ([a-z]\w*)", text, re.M)
        found += [f"{module.__name__}.{n}" for n in own]
    return found


def test_public_names_are_found():
    names = public_names()
    assert {"jaxonomy_dae.simulate", "jaxonomy_dae.linear.KLU", "jaxonomy_dae.testing.assert_energy_balance"} <= {
        *names
    }
    assert len(names) > 50


@functools.cache
def api() -> str:
    return "\n".join(path.read_text() for path in sorted((DOCS / "api").glob("*.md")))


@pytest.mark.parametrize("name", public_names())
def test_every_public_name_is_in_the_api(name):
    last, text = name.rpartition(".")[2], api()
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


page = functools.cache(write_page)


@pytest.mark.parametrize("domain", domains())
def test_pages_have_what_components_declare(domain):
    sections = re.split(r"^## ", page(domain), flags=re.M)[1:]
    for component, section in zip(components_of(domain), sections, strict=True):
        assert section.startswith(type(component).__name__ + "\n")
        hidden = ("port", "start", "event")
        names = [*component.parameters, *(n for n, v in component.variables.items() if v.kind not in hidden)]
        for name in (*names, *component.ports, *component.children):
            assert f"`{name}`" in section
        assert (r"\[" in section or "```text" in section) and "Piecewise" not in section and ":relation" not in section
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
        "\\[\n\\begin{aligned}\nv &= v_{\\mathrm{p}} - v_{\\mathrm{n}} \\\\\n"
        "i &= i_{\\mathrm{p}} \\\\\ni_{\\mathrm{n}} + i_{\\mathrm{p}} &= 0 \\\\\n"
        "C \\, \\dot{v} &= i\n\\end{aligned}\n\\]\n\n"
    )


def test_events_and_parts():
    electrical = page("electrical")
    assert "when u > threshold, while closed = 0: closed becomes 1" in electrical
    assert r"0 &= \begin{cases} v - \mathrm{Ron} \, i & \text{for}\: \mathrm{closed} = 1" in electrical
    assert "| `inductor` | Inductor |" in electrical and "inductor.n — emf.p" in electrical
    signal = page("signal")
    assert "every period seconds: held becomes u" in signal
    assert r"1 & \text{for}\: t \geq \mathrm{start\_time} \\0 & \text{otherwise}" in signal


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
    assert equation(Eq(a, b)) == "a &= b"
    assert equation(a - b) == "0 &= a - b"


def test_the_gallery_has_an_overview():
    gallery = pytest.importorskip("gallery")  # a hook, which needs MkDocs
    text = gallery.overview()
    for entry in gallery.entries():
        assert re.search(rf"### \[[^\]]+\]\([./]*{entry.stem}\.ipynb\)\n\n[^\n]+\.", text), entry.stem
        suffix, figure = gallery.last_figure_of(entry.path)
        assert f"({entry.stem}.{suffix})" in text and "TIME" not in text
        file = gallery.colab_button(entry).partition("/blob/main/")[2].partition(")")[0]
        assert (gallery.EXAMPLES.parent / file) == entry.path and gallery.colab_button(entry) in text
        assert b"<svg" in figure if suffix == "svg" else figure.startswith(b"\x89PNG")
    found = {path.stem for path in (gallery.EXAMPLES / "gallery").glob("*.ipynb")} | {"neural_dae_pendulum_drag"}
    assert found == {entry.stem for entry in gallery.entries()}


def test_each_object_of_the_api_has_a_page():
    """On file systems that do not tell cases apart, too."""
    pages = pytest.importorskip("api_pages")
    names = [match[1] for path in pages.groups() for match in pages.OBJECT.finditer(path.read_text())]
    files = [pages.file_of(name).lower() for name in names]
    assert len(files) == len({*files}) > 80
    for path in pages.groups():
        assert ":::" not in pages.overview(path)
    assert not [name for name in names if not pages.first_sentence(name)]


def test_rows_of_errors_become_headings():
    headings = pytest.importorskip("error_headings")
    assert headings.ROW.sub(r"\1: \3", "| `no start` | None was given. | Give one. |") == "no start: Give one."


@pytest.mark.parametrize("page", ["../README.md", "start/install.md", "start/first-model.md", "start/first-fit.md"])
def test_first_pages_have_short_sentences(page):
    text = re.sub(r"^```.*?^```$|\\\[.*?\\\]", "", (DOCS / page).read_text(), flags=re.M | re.S)
    for paragraph in re.split(r"\n\s*\n|\n(?=[-|] |\d+\. )", text):
        words = re.sub(r"`[^`]*`", "code", " ".join(paragraph.split()))
        for sentence in re.split(r"(?<=[.!?:;])\s+", "" if words.startswith(("|", "#", "!")) else words):
            assert len(sentence.split()) <= 30, sentence


@pytest.mark.parametrize(
    "path, written",
    [
        ("v", "v"),
        ("p.v", r"v_{\mathrm{p}}"),
        ("phi_rel", r"\phi_{\mathrm{rel}}"),
        ("R0", r"R_{\mathrm{0}}"),
        ("flange_a.tau", r"\tau_{\mathrm{flange\_a}}"),
        ("initial_angle", r"\mathrm{initial\_angle}"),
    ],
)
def test_names_in_equations(path, written):
    assert name_text(path) == written


def test_equations_of_components_are_formulas_that_close():
    """Braces and brackets of LaTeX are balanced in every equation of the library, and nothing is left of Python's names
    for hidden variables."""
    for domain in domains():
        text = page(domain)
        formulas = re.findall(r"\\\[\n(.*?)\n\\\]", text, re.S)
        assert formulas or domain == "contacts"
        for formula in formulas:
            plain = formula.replace(r"\{", "").replace(r"\}", "")
            assert plain.count("{") == plain.count("}"), formula
            assert formula.count(r"\left") == formula.count(r"\right"), formula
            assert not re.search(r":(?!\s|})", formula.replace(r"\:", "")), formula
