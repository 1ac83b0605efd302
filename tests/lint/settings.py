"""settings.py PROGRAM DOCUMENT: every setting of the tables stands in the document with its default.

PROGRAM is tools/settings.c, which lists them. The document has a table with a row `name`, … for the
settings of each kind of job; members of an object stand in the object.
"""

import subprocess
import sys


def rows(document):
    return [line for line in open(document, encoding="utf-8") if line.startswith("|")]


def says(row, name, default):
    """Whether a row of the table names a setting and, if that is a number, its default."""
    if f"`{name}`" not in row and f'"{name}"' not in row:
        return False
    try:
        value = float(default)
    except ValueError:
        return True
    numbers = row.replace(",", " ").replace("}", " ").replace(":", " ").replace("|", " ").split()
    return any(number.strip("`") in (default, f"{value:g}", f"{value:g}".replace("e-0", "e-")) for number in numbers)


def main():
    program, document = sys.argv[1:]
    listed = subprocess.run([program, "list"], check=True, capture_output=True, text=True).stdout.splitlines()
    table = rows(document)
    print(f"1..{len(listed)}")
    failed = 0
    for number, line in enumerate(listed, 1):
        kind, place, default, _ = line.split("\t")
        # Learning settings of campaigns have the defaults of trainings, unless the row says otherwise.
        learning = place.startswith("learning.")
        good = any(says(row, place.split(".")[-1], "" if learning else default) for row in table)
        failed += not good
        print(f"{'ok' if good else 'not ok'} {number} - {kind}: {place} {default}")
    sys.exit(failed > 0)


main()
