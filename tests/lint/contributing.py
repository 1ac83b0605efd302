#!/usr/bin/python3
"""Follows the worked examples of docs/contributing.md: applies the diffs of each section to a copy
of the sources, compiles every C file that they touch, and runs the unit tests that they extend.

Usage: contributing.py CC LIBMORPHO. Prints TAP: one line for each example. The room that an example
changes is compiled again, and the rest of it comes from LIBMORPHO."""
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

TOP = Path(__file__).resolve().parents[2]
FLAGS = ["-std=gnu17", "-D_GNU_SOURCE", "-O1", "-ffp-contract=off", "-Wall", "-Werror"]
ADDED_CASE = re.compile(r'^\+    \{"([^"]+)", \w+\},$', re.M)


def examples():
    """Titles of the sections that have diffs, each with its diffs as one text."""
    text = (TOP / "docs/contributing.md").read_text()
    for section in re.split(r"^## ", text, flags=re.M)[1:]:
        diffs = re.findall(r"^```diff\n(.*?)^```$", section, re.M | re.S)
        if diffs:
            yield section.split("\n")[0], "".join(diffs)


def run(command, folder, **options):
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=300,
                          check=False, **options)
    return done.returncode, done.stdout + done.stderr


def follow(diff, compiler, library, copy):
    """What is wrong with an example: a list of lines, empty if it works."""
    for name in ("include", "src", "tests/unit", "docs"):
        shutil.copytree(TOP / name, copy / name)
    error, output = run(["git", "apply", "-"], copy, input=diff)
    if error != 0:
        return ["the diffs do not apply:", *output.splitlines()]
    faults = []
    changed = re.findall(r"^\+\+\+ b/(\S+\.c)$", diff, re.M)
    tests = [name for name in changed if name.startswith("tests/")]
    rooms = sorted({Path(name).parent for name in changed if name.startswith("src/")})
    sources = [str(path) for room in rooms for path in sorted((copy / room).glob("*.c"))]
    cases = ADDED_CASE.findall(diff)
    for test in tests:
        error, output = run([compiler, *FLAGS, "-Iinclude", "-Isrc", "-o", "test", test, *sources,
                             library, "-ljansson", "-lm", "-ldl", "-lpthread"], copy)
        if error != 0:
            return [f"{test} does not compile:", *output.splitlines()]
        error, output = run(["./test"], copy)
        if error != 0:
            faults += [f"{test} fails:", *output.splitlines()]
        cases = [case for case in cases if not re.search(rf"^ok \d+ - {re.escape(case)}$", output,
                                                         re.M)]
    return faults + [f"no test ran this case: {case}" for case in cases] + (
        [] if tests and ADDED_CASE.search(diff) else ["the example adds no test"])


def main(compiler, library):
    found = list(examples())
    print(f"1..{len(found) + 1}")
    print(f"{'ok' if found else 'not ok'} 1 - docs/contributing.md has examples")
    for number, (title, diff) in enumerate(found, 2):
        with tempfile.TemporaryDirectory() as folder:
            faults = follow(diff, compiler, str(Path(library).resolve()), Path(folder))
        for fault in faults:
            print(f"# {fault}")
        print(f"{'not ok' if faults else 'ok'} {number} - {title}")


if __name__ == "__main__":
    main(*sys.argv[1:])
