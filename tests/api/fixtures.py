"""Daemons for tests: one that they share, and those of a test's own."""

import pytest

from service import Service


@pytest.fixture(scope="session")
def service():
    """One daemon for the tests that do not disturb each other."""
    running = Service()
    yield running
    assert running.close() == 0, running.log_text()


@pytest.fixture
def start():
    """Starts daemons of a test's own."""
    started = []

    def launch(*flags, **options):
        started.append(Service(*flags, **options))
        return started[-1]

    yield launch
    for running in started:
        running.close()
