"""Verdicts about models of one family, in processes whose OpenBLAS uses the kernels of other processors.

Each process reads seeds from its input and answers each with the verdicts about the model and about those with other
roundings, as JSON. The kernels differ in the last digits of products and decompositions; those that this processor does
not have the instructions for, or that round as others do, are left out.
"""

import dataclasses
import functools
import hashlib
import importlib
import json
import os
import resource
import subprocess
import sys
import time

import numpy as np

CORES = ("Haswell", "Zen", "Sandybridge", "Nehalem", "SkylakeX")


@dataclasses.dataclass(frozen=True)
class Verdict:
    """How many states a model has, None where it is refused; and the error's text."""

    states: int | None
    text: str = ""


def verdict(diagram, mode: str = "auto") -> Verdict:
    """What the compiler, or else the examination of blocks at the start, says of a model; in NumPy alone."""
    from jaxonomy_dae.compile.lowering.lower import lower
    from jaxonomy_dae.compile.model.consistent_point import initial_point
    from jaxonomy_dae.compile.model.declared import start_guess
    from jaxonomy_dae.compile.passes.flatten import flatten
    from jaxonomy_dae.compile.passes.pipeline import compile_flat
    from jaxonomy_dae.errors import ModelError
    from jaxonomy_dae.run.start.singular_blocks import examine_blocks

    flat = flatten(diagram)
    try:
        plan = lower(compile_flat(flat, mode, ()))
    except ModelError as error:
        return Verdict(None, f"{type(error).__name__}: {error}")
    at = initial_point(plan.model, flat.declares)
    values = at.values[:-1].copy()
    _, fixed = start_guess(plan.model, flat.declares.values)
    values[list(fixed)] = list(fixed.values())
    x = values[[*plan.states, *plan.carried]]
    for finding in examine_blocks(plan, at.parameters, at.networks.weights, 0.0, x, lambda: np.zeros(0)):
        if finding.singular:
            return Verdict(None, "InitializationError: a block is singular at the start")
    return Verdict(len(plan.states))


class Kernels:
    """The processes, one for each kind of kernels."""

    def __init__(self, family: str):
        self.processes, digits = {}, set()
        for core in CORES:
            environment = os.environ | {"OPENBLAS_CORETYPE": core, "OPENBLAS_NUM_THREADS": "1", "JAX_ENABLE_X64": "1"}
            process = subprocess.Popen(
                [sys.executable, "-m", "benchmarks.attack.kernels", family], env=environment, text=True,
                stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            )  # fmt: skip
            assert process.stdout is not None
            said = process.stdout.readline()
            if said and said not in digits:
                digits.add(said)
                self.processes[core] = process
            else:
                process.kill()
                process.communicate()  # closes its pipes

    def verdicts(self, seed: int) -> tuple[dict[str, list[Verdict]], float]:
        """Of the model of a seed, by kernels; and the processor time that all of them took."""
        found, total = {}, 0.0
        for core, process in self.processes.items():
            process.stdin.write(f"{seed}\n")
            process.stdin.flush()
            seconds, verdicts = json.loads(process.stdout.readline())
            found[core] = [Verdict(*pair) for pair in verdicts]
            total += seconds
        return found, total


@functools.cache
def kernels_for(family: str) -> Kernels:
    """Started once; they end with their input, when this process does."""
    return Kernels(family)


def _digits() -> str:
    """What products and decompositions come to, to the last bit."""
    a = np.random.default_rng(0).normal(size=(40, 43))
    found = [a @ a.T, a @ a[0], *np.linalg.svd(a), np.linalg.inv(a[:, :40]), np.linalg.qr(a)[0]]
    return hashlib.sha256(b"".join(part.tobytes() for part in found)).hexdigest()


def main() -> None:
    family = importlib.import_module(f".{sys.argv[1]}", __package__)
    # The limit of processor time of one model, which a process that judges models has, is not that of all.
    _, hard = resource.getrlimit(resource.RLIMIT_CPU)
    resource.setrlimit(resource.RLIMIT_CPU, (hard, hard))
    print(_digits(), flush=True)
    for line in sys.stdin:
        start = time.process_time()
        found = [verdict(*family.model(int(line), roundings)) for roundings in family.ROUNDINGS]
        seconds = time.process_time() - start
        print(json.dumps([seconds, [dataclasses.astuple(v) for v in found]]), flush=True)


if __name__ == "__main__":
    main()
