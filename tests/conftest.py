"""Settings every test relies on. They must be made before `jaxonomy_dae` is first imported."""

import ctypes
import gc
import os
import re
import shutil
import tempfile
from pathlib import Path

import hypothesis
import jax
import jaxtyping
import pytest
from type_checks import modules_with_shapes

os.environ["MPLBACKEND"] = "Agg"

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")

# Shapes and dtypes in signatures are checked here, and only here: users pay nothing for them.
jaxtyping.install_import_hook(modules_with_shapes(), "type_checks.checked")

# The same examples in every run, and no deadline: the first call of a jitted function compiles it.
hypothesis.settings.register_profile("deterministic", derandomize=True, deadline=None, database=None)
hypothesis.settings.load_profile("deterministic")

pytest_plugins = ["slow_box"]  # `--minutes`

LONG = 5.0  # processor seconds: a test of the default run that takes longer says why
_notes: list[str] = []  # for the end of the run


# --- compiled programs, kept for the next run ------------------------------------------------------------------------


def _cache_folder() -> Path:
    """Where JAX keeps compiled programs: `JAX_COMPILATION_CACHE_DIR`, or in the user's cache directory."""
    chosen = os.environ.get("JAX_COMPILATION_CACHE_DIR")
    if chosen:
        return Path(chosen)
    caches = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(caches) / "jaxonomy_dae" / "tests"


def _keep_compiled_programs() -> None:
    """A second run reads what XLA made in the first; most of the tests' time goes into that."""
    folder = _cache_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / f".writable-{os.getpid()}"
        probe.touch()
        probe.unlink()
    except OSError as error:
        jax.config.update("jax_enable_compilation_cache", False)
        _notes.append(f"compiled programs are not kept: {folder} cannot be written ({error.strerror})")
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


_keep_compiled_programs()


PROGRAMS = "JAXONOMY_DAE_CACHE"  # the folder in which the package keeps programs for the next process


def _in_a_process_of_xdist(config: pytest.Config) -> bool:
    return hasattr(config, "workerinput")


@pytest.hookimpl(tryfirst=True)  # before workers are started, which inherit it
def pytest_configure(config: pytest.Config) -> None:
    """Processes that tests start find what others of this run have compiled, and nothing of the user's."""
    if not _in_a_process_of_xdist(config):
        made = tempfile.mkdtemp(prefix="programs-of-tests-")
        before = os.environ.get(PROGRAMS)
        os.environ[PROGRAMS] = made

        def undo() -> None:
            shutil.rmtree(made, ignore_errors=True)
            os.environ.pop(PROGRAMS)
            if before is not None:
                os.environ[PROGRAMS] = before

        config.add_cleanup(undo)


# --- compiled programs, dropped before they fill the process ---------------------------------------------------------

MAPPINGS, PAGES = Path("/proc/self/maps"), Path("/proc/self/statm")  # on Linux
MOST_MAPPINGS = 20_000  # a third of what Linux allows by default


def _resident() -> float:
    """Memory of this process, in bytes."""
    return int(PAGES.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def _share_of_memory() -> float:
    """What a worker may grow by before it clears: a sixth of the machine, 3.9 GB of 23 GB."""
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 6


_after_clearing = 0.0


@pytest.fixture(autouse=True)
def room_for_compiled_programs():
    """Compiled programs are memory mappings, of which XLA crashes where it gets no more, and memory.

    Clearing costs half a second and makes the next test compile what it shares with others, and what is freed does not
    all go back to the system: so memory must have grown since the last time.
    """
    global _after_clearing
    yield
    if not MAPPINGS.exists():
        return
    if _resident() > _after_clearing + _share_of_memory() or MAPPINGS.read_bytes().count(b"\n") > MOST_MAPPINGS:
        from jaxonomy_dae.host.cache import PROGRAMS

        PROGRAMS.clear()  # otherwise what they hold stays above the limit, and every later test clears again
        jax.clear_caches()
        gc.collect()
        ctypes.CDLL(None).malloc_trim(0)
        _after_clearing = _resident()


def pytest_collection_finish():
    """What was imported stays: collections need not look at it again and again, which took a fifth of the time."""
    gc.collect()
    gc.freeze()
    # Tracing makes millions of objects that live until the program is compiled. Looked at every 700 of them, as Python
    # does by default, they took an eighth of the time of a test of events.
    gc.set_threshold(50_000, 20, 100)


# --- long tests ------------------------------------------------------------------------------------------------------

_unexplained: list[tuple[float, str]] = []
_began = 0.0


def _processor_seconds() -> float:
    """Of this process and of those that it has started and that have ended."""
    return sum(os.times()[:4])


def pytest_runtest_logstart():
    global _began
    _began = _processor_seconds()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item):
    report = yield
    if not (item.get_closest_marker("long") or item.get_closest_marker("slow")):
        report.user_properties.append(("processor seconds", _processor_seconds() - _began))
    return _or_skipped_for_a_known_reason(report)


def pytest_runtest_logreport(report):
    """In the process that writes the report, which under pytest-xdist is not the one that ran the test."""
    spent = dict(report.user_properties).get("processor seconds", 0.0)
    if report.when == "teardown" and spent > LONG:
        _unexplained.append((spent, report.nodeid))


def pytest_terminal_summary(terminalreporter):
    for note in _notes:
        terminalreporter.write_line(note, yellow=True)
    for seconds, name in sorted(_unexplained, reverse=True)[:10]:
        terminalreporter.write_line(
            f"{seconds:.1f} CPU s, and no @pytest.mark.long(reason) says why: {name}", yellow=True
        )


# --- skipped tests ----------------------------------------------------------------------------------------------------

# Where the variable CI is set, all extras are installed, and a test is skipped for one of these reasons.
MAY_BE_SKIPPED = (
    r"JAXONOMY_DAE_DATA names no folder",  # measured data, which are not part of the repository
    r"this processor does not run OpenBLAS' kernels",
    r"could not import 'casadi'",  # an extra of the benchmarks
    r"MODELICA_LIBRARY does not name the folder",  # the Modelica Standard Library, which is not part of the repository
    r"REFERENCE_FMUS does not name the sources",  # FMUs of the Modelica Association
    r"no mappings are counted here",  # outside of Linux
)


def _or_skipped_for_a_known_reason(report):
    """The report; a failure if the test or the file was skipped for a reason that is not in the list."""
    if report.outcome != "skipped" or hasattr(report, "wasxfail") or not os.environ.get("CI"):
        return report
    reason = str(report.longrepr[2] if isinstance(report.longrepr, tuple) else report.longrepr)
    if not any(re.search(known, reason) for known in MAY_BE_SKIPPED):
        report.outcome = "failed"
        report.longrepr = f"{report.nodeid}: {reason}. In CI, only reasons in tests/conftest.py (MAY_BE_SKIPPED) skip."
    return report


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector):
    report = yield
    return _or_skipped_for_a_known_reason(report)


# --- other units -----------------------------------------------------------------------------------------------------


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
