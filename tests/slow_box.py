"""Slow tests for so many minutes: `--minutes 25`.

Given are the slow tests, how long each took (`durations.json`) and when each passed last on this machine. The tests
that nobody has timed come first, then those that did not pass for the longest time. Among equals, as in a fresh clone
on a fresh machine, they stand on a circle on which each landing begins elsewhere, and nothing needs to be committed.
When the time is spent, no further test begins. Those that run end, so that nothing is cut.
"""

import datetime
import itertools
import json
import math
import os
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

DURATIONS = Path(__file__).with_name("durations.json")
# Turns by this share of a circle leave the smallest gaps, however many are made: three of them cover it with windows of
# 0.39 each.
GOLDEN = (math.sqrt(5) - 1) / 2

# A test that would end later than by this share of the box waits for the next one, where it may begin early. A landing
# takes 40 minutes: eight for what is checked before, 25, and a quarter more.
BEYOND = 0.25


def minutes(text: str) -> float:
    """What `--minutes` says; refused in one sentence."""
    try:
        found = float(text)
    except ValueError:
        found = math.nan
    if not 0 < found < math.inf:
        raise pytest.UsageError(f"how many minutes? a positive number, as in make test-slow MINUTES=25; got {text!r}")
    return found


def turn() -> float:
    """Where on the circle a run of today and of this commit begins, from zero to one."""
    command = ["git", "rev-list", "--first-parent", "--count", "HEAD"]
    try:
        counted = subprocess.run(command, cwd=DURATIONS.parent, capture_output=True, text=True).stdout.strip()
    except OSError:  # there is no git
        counted = ""
    return (int(counted or 0) + datetime.date.today().toordinal()) * GOLDEN % 1.0


def in_order(
    tests: Sequence[str], seconds: dict[str, float], passed: dict[str, float], turn: float, processes: int = 1
) -> list[str]:
    """The tests as they run. Of several processes, each takes an equal share, one after the other, as
    `--dist worksteal` hands them out."""
    known = [seconds[test] for test in tests if test in seconds]
    mean = sum(known) / len(known) if known else 1.0
    ends = dict(zip(tests, itertools.accumulate(seconds.get(test, mean) for test in tests), strict=True))
    begin = turn * ends[tests[-1]] if tests else 0.0

    def group(test: str) -> tuple[bool, float, bool, str]:
        """Those of a file share programs, and stay together as far as they have waited equally long."""
        return test in seconds, passed.get(test, 0.0), ends[test] <= begin, test.partition("::")[0]

    sizes = [len(tests) // processes + (k >= processes - len(tests) % processes) for k in range(processes)]
    shares: list[list[str]] = [[] for _ in sizes]
    busy = [0.0] * processes
    for _, together in itertools.groupby(sorted(tests, key=group), key=group):  # the rest as it stands in the file
        waiting = list(together)
        while waiting:
            k = min((k for k in range(processes) if len(shares[k]) < sizes[k]), key=busy.__getitem__)
            taken, waiting = waiting[: sizes[k] - len(shares[k])], waiting[sizes[k] - len(shares[k]) :]
            shares[k] += taken
            busy[k] += sum(seconds.get(test, mean) for test in taken)
    return [test for share in shares for test in share]


def _memory() -> Path:
    """When slow tests passed, in the user's cache directory."""
    caches = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(caches) / "jaxonomy_dae" / "slow_tests.json"


def _read(file: Path) -> dict[str, float]:
    try:
        return json.loads(file.read_text())
    except (OSError, ValueError):  # not there, or not whole: as if no test had ever passed
        return {}


class SlowBox:
    """Puts the tests in order, stops beginning new ones, and counts. Under pytest-xdist each process has one: that
    which hands out the tests tells the others when it began and what it remembers."""

    def __init__(self, minutes: float, told: dict[str, Any] | None):
        self.minutes = minutes
        self.told = told or {
            "began": time.time(),
            "passed": _read(_memory()),
            "seconds": _read(DURATIONS),
            "turn": turn(),
        }
        self.tests = 0
        self.begun = False
        self.ran: dict[str, bool] = {}  # whether it passed

    @pytest.hookimpl(trylast=True)  # after those that are not slow have been left out
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        self.tests = len(items)
        found = {item.nodeid: item for item in items}
        processes = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", 1))
        told = self.told
        ordered = in_order(list(found), told["seconds"], told["passed"], told["turn"], processes)
        items[:] = [found[test] for test in ordered]

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> bool | None:
        """True, as if it had been seen to, for a test that is left for the next run."""
        spent, whole = time.time() - self.told["began"], 60 * self.minutes
        ends = spent + self.told["seconds"].get(item.nodeid, 0.0)
        if spent > whole or (self.begun and ends > (1 + BEYOND) * whole):
            return True
        self.begun = True
        return None

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self.ran[report.nodeid] = self.ran.get(report.nodeid, True) and report.outcome != "failed"

    @pytest.hookimpl(optionalhook=True)  # of pytest-xdist
    def pytest_configure_node(self, node: Any) -> None:
        node.workerinput["slow_box"] = self.told

    @pytest.hookimpl(optionalhook=True)
    def pytest_xdist_node_collection_finished(self, ids: Sequence[str]) -> None:
        self.tests = len(ids)

    # --- at the end ---

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        spent = (time.time() - self.told["began"]) / 60
        left = self.tests - len(self.ran)
        terminalreporter.write_line(f"{len(self.ran)} slow tests ran in {spent:.1f} minutes, {left} are left")

    def remember(self) -> None:
        """That tests passed; those that failed are due."""
        now = self.told["began"]
        passed = {test: now for test, right in self.ran.items() if right}
        failed = [test for test, right in self.ran.items() if not right]
        kept = {test: when for test, when in (_read(_memory()) | passed).items() if test not in failed}
        try:
            _memory().parent.mkdir(parents=True, exist_ok=True)
            part = _memory().with_suffix(f".{os.getpid()}")
            part.write_text(json.dumps(kept, indent=0))
            part.replace(_memory())
        except OSError:
            pass  # the circle has turned at the next run

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        if not hasattr(session.config, "workerinput"):
            self.remember()


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--minutes", default=None, help="run slow tests, those that waited longest first, for so long")


def pytest_configure(config: pytest.Config) -> None:
    given = config.getoption("--minutes")
    if given is not None:
        told = getattr(config, "workerinput", {}).get("slow_box")
        config.pluginmanager.register(SlowBox(minutes(given), told), "slow_box_of_this_run")
