"""Deliberate faults stand where the code stands: one whose place has moved would notice nothing for ever."""

import pytest
from problems import ROOT
from test_house import ORDER, room

from benchmarks.attack.invariance import planted
from benchmarks.faults import FAULTS


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.file)
def test_a_fault_has_one_place_and_tests(fault):
    assert (ROOT / "jaxonomy_dae" / fault.file).read_text().count(fault.right) == 1
    assert all((ROOT / tests).exists() for tests in fault.tests.split())


def test_every_room_has_a_fault():
    """But for types, texts and the table of tolerances."""
    rooms = {room(tuple(fault.file.removesuffix(".py").split("/"))) for fault in FAULTS}
    assert rooms | {"base/aliases", "base/errors", "base/tolerances"} == set(ORDER)


@pytest.mark.parametrize("fault", planted.FAULTS, ids=lambda fault: fault.what)
def test_what_a_fault_replaces_is_there(fault):
    with planted.planted(fault):
        pass
