"""Given a wheel, run where it is installed: it holds the package alone, and importing it is inert."""

import importlib.metadata
import importlib.util
import pathlib
import sys
import zipfile

wheel = pathlib.Path(sys.argv[1])
names = zipfile.ZipFile(wheel).namelist()
version = wheel.name.split("-")[1]
assert "jaxonomy_dae/py.typed" in names, "py.typed is missing from the wheel"
foreign = [n for n in names if not n.startswith(("jaxonomy_dae/", f"jaxonomy_dae-{version}.dist-info/"))]
assert not foreign, f"the wheel holds more than the package: {foreign}"

for tool in ("pytest", "ruff", "matplotlib"):
    assert importlib.util.find_spec(tool) is None, f"{tool} is installed: this environment is not clean"

import jaxonomy_dae  # noqa: E402

assert pathlib.Path(jaxonomy_dae.__file__).is_relative_to(sys.prefix), jaxonomy_dae.__file__
assert jaxonomy_dae.__version__ == importlib.metadata.version("jaxonomy_dae") == version

import jax  # noqa: E402

assert not jax.config.jax_enable_x64, "importing jaxonomy_dae switched on x64"
print(f"{wheel.name}: imports from a clean environment, version {version}, x64 untouched")
