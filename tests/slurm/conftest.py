"""Fixtures: a Slurm cluster on this machine, and the services of the API tests."""

import pathlib
import sys

import pytest

sys.path.insert(0, str(pathlib.Path(__file__).parent))
sys.path.insert(1, str(pathlib.Path(__file__).parents[1] / "api"))

import cluster  # noqa: E402
from fixtures import start  # noqa: E402, F401


@pytest.fixture(scope="session")
def slurm():
    if lacks := cluster.missing():
        pytest.skip(lacks)
    running = cluster.Cluster()
    yield running
    running.close()
