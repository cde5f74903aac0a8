"""Slow tests in a time box: in which order, and what is said of what ran, of what is left and of what broke."""

import os
import re
import subprocess
import sys

import pytest
import slow_box
from problems import ROOT

WAITS = ("time.sleep(0.5)", "os.getcwd()")
TESTS = [f"{file}.py::test_{k}" for file in "abc" for k in range(4)]
SECONDS = dict.fromkeys(TESTS, 10.0)


def order(passed=None, turn=0.0, tests=TESTS):
    return slow_box.in_order(tests, SECONDS, passed or {}, turn)


def test_new_tests_run_first():
    """A file of durations that is stale does not know them."""
    assert order(tests=[*TESTS, "b.py::test_new"])[0] == "b.py::test_new"


def test_those_that_waited_longest_run_first():
    passed = {test: 5.0 for test in TESTS} | {"c.py::test_1": 2.0}
    del passed["b.py::test_3"]
    assert order(passed)[:2] == ["b.py::test_3", "c.py::test_1"]


def test_each_turn_begins_elsewhere():
    """Five of twelve tests fit into the box: three turns run all of them, wherever they begin."""
    for first in (0.0, 0.25, 0.7):
        ran = {test for k in range(3) for test in order(turn=(first + k * slow_box.GOLDEN) % 1.0)[:5]}
        assert ran == set(TESTS)


def test_each_process_takes_whole_files():
    """`--dist worksteal` cuts the list into equal parts: each begins with what waited longest."""
    ordered = slow_box.in_order(TESTS, SECONDS, dict.fromkeys(TESTS[:4], 1.0), 0.0, processes=2)
    assert ordered == [*TESTS[4:8], *TESTS[:2], *TESTS[8:], *TESTS[2:4]]
    assert sorted(slow_box.in_order(TESTS, {}, {}, 0.3, processes=5)) == TESTS


@pytest.fixture
def boxed(tmp_path):
    """Runs pytest with the plug-in alone on one file of tests; returns status and text."""
    (tmp_path / "pytest.ini").write_text("[pytest]\nmarkers = slow\n")

    def run(source: str, *arguments: str) -> tuple[int, str]:
        (tmp_path / "test_them.py").write_text(f"import os, time, pytest\npytestmark = pytest.mark.slow\n{source}")
        command = [sys.executable, "-m", "pytest", "-q", "-p", "slow_box", "-p", "xdist", *arguments]
        changed = {
            "PYTHONPATH": str(ROOT / "tests"),
            "XDG_CACHE_HOME": str(tmp_path / "caches"),
            "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1",
        }
        done = subprocess.run(command, cwd=tmp_path, env=os.environ | changed, capture_output=True, text=True)
        return done.returncode, done.stdout + done.stderr

    return run


@pytest.mark.parametrize("given", ["0", "-3", "soon", "nan", ""])
def test_what_is_not_a_time(boxed, given):
    status, text = boxed("def test_it(): pass", "--minutes", given)
    said = f"how many minutes? a positive number, as in make test-slow MINUTES=25; got {given!r}"
    assert status == pytest.ExitCode.USAGE_ERROR and said in text and "Traceback" not in text


@pytest.mark.parametrize("processes", [(), pytest.param(("-n", "2"), marks=pytest.mark.slow)])
def test_the_time_is_spent(boxed, processes):
    """Those that run end; those that are left are counted, and run in the next box."""
    slow, fast = ("@pytest.mark.parametrize('k', range(30))\ndef test_it(k): " + does for does in WAITS)
    left = 30
    for source, minutes in ((slow, "0.04"), (fast, "5")):
        status, text = boxed(source, "--minutes", minutes, *processes)
        ran, then = map(int, re.findall(r"(\d+) slow tests ran in \d+\.\d minutes, (\d+) are left", text)[0])
        assert status == 0 and re.search(rf"^{ran} passed in", text, re.MULTILINE)
        assert 0 < ran == 30 - then
        left = then if minutes == "0.04" else left
    assert 0 < left < 30 and then == 0


@pytest.mark.slow
def test_a_process_that_dies_names_its_test(boxed):
    status, text = boxed(
        "def test_right(): pass\ndef test_deadly(): os._exit(3)\ndef test_after(): pass", "--minutes", "1", "-n", "2"
    )
    assert status == pytest.ExitCode.TESTS_FAILED
    assert re.search(r"FAILED test_them.py::test_deadly", text) and "crashed while running" in text
    assert "3 slow tests ran in" in text and re.search(r"\n1 failed, 2 passed in", text)


def test_a_failing_test_is_due(boxed):
    status, text = boxed("def test_right(): pass\ndef test_wrong(): assert False", "--minutes", "1")
    assert status == pytest.ExitCode.TESTS_FAILED and "FAILED test_them.py::test_wrong" in text
    _, text = boxed("def test_right(): pass\ndef test_wrong(): assert True", "--minutes", "1", "-v", "-v")
    assert text.index("test_wrong") < text.index("test_right")
