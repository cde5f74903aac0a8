"""Parameters of flat Modelica texts that are written as numbers."""

import pytest

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, EqnEnv, ModelError, StructuralError
from jaxonomy_dae.modelica import FlatComponent, load

TEXT = """//! base 0.1.0
package 'm'
  model 'm'
    parameter Real 'r' = 0.0;
    parameter Real 'c' = 2.0;
    Real 'i';
    Real 'u';
    Real 'v';
  equation
    'i' * 'r' = 'v' - 'u';
    'v' = sin(time);
    'c' * der('u') = 'i';
  end 'm';
end 'm';"""


def compiled(**more):
    ev, diagram = EqnEnv(), AcausalDiagram()
    diagram.add(FlatComponent(ev, "m", load(TEXT), **more))
    return AcausalCompiler(ev, diagram)()


def test_a_resistance_of_zero_is_a_number():
    """As a parameter, it has to determine a current, also where the potentials at its ends are one and determine the
    current by their derivative."""
    with pytest.raises(StructuralError, match=r"determines nothing for m.r = 0"):
        compiled()
    system = compiled(numbers=["r"])
    assert list(system.parameters.names) == ["m.c"]
    assert not system.states


def test_numbers_are_parameters_of_the_text():
    for name in ("u", "q"):
        with pytest.raises(ModelError, match=f"numbers: 'm' has no parameter '{name}'"):
            compiled(numbers=[name])


@pytest.mark.parametrize(
    "written, said",
    [
        ("0^(-1)", r"0 \^ -1: 0\.0 cannot be raised"), ("10^400", r"10 \^ 400: int too large"),
        ("sum(linspace(0, 1, 1))", "linspace needs two points or more; got 1"), ("div(1, 0)", r"div\(1, 0\): "),
        ("sqrt(-1)", r"sqrt\(-1\): math domain error"),
    ],
)  # fmt: skip
def test_numbers_that_there_are_not(written, said):
    """Python's errors of arithmetic came without a line."""
    text = TEXT.replace("'c' = 2.0", f"'c' = {written}")
    with pytest.raises(ModelError, match=rf"line \d+: {said}"):
        FlatComponent(EqnEnv(), "m", load(text))
