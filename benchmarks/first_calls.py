"""What comes before the first number of a model, and before its first gradient: processor seconds, and programs.

    python -m benchmarks.first_calls [--models "house,plate"] [--beside ../older] [--warm] [--no-gradient]

Twelve models (`first_models.py`), each in fresh processes: one builds the model, simulates, reads a variable; one
builds it and differentiates the end of that variable by a parameter, outside of jit. XLA's options are the defaults,
and nothing that was compiled before is found. With `--warm`, a second process follows that finds what the first kept.
Seconds are of the processor, without imports. `--beside` measures another tree, too.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from statistics import median
from typing import Any

HERE = Path(__file__).resolve().parent.parent
COMPILED = "/jax/core/compile/backend_compile_duration"  # what JAX reports at each program (`jax.monitoring`)


def measured(name: str, gradient: bool) -> dict[str, Any]:
    """What one model costs in this process."""
    import jax

    jax.config.update("jax_enable_x64", True)
    import numpy as np

    from benchmarks.first_models import MODELS, times
    from jaxonomy_dae import simulate

    spent, programs, within = Counter(), [], [0.0]

    def timed(kind: str, module: Any, function: str) -> None:
        """Adds the processor seconds of calls, without those of timed calls within them, to `spent`."""
        original = getattr(module, function)

        def call(*args: Any, **kwargs: Any) -> Any:
            begin = time.process_time()
            within.append(0.0)
            try:
                return original(*args, **kwargs)
            finally:
                took = time.process_time() - begin
                spent[kind] += took - within.pop()
                within[-1] += took

        setattr(module, function, call)

    from jax._src import compiler as xla
    from jax._src.interpreters import mlir, partial_eval

    timed("xla", xla, "backend_compile_and_load")
    timed("lower", mlir, "lower_jaxpr_to_module")
    timed("trace", partial_eval, "trace_to_jaxpr")

    def listen(event: str, seconds: float, **what: Any) -> None:
        if event == COMPILED:
            programs.append((what.get("fun_name", "?"), round(seconds, 2)))

    jax.monitoring.register_event_duration_secs_listener(listen)
    model = MODELS[name]
    found: dict[str, Any] = {}
    begin, clock = time.process_time(), time.perf_counter()
    compiler = model.build()
    built = time.process_time()
    system = compiler()
    compiled = time.process_time()
    if gradient:

        def end(value: Any) -> Any:
            run = simulate(system.with_parameters({model.by: value}), model.t1, ts=times(model), **model.options)
            return run[model.reads][-1]

        number = float(jax.grad(end)(float(system.parameters[model.by])))
    else:
        number = float(np.asarray(simulate(system, model.t1, ts=times(model), **model.options)[model.reads])[-1])
    done = time.process_time()
    found = {
        "build": built - begin, "compile": compiled - built, "call": done - compiled, "cpu": done - begin,
        "clock": time.perf_counter() - clock, "number": number, "programs": len(programs),
        "large": [p for p in programs if p[1] >= 0.05], "names": Counter(p[0] for p in programs), **spent,
    }  # fmt: skip
    if not gradient:
        begin = time.process_time()
        simulate(system, model.t1, ts=times(model), **model.options)[model.reads]
        found["again"] = time.process_time() - begin
    return found


def in_a_process(name: str, gradient: bool, tree: Path, cache: str, jax_cache: bool) -> dict[str, Any]:
    """What one model costs in a fresh process that imports the package from `tree` and keeps programs in `cache`."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("XLA_FLAGS", "JAX_COMPILATION", "JAX_PERSISTENT"))}
    kept |= {"PYTHONPATH": f"{tree}{os.pathsep}{HERE}", "JAXONOMY_DAE_CACHE": cache, "JAX_PLATFORMS": "cpu"}
    if jax_cache:
        kept |= {"JAX_COMPILATION_CACHE_DIR": cache, "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    command = [sys.executable, "-m", "benchmarks.first_calls", "--one", name, *["--gradient"] * gradient]
    done = subprocess.run(command, env=kept, cwd=HERE, capture_output=True, text=True)
    if done.returncode:
        return {"error": done.stderr.strip().splitlines()[-1][:100]}
    return json.loads(done.stdout.splitlines()[-1])


def row(label: str, found: dict[str, Any]) -> str:
    if "error" in found:
        return f"{label:<34}{found['error']}"
    columns = ("build", "compile", "trace", "lower", "xla", "cpu", "again")
    return f"{label:<34}" + "".join(f"{found.get(c, float('nan')):>8.2f}" for c in columns) + f"{found['programs']:>9}"


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--models", default="")
    parser.add_argument("--beside", default="", help="another tree to be measured")
    parser.add_argument("--warm", action="store_true", help="measure a second process, too")
    parser.add_argument("--jax-cache", action="store_true", help="keep programs in JAX's own persistent cache")
    parser.add_argument("--no-gradient", action="store_true")
    parser.add_argument("--no-value", action="store_true")
    parser.add_argument("--verbose", action="store_true", help="list programs")
    parser.add_argument("--one", default="", help="measure one model in this process")
    parser.add_argument("--gradient", action="store_true")
    asked = parser.parse_args()
    if asked.one:
        print(json.dumps(measured(asked.one, asked.gradient)))
        return
    from benchmarks.first_models import MODELS

    trees = [HERE, *([Path(asked.beside).resolve()] if asked.beside else [])]
    columns = "".join(f"{c:>8}" for c in ("build", "compile", "trace", "lower", "XLA", "CPU", "again"))
    print(f"{'seconds':<34}{columns}{'programs':>9}", flush=True)
    collected: dict[str, list[float]] = {}
    for name in [m for m in asked.models.split(",") if m] or MODELS:
        for gradient in (False, True):
            if (asked.no_gradient and gradient) or (asked.no_value and not gradient):
                continue
            for tree in trees:
                with tempfile.TemporaryDirectory() as cache:
                    for turn in ("first", "second") if asked.warm else ("first",):
                        found = in_a_process(name, gradient, tree, cache, asked.jax_cache)
                        label = f"{'gradient' if gradient else 'value'}, {turn}{'' if tree == HERE else ', beside'}"
                        print(row(f"{name}: {label}", found), flush=True)
                        if asked.verbose and "error" not in found:
                            print("   ", found["large"], dict(found["names"]), flush=True)
                        if "cpu" in found:
                            collected.setdefault(label, []).append(found["cpu"])
    for label, values in collected.items():
        print(f"median {label}: {median(values):.2f} CPU s, most {max(values):.2f}, of {len(values)} models")


if __name__ == "__main__":
    main()
