"""Everything private of other libraries passes through one file, is reached when needed, and only versions that were
tried are trusted."""

import ast
import importlib.metadata
from pathlib import Path

import pytest
from problems import run

import jaxonomy_dae
from jaxonomy_dae.base import private_names

PACKAGE = Path(jaxonomy_dae.__file__).parent
LIBRARIES = ("diffrax", "equinox", "optimistix", "lineax", "jax")
FILE = PACKAGE / "base" / "private_names.py"
MOVING = ("jax.extend", "jax.experimental", "jax.interpreters")  # public, but JAX promises nothing


@pytest.mark.parametrize("name", LIBRARIES)
def test_version_was_tried(name):
    found = importlib.metadata.version(name)
    assert found in private_names.TRIED[name], (
        f"{name} {found} is new: run all tests, look at what private_names.py takes from it, add it to TRIED"
    )


def imported(tree: ast.AST):
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.level == 0:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)


def is_private(name: str) -> bool:
    library, *rest = name.split(".")
    return library in LIBRARIES and (
        any(part.startswith("_") or part == "internal" for part in rest) or name.startswith(MOVING)
    )


def test_no_file_imports_them():
    found = {
        (path.relative_to(PACKAGE).as_posix(), name)
        for path in PACKAGE.rglob("*.py")
        for name in imported(ast.parse(path.read_text()))
        if is_private(name)
    }
    assert not found, f"take these by a name in private_names.NAMES: {found}"


def test_all_are_there_and_used():
    assert private_names.missing(tuple(private_names.NAMES)) is None
    source = "".join(path.read_text() for path in PACKAGE.rglob("*.py") if path != FILE)
    used = source + FILE.read_text().partition("class MissingName")[2]
    own = " ".join(private_names.FOR_STORED_ADJOINT)
    assert all(f'private("{name}")' in used or name in own for name in private_names.NAMES)


# Each takes a name away, before the package is imported, as a new version of the library would.
GONE = {
    "every name": "for path in names.values(): remove(path)",
    "another argument": (
        "import functools, diffrax\n"
        "old = diffrax.AbstractAdjoint.loop\n"
        "def loop(self, *, args, terms, solver, stepsize_controller, event, saveat, t0, t1, dt0, max_steps, throw,"
        " init_state, passed_solver_state, passed_controller_state, meter): ...\n"
        "diffrax.AbstractAdjoint.loop = loop\n"
    ),
}
PROGRAM = """
import importlib, warnings, sys
import diffrax, jax, jax.numpy as jnp, equinox.internal, diffrax._integrate, jax.extend.core, numpy as np
import jax.experimental.xla_metadata
jax.config.update("jax_enable_x64", True)
names = {names!r}
class Without:
    def __init__(self, module, gone): self.module, self.gone = module, gone
    def __getattr__(self, name):
        if name == self.gone or name in getattr(self.module, "gone", ()): raise AttributeError(name)
        return getattr(self.module, name)
def remove(path):
    module, _, name = path.rpartition(".")
    taken.add((module, name))
taken = set()
real = importlib.import_module
def import_module(name, package=None):
    found = real(name, package)
    for module, gone in taken:
        if module == name: found = Without(found, gone)
    return found
importlib.import_module = import_module
{gone}
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    from jaxonomy_dae import *
    from jaxonomy_dae.solvers import StoredAdjoint
    class Decay(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            k, x = self.parameter("k", 2.0), self.variable("x", start=1.0, fixed=True)
            self.add_equations(der(x) + k * x)
    ev, diagram = EqnEnv(), AcausalDiagram()
    diagram.add(Decay(ev, "c"))
    system = AcausalCompiler(ev, diagram)()
    for adjoint in {adjoints}:
        def end(k):
            changed = system.with_parameters({{"c.k": k}})
            return simulate(changed, 1.0, ts=jnp.array([1.0]), rtol=1e-8, adjoint=adjoint)["c.x"][0]
        value, slope = jax.value_and_grad(end)(2.0)
        np.testing.assert_allclose([value, slope], [np.exp(-2), -np.exp(-2)], rtol=1e-6)
texts = [str(w.message) for w in caught if issubclass(w.category, RuntimeWarning)]
print(len(texts), texts[0])
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    "what, adjoints",
    [
        pytest.param("every name", "(None,)", marks=pytest.mark.long("another process, which compiles a gradient")),
        pytest.param("every name", "(StoredAdjoint(),)", marks=pytest.mark.slow),
        pytest.param("another argument", "(None, StoredAdjoint())", marks=pytest.mark.slow),
    ],
)
def test_a_missing_name(what, adjoints):
    """The package is imported, simulates and differentiates, by another adjoint, and says so once."""
    count, _, text = (
        run(PROGRAM.format(names=private_names.NAMES, gone=GONE[what], adjoints=adjoints)).strip().partition(" ")
    )
    assert count == "1" and "diffrax 0." in text
    assert "RecursiveCheckpointAdjoint instead of StoredAdjoint" in text and "tried:" in text
