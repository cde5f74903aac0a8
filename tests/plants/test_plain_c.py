"""Systems as plain C99: compiled without a warning, run, and set beside JAX and closed forms."""

import csv
import subprocess

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hybrid_models import Ball, SampledPI
from hybrid_models import compiled as hybrid
from problems import drag_on, mlp, pendulum

from jaxonomy_dae import simulate
from jaxonomy_dae.errors import ModelError
from jaxonomy_dae.fmi.compilers import compiler_for, this_platform

pytestmark = pytest.mark.skipif(compiler_for(this_platform()) is None, reason="no C compiler on this machine")


def built(folder, main="main.c"):
    """The program of a folder, compiled with all warnings as errors."""
    strict = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-O1", "-ffp-contract=off"]
    command = [*(compiler_for(this_platform()) or ()), *strict, f"-I{folder}", str(folder / f"{folder.name}.c")]
    program = folder / "program"
    done = subprocess.run([*command, str(folder / main), "-o", str(program), "-lm"], capture_output=True, text=True)
    assert not done.returncode, done.stderr
    return program


def printed(program, *arguments):
    done = subprocess.run([str(program), *map(str, arguments)], capture_output=True, text=True)
    assert not done.returncode, done.stderr
    head, *rows = csv.reader(done.stdout.splitlines())
    return dict(zip(head, np.array(rows, float).T, strict=True))


def test_a_ball_in_c(tmp_path):
    """A ball dropped from 1 m bounces with e = 0.8."""
    folder = hybrid(Ball, "b").to_c(tmp_path / "ball", stop_time=0.9)
    assert {p.name for p in folder.iterdir()} == {"ball.h", "ball.c", "main.c", "CMakeLists.txt"}
    found = printed(built(folder), 0.9, 9, 1e-9)
    fall, t = np.sqrt(2 / 9.81), found["time"]
    s, v = t - fall, 0.8 * np.sqrt(2 * 9.81)
    np.testing.assert_allclose(found["b.h"], np.where(s < 0, 1 - 9.81 * t**2 / 2, v * s - 9.81 * s**2 / 2), atol=1e-12)
    np.testing.assert_array_equal(found["b.n"], s > 0)


def test_what_cannot_be_written_is_refused_by_name(tmp_path):
    system = hybrid(Ball, "b")
    for folder in ("ball 1", "while"):
        with pytest.raises(ModelError, match=f"'{folder}' is not a name of C"):
            system.to_c(tmp_path / folder)
    with pytest.raises(ModelError, match="functions: 'simulate' is not known; there are derivatives, events, run"):
        system.to_c(tmp_path / "ball", functions=["simulate"])
    (tmp_path / "ball").mkdir()
    (tmp_path / "ball" / "main.c").write_text("")
    with pytest.raises(ModelError, match="main.c' exists: give another folder, or overwrite=True"):
        system.to_c(tmp_path / "ball")


DERIVATIVES = """
#include <stdio.h>
#include "swing.h"
static swing m;
int main(void) {
  static double along[SWING_ND], out[SWING_ND], y[SWING_N_UNKNOWNS], weights[SWING_N_UNKNOWNS];
  swing_reset(&m);
  if (swing_start(&m, 0, 1, 0)) return 1;
  for (int k = 0; k < SWING_ND; ++k) along[k] = 1 + k % 3;
  for (int k = 0; k < SWING_N_UNKNOWNS; ++k) weights[k] = 1 - k % 2 * 0.5;
  swing_get_forward(&m, along, y);
  swing_get_reverse(&m, weights, out);
  double a = 0, b = 0;
  for (int k = 0; k < SWING_N_UNKNOWNS; ++k) a += weights[k] * y[k];
  for (int k = 0; k < SWING_ND; ++k) b += along[k] * out[k];
  printf("forward,reverse,length,weight\\n%.17g,%.17g,%.17g,%.17g\\n", a, b, out[swing_place("pend.L")],
         out[swing_place("drag.layers[0].weight")]);
  return swing_place("pend.none") != -1;
}
"""


@pytest.mark.slow
def test_a_pendulum_with_a_network_in_c(tmp_path):
    """Each choice of functions compiles; a run is that of `simulate`, derivatives are those of JAX."""
    system = pendulum(drag_on("vx", "vy", network=mlp(2, 2)))
    for functions in ([], ["events"], ["derivatives"]):
        built(system.to_c(tmp_path / "some", functions=functions, overwrite=True))
    folder = system.to_c(tmp_path / "swing", outputs=["pend.lam"])
    found = printed(built(folder), 2.0, 20, 1e-9)
    expected = simulate(system, 2.0, rtol=1e-10, atol=1e-12, ts=jnp.asarray(found["time"]))
    for name in ("pend.x", "pend.vy", "pend.lam"):
        np.testing.assert_allclose(found[name], expected[name], atol=1e-7, err_msg=name)
    (folder / "derivatives.c").write_text(DERIVATIVES)
    found = printed(built(folder, "derivatives.c"))
    assert found["forward"] == pytest.approx(found["reverse"], rel=1e-12)
    weights = 1 - np.arange(len(system.states) + 1) % 2 * 0.5
    x = system.initialize()

    def weighted(length):
        own = system.with_parameters({"pend.L": length})
        return weights[:-1] @ own.vector_field(0.0, x) + weights[-1] * own.observe(["pend.lam"], 0.0, x)[0]

    assert found["length"] == pytest.approx(float(jax.grad(weighted)(1.0)), rel=1e-10, abs=1e-12)


@pytest.mark.slow
def test_a_sampled_controller_in_c(tmp_path):
    system = hybrid(SampledPI, "c")
    found = printed(built(system.to_c(tmp_path / "loop")), 2.05, 41, 1e-9)
    expected = simulate(system, 2.05, rtol=1e-10, atol=1e-12, ts=jnp.asarray(found["time"]))
    np.testing.assert_allclose(found["c.x"], expected["c.x"], atol=1e-8)
