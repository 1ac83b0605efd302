"""Turns openapi.yaml into JSON: as a file, or as a C source that holds its bytes, plain and
compressed.

usage: openapi_json.py openapi.yaml examples.json out.json|out.c
Every local reference must lead somewhere; a dangling one ends the build. Wherever a schema stands
that has an example, and in every response that has one, the example is added.
"""
import gzip
import json
import sys

import yaml


def check_references(node, root):
    if isinstance(node, dict):
        for key, value in node.items():
            if key == "$ref":
                target = root
                for part in value.removeprefix("#/").split("/"):
                    target = target[part.replace("~1", "/").replace("~0", "~")]
            else:
                check_references(value, root)
    elif isinstance(node, list):
        for value in node:
            check_references(value, root)


def put_in_order(paths):
    """Puts replies in the order of their codes: what `<<` merges comes first."""
    for item in paths.values():
        for method, operation in item.items():
            if method != "parameters":
                operation["responses"] = dict(sorted(operation["responses"].items()))


def add_examples(node, examples):
    """To media types whose schema has an example."""
    if isinstance(node, dict):
        schema = node.get("schema")
        name = schema.get("$ref", "").rpartition("/")[2] if isinstance(schema, dict) else ""
        if name in examples and "in" not in node:
            node.setdefault("examples", {})["example"] = {"$ref": f"#/components/examples/{name}"}
        for value in node.values():
            add_examples(value, examples)
    elif isinstance(node, list):
        for value in node:
            add_examples(value, examples)


def main():
    source, of_examples, target = sys.argv[1:]
    with open(source, encoding="utf-8") as file:
        document = yaml.safe_load(file)
    del document["x-shared"]
    put_in_order(document["paths"])
    with open(of_examples, encoding="utf-8") as file:
        examples = json.load(file)
    components = document["components"]
    components["examples"] = {name: {"value": value} for name, value in examples.items()}
    add_examples(document["paths"], examples)
    add_examples(components["responses"], examples)
    for name, response in components["responses"].items():
        if name in examples:
            media = dict(response["content"]["application/problem+json"])
            media["examples"] = {"example": {"$ref": f"#/components/examples/{name}"}}
            response["content"] = {"application/problem+json": media}
    check_references(document, document)
    text = json.dumps(document, ensure_ascii=True, separators=(",", ":"))
    if target.endswith(".c"):
        lines = ['#include "api/openapi.h"', "", "const char mo_openapi_json[] ="]
        for start in range(0, len(text), 100):
            piece = text[start:start + 100].replace("\\",
                                                    "\\\\").replace('"', '\\"').replace("?", "\\?")
            lines.append(f'  "{piece}"')
        lines[-1] += ";"
        lines.append("const size_t mo_openapi_json_size = sizeof(mo_openapi_json) - 1;")
        packed = gzip.compress(text.encode("ascii"), 9, mtime=0)
        lines.append("const unsigned char mo_openapi_gzip[] = {")
        for start in range(0, len(packed), 32):
            lines.append(",".join(map(str, packed[start:start + 32])) + ",")
        lines.append("};\nconst size_t mo_openapi_gzip_size = sizeof(mo_openapi_gzip);")
        text = "\n".join(lines)
    with open(target, "w", encoding="ascii") as file:
        file.write(text + "\n")


main()
