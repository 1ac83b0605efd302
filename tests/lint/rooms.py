#!/usr/bin/python3
"""Enforces the order of the rooms: a room includes only itself, rooms above it, and the libraries
listed for it.

Prints TAP: one line per room; one per room or client without circles of files (circles.py); then
the rules for all code, including the size of private headers; and one line to show that each rule
can fail."""
import re
import sys
import tempfile
from pathlib import Path

import circles
import tap
from circles import COMMENT, INCLUDE, circles_of, code_files

MOST_STATEMENTS = re.compile(r"#define MO_STATEMENTS_MAX (\d+)")
STATEMENT = re.compile(r"\bmo_sql_(?:do|find|row|rows|change|insert)(?:_with)?\(")

# Rooms in order of dependence, with the external headers that each may use in addition to the C
# library's.
ROOMS = {
    "base": ["nettle/"],
    "morphospace": [],
    "world": [],
    "controller": ["jansson.h"],
    "rollout": [],
    "compute": [],
    "learning": [],
    "evolution": [],
    "certificate": [],
    "atlas": [],
    "store": ["sqlite3.h"],
    "exchange": ["zstd.h"],
    "fleet": [],
    "worker": ["curl/"],
    "jobs": [],
    "http": ["microhttpd.h", "gnutls/"],
    "api": [],
    "daemon": ["systemd/"],
}
# A room that includes only these others, although more come before it: the protocol does not depend
# on jobs.
ONLY = {"http": ["base"]}
CLIENTS = ["base/base64.h", "base/text.h", "base/words.h"]  # shared with clients
LIBRARY = list(ROOMS)[:list(ROOMS).index("store")]  # libmorpho: no output, no exit
FOREIGN = ["jansson.h", "cblas.h", "sqlite3.h", "nettle/", "microhttpd.h", "gnutls/", "systemd/",
           "curl/", "zstd.h"]
PUBLIC = {
    "error.h": "base", "random.h": "base", "morphospace.h": "morphospace", "world.h": "world",
    "task.h": "world",
    "controller.h": "controller", "measure.h": "world", "rollout.h": "rollout",
    "state.h": "rollout", "gradient.h": "rollout",
    "score_error.h": "rollout", "score_ladder.h": "rollout", "compute.h": "compute",
    "learning.h": "learning", "evolution.h": "evolution",
    "certificate.h": "certificate", "atlas.h": "atlas"
}
SPEAKS = re.compile(
    r"(?<![\w.>])(?:exit|_exit|abort|printf|puts|perror|syslog)\s*\(|\b(?:stdout|stderr)\b")
HEADER_LINES = 150


def room_of(include, path, top):
    """Returns the room of an included header, or None for headers of the C library and external
    ones."""
    if include.startswith("morpho/"):
        return PUBLIC.get(include[len("morpho/"):], "an unknown public header")
    first = include.split("/")[0]
    if "/" in include and first in ROOMS:
        return first
    if (path.parent / include).exists():
        return (path.parent / include).resolve().relative_to((top / "src").resolve()).parts[0]
    return None


def faults_of(room, top):
    order = list(ROOMS)
    faults = []
    files = code_files(top / "src" / room)
    files += [
        top / "include/morpho" / name for name, owner in PUBLIC.items()
        if owner == room and (top / "include/morpho" / name).exists()
    ]
    for path in files:
        text = path.read_text()
        name = path.relative_to(top)
        for include in INCLUDE.findall(text):
            if "include/morpho" in str(name) and not include.startswith("morpho/"):
                other = None
            else:
                other = room_of(include, path, top)
            if other is not None and other not in order:
                faults.append(f"{name} includes {include}: {other}")
            elif other is not None and order.index(other) > order.index(room):
                faults.append(
                    f"{name} includes {include}, of room {other}, which comes after {room}")
            only = ONLY.get(room)
            if only is not None and other not in (None, room, *only) and include not in only:
                faults.append(f"{name} includes {include}: room {room} must not use {other}")
            for foreign in FOREIGN:
                if include.startswith(foreign) and foreign not in ROOMS[room]:
                    faults.append(f"{name} includes {include}, which room {room} may not use")
        if room in LIBRARY:
            bare = COMMENT.sub(
                lambda m: " " * len(m.group())
                if "\n" not in m.group() else "\n" * m.group().count("\n"), text)
            for number, line in enumerate(bare.splitlines(), 1):
                if SPEAKS.search(line):
                    faults.append(
                        f"{name}:{number}: a library neither prints nor ends the process: "
                        f"{line.strip()}"
                    )
    return faults


def headers_of(top):
    """Returns private headers that are too long."""
    return [
        f"{path.relative_to(top)} has {length} lines, more than {HEADER_LINES}"
        for folder in ("src", "clients") for path in code_files(top / folder)
        if path.suffix == ".h"
        for length in [path.read_text().count("\n")] if length > HEADER_LINES
    ]


def statement_faults(top):
    """A connection to the database must have room for all statements that it could keep."""
    header = top / "src/store/sql.h"
    if not header.is_file():
        return []
    most = int(MOST_STATEMENTS.search(header.read_text()).group(1))
    count = sum(len(STATEMENT.findall(path.read_text())) for path in code_files(top / "src/store"))
    return [f"src/store has up to {count} statements, more than {most}: raise MO_STATEMENTS_MAX"
            ] if count > most else []


def client_faults(top):
    faults = []
    for path in code_files(top / "clients"):
        for include in INCLUDE.findall(path.read_text()):
            if include in CLIENTS:
                continue
            if include.split("/")[0] in ROOMS or include.startswith("morpho/"):
                faults.append(
                    f"{path.relative_to(top)} includes {include}: clients use only the HTTP API")
    return faults


def report(top):
    results = [(f"room {room}", faults_of(room, top)) for room in ROOMS
               if (top / "src" / room).is_dir()]
    known = set(ROOMS)
    strangers = [
        f"src/{p.name} is not a room of tests/lint/rooms.py" for p in (top / "src").iterdir()
        if p.is_dir() and p.name not in known
    ]
    unlisted = [
        f"include/morpho/{p.name} belongs to no room" for p in (top / "include/morpho").glob("*.h")
        if p.name not in PUBLIC
    ]
    folders = [top / "src" / room for room in ROOMS] + sorted((top / "clients").glob("*/"))
    results += [(f"no circle in {folder.relative_to(top)}", circles_of(folder, top))
                for folder in folders if code_files(folder)]
    results.append(("every folder of src is a room", strangers + unlisted))
    results.append(("private headers are short", headers_of(top)))
    results.append(("clients use only the HTTP API", client_faults(top)))
    results.append(("a connection can keep all statements", statement_faults(top)))
    return results


def self_test():
    """Breaks each rule once in a scratch tree; returns the rules that were not noticed."""
    cases = {
        "a lower room": ("src/world/a.c", '#include "store/store.h"\n'),
        "a lower room's public header": ("src/morphospace/a.c", "#include <morpho/rollout.h>\n"),
        "a protocol that knows jobs": ("src/http/a.c", '#include "jobs/jobs.h"\n'),
        "a foreign header": ("src/jobs/a.c", "#include <sqlite3.h>\n"),
        "printing": ("src/rollout/a.c", 'void f(void) { printf("x"); }\n'),
        "ending the process": ("src/base/a.c", "void f(void) { exit(1); }\n"),
        "a client that links the library": ("clients/x/a.c", "#include <morpho/world.h>\n"),
        "a stranger": ("src/other/a.c", "\n"),
        "a circle": ("src/jobs/a.c", "int mo_a(void)\n{\n  return mo_b();\n}\n",
                     "src/jobs/b.c", "int mo_b(void)\n{\n  return mo_a();\n}\n"),
        "many statements": ("src/store/sql.h", "#define MO_STATEMENTS_MAX 1\n",
                            "src/store/a.c", 'mo_sql_do(c, "a");\nmo_sql_rows_with(c, "b");\n'),
        "a long header": ("src/jobs/a.h", "\n" * (HEADER_LINES + 1)),
    }
    missed = []
    for rule, files in cases.items():
        with tempfile.TemporaryDirectory() as folder:
            top = Path(folder)
            (top / "include/morpho").mkdir(parents=True)
            for room in ROOMS:
                (top / "src" / room).mkdir(parents=True)
            for name, text in zip(files[::2], files[1::2]):
                (top / name).parent.mkdir(parents=True, exist_ok=True)
                (top / name).write_text(text)
            if not any(faults for _, faults in report(top)):
                missed.append(f"not noticed: {rule}")
    return missed


def main():
    top = Path(__file__).resolve().parents[2]
    results = report(top) + [
        ("each rule can fail", self_test() + circles.self_test())
    ]
    return tap.report(results)


if __name__ == "__main__":
    sys.exit(main())
