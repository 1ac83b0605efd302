"""Requirements of client generators on the contract: names, types, descriptions, links.

tests/peers/ calls the Python and Java clients that two generators make from it."""

import re

from service import CONTRACT, SOURCE

DOCUMENT = CONTRACT.document
SCHEMAS = DOCUMENT["components"]["schemas"]


def operations():
    for path, item in DOCUMENT["paths"].items():
        for method, operation in item.items():
            if method in ("get", "put", "post", "patch", "delete"):
                yield path, method, operation


def nodes(node, path=""):
    if isinstance(node, dict):
        yield path, node
    for key, value in (node.items() if isinstance(node, dict) else
                       enumerate(node) if isinstance(node, list) else ()):
        yield from nodes(value, f"{path}/{key}")


def test_every_operation_is_described():
    names = [operation["operationId"] for _, _, operation in operations()]
    assert len(names) == len(set(names))
    for path, method, operation in operations():
        assert len(operation["tags"]) == 1 and operation["summary"], (path, method)
        assert operation["description"] != operation["summary"], (path, method)
        body = CONTRACT.resolve(operation.get("requestBody", {}))
        assert len(body.get("content", {"": 0})) == 1, f"{path}: one type of body, or none is made"
        for reply in operation["responses"].values():
            types = list(CONTRACT.resolve(reply).get("content", {}))
            assert "application/json" not in types[1:], f"{path}: generators take the first type"


def test_every_schema_has_a_name_and_types():
    """A class without its own name gets a generated one; a constant without a type can be any
    value."""
    for path, node in (*nodes(DOCUMENT["paths"]), *nodes(SCHEMAS)):
        if "properties" in node and node.get("type") == "object":
            assert path.count("/") == 1, path
        if "const" in node or "enum" in node:
            assert "type" in node, path
        for union in ("oneOf", "anyOf"):
            for variant in node.get(union, []):
                assert "$ref" in variant or variant.get("type") != "object", path


def test_variants_of_unions_are_distinguishable():
    """Either a discriminator names all variants, or no two variants share a member."""
    for name, schema in SCHEMAS.items():
        variants = [variant["$ref"] for variant in schema.get("oneOf", [])]
        if "discriminator" in schema:
            key = schema["discriminator"]["propertyName"]
            mapping = schema["discriminator"]["mapping"]
            assert sorted(mapping.values()) == sorted(variants), name
            for value, variant in mapping.items():
                kind = CONTRACT.resolve({"$ref": variant})["properties"][key]
                assert kind == dict(kind, type="string", const=value), (name, value)


def test_pages_lead_to_the_next():
    for path, _, operation in operations():
        reply = CONTRACT.resolve(operation["responses"].get("200", {}))
        schema = CONTRACT.resolve(reply.get("content", {}).get("application/json",
                                                              {}).get("schema", {}))
        if "next_cursor" in schema.get("properties", {}):
            link = reply["links"]["next"]
            assert link["operationId"] == operation["operationId"], path
            assert link["parameters"]["cursor"] == "$response.body#/next_cursor", path
    known = {operation["operationId"] for _, _, operation in operations()}
    for path, node in nodes(DOCUMENT):
        if path.endswith("/links") and "components/schemas" not in path and "responses" in path:
            assert {CONTRACT.resolve(link)["operationId"] for link in node.values()} <= known, path


def test_every_event_has_a_type():
    """The sources write exactly the types of the contract."""
    written = set()
    for source in (SOURCE / "src").glob("*/*.c"):
        written |= set(re.findall(
            r'"((?:job|controller|evaluation|training|campaign|atlas|certificate|fleet|scores)'
            r'\.[a-z_]+)"', source.read_text(encoding="utf-8")))
    written -= {"job.", "campaign.json", "scores.json"}  # files of bundles and of scores
    assert written == set(SCHEMAS["Event"]["discriminator"]["mapping"])


def test_every_type_of_problem_has_a_page(service):
    document = (SOURCE / "docs" / "problems.md").read_text(encoding="utf-8")
    names = re.findall(r"^## ([a-z-]+)$", document, re.M)
    types = SCHEMAS["ProblemType"]["enum"]
    assert sorted(types) == sorted(["about:blank", *(f"/problems/{name}" for name in names)])
    source = (SOURCE / "src" / "http" / "problem.c").read_text(encoding="utf-8")
    assert set(re.findall(r'"(/problems/[a-z-]+)"', source)) == set(types) - {"about:blank"}
    for name in names:
        page = service.request("GET", f"/problems/{name}").body.decode()
        assert page.startswith(f"## {name}\n") and page in document and page.count("## ") == 1
    assert service.request("GET", "/problems/nothing").json()["type"] == "/problems/not-found"
