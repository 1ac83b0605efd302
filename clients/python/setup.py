"""Generates morphod/_sync, which is not in the repository, and calls setuptools.

All settings are in pyproject.toml.
"""
import pathlib
import runpy

import setuptools

TOOL = pathlib.Path(__file__).resolve().parent / "tools" / "synchronous"
runpy.run_path(str(TOOL))["main"]([])
setuptools.setup()
