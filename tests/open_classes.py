"""What tests of plants with opened Modelica classes share."""

import jax
import jax.numpy as jnp

from jaxonomy_dae import simulate


def opened(library, path):
    return library[f"Modelica.{path}"]


def run_with_slopes(system, values, ts, names, of, solver=None, initial=None):
    """The values of variables, and the derivatives of the sum of the last values of `of` by parameters: no two of these
    depend on the same parameter."""

    def run(values):
        options = {"ts": jnp.asarray(ts), "rtol": 1e-9, "atol": 1e-11, "solver": solver, "initial": initial}
        solution = simulate(system.with_parameters(values), float(ts[-1]), **options)
        found = {n: solution[n] for n in names}
        return sum(found[n][-1] for n in of), found

    (_, found), slopes = jax.jit(jax.value_and_grad(run, has_aux=True))(values)
    return found, slopes


def run_along(system, values, ts, names, solver=None):
    """The values of variables, and their derivatives where all parameters grow in proportion, in forward mode: it makes
    smaller programs than the reverse one, where there are many events."""

    def run(scale):
        options = {"ts": jnp.asarray(ts), "rtol": 1e-9, "atol": 1e-11, "solver": solver}
        given = {name: value * scale for name, value in values.items()}
        solution = simulate(system.with_parameters(given), float(ts[-1]), **options)
        return jnp.stack([solution[n] for n in names])

    return jax.jit(lambda scale: jax.jvp(run, (scale,), (1.0,)))(1.0)


def along_by_differences(reference, values, step=1e-5):
    """The derivatives of `reference(*values)` where all values grow in proportion, by central differences."""
    up, down = (reference(*(value * (1 + sign * step) for value in values.values())) for sign in (1, -1))
    return (up - down) / (2 * step)


def by_differences(reference, values, step=1e-4):
    """The derivatives of the sum of the last values that `reference(*values)` gives, by central differences."""

    def end(name, factor):
        return reference(*(values | {name: values[name] * factor}).values())[..., -1].sum()

    return {
        name: (end(name, 1 + step) - end(name, 1 - step)) / (2 * step * value)
        for name, value in values.items()
    }  # fmt: skip
