"""Files of benchmarks: rows as CSV, and generated parts of Markdown pages between two markers.

Files are replaced atomically, so that a program that is stopped leaves either the old or the new
one."""
import csv
import os
from pathlib import Path


def number(value):
    """Formats a number. Whole numbers keep all digits, so that a seed that was read as a float is
    written unchanged."""
    if isinstance(value, float):
        return str(int(value)) if value.is_integer() and abs(value) < 1e15 else f"{value:.6g}"
    return "" if value is None else str(value)


def replace(path, content):
    """Replaces a file. content: text or bytes."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(path.name + ".new")
    beside.write_bytes(content if isinstance(content, bytes) else content.encode())
    os.replace(beside, path)


def write(path, columns, rows):
    """Writes rows, which are dictionaries. Keys that are not columns are left out."""
    lines = [",".join(columns)
             ] + [",".join(number(row.get(column)) for column in columns) for row in rows]
    replace(path, "\n".join(lines) + "\n")


def read(path, texts):
    """Returns rows: the columns `texts` as text, the others as numbers, or None where they are
    empty. A file that does not exist has no rows."""
    if not Path(path).exists():
        return []
    with open(path, encoding="utf-8", newline="") as file:
        return [{
            key: value if key in texts else None if value == "" else float(value)
            for key, value in row.items()
        } for row in csv.DictReader(file)]


def group(rows, *keys):
    """Returns lists of rows by the values of `keys`, in order of appearance."""
    groups = {}
    for row in rows:
        groups.setdefault(tuple(row[key] for key in keys), []).append(row)
    return groups


def mean(values):
    values = [value for value in values if value is not None]
    return sum(values) / len(values) if values else None


def table(heads, lines):
    """Returns a Markdown table."""
    out = ["| " + " | ".join(heads) + " |", "|" + " --- |" * len(heads)]
    return "\n".join(out + ["| " + " | ".join(line) + " |" for line in lines])


def put_between(path, name, text, otherwise=""):
    """Puts `text` between the markers `name` of a Markdown page, and keeps the rest of the page. A
    page that does not exist begins as `otherwise`. Missing markers are added at its end."""
    begin, end = f"<!-- {name}: begin -->", f"<!-- {name}: end -->"
    path = Path(path)
    page = path.read_text(encoding="utf-8") if path.exists() else otherwise
    if begin not in page or end not in page:
        page = page.rstrip("\n") + f"\n\n{begin}\n{end}\n"
    before, rest = page.split(begin, 1)
    behind = rest.split(end, 1)[1]
    replace(path, f"{before}{begin}\n{text.strip()}\n{end}{behind}")
