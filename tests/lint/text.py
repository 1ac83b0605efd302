#!/usr/bin/python3
"""Checks the rules of docs/style.md that a program can check: lines of at most 100 columns, words
with a better alternative, also in identifiers, and links to headings.

Prints TAP: one line for each rule, and one that shows that each rule can fail. `text.py PATH…`
checks only these files and folders."""
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
    "", ".1", ".8", ".build", ".c", ".css", ".cu", ".cuh", ".h", ".html", ".in", ".inc", ".js",
    ".md", ".py", ".sh", ".socket", ".sql", ".txt"
}
# Inputs of tests, built files, and the page that lists the words.
SKIPPED = re.compile(r"(^|/)(__pycache__|\.pytest_cache|corpus|golden|build[^/]*|_sync)/|"
                     r"^docs/style.md$|^tests/lint/text.py$")
WIDTH = 100

# Words, each with what to write in its place. Parts of a name (`wish_flags`) are not words.
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

# These rules hold only in the folders of STRICT. Python's None is not a word; `tell` is a verb of
# studies (ask, tell), and code in a call, a path or quotes.
STRICT_WORDS = {
    r"(?-i:is none)": "invalid, absent, there is no X",
    r"no success": "failure, does not succeed",
    r"told": "reported, shown, sent",
    r"tells|(?<![./`\"'])(?<!ask, )(?<!ask and )(?<!study )tell(?![(`\"'/])": "report, show, send",
    r"way back": "backward pass",
    r"out of turn": "out of order",
}
# Not yet: docs, schema, src, tests.
STRICT = (".ci", "bench", "clients", "data", "experiments", "include", "systemd", "tools")

# Parts of identifiers, such as reckon_rows or comeInCrowds.
NAMES = {
    r"crowds": "groups, many at once",
    r"reckon(s|ed|ing)?": "estimate, compute",
    r"told": "reported, shown, sent",
}


# Where a part of a name begins and ends: an underscore, or a capital letter.
PART = (r"(?-i:(?<![A-Za-z])|(?<=[a-z])(?=[A-Z]))", r"(?-i:(?![a-z]))")


def text_files(paths):
    for path in paths:
        for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
            name = file.relative_to(TOP).as_posix() if file.is_relative_to(TOP) else file.name
            if file.is_file() and file.suffix in SUFFIXES and not SKIPPED.search(name):
                yield file


def may_be_wide(line, in_code):
    """Returns whether a line may be wide: a table, code in a document, or a line without a blank
    where it could be broken."""
    return in_code or line.startswith(("|", "    ")) or " " not in line.strip()[:WIDTH]


def wide_lines(path):
    """Yields lines of more than 100 columns, except for tables and code in Markdown."""
    markdown, in_code = path.suffix == ".md", False
    for number, line in enumerate(path.read_text().splitlines(), 1):
        if markdown and line.startswith("```"):
            in_code = not in_code
        if (len(line) > WIDTH and not (markdown and may_be_wide(line, in_code)) and
                not line.startswith(("ROUTE(", "TABLE("))):  # also a table
            yield number, f"{len(line)} columns"


def worse(words, begin=r"\b", end=r"\b"):
    """Returns the check of a rule, which finds these words in lines of text."""
    form = re.compile("|".join(rf"(?P<w{i}>{begin}(?:{word}){end})"
                               for i, word in enumerate(words)), re.I)
    advice = list(words.values())

    def check(lines):
        for number, line in enumerate(lines, 1):
            for match in form.finditer(line):
                yield number, f'"{match.group()}": {advice[int(match.lastgroup[1:])]}'

    return check


worse_words = worse(WORDS)


def in_file(check):
    return lambda path: check(path.read_text().splitlines())


def anchors(path):
    """Returns the anchors of the headings of a page."""
    words = [re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", line.lstrip("#")).strip().lower()
             for line in path.read_text().splitlines() if re.match("#+ ", line)]
    return {re.sub(r"[^\w -]", "", one).replace(" ", "-") for one in words}


def broken_links(path):
    """Yields links of a page to headings that do not exist."""
    for number, line in enumerate(path.read_text().splitlines() if path.suffix == ".md" else [], 1):
        for page, anchor in re.findall(r"\]\(([^)#\s:]*)#([^)]+)\)", line):
            target = path.parent / page if page else path
            if target.suffix == ".md" and (not target.is_file() or
                                           anchor not in anchors(target)):
                yield number, f"no heading is {page}#{anchor}"


# Each rule with its check and the folders that it holds in (None: all folders).
RULES = {
    "lines have at most 100 columns": (wide_lines, None),
    "words": (in_file(worse_words), None),
    "words, strictly": (in_file(worse(STRICT_WORDS)), STRICT),
    "parts of names": (in_file(worse(NAMES, *PART)), STRICT),
    "links name headings": (broken_links, None),
}


def holds_in(path, folders):
    """Returns whether a rule with these folders applies to a file. All rules apply to files outside
    TOP."""
    return (folders is None or not path.is_relative_to(TOP) or
            path.relative_to(TOP).parts[0] in folders)


def report(paths):
    files = list(text_files(paths))
    return [(name, [f"{path}:{number}: {what}" for path in files if holds_in(path, folders)
                    for number, what in check(path)])
            for name, (check, folders) in RULES.items()]


def self_test():
    """Breaks each rule in a scratch folder; returns faults that were not noticed, and faults that
    were reported by mistake."""
    long = "word " * 21
    wrong = {
        "a.c": [long, "/* Starts anew. */", "int wish;", "// a grey line"],
        "a.md": [long, "A reply is under way.", "It normalises.", "The centre of mass.",
                 "# A b\n[a](#ab)", "[a](no-page.md#a)"],
        "a.build": [long],
        "script": [long, "echo for ever"],
        "a.js": [f"// {long}", "const comeInCrowds = 1;", "// The page tells its name."],
        "a.css": [f"a {{ {long}}}", "/* Greyish. */"],
        "a.html": [f"<p>{long}</p>", "<p>Back on the way back.</p>"],
        "a.py": ["told = reply()", "reckoned = 1", "# There is none.", "# The study tells it."],
        "b.c": ["int come_in_crowds;", "/* Deaths out of turn. */", "/* There was no success. */"],
    }
    right = {
        "a.md": [f"| {long}|", f"```sh\n{long}\n```", f"    {long}", "x" * 101, "of an island",
                 "## [A](x) `b`: c\n[a](#a-b-c) [a](a.md#a-b-c) [a](http://x.org/y.md#z)"],
        "a.c": ["int wish_flags;", "x" * 100],
        "a.py": ["if x is None:", "study.tell(it)", 'post("/tell")', "# Ask, tell, resume."],
        "a.js": ["const unreckonable = stolds;", "x" * 100],
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
