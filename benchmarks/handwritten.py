r"""The planar pendulum written by hand in Diffrax: what generated models are measured against.

The bob is held on a circle of length $L$ and may be pushed by a force per mass
$N(v)$, learned or given ($g$ along $-y$, angles from the $+x$ axis):

$$\dot r = v, \qquad \dot v = -\frac{2\lambda}{m} r + g + N(v), \qquad
0 = |r|^2 - L^2,$$

so that differentiating the constraint twice gives

$$\frac{2\lambda}{m} L^2 = |v|^2 - g y + r \cdot N .$$

Three models, each as fast as we know how to write it:

- the *reduced* model, the reference tutorial's: states $(v_x, x)$ on the chart $y < 0$;
- the *Cartesian* model: states $(x, y, v_x, v_y)$, projected back onto the circle after
  every step, so that it holds for full swings;
- `angle_solution`: one angle, no constraint, integrated by SciPy to thirteen digits.
  It shares nothing with the other two and judges them.

In the first two the component axis comes first and every expression is elementwise
beyond it: one vector field serves a single bob, shape `(4,)`, and many, `(4, batch)`.

Importing this module changes no setting of JAX. All figures are for float64: call
`jax.config.update("jax_enable_x64", True)` first, as `main` does.
"""

import functools
import operator
import time
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import scipy.integrate
import scipy.special
from jaxtyping import Array, ArrayLike, Float

GRAVITY = 9.81  # m/s²
RELEASE = -1.2  # rad from the +x axis
HORIZONS = (0.5, 1.0, 1.5)  # s
SAMPLE_TIMES = tuple(np.linspace(0.0, 6.0, 201)[1:].tolist())  # s
DRAG = 0.5  # 1/m, drag per mass
RTOL = 1e-7
ATOL = 1e-9

# The default adjoint keeps about sqrt(2 max_steps) checkpoints. On CPU that number is
# worth choosing. The tutorial's solve, of 42 steps, gives its gradient in 0.32 ms with up
# to 32 checkpoints, but in 0.6 ms from about 40 on, though nothing is recomputed then
# (512 steps: 30 checkpoints; Diffrax's default of 4096 steps: 89). The longer solve of
# the 200 samples, of 185 steps, is fastest with a checkpoint for every step.
MAX_STEPS = 512
SAMPLE_CHECKPOINTS = 200

Injection = Literal["row", "equation"]
Correction = Callable[[Array, Any], Array]
Times = Array | np.ndarray | Sequence[float]


#
# Learned and given forces per mass
#


def tutorial_weights() -> Float[Array, "19"]:
    """The tutorial's initial weights, drawn and ravelled as it does (W1, W2, b1, b2)."""
    _require_x64()
    key1, key2 = jax.random.split(jax.random.PRNGKey(0))
    w1 = 0.5 * jax.random.normal(key1, (6, 1))
    w2 = 0.1 * jax.random.normal(key2, (1, 6))
    return jnp.concatenate([w1[:, 0], w2[0], jnp.zeros(6), jnp.zeros(1)])


def tutorial_network(vx: Float[Array, ""], weights) -> Float[Array, ""]:
    """The tutorial's 1 → 6 → 1 tanh network, fastest for one bob.

    No matrix products: so XLA fuses it into the arithmetic around it.
    """
    w1, w2, b1, b2 = weights[:6], weights[6:12], weights[12:18], weights[18]
    return jnp.sum(w2 * jnp.tanh(w1 * vx + b1)) + b2


def tutorial_network_unrolled(vx: Float[Array, "*b"], weights) -> Float[Array, "*b"]:
    """The same network unit by unit, fastest for many: no axis but the batch's is left."""
    w1, w2, b1, b2 = weights[:6], weights[6:12], weights[12:18], weights[18]
    units = (w2[i] * jnp.tanh(w1[i] * vx + b1[i]) for i in range(6))
    return functools.reduce(operator.add, units, b2)


def tutorial_drag(vx: Float[Array, "*b"], weights) -> Float[Array, "*b"]:
    """What the tutorial's network is to find: drag on the horizontal velocity alone."""
    del weights
    return -DRAG * vx * jnp.abs(vx)


def horizontal(correction: Correction) -> Correction:
    """A correction of `vx` as a force per mass on the Cartesian model."""

    def force(v, weights):
        n = correction(v[0], weights)
        return jnp.stack([n, jnp.zeros_like(n)])

    return force


def quadratic_drag(v: Float[Array, " 2 *b"], weights) -> Float[Array, " 2 *b"]:
    """Drag on both velocities, $-c |v| v$."""
    del weights
    # `where` keeps the derivative of the norm finite at rest.
    square = v[0] ** 2 + v[1] ** 2
    moving = square > 0
    speed = jnp.where(moving, jnp.sqrt(jnp.where(moving, square, 1.0)), 0.0)
    return -DRAG * speed * v


class VelocityNetwork(NamedTuple):
    """Weights of a 2 → 8 → 8 → 2 tanh network of the velocity (114 numbers)."""

    w1: Float[Array, "8 2"]
    w2: Float[Array, "8 8"]
    w3: Float[Array, "2 8"]
    b1: Float[Array, "8"]
    b2: Float[Array, "8"]
    b3: Float[Array, "2"]


def velocity_weights(seed: int = 0) -> VelocityNetwork:
    """Draws a `VelocityNetwork` at the tutorial's scales: 0.5 hidden, 0.1 last, no bias."""
    _require_x64()
    key1, key2, key3 = jax.random.split(jax.random.PRNGKey(seed), 3)
    return VelocityNetwork(
        0.5 * jax.random.normal(key1, (8, 2)),
        0.5 * jax.random.normal(key2, (8, 8)),
        0.1 * jax.random.normal(key3, (2, 8)),
        jnp.zeros(8),
        jnp.zeros(8),
        jnp.zeros(2),
    )


def velocity_network(v: Float[Array, " 2 *b"], weights: VelocityNetwork) -> Float[Array, " 2 *b"]:
    """A force per mass learned from the velocity: `(vx, vy)` to `(ax, ay)`."""
    expand = (...,) + (None,) * (v.ndim - 1)

    def layer(w, b, h):
        return jnp.sum(w[expand] * h, axis=1) + b[expand]

    h = jnp.tanh(layer(weights.w1, weights.b1, v))
    h = jnp.tanh(layer(weights.w2, weights.b2, h))
    return layer(weights.w3, weights.b3, h)


#
# Solvers
#


class UnrolledTsit5(diffrax.Tsit5):
    """Tsit5 with its seven stages written out, for states that are one array.

    Diffrax loops over the stages and scatters each slope into a buffer. For one small
    state that is as good or, in reverse mode, better; under `vmap` and in forward mode
    it takes half of the time. Differs from `diffrax.Tsit5` by rounding alone.
    Discontinuities (`made_jump`) are not provided for: there are none here.
    """

    def init(self, terms, t0, t1, y0, args):  # pyright: ignore
        return terms.vf(t0, y0, args)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):  # pyright: ignore
        del made_jump
        tableau = self.tableau
        control = terms.contr(t0, t1)
        y1 = y0
        slope = solver_state  # first same as last
        k = [terms.prod(slope, control)]
        for a, c in zip(tableau.a_lower, tableau.c, strict=True):
            y1 = y0 + _combine(a, k)
            slope = terms.vf(t0 + float(c) * (t1 - t0), y1, args)
            k.append(terms.prod(slope, control))
        y_error = _combine(tableau.b_error, k)
        dense_info = dict(y0=y0, y1=y1, k=jnp.stack(k))
        return y1, y_error, dense_info, slope, diffrax.RESULTS.successful


def _combine(coefficients: np.ndarray, k: list[Array]) -> Array:
    terms = [float(c) * ki for c, ki in zip(coefficients, k, strict=True) if c != 0]
    return functools.reduce(operator.add, terms)


class ProjectedTsit5(diffrax.Tsit5):
    """Tsit5 that puts position and velocity back on the circle after every step.

    The projection moves the state by no more than the step's error, so the last slope is
    kept as the next step's first (first same as last): recomputing it would buy one more
    order of a term already below the tolerance, for one stage in seven.
    """

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):  # pyright: ignore
        y1, *rest = super().step(terms, t0, t1, y0, args, solver_state, made_jump)
        _, length = args
        return project(y1, length), *rest


class ProjectedUnrolledTsit5(ProjectedTsit5, UnrolledTsit5):
    """`ProjectedTsit5` with `UnrolledTsit5`'s stages."""


def project(state: Float[Array, " 4 *b"], length: ArrayLike = 1.0) -> Float[Array, " 4 *b"]:
    """The nearest point of the circle, and the velocity's part along its tangent."""
    x, y, vx, vy = state
    scale = length / jnp.sqrt(x * x + y * y)
    x, y = scale * x, scale * y
    radial = (x * vx + y * vy) / (length * length)
    return jnp.stack([x, y, vx - radial * x, vy - radial * y])


#
# The reduced model: (vx, x)
#


def reduced_field(correction: Correction, injection: Injection) -> Callable:
    """The vector field of `(vx, x)`, for `diffrax.ODETerm`, with `args = (weights, length)`.

    **Arguments:**

    - `correction`: `(vx, weights)` to a force per mass on `vx`, in m/s².
    - `injection`: `"equation"` for a force that the rod's tension answers to; `"row"` for
        the tutorial's meaning, a term added to the finished right-hand side, which the
        tension does not know of.

    **Raises:** `ValueError` for another `injection`.
    """
    if injection not in ("row", "equation"):
        raise ValueError(f"injection must be 'row' or 'equation', but got {injection!r}.")

    def field(t, state, args):
        del t
        weights, length = args
        vx, x = state
        y = -jnp.sqrt(length * length - x * x)
        vy = -x * vx / y
        n = correction(vx, weights)
        twice_lam = vx * vx + vy * vy - GRAVITY * y
        if injection == "equation":
            twice_lam = twice_lam + x * n
        return jnp.stack([n - twice_lam * x / (length * length), vx])

    return field


def reduced_model(
    weights: Any,
    ts: Times = HORIZONS,
    angle: Float[ArrayLike, "*b"] = RELEASE,
    correction: Correction = tutorial_network,
    injection: Injection = "row",
    *,
    length: float = 1.0,
    rtol: float = RTOL,
    atol: float = ATOL,
    solver: diffrax.AbstractSolver | None = None,
    adjoint: diffrax.AbstractAdjoint | None = None,
    max_steps: int = MAX_STEPS,
) -> diffrax.Solution:
    """Releases the bob from rest and follows `(vx, x)`, as long as it stays below the pivot.

    **Arguments:**

    - `weights`: what `correction` takes.
    - `ts`: increasing times in s at which to save.
    - `angle`: in rad, inside (−π, 0). An array gives one solve of a `(2, batch)` state in
        lockstep, with the step size chosen by the worst member.
    - `correction`, `injection`: see `reduced_field`.
    - `length`: in m.

    **Returns:** the Diffrax solution; `ys` has shape `(len(ts), 2, *batch)`.
    """
    angle = jnp.asarray(angle, float)
    x = length * jnp.cos(angle)
    return _solve(
        reduced_field(correction, injection),
        jnp.stack([jnp.zeros_like(x), x]),
        (weights, length),
        jnp.asarray(ts, float),
        None,
        diffrax.Tsit5() if solver is None else solver,
        rtol,
        atol,
        adjoint,
        max_steps,
    )


def tutorial_truth(injection: Injection = "row", rtol: float = RTOL, atol: float = ATOL) -> Float[Array, "3 2"]:
    """`(vx, x)` with drag at the three horizons: the tutorial's training data."""
    solution = reduced_model(
        None,
        correction=tutorial_drag,
        injection=injection,
        rtol=rtol,
        atol=atol,
        max_steps=4096,
    )
    return _values(solution)


def tutorial_loss(
    theta: Float[Array, "19"],
    truth: Float[Array, "3 2"],
    injection: Injection = "row",
    **kwargs: Any,
) -> Float[Array, ""]:
    """The tutorial's loss: Σ over its horizons of |(vx, x) − truth|², from one solve.

    Further arguments go to `reduced_model`.
    """
    ys = _values(reduced_model(theta, injection=injection, **kwargs))
    return jnp.sum((ys - truth) ** 2)


def tutorial_value_and_grad_forward(
    theta: Float[Array, "19"],
    truth: Float[Array, "3 2"],
    injection: Injection = "row",
    **kwargs: Any,
) -> tuple[Float[Array, ""], Float[Array, "19"]]:
    """Value and gradient of `tutorial_loss` by nineteen tangents in one forward solve.

    With so few weights this beats reverse mode; it does not scale to larger networks.
    """
    kwargs = dict(solver=UnrolledTsit5(), adjoint=diffrax.ForwardMode()) | kwargs

    def residual(theta):
        ys = _values(reduced_model(theta, injection=injection, **kwargs))
        return ys - truth, ys - truth

    jacobian, value = jax.jacfwd(residual, has_aux=True)(theta)
    return jnp.sum(value**2), 2 * jnp.tensordot(value, jacobian, 2)


def tutorial_training(
    truth: Float[Array, "3 2"],
    injection: Injection = "row",
    steps: int = 25,
    learning_rate: float = 0.02,
) -> tuple[Float[Array, "19"], Float[np.ndarray, " steps"]]:
    """Adam on `tutorial_loss`, the whole step jitted.

    **Returns:** the last weights, and the loss before each update, as the tutorial prints it.
    """
    optimizer = optax.adam(learning_rate)

    @jax.jit
    def step(theta, state):
        loss, grad = jax.value_and_grad(tutorial_loss)(theta, truth, injection)
        update, state = optimizer.update(grad, state)
        return optax.apply_updates(theta, update), state, loss

    theta = tutorial_weights()
    state = optimizer.init(theta)
    losses = []
    for _ in range(steps):
        theta, state, loss = step(theta, state)
        losses.append(loss)
    return theta, np.array(losses)


#
# The Cartesian model: (x, y, vx, vy)
#


def cartesian_field(force: Correction) -> Callable:
    """The vector field of `(x, y, vx, vy)`, with `args = (weights, length)`.

    `force` takes `(v, weights)` to a force per mass, both of shape `(2, *batch)`.
    """

    def field(t, state, args):
        del t
        weights, _ = args
        x, y, vx, vy = state
        ax, ay = force(state[2:], weights)
        ay = ay - GRAVITY
        twice_lam = (vx * vx + vy * vy + x * ax + y * ay) / (x * x + y * y)
        return jnp.stack([vx, vy, ax - twice_lam * x, ay - twice_lam * y])

    return field


def full_model(
    weights: Any,
    ts: Times = SAMPLE_TIMES,
    angle: Float[ArrayLike, "*b"] = RELEASE,
    force: Correction = velocity_network,
    *,
    length: float = 1.0,
    rtol: float = RTOL,
    atol: float = ATOL,
    solver: diffrax.AbstractSolver | None = None,
    adjoint: diffrax.AbstractAdjoint | None = None,
    max_steps: int = MAX_STEPS,
) -> diffrax.Solution:
    """Releases the bob from rest at any angle and follows it through full swings.

    **Arguments:**

    - `weights`: what `force` takes.
    - `ts`: increasing times in s at which to save.
    - `angle`: in rad. An array gives one solve of a `(4, batch)` state in lockstep.
    - `force`: see `cartesian_field`.
    - `length`: in m.
    - `solver`: `ProjectedTsit5()` unless told; another one gets no projection.

    **Returns:** the Diffrax solution; `ys` has shape `(len(ts), 4, *batch)` and lies on the
    constraint, interpolated samples included.
    """
    angle = jnp.asarray(angle, float)
    zero = jnp.zeros_like(angle)
    y0 = jnp.stack([length * jnp.cos(angle), length * jnp.sin(angle), zero, zero])
    return _solve(
        cartesian_field(force),
        y0,
        (weights, length),
        jnp.asarray(ts, float),
        lambda t, y, args: project(y, args[1]),
        ProjectedTsit5() if solver is None else solver,
        rtol,
        atol,
        adjoint,
        max_steps,
    )


def full_loss(
    weights: Any,
    truth: Float[Array, "times 2"],
    ts: Times = SAMPLE_TIMES,
    **kwargs: Any,
) -> Float[Array, ""]:
    """The mean over the samples of |(x, y) − truth|², in m².

    Further arguments go to `full_model`.
    """
    kwargs = {"adjoint": diffrax.RecursiveCheckpointAdjoint(SAMPLE_CHECKPOINTS)} | kwargs
    ys = _values(full_model(weights, ts, **kwargs))
    return jnp.mean(jnp.sum((ys[:, :2] - truth) ** 2, axis=1))


#
# Batches
#


def rollouts(
    angles: Float[Array, " batch"],
    weights: Float[Array, "19"],
    model: Literal["reduced", "cartesian"] = "reduced",
    batching: Literal["vmap", "lockstep"] = "vmap",
    ts: Times = HORIZONS,
    **kwargs: Any,
) -> Float[Array, "batch times state"]:
    """Rollouts over release angles, the tutorial's network as a true horizontal force.

    **Arguments:**

    - `angles`: in rad. The reduced model wants them inside its chart, say −1.2 to −0.6.
    - `weights`: the network's.
    - `model`: `"reduced"` follows `(vx, x)`, `"cartesian"` `(x, y, vx, vy)`. Both describe
        the same motion.
    - `batching`: `"vmap"` gives every member steps of its own, at the cost of selecting
        between old and new carry at every step until the slowest is done. `"lockstep"`
        solves the batch as one system with the worst member's step size: every member
        meets its tolerance, and it is faster as long as members are alike.
    - further arguments go to the model. What is not given is chosen for speed: unrolled
        stages and the unrolled network.

    **Returns:** the states at `ts`.
    """
    if model == "reduced":

        def solve(angle):
            options: dict[str, Any] = dict(
                correction=tutorial_network_unrolled,
                injection="equation",
                solver=UnrolledTsit5(),
            )
            return _values(reduced_model(weights, ts, angle, **(options | kwargs)))

    else:

        def solve(angle):
            options: dict[str, Any] = dict(
                force=horizontal(tutorial_network_unrolled),
                solver=ProjectedUnrolledTsit5(),
            )
            return _values(full_model(weights, ts, angle, **(options | kwargs)))

    if batching == "vmap":
        return jax.vmap(solve)(angles)
    return jnp.moveaxis(solve(angles), -1, 0)


def rollouts_loss(
    weights: Float[Array, "19"],
    angles: Float[Array, " batch"],
    truth: Float[Array, "batch times state"],
    **kwargs: Any,
) -> Float[Array, ""]:
    """The mean over members and times of |state − truth|². See `rollouts`."""
    ys = rollouts(angles, weights, **kwargs)
    return jnp.mean(jnp.sum((ys - truth) ** 2, axis=-1))


#
# The independent reference
#


class AngleSolution(NamedTuple):
    """Position in m, velocity in m/s, and the multiplier of
    $m \\dot v = -2 \\lambda r + m (g + N)$ in kg/s², at each time.
    """

    x: Float[np.ndarray, " times"]
    y: Float[np.ndarray, " times"]
    vx: Float[np.ndarray, " times"]
    vy: Float[np.ndarray, " times"]
    lam: Float[np.ndarray, " times"]


def angle_solution(
    theta0: float,
    omega0: float,
    ts: Times,
    g: float = GRAVITY,
    L: float = 1.0,
    *,
    m: float = 1.0,
    force: Callable[[float, float], tuple[float, float]] | None = None,
) -> AngleSolution:
    r"""Integrates $\ddot\theta = (-g\cos\theta + N_\theta) / L$ to thirteen digits.

    DOP853 at rtol 1e-13, restarted at every time asked for: its interpolant is of lower
    order than its steps.

    **Arguments:**

    - `theta0`, `omega0`: angle from the +x axis in rad, and its rate in rad/s, at 0 s.
    - `ts`: increasing times in s, none negative.
    - `g`, `L`, `m`: in m/s², m, kg.
    - `force`: the force per mass, `(vx, vy)` to `(Nx, Ny)`, in m/s². None unless given.
    """

    def acting(theta, omega):
        if force is None:
            return 0.0, 0.0
        return force(-L * np.sin(theta) * omega, L * np.cos(theta) * omega)

    def field(t, state):
        theta, omega = state
        nx, ny = acting(theta, omega)
        tangential = (ny - g) * np.cos(theta) - nx * np.sin(theta)
        return omega, tangential / L

    time, state, states = 0.0, np.array([theta0, omega0], float), []
    for t in np.asarray(ts, float):
        if t > time:
            solution = scipy.integrate.solve_ivp(field, (time, t), state, method="DOP853", rtol=1e-13, atol=1e-14)
            time, state = t, solution.y[:, -1]
        states.append(state)
    theta, omega = np.array(states).T
    x, y = L * np.cos(theta), L * np.sin(theta)
    vx, vy = -y * omega, x * omega
    nx, ny = np.array([acting(*s) for s in states]).T
    lam = m * (vx**2 + vy**2 - g * y + x * nx + y * ny) / (2 * L**2)
    return AngleSolution(x, y, vx, vy, lam)


def elliptic_angle(theta0: float, ts: Times, g: float = GRAVITY, L: float = 1.0) -> Float[np.ndarray, " times"]:
    """The closed form for a release from rest without forces (Jacobi's cd), in rad."""
    k = np.sin((theta0 + np.pi / 2) / 2)
    _, cn, dn, _ = scipy.special.ellipj(np.sqrt(g / L) * np.asarray(ts), k * k)
    return 2 * np.arcsin(k * cn / dn) - np.pi / 2


#
# The machinery
#


def _solve(field, y0, args, ts, save, solver, rtol, atol, adjoint, max_steps) -> diffrax.Solution:
    saveat = diffrax.SaveAt(ts=ts) if save is None else diffrax.SaveAt(ts=ts, fn=save)
    return diffrax.diffeqsolve(
        diffrax.ODETerm(field),
        solver,
        t0=0.0,
        t1=ts[-1],
        dt0=None,  # 0.01 s
        y0=y0,
        args=args,
        saveat=saveat,
        stepsize_controller=diffrax.PIDController(rtol, atol, norm=_worst_rms),
        adjoint=diffrax.RecursiveCheckpointAdjoint() if adjoint is None else adjoint,
        max_steps=max_steps,
    )


def _worst_rms(error: Float[Array, " state *b"]) -> Float[Array, ""]:
    # No gradient flows through step sizes, so none is needed at zero.
    return jnp.sqrt(jnp.max(jnp.mean(error**2, axis=0)))


def _values(solution: diffrax.Solution) -> Array:
    ys = solution.ys
    assert ys is not None
    return ys


def _require_x64() -> None:
    if not jax.config.jax_enable_x64:  # pyright: ignore
        raise RuntimeError(
            "These models are defined in float64, but JAX is set to float32. Call "
            'jax.config.update("jax_enable_x64", True) before anything else.'
        )


#
# Figures
#


class Timing(NamedTuple):
    """Seconds to trace and compile, for the first run, and for a run in the steady state."""

    compile: float
    first: float
    best: float
    median: float

    def __str__(self) -> str:
        return (
            f"compile {self.compile:5.2f} s | first {1e3 * self.first:9.3f} ms | "
            f"steady {1e3 * self.best:9.3f} ms (median {1e3 * self.median:9.3f} ms)"
        )


def measure(fn: Callable, *args: Any, seconds: float = 0.5) -> Timing:
    """Times `jax.jit(fn)(*args)`, with JAX's caches emptied before.

    The steady state is measured through the jitted function, as a training loop would
    call it, for about `seconds` and at least three calls.
    """
    jax.clear_caches()
    jitted = jax.jit(lambda *args: fn(*args))

    def run():
        start = time.perf_counter()
        jax.block_until_ready(jitted(*args))
        return time.perf_counter() - start

    start = time.perf_counter()
    jitted.lower(*args).compile()
    compiled = time.perf_counter() - start
    first = run()
    steady = [run()]
    end = time.perf_counter() + seconds
    while len(steady) < 3 or time.perf_counter() < end:
        steady.append(run())
    return Timing(compiled, first, min(steady), float(np.median(steady)))


def _worst(a, b) -> float:
    return float(np.max(np.abs(np.asarray(a) - np.asarray(b))))


def _report_tutorial(injection: Injection) -> None:
    truth = tutorial_truth(injection)
    converged = tutorial_truth(injection, 1e-12, 1e-14)
    theta = tutorial_weights()
    print(f"\nTutorial, {injection} injection")
    for t, (vx, x), fine in zip(HORIZONS, truth, converged, strict=True):
        print(f"  truth at {t} s: {vx:.8f}, {x:.8f} (converged {fine[0]:.8f}, {fine[1]:.8f})")
    if injection == "equation":
        drag = angle_solution(RELEASE, 0.0, HORIZONS, force=lambda vx, vy: (-DRAG * vx * abs(vx), 0.0))
        independent = np.stack([drag.vx, drag.x], axis=1)
        print(f"  converged truth less angle_solution: {_worst(converged, independent):.1e}")
    loss, grad = jax.jit(jax.value_and_grad(tutorial_loss), static_argnums=2)(theta, truth, injection)
    print(f"  initial loss {loss:.6e}, gradient norm {jnp.linalg.norm(grad):.6e}")
    forward = jax.jit(tutorial_value_and_grad_forward, static_argnums=2)
    _, grad_forward = forward(theta, truth, injection)
    print(f"  reverse less forward gradient: {_worst(grad, grad_forward):.1e}")
    _, losses = tutorial_training(truth, injection)
    shown = ", ".join(f"{step}: {losses[step - 1]:.6e}" for step in range(5, 26, 5))
    print(f"  Adam {shown}")
    steps = reduced_model(theta, injection=injection).stats["num_steps"]
    print(f"  {int(steps)} steps")

    def value(theta, truth):
        return tutorial_loss(theta, truth, injection)

    def forward_mode(theta, truth):
        return tutorial_value_and_grad_forward(theta, truth, injection)

    print("  loss           ", measure(value, theta, truth))
    print("  loss, gradient ", measure(jax.value_and_grad(value), theta, truth))
    print("  same, forward  ", measure(forward_mode, theta, truth))


def _report_full() -> None:
    print("\nCartesian with projection")
    ts = np.linspace(0.0, 20.0, 401)[1:]
    none = horizontal(lambda vx, _: jnp.zeros_like(vx))
    for angle in (np.pi / 6, RELEASE):
        theta = elliptic_angle(angle, ts)
        exact = angle_solution(angle, 0.0, ts)
        closed = np.stack([np.cos(theta), np.sin(theta)])
        solution = full_model(None, ts, angle, none, max_steps=4096)
        x, y, vx, vy = _values(solution).T
        energy = 0.5 * (vx**2 + vy**2) + GRAVITY * y
        print(
            f"  release at {angle:+.4f} rad, 20 s without force: "
            f"{int(solution.stats['num_steps'])} steps; "
            f"position error {_worst(jnp.stack([x, y]), closed):.1e} m, "
            f"energy drift {_worst(energy, GRAVITY * np.sin(angle)):.1e} J/kg, "
            f"|r|² − L² {_worst(x * x + y * y, 1.0):.1e}, r·v {_worst(x * vx + y * vy, 0):.1e}"
        )
        print(f"    angle_solution less elliptic functions: {_worst(exact[:2], closed):.1e} m")

    def drag(vx, vy):
        speed = np.hypot(vx, vy)
        return -DRAG * speed * vx, -DRAG * speed * vy

    exact = np.stack(angle_solution(RELEASE, 0.0, SAMPLE_TIMES, force=drag)[:4], axis=1)
    solution = full_model(None, force=quadratic_drag)
    print(
        f"  {len(SAMPLE_TIMES)} samples over {SAMPLE_TIMES[-1]} s with drag: "
        f"{int(solution.stats['num_steps'])} steps, "
        f"state less angle_solution {_worst(_values(solution), exact):.1e}"
    )
    weights, truth = velocity_weights(), jnp.asarray(exact[:, :2])
    loss, grad = jax.jit(jax.value_and_grad(full_loss))(weights, truth)
    direction = velocity_weights(1)
    slope = sum(jnp.vdot(a, b) for a, b in zip(grad, direction, strict=True))

    def shifted(distance):
        moved = jax.tree.map(lambda w, d: w + distance * d, weights, direction)
        return full_loss(moved, truth, rtol=1e-11, atol=1e-13, max_steps=8192)

    quotient = (shifted(1e-5) - shifted(-1e-5)) / 2e-5
    print(f"  network: loss {loss:.6e}; directional derivative {slope:.8e}, by tight differences {quotient:.8e}")
    print("  rollout        ", measure(lambda w: _values(full_model(w)), weights))
    print("  loss           ", measure(full_loss, weights, truth))
    print("  loss, gradient ", measure(jax.value_and_grad(full_loss), weights, truth))


def _report_rollouts(batch: int = 10_000) -> None:
    print(f"\n{batch:,} rollouts of {HORIZONS[-1]} s over release angles −1.2 … −0.6 rad")
    angles, weights = jnp.linspace(RELEASE, -0.6, batch), tutorial_weights()
    variants = {
        "reduced, vmap, nothing unrolled": dict(solver=diffrax.Tsit5(), correction=tutorial_network),
        "reduced, vmap": dict(),
        "reduced, lockstep": dict(batching="lockstep"),
        "Cartesian, vmap": dict(model="cartesian"),
        "Cartesian, lockstep": dict(model="cartesian", batching="lockstep"),
    }
    fine = rollouts(angles[::100], weights, rtol=1e-12, atol=1e-14, max_steps=8192)
    for name, options in variants.items():

        def forward(angles, weights, options=options):
            return rollouts(angles, weights, **options)

        def loss(weights, angles, truth, options=options):
            return rollouts_loss(weights, angles, truth, **options)

        ys = jax.jit(forward)(angles, weights)
        pair = ys[..., jnp.array([2, 0])] if ys.shape[-1] == 4 else ys
        print(f"  {name}: error of (vx, x) {_worst(pair[::100], fine):.1e}")
        print("    forward      ", measure(forward, angles, weights))
        truth = jnp.zeros_like(ys)
        print("    with gradient", measure(jax.value_and_grad(loss), weights, angles, truth))


def main() -> None:
    """Prints the parity figures and the timings of every model (three minutes)."""
    jax.config.update("jax_enable_x64", True)
    print(
        f"jax {jax.__version__} on {jax.devices()[0].platform}, "
        f"diffrax {diffrax.__version__}, equinox {eqx.__version__}"
    )
    _report_tutorial("row")
    _report_tutorial("equation")
    _report_full()
    _report_rollouts()


if __name__ == "__main__":
    main()
