"""The service treats values as the contract says: at each bound, and for many texts."""

import re

import pytest
from service import CONTRACT, DESIGN, await_end

CURSORS = [
    "1", "01", "0", "x", "", "-1", "9999999999", "99999999999", "999999999999999999",
    "1000000000000000000", "0" * 512, "5-7", "05-007", "1234567-1", "999999-999999", "~3", "~03",
    "walker", "Walker", "a" * 64, "a" * 65, "3ff0000000000000-4", "fff8000000000000-4",
    "bff0000000000000-4", "7ff8000000000000-4", "7ff0000000000000-4", "7fefffffffffffff-4",
    "7e00000000000000-4", "3ff0000000000000-04", "3ff00000-4", "4294967296", "1.5"
]
KEYS = [
    "k", "k" * 255, "k" * 256, '"k"', '"' + "k" * 255 + '"', '"' + "k" * 256 + '"', '"', '""', '"a',
    'a"', '"a"b"', r'"a\"b"', r'"a\\b"', r'"a\b"', "a b", '"a b"', "\u00e9", r"a\b", "a\tb"
]
PREFER = [
    "wait=1", "wait=0", 'wait="1"', "wait=", "wait=x", "wait=-1", "wait", "return=minimal", "",
    "wait=" + "0" * 18, "wait=" + "0" * 19
]


def schema_of(operation, name):
    parameter, = [
        one for one in map(CONTRACT.resolve, operation["parameters"]) if one["name"] == name
    ]
    return CONTRACT.resolve(parameter["schema"])


def lists():
    for path, item in CONTRACT.document["paths"].items():
        if any(
                CONTRACT.resolve(one)["name"] == "cursor"
                for one in item.get("get", {}).get("parameters", [])):
            yield path


@pytest.fixture(scope="module")
def atlas(service):
    """An atlas of the name that the paths have."""
    body = {"voxels": 1, "name": "small", "physics": {"n_steps": 8, "control_period_s": 0.016}}
    path = f"/v1/jobs/{service.post('/v1/atlases', body)['id']}"
    assert await_end(service, path).json()["state"] == "succeeded"
    yield
    assert service.request("DELETE", "/v1/atlases/small").status == 204


@pytest.fixture(scope="module")
def campaign(service):
    body = {
        "mode": "zero-shot", "population": 4, "generations": 1, "physics": {"n_steps": 5},
        "exclude_pretraining": False
    }
    id = service.post("/v1/campaigns", body)["id"]
    service.request("GET", f"/v1/jobs/{id}", headers={"Prefer": "wait=60"})
    return id


@pytest.mark.parametrize("path", lists())
def test_cursors(service, campaign, atlas, path):
    schema = schema_of(CONTRACT.document["paths"][path]["get"], "cursor")
    queries = {"/v1/designs": ("", "&sort=score"), "/v1/events": ("&format=json", )}
    for query in queries.get(path, ("", )):
        for cursor in CURSORS:
            at = path.format(id=campaign, number=0, name="small")
            reply = service.request("GET", f"{at}?cursor={cursor}{query}")
            shown = re.search(schema["pattern"], cursor) is not None and len(cursor) <= schema.get(
                "maxLength", 520)
            if path == "/v1/designs":  # one format for each kind
                shown = shown and ("-" in cursor) == (query != "")
            assert (reply.status != 400) == shown, (path, cursor, reply.status)


def test_places_of_learning(service, campaign):
    pattern = schema_of(CONTRACT.document["paths"]["/v1/campaigns/{id}/learning"]["get"],
                        "cursor")["pattern"]
    for place in ("0.0", "4294967295.4294967296", "9999999999.9999999999", "10000000000.0", "1",
                  "1.", ".1", "-1.0", "1.0.0"):
        reply = service.request("GET", f"/v1/campaigns/{campaign}/learning?cursor={place}")
        assert (reply.status != 400) == (re.search(pattern, place) is not None), place


def test_keys_and_preferences(start):
    service = start()  # with different keys than other tests
    operation = CONTRACT.document["paths"]["/v1/evaluations"]["post"]
    for header, texts in (("Idempotency-Key", KEYS), ("Prefer", PREFER)):
        pattern = schema_of(operation, header).get("pattern", "")  # Prefer is never refused
        for text in texts:
            reply = service.request("POST", "/v1/evaluations",
                                    {"designs": [DESIGN], "physics": {"n_steps": 5}},
                                    headers={header: text})
            assert (reply.status != 400) == (re.search(pattern, text)
                                             is not None), (header, text, reply.body)
