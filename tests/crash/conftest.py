"""Fixtures of the crash tests, from surroundings.py, which tests/fleet also uses."""
import os
import sys

sys.path.insert(0, os.path.dirname(__file__))

from surroundings import (  # noqa: E402, F401
    daemon, folder, pytest_report_header, seed, small_blocks, small_disk, soak,
    training_disk)
