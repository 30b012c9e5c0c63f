"""Files mapped into memory."""

import gc
import os
import sys

import numpy as np
import pytest

from cathsim_dmc import file_maps


@pytest.fixture
def path(tmp_path):
    values = np.arange(3 * 2**14, dtype=np.uint8)
    (tmp_path / "bytes").write_bytes(values.tobytes())
    return tmp_path / "bytes"


def mapped(path):
    with path.open("rb") as stream:
        return file_maps.mapped(stream)


def test_a_map_has_the_bytes_of_its_file_after_it_is_closed(path):
    pages = mapped(path)
    assert pages.dtype == np.uint8 and pages.tobytes() == path.read_bytes()


def test_what_is_written_to_a_map_stays_there_until_it_is_released(path):
    before, pages = path.read_bytes(), mapped(path)
    pages[7] += 1
    assert path.read_bytes() == before and pages.tobytes() != before
    if os.name == "posix":
        file_maps.release(pages)
        assert pages.tobytes() == before


def test_an_empty_file_has_no_map(tmp_path):
    (tmp_path / "empty").touch()
    with pytest.raises(OSError, match="cannot be mapped"):
        mapped(tmp_path / "empty")


@pytest.mark.skipif(sys.platform != "linux", reason="maps are listed by Linux alone")
def test_a_map_stays_as_long_as_a_part_of_it_is_used(path):
    def listed():
        with open("/proc/self/maps") as maps:
            return str(path) in maps.read()

    part = mapped(path)[5:9].view(np.uint16)
    gc.collect()
    assert listed() and part.view(np.uint8).tolist() == [5, 6, 7, 8]
    del part
    gc.collect()
    assert not listed()
