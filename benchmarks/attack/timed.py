"""Models judged by several processes beside each other until the time is spent."""

import collections
import multiprocessing
import resource
import signal
import threading
import time
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection

from .draws import Draw
from .outcome import GOOD, HEAD, Outcome, row

KEPT = 10  # models whose compiled programs a process keeps
# A model that is late is stopped where Python runs; one that XLA compiles for ever, after as many seconds of processor
# time, with its process.
LONGEST = 90


def serve(connection: Connection) -> None:
    """Judges what comes through the connection, one model after the other, until nothing more comes."""
    from .judge import drop_programs

    _, hard = resource.getrlimit(resource.RLIMIT_CPU)
    count = 0
    while True:
        try:
            draw = connection.recv()
        except EOFError:
            return
        resource.setrlimit(resource.RLIMIT_CPU, (int(time.process_time()) + LONGEST, hard))
        connection.send(draw.judged())
        count += 1
        if count % KEPT == 0:
            drop_programs()


def _worst(found: list[Outcome]) -> Outcome:
    """The first that is not good, or the first."""
    return next((o for o in found if o.kind not in GOOD), found[0])


class Worker:
    """A process that judges models; another takes its place where it dies."""

    def __init__(self):
        self._start()

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.connection, inside = context.Pipe()
        # Some families start processes of their own, which daemons must not; this one ends with its connection.
        self.process = context.Process(target=serve, args=(inside,))
        self.process.start()
        inside.close()

    def judged(self, draw: Draw) -> tuple[str, list[Outcome]]:
        try:
            self.connection.send(draw)
            return self.connection.recv()
        except (EOFError, ConnectionError):
            self.process.join()
            code = self.process.exitcode
            self._start()
            if code == -signal.SIGXCPU:
                return "", [Outcome("late", float("inf"), f"killed after {LONGEST} s", LONGEST)]
            return "", [Outcome("crashed", float("inf"), f"its process ended with exit code {code}", 0.0)]

    def stop(self) -> None:
        self.connection.close()
        self.process.join()


def attack(
    draws: Iterator[Draw], minutes: float, tell: Callable[[str], None], processes: int = 2, refusals: bool = False
) -> bool:
    """Judges models by so many `processes` until the time is spent, and tells of each that is not right or truly
    refused, with `refusals` of those refused as well, and then all counts. Returns whether all were right or truly
    refused."""
    end = time.monotonic() + 60 * minutes
    lock = threading.Lock()
    outcomes: dict[str, list[tuple[int, Outcome]]] = collections.defaultdict(list)

    def work() -> None:
        worker = Worker()
        try:
            while time.monotonic() < end:
                with lock:
                    draw = next(draws)
                note, found = worker.judged(draw)
                with lock:
                    for outcome in found if any(o.part for o in found) else [_worst(found)]:
                        outcomes[draw.row_of(0, outcome)].append((draw.seed, outcome))
                        if outcome.kind not in GOOD or (refusals and outcome.kind == "refused"):
                            tell(f"{outcome.kind}: {draw.row} ({note}): {outcome.text[:600]}\n    {draw.command}")
        finally:
            worker.stop()

    threads = [threading.Thread(target=work) for _ in range(processes)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    tell(HEAD)
    for name, pairs in sorted(outcomes.items()):
        tell(row(name, pairs))
    everything = [pair for pairs in outcomes.values() for pair in pairs]
    if everything:
        tell(row("all", everything))
    return all(outcome.kind in GOOD for _, outcome in everything)
