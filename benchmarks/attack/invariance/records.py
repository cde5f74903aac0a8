"""Letters f and g: how records are written, and where a search began. Compared is all that a fit says: values,
intervals and their notes, noise levels, degrees of freedom, χ² and BIC.

The models are linear, of one or two states, so that a fit takes a fraction of a second; numbers of samples come from a
few, so that most draws share compiled programs.
"""

import functools
import zlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import sympy
from sympy import Eq

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, AcausalSystem, Component, EqnEnv, Interval, der, learning
from jaxonomy_dae.learning.gradient import Batches

from .said import Pairs, Said, said

ALIKE = 1e-6  # relative
TIGHT = {"rtol": 1e-10, "atol": 1e-12}
POSITIVE = Interval(0.0, np.inf, open_low=True)


class Decay(Component):
    """x' = −a·x + g·u, z' = x, and x in another unit, r = k·x. Nothing measured tells the two factors of g apart."""

    def __init__(self, ev: EqnEnv, name: str):
        super().__init__(ev, name)
        a, one = self.parameter("a", 1.0, bounds=POSITIVE), self.parameter("one", 0.6)
        other, k = self.parameter("other", 0.5), self.parameter("k", 1.0)
        u = self.input("u", default=0.0)
        x, z = (self.variable(n, start=s, fixed=True) for n, s in (("x", 1.0), ("z", 0.0)))
        r = self.variable("r")
        self.add_equations(Eq(der(x), -a * x + one * other * u), Eq(der(z), x), Eq(r, k * x))


class Static(Component):
    """y = p·u + q·sin s, of a clock s: a record may be cut anywhere."""

    def __init__(self, ev: EqnEnv, name: str):
        super().__init__(ev, name)
        p, q, u = self.parameter("p", 1.0), self.parameter("q", 1.0), self.input("u")
        s, y = self.variable("s", start=0.0, fixed=True), self.variable("y")
        self.add_equations(Eq(der(s), 1), Eq(y, p * u + q * sympy.sin(s)))


@functools.cache
def system_of(kind: type) -> AcausalSystem:
    """The compiled model of a class."""
    ev, diagram = EqnEnv(), AcausalDiagram()
    diagram.add(kind(ev, "c"))
    return AcausalCompiler(ev, diagram)()


# --- what is said ----------------------------------------------------------------------------------------------------


def facts(fit: Any, names: Mapping[str, str] | None = None) -> dict[str, Any]:
    """All that a fit says, with other names for what is estimated."""
    names = names or {}
    count = int(fit.objective.free.sum())
    samples = fit.minimum.weights.samples
    out: dict[str, Any] = {
        "freedom": fit.freedom, "chi2": fit.chi2, "bic": count * np.log(samples) - 2 * fit.log_likelihood,
    }  # fmt: skip
    out |= {f"sigma of {name}": value for name, value in fit.sigma.items()}
    for row in fit.table():
        name = names.get(row.name, row.name)
        known = row.note != "not determined"
        out |= {f"{name}, note": coded(row.note)}
        out |= {name: row.value, f"{name}, low": row.low, f"{name}, high": row.high} if known else {}
    return out | {"what is said": coded(*sorted(out))}


def coded(*texts: str) -> float:
    """A number that differs where texts do."""
    return float(zlib.crc32("|".join(texts).encode()))


def fitted(
    kind: type, records: Sequence[learning.Experiment], train: Sequence[str], names: Any = None, how: Any = None,
    **given: Any,
) -> Said:  # fmt: skip
    """What is said of a fit to records; `how` are arguments of `fit`."""
    problem = learning.Problem(system_of(kind), learning.Data(*records), train=train, **TIGHT | given)
    return said(lambda: facts(problem.fit(**how or {}), names))


# --- draws -----------------------------------------------------------------------------------------------------------


class Draw:
    """Records of a decay from a drawn truth, with noise; some noise levels are known, others not."""

    def __init__(self, rng: np.random.Generator):
        self.rng = rng
        self.a, self.noise = float(10 ** rng.uniform(-0.5, 0.5)), float(10 ** rng.uniform(-2.5, -1))
        self.level = "estimate" if rng.random() < 0.5 else self.noise * float(10 ** rng.uniform(-0.2, 0.2))
        self.both = bool(rng.random() < 0.5)  # outputs
        self.end = float(rng.uniform(1.0, 3.0))

    def record(self, n: int = 9, start: float = 1.0, driven: float = 0.0, **given: Any) -> learning.Experiment:
        ts = np.sort(self.rng.uniform(0.05, 1.0, n)) * self.end
        still = driven / self.a
        off = (start - still) * np.exp(-self.a * ts)
        truth = {"c.x": still + off, "c.z": still * ts + (start - still - off) / self.a}
        given = ({"inputs": {"c.u": 1.0}} if driven else {}) | given
        names = list(truth) if self.both else ["c.x"]
        data = {name: truth[name] + self.noise * self.rng.standard_normal(n) for name in names}
        return learning.Experiment(ts, data, **{"sigma": self.level, "initial": {"c.x": start, "c.z": 0.0}} | given)


def other(one: learning.Experiment, **changes: Any) -> learning.Experiment:
    """A copy of an experiment."""
    given = {name: getattr(one, name) for name in one.__dataclass_fields__}
    given["sigma"] = {n: "estimate" if np.isnan(s) else s for n, s in given["sigma"].items()}
    return learning.Experiment(**given | changes)


def padded(one: learning.Experiment, rng: np.random.Generator, beyond: bool) -> learning.Experiment:
    """The same samples with rows of NaN between them, and beyond the last."""
    more = rng.uniform(0.01, one.times[-1], 2)
    times = np.concatenate([one.times, more, [1.2 * one.times[-1]] if beyond else [more[0] / 2]])
    order = np.argsort(times)
    data = {name: np.concatenate([v, np.full(3, np.nan)])[order] for name, v in one.data.items()}
    return other(one, times=times[order], data=data)


# --- letter f --------------------------------------------------------------------------------------------------------

WAYS: dict[str, Callable[[Draw], tuple[Said, Said]]] = {}


def way(pair: Callable[[Draw], tuple[Said, Said]]) -> Callable[[Draw], tuple[Said, Said]]:
    """Registers a way of writing records differently."""
    WAYS[pair.__name__.replace("_", " ")] = pair
    return pair


def method_of(draw: Draw, shooting: bool = False) -> dict[str, Any]:
    """Runs, or a filter, or multiple shooting; all with the same trained names."""
    if draw.rng.random() < 0.3:
        return {"method": learning.Filter({"c.x": 0.03})}
    return {"method": learning.Shooting(nodes=2)} if shooting and draw.rng.random() < 0.2 else {}


@way
def weight(draw: Draw) -> tuple[Said, Said]:
    one, beside = draw.record(), draw.record(6, start=0.7, name="beside")
    given = method_of(draw)
    heavy = fitted(Decay, [other(one, weight=3.0), beside], ["c.a"], **given)
    return heavy, fitted(Decay, [*(other(one, name=f"{k}") for k in range(3)), beside], ["c.a"], **given)


@way
def rows_of_nan(draw: Draw) -> tuple[Said, Said]:
    one, given = draw.record(), method_of(draw, shooting=False)
    return fitted(Decay, [one], ["c.a"], **given), fitted(Decay, [padded(one, draw.rng, True)], ["c.a"], **given)


@way
def order(draw: Draw) -> tuple[Said, Said]:
    given = method_of(draw, shooting=True)
    records = [draw.record(n, start=s, name=f"{k}") for k, (n, s) in enumerate([(9, 1.0), (6, 0.7), (4, -0.4)])]
    mixed = [records[k] for k in draw.rng.permutation(3)]
    return fitted(Decay, records, ["c.a"], **given), fitted(Decay, mixed, ["c.a"], **given)


@way
def cut(draw: Draw) -> tuple[Said, Said]:
    """A record of a model without memory, in one piece or in two that continue each other."""
    rng, n = draw.rng, 12
    ts = np.arange(1, n + 1) / 4
    u = rng.standard_normal(n)
    y = 0.8 * u + 0.3 * np.sin(ts) + draw.noise * rng.standard_normal(n)
    inputs = {"c.u": (np.concatenate([[0.0], ts]), np.concatenate([[0.0], u]), "linear")}

    def part(rows: slice, t0: float, name: str) -> learning.Experiment:
        return learning.Experiment(
            ts[rows], {"c.y": y[rows]}, sigma=draw.level, inputs=inputs, initial={"c.s": t0}, t0=t0, name=name
        )

    at = int(rng.choice([4, 8]))
    whole, parts = part(slice(None), 0.0, "whole"), [part(slice(at), 0.0, "1"), part(slice(at, None), ts[at - 1], "2")]
    return fitted(Static, [whole], ["c.p", "c.q"]), fitted(Static, parts, ["c.p", "c.q"])


@way
def outputs_apart(draw: Draw) -> tuple[Said, Said]:
    draw.both = True
    one = draw.record()
    apart = [other(one, data={n: v}, sigma={n: one.sigma[n] if draw.level != "estimate" else "estimate"}, name=n)
             for n, v in one.data.items()]  # fmt: skip
    return fitted(Decay, [one], ["c.a"]), fitted(Decay, apart, ["c.a"])


@way
def together_or_alone(draw: Draw) -> tuple[Said, Said]:
    """Experiments of several lengths that share nothing, with a sensor law that reads all of its record."""
    draw.level = draw.noise
    draw.both = False
    own = {"c.x": 1.0, "c.z": 0.0, "c.a": learning.Unknown(1.0)}
    records = [draw.record(n, name=f"{n}", initial=own) for n in (9, 6)]
    if draw.rng.random() < 0.5:
        given: dict[str, Any] = {}
    else:
        given = {"observe": {"mean": lambda solution: solution["c.x"] - solution["c.x"].mean()}}
        records = [other(r, data={"mean": r.data["c.x"] - r.data["c.x"].mean()}, sigma=draw.noise) for r in records]

    def own_values(which: Sequence[learning.Experiment]) -> Mapping[str, Any]:
        fit = learning.Problem(system_of(Decay), learning.Data(*which), train=[], **TIGHT | given).fit()
        return {n: v for n, v in facts(fit).items() if n.startswith("c.a")}

    return said(lambda: own_values(records)), said(lambda: own_values(records[:1]) | own_values(records[1:]))


@way
def units(draw: Draw) -> tuple[Said, Said]:
    draw.both = False
    one, k = draw.record(), float(10 ** draw.rng.uniform(-6, 6))
    level = draw.level if isinstance(draw.level, str) else draw.level * k
    scaled = other(one, data={"c.r": k * one.data["c.x"]}, sigma=level)

    def bare(records: Sequence[learning.Experiment], k: float) -> dict[str, Any]:
        system = system_of(Decay).with_parameters({"c.k": k})
        fit = learning.Problem(system, learning.Data(*records), train=["c.a"], **TIGHT | {"atol": 1e-14}).fit()
        found = facts(fit)
        kept = {n: v for n, v in found.items() if n.startswith(("c.a", "freedom", "chi2"))}
        return kept | {f"{n} / k": v / k for n, v in found.items() if n.startswith("sigma")}

    return said(lambda: bare([other(one, data={"c.r": one.data["c.x"]}, sigma=draw.level)], 1.0)), said(
        lambda: bare([scaled], k)
    )


@way
def held_out(draw: Draw) -> tuple[Said, Said]:
    """What is held out tells nothing."""
    one, given = draw.record(), method_of(draw)
    records = [one, draw.record(6, start=5.0, holdout=True, name="kept")]
    return fitted(Decay, [one], ["c.a"], **given), fitted(Decay, records, ["c.a"], **given)


@way
def shifted(draw: Draw) -> tuple[Said, Said]:
    one, late = draw.record(), float(draw.rng.uniform(-50, 50))
    later = other(one, times=one.times + late, t0=late)
    return fitted(Decay, [one], ["c.a"]), fitted(Decay, [later], ["c.a"])


@way
def sample_at_the_start(draw: Draw) -> tuple[Said, Said]:
    """A start that was measured, as an experiment of one sample, or as the prior that it makes."""
    draw.level, draw.both = draw.noise, False
    y0, spread = 1.0 + 0.1 * float(draw.rng.standard_normal()), 0.1
    free = {"c.x": learning.Unknown(y0, shared=True), "c.z": 0.0}
    known = {"c.x": learning.Unknown(y0, spread=spread, shared=True), "c.z": 0.0}
    one = draw.record(initial=free)
    at_start = learning.Experiment([0.0], {"c.x": [y0]}, sigma=spread, initial=free)
    sides = [one, at_start], [other(one, initial=known)]

    def found(records: Sequence[learning.Experiment]) -> dict[str, Any]:
        all_of_it = fitted(Decay, records, ["c.a"]).values
        return {n: v for n, v in all_of_it.items() if n.startswith("c.")}

    return said(lambda: found(sides[0])), said(lambda: found(sides[1]))


@way
def minibatches(draw: Draw) -> tuple[Said, Said]:
    """The mean of an epoch is the cost of all, priors counted once."""
    draw.level = draw.noise
    prior = {"c.x": learning.Unknown(1.0, spread=0.2, shared=True), "c.z": 0.0}
    records = [draw.record(n, name=f"{k}", initial=prior) for k, n in enumerate((9, 6, 4, 8))]
    problem = learning.Problem(system_of(Decay), learning.Data(*records), train=["c.a"], **TIGHT)
    objective = problem._prepared(None, (), None, None)
    z = np.array([0.3, 0.9])
    weights = objective.weights(z, objective.evaluate(z))

    def parts(size: int | None) -> list[Any]:
        batches = Batches(objective, size, 0)
        return [batches.cost_and_gradient(z, weights, batches.chosen(k)) for k in range(1 if size is None else 2)]

    def mean(size: int | None) -> dict[str, Any]:
        found = parts(size)
        return {name: np.mean([f[k] for f in found], axis=0) for k, name in enumerate(("cost", "gradient"))}

    return said(lambda: mean(2)), said(lambda: mean(None))


# --- letter g --------------------------------------------------------------------------------------------------------


def starts(draw: Draw) -> list[tuple[str, Said, Said]]:
    """The same problem from several places, with a prior and with a product of which only the whole is determined."""
    prior = {"c.x": learning.Unknown(1.1, spread=float(10 ** draw.rng.uniform(-2, 0)), shared=True), "c.z": 0.0}
    records = [draw.record(initial=prior, driven=0.3)]
    train = ["c.a", "c.one", "c.other"] if draw.rng.random() < 0.5 else ["c.a"]
    problem = learning.Problem(system_of(Decay), learning.Data(*records), train=train, **TIGHT)
    first = problem.fit()
    here = said(lambda: facts(first))
    a, x = float(10 ** draw.rng.uniform(-0.7, 0.7)), float(draw.rng.uniform(0.5, 2.0))
    elsewhere = {"c.a": a, "c.x at the start": x}
    if len(train) > 1:
        elsewhere |= {"c.one": float(draw.rng.uniform(0.2, 2.0)), "c.other": float(draw.rng.uniform(0.2, 2.0))}
    given = {
        "values found": {"start": first.values},
        "the system found": {"start": first.system},
        "the same again": {},
        "elsewhere": {"start": elsewhere},
    }
    found = [(what, here, said(lambda how=how: facts(problem.fit(**how)))) for what, how in given.items()]
    count = int(draw.rng.integers(2, 4))
    best = problem.fit(starts=count, seed=int(draw.rng.integers(100)))
    least = min(first.objective.surprise(first.minimum), best.objective.surprise(best.minimum))
    likely = best.objective.surprise(best.minimum)
    return [*found, ("several starts", Said({"score": np.array(likely)}), Said({"score": np.array(least)}))]


# --- for the family --------------------------------------------------------------------------------------------------


def written(number: int) -> Pairs:
    """Letter f: records written differently."""
    names = list(WAYS)
    what = names[number % len(names)]
    draw = Draw(np.random.default_rng([number, 31]))
    pairs = Pairs("f", f"decay, {what}")

    def pair() -> None:
        one, two = WAYS[what](draw)
        pairs.compare(what, one, two, ALIKE)

    pairs.attempt(what, pair)
    return pairs


def begun(number: int) -> Pairs:
    """Letter g: searches that began elsewhere."""
    draw = Draw(np.random.default_rng([number, 32]))
    pairs = Pairs("g", "decay")

    def compare() -> None:
        for what, one, two in starts(draw):
            pairs.compare(what, one, two, ALIKE)

    pairs.attempt("starts", compare)
    return pairs
