"""Large arrays that follow each other get the same pages while memory is kept, and the system has them back afterwards."""

import sys

import numpy as np
import pytest

from noiseflow.resources import _glibc, hand_back, kept_memory

pytestmark = pytest.mark.skipif(sys.platform != "linux" or _glibc() is None, reason="glibc alone is told")
_BYTES, _PAGE = 64 * 2**20, 4096


def new_pages() -> int:
    """How many pages the system had to clear for one large array."""
    import resource

    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    np.empty(_BYTES, np.uint8).fill(1)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before


def resident() -> int:
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * _PAGE


def test_pages_are_cleared_once_and_handed_back_by_the_outermost() -> None:
    with kept_memory():
        new_pages()
        with kept_memory():
            pass
        assert new_pages() < 100
        held = resident()
    assert resident() < held - _BYTES / 2


def test_between_two_parts_of_something_long_memory_can_be_handed_back() -> None:
    with kept_memory():
        new_pages()
        held = resident()
        hand_back()
        assert resident() < held - _BYTES / 2


@kept_memory()
def fail() -> None:
    new_pages()
    raise KeyError(resident())


def test_an_error_inside_hands_the_memory_back_too() -> None:
    with pytest.raises(KeyError) as caught:
        fail()
    assert resident() < caught.value.args[0] - _BYTES / 2
