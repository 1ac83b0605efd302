"""Daemons for tests: a shared one, and separate ones."""

import pytest

from service import Service


@pytest.fixture(scope="session")
def service():
    """One daemon for all tests that do not disturb each other."""
    running = Service()
    yield running
    assert running.close() == 0, running.log_text()


@pytest.fixture
def start():
    """Starts daemons that a test does not share."""
    started = []

    def launch(*flags, **options):
        started.append(Service(*flags, **options))
        return started[-1]

    yield launch
    for running in started:
        running.close()
