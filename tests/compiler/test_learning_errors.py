"""What experiments and problems refuse, and with which words. Nothing is simulated."""

from types import SimpleNamespace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from hybrid_models import Doubling

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, EqnEnv
from jaxonomy_dae.errors import ModelError
from jaxonomy_dae.learning import (
    Data,
    Experiment,
    Filter,
    GradientSteps,
    Innovations,
    Noise,
    Problem,
    Shooting,
    Unknown,
)
from jaxonomy_dae.learning.band import law_of
from jaxonomy_dae.learning.evaluation import Evaluation
from jaxonomy_dae.learning.intervals import checked_level
from jaxonomy_dae.learning.table import Row, Table
from jaxonomy_dae.learning.training import _facts, shares_of_time
from jaxonomy_dae.write import Component, Eq, der
from jaxonomy_dae.write.interval import POSITIVE

TIMES = np.array([1.0, 2.0, 3.0])


class Tank(Component):
    def __init__(self, ev, name="tank"):
        super().__init__(ev, name)
        k = self.parameter("k", 0.5, unit="1/s", bounds=(0.0, np.inf))
        self.parameter("idle", 1.0)
        u = self.input("u")
        level = self.variable("level", start=1.0, fixed=True, unit="m")
        outflow = self.variable("outflow")
        (loss,) = self.learned("loss", eqx.nn.MLP(1, 1, 2, 1, jnp.tanh, key=jax.random.key(0)), inputs=[level])
        depth = self.variable("depth")  # the level by another name
        self.add_equations(Eq(der(level), u - outflow + loss), Eq(outflow, k * level**2), Eq(depth, 2 * level))


class Decay(Component):
    """At a rate above zero."""

    def __init__(self, ev, name="c"):
        super().__init__(ev, name)
        x, k = self.variable("x", start=1.0, fixed=True), self.parameter("k", 1.0, bounds=POSITIVE)
        self.add_equations(Eq(der(x), -k * x))


@pytest.fixture(scope="module")
def system():
    ev, diagram = EqnEnv(), AcausalDiagram()
    diagram.add(Tank(ev))
    return AcausalCompiler(ev, diagram)()


def record(data=None, **given):
    given = {"inputs": {"tank.u": 0.0}} | given
    return Experiment(TIMES, {"tank.level": TIMES} if data is None else data, **given)


@pytest.mark.parametrize(
    "given, words",
    [
        (dict(times=[1.0, 3.0, 2.0]), r"times\[1\]=3 is followed by times\[2\]=2"),
        (dict(times=[1.0, np.nan, 2.0]), r"times\[1\] is nan"),
        (dict(t0=2.0), "starts at t0=2, the times reach from 1 to 3"),
        (dict(data={"tank.level": [1.0, 2.0]}), r"'tank.level' need a row for each of the 3 times; got shape \(2,\)"),
        (
            dict(data={"tank.level": [1.0, np.inf, 2.0]}),
            r"'tank.level': entry \[1\] is inf; NaN marks a missing sample",
        ),
        (dict(sigma=0.0), "sigma of 'tank.level' is a standard deviation > 0"),
        (dict(sigma={"tank.levle": 1.0}), "there are no data of 'tank.levle': did you mean 'tank.level'"),
        (dict(weight=-1.0), "weight is a number ≥ 0; got -1"),
        (dict(t0="0"), "t0 is the time at which the experiment starts, a number; got '0'"),
    ],
)
def test_experiment(given, words):
    with pytest.raises(ModelError, match=words):
        Experiment(**({"times": TIMES, "data": {"tank.level": TIMES}} | given))


@pytest.mark.parametrize(
    "experiments, given, words",
    [
        ([record({"tank.levl": TIMES})], {}, "'tank.levl', which is not a variable: did you mean 'tank.level'"),
        ([record({"tank.level": np.ones((3, 2))})], {}, r"'tank.level' must have shape \(n,\); got \(3, 2\)"),
        ([record({"tank.level": np.full(3, np.nan)})], {}, "all samples are missing"),
        ([record(inputs={"tank.v": 0.0})], {}, "'tank.v' is not an input of this system: did you mean 'tank.u'"),
        ([record(inputs={"tank.u": (TIMES, TIMES)})], {}, "reach from 1 to 3, the experiment from 0 to 3"),
        ([record(inputs={"tank.u": ([0, 5, 4], TIMES)})], {}, "times must increase"),
        ([record(inputs={"tank.u": np.nan})], {}, "input 'tank.u' must be finite; got nan"),
        ([record(initial={"tank.level": object()})], {}, "'tank.level' starts at a finite number or Unknown"),
        ([record(inputs={"tank.u": ([0, 2, 4], [0, np.nan, 1])})], {}, r"input 'tank.u': values\[1\] is nan"),
        ([record(), record(inputs={})], {}, "experiment 1 does not give input 'tank.u'"),
        (
            [record(inputs={"tank.u": ([0, 3], [0, 1], kind)}) for kind in ("held", "linear")],
            {},
            "'held' in experiment 0 and 'linear' in experiment 1",
        ),
        ([record(holdout=True)], {}, "every experiment is held out"),
        ([record(weight=0.0)], dict(method=Filter({"tank.level": 0.1})), "nothing is to be fitted"),
        (
            [record({"tank.level": TIMES, "tank.outflow": TIMES}, sigma={"tank.level": Noise(shared="tank.outflow")})],
            {},
            "'tank.level' shares the level 'tank.outflow', which is the name of an output that does not",
        ),
        ([record(name="a"), record(name="a")], {}, "two experiments are named 'a'"),
        ([record()], dict(train=["tank.kk"]), "'tank.kk' is neither a parameter, a network nor a sensor law"),
        ([record()], dict(train=[]), "nothing is to be learned"),
        ([record()], dict(train=["tank.idle"]), "nothing in the model reads parameter 'tank.idle'"),
        ([record()], dict(train=["y"], observe={"y": lambda s: s["tank.level"]}), "'y' has no numbers to be trained"),
        ([record()], dict(starts={"tank.outflow": Unknown(1.0)}), "'tank.outflow' is algebraic: .*'tank.level'"),
        ([record()], dict(starts={"tank.lvl": Unknown(1.0)}), "'tank.lvl' is not that of a variable"),
        ([record()], dict(starts={"tank.level": "high"}), "'tank.level' starts at a finite number or Unknown"),
        ([record(), record(initial={"tank.level": 1.0})], {}, "experiment 0 does not say how 'tank.level' starts"),
        (
            [record(initial={"tank.level": Unknown(1.0, shared=k)}) for k in (True, False)],
            {},
            "'tank.level' is shared in some experiments only",
        ),
        ([record()], dict(regularize={"tank.los": 1.0}), "'tank.los' is no network that is trained"),
        ([record()], dict(regularize={"tank.loss": -1.0}), "takes 'evidence', a precision ≥ 0 or None; got -1"),
    ],
)
def test_problem(system, experiments, given, words):
    with pytest.raises(ModelError, match=words):
        Problem(system, Data(*experiments), **given)


@pytest.mark.parametrize(
    "given, words",
    [
        (dict(freeze=["tank.c"]), "'tank.c' is not estimated in this problem: did you mean 'tank.k'"),
        (dict(freeze=["tank.k"]), "everything is frozen"),
        (dict(start={"tank.k": np.nan}), "'tank.k' needs a finite number"),
        (dict(bounds={"tank.k": (2.0, 1.0)}), r"bounds of 'tank.k' must lie within"),
        (dict(horizons=(0.5,)), "horizons are shares"),
        (dict(data=record(weight=0.0)), "nothing is to be fitted"),
        (dict(steps=-1), "steps is a whole number ≥ 0; got -1"),
        (dict(data=record({"tank.outflow": TIMES})), "name other outputs"),
    ],
)
def test_fit(system, given, words):
    problem = Problem(system, record(), train=["tank.k"])
    with pytest.raises(ModelError, match=words):
        problem.fit(**given)


def test_spread_and_guess_of_an_unknown():
    with pytest.raises(ModelError, match="finite guess; got nan"):
        Unknown(np.nan)
    with pytest.raises(ModelError, match="standard deviation > 0"):
        Unknown(1.0, spread=0.0)


def test_csv_with_missing_cells_and_dates(tmp_path):
    path = tmp_path / "record.csv"
    path.write_text(
        "time,T,P\n2020-01-01 00:00:00+00:00,1.5,2\n2020-01-01 01:00:00+00:00,,3\n2020-01-01 02:00:00+00:00,4,5\n"
    )
    one = Experiment.from_csv(path, {"room.T": "T"}, time="time", inputs={"heater.Q": ("P", "held")}, sigma=0.1)
    np.testing.assert_array_equal(one.times, [0.0, 3600.0, 7200.0])
    np.testing.assert_array_equal(one.data["room.T"], [1.5, np.nan, 4.0])
    np.testing.assert_array_equal(one.inputs["heater.Q"][1], [2.0, 3.0, 5.0])
    with pytest.raises(ModelError, match="no column 'S': known names: 'time', 'T', 'P'"):
        Experiment.from_csv(path, {"room.T": "S"}, time="time")


def test_csv_of_other_programs(tmp_path):
    """Raw errors of Python, a mark at the beginning that became part of a name, and cells that were left out."""
    path = tmp_path / "record.csv"
    path.write_text("t,x\n0,1\n1,2\n", encoding="utf-8-sig")
    np.testing.assert_array_equal(Experiment.from_csv(path, "x", time="t").data["x"], [1.0, 2.0])
    path.write_text("t,x\n0,1\n1,n/a\n")
    with pytest.raises(ModelError, match="column 'x' has cells that are no numbers, such as 'n/a'"):
        Experiment.from_csv(path, ["x"], time="t")
    path.write_text("t,x\n0,1\n1,2,7\n")
    with pytest.raises(ModelError, match="row 2 below the first line has more cells"):
        Experiment.from_csv(path, ["x"], time="t")


def test_names_of_new_data_have_no_order(system):
    """Data in another order, and a constant in place of samples, were said to name other outputs."""
    both = {"tank.level": TIMES, "tank.outflow": TIMES}
    given = {"tank.k": Unknown(0.3), "tank.level": 1.0}
    problem = Problem(system, record(both, initial=given, inputs={"tank.u": ([0, 3], [0, 1])}), train=[])
    other = record(dict(reversed(both.items())), initial=dict(reversed(given.items())))
    found = problem._prepared(other, (), None, None)
    assert found.layout == problem._layout and found.stacked.kinds == (("tank.u", "linear"),)


def test_correlations_below_zero_over_whole_steps_alone(system):
    """A run was blamed whose derivatives were not finite."""
    even = record(sigma=Noise(0.1, rho=-0.5))
    Problem(system, even, train=["tank.k"])._prepared(None, (), None, None)
    uneven = Experiment([1.0, 2.0, 3.0, 4.4], {"tank.level": np.ones(4)}, Noise(0.1, rho=-0.5), {"tank.u": 0.0})
    with pytest.raises(ModelError, match="'tank.level' are not whole sampling steps apart, .* rho = -0.5"):
        Problem(system, uneven, train=["tank.k"])._prepared(None, (), None, None)


def test_a_probability_and_a_name_of_a_table():
    """level=95 gave intervals without ends, and a name that is not there a StopIteration."""
    for level in (95, 0.0, np.nan, "0.95", True):
        with pytest.raises(ModelError, match="level is a probability between 0 and 1"):
            checked_level(level)
    with pytest.raises(ModelError, match="no row 'tank.K' in this table: did you mean 'tank.k'"):
        Table((Row("tank.k", 1.0, 0.0, 2.0, "", ""),), 0.95)["tank.K"]


@pytest.mark.parametrize(
    "make, words",
    [
        (lambda: Shooting(nodes=0), "nodes is a whole number ≥ 1; got 0"),
        (lambda: Shooting(nodes=True), "nodes is a whole number ≥ 1; got True"),
        (lambda: GradientSteps(optax.sgd(0.1), -1), "steps is a whole number ≥ 0; got -1"),
        (lambda: GradientSteps(optax.sgd(0.1), 5, batch=0), "batch is a whole number ≥ 1; got 0"),
        (lambda: GradientSteps(optax.sgd(0.1), 5, horizons=(1.0, 0.5)), "the last of them 1"),
        (lambda: shares_of_time(5), "the last of them 1; got 5"),
        (lambda: Filter({}), "noise is a dictionary by names of states"),
        (lambda: Filter({"tank.level": 0.0}), "noise of 'tank.level' is a number > 0, 'estimate' or Unknown"),
        (lambda: Filter({"tank.level": "guess"}), "noise of 'tank.level' is a number > 0, 'estimate' or .*'guess'"),
        (lambda: Filter({"tank.level": 1.0}, substeps=0), "substeps is a whole number ≥ 1; got 0"),
        (lambda: Innovations("all"), "gain is 'estimate', or a dictionary by pairs"),
        (lambda: Innovations({"tank.level": 0.1}), r"a dictionary by pairs \(state, output\)"),
        (lambda: Innovations({("a", "b"): np.nan}), "gain of 'a' by 'b' is a finite number, 'estimate' or Unknown"),
    ],
)
def test_methods(make, words):
    with pytest.raises(ModelError, match=words):
        make()


def test_methods_of_a_problem(system):
    with pytest.raises(ModelError, match="method is 'single', 'growing' or Shooting"):
        Problem(system, record(), train=["tank.k"], method="double")
    problem = Problem(system, record(), train=["tank.k"], method=Shooting(nodes=3))
    with pytest.raises(ModelError, match="adam and horizons belong to single shooting"):
        problem.fit(horizons=(0.5, 1.0))
    with pytest.raises(ModelError, match="first= does not go with adam="):
        problem.fit(first=GradientSteps(optax.sgd(0.1), 5), adam=3)
    ev, diagram = EqnEnv(), AcausalDiagram()
    diagram.add(Doubling(ev, "d"))
    with pytest.raises(ModelError, match="'d.d' is a discrete variable, which the nodes"):
        Problem(
            AcausalCompiler(ev, diagram)(), Experiment(TIMES, {"d.y": TIMES}), train=["d.a"], method=Shooting(nodes=3)
        )


@pytest.mark.parametrize(
    "method, words",
    [
        (Filter({"tank.lvl": 0.1}), "noise: 'tank.lvl' is not a variable: did you mean 'tank.level'"),
        (Filter({"tank.outflow": 0.1}), "'tank.outflow' is not a differential state .*; these are: 'tank.level'"),
        (Filter({"tank.level": 0.1, "tank.k": 0.1}), "noise: 'tank.k' is not a variable"),
        (Innovations({("tank.level", "tank.flow"): 0.1}), "there are no data of 'tank.flow'"),
        (Innovations({("tank.outflow", "tank.level"): 0.1}), "'tank.outflow' is not a differential state"),
        (
            Innovations({("tank.level", "tank.level"): 0.1, ("tank.depth", "tank.level"): 0.2}),
            "gain of tank.depth by tank.level is given twice, also as the gain of tank.level by tank.level",
        ),
    ],
)
def test_names_of_errors_in_equations(system, method, words):
    with pytest.raises(ModelError, match=words):
        Problem(system, record(), train=["tank.k"], method=method)


def test_what_filters_do_not_do(system):
    problem = Problem(system, record(), train=["tank.k"], method=Filter({"tank.level": "estimate", "tank.u": 0.1}))
    names = problem._coordinates(problem._stacked, (), None, None).names
    assert names == ("tank.k", "noise of tank.level", "noise of tank.u", "sigma of tank.level")
    for given in (dict(adam=3), dict(first=GradientSteps(optax.sgd(0.1), 5))):
        with pytest.raises(ModelError, match="gradient steps are those of runs, not of Filter"):
            problem.fit(**given)
    with pytest.raises(ModelError, match="gradient steps are those of runs"):
        problem.train(GradientSteps(optax.sgd(0.1), 5))
    with pytest.raises(ModelError, match="name other outputs"):  # a noise level that is known now
        problem.fit(record(sigma=0.1))
    ev, diagram = EqnEnv(), AcausalDiagram()
    diagram.add(Doubling(ev, "d"))
    with pytest.raises(ModelError, match="Innovations: 'd.d' is a discrete variable"):
        Problem(AcausalCompiler(ev, diagram)(), Experiment(TIMES, {"d.y": TIMES}), train=["d.a"], method=Innovations())


def test_a_checkpoint_tells_the_integration_the_inputs_and_the_functions(system):
    """Training went on from files that were written with other tolerances, other interpolation, or another law."""

    def facts(kind="linear", law=lambda s: s["tank.level"], sigma=1.0, **given):
        data = record({"gauge": TIMES}, inputs={"tank.u": (np.array([0.0, 3.0]), np.ones(2), kind)}, sigma=sigma)
        problem = Problem(system, data, train=["tank.k"], observe={"gauge": law}, **given)
        return _facts(problem._prepared(None, (), None, None), GradientSteps(optax.sgd(0.1), 5), ())

    def gain(by):
        return lambda s: by * s["tank.level"]

    base = facts()
    assert facts() == base and facts(law=gain(2.0)) == facts(law=gain(2.0))
    estimated = facts(sigma="estimate")
    for noise in (Noise(shared="s"), Noise(rho="estimate"), Noise(rho=0.5)):
        other = facts(sigma=noise)
        assert [key for key in base if estimated[key] != other[key]] == ["set of data"]
    for name, other in {
        "kind of inputs": facts("held"),
        "integration": facts(rtol=1e-4),
        "set of networks and sensor laws": facts(law=lambda s: 2.0 * s["tank.level"]),
    }.items():
        assert [key for key in base if base[key] != other[key]] == [name]
    assert facts(law=gain(2.0)) != facts(law=gain(3.0))


def test_one_guess_for_what_all_experiments_share(system):
    """The first experiment's guess and spread held for all, whatever the others said."""
    experiments = [record(initial={"tank.level": Unknown(g, spread=0.1, shared=True)}) for g in (1.0, 2.0)]
    with pytest.raises(
        ModelError, match="'tank.level' is one number, shared by all experiments, but experiment 0 says"
    ):
        Problem(system, Data(*experiments))


def test_priors_outside_of_bounds(system):
    data = record(initial={"tank.k": Unknown(-1.0)})
    problem = Problem(system, data, train=[])
    with pytest.raises(ModelError, match=r"tank.k, experiment 0: the guess must lie in \[0, inf\].*; got -1"):
        problem.fit()


def test_the_prior_of_a_positive_number_of_an_experiment_is_normal():
    """It was log-normal: two standard deviations below a guess of 1 ± 2 lay 0.02, and above 50."""
    ev, diagram = EqnEnv(), AcausalDiagram()
    diagram.add(Decay(ev))
    data = Experiment(TIMES, {"c.x": TIMES}, initial={"c.k": Unknown(1.0, spread=2.0)})
    objective = Problem(AcausalCompiler(ev, diagram)(), data)._prepared(None, (), None, None)
    z = objective.coordinates.scaled(np.array([4.0]))
    found = Evaluation(np.zeros(3), np.zeros((3, 1)))
    assert objective.weights(z, found).prior(z).residual == pytest.approx([(4.0 - 1.0) / 2.0], rel=1e-12)


def test_grids_of_bands(system):
    """Bare errors of array shapes."""
    fit: Any = SimpleNamespace(
        objective=SimpleNamespace(layout=SimpleNamespace(modules=("tank.loss",))), system=system, observers={}
    )
    with pytest.raises(ModelError, match=r"'tank.loss' has 1 inputs, tank.level: .* shape \(n, 1\); got \(4, 2\)"):
        law_of(fit, "tank.loss", np.ones((4, 2)), None)
    with pytest.raises(ModelError, match="got one number, 0.5"):
        law_of(fit, "tank.loss", 0.5, None)
