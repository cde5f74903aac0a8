"""The ladder of methods: each rung is reached by a problem that defeats the one before, and finds a known root."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import pytest
from problems import compiled, component, pendulum
from sympy import Abs, Eq, atan

from jaxonomy_dae import Component, EqnEnv, InitializationError, ModelError, der, simulate
from jaxonomy_dae.run.start import initialize as initialization
from jaxonomy_dae.run.start.initialize import find_initial, is_consistent
from jaxonomy_dae.run.start.ladder import METHODS, find_root, looking
from jaxonomy_dae.run.start.sizes import Sizes

# x³ − 2x + 2 = 0 has one real root, by Cardano's formula; |F| has a local minimum at √(2/3), where F = 2 − (4/3)√(2/3).
CARDANO = -np.cbrt(1 + np.sqrt(19 / 27)) - np.cbrt(1 - np.sqrt(19 / 27))


def sizes(start, m) -> Sizes:
    return Sizes(jnp.ones(len(start)), jnp.maximum(1, jnp.abs(start)), jnp.zeros(m), jnp.zeros(m))


def climb(function, start, core="all"):
    """(root, method, residual) found from a start."""
    start = jnp.asarray(np.asarray(start, float))
    m = jax.eval_shape(function, start).shape[0]
    chosen = np.arange(start.shape[0]) if core == "all" and m >= start.shape[0] else None

    @jax.jit
    def climbed(x):
        found = find_root(looking(function), m, x, sizes(x, m), chosen)
        return found.x, found.method, jnp.abs(function(found.x)).max()

    x, method, residual = climbed(start)
    return np.asarray(x), METHODS[int(method)], float(residual)


@jax.jit
def climb_one(which, start):
    """The same for one of the functions of `ONE_UNKNOWN`, in a program that has all of them."""

    def function(x):
        return jax.lax.switch(which, list(ONE_UNKNOWN.values()), x)

    found = find_root(looking(function), 1, start, sizes(start, 1), np.arange(1))
    return found.x, found.method, jnp.abs(function(found.x)).max()


def freudenstein_roth(x):
    """Freudenstein & Roth (1963): root (5, 4); descent from (0.5, −2) ends in a local minimum at (11.41…, −0.8968…)."""
    a = -13 + x[0] + ((5 - x[1]) * x[1] - 2) * x[1]
    b = -29 + x[0] + ((x[1] + 1) * x[1] - 14) * x[1]
    return jnp.stack([a, b])


ONE_UNKNOWN = {
    "x - 3": lambda x: x - 3.0,
    "2x - 3": lambda x: 2 * x - 3.0,
    "arctan": jnp.arctan,
    "squares": lambda x: x**2 - 4.0,
    "cubic": lambda x: x**3 - 2 * x + 2,
    "fold": lambda x: x**3 - 3 * x + 4,
    "exponential": lambda x: x * jnp.exp(-x) + 1,
    "no root": lambda x: x**2 + 1,
    "log": jnp.log,
}
PROBLEMS = {
    "a consistent start": ("x - 3", [3.0], "the start was consistent", [3.0]),
    "affine": ("2x - 3", [0.0], "Newton", [1.5]),
    # The full step from 10 goes to −138 and diverges from there.
    "arctan, line search": ("arctan", [10.0], "Newton", [0.0]),
    "arctan, far away": ("arctan", [1000.0], "Newton", [0.0]),
    # x0² + x1² = 5 and x1 = x0 + 1: (1, 2) and (−2, −1). At x0 = −x1 the Jacobian is singular.
    "a singular start": (
        lambda x: jnp.stack([x[0] ** 2 + x[1] ** 2 - 5, x[0] - x[1] + 1]),
        [0.5, -0.5],
        "Levenberg–Marquardt",
        None,
    ),
    "a stationary start": ("squares", [0.0], "homotopy", None),  # the gradient of |F|² is zero: ±2
    "a local minimum": ("cubic", [2.0], "homotopy", [CARDANO]),
    "from the fold itself": ("fold", [1.0], "homotopy", None),  # F' = 0 there
    "the other side": ("exponential", [3.0], "homotopy", [-0.5671432904097838]),  # −Ω
    "two unknowns": (freudenstein_roth, [0.5, -2.0], "homotopy", [5.0, 4.0]),
    # Redundant rows that agree at the root alone.
    "redundant": (lambda x: jnp.stack([x[0] - 2, x[0] ** 3 + x[0] - 10]), [0.0], "Newton", [2.0]),
}


def climb_problem(function, start):
    if callable(function):
        return climb(function, start)
    which = list(ONE_UNKNOWN).index(function)
    x, method, residual = climb_one(np.int32(which), np.asarray(start))
    return np.asarray(x), METHODS[int(method)], float(residual)


# Without guesses, from zero, where all slopes of several equations vanish.
STATIONARY = {
    "squares": (lambda x: jnp.stack([x[0] ** 2 - 1, x[1] ** 2 - 4]), [1.0, 2.0]),
    "turbulent flows": (
        lambda x: jnp.stack([x[0] * jnp.abs(x[0]) - 3, x[1] * jnp.abs(x[1]) + 4, x[0] + x[1] - x[2]]),
        [np.sqrt(3), -2.0, np.sqrt(3) - 2],
    ),
}


@pytest.mark.parametrize("name", ["turbulent flows", pytest.param("squares", marks=pytest.mark.slow)])
def test_a_second_climb_where_nothing_is_known(name):
    """Every rung ended where it began: zero is nobody's guess, and the sizes of unknowns are tried as one."""
    function, root = STATIONARY[name]
    n, nothing = len(root), np.zeros(len(root))
    found = jax.jit(lambda x: find_root(looking(function), n, x, Sizes(*[jnp.zeros(n)] * 4), np.arange(n)).x)(nothing)
    np.testing.assert_allclose(found, root, rtol=1e-12)


@pytest.mark.parametrize("name", PROBLEMS)
def test_the_rung(name):
    function, start, method, root = PROBLEMS[name]
    x, used, residual = climb_problem(function, start)
    assert used == method
    assert residual <= 1e-12 * (1 + np.abs(x).max())  # where the ladder stops
    if root is not None:
        np.testing.assert_allclose(x, root, rtol=1e-12, atol=1e-12)


@jax.jit
def look_at_one(which, x):
    return looking(lambda x: jax.lax.switch(which, list(ONE_UNKNOWN.values()), x))(x)


SHARED = [name for name, (function, *_) in PROBLEMS.items() if not callable(function)]


@pytest.mark.parametrize("name", SHARED)
def test_outside_of_programs_the_rung_is_the_same(name):
    """Where values are known the ladder runs in NumPy, and must not lead elsewhere than the one in programs."""
    function, start, method, _ = PROBLEMS[name]
    which, start = np.int32(list(ONE_UNKNOWN).index(function)), np.asarray(start, float)
    known = Sizes(*map(np.asarray, sizes(start, 1)))
    with np.errstate(all="ignore"):
        found = find_root(lambda x: jax.device_get(look_at_one(which, x)), 1, start, known, np.arange(1))
    x, used, _ = climb_problem(function, start)
    assert METHODS[int(found.method)] == used == method
    assert isinstance(found.x, np.ndarray)
    np.testing.assert_allclose(found.x, x, rtol=1e-12, atol=1e-12)


def test_without_a_root_the_best_point_is_returned():
    x, used, residual = climb_problem("no root", [2.0])
    assert used == METHODS[-1]
    assert residual == pytest.approx(1.0, abs=1e-6)  # the least of x² + 1; |x| ≤ 1e-3 there
    # Two rows that contradict each other: the least-squares compromise.
    x, used, _ = climb(lambda x: jnp.stack([x[0] - 1, x[0] - 2]), [0.0], core=None)
    assert used == METHODS[-1] and x[0] == pytest.approx(1.5, abs=1e-5)


def test_a_start_that_is_not_finite_is_given_up_at_once():
    x, used, residual = climb_problem("log", [-1.0])
    assert used == METHODS[-1] and x[0] == -1.0 and np.isnan(residual)


@pytest.mark.slow
def test_members_of_a_batch_are_on_their_own_rungs():
    starts = np.array([[CARDANO], [-1.5], [2.0], [np.nan]])

    @jax.jit
    @jax.vmap
    def roots(start):
        found = find_root(looking(ONE_UNKNOWN["cubic"]), 1, start, sizes(start, 1), np.arange(1))
        return found.x, found.method

    x, method = roots(starts)
    assert [METHODS[int(k)] for k in method] == ["the start was consistent", "Newton", "homotopy", "none"]
    np.testing.assert_allclose(x[:3, 0], CARDANO, rtol=1e-12)


class Law(Component):
    """dx/dt = −z, where f(z) = p·x determines z."""

    def __init__(self, ev, name, law, p=0.0, z=2.0):
        super().__init__(ev, name)
        p = self.parameter("p", p)
        x = self.variable("x", start=1.0, fixed=True)
        z = self.variable("z", start=self.parameter("guess", z))
        self.add_equations(Eq(der(x), -z), Eq(law(z), p * x))


def cubic(z):
    return z**3 - 2 * z + 2


@pytest.mark.slow
@pytest.mark.parametrize(
    "law, guess, method, root",
    [(atan, 10.0, "Newton", 0.0), (cubic, 2.0, "homotopy", CARDANO)],
)
def test_a_models_own_equation(law, guess, method, root):
    system = compiled(Law(EqnEnv(), "c", law, z=guess))
    assert system.initialization_report().method == method
    assert float(system.observe("c.z", 0.0, system.initialize())) == pytest.approx(root, abs=1e-12)


@pytest.mark.parametrize("traced", [False, True], ids=["outside", "in a program"])
def test_what_nobody_guessed_follows_from_other_equations(traced):
    """A core whose permeability, permeance and reluctance nobody guessed: at zero the reluctance has no value. Without
    flux it is l/(µ0·1210·A)."""

    def saturating(core, ev):
        names = "flux", "iron", "leak", "density", "share", "mu", "permeance", "reluctance", "magnet"
        flux, iron, leak, density, share, mu, permeance, reluctance, magnet = map(core.variable, names)
        current, length = core.variable("current", start=0.0, fixed=True), core.parameter("length", 0.26)
        core.add_equations(
            Eq(flux, iron + leak), Eq(600 * current, magnet + 1.27e5 * iron), Eq(600 * current, 1.2e6 * leak),
            Eq(density, iron / 6.25e-4), Eq(share, Abs(density / 1.16)), Eq(magnet, iron * reluctance),
            Eq(mu, 1 + (1209 + 24630 * share) / (1 + 2.44 * share + share**14)),
            Eq(permeance, 1.25663706212e-6 * mu * 6.25e-4 / length), Eq(reluctance, 1 / permeance),
            Eq(600 * der(flux), 325 - 7.5 * current),
        )  # fmt: skip

    system = compiled(component(saturating))

    def start(length):
        point = simulate(system.with_parameters({"c.length": length}), 1e-6, ts=jnp.array([0.0]))
        return jnp.stack([point["c.reluctance"][0], point["c.flux"][0]])

    found = np.asarray((jax.jit(start) if traced else start)(0.26))
    np.testing.assert_allclose(found, [0.26 / (1.25663706212e-6 * 1210 * 6.25e-4), 0.0], rtol=1e-9, atol=1e-15)


@pytest.mark.slow
def test_gradients_are_exact_whichever_rung_found_the_point():
    system = compiled(Law(EqnEnv(), "c", cubic))

    @jax.jit
    @jax.value_and_grad
    def z(p):
        changed = system.with_parameters({"c.p": p})
        return changed.observe("c.z", 0.0, changed.initialize())

    value, slope = z(0.0)
    # dz/dp = x/(3z² − 2), x = 1, by the implicit function theorem.
    assert float(value) == pytest.approx(CARDANO, rel=1e-12)
    assert float(slope) == pytest.approx(1 / (3 * CARDANO**2 - 2), rel=1e-12)
    numeric = (float(z(1e-5)[0]) - float(z(-1e-5)[0])) / 2e-5
    assert float(slope) == pytest.approx(numeric, rel=1e-8)


@pytest.mark.slow
def test_one_member_that_fails_does_not_disturb_the_others():
    """z² = p − 1 at x = 1 has no solution for p < 1."""
    system = compiled(Law(EqnEnv(), "c", lambda z: z**2 + 1, p=2.0, z=3.0))
    p = np.array([2.0, 0.5, 5.0])

    def start(p):
        changed = system.with_parameters({"c.p": p})
        found = find_initial(changed, 0.0, None, None)
        return changed.observe("c.z", 0.0, found.x), is_consistent(found)

    def total(p):
        z, good = jax.vmap(start)(p)
        return z[0] + z[2], (z, good)

    (_, (z, good)), slope = jax.jit(jax.value_and_grad(total, has_aux=True))(p)
    np.testing.assert_allclose(np.asarray(z)[[0, 2]], [1.0, 2.0], rtol=1e-12)  # √(p − 1)
    assert good.tolist() == [True, False, True]
    np.testing.assert_allclose(slope, [1 / 2, 0.0, 1 / 4], rtol=1e-12, atol=1e-12)
    with pytest.raises(
        InitializationError,
        match=r"first:\n  c: 0 = -p\*x \+ z\*\*2 \+ 1  \(test_\w+\.py:\d+\), in c\.x, der\(c\.x\): off by",
    ):
        system.with_parameters({"c.p": 0.5}).initialize()


@pytest.mark.slow
def test_a_run_from_an_inconsistent_start_is_no_success():
    system = compiled(Law(EqnEnv(), "c", lambda z: z**2 + 1, p=2.0, z=3.0))

    @jax.jit
    @jax.vmap
    def run(p):
        solution = simulate(system.with_parameters({"c.p": p}), 0.1, ts=jnp.array([0.1]), throw=False)
        return solution["c.z"][0], diffrax.is_okay(solution.result)

    z, okay = run(jnp.array([2.0, 0.5, 5.0]))
    # z² = p·x − 1 and dx/dt = −z: z falls by p/2 per time, from √(p − 1).
    np.testing.assert_allclose(z[jnp.array([0, 2])], [1.0 - 0.1, 2.0 - 0.25], rtol=1e-6)
    assert okay.tolist() == [True, False, True]


@pytest.mark.filterwarnings("ignore:initial=")
@pytest.mark.parametrize(
    "solver", [optimistix.Dogleg, pytest.param(optimistix.LevenbergMarquardt, marks=pytest.mark.slow)]
)
def test_a_solver_of_the_users_own(solver):
    """y = −√(1 − x²) and its slope −x/y, by way of any Optimistix solver, loose tolerances included."""
    system, own = pendulum(), solver(rtol=1e-6, atol=1e-6)

    @jax.jit
    @jax.value_and_grad
    def height(x):
        return system.observe("pend.y", 0.0, system.initialize(initial={"pend.x": x, "pend.vx": 1.6}, solver=own))

    value, slope = height(0.6)
    assert float(value) == pytest.approx(-0.8, rel=1e-11)
    assert float(slope) == pytest.approx(0.75, rel=1e-9)


def test_what_is_not_a_solver_is_refused():
    with pytest.raises(ModelError, match=r"solver is an Optimistix root finder.*got 'lm'"):
        pendulum().initialize(solver="lm")


class Chain(Component):
    """Three pendula; the length of each rod but the first is 1 + λ/10, λ the multiplier of the rod before: index 7."""

    def __init__(self, ev, name, heights):
        super().__init__(ev, name)
        length = 1.0
        for k, height in enumerate(heights, 1):
            x, y = self.variable(f"x{k}", start=0.5), self.variable(f"y{k}", start=height, fixed=True)
            v, lam = self.variable(f"v{k}", start=0.0, fixed=True), self.variable(f"l{k}", start=9.0)
            self.add_equations(
                Eq(der(y), v), Eq(der(der(x)), -x * lam), Eq(der(v), 9.8 - y * lam), Eq(x**2 + y**2, length**2)
            )
            length = 1.0 + 0.1 * lam


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the start is far")
def test_a_chain_of_high_index_starts_one_block_after_the_other():
    """At rest λ₁ = g·y₁ and λ₁″ = 2|a|² + g·a_y, from λ₁ = |v|² + g·y₁; λ₂·L² = g·y₂ − L·L″ with L = 1 + λ₁/10."""
    g, y1, y2, y3 = 9.8, 0.9, 1.5, 0.5
    first = g * y1
    ax, ay = -first * np.sqrt(1 - y1**2), g - first * y1
    length, bend = 1 + 0.1 * first, 0.1 * (2 * (ax**2 + ay**2) + g * ay)
    second = (g * y2 - length * bend) / length**2
    system = compiled(Chain(EqnEnv(), "c", (y1, y2, y3)))
    x = system.initialize()
    names = ["c.x1", "c.l1", "c.x2", "c.l2", "c.x3"]
    expected = [np.sqrt(1 - y1**2), first, np.sqrt(length**2 - y2**2), second, np.sqrt((1 + 0.1 * second) ** 2 - y3**2)]
    np.testing.assert_allclose(system.observe(names, 0.0, x), expected, rtol=1e-12)


def test_climbing_again_comes_to_an_end():
    """Without a root, and with starts of further climbs at which nothing is finite."""

    def function(x):
        return jnp.stack([x[0] ** 2 + 1, x[1] ** 2 + 1]) + jnp.where(jnp.sum(x**2) > 0.25, jnp.nan, 0)

    method = jax.jit(lambda x: find_root(looking(function), 2, x, Sizes(*[jnp.zeros(2)] * 4), np.arange(2)).method)(
        np.zeros(2)
    )
    assert METHODS[int(method)] == "none"


class Cubics(Component):
    """x³ + y³ + x = r, y − x³ + y³ = 2·r, r' = −r."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        x, y, r = (self.variable(k, start=1.0) for k in "xyr")
        self.add_equations(Eq(x**3 + y**3 + x, r), Eq(y - x**3 + y**3, 2 * r), der(r) + r)


@pytest.mark.slow
def test_the_last_step_is_checked(monkeypatch):
    """The step that carries the derivative once went from a root to 1e272, unseen."""
    assert np.isfinite(compiled(Cubics(EqnEnv(), "sound")).initialize()).all()
    monkeypatch.setattr(initialization, "least_squares", lambda matrix, right: 1e3 + 0 * (right @ matrix))
    with pytest.raises(InitializationError, match="no consistent initial point"):
        compiled(Cubics(EqnEnv(), "broken")).initialize(initial={"broken.r": 2.0})


class Circle(Component):
    """A point that runs around the unit circle, x' = −y."""

    def __init__(self, ev, x0):
        super().__init__(ev, "c")
        x, y = self.variable("x", start=x0), self.variable("y", start=0.0)
        self.add_equations(Eq(x**2 + y**2, 1), Eq(der(x), -y))


@pytest.mark.slow
@pytest.mark.parametrize("x0", [1.3, 2.0])
def test_a_guess_beside_a_fold(x0):
    """The nearest point of the circle is (1, 0), where y has no slope: the search stopped in front of it, and the error
    said that no point was found. There, x as the only state does not tell which way y goes."""
    with pytest.raises(InitializationError, match=r"singular .*do not determine der\(c\.x\)"):
        compiled(Circle(EqnEnv(), x0)).initialize()
