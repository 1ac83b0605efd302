"""The Python package against real daemons."""

import pathlib
import sys

SOURCE = pathlib.Path(__file__).resolve().parents[2]
sys.path[:0] = [str(SOURCE / "clients" / "python"), str(SOURCE / "tests" / "api")]

import morphod
import pytest
from fixtures import service, start  # noqa: F401


@pytest.fixture
def m(service):  # noqa: F811
    with morphod.Client(f"http://{service.host}:{service.port}") as client:
        yield client


@pytest.fixture(scope="session")
def campaign(service):  # noqa: F811
    """Two replicates that have ended."""
    with morphod.Client(f"http://{service.host}:{service.port}") as client:
        group = client.campaign("zero-shot", preset="demo", replicates=2, population=24,
                                generations=5, label="for tests", physics={"n_steps": 60})
        group.wait()
        yield [member.id for member in group]
