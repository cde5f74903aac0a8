"""The equations of FMUs for FMI-LS-DAE: an index-3 pendulum with its hidden constraints, by hand."""

import zipfile
from xml.etree import ElementTree

import numpy as np
import pytest
from fmus import exported, opened
from problems import compiled, drag_on, mlp, pendulum

from jaxonomy_dae import Component, EqnEnv, der
from jaxonomy_dae.errors import ModelError
from jaxonomy_dae.fmi import export_fmu
from jaxonomy_dae.fmi.compilers import compiler_for, this_platform
from jaxonomy_dae.fmi.manifest import PATH
from jaxonomy_dae.write import Eq

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(compiler_for(this_platform()) is None, reason="no C compiler on this machine"),
]


class Loop(Component):
    """y + y³ = x, x' = −y."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        x, y = self.variable("x", start=2.0, fixed=True), self.variable("y", start=1.0)
        self.add_equations(Eq(y + y**3, x), Eq(der(x), -y))


def structure(path):
    """Returns (the algebraic variables, the derivatives of states, the residuals as lists of formulations)."""
    with zipfile.ZipFile(path) as file:
        root = ElementTree.fromstring(file.read(PATH))
    algebraics = [int(e.attrib["valueReference"]) for e in root.iter("AlgebraicVariable")]
    slopes = [int(e.attrib["valueReference"]) for e in root.iter("ContinuousStateDerivative")]
    return algebraics, slopes, [[f.attrib for f in e] for e in root.iter("Residual")]


def solved(fmu, path):
    """Newton's method on the residuals of index 1, by directional derivatives; returns the derivatives of states."""
    algebraics, slopes, residuals = structure(path)
    left = [int(f["valueReference"]) for group in residuals for f in group if f["index"] == "1"]
    assert len(left) == len(algebraics)
    model = fmu.model
    for _ in range(8):
        values = np.array(model.getFloat64(left))
        jacobian = [model.getDirectionalDerivative(left, [a], [1.0], len(left)) for a in algebraics]
        step = np.linalg.solve(np.transpose(jacobian), values)
        model.setFloat64(algebraics, list(np.array(model.getFloat64(algebraics)) - step))
    assert np.abs(model.getFloat64(left)).max() < 1e-11
    return np.array(model.getFloat64(slopes))


@pytest.mark.parametrize("law", [None, drag_on("vx", "vy", network=mlp(2, 2))], ids=["bare", "network"])
def test_a_pendulum_with_its_constraints(tmp_path, law):
    """x² + y² = L² has index 3, its derivative 2, and its second derivative gives the pull of the link."""
    path = exported(pendulum(*([law] if law else [])), tmp_path, dae=True)
    _, _, residuals = structure(path)
    (constraint,) = [group for group in residuals if any(f["index"] == "3" for f in group)]
    assert [f["index"] for f in constraint][:2] == ["3", "2"]
    with opened(path) as fmu:
        np.testing.assert_allclose(solved(fmu, path), fmu.get(*(f"der(pend.{n})" for n in fmu_states(fmu))), rtol=1e-11)
        # Off the circle the constraints are what they are by hand, up to the sign with which they are written.
        point = {"pend.x": 0.7, "pend.y": -0.9, "pend.vx": 0.4, "pend.vy": 0.2}
        fmu.set(point)
        x, y, vx, vy = point.values()
        found = [fmu.model.getFloat64([int(f["valueReference"])])[0] for f in constraint[:2]]
        np.testing.assert_allclose(np.abs(found), np.abs([x**2 + y**2 - 1, 2 * (x * vx + y * vy)]), rtol=1e-13)


def fmu_states(fmu):
    return [d.variable.derivative.name.removeprefix("pend.") for d in fmu.description.derivatives]


def test_an_implicit_equation_is_left_open(tmp_path):
    path = exported(compiled(Loop(EqnEnv(), "loop")), tmp_path, dae=True)
    algebraics, slopes, ((formulation,),) = structure(path)
    with opened(path) as fmu:
        (given,) = [v for v in fmu.description.modelVariables if v.valueReference in algebraics]
        assert given.description.startswith("der(loop.x)")  # which is −y
        fmu.model.setFloat64(algebraics, [-0.5])
        residual = fmu.model.getFloat64([int(formulation["valueReference"])])[0]
        assert abs(residual) == pytest.approx(2.0 - 0.5 - 0.5**3, rel=1e-14)
        assert fmu.model.getFloat64(slopes)[0] == pytest.approx(-0.5, rel=1e-14)
        assert fmu.get("der(loop.x)")[0] == pytest.approx(-1.0, rel=1e-12)
        assert solved(fmu, path)[0] == pytest.approx(-1.0, rel=1e-12)
        back = fmu.model.getAdjointDerivative([int(formulation["valueReference"])], algebraics, [1.0], 1)
        assert abs(back[0]) == pytest.approx(1 + 3 * 1.0**2, rel=1e-12)


def test_the_layered_standard_is_one_of_version_3(tmp_path):
    with pytest.raises(ModelError, match="FMI-LS-DAE is one of FMI 3"):
        export_fmu(compiled(Loop(EqnEnv(), "loop")), tmp_path / "x.fmu", fmi=2, dae=True)
