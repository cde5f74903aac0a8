"""Which compiled programs are kept, and what is freed."""

import gc
import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxonomy_dae.host import cache, machine
from jaxonomy_dae.host.machine import Use
from jaxonomy_dae.host.staging import is_staged

KERNELS = 10
on_linux = pytest.mark.skipif(machine.mappings() is None, reason="no mappings are counted here")


def many_kernels(x, factor):
    """sin(factor·sin(… x)), each in a loop of its own, which is a kernel of its own."""
    for _ in range(KERNELS):
        x = jax.lax.fori_loop(0, 2, lambda _, v: jnp.sin(factor * v), x)
    return x


def expected(x, factor):
    for _ in range(2 * KERNELS):
        x = np.sin(factor * x)
    return x


@pytest.fixture
def limited(monkeypatch):
    """A cache where each program counts as one mapping of eight that are allowed; `others` come to these."""
    others = [0]

    def mappings():
        return Use(len(programs) + others[0], 8)

    monkeypatch.setattr(cache, "mappings", mappings)
    monkeypatch.setattr(cache, "memory", lambda: None)
    monkeypatch.setattr(cache, "PAUSE", 0)
    programs = cache.ProgramCache()
    return programs, others


def call(programs, *args, function=many_kernels):
    return programs.call(function, False, args, {})


def times(x, k):
    return x * k


class Noted(list):
    """A list that does not count as content, so that a function may note in it what it was traced for."""

    def __content__(self):
        return "noted", ()


def name(function):
    return f"{function.__module__}.{function.__qualname__}"


@pytest.mark.slow
def test_the_least_recently_used_program_goes(limited):
    """Half of eight may be used: before the sixth, the oldest goes, which is not the one that was called since."""
    programs, _ = limited
    x = jnp.array(3.0)
    for k in range(5):
        assert call(programs, x, k, function=times) == 3.0 * k
    call(programs, x, 0, function=times)
    traced = Noted()

    def counted(x, k):
        traced.append(k)
        return x * k

    for k in (5, 6, 5):
        assert call(programs, x, k, function=counted) == 3.0 * k
    assert traced == [5, 6]
    kept = [(one.call.function, one.call.static[1]) for one in programs._programs.values()]
    assert (name(times), 0) in kept and (name(times), 1) not in kept and len(kept) <= 6
    assert call(programs, x, 1, function=times) == 3.0  # compiled anew


@pytest.mark.slow
def test_programs_in_use_do_not_push_each_other_out(limited):
    """Where others hold half of what is allowed already, what is called in turn stays compiled."""
    programs, others = limited
    others[0] = 5
    traced = Noted()

    def counted(x, k):
        traced.append(k)
        return x * k

    for _ in range(4):
        for k in range(2):
            call(programs, jnp.array(1.0), k, function=counted)
    assert len(traced) <= 4


@pytest.mark.slow
def test_a_program_that_runs_is_kept(limited):
    """A function compiles others while it is traced, more than there is room for."""
    programs, _ = limited

    def outer(x):
        for k in range(8):
            x = x + call(programs, x, k, function=times)
        return x

    assert call(programs, jnp.array(1.0), function=outer) == np.prod(np.arange(8) + 1.0)
    assert name(outer) in [one.call.function for one in programs._programs.values()]


def test_values_of_other_shapes_and_types_are_other_programs():
    programs = cache.ProgramCache()
    for x in (jnp.ones(2), jnp.ones(3), jnp.ones(2, jnp.float32), 2 * jnp.ones(2)):
        np.testing.assert_array_equal(call(programs, x, 2, function=times), 2 * x)
    assert len(programs) == 3


@pytest.mark.slow
@on_linux
def test_what_is_let_go_returns_its_mappings():
    """Values, gradients and batches of gradients: all that was compiled of a function."""
    programs = cache.ProgramCache()
    x, factor = jnp.linspace(0.1, 0.9, 3), jnp.array(1.1)

    def loss(factor):
        return jnp.sum(call(programs, x, factor))

    def used():
        gc.collect()
        return machine.mappings().used

    def everything():
        many = jnp.stack([factor, factor])
        return loss(factor), jax.jvp(loss, (factor,), (factor,))[1], jax.vmap(loss)(many)

    everything()  # with the operations around, which JAX keeps
    programs.clear()
    before = used()
    values = everything()
    assert used() > before + 3 * KERNELS
    programs.clear()
    assert len(programs) == 0 and used() <= before + KERNELS // 4
    again = everything()
    for one, two in zip(values, again, strict=True):
        np.testing.assert_array_equal(one, two)
    np.testing.assert_allclose(values[0], expected(np.asarray(x), 1.1).sum(), rtol=1e-14)


def test_without_counts_of_mappings_programs_are_counted(monkeypatch):
    monkeypatch.setattr(cache, "mappings", lambda: None)
    monkeypatch.setattr(cache, "memory", lambda: None)
    monkeypatch.setattr(cache, "COUNT", 3)
    programs = cache.ProgramCache()
    for k in range(6):
        call(programs, jnp.array(1.0), k, function=times)
    assert len(programs) == 4  # three, and the one that was made


@pytest.mark.slow
def test_half_of_the_programs_go_where_memory_is_short(monkeypatch):
    monkeypatch.setattr(cache, "PAUSE", 0)
    monkeypatch.setattr(cache, "mappings", lambda: Use(0, 100))
    monkeypatch.setattr(cache, "memory", lambda: Use(used[0], 100))
    programs, used = cache.ProgramCache(), [0]
    for k in range(4):
        call(programs, jnp.array(1.0), k, function=times)
    used[0] = 60
    for k, kept in ((4, 3), (5, 4), (6, 5)):  # once, until more is used
        call(programs, jnp.array(1.0), k, function=times)
        assert len(programs) == kept
    used[0] = 80
    call(programs, jnp.array(1.0), 7, function=times)
    assert len(programs) == 3


@pytest.mark.slow
@on_linux
def test_a_process_near_the_limit_is_told_once_and_all_is_let_go(monkeypatch, tmp_path):
    """A user's own programs take what is allowed."""
    mine = eqx.filter_jit(many_kernels)
    x = jnp.array(0.3)
    value = mine(x, 1.3)
    held = machine.mappings().used
    allowed = tmp_path / "max_map_count"
    allowed.write_text(str(held))
    monkeypatch.setattr(machine, "ALLOWED", allowed)
    programs = cache.ProgramCache()
    with pytest.warns(RuntimeWarning, match=r"memory mappings that Linux allows.*jax\.clear_caches\(\).*max_map_count"):
        call(programs, x, 2, function=times)
    assert machine.mappings().used < held - KERNELS
    np.testing.assert_array_equal(mine(x, 1.3), value)  # compiled anew
    allowed.write_text(str(machine.mappings().used))
    programs = cache.ProgramCache()
    programs._warned = True
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        call(programs, x, 3, function=times)


def test_use_is_measured_in_at_most_a_hundredth_of_the_time(monkeypatch):
    now, measured = [0.0], []

    def mappings():
        measured.append(now[0])
        now[0] += 0.05
        return Use(0, 100)

    monkeypatch.setattr(cache, "mappings", mappings)
    monkeypatch.setattr(cache, "memory", lambda: None)
    monkeypatch.setattr(cache.time, "perf_counter", lambda: now[0])
    programs = cache.ProgramCache()
    for _ in range(200):
        programs.make_room()
        now[0] += 0.1
    assert 3 <= len(measured) <= 5 and min(np.diff(measured)) >= 5.0


def test_what_closed_over_a_traced_value_is_not_kept():
    """At the next call, the value is another one."""
    programs, held = cache.ProgramCache(), [None]

    def function(x):
        return x * held[0]

    def loss(k):
        held[0] = k
        return call(programs, jnp.array(3.0), function=function)

    for k in (2.0, 5.0):
        assert jax.value_and_grad(lambda k: loss(k) * k)(k) == (3 * k * k, 6 * k)
    assert len(programs) == 0


def test_inside_other_programs():
    """Compiler options are for whole programs; arguments may be traced, or not."""
    programs = cache.ProgramCache()

    def mine(x):
        return call(programs, x, 2, function=times) + call(programs, jnp.array(5.0), 2, function=times)

    assert jax.jit(mine)(1.0) == 12.0
    assert jax.jit(jax.grad(mine))(1.0) == 2.0
    assert mine(jnp.array(1.0)) == 12.0


def test_errors_of_functions_pass_through():
    programs = cache.ProgramCache()

    def checked(x):
        return eqx.error_if(x, x < 0, "x must not be negative")

    assert call(programs, jnp.array(1.0), function=checked) == 1.0
    with pytest.raises(eqx.EquinoxRuntimeError, match="x must not be negative"):
        call(programs, jnp.array(-1.0), function=checked)

    def wrong(x):
        raise ValueError("no")

    with pytest.raises(ValueError, match="^no"):
        call(programs, jnp.array(1.0), function=wrong)


def test_what_is_staged():
    """Tracers around values are not; what has no value yet is."""
    seen = []

    def look(x):
        seen.append(is_staged({"x": x, "name": "a"}))
        return x * x

    x = jnp.array(2.0)
    for transformed in (look, jax.grad(look), jax.grad(jax.grad(look))):
        transformed(x)
    jax.vmap(jax.grad(look))(jnp.ones(2))
    jax.jvp(jax.vmap(look), (jnp.ones(2),), (jnp.ones(2),))
    assert seen == [False] * 5
    seen.clear()
    jax.jit(look)(x)
    jax.jit(jax.vmap(jax.grad(look)))(jnp.ones(2))
    jax.grad(jax.jit(look))(x)
    jax.lax.scan(lambda c, _: (look(c), None), x, length=2)
    assert seen and all(seen)
