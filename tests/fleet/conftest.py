"""Fixtures of the fleet tests: those of the crash tests, and workers."""
import os
import pathlib
import sys

import pytest

TESTS = pathlib.Path(__file__).parents[1]
sys.path[:0] = [os.fspath(TESTS / name) for name in ("fleet", "crash", "api")]

from machines import Worker  # noqa: E402
from surroundings import (  # noqa: E402, F401
    daemon, folder, pytest_report_header, seed, small_disk, soak)


@pytest.fixture
def worker(folder):  # noqa: F811
    """worker(address, name, …) starts one; all of them are stopped at the end of the test."""
    started = []

    def start(*arguments, **how):
        started.append(Worker(folder, *arguments, **how))
        return started[-1]

    yield start
    for one in started:
        one.close()
