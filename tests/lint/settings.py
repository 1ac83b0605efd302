"""settings.py PROGRAM DOCUMENT: every setting of the tables must be in a table of the document.

PROGRAM is tools/settings.c, which lists the settings. The document needs a row with `name` for each
setting, and with its default if that is a single number. Members of an object are inside the
object.
"""

import re
import subprocess
import sys


def names(row, name, default):
    """Returns whether a row contains a setting and, if the default is a number, the default."""
    if f"`{name}`" not in row and f'"{name}"' not in row:
        return False
    try:
        value = float(default)
    except ValueError:
        return True
    return any(float(number) == value for number in re.findall(r"\d+(?:\.\d+)?(?:e-?\d+)?", row))


def main():
    program, document = sys.argv[1:]
    run = subprocess.run([program, "list"], check=True, capture_output=True, text=True)
    listed = run.stdout.splitlines()
    with open(document, encoding="utf-8") as file:
        table = [line for line in file if line.startswith("|")]
    print(f"1..{len(listed)}")
    failed = 0
    for number, line in enumerate(listed, 1):
        kind, place, default, _ = line.split("\t")
        # Campaigns that learn have the defaults of training runs if the row has no default.
        shown = "" if place.startswith("learning.") else default
        good = any(names(row, place.split(".")[-1], shown) for row in table)
        failed += not good
        print(f"{'ok' if good else 'not ok'} {number} - {kind}: {place} {default}")
    sys.exit(failed > 0)


main()
