"""The contract (schema/openapi.yaml) as a checker: every reply that a test receives goes through
Contract.check."""

import json
import os
import pathlib
import re

import jsonschema
import yaml

SOURCE = pathlib.Path(
    os.environ.get("MORPHO_SOURCE_DIR", pathlib.Path(__file__).resolve().parents[2]))
COMMON_PROBLEMS = {404, 405, 417, 431, 501}  # for paths and methods that the contract does not list


class Contract:
    def __init__(self):
        with open(SOURCE / "schema" / "openapi.yaml", encoding="utf-8") as file:
            self.document = yaml.load(file, Loader=yaml.CSafeLoader)
        del self.document["x-shared"]  # like the build
        self.resolver = jsonschema.RefResolver("", self.document)
        self.templates = []
        for path, item in self.document["paths"].items():
            pattern = re.sub(r"\\\{[a-z0-9]+\\\}", "[^/]+", re.escape(path))
            self.templates.append((re.compile(pattern + r"\Z"), item))
        self.validators = {}
        self.known = set()  # bodies that were compared with the contract

    def resolve(self, node):
        while "$ref" in node:
            node = self.resolver.resolve(node["$ref"])[1]
        return node

    def validator(self, schema):
        key = json.dumps(schema, sort_keys=True)
        if key not in self.validators:
            self.validators[key] = jsonschema.Draft202012Validator(schema, resolver=self.resolver)
        return self.validators[key]

    def validate(self, schema, value, where):
        faults = sorted(self.validator(schema).iter_errors(value), key=str)
        assert not faults, f"{where}: {faults[0].message} at {list(faults[0].absolute_path)}"

    def find(self, path):
        """Returns the contract's entry for a path, or None."""
        return next((item for pattern, item in self.templates if pattern.match(path)), None)

    def check(self, method, path, status, headers, body):
        """headers: a mapping that ignores case. body: bytes."""
        where = f"{method} {path} -> {status}"
        path = path.split("?")[0]
        item = self.find(path)
        operation = item.get("get" if method == "HEAD" else method.lower()) if item else None
        request_id = headers.get("X-Request-Id", "")
        assert re.fullmatch("[0-9a-f]{16}", request_id), f"{where}: no X-Request-Id"
        assert (headers.get("X-Content-Type-Options") == "nosniff" or
                headers.get("Connection") == "close"), where
        if status in (429, 503, 507):
            assert headers.get("Retry-After", "").isdigit(), f"{where}: no Retry-After"
        if status == 405:
            assert headers.get("Allow"), f"{where}: no Allow"
        if status == 401:
            scheme = headers.get("WWW-Authenticate", "").split(" ")[0]
            assert scheme == "Bearer", f"{where}: no WWW-Authenticate"
        if status >= 400:
            self.check_problem(where, status, headers, body, method)
        if operation is None:
            if method == "OPTIONS" and status == 204:
                assert headers.get("Allow") or path == "*", where
            else:
                assert status in COMMON_PROBLEMS | {400, 401, 403}, f"{where}: not in the contract"
            return
        if str(status) not in operation["responses"]:
            assert status in COMMON_PROBLEMS, f"{where}: the contract does not list this status"
            return
        response = self.resolve(operation["responses"][str(status)])
        for name, header in response.get("headers", {}).items():
            header = self.resolve(header)
            if name in headers:
                self.validate(header.get("schema", {}), headers[name], f"{where}, {name}")
        for name in {"Location", "ETag"}.intersection(response.get("headers", {})):
            assert name in headers, f"{where}: no {name}"
        self.check_body(where, response.get("content", {}), headers, body, method)

    def check_problem(self, where, status, headers, body, method):
        media = headers.get("Content-Type")
        assert media == "application/problem+json", f"{where}: not a problem document"
        if method == "HEAD":
            return
        problem = json.loads(body)
        self.validate({"$ref": "#/components/schemas/Problem"}, problem, where)
        assert problem["status"] == status, where
        assert problem["request_id"] == headers["X-Request-Id"], where

    def check_body(self, where, content, headers, body, method):
        if not content:
            assert body == b"", f"{where}: a body is not in the contract"
            return
        media = headers.get("Content-Type", "").split(";")[0]
        assert media in content, f"{where}: Content-Type {media!r} is not in the contract"
        if method == "HEAD":
            assert body == b"", where
            return
        # Tests that wait get the same reply many times.
        key = id(content), media, body  # the document keeps `content`
        if key in self.known:
            return
        if media == "application/x-ndjson":
            page = self.resolve(content["application/json"]["schema"])
            for line in body.splitlines():
                self.validate(page["properties"]["items"]["items"],
                              json.loads(line, parse_constant=refuse), where)
        elif media.endswith("json"):
            self.validate(content[media].get("schema", {}), json.loads(body, parse_constant=refuse),
                          where)
        if len(body) < 65536:
            self.known.add(key)


def refuse(name):
    raise AssertionError(f"{name} is not JSON")
