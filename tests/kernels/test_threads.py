"""Factorizations by one thread."""

import contextlib

import numpy as np
import pytest
import scipy.linalg

from jaxonomy_dae.host import threads


def test_large_work_has_all_threads():
    assert isinstance(threads.one_thread(2 * threads.LARGE), contextlib.nullcontext)


def test_threads_are_as_many_as_before_afterwards():
    def counts():
        return [lib["num_threads"] for lib in threads._controller().info() if lib["user_api"] == "blas"]

    scipy.linalg.qr(np.eye(3))
    before = counts()
    assert before
    with pytest.raises(ZeroDivisionError), threads.one_thread(1.0):
        assert counts() == [1] * len(before)
        raise ZeroDivisionError
    assert counts() == before
