#!/usr/bin/python3
"""Prints what ninja has to build for some of the tests of a build folder: `targets.py FOLDER
--suite NAME…` or `--no-suite NAME…`, as for meson test."""
import argparse
import json
import os
import subprocess
import sys


def introspect(folder, what):
    return json.loads(
        subprocess.run(["meson", "introspect", folder, what], check=True,
                       capture_output=True).stdout)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("folder")
    parser.add_argument("--suite", action="append", default=[])
    parser.add_argument("--no-suite", action="append", default=[])
    arguments = parser.parse_args()
    folder = os.path.abspath(arguments.folder)
    files = {target["id"]: target["filename"] for target in introspect(folder, "--targets")}
    needed = set()
    for test in introspect(folder, "--tests"):
        suites = {suite.split(":")[-1] for suite in test["suite"]}
        if suites.intersection(arguments.no_suite) or (arguments.suite and
                                                       not suites.intersection(arguments.suite)):
            continue
        for target in test["depends"]:
            needed.update(os.path.relpath(file, folder) for file in files[target])
    print("\n".join(sorted(needed)))


sys.exit(main())
