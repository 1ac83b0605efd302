#!/usr/bin/python3
"""Checks the stored notebooks (docs/notebooks): they must be executed once from the first cell to
the last, without errors, warnings, paths or host names, be small, and follow the rules of text.py
for words and width.

Prints TAP: one line for each rule, and one that shows that each rule can fail."""
import json
import re
import sys

from text import TOP, WIDTH, worse_words

import tap

FOLDER = TOP / "docs" / "notebooks"
BYTES_MAX = 1_200_000  # of all notebooks together
PLACE = re.compile(r"/(home|root|tmp|usr|var|work|mnt)/|"
                   r"https?://(?!127\.0\.0\.1:8765)[^/\s\"]+:\d+")


def code(notebook):
    return [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]


def not_in_order(notebook):
    counts = [cell["execution_count"] for cell in code(notebook)]
    if counts != list(range(1, len(counts) + 1)):
        yield f"execution counts {counts}"


def faulty(notebook):
    for cell in code(notebook):
        for output in cell["outputs"]:
            if output["output_type"] == "error" or output.get("name") == "stderr":
                yield f"{output['output_type']} of cell {cell['execution_count']}"


def empty(notebook):
    """If a figure is drawn, its output must be stored; there must be at least one."""
    kinds = {kind for cell in code(notebook) for output in cell["outputs"]
             for kind in output.get("data", ())}
    for kind in {"image/png", "image/jpeg"} - kinds:
        yield f"no output of the kind {kind}"


def places(notebook):
    for cell in notebook["cells"]:
        for match in PLACE.finditer(json.dumps([cell["source"], [
                {key: value for key, value in output.get("data", output).items()
                 if not key.startswith("image/")} for output in cell.get("outputs", ())]])):
            yield match.group()


def untidy(notebook):
    if not "".join(notebook["cells"][0]["source"]).startswith("# "):
        yield "the first cell is not a title"
    for cell in notebook["cells"]:
        lines = "".join(cell["source"]).splitlines()
        for line in lines:
            if len(line) > WIDTH:
                yield f"{len(line)} columns: {line}"
        for _, what in worse_words(lines):
            yield what


RULES = {
    "cells were executed once, in order": not_in_order, "no errors and no warnings": faulty,
    "figures and a player are stored": empty, "no paths or host names": places,
    "a title, 100 columns, words": untidy,
}


def self_test():
    """Breaks each rule; returns the rules that did not notice."""
    fine = {"cell_type": "code", "execution_count": 1, "source": ["m"], "outputs": [
        {"output_type": "execute_result", "data": {"image/png": "", "image/jpeg": "/tmp/"}}]}
    title = {"cell_type": "markdown", "source": ["# A title"]}

    def found(rule, *cells):
        return bool(list(RULES[rule]({"cells": cells})))
    error = [{"output_type": "error"}]
    warning = [{"output_type": "stream", "name": "stderr", "text": ["/usr/lib/x.py: old"]}]
    broken = [(fine | {"execution_count": None}, fine), (fine | {"outputs": error}, ),
              (fine | {"outputs": []}, ), (fine | {"outputs": warning}, ),
              (title, fine | {"source": ["x" * 101]})]
    return [f"{rule}: {what}" for rule, cells in zip(RULES, broken)
            for what, bad in (("not noticed", not found(rule, *cells)),
                              ("by mistake", found(rule, title, fine))) if bad]


def main():
    files = sorted(FOLDER.glob("*.ipynb"))
    notebooks = [(file.name, json.loads(file.read_text())) for file in files]
    size = sum(file.stat().st_size for file in files)
    results = [(name, [f"{file}: {fault}" for file, notebook in notebooks
                       for fault in rule(notebook)]) for name, rule in RULES.items()]
    results += [("seven notebooks of at most 1.2 MB together",
                 [] if len(files) == 7 and size <= BYTES_MAX else [f"{len(files)}, {size} bytes"]),
                ("each rule can fail", self_test())]
    return tap.report(results)


if __name__ == "__main__":
    sys.exit(main())
