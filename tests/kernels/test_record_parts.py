"""Parts of records and coarser ones, beside closed forms and SciPy."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal

from jaxonomy_dae.errors import ModelError
from jaxonomy_dae.learning import Experiment, Filter, Noise, Unknown

TS = np.linspace(0.0, 10.0, 401)
AT = np.array([1.0, 2.0, 3.0])


def record(**given):
    return Experiment(TS, {"c.x": np.sin(TS), "c.y": np.stack([TS, TS**2], axis=1)}, **given)


def test_a_window_begins_where_it_says():
    whole = record(sigma={"c.x": 0.1}, initial={"c.x": Unknown(0.0), "c.k": 2.0}, name="one", weight=3.0)
    part = whole.window(2.0, 5.0, initial={"c.x": Unknown(0.9), "c.k": 2.0})
    assert part.t0 == 2.0 and part.times[0] == 2.0 and part.times[-1] == 5.0 and part.name == "one"
    assert part.weight == 3.0 and part.initial == {"c.x": Unknown(0.9), "c.k": 2.0}
    assert part.sigma["c.x"] == 0.1 and np.isnan(part.sigma["c.y"]) and part.data["c.y"].shape == (121, 2)
    np.testing.assert_array_equal(part.data["c.x"], np.sin(part.times))
    with pytest.raises(ModelError, match=r"'c.k' is known at 0, not at 2: .* a parameter keeps its value, 2.0"):
        whole.window(2.0, 5.0)
    with pytest.raises(ModelError, match="there is no sample from 10.5 to 11"):
        record().window(10.5, 11.0)
    with pytest.raises(ModelError, match="0 ≤ start < end; got 3.0 and 3.0"):
        record().window(3.0, 3.0)


def test_a_record_at_other_times():
    x = np.array([1.0, 3.0, np.nan, 5.0, 9.0])
    few = Experiment(np.arange(5.0), {"c.x": x}).resample([0.0, 0.5, 1.0, 1.5, 3.0, 3.25, 4.0, 4.5])
    np.testing.assert_array_equal(few.data["c.x"], [1.0, 2.0, 3.0, np.nan, 5.0, 6.0, 9.0, np.nan])
    lines = record().resample(np.linspace(0.3, 9.7, 7)).data["c.y"]
    np.testing.assert_allclose(lines[:, 0], np.linspace(0.3, 9.7, 7), rtol=1e-14)
    with pytest.raises(ModelError, match="must increase"):
        record().resample([1.0, 1.0])


def test_decimation_keeps_what_is_slow_and_nothing_else():
    """Every eighth sample of an oscillation at 4.9 of 5 Hz looks like one at 0.1 Hz."""
    ts = np.arange(2001) * 0.025
    slow, fast = np.sin(2 * np.pi * 0.1 * ts), np.sin(2 * np.pi * 4.9 * ts)
    few = Experiment(ts, {"c.x": slow + fast, "c.line": 3 - 2 * ts}, sigma=1.0).decimate(8)
    np.testing.assert_allclose(few.times, ts[8:-8:8])
    assert np.abs((slow + fast)[::8] - slow[::8]).max() > 0.9
    inside = slice(10, -10)
    assert np.abs(few.data["c.x"] - slow[8:-8:8])[inside].max() < 5e-3
    np.testing.assert_allclose(few.data["c.line"], 3 - 2 * ts[8:-8:8], atol=1e-9)
    theirs = scipy.signal.decimate(slow + fast, 8, ftype="fir")
    np.testing.assert_allclose(few.data["c.x"][19:-19], theirs[20:-20], atol=1e-12)
    noise = np.random.default_rng(0).standard_normal(100_001)
    quiet = Experiment(np.arange(100_001.0), {"c.x": noise}, sigma=1.0).decimate(8)
    assert quiet.data["c.x"].std() == pytest.approx(quiet.sigma["c.x"], rel=0.02)
    assert np.isnan(Experiment(ts, {"c.x": slow}).decimate(2).sigma["c.x"])


def test_decimation_of_what_no_filter_takes():
    with pytest.raises(ModelError, match="even steps"):
        Experiment(TS**2 + TS, {"c.x": TS}).decimate(4)
    with pytest.raises(ModelError, match="'c.x' has missing samples"):
        Experiment(TS, {"c.x": np.where(TS == 5, np.nan, TS)}).decimate(4)
    with pytest.raises(ModelError, match="factor is a whole number"):
        record().decimate(2.5)
    np.testing.assert_allclose(record().decimate(1).data["c.x"], np.sin(TS), atol=1e-14)


def test_a_trend_is_taken_away():
    x = np.sin(2 * np.pi * TS) + 3.0 - 0.5 * TS
    x[7] = np.nan
    level = Experiment(TS, {"c.x": x, "c.y": TS}).detrend("c.x")
    seen = np.isfinite(x)
    expected = x[seen] - np.polyval(np.polyfit(TS[seen], x[seen], 1), TS[seen])
    np.testing.assert_allclose(level.data["c.x"][seen], expected, atol=1e-12)
    assert np.isnan(level.data["c.x"][7])
    np.testing.assert_array_equal(level.data["c.y"], TS)
    np.testing.assert_allclose(record().detrend(degree=0).data["c.y"][:, 0], TS - 5.0, atol=1e-12)
    with pytest.raises(ModelError, match="no data of 'c.z'"):
        record().detrend("c.z")
    with pytest.raises(ModelError, match="1 samples, too few"):
        Experiment(TS[:2], {"c.x": [1.0, np.nan]}).detrend()


def test_what_is_known_somewhere_else_is_said_anew():
    """A prior of the value at t0 became one of the value at a window's start."""
    with pytest.raises(ModelError, match="'c.x' is known at 0, not at 2"):
        record(initial={"c.x": Unknown(0.0, spread=0.1)}).window(2.0, 5.0)


def test_correlations_are_those_of_neighbours():
    """Of noise that correlates by 0.9 from sample to sample, every tenth sample does by 0.9¹⁰ = 0.35."""
    coloured = record(sigma={"c.x": Noise(0.1, rho=0.9)})
    for coarser in (lambda: coloured.decimate(10), lambda: coloured.resample(TS[::10])):
        with pytest.raises(ModelError, match="the noise of 'c.x' is correlated, rho, from one sample to the next"):
            coarser()
    with pytest.raises(ModelError, match="is correlated"):  # how much quieter it becomes is not known
        record(sigma={"c.x": Noise(0.1, rho="estimate")}).decimate(10)
    assert record(sigma={"c.x": Noise(rho="estimate")}).decimate(10).noise("c.x").rho == "estimate"


def test_numbers_of_numpy_and_jax_are_numbers():
    """Those of JAX were refused, with words that were not true; a start known so was kept at a window's start."""

    def number(x: float) -> Any:
        return jnp.asarray(np.array(x))

    levels, count = jnp.asarray(0.1 + 0.01 * AT), np.int64(2)

    def given(**others: Any) -> Experiment:
        return Experiment(AT, {"c.x": AT}, **others)

    known = {"c.x": number(2.0), "c.k": np.array(0.3)}
    one = given(t0=number(1.0), weight=np.array(2.0), initial=known)
    assert (one.t0, one.weight, one.initial) == (1.0, 2.0, {"c.x": 2.0, "c.k": 0.3})
    np.testing.assert_array_equal(given(sigma=levels).sigma["c.x"], np.asarray(levels))
    assert given(sigma=number(0.1)).sigma["c.x"] == 0.1 and Unknown(number(2.0)) == Unknown(2.0)
    with pytest.raises(ModelError, match="'c.x' is known at 1, not at 2"):
        one.window(2.0, 3.0)
    assert Filter({"c.x": 1.0}, count) == Filter({"c.x": 1.0}, 2)


def test_noise_is_as_quiet_at_the_ends():
    """The first and the last sample of a decimated record had the noise of single ones, three times what was said."""
    noise = np.random.default_rng(0).standard_normal((201, 4000))
    few = Experiment(np.arange(201.0), {"c.x": noise}, sigma=1.0).decimate(10)
    level = few.sigma["c.x"]
    np.testing.assert_allclose(few.data["c.x"].std(axis=1), level, rtol=0.2)
    assert len(few.times) == 19 and few.times[0] == 10.0 and few.times[-1] == 190.0
    with pytest.raises(ModelError, match="more than 20 samples"):
        Experiment(np.arange(20.0), {"c.x": noise[:20]}).decimate(10)
