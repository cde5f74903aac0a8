"""Settings every test relies on. They must be made before `jaxonomy_dae` is first imported."""

import gc
import os
from pathlib import Path

import hypothesis
import jax
import jaxtyping
import pytest

os.environ["MPLBACKEND"] = "Agg"

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")

# Shapes and types in signatures are checked here, and only here: users pay nothing for them.
jaxtyping.install_import_hook("jaxonomy_dae", "beartype.beartype")

# The same examples in every run, and no deadline: the first call of a jitted function compiles it.
hypothesis.settings.register_profile("deterministic", derandomize=True, deadline=None, database=None)
hypothesis.settings.load_profile("deterministic")

MAPPINGS, PAGES = Path("/proc/self/maps"), Path("/proc/self/statm")  # on Linux
MOST_MAPPINGS = 20_000  # a third of what Linux allows by default
MOST_MEMORY = 4e9  # bytes


@pytest.fixture(autouse=True)
def room_for_compiled_programs():
    """Compiled programs are memory mappings, of which XLA crashes where it gets no more, and memory."""
    yield
    if not MAPPINGS.exists():
        return
    resident = int(PAGES.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    if resident > MOST_MEMORY or MAPPINGS.read_bytes().count(b"\n") > MOST_MAPPINGS:
        jax.clear_caches()
        gc.collect()


def pytest_addoption(parser):
    parser.addoption(
        "--units", type=int, default=None, help="compile every model again in random units of this seed, and compare"
    )


@pytest.fixture(autouse=True)
def in_other_units(request):
    """With `--units`, every model that a test compiles must have the same verdict and states in other units."""
    seed = request.config.getoption("--units")
    file = request.node.nodeid.partition("::")[0]
    if seed is None or "units" in file or "rescaled" in file:
        yield
        return
    from other_units import compare_verdicts, is_rescalable, watched
    from rescaling import KINDS

    request.getfixturevalue("monkeypatch")  # what a test patches stays so until its models have been compared
    with watched() as seen:
        yield
    for compiler, old in seen:
        if is_rescalable(compiler):
            compare_verdicts(compiler, old, KINDS[seed % len(KINDS)], seed)
