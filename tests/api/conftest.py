"""Fixtures of these tests; fixtures.py has them, which the Python package is tested with, too."""

from fixtures import service, start  # noqa: F401
