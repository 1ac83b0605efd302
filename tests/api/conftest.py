"""Fixtures of these tests. They are in fixtures.py, which the tests of the Python package also
use."""

from fixtures import service, start  # noqa: F401
