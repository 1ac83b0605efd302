"""Turns openapi.yaml into JSON: as a file, or as a C source that holds its bytes, plain and
compressed.

usage: openapi_json.py openapi.yaml out.json|out.c
Every local reference must lead somewhere; a dangling one ends the build.
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


def main():
    source, target = sys.argv[1:]
    with open(source, encoding="utf-8") as file:
        document = yaml.safe_load(file)
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
