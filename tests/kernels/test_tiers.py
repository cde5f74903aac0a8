"""Programs in two tiers, kept for the next process, and their derivatives and batches as programs of their own."""

import os
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental.compilation_cache import compilation_cache
from problems import run

from jaxonomy_dae.host import kept, tiers
from jaxonomy_dae.host.cache import ProgramCache
from jaxonomy_dae.host.compilations import compilations


def wave(x, k):
    """sin(k·sin(k·x)) by a loop, and which of the results are positive."""
    y = jax.lax.fori_loop(0, 2, lambda _, v: jnp.sin(k * v), x)
    return {"y": y, "positive": y > 0, "name": "wave"}


def expected(x, k):
    return np.sin(k * np.sin(k * x))


@pytest.fixture
def tiered(monkeypatch):
    """Two tiers, whatever `XLA_FLAGS` says."""
    monkeypatch.setattr(tiers, "_chosen_by_the_user", lambda: False)


@pytest.fixture
def without_jax():
    """JAX's own cache is off."""
    by_jax = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    compilation_cache.reset_cache()
    jax.config.update("jax_compilation_cache_dir", None)
    yield
    compilation_cache.reset_cache()
    jax.config.update("jax_compilation_cache_dir", by_jax)
    kept._CHOSEN.clear()


@pytest.fixture
def folder(tmp_path, without_jax):
    """A folder in which programs are kept."""
    kept.keep_programs(tmp_path / "programs")
    return tmp_path / "programs"


def records(since):
    return [(c.name, c.how) for c in compilations()[since:]]


def call(programs, x, k):
    return programs.call(wave, True, (x, k), {})


def test_a_program_is_optimized_once_its_runs_took_as_long(tiered):
    """Neither one call nor a few short ones pay for an optimization; what has run for long does, in another thread."""
    programs, since, x = ProgramCache(), len(compilations()), jnp.linspace(0.0, 1.0, 3)
    first = call(programs, x, jnp.array(1.1))
    again = call(programs, x, jnp.array(1.2))
    assert records(since) == [("wave", "quick")]
    (called,) = programs._programs.values()
    program: Any = called.function._program
    program._spent = 1e6  # seconds, as if it had run
    assert call(programs, x, jnp.array(1.1))["name"] == "wave"
    for thread in list(tiers._THREADS):
        thread.join()
    assert records(since) == [("wave", "quick"), ("wave", "optimized")]
    after = call(programs, x, jnp.array(1.1))
    np.testing.assert_allclose(after["y"], first["y"], rtol=1e-15)
    np.testing.assert_allclose(again["y"], expected(np.asarray(x), 1.2), rtol=1e-14)
    assert program._lowered is None  # the quick one has been dropped


def test_options_that_xla_does_not_know_are_left_out(tiered, monkeypatch):
    """Of an XLA that lost the older code generator."""
    monkeypatch.setattr(tiers, "QUICK", {"xla_cpu_no_such_option": False})
    monkeypatch.setattr(tiers, "_REFUSED", [])
    since = len(compilations())
    found = call(ProgramCache(), jnp.ones(2), jnp.array(1.0))
    assert records(since) == [("wave", "optimized")] and tiers.quick() == {}
    np.testing.assert_allclose(found["y"], expected(1.0, 1.0), rtol=1e-14)


def test_the_users_own_choice_of_optimization_stands(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--xla_backend_optimization_level=1")
    assert tiers._chosen_by_the_user.__wrapped__()
    monkeypatch.setenv("XLA_FLAGS", "--xla_force_host_platform_device_count=2")
    assert not tiers._chosen_by_the_user.__wrapped__()


def test_the_next_process_finds_what_was_compiled(tiered, folder):
    """Another cache of programs stands for another process: the outcome is the same to the last bit."""
    x, k, since = jnp.linspace(0.0, 1.0, 4), jnp.array(1.3), len(compilations())
    first = call(ProgramCache(), x, k)
    second = call(ProgramCache(), x, k)
    assert records(since) == [("wave", "quick"), ("wave", "loaded")]
    np.testing.assert_array_equal(first["y"], second["y"])
    assert second["name"] == "wave" and second["positive"].dtype == bool
    (file,) = folder.iterdir()
    assert file.stat().st_mode & 0o077 == 0 and folder.stat().st_mode & 0o077 == 0


def test_files_that_are_not_whole_are_compiled_anew(tiered, folder):
    x, k = jnp.linspace(0.0, 1.0, 5), jnp.array(1.3)
    first = call(ProgramCache(), x, k)
    (file,) = folder.iterdir()
    content = file.read_bytes()
    for broken in (b"", content[:100], content[:-1] + bytes([content[-1] ^ 1]), b"x" * 1000):
        file.write_bytes(broken)
        since = len(compilations())
        np.testing.assert_array_equal(call(ProgramCache(), x, k)["y"], first["y"])
        assert records(since) == [("wave", "quick")]
    assert list(folder.iterdir()) == [file]  # nothing half written is left


def test_what_was_read_but_does_not_run_is_compiled_anew(tiered, folder, monkeypatch):
    """XLA finds out only at the first run that an executable lacks a kernel."""

    def broken(arrays):
        raise jax.errors.JaxRuntimeError("NOT_FOUND: Function call_kernel not found")

    monkeypatch.setattr(kept, "load", lambda key, options, lowered, arrays: (broken, 1.0) if options else None)
    programs = ProgramCache()
    for _ in range(2):
        np.testing.assert_allclose(call(programs, jnp.ones(7), jnp.array(1.3))["y"], expected(1.0, 1.3), rtol=1e-14)


def test_other_processors_find_nothing(tiered, folder, monkeypatch):
    """Machine code for one processor may be none for another."""
    x, k = jnp.linspace(0.0, 1.0, 6), jnp.array(1.3)
    call(ProgramCache(), x, k)
    monkeypatch.setattr(kept, "_machine", lambda: "another one")
    since = len(compilations())
    call(ProgramCache(), x, k)
    assert records(since) == [("wave", "quick")] and len(list(folder.iterdir())) == 2


def test_the_folder_does_not_grow_beyond_its_room(tmp_path, monkeypatch):
    for name, age in (("a", 3), ("b", 1), ("c", 2)):
        (tmp_path / name).write_bytes(bytes(100))
        os.utime(tmp_path / name, (time.time() - age, time.time() - age))
    monkeypatch.setattr(kept, "ROOM", 250)
    kept._make_room(tmp_path)
    assert {file.name for file in tmp_path.iterdir()} == {"b", "c"}  # the one used longest ago has gone


def test_where_programs_are_kept(monkeypatch, tmp_path, without_jax):
    monkeypatch.setenv("JAXONOMY_DAE_CACHE", str(tmp_path))
    assert kept.folder() == tmp_path
    monkeypatch.setenv("JAXONOMY_DAE_CACHE", "")
    assert kept.folder() is None
    monkeypatch.delenv("JAXONOMY_DAE_CACHE")
    where = kept.folder()
    assert where is not None and where.parts[-2:] == ("jaxonomy_dae", "programs")
    kept.keep_programs(tmp_path)
    assert kept.folder() == tmp_path
    kept.keep_programs(None)
    assert kept.folder() is None
    kept.keep_programs(tmp_path)
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))  # JAX's own outranks it
    assert kept.folder() is None


def test_programs_that_call_python_are_not_kept(tiered, folder):
    def doubled(x):
        return jax.pure_callback(lambda v: 2 * v, jax.ShapeDtypeStruct(x.shape, x.dtype), x)

    assert ProgramCache().call(doubled, True, (jnp.array(3.0),), {}) == 6.0
    assert not folder.exists()


LEAVE = """
import jax, jax.numpy as jnp
jax.config.update("jax_enable_compilation_cache", False)
from jaxonomy_dae.host import tiers
from jaxonomy_dae.host.cache import ProgramCache
tiers._chosen_by_the_user = lambda: False
def many(x):
    for _ in range(60):
        x = jax.lax.fori_loop(0, 2, lambda _, v: jnp.sin(1.1 * v), x)
    return x
programs = ProgramCache()
for _ in range(2):
    programs.call(many, True, (jnp.ones(3),), {})
print("threads", len(tiers._THREADS))
if WAITS:
    (called,) = programs._programs.values()
    called.function._program._spent = 1e6
    programs.call(many, True, (jnp.ones(3),), {})
    print("optimizing", sum(thread.is_alive() for thread in tiers._THREADS))
"""


@pytest.mark.slow
@pytest.mark.parametrize("waits", [False, True])
def test_the_interpreter_leaves_cleanly(waits):
    """A script that ends after its second call has nothing to wait for; one that ends while XLA optimizes waits for it,
    and does not crash."""
    told = run(f"WAITS = {waits}\n{LEAVE}")
    assert "threads 0" in told and ("optimizing 1" in told) == waits


# --- derivatives and batches ---------------------------------------------------------------------------------------


def loss(programs, x, k):
    found = call(programs, x, k)
    return jnp.sum(found["y"] ** 2) + k * jnp.where(found["positive"], 1.0, 0.0).sum()


def plain(x, k):
    found = wave(x, k)
    return jnp.sum(found["y"] ** 2) + k * jnp.where(found["positive"], 1.0, 0.0).sum()


X, K, MANY = np.linspace(-1.0, 1.0, 3), 1.1, np.array([0.9, 1.1])
TRANSFORMED = {
    "value": lambda f, x, k, ks: f(x, k),
    "gradient": lambda f, x, k, ks: jax.grad(f, 1)(x, k),
    "by both": lambda f, x, k, ks: jax.grad(f, (0, 1))(x, k),
    "by a float": lambda f, x, k, ks: jax.grad(lambda k: f(x, k))(1.1),
    "batch": lambda f, x, k, ks: jax.vmap(f, (None, 0))(x, ks),
    "batch along a later axis": lambda f, x, k, ks: jax.vmap(f, (1, None))(jnp.stack([x, 2 * x], 1), k),
    "gradients of a batch": lambda f, x, k, ks: jax.vmap(jax.grad(f, 1), (None, 0))(x, ks),
    "gradient of a batch's sum": lambda f, x, k, ks: jax.grad(lambda ks: jax.vmap(f, (None, 0))(x, ks).sum())(ks),
    "forward": lambda f, x, k, ks: jax.jvp(lambda k: f(x, k), (k,), (k,)),
    "forward by all": lambda f, x, k, ks: jax.jacfwd(f, (0, 1))(x, k),
    "forward in a batch": lambda f, x, k, ks: jax.vmap(jax.jacfwd(f), (None, 0))(x, ks),
    "forward of a batch": lambda f, x, k, ks: jax.jvp(lambda ks: jax.vmap(f, (None, 0))(x, ks), (ks,), (ks,)),
    "forward twice": lambda f, x, k, ks: jax.jacfwd(jax.jacfwd(f))(x, k),
    "linearized": lambda f, x, k, ks: jax.linearize(lambda k: f(x, k), k)[1](jnp.ones_like(k)),
    "second derivative": lambda f, x, k, ks: jax.grad(jax.grad(lambda k: f(x, k)))(k),
    "forward over reverse": lambda f, x, k, ks: jax.jacfwd(jax.grad(lambda k: f(x, k)))(k),
    "jacobian": lambda f, x, k, ks: jax.jacrev(lambda x: f(x, k))(x),
    "jitted": lambda f, x, k, ks: jax.jit(jax.grad(f, 1))(x, k),
    "jitted inside": lambda f, x, k, ks: jax.grad(lambda k: jax.jit(f)(x, k))(k),
    "in a scan": lambda f, x, k, ks: jax.lax.scan(lambda c, k: (c, f(x, k)), 0.0, ks)[1],
    "nested batches": lambda f, x, k, ks: jax.vmap(lambda k: jax.vmap(lambda s: f(x, s * k))(ks))(ks),
}


@pytest.mark.parametrize("name", TRANSFORMED)
def test_transformations_are_those_of_jax(name):
    programs, transform, given = ProgramCache(), TRANSFORMED[name], (jnp.asarray(X), jnp.asarray(K), jnp.asarray(MANY))
    found = transform(lambda x, k: loss(programs, x, k), *given)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(transform(plain, *given)), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-13)


def test_a_gradient_is_two_programs_and_is_compiled_once():
    programs, since = ProgramCache(), len(compilations())
    for k in (1.1, 1.2, 1.3):
        jax.grad(lambda k: loss(programs, jnp.asarray(X), k))(k)
    assert [name for name, _ in records(since)] == ["wave", "gradient of wave"]


@pytest.mark.long("XLA compiles a batch")
def test_a_jacobian_in_forward_mode_is_one_program_and_is_compiled_once():
    programs, since = ProgramCache(), len(compilations())
    for k in map(jnp.asarray, (1.1, 1.2, 1.3)):
        found = jax.jacfwd(lambda x, k=k: loss(programs, x, k))(jnp.asarray(X))
        np.testing.assert_allclose(found, jax.jacfwd(plain)(jnp.asarray(X), k), rtol=1e-13)
    assert [name for name, _ in records(since)] == ["batch of derivative of wave"]


def test_cotangents_that_are_zero_are_left_out():
    """What is not read costs nothing in the pullback, and a derivative that is not finite there does not matter."""

    def both(x):
        return jnp.sin(x), jnp.sqrt(x)

    programs = ProgramCache()
    assert jax.grad(lambda x: programs.call(both, True, (x,), {})[0])(jnp.array(0.0)) == 1.0
    assert jax.grad(lambda x: programs.call(both, True, (x,), {})[1])(jnp.array(4.0)) == 0.25


@pytest.mark.slow
def test_rows_of_a_loop_that_are_not_read():
    """JAX takes the zero cotangent of rows that a loop collects for that of one row."""

    def collected(x):
        def step(v, _):
            following = jnp.sin(v)
            return following, (following, jnp.cos(v))

        last, (rows, others) = jax.lax.scan(step, x, length=2)
        return rows[0] * others[1], last, rows, others

    programs, x = ProgramCache(), jnp.array([0.3, 0.4])
    for k in range(4):
        found = jax.grad(lambda x, k=k: programs.call(collected, True, (x,), {})[k].sum())(x)
        np.testing.assert_allclose(found, jax.grad(lambda x, k=k: collected(x)[k].sum())(x), rtol=1e-14)


def test_reasons():
    """A record says what made another program necessary."""
    programs, since = ProgramCache(), len(compilations())
    call(programs, jnp.ones(2), jnp.array(1.0))
    call(programs, jnp.ones(3), jnp.array(1.0))
    call(programs, jnp.ones(3, jnp.float32), jnp.array(1.0, jnp.float32))
    first, second, third = (c.why for c in compilations()[since:])
    assert first == "first call" and "float64[2], is float64[3]" in second
    assert third.count("float32") == 2 and compilations()[-1].seconds > 0
