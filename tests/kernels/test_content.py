"""The identity by which programs are found again, in this process and without tracing in later ones.

The fault to fear is a program that is found for a call that computes something else. `test_edits.py` has a table of
edits; here are the parts.
"""

import dataclasses
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental.compilation_cache import compilation_cache
from problems import run

from benchmarks.attack.invariance.declarations import PAIRS, STRUCTURE, built
from jaxonomy_dae import solvers
from jaxonomy_dae.host import cache, kept, libraries, program
from jaxonomy_dae.host.cache import ProgramCache
from jaxonomy_dae.host.compilations import compilations
from jaxonomy_dae.host.content import content
from jaxonomy_dae.host.program import types_of
from jaxonomy_dae.run.system.closed_function import closed_function


class Noted(list):
    """A list that does not count as content, so that a function may read and write it behind the back of the walk."""

    def __content__(self):
        return "noted", ()


FORM, TRACES = Noted([jnp.sin]), Noted()


def wave(x, k):
    """f(k·x) twice, and which of the results are positive; f may be another one, and nothing tells."""
    TRACES.append(FORM[0])
    y = FORM[0](k * FORM[0](k * x))
    return {"y": y, "twice": 2 * k * y, "positive": y > 0, "name": "wave"}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder in which programs are kept, and no cache of JAX's own."""
    by_jax = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    compilation_cache.reset_cache()
    jax.config.update("jax_compilation_cache_dir", None)
    kept.keep_programs(tmp_path / "programs")
    monkeypatch.setattr(program, "_chosen_by_the_user", lambda: False)
    monkeypatch.setattr(libraries, "_is_patched", lambda: False)  # types are checked while tests run
    FORM[:] = [jnp.sin]
    TRACES.clear()
    libraries.code.cache_clear()
    yield
    compilation_cache.reset_cache()
    jax.config.update("jax_compilation_cache_dir", by_jax)
    kept._CHOSEN.clear()
    libraries.code.cache_clear()


@pytest.fixture(autouse=True)
def another_process():
    """What this process has compiled is forgotten, so that another cache of programs stands for another process."""
    program._EXECUTABLES.clear()


def next_process():
    program._EXECUTABLES.clear()
    return ProgramCache()


def loss(programs, part, x, k):
    return jnp.sum(programs.call(wave, False, (x, k), {})[part] ** 2)


X, K = np.linspace(-1.0, 1.0, 3), 1.1


def test_a_call_is_not_traced_again(folder):
    """Another cache of programs stands for another process: the outcome is the same to the last bit."""
    first = ProgramCache().call(wave, False, (jnp.asarray(X), jnp.array(K)), {})
    traced, since = len(TRACES), len(compilations())
    second = next_process().call(wave, False, (jnp.asarray(X), jnp.array(K)), {})
    assert len(TRACES) == traced and [c.how for c in compilations()[since:]] == ["loaded"]
    assert second["name"] == "wave" and second["positive"].dtype == bool
    for name in ("y", "twice", "positive"):
        np.testing.assert_array_equal(first[name], second[name])


def test_code_that_has_changed_since_it_was_read(folder, monkeypatch):
    """A developer edits a file of the package while a notebook runs: programs of the code before are not kept as those
    of the code after. Kind of defect: a file with an old date counted as one that this process had read."""
    assert cache._identity("a") is not None
    libraries.code.cache_clear()
    (name, size, written, changed), *rest = libraries._SNAPSHOT
    monkeypatch.setattr(libraries, "_SNAPSHOT", [(name, size, written, changed - 1), *rest])
    assert cache._identity("a") is None


DERIVATIVES = {
    "reverse": lambda f, k: jax.grad(f)(k),
    "forward": lambda f, k: jax.jacfwd(f)(k),
    "batch": lambda f, k: jax.vmap(f)(jnp.stack([k, 2 * k])),
}


@pytest.mark.parametrize("name", DERIVATIVES)
def test_derivatives_are_not_traced_again(folder, name):
    def found(programs):
        return DERIVATIVES[name](lambda k: loss(programs, "y", jnp.asarray(X), k), jnp.array(K))

    first, traced = found(ProgramCache()), len(TRACES)
    np.testing.assert_array_equal(found(next_process()), first)
    assert len(TRACES) == traced


def odd(v):
    return -jnp.sin(-v)


def gradient(programs, part):
    return float(jax.grad(lambda k: loss(programs, part, jnp.asarray(X), k))(K))


def by_jax(form, part):
    def f(k):
        y = form(k * form(k * X))
        return jnp.sum((y if part == "y" else 2 * k * y) ** 2)

    return float(jax.grad(f)(K))


@pytest.mark.parametrize("later", [jnp.sin, odd])
def test_another_pullback_of_what_was_found(folder, later):
    """A later process reads another part of the outcome: its pullback is not there, and needs what tracing alone tells.
    Where tracing then writes the same function in another way, the arrays of the old program are not used."""
    gradient(ProgramCache(), "y")
    FORM[:] = [later]
    programs, traced = next_process(), len(TRACES)
    for _ in range(2):
        assert gradient(programs, "twice") == pytest.approx(by_jax(later, "twice"), rel=1e-13)
    assert len(TRACES) == traced + (1 if later is jnp.sin else 2)


def test_an_executable_that_is_gone_is_compiled_anew(folder):
    x, k = jnp.asarray(X), jnp.array(K)
    first = ProgramCache().call(wave, False, (x, k), {})
    where: Any = kept.folder()
    smallest = min(where.iterdir(), key=lambda path: path.stat().st_size)  # the record
    for path in set(where.iterdir()) - {smallest}:
        path.unlink()
    np.testing.assert_array_equal(next_process().call(wave, False, (x, k), {})["y"], first["y"])
    smallest.write_bytes(b"not a record")
    np.testing.assert_array_equal(next_process().call(wave, False, (x, k), {})["y"], first["y"])


# --- what must not be taken for the same ---------------------------------------------------------------------------


class Slow(eqx.Module):
    rate: float = eqx.field(static=True)


def local(rate, power=1):
    class Slow(eqx.Module):
        rate: float = eqx.field(static=True)

        def __call__(self, x):
            return self.rate * x**power

    return Slow(rate)


class Metres(float):
    pass


class Marked(set):
    mark = 0


def marked(mark):
    some = Marked()
    some.mark = mark
    return some


def branching(number):
    """A number in a branch is part of the program: JAX wraps it in a subclass of float."""
    return closed_function(lambda t: jax.lax.cond(t > 0, lambda: number, lambda: 0.0), np.float64)


DIFFERENT = {
    "numbers of a subclass": (Metres(1.0), Metres(2.0)),
    "sets with attributes": (marked(1), marked(2)),
    "numbers in branches": tuple(jax.tree.structure(branching(number)) for number in (1.0, 2.0)),
    "solvers of one name": (diffrax.Tsit5(), solvers.Tsit5()),
    "solvers": (solvers.BDF(), solvers.Rodas5P()),
    "an option": (solvers.BDF(), dataclasses.replace(solvers.BDF(), max_order=2)),
    "int and float": (1, 1.0),
    "int and bool": (1, True),
    "text and bytes": ("a", b"a"),
    "zeros": (0.0, -0.0),
    "list and tuple": ([1, 2], (1, 2)),
    "nesting": ((1, (2,)), ((1, 2),)),
    "names": ({"a": 1}, {"b": 1}),
    "arrays": (np.ones(2), np.array([1.0, 1.0 + 1e-15])),
    "types of arrays": (np.ones(2), np.ones(2, np.float32)),
    "shapes": (np.ones((1, 2)), np.ones((2, 1))),
    "functions": (jnp.sin, jnp.cos),
    "functions of one name": (jnp.sin, np.sin),
    "structures": (jax.tree.structure((1, None)), jax.tree.structure((1, ()))),
    "static parts": (jax.tree.structure(eqx.nn.Linear(2, 3, key=jax.random.key(0))),
                     jax.tree.structure(eqx.nn.Linear(2, 4, key=jax.random.key(0)))),
    "record and function": (Slow(1.0), jnp.sin),
    "classes of one name": (local(1.0), local(1.0, 2)),
    "static fields": (Slow(1.0), Slow(True)),
    "masks": (np.ma.array([1.0, 2.0], mask=[0, 1]), np.ma.array([1.0, 2.0], mask=[1, 0])),
    "arrays of objects": (np.array([1, None]), np.array([1.0, None])),
    "signs of zero in an array": (np.zeros(1), -np.zeros(1)),
    "keys": (jax.random.key(0), jax.random.key(1)),
}  # fmt: skip


@pytest.mark.parametrize("name", DIFFERENT)
def test_what_differs_is_told_apart(name):
    one, other = DIFFERENT[name]
    assert content(one).digest != content(other).digest and not content(one).unseen
    assert content(one) == content(one) and content(other) == content(other)


@pytest.mark.parametrize("name", [name for name, (_, kind) in PAIRS.items() if kind == STRUCTURE])
def test_models_of_other_structure_are_told_apart(name):
    """Pairs of models that differ in one argument of a declaration."""
    one, other = (content(*jax.tree.flatten(eqx.partition(built(each), eqx.is_array)[1])) for each in PAIRS[name][0])
    assert one.digest != other.digest


def test_options_of_jax_and_types_are_told_apart():
    options = {cache._of_options()}
    with jax.enable_x64(False):
        options.add(cache._of_options())
    with jax.default_matmul_precision("highest"):
        options.add(cache._of_options())
    with jax.numpy_dtype_promotion("standard"):
        options.add(cache._of_options())
    with jax.threefry_partitionable(not jax.config.jax_threefry_partitionable):  # pyright: ignore
        options.add(cache._of_options())
    assert len(options) == 5 and cache._of_options() in options
    arrays = jnp.ones(2), jnp.ones(3), jnp.ones(2, jnp.float32), jnp.ones((2, 1))
    assert len({types_of([a]) for a in arrays}) == 4
    assert types_of([jnp.asarray(np.ones(()))]) != types_of([jax.jit(lambda: 1.0)()])  # weakly typed


PROCESS = """
import jax
jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
from problems import component
from jaxonomy_dae import AcausalCompiler, AcausalDiagram, EqnEnv, NeuralDAEBlock, compilations, der, simulate
def decay(law=None):
    def write(c, ev):
        x = c.variable("x", start=1.0, fixed=True)
        c.add_equations(der(x) + c.parameter("k", 2.0) * x)
    diagram, c = AcausalDiagram(), component(write)
    diagram.add(c)
    if law is not None:
        diagram.add_neural_correction_block(NeuralDAEBlock(law, jnp.ones(1), targets=[(c, "x")], name="law"))
    return AcausalCompiler(c.ev, diagram)()
def law(t, u, theta):
    return theta * jnp.FORM(u)
for system in (decay(), decay(law)):
    def end(k):
        return simulate(system.with_parameters({"c.k": k}), 1.0)["c.x"][-1]
    since = len(compilations())
    found = float(end(2.0)), float(jax.grad(end)(2.0))
    made = compilations()[since:]
    print(*found, sum(c.how == "loaded" for c in made) == len(made), sum(c.traced + c.lowered for c in made) < 0.01)
"""


@pytest.mark.slow
def test_the_next_process_traces_nothing_but_code_that_is_new(tmp_path, monkeypatch):
    """The second process finds the model's programs. A user's function of the same name is another one there."""
    monkeypatch.setenv("JAXONOMY_DAE_CACHE", str(tmp_path))
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    first, second = (run(PROCESS.replace("FORM", form)).splitlines() for form in ("sin", "cos"))
    known, own = (lines[0].split() for lines in (first, second)), (lines[1].split() for lines in (first, second))
    (*numbers, loaded, traced), (*again, loaded_again, traced_again) = known
    assert numbers == again and (loaded, traced, loaded_again, traced_again) == ("False", "False", "True", "True")
    np.testing.assert_allclose([float(v) for v in numbers], [np.exp(-2.0), -np.exp(-2.0)], rtol=1e-5)
    (of_sin, *_), (of_cos, _, loaded, traced) = own
    assert abs(float(of_sin) - float(of_cos)) > 1e-2 and (loaded, traced) == ("False", "False")


class Ring:
    """Objects that know all others."""

    def __init__(self, others: set):
        self.others = others
        others.add(self)


def test_a_set_whose_members_lead_back_to_it():
    """The walk over its members began anew at each of them, and took hours for a function that a test had patched."""
    others: set = set()
    rings = [Ring(others) for _ in range(12)]
    assert any("Ring" in what for what in content(rings[0]).unseen)
    assert content({1, "a", (2.0, None)}).digest == content({(2.0, None), "a", 1}).digest != content({1, "a"}).digest
    assert not content({1, "a"}).unseen
