#!/usr/bin/python3
"""Checks what docs/style.md says of text and a program can see: lines of at most 100 columns, and
words for which there is a better one.

Prints TAP: one line for each rule, and one that shows that each rule can fail. `text.py PATH…`
checks these files and folders only."""
import re
import sys
import tempfile
from pathlib import Path

import tap

TOP = Path(__file__).resolve().parents[2]
PLACES = [
    ".ci", "CHANGELOG.md", "README.md", "bench", "clients", "data", "docs", "experiments", "include",
    "meson.build", "meson_options.txt", "schema", "src", "systemd", "tests", "tools"
]
SUFFIXES = {
    "", ".1", ".8", ".build", ".c", ".cu", ".cuh", ".h", ".in", ".inc", ".md", ".py", ".sh",
    ".socket", ".sql", ".txt"
}
# Inputs of tests, built files, and the page that names the words.
SKIPPED = re.compile(r"(^|/)(__pycache__|\.pytest_cache|corpus|golden|build[^/]*)/|^docs/style.md$|"
                     r"^tests/lint/text.py$")
WIDTH = 100

# Word by word, what to write in its place. Parts of a name (`wish_flags`) are not words.
WORDS = {
    r"anew": "again, new",
    r"whoever": "the name of the program, thread or person",
    r"under[ -]way": "in flight, running, pending",
    r"for ?ever": "permanently, never expires",
    r"wish(es|ed)?": "request",
    r"hear[sd]?": "receives, is notified",
    r"settle[sd]?|settling": "decide, end, store",
    r"land(s|ed|ing)?": "arrive, end",
    r"as ever": "as before",
    r"\w*(colour|behaviour|neighbour|favour|honour)\w*": "the American spelling, -or",
    r"(centre|metre)[sd]?|centring": "the American spelling, -er",
    r"grey\w*": "gray",
    r"\w*(general|initial|linear|normal|optim|organ|random|recogn|serial|summar|synchron)"
    r"is(e|ed|es|ing|ation)": "the American spelling, -ize",
}
WORD = re.compile("|".join(rf"(?P<w{i}>\b(?:{word})\b)"
                           for i, word in enumerate(WORDS)), re.I)
ADVICE = list(WORDS.values())


def text_files(paths):
    for path in paths:
        for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
            name = file.relative_to(TOP).as_posix() if file.is_relative_to(TOP) else file.name
            if file.is_file() and file.suffix in SUFFIXES and not SKIPPED.search(name):
                yield file


def may_be_wide(line, in_code):
    """Tables, code in a document, and what has no blank at which to break it."""
    return in_code or line.startswith(("|", "    ")) or " " not in line.strip()[:WIDTH]


def wide_lines(path):
    """Lines of more than 100 columns, but for tables and code in Markdown."""
    markdown, in_code = path.suffix == ".md", False
    for number, line in enumerate(path.read_text().splitlines(), 1):
        if markdown and line.startswith("```"):
            in_code = not in_code
        if (len(line) > WIDTH and not (markdown and may_be_wide(line, in_code)) and
                not line.startswith(("ROUTE(", "TABLE("))):  # a table, too
            yield number, f"{len(line)} columns"


def worse_words(path):
    for number, line in enumerate(path.read_text().splitlines(), 1):
        for match in WORD.finditer(line):
            yield number, f'"{match.group()}": {ADVICE[int(match.lastgroup[1:])]}'


RULES = {"lines have at most 100 columns": wide_lines, "words": worse_words}


def report(paths):
    files = list(text_files(paths))
    return [(name, [f"{path}:{number}: {what}" for path in files for number, what in rule(path)])
            for name, rule in RULES.items()]


def self_test():
    """Breaks each rule in a scratch folder; returns what was not noticed, and what was by mistake."""
    long = "word " * 21
    wrong = {
        "a.c": [long, "/* Starts anew. */", "int wish;", "// a grey line"],
        "a.md": [long, "A reply is under way.", "It normalises.", "The centre of mass."],
        "a.build": [long],
        "script": [long, "echo for ever"],
    }
    right = {
        "a.md": [f"| {long}|", f"```sh\n{long}\n```", f"    {long}", "x" * 101, "of an island"],
        "a.c": ["int wish_flags;", "x" * 100],
    }
    with tempfile.TemporaryDirectory() as folder:
        def found(name, text):
            (Path(folder) / name).write_text(text + "\n")
            return any(faults for _, faults in report([Path(folder) / name]))
        return ([f"not noticed in {n}: {t}" for n, lines in wrong.items() for t in lines
                 if not found(n, t)] +
                [f"by mistake in {n}: {t}" for n, lines in right.items() for t in lines
                 if found(n, t)])


def main(arguments):
    paths = [Path(a).resolve() for a in arguments] or [TOP / place for place in PLACES]
    results = report(paths) + [("each rule can fail", self_test())]
    return tap.report([(name, [fault.replace(f"{TOP}/", "") for fault in faults])
                       for name, faults in results])


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
