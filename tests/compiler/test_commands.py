"""The commands that run the tests: what they say of arguments that cannot work, and a cache that cannot be written."""

import os
import subprocess
import sys

import pytest
from problems import ROOT


def made(*arguments: str) -> subprocess.CompletedProcess[str]:
    """`make` without anything being run for its own sake: targets that exist already, and a plan of the rest."""
    outside = {name: value for name, value in os.environ.items() if not name.startswith("MAKE")}
    return subprocess.run(["make", "-n", *arguments], cwd=ROOT, env=outside, capture_output=True, text=True)


def test_a_part_is_passed_on():
    assert "--splits 8 --group 3" in made("test-all", "PART=3/8").stdout


@pytest.mark.parametrize("part", ["3", "0/8", "third", "3/8/2"])
def test_what_is_not_a_part(part):
    command = made("test-all", f"PART={part}").stdout.partition("if [ -n")[2].partition("exit 2; fi")[0]
    run = subprocess.run(["bash", "-c", f"if [ -n{command}exit 2; fi"], capture_output=True, text=True)
    assert run.returncode == 2 and f"PART={part} is not a part: PART=3/8 is the third of eight" in run.stderr


def run_pytest(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "tests/compiler/test_house.py", *arguments]
    return subprocess.run(command, cwd=ROOT, env={**os.environ, **environment}, capture_output=True, text=True)


@pytest.mark.slow
def test_a_part_out_of_range():
    run = run_pytest("--splits", "8", "--group", "9")
    assert run.returncode == pytest.ExitCode.USAGE_ERROR and "must be >= 1 and <= 8" in run.stderr


@pytest.mark.slow
def test_a_cache_that_cannot_be_written(tmp_path):
    (tmp_path / "file").touch()
    run = run_pytest(JAX_COMPILATION_CACHE_DIR=str(tmp_path / "file" / "cache"))
    assert run.returncode == 0, run.stdout
    assert f"compiled programs are not kept: {tmp_path / 'file' / 'cache'} cannot be written" in run.stdout
