"""The command for FMUs: it checks, runs and compiles what was exported, and names what is wrong with a file."""

import csv
import math
import zipfile

import pytest
from hybrid_models import compiled

from jaxonomy_dae import Component, der
from jaxonomy_dae.fmi import export_fmu
from jaxonomy_dae.fmi.__main__ import main
from jaxonomy_dae.fmi.compilers import FOLDERS_OF_FMI_2, TARGETS, compiler_for, this_platform
from jaxonomy_dae.write import Eq

pytest.importorskip("fmpy", reason="FMPy is not installed (extra fmi)")
pytestmark = pytest.mark.skipif(compiler_for(this_platform()) is None, reason="no C compiler on this machine")


class Decay(Component):
    def __init__(self, ev, name):
        super().__init__(ev, name)
        x = self.variable("x", start=1.0, fixed=True)
        self.add_equations(Eq(der(x), -x))


@pytest.mark.parametrize("version", [3, pytest.param(2, marks=pytest.mark.slow)])
def test_sources_become_a_binary_that_runs(tmp_path, capsys, version):
    system = compiled(Decay, "decay")
    path = export_fmu(system, tmp_path / "plant.fmu", outputs=["decay.x"], platforms=(), fmi=version)
    assert main(["validate", str(path)]) == 0
    assert main(["run", str(path)]) == 1
    assert f"{path}: FMPy could not run it" in capsys.readouterr().err

    folder = this_platform() if version == 3 else FOLDERS_OF_FMI_2.get(this_platform(), this_platform())
    assert main(["compile", str(path)]) == 0
    assert capsys.readouterr().out == f"binaries/{folder}/plant{TARGETS[this_platform()][1]}\n"
    table = tmp_path / "values.csv"
    options = ["--stop-time", "1", "--tolerance", "1e-9", "--kind", "ModelExchange", "--csv", str(table)]
    assert main(["run", str(path), *options]) == 0
    with table.open() as file:
        last = list(csv.DictReader(file))[-1]
    assert float(last["time"]) == 1.0
    assert float(last["decay.x"]) == pytest.approx(math.exp(-1), abs=1e-7)


def test_files_that_are_no_such_fmus_are_named(tmp_path, capsys):
    text, bare, odd = (tmp_path / name for name in ("text.fmu", "bare.fmu", "odd.fmu"))
    text.write_text("no zip")
    named = '<b><BuildConfiguration modelIdentifier="../m"><SourceFile name="m.c"/></BuildConfiguration></b>'
    for path, build in (bare, None), (odd, named):
        with zipfile.ZipFile(path, "w") as file:
            file.writestr("modelDescription.xml", "<a/>")
            if build:
                file.writestr("sources/buildDescription.xml", build)
    for path, reason in (
        (tmp_path / "none.fmu", "there is no file"),
        (text, "an FMU is a zip file"),
        (bare, "has no sources/buildDescription.xml"),
        (odd, "modelIdentifier '../m' is not a name of C"),
    ):
        before = path.read_bytes() if path.exists() else None
        assert main(["compile", str(path)]) == 1
        assert reason in capsys.readouterr().err
        assert before == (path.read_bytes() if path.exists() else None)
        assert main(["validate", str(path)]) == 1
