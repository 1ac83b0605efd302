#!/usr/bin/python3
"""Follows the worked examples of docs/contributing.md: applies the diffs of each section to a copy
of the sources, compiles the rooms that they touch, and runs the unit tests that they extend.

Usage: contributing.py CC LIBMORPHO. Prints TAP: one line for each example. A room of the library is
linked with the test, with kernels for the smallest instruction set; a room of the service is only
compiled, and its routes are compared with the contract."""
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import yaml

TOP = Path(__file__).resolve().parents[2]
# The tests take less time than optimizing the rooms for them would.
FLAGS = ["-std=gnu17", "-D_GNU_SOURCE", "-O0", "-ffp-contract=off", "-Wall", "-Werror"]
KERNEL_FLAGS = ["-DMO_FAST_ISA=baseline", "-DMO_VBYTES=16"]
SERVICE = ["store", "jobs", "http", "api", "daemon"]
ROUTE = re.compile(r'^ROUTE\("([^"]+)", (\w+)', re.M)
ADDED_CASE = re.compile(r'^\+    \{"([^"]+)", \w+\},$', re.M)


def examples():
    """Returns the titles of the sections with diffs, each with its diffs as one text."""
    text = (TOP / "docs/contributing.md").read_text()
    for section in re.split(r"^## ", text, flags=re.M)[1:]:
        diffs = re.findall(r"^```diff\n(.*?)^```$", section, re.M | re.S)
        if diffs:
            yield section.split("\n")[0], "".join(diffs)


def run(command, folder, **options):
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=300,
                          check=False, **options)
    return done.returncode, done.stdout + done.stderr


def service_faults(rooms, compiler, built, copy):
    """Checks rooms of the service: their sources must compile, with headers that are generated in
    the folder `built`, and the contract must have their routes."""
    faults = []
    for room in rooms:
        error, output = run([compiler, *FLAGS, "-Wmissing-prototypes", "-fsyntax-only", "-Iinclude",
                             "-Isrc", f"-I{built / room}",
                             *map(str, sorted((copy / "src" / room).glob("*.c")))], copy)
        faults += [f"room {room} does not compile:", *output.splitlines()] if error != 0 else []
    if "api" in rooms:
        paths = yaml.safe_load((copy / "schema/openapi.yaml").read_text())["paths"]
        faults += [f"the contract has no {method} {path}"
                   for path, method in ROUTE.findall((copy / "src/api/routes.inc").read_text())
                   if method.lower() not in paths.get(path, {})]
    return faults


def follow(diff, compiler, library, copy):
    """Returns the faults of an example as a list of lines, empty if it works."""
    for name in ("include", "src", "schema", "tests/unit", "docs"):
        shutil.copytree(TOP / name, copy / name)
    error, output = run(["git", "apply", "-"], copy, input=diff)
    if error != 0:
        return ["the diffs do not apply:", *output.splitlines()]
    changed = re.findall(r"^\+\+\+ b/(\S+)$", diff, re.M)
    tests = [name for name in dict.fromkeys(changed) if name.startswith("tests/")]
    rooms = {Path(name).parts[1] for name in changed if name.startswith("src/")}
    library_rooms = sorted(rooms.difference(SERVICE))
    sources = [str(path) for room in library_rooms
               for path in sorted((copy / "src" / room).glob("*.c"))]
    faults = service_faults(sorted(rooms.intersection(SERVICE)), compiler, library.parent, copy)
    cases = ADDED_CASE.findall(diff)
    for test in tests:
        error, output = run([compiler, *FLAGS, *KERNEL_FLAGS, "-Iinclude", "-Isrc", "-o", "test",
                             test, *sources, str(library), "-ljansson", "-lnettle", "-lm", "-ldl",
                             "-lpthread"], copy)
        if error != 0:
            return [f"{test} does not compile:", *output.splitlines()]
        error, output = run(["./test"], copy)
        if error != 0:
            faults += [f"{test} fails:", *output.splitlines()]
        cases = [case for case in cases if not re.search(rf"^ok \d+ - {re.escape(case)}$", output,
                                                         re.M)]
    if library_rooms and not ADDED_CASE.search(diff):
        faults.append("the example adds no test")
    return faults + [f"no test ran this case: {case}" for case in cases]


def main(compiler, library):
    found = list(examples())
    print(f"1..{len(found) + 1}")
    print(f"{'ok' if found else 'not ok'} 1 - docs/contributing.md has examples")
    for number, (title, diff) in enumerate(found, 2):
        with tempfile.TemporaryDirectory() as folder:
            faults = follow(diff, compiler, Path(library).resolve(), Path(folder))
        for fault in faults:
            print(f"# {fault}")
        print(f"{'not ok' if faults else 'ok'} {number} - {title}")


if __name__ == "__main__":
    main(*sys.argv[1:])
