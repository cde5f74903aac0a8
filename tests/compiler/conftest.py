"""What is done without XLA: structure, passes, units, messages. A test that compiles a program belongs elsewhere."""

import jax.monitoring
import pytest

_compiled = 0


def _count(event: str, duration: float, **_):
    global _compiled
    if event.endswith("backend_compile_duration"):
        _compiled += 1


jax.monitoring.register_event_duration_secs_listener(_count)


@pytest.fixture(autouse=True)
def no_program_is_compiled():
    """Fails a test during which XLA compiles anything, a program kept from an earlier run included."""
    before = _compiled
    yield
    assert _compiled == before, (
        f"{_compiled - before} programs were compiled: tests/kernels and tests/plants are for tests that need XLA"
    )
