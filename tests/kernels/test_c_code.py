"""Primitives of JAX in C, each alone against JAX on edge values, and random expressions."""

from functools import partial

import jax
import jax.numpy as jnp
import jax.scipy.special as special
import numpy as np
import pytest
from c_programs import COMPILER, agree, in_c
from jax import lax

from jaxonomy_dae.errors import ModelError
from jaxonomy_dae.fmi.emit_c import program_in_c

pytestmark = pytest.mark.skipif(COMPILER is None, reason="no C compiler on this machine")

NAN, INF = float("nan"), float("inf")
EDGES = [0.0, -0.0, 1.0, -1.0, 0.5, -2.5, 1.5, 2.5, 1e-300, -1e300, 3.7, INF, -INF, NAN]
UNARY = {
    "exp": jnp.exp, "exp2": jnp.exp2, "log": jnp.log, "expm1": jnp.expm1, "log1p": jnp.log1p, "sin": jnp.sin,
    "cos": jnp.cos, "tan": jnp.tan, "asin": jnp.arcsin, "acos": jnp.arccos, "atan": jnp.arctan, "sinh": jnp.sinh,
    "cosh": jnp.cosh, "tanh": jnp.tanh, "asinh": jnp.arcsinh, "acosh": jnp.arccosh, "atanh": jnp.arctanh,
    "sqrt": jnp.sqrt, "rsqrt": lax.rsqrt, "cbrt": jnp.cbrt, "erf": special.erf, "erfc": special.erfc,
    "logistic": jax.nn.sigmoid, "floor": jnp.floor, "ceil": jnp.ceil, "round": lax.round,
    "rint": partial(lax.round, rounding_method=lax.RoundingMethod.TO_NEAREST_EVEN), "sign": jnp.sign, "abs": jnp.abs,
    "neg": jnp.negative, "square": jnp.square, "is_finite": jnp.isfinite, "to_int32": lambda x: x.astype(jnp.int32),
    "to_int64": lambda x: x.astype(jnp.int64), "to_uint8": lambda x: x.astype(jnp.uint8),
    "to_bool": lambda x: x.astype(bool), "cube": lambda x: lax.integer_pow(x, 3),
    "seventh": lambda x: lax.integer_pow(x, 7), "inverse_square": lambda x: lax.integer_pow(x, -2),
    "fewer_digits": lambda x: lax.reduce_precision(x, jnp.finfo(x.dtype).nexp, 1),
}  # fmt: skip
BINARY = {
    "add": lax.add, "sub": lax.sub, "mul": lax.mul, "div": lax.div, "rem": lax.rem, "max": lax.max, "min": lax.min,
    "pow": lax.pow, "atan2": lax.atan2, "nextafter": lax.nextafter, "eq": lax.eq, "ne": lax.ne, "lt": lax.lt,
    "le": lax.le, "gt": lax.gt, "ge": lax.ge,
    "select": lambda x, y: jnp.where(x > y, x, y), "clamp": lambda x, y: lax.clamp(x, y, jnp.ones_like(x)),
}  # fmt: skip
INTEGERS = [0, 1, -1, 7, -7, 3, -3, 2**31 - 1, -(2**31)]
OF_INTEGERS = {
    "iadd": lax.add, "isub": lax.sub, "imul": lax.mul, "idiv": lax.div, "irem": lax.rem, "imax": lax.max,
    "imin": lax.min, "iand": lax.bitwise_and, "ior": lax.bitwise_or, "ixor": lax.bitwise_xor,
    "left": lax.shift_left, "right": lax.shift_right_arithmetic, "logical": lax.shift_right_logical,
    "signs": lambda x, y: jnp.sign(x) + jnp.abs(y) - (-x), "to_float": lambda x, y: x.astype(jnp.float64) / 3.0,
    "not": lambda x, y: ~x, "inot": lambda x, y: ~(x > y) & ((y > 0) | (x < y)),
}  # fmt: skip


def grid(values, dtype):
    a = np.array(values, dtype)
    return np.repeat(a, len(a)), np.tile(a, len(a))


def matrix(*shape, seed=0):
    return np.random.default_rng(seed).normal(size=shape)


A, B, V = matrix(3, 4), matrix(4, 2, seed=1), matrix(5, seed=2)
SQUARE = matrix(4, 4, seed=3)
CUBE = matrix(2, 3, 4, seed=4)
ARRAYS = {
    "matmul": (jnp.matmul, (A, B)),
    "batched": (lambda a, b: jnp.einsum("bij,bkj->bik", a, b), (CUBE, CUBE[:, ::-1])),
    "outer": (jnp.outer, (V, V)),
    "dot": (jnp.dot, (V, V)),
    "transpose": (lambda a: jnp.transpose(a, (2, 0, 1)), (CUBE,)),
    "broadcast": (lambda a: jnp.broadcast_to(a[:, None], (5, 3)) * 2.0, (V,)),
    "singletons": (lambda a, b: a[:, :1] * b[:1] + a, (A, A)),
    "slice": (lambda a: a[1:3, ::2] + a[:2, 1::2], (A,)),
    "rev": (lambda a: a[::-1, ::-1], (A,)),
    "pad": (lambda a: lax.pad(a, 0.5, ((1, -1, 2), (0, 2, 0))), (A,)),
    "concatenate": (lambda a: jnp.concatenate([a, a[:, :1], a[:, 2:]], axis=1), (A,)),
    "stack": (lambda a: jnp.stack([a, 2 * a], axis=1), (A,)),
    "unstack": (lambda a: [r * 2 for r in jnp.unstack(a, axis=1)][::2], (A,)),
    "split": (lambda a: jnp.split(a, [1, 3], axis=1), (A,)),
    "iota": (lambda a: a + jnp.arange(5) * 1.0 + lax.broadcasted_iota(jnp.float64, (3, 5), 0), (V,)),
    "gather": (lambda a, i: a[i], (A, np.array([0, 2, 2, -1]))),
    "pairs": (lambda a, i: a[i, jnp.abs(i)], (A, np.array([0, 2, -1]))),
    "filled": (lambda a, i: a.at[i].get(mode="fill", fill_value=NAN), (A, np.array([0, 7, -9]))),
    "clipped": (lambda a, i: a.at[i].get(mode="clip"), (A, np.array([0, 7, -9]))),
    "set": (lambda a, i: a.at[i].set(1.0), (V, np.array([0, 7, 3]))),
    "scatter_add": (lambda a, i: a.at[i].add(V[:4]), (V, np.array([0, 3, 3, 9]))),
    "scatter_max": (lambda a, i: a.at[i].max(0.1), (V, np.array([0, 3, 3, -1]))),
    "scatter_mul": (lambda a, i: a.at[:, i].multiply(2.0), (A, np.array([1, 1]))),
    "block": (lambda a, i: lax.dynamic_slice(a, (i, i), (2, 2)), (A, np.int64(2))),
    "update": (lambda a, i: lax.dynamic_update_slice(a, a[:2, :2], (i, 0)), (A, np.int64(5))),
    "sum": (lambda a: (a.sum(), a.sum(0), a.sum((0, 2)), a.prod(1)), (CUBE,)),
    "extremes": (lambda a: (a.max(), a.min(1), a.argmax(0), a.argmin(1)), (A,)),
    "extremes_nan": (lambda a: (a.max(), a.min(), a.argmax(), a.argmin()), (np.array([1.0, NAN, 3.0]),)),
    "logic": (lambda a: (jnp.any(a > 1, 0), jnp.all(a > -9)), (A,)),
    "cumulate": (lambda a: (jnp.cumsum(a, 0), jnp.cumprod(a, 1), lax.cummax(a, 0), lax.cummin(a, 0, True)), (A,)),
    "sort": (lambda a: (jnp.sort(a), jnp.argsort(a)), (np.array([3.0, -1.0, NAN, 2.0, -1.0]),)),
    "empty": (lambda a: (a * 2, a.sum(), jnp.concatenate([a, a]), a[:, None] @ a[None]), (np.zeros(0),)),
    "one": (lambda a: (a * a[0], a.reshape(()), a.reshape(1, 1) + 1, a.sum()), (np.ones(1),)),
    "solve": (jnp.linalg.solve, (SQUARE, V[:4])),
    "solve_transposed": (lambda a, b: jax.vjp(lambda b: jnp.linalg.solve(a, b), b)[1](b), (SQUARE, V[:4])),
    "inverse": (jnp.linalg.inv, (SQUARE,)),
    "determinant": (jnp.linalg.det, (SQUARE,)),
    "cholesky": (lambda a: jnp.linalg.cholesky(a @ a.T), (SQUARE,)),
    "qr": (jnp.linalg.qr, (matrix(5, 3),)),
    "qr_wide": (jnp.linalg.qr, (A,)),
    "least_squares": (lambda a, b: jax.scipy.linalg.solve_triangular(a, b, trans=1), (np.tril(SQUARE).T, V[:4])),
    "while": (lambda x: lax.while_loop(lambda c: c[1] < 5, lambda c: (c[0] * 1.5, c[1] + 1), (x, 0)), (V,)),
    "cond": (lambda x, k: lax.switch(k, [jnp.sin, jnp.cos, lambda x: x], x), (V, np.int64(7))),
    "scan": (lambda x: lax.scan(lambda c, x: (c + x, c * x), 0.5, x), (V,)),
    "scan_back": (lambda x: lax.scan(lambda c, r: (c + r[0], r * c), 0.5, x, reverse=True), (A,)),
    "gradient": (jax.grad(lambda x: lax.scan(lambda c, x: (jnp.tanh(c + x), None), 0.5, x)[0]), (V,)),
    "long": (lambda x: jnp.where(x > 0, jnp.sqrt(jnp.abs(x)), x**2).reshape(50, 2) @ jnp.ones((2, 3)), (matrix(100),)),
    "constant": (lambda x: x * jnp.asarray(V) + jnp.asarray(matrix(5, seed=9)) @ x, (V,)),
    "same": (lambda x: (x, x, 1.0, x.reshape(5, 1)), (V,)),
    "called_twice": (lambda x: big(x) + big(2 * x), (V,)),
}


@jax.jit
def big(x):
    """A function with more operations than are put in place."""
    for k in range(20):
        x = jnp.sin(x) + k * x[::-1]
    return x


def table(dtype):
    """The functions, with edge values in one precision."""
    with np.errstate(over="ignore"):  # the largest numbers of double precision are infinite in single
        edges = np.array(EDGES, dtype)
        given = {name: (function, (edges,)) for name, function in UNARY.items()}
        given |= {name: (function, grid(EDGES, dtype)) for name, function in BINARY.items()}
    return given


def compared(functions, folder, rtol, **options):
    functions = {f"of_{name}": entry for name, entry in functions.items()}  # some are keywords of C
    found = in_c(functions, folder, **options)
    given = {name: given for name, (_, given) in functions.items()}
    expected = jax.jit(lambda all_given: {name: functions[name][0](*own) for name, own in all_given.items()})(given)
    # Compiled without optimization, XLA's cube root of 1e-100 is off by 1.3e-14.
    expected |= {name: np.cbrt(*given[name]) for name in given if name == "of_cbrt"}
    for name, own in given.items():
        agree(found[name](*own), expected[name], rtol, name)


@pytest.fixture(autouse=True)
def promotion():
    with jax.numpy_dtype_promotion("standard"):
        yield


def test_primitives_at_edge_values(tmp_path):
    """Functions of the C library are right to some units in the last place, and so are those of XLA."""
    given = {name: (function, grid(INTEGERS, np.int32)) for name, function in OF_INTEGERS.items()}
    compared(table(np.float64) | given, tmp_path, 4e-15)


@pytest.mark.slow
def test_arrays_and_control_flow(tmp_path):
    compared(ARRAYS, tmp_path, 1e-12)


@pytest.mark.slow
def test_single_precision(tmp_path):
    compared(table(np.float32), tmp_path, 2e-6)


def expression(rng, inputs, depth):
    """A random expression of arrays of five entries, finite where its inputs are."""
    if not depth:
        return inputs[rng.integers(len(inputs))]
    a, b = expression(rng, inputs, depth - 1), expression(rng, inputs, depth - 1)
    return (
        lambda x: a(x) + b(x), lambda x: a(x) * b(x), lambda x: a(x) - 0.5 * b(x),
        lambda x: jnp.tanh(a(x)) + b(x)[::-1],
        lambda x: jnp.where(a(x) > b(x), a(x), b(x)), lambda x: a(x) / (1.0 + b(x) ** 2),
        lambda x: jnp.sin(a(x)) * b(x),
        lambda x: jnp.cumsum(a(x)) - b(x), lambda x: a(x)[jnp.array([4, 0, 0, 2, 1])] + b(x),
        lambda x: jnp.concatenate([a(x)[:2], b(x)[2:]]), lambda x: jnp.outer(a(x), b(x)) @ (a(x) / 10.0),
        lambda x: a(x).at[jnp.array([1, 1, 3])].add(b(x)[:3]), lambda x: jnp.exp(-jnp.abs(a(x))) + jnp.max(b(x)),
    )[rng.integers(13)]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("derivative", ["value", "forward", "reverse"])
def test_random_expressions(tmp_path, derivative):
    rng = np.random.default_rng(7)
    leaves = [lambda x: x, lambda x: x * 0.5 + 1.0, lambda x: jnp.ones(5) * x[0], lambda x: jnp.arange(5) * 0.1 + 0 * x]
    functions = {}
    for k in range(100):
        f = expression(rng, leaves, 4)
        made = {
            "value": f,
            "forward": lambda x, f=f: jax.jvp(f, (x,), (x,))[1],
            "reverse": lambda x, f=f: jax.vjp(f, x)[1](jnp.cos(x))[0],
        }
        functions[f"e{k}"] = (made[derivative], (rng.normal(size=5),))
    found = in_c(functions, tmp_path)
    for name, (function, given) in functions.items():
        expected = np.asarray(jax.jit(function)(*given))
        scale = np.abs(expected).max() + 1e-300
        np.testing.assert_allclose(found[name](*given)[0] / scale, expected / scale, atol=1e-10, err_msg=name)


def test_what_c_cannot_is_refused():
    def host(x):
        return jax.pure_callback(np.sin, jax.ShapeDtypeStruct((), x.dtype), x)

    def program(f, *given):
        return program_in_c({"f": jax.make_jaxpr(f)(*given)})

    with pytest.raises(
        ModelError, match=r"calls the host \(JAX primitive 'pure_callback'\).*test_c_code.py:\d+, in .*host"
    ):
        program(host, 1.0)
    with pytest.raises(ModelError, match="no C code for the JAX primitive 'igamma'.*test_c_code.py"):
        program(lambda x: special.gammainc(x, 2.0), 1.0)
    with pytest.raises(ModelError, match="numbers of type complex128"):
        program(lambda x: jnp.abs(x * 1j), 1.0)
    with pytest.raises(ModelError, match="inside jit"):
        jax.jit(lambda x: program(lambda y: x * y, 1.0) and x)(1.0)


def test_the_same_program_gives_the_same_text():
    def f(x):
        return big(x) + big(2 * x) + jnp.asarray(V)

    texts = [program_in_c({"f": jax.make_jaxpr(lambda x: f(x))(V)})[0] for _ in range(2)]
    assert texts[0] == texts[1]
    assert texts[0].count("static void") == 2  # `big` is written once


def test_what_is_known_or_done_is_not_computed(tmp_path):
    """Places of gathers are tables, equal values are computed once, arrays that nobody reads any more are changed in
    place, and equal numbers have no table."""
    places = jnp.array([4, -1, 0])

    def f(x):
        twice = jnp.sin(x) + jnp.sin(x)
        changed = jnp.zeros(40).at[places].add(x[places]).at[places + 1].set(twice[jnp.array([1, 2, 3])])
        return changed * 2.0, jnp.stack([x, -x])[jnp.array([[1, 0], [0, 1]]), jnp.array([2, 3])]

    text, _ = program_in_c({"f": jax.make_jaxpr(f)(V)})
    assert text.count("sin(") == 1 and "40 * sizeof" not in text and " < 0 ? 0 :" not in text
    assert "static const double" not in text
    agree(in_c({"f": (f, (V,))}, tmp_path)["f"](V), f(V), 1e-15)
