"""Programs belong to what they compute: a table of edits, each before and after, in one process and in two.

Kind of defect: a program compiled for one function served another one, because functions were told apart as objects, by
their names, by their bytecode or by their modules' dates. Wrong numbers without a word are the worst that a cache can
do. Each law is a function of one number x, read at x = 2; what is right follows from the law as it stands.
"""

import dataclasses
import functools
import importlib
import math
import os
import subprocess
import sys
import time
import types
import warnings
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxonomy_dae.host.cache import ProgramCache
from jaxonomy_dae.host.libraries import Owner, owner

X = 2.0


def applied(law, x):
    return law(x)


def value(programs, law):
    return float(programs.call(applied, False, (law, jnp.asarray(X)), {}))


# --- one process
# ----------------------------------------------------------------------------------------------------

FACTOR = [1.0]  # of `by_global`
OTHER = types.SimpleNamespace(factor=1.0)
TABLE = np.array([1.0, 2.0])


def by_global():
    scope = {"factor": 1.0, "jnp": jnp}
    exec("def law(x): return factor * x", scope)  # a cell of a notebook
    return scope["law"], lambda: scope.update(factor=3.0), 3.0 * X


def by_global_of_another_type():
    scope = {"factor": 1, "jnp": jnp}
    exec("def law(x): return jnp.where(jnp.asarray(factor).dtype == bool, 5.0, x)", scope)
    return scope["law"], lambda: scope.update(factor=True), 5.0


def by_sign_of_zero():
    scope = {"zero": 0.0, "jnp": jnp}
    exec("def law(x): return jnp.arctan2(zero, -1.0) + 0 * x", scope)
    return scope["law"], lambda: scope.update(zero=-0.0), -math.pi


def by_helper():
    scope = {}
    exec("def helper(x): return x\ndef law(x): return helper(x)", scope)
    return scope["law"], lambda: exec("def helper(x): return x * x", scope), X * X


def by_cell():
    factor = 1.0

    def law(x):
        return factor * x

    def edit():
        nonlocal factor
        factor = 3.0

    return law, edit, 3.0 * X


def by_default():
    def law(x, factor=1.0):
        return factor * x

    return law, lambda: setattr(law, "__defaults__", (3.0,)), 3.0 * X


def by_keyword_default():
    def law(x, *, factor=1.0):
        return factor * x

    return law, lambda: law.__kwdefaults__.update(factor=3.0), 3.0 * X


def by_attribute_of_the_function():
    def law(x):
        return law.factor * x

    law.factor = 1.0
    return law, lambda: setattr(law, "factor", 3.0), 3.0 * X


def by_code():
    def law(x):
        return x

    def edited(x):
        return x * x

    return law, lambda: setattr(law, "__code__", edited.__code__), X * X  # as IPython's autoreload does


class Gain:
    def __init__(self, factor):
        self.factor = factor

    def law(self, x):
        return self.factor * x

    def __call__(self, x):
        return self.factor * x


def by_bound_method():
    gain = Gain(1.0)
    return gain.law, lambda: setattr(gain, "factor", 3.0), 3.0 * X


def by_object():
    gain = Gain(1.0)
    return gain, lambda: setattr(gain, "factor", 3.0), 3.0 * X


def by_slots():
    class Slotted:
        __slots__ = ("factor",)

        def __call__(self, x):
            return self.factor * x

    law = Slotted()
    law.factor = 1.0
    return law, lambda: setattr(law, "factor", 3.0), 3.0 * X


def by_method_of_a_class():
    class Law:
        def __call__(self, x):
            return x

    return Law(), lambda: setattr(Law, "__call__", lambda self, x: x * x), X * X


def by_attribute_of_a_class():
    class Law:
        factor = 1.0

        def __call__(self, x):
            return self.factor * x

    return Law(), lambda: setattr(Law, "factor", 3.0), 3.0 * X


def by_base_class():
    class Base:
        def times(self, x):
            return x

    class Law(Base):
        def __call__(self, x):
            return self.times(x)

    return Law(), lambda: setattr(Base, "times", lambda self, x: x * x), X * X


def by_property():
    class Law:
        @property
        def factor(self):
            return 1.0

        def __call__(self, x):
            return self.factor * x

    return Law(), lambda: setattr(Law, "factor", property(lambda self: 3.0)), 3.0 * X


def by_array():
    table = np.array([1.0, 2.0])

    def law(x):
        return x * jnp.asarray(table)[0]

    return law, lambda: table.__setitem__(0, 3.0), 3.0 * X


def by_list_in_a_dictionary():
    settings = {"factors": [1.0]}

    def law(x):
        return x * settings["factors"][0]

    return law, lambda: settings["factors"].__setitem__(0, 3.0), 3.0 * X


def by_partial():
    settings = {"factor": 1.0}

    def scaled(settings, x):
        return settings["factor"] * x

    return functools.partial(scaled, settings), lambda: settings.update(factor=3.0), 3.0 * X


def by_decorator():
    scope = {"factor": 1.0}
    exec("def law(x): return factor * x", scope)

    @functools.wraps(scope["law"])
    def wrapped(x):
        return scope["law"](x)

    return wrapped, lambda: scope.update(factor=3.0), 3.0 * X


def by_jitted():
    scope = {"factor": 1.0, "jax": jax}
    exec("def helper(x): return factor * x\ndef law(x): return helper(x)", scope)
    return scope["law"], lambda: scope.update(helper=jax.jit(lambda x: x * x)), X * X


def by_rule_of_a_derivative():
    slope = [1.0]

    @jax.custom_jvp
    def square(x):
        return x * x

    @square.defjvp
    def _(primals, tangents):
        return square(primals[0]), slope[0] * tangents[0]

    def law(x):
        return jax.grad(square)(x)

    return law, lambda: slope.__setitem__(0, 3.0), 3.0


def by_module_two_away():
    far, near = types.ModuleType("far"), types.ModuleType("near")
    far.factor, near.far = 1.0, far
    sys.modules["near"], sys.modules["far"] = near, far
    scope = {"near": near}
    exec("def law(x): return near.far.factor * x", scope)
    return scope["law"], lambda: setattr(far, "factor", 3.0), 3.0 * X


def by_import_inside():
    module = sys.modules["law_inside"] = types.ModuleType("law_inside")
    module.factor = 1.0

    def law(x):
        from law_inside import factor

        return factor * x

    return law, lambda: setattr(module, "factor", 3.0), 3.0 * X


def by_environment():
    os.environ["JAXONOMY_TEST_FACTOR"] = "1.0"

    def law(x):
        return float(os.environ["JAXONOMY_TEST_FACTOR"]) * x

    return law, lambda: os.environ.update(JAXONOMY_TEST_FACTOR="3.0"), 3.0 * X


def by_random_state():
    np.random.seed(1)

    def law(x):
        return np.random.random() * 0 + len(TABLE) * x + np.random.randint(2, 3)

    return law, lambda: np.random.seed(2), 2 * X + 2


def by_getattr():
    settings = types.SimpleNamespace(factor=1.0)

    def law(x):
        return getattr(settings, "fac" + "tor") * x

    return law, lambda: setattr(settings, "factor", 3.0), 3.0 * X


def by_instance_that_hides_it():
    class Law:
        def __init__(self):
            self.held = iter([1.0, 3.0])  # an iterator, which changes as it is read

        def __call__(self, x):
            return next(self.held) * x

    return Law(), lambda: None, 3.0 * X


@dataclasses.dataclass(frozen=True)
class Uncompared:
    name: str
    factor: float = dataclasses.field(compare=False, default=1.0)

    def __call__(self, x):
        return self.factor * x


def by_field_that_is_not_compared():
    one, other = Uncompared("a", 1.0), Uncompared("a", 3.0)
    current = [one]
    return current, lambda: current.__setitem__(0, other), 3.0 * X


class Static(eqx.Module):
    fill: object = eqx.field(static=True)

    def __call__(self, x):
        return x * (1.0 if isinstance(self.fill, bool) else 3.0)


def by_static_field_of_another_type():
    current = [Static(True)]
    return current, lambda: current.__setitem__(0, Static(1)), 3.0 * X


def by_class_of_the_same_name():
    def made(power):
        class Law(eqx.Module):
            def __call__(self, x):
                return x**power

        return Law()

    current = [made(1)]
    return current, lambda: current.__setitem__(0, made(2)), X * X


def by_method_of_a_library():
    class Layer(eqx.nn.Identity):
        pass

    law, kept = Layer(), eqx.nn.Identity.__call__

    def edit():
        eqx.nn.Identity.__call__ = lambda self, x, *, key=None: x * x

    edit.undo = lambda: setattr(eqx.nn.Identity, "__call__", kept)
    return law, edit, X * X


EDITS = {name: law for name, law in list(globals().items()) if name.startswith("by_")}


@pytest.mark.parametrize("name", EDITS)
def test_one_process(name):
    law, edit, right = EDITS[name]()
    programs = ProgramCache()

    def now():
        return value(programs, law[0] if isinstance(law, list) else law)

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that a function computes something else than before
            before = now()
            edit()
            after = now()
    finally:
        getattr(edit, "undo", lambda: None)()
    assert after == pytest.approx(right, rel=1e-12)
    assert before != after or name == "by_random_state"


def test_what_is_the_same_is_not_compiled_again():
    """A cell of a notebook is run again: the same law, another object."""
    programs = ProgramCache()
    for _ in range(3):
        scope = {"factor": 2.0, "jnp": jnp}
        exec("def helper(x): return jnp.sin(x)\ndef law(x): return factor * helper(x)", scope)
        value(programs, scope["law"])
    assert len(programs) == 1


def test_a_function_that_reads_a_clock_is_said_at_the_second_call():
    programs = ProgramCache()

    def law(x):
        return time.perf_counter() * x

    first = value(programs, law)
    with pytest.warns(RuntimeWarning, match="computes something else than when it was called last.*reads .*time"):
        assert value(programs, law) > first


def test_a_late_derivative_is_that_of_the_law_as_it_is_now():
    """Two laws of one content share their programs; the derivative is traced when it is asked for, of the law that
    asks."""

    def made(factor):
        def law(x):
            return factor[0] * x

        return law

    programs, one, other = ProgramCache(), [1.0], [1.0]
    assert value(programs, made(one)) == X
    one[0] = 7.0  # the first law is another one now
    slope = jax.grad(lambda x: programs.call(applied, False, (made(other), x), {}))(jnp.asarray(X))
    assert slope == 1.0


def test_a_loop_reads_at_its_beginning():
    programs, factor = ProgramCache(), [1.0]

    def law(x):
        return factor[0] * x

    looped = programs.looped(law)
    assert looped(jnp.asarray(X)) == X
    factor[0] = 3.0
    assert looped(jnp.asarray(X)) == X and programs.looped(law)(jnp.asarray(X)) == 3.0 * X


def test_whose_a_module_is(tmp_path, monkeypatch):
    """A module of the user's with a name of the standard library, of a library or of this package is the user's."""
    for name in ("wave", "jaxonomy_dae_more", "optax"):
        (tmp_path / f"{name}.py").write_text("def law(x): return x\n")
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.syspath_prepend(str(tmp_path))
    for name in ("wave", "jaxonomy_dae_more", "optax"):
        importlib.import_module(name)
        assert owner(name) is Owner.USER
        monkeypatch.delitem(sys.modules, name)
    assert owner("math") is Owner.KNOWN and owner("time") is Owner.STANDARD


# --- two processes
# -----------------------------------------------------------------------------------------------------

PROCESS = """
import os, sys
import jax, jax.numpy as jnp, numpy as np
jax.config.update("jax_enable_x64", True)
from jaxonomy_dae import compilations
from jaxonomy_dae.host.cache import ProgramCache
import wave, near, profile, plain
if os.environ.get("PATCHED"):
    import equinox as eqx
    eqx.nn.Identity.__call__ = lambda self, x, *, key=None: x * x
def applied(law, x):
    return law(x)
def law_of_main(x):
    return FACTOR * x
import equinox as eqx
laws = dict(wave=wave.law, near=near.law, profile=profile.Law(), main=law_of_main, library=eqx.nn.Identity(),
            plain=plain.law, environment=plain.environment)
for name, law in laws.items():
    since = len(compilations())
    found = float(ProgramCache().call(applied, False, (law, jnp.asarray(2.0)), {}))
    print(name, found, *(c.how for c in compilations()[since:]))
"""
FILES = {
    "wave.py": "def law(x): return FACTOR * x\n",
    "near.py": "import far\ndef law(x): return far.helper(x)\n",
    "far.py": "def helper(x): return FACTOR * x\n",
    "profile.py": "class Law:\n    def __call__(self, x): return FACTOR * x\n",
    "plain.py": "import os\ndef law(x): return 5.0 * x\n"
    "def environment(x): return float(os.environ['FACTOR_OF_TEST']) * x\n",
}


@pytest.mark.slow
def test_two_processes(tmp_path):
    """The second process finds the programs of laws that are the same, and those alone."""
    environment = {key: v for key, v in os.environ.items() if not key.startswith("JAX_COMPILATION")}
    environment |= {
        "JAXONOMY_DAE_CACHE": str(tmp_path / "kept"),
        "PYTHONPATH": os.pathsep.join([str(tmp_path), str(Path(__file__).parents[2])]),
        "PYTHONDONTWRITEBYTECODE": "1",
        "XLA_FLAGS": "",
    }

    def told(factor, **more):
        for name, text in FILES.items():
            (tmp_path / name).write_text(text.replace("FACTOR *", f"{factor} *"))
            os.utime(tmp_path / name, (1e9, 1e9))  # an old date tells nothing
        (tmp_path / "script.py").write_text(PROCESS.replace("FACTOR *", f"{factor} *"))
        command = [sys.executable, str(tmp_path / "script.py")]
        more = {"FACTOR_OF_TEST": str(factor)} | more
        done = subprocess.run(command, env=environment | more, capture_output=True, text=True, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        return {name: (float(number), how) for name, number, *how in map(str.split, done.stdout.splitlines())}

    first, again, edited = told(1.0), told(1.0), told(3.0, PATCHED="1")
    laws = {"wave", "near", "profile", "main", "environment"}
    assert {name: number for name, (number, _) in first.items()} == dict.fromkeys(laws, 2.0) | {
        "plain": 10.0, "library": 2.0,
    }  # fmt: skip
    assert {name: number for name, (number, _) in again.items()} == {n: v for n, (v, _) in first.items()}
    assert all(how == ["loaded"] for _, how in again.values())
    assert {name: number for name, (number, _) in edited.items()} == dict.fromkeys(laws, 6.0) | {
        "plain": 10.0, "library": 4.0,
    }  # fmt: skip
