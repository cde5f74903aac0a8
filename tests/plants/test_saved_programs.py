"""Programs that are compiled ahead of time, and run by another process without compiling anything."""

import re
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental.compilation_cache.compilation_cache import reset_cache
from problems import rc_circuit, rc_voltage, run

from jaxonomy_dae import ModelError, load_compiled, save_compiled, simulate, solvers
from jaxonomy_dae.run.simulation import saved_programs

TS = np.linspace(0.0, 2.0, 3)
READ = """
import jax, time
jax.config.update("jax_enable_x64", True)
from jaxonomy_dae import load_compiled
compiled = []
jax.monitoring.register_event_duration_secs_listener(
    lambda event, seconds, **what: compiled.append(event) if event.endswith("backend_compile_duration") else None
)
program = load_compiled(PATH)
value, gradient = program(jax.device_put(2.0))
print(repr(float(value)), repr(float(gradient)), len(compiled))
"""


@pytest.fixture(autouse=True)
def no_cache():
    """What is read from JAX's cache cannot be written once more; whether there is one is remembered until a reset."""
    jax.config.update("jax_enable_compilation_cache", False)
    reset_cache()
    yield
    jax.config.update("jax_enable_compilation_cache", True)
    reset_cache()


def end(R):
    system = rc_circuit().with_parameters({"r.R": R})
    return simulate(system, 2.0, ts=TS, solver=solvers.Rodas5P(), throw=False)["c.v"][-1]


@pytest.mark.slow
def test_a_run_and_its_gradient_in_another_process(tmp_path):
    """The other process compiles nothing, and does not crash where LAPACK is called. Values are those of the first
    process, to the last bit, and those of the closed form."""
    compiled = jax.jit(jax.value_and_grad(end)).lower(2.0).compile()
    save_compiled(compiled, tmp_path / "run.bin")
    value, gradient, count = run(f"PATH = {str(tmp_path / 'run.bin')!r}\n{READ}").split()
    here = compiled(jnp.asarray(2.0))
    assert (float(value), float(gradient), int(count)) == (float(here[0]), float(here[1]), 0)
    assert float(value) == pytest.approx(rc_voltage(2.0), rel=1e-5)  # rtol 1e-6


def small():
    return jax.jit(lambda x: {"twice": 2 * x}).lower(1.0).compile()


def test_files_of_other_machines_and_of_other_kinds_are_refused(tmp_path, monkeypatch):
    path = tmp_path / "small.bin"
    save_compiled(small(), path)
    there = saved_programs.machine_and_versions()
    monkeypatch.setattr(saved_programs, "machine_and_versions", lambda: there | {"version of JAX": "0.1"})
    with pytest.raises(ModelError, match=rf"another version of JAX: {jax.__version__}, here 0.1. Compile"):
        load_compiled(path)
    monkeypatch.setattr(saved_programs, "machine_and_versions", lambda: there | {"processor": "abacus" * 20})
    with pytest.raises(ModelError, match="another processor. Compile"):
        load_compiled(path)
    path.write_bytes(b"something else")
    with pytest.raises(ModelError, match="not a file of save_compiled"):
        load_compiled(path)


def test_programs_that_call_python_are_refused(tmp_path):
    def checked(x):
        return jax.pure_callback(lambda v: v, jax.ShapeDtypeStruct((), x.dtype), x)

    with pytest.raises(ModelError, match="calls Python.*throw=True"):
        save_compiled(jax.jit(checked).lower(1.0).compile(), tmp_path / "checked.bin")


CACHED = """
import sys

import jax
import jax.numpy as jnp

from jaxonomy_dae import save_compiled

jax.config.update("jax_compilation_cache_dir", sys.argv[1])
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
for _ in range(2):
    compiled = jax.jit(lambda x: jnp.linalg.solve(jnp.eye(3) + x, jnp.sin(x) * jnp.ones(3)).sum()).lower(1.0).compile()
    try:
        save_compiled(compiled, sys.argv[2])
        print("saved")
    except Exception as error:
        print(type(error).__name__, error)
    jax.clear_caches()
"""


def test_what_was_read_from_a_cache_is_refused(tmp_path):
    """Kind: a result that hangs on what was compiled before. The second time, JAX reads the program from its cache, and
    writes a file without its kernels."""
    arguments = [sys.executable, "-c", CACHED, str(tmp_path / "cache"), str(tmp_path / "run.bin")]
    done = subprocess.run(arguments, capture_output=True, text=True, check=True)
    first, second = done.stdout.strip().split("\n", 1)
    assert first == "saved"
    assert re.match(r"ModelError save_compiled: .*persistent cache\. Compile it in a process that does not", second)
