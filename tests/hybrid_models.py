"""Models with events that several tests share."""

from sympy import Abs, sign, sqrt

from jaxonomy_dae import (
    AcausalCompiler,
    AcausalDiagram,
    AcausalSystem,
    Component,
    EqnEnv,
    assign,
    der,
    pre,
    reinit,
    terminate,
)
from jaxonomy_dae.write import Eq


def compiled(component: type, name: str, **arguments) -> AcausalSystem:
    ev, diagram = EqnEnv(), AcausalDiagram()
    diagram.add(component(ev, name, **arguments))
    return AcausalCompiler(ev, diagram)()


class Ball(Component):
    """A ball that bounces, and counts how often."""

    def __init__(self, ev, name, h0=1.0, e=0.8, g=9.81, stop=None):
        super().__init__(ev, name)
        restitution, gravity, height = self.parameter("e", e), self.parameter("g", g), self.parameter("h0", h0)
        h = self.variable("h", start=height, fixed=True)
        v = self.variable("v", start=0.0, fixed=True)
        n = self.discrete("n", start=0)
        self.add_equations(Eq(der(h), v), Eq(der(v), -gravity))
        self.when(h <= 0, reinit(v, -restitution * pre(v)), reinit(h, 0), assign(n, pre(n) + 1))
        if stop is not None:
            self.when(n >= self.parameter("stop", stop), terminate("bounced enough"))


class Thermostat(Component):
    def __init__(self, ev, name):
        super().__init__(ev, name)
        C, G = self.parameter("C", 1.0), self.parameter("G", 0.1)
        P, outside = self.parameter("P", 10.0), self.parameter("outside", 20.0)
        T = self.variable("T", start=20.0, fixed=True)
        q = self.variable("q")
        on = self.discrete("on", start=1)
        self.add_equations(Eq(C * der(T), q - G * (T - outside)), Eq(q, on * P))
        self.when(T < 49, assign(on, 1))
        self.when(T > 51, assign(on, 0))


class SampledPI(Component):
    """A lag of first order and a controller that sees it ten times a second."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        Kp, Ki = self.parameter("Kp", 2.0), self.parameter("Ki", 3.0)
        T, r = self.parameter("T", 0.1), self.parameter("r", 1.0)
        x = self.variable("x", start=0.0, fixed=True)
        u, total = self.discrete("u"), self.discrete("I")
        self.add_equations(Eq(der(x), -x + u))
        self.when(self.sampled(T), assign(u, Kp * (r - x) + pre(total)), assign(total, pre(total) + Ki * T * (r - x)))


class Stick(Component):
    """A mass pushed by a growing force against dry friction: it sticks until the force is large enough, slides, and
    sticks again when it has come to rest; written as an acceleration that is zero while it sticks."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        m, mu = self.parameter("m", 2.0), self.parameter("mu", 3.0)
        x = self.variable("x", start=0.0, fixed=True)
        v = self.variable("v", start=0.0, fixed=True)
        push = self.variable("push")
        mode = self.discrete("mode", start=0)
        force = 4 * (1 - (ev.t - 1) ** 2)
        self.add_equations(Eq(push, force), Eq(der(x), v), Eq(m * der(v), Abs(mode) * (push - mu * mode)))
        self.when(Abs(push) >= mu, assign(mode, sign(push)), on=Eq(mode, 0))
        self.when(mode * v <= 0, assign(mode, 0), reinit(v, 0), on=Eq(Abs(mode), 1))


class Commensurate(Component):
    """Clocks of 0.1, 0.2 and 0.3 s that read each other, the slower ones declared first."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        x = self.variable("x", start=0.0, fixed=True)
        self.add_equations(Eq(der(x), 1))
        a, b, c = (self.discrete(n) for n in ("a", "b", "slow"))
        self.when(self.sampled(0.2), assign(b, 100 * a + pre(b)))
        self.when(self.sampled(0.1), assign(a, pre(a) + 1))
        self.when(self.sampled(0.3), assign(c, pre(c) + pre(a) * 1000 + b))


class Counting(Component):
    """Counts how often its integral has grown by one, in steps of its rate."""

    def __init__(self, ev, name, rate=1.0):
        super().__init__(ev, name)
        r, n = self.parameter("rate", rate), self.discrete("n")
        x = self.variable("x", start=0.0, fixed=True)
        self.add_equations(Eq(der(x), r))
        self.when(x >= 1, reinit(x, 0), assign(n, pre(n) + r))


class Gear(Component):
    """A discrete variable as the parameter of a child, beside a child with its own."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        gain = self.discrete("gain", start=1.0)
        self.add(Counting(ev, "child", rate=2 * gain))
        self.add(Counting(ev, "other"))
        self.when(ev.t >= 1.25, assign(gain, 3.0))


class Twice(Component):
    """Two events with one condition."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        x = self.variable("x", start=0.0, fixed=True)
        k = self.discrete("k")
        self.add_equations(Eq(der(x), 1))
        self.when(x >= 1, reinit(x, 0))
        self.when(x >= 1, assign(k, pre(k) + 1))


class Doubling(Component):
    """A discrete variable that begins at 2·a and is doubled once a second, and its integral."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        a, x = self.parameter("a", 1.5), self.variable("x", start=0.0, fixed=True)
        y, d = self.variable("y", start=0.0, fixed=True), self.discrete("d", start=2 * a)
        self.add_equations(Eq(der(x), 1), Eq(der(y), d))
        self.when(x >= 1, reinit(x, 0), assign(d, 2 * pre(d)))


class Bob(Component):
    """A point on a string, written as equations."""

    def __init__(self, ev, name, L=1.0, v0=5.2):
        super().__init__(ev, name)
        L, v0, m, g = self.parameter("L", L), self.parameter("v0", v0), self.parameter("m", 2.0), 9.81
        x, y = self.variable("x", start=0.0, fixed=True), self.variable("y", start=-L, fixed=True)
        vx, vy = self.variable("vx", start=v0, fixed=True), self.variable("vy", start=0.0, fixed=True)
        pull = self.variable("pull")
        self.add_equations(
            Eq(der(x), vx), Eq(der(y), vy), Eq(m * der(vx), -pull * x), Eq(m * der(vy), -pull * y - m * g)
        )
        self.complementary(L - sqrt(x**2 + y**2), pull, "taut", order=2, start=1)
