"""Programs that stay as they were compiled, kept for the next process; their derivatives and batches."""

import hashlib
import os
import pickle
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental.compilation_cache import compilation_cache

from jaxonomy_dae.host import kept, program
from jaxonomy_dae.host.cache import ProgramCache
from jaxonomy_dae.host.compilations import compilations


def wave(x, k):
    """sin(k·sin(k·x)) by a loop, and which of the results are positive."""
    y = jax.lax.fori_loop(0, 2, lambda _, v: jnp.sin(k * v), x)
    return {"y": y, "positive": y > 0, "name": "wave"}


def expected(x, k):
    return np.sin(k * np.sin(k * x))


@pytest.fixture
def quickly(monkeypatch):
    """Quick compilations, whatever `XLA_FLAGS` says."""
    monkeypatch.setattr(program, "_chosen_by_the_user", lambda: False)


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
    return programs.call(wave, False, (x, k), {})


def test_a_program_stays_as_it_was_compiled(quickly):
    """Kind of defect: after some 200 calls a thread had compiled another program, and the same call returned other
    numbers. Which program it is, its caller says."""
    programs, since, x = ProgramCache(), len(compilations()), jnp.linspace(0.0, 1.0, 3)
    first = call(programs, x, jnp.array(1.1))
    for _ in range(300):
        again = call(programs, x, jnp.array(1.1))
    assert records(since) == [("wave", "quick")]
    np.testing.assert_array_equal(first["y"], again["y"])
    optimized = programs.call(wave, True, (x, jnp.array(1.1)), {})
    assert records(since)[1:] == [("wave", "optimized")]
    np.testing.assert_allclose(optimized["y"], expected(np.asarray(x), 1.1), rtol=1e-14)


def test_options_that_xla_does_not_know_are_left_out(quickly, monkeypatch):
    """Of an XLA that lost the older code generator."""
    monkeypatch.setattr(program, "QUICK", {"xla_cpu_no_such_option": False})
    monkeypatch.setattr(program, "_REFUSED", [])
    since = len(compilations())
    found = call(ProgramCache(), jnp.ones(2), jnp.array(1.0))
    assert records(since) == [("wave", "optimized")] and program.quick() == {}
    np.testing.assert_allclose(found["y"], expected(1.0, 1.0), rtol=1e-14)


def test_the_users_own_choice_of_optimization_stands(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--xla_backend_optimization_level=1")
    assert program._chosen_by_the_user.__wrapped__()
    monkeypatch.setenv("XLA_FLAGS", "--xla_force_host_platform_device_count=2")
    assert not program._chosen_by_the_user.__wrapped__()


def test_the_next_process_finds_what_was_compiled(quickly, folder):
    """Another cache of programs stands for another process: the outcome is the same to the last bit."""
    x, k, since = jnp.linspace(0.0, 1.0, 4), jnp.array(1.3), len(compilations())
    first = call(ProgramCache(), x, k)
    second = call(ProgramCache(), x, k)
    assert records(since) == [("wave", "quick"), ("wave", "loaded")]
    np.testing.assert_array_equal(first["y"], second["y"])
    assert second["name"] == "wave" and second["positive"].dtype == bool
    assert len(list(folder.iterdir())) == 2  # the executable, and what is known of it
    assert all(file.stat().st_mode & 0o077 == 0 for file in (folder, *folder.iterdir()))


def test_files_that_are_not_whole_are_compiled_anew(quickly, folder):
    x, k = jnp.linspace(0.0, 1.0, 5), jnp.array(1.3)
    first = call(ProgramCache(), x, k)
    contents = {file: file.read_bytes() for file in folder.iterdir()}
    for broken in (
        lambda c: b"",
        lambda c: c[:100],
        lambda c: c[:-1] + bytes([c[-1] ^ 1]),
        lambda c: b"x" * 1000,
        lambda c: next(other for other in contents.values() if other != c),  # the files have changed places
    ):
        for file, content in contents.items():
            file.write_bytes(broken(content))
        program._EXECUTABLES.clear()
        since = len(compilations())
        np.testing.assert_array_equal(call(ProgramCache(), x, k)["y"], first["y"])
        assert records(since) == [("wave", "quick")]
    assert {*folder.iterdir()} == {*contents}  # nothing half written is left


def test_what_was_read_but_does_not_run_is_compiled_anew(quickly, folder, monkeypatch):
    """XLA finds out only at the first run that an executable lacks a kernel."""

    def broken(arrays):
        raise jax.errors.JaxRuntimeError("NOT_FOUND: Function call_kernel not found")

    monkeypatch.setattr(kept, "load", lambda key, options, outputs, arrays: broken)
    programs = ProgramCache()
    for _ in range(2):
        np.testing.assert_allclose(call(programs, jnp.ones(7), jnp.array(1.3))["y"], expected(1.0, 1.3), rtol=1e-14)


def test_other_processors_find_nothing(quickly, folder, monkeypatch):
    """Machine code for one processor may be none for another."""
    x, k = jnp.linspace(0.0, 1.0, 6), jnp.array(1.3)
    call(ProgramCache(), x, k)
    monkeypatch.setattr(kept, "_machine", lambda: "another one")
    since = len(compilations())
    call(ProgramCache(), x, k)
    assert records(since) == [("wave", "quick")] and len(list(folder.iterdir())) == 4


def test_the_folder_does_not_grow_beyond_its_room(tmp_path):
    """Kind of defect: files of the user's in the folder that he had named were counted, and deleted."""
    ours = [f"{digit * 64}.program" for digit in "abc"]
    for name, age in ((ours[0], 3), (ours[1], 1), (ours[2], 2), ("measurements.h5", 9), ("a" * 64, 9)):
        (tmp_path / name).write_bytes(bytes(100))
        os.utime(tmp_path / name, (time.time() - age, time.time() - age))
    kept.make_room(tmp_path, kept.OURS, room=250)
    left = {file.name for file in tmp_path.iterdir()}
    assert left == {ours[1], ours[2], "measurements.h5", "a" * 64}  # ours that was used longest ago has gone


def test_what_is_read_of_a_program_is_data(quickly, folder, tmp_path):
    """Kind of defect: a record was a pickle, and one with code in it was executed."""
    mark = tmp_path / "mark"

    class Code:
        def __reduce__(self):
            return os.system, (f"touch {mark}",)

    x, k = jnp.linspace(0.0, 1.0, 8), jnp.array(1.3)
    first = call(ProgramCache(), x, k)
    content = pickle.dumps(Code())
    smallest = min(folder.iterdir(), key=lambda path: path.stat().st_size)  # the record
    smallest.write_bytes(hashlib.sha256(content).digest() + content)
    np.testing.assert_array_equal(call(ProgramCache(), x, k)["y"], first["y"])
    assert not mark.exists()


FOREIGN = {
    "writable for others": lambda where: where.chmod(0o777),
    "a link": lambda where: (where.rename(where.with_name("real")), where.symlink_to(where.with_name("real"))),
    "of another user": lambda where: os.chown(where, 12345, 12345),
}


@pytest.mark.parametrize("name", FOREIGN)
def test_a_folder_into_which_others_may_write_is_not_used(quickly, folder, name):
    """Executables are native code: whoever can write them there could run anything here."""
    if not hasattr(os, "getuid") or (name == "of another user" and os.getuid() != 0):
        pytest.skip("only root can give a folder to another user")
    folder.mkdir()
    FOREIGN[name](folder)
    since = len(compilations())
    for _ in range(2):
        call(ProgramCache(), jnp.linspace(0.0, 1.0, 9), jnp.array(1.3))
    assert [how for _, how in records(since)].count("refused") == 1
    assert str(folder) in compilations()[since].why and not list(folder.iterdir())


def test_a_full_disk_leaves_nothing_behind(quickly, folder, monkeypatch):
    def full(*args):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(kept.os, "replace", full)
    found = call(ProgramCache(), jnp.linspace(0.0, 1.0, 10), jnp.array(1.3))
    np.testing.assert_allclose(found["y"], expected(np.linspace(0.0, 1.0, 10), 1.3), rtol=1e-14)
    assert not list(folder.iterdir())


def test_a_user_without_a_home(quickly, monkeypatch, without_jax):
    """In containers: `Path.home` fails."""

    def homeless():
        raise RuntimeError("Could not determine home directory.")

    for name in ("JAXONOMY_DAE_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(kept.Path, "home", homeless)
    assert kept.folder() is None
    call(ProgramCache(), jnp.linspace(0.0, 1.0, 11), jnp.array(1.3))


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


def test_programs_that_call_python_are_not_kept(quickly, folder):
    def doubled(x):
        return jax.pure_callback(lambda v: 2 * v, jax.ShapeDtypeStruct(x.shape, x.dtype), x)

    assert ProgramCache().call(doubled, False, (jnp.array(3.0),), {}) == 6.0
    assert not folder.exists()


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
    assert jax.grad(lambda x: programs.call(both, False, (x,), {})[0])(jnp.array(0.0)) == 1.0
    assert jax.grad(lambda x: programs.call(both, False, (x,), {})[1])(jnp.array(4.0)) == 0.25


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
        found = jax.grad(lambda x, k=k: programs.call(collected, False, (x,), {})[k].sum())(x)
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
