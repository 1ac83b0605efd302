"""Evaluations that cannot be: each with its status and, where there is a place, its JSON pointer.
"""

import json

import pytest

from service import DESIGN

FLAT = [0.05] * 64
LIGHT = [4.5, 2.5]


def with_cells(cells):
    return {"designs": [DESIGN, {"cells": cells}]}


def with_field(name, value):
    return {"designs": [DESIGN], name: value}


def with_environment(**fields):
    return {
        "designs": [DESIGN], "environments": [{"light_xy_m": LIGHT, "terrain_heights_m": FLAT},
                                              fields]
    }


INVALID = {
    "not an object": ([], ""),
    "a string": ("designs", ""),
    "no designs": ({}, ""),
    "designs empty": ({"designs": []}, "/designs"),
    "designs not an array": ({"designs": {"cells": []}}, "/designs"),
    "design not an object": ({"designs": [DESIGN, 7]}, "/designs/1"),
    "design of nothing": ({"designs": [{}]}, "/designs/0"),
    "design of two forms": ({"designs": [dict(DESIGN, voxels="1" + "0" * 143)]}, "/designs/0"),
    "empty cells": (with_cells([]), "/designs/1/cells"),
    "too many cells": (with_cells([[0, 0, 0]] * 145), "/designs/1/cells"),
    "cells not contiguous": (with_cells([[0, 0, 0], [1, 0, 0], [3, 0, 0]]), "/designs/1/cells/2"),
    "cells touch by an edge": (with_cells([[0, 0, 0], [1, 1, 0]]), "/designs/1/cells/1"),
    "cell doubled": (with_cells([[0, 0, 0], [1, 0, 0], [0, 0, 0]]), "/designs/1/cells/2"),
    "cell beyond x": (with_cells([[6, 0, 0]]), "/designs/1/cells/0/0"),
    "cell beyond y": (with_cells([[0, 0, 0], [0, 6, 0]]), "/designs/1/cells/1/1"),
    "cell beyond z": (with_cells([[0, 0, 4]]), "/designs/1/cells/0/2"),
    "cell below zero": (with_cells([[0, -1, 0]]), "/designs/1/cells/0/1"),
    "cell far away": (with_cells([[0, 0, 2**60]]), "/designs/1/cells/0/2"),
    "cell of two": (with_cells([[0, 0]]), "/designs/1/cells/0"),
    "cell of four": (with_cells([[0, 0, 0, 0]]), "/designs/1/cells/0"),
    "cell of text": (with_cells([["0", 0, 0]]), "/designs/1/cells/0/0"),
    "cell of fractions": (with_cells([[0.5, 0, 0]]), "/designs/1/cells/0/0"),
    "cell is null": (with_cells([None]), "/designs/1/cells/0"),
    "cell of true": (with_cells([[True, 0, 0]]), "/designs/1/cells/0/0"),
    "145 characters": ({"designs": [{"voxels": "1" * 145}]}, "/designs/0/voxels"),
    "143 characters": ({"designs": [{"voxels": "1" * 143}]}, "/designs/0/voxels"),
    "other characters": ({"designs": [{"voxels": "2" * 144}]}, "/designs/0/voxels"),
    "voxels all zero": ({"designs": [{"voxels": "0" * 144}]}, "/designs/0/voxels"),
    "voxels not contiguous": ({"designs": [{"voxels": "101" + "0" * 141}]}, "/designs/0/voxels"),
    "voxels a number": ({"designs": [{"voxels": 1}]}, "/designs/0/voxels"),
    "voxels without end": ({"designs": [{"voxels": "1" * 100000}]}, "/designs/0/voxels"),
    "id too short": ({"designs": [{"id": "80"}]}, "/designs/0/id"),
    "id not canonical": ({"designs": [{"id": "0" * 35 + "1"}]}, "/designs/0/id"),
    "id not hexadecimal": ({"designs": [{"id": "x" * 36}]}, "/designs/0/id"),
    "id empty body": ({"designs": [{"id": "0" * 36}]}, "/designs/0/id"),
    "unknown field of a design": ({"designs": [dict(DESIGN, name="x")]}, "/designs/0/name"),
    "unknown field": (with_field("enviroments", "paper-test"), "/enviroments"),
    "unknown field with odd characters": (with_field("a/b~c\u00e9", 1), "/a~1b~0c\u00e9"),
    "unknown controller": (with_field("controller", "nobody"), "/controller"),
    "unknown controller by hash": (with_field("controller", "sha256:" + "0" * 64), "/controller"),
    "controller not a name": (with_field("controller", "../default"), "/controller"),
    "controller hash too short": (with_field("controller", "sha256:ab"), "/controller"),
    "controller a number": (with_field("controller", 1), "/controller"),
    "unknown environments": (with_field("environments", "moon"), "/environments"),
    "environments empty": (with_field("environments", []), "/environments"),
    "environments a number": (with_field("environments", 5), "/environments"),
    "65 environments": (with_field("environments",
                                   [{"light_xy_m": LIGHT, "terrain_heights_m": FLAT}] * 65),
                        "/environments"),
    "environment a string": (with_field("environments", ["paper-test"]), "/environments/0"),
    "63 heights": (with_environment(light_xy_m=LIGHT, terrain_heights_m=FLAT[1:]),
                   "/environments/1/terrain_heights_m"),
    "65 heights": (with_environment(light_xy_m=LIGHT, terrain_heights_m=FLAT + [0]),
                   "/environments/1/terrain_heights_m"),
    "height too high": (with_environment(light_xy_m=LIGHT, terrain_heights_m=FLAT[:63] + [101]),
                        "/environments/1/terrain_heights_m/63"),
    "height null": (with_environment(light_xy_m=LIGHT, terrain_heights_m=[None] + FLAT[1:]),
                    "/environments/1/terrain_heights_m/0"),
    "light of one": (with_environment(light_xy_m=[1],
                                      terrain_heights_m=FLAT), "/environments/1/light_xy_m"),
    "light far away": (with_environment(light_xy_m=[1, 1001],
                                        terrain_heights_m=FLAT), "/environments/1/light_xy_m/1"),
    "no light": (with_environment(terrain_heights_m=FLAT), "/environments/1"),
    "no terrain": (with_environment(light_xy_m=LIGHT), "/environments/1"),
    "two terrains": (with_environment(light_xy_m=LIGHT,
                                      terrain_heights_m=FLAT,
                                      terrain_sigma_m=0.1,
                                      seed=1), "/environments/1"),
    "no seed": (with_environment(light_xy_m=LIGHT, terrain_sigma_m=0.1), "/environments/1"),
    "negative sigma": (with_environment(light_xy_m=LIGHT, terrain_sigma_m=-0.1,
                                        seed=1), "/environments/1/terrain_sigma_m"),
    "negative seed": (with_environment(light_xy_m=LIGHT, terrain_sigma_m=0.1,
                                       seed=-1), "/environments/1/seed"),
    "seed with a fraction": (with_environment(light_xy_m=LIGHT, terrain_sigma_m=0.1,
                                              seed=1.5), "/environments/1/seed"),
    "seed beyond 2^53": (with_environment(light_xy_m=LIGHT, terrain_sigma_m=0.1,
                                          seed=2**53), "/environments/1/seed"),
    "unknown field of an environment": (with_environment(light_xy_m=LIGHT,
                                                         terrain_heights_m=FLAT,
                                                         wind=1), "/environments/1/wind"),
    "record a string": (with_field("record", "com"), "/record"),
    "record something": (with_field("record", ["com", "pose"]), "/record/1"),
    "record twice": (with_field("record", ["com", "com"]), "/record/1"),
    "record too much": ({
        "designs": [{"cells": [[x, y, z] for x in range(6) for y in range(6)
                               for z in range(4)]}] * 500, "record": ["masses"], "record_stride": 1
    }, "/record"),
    "stride zero": (with_field("record_stride", 0), "/record_stride"),
    "stride beyond the end": (with_field("record_stride", 1001), "/record_stride"),
    "time step zero": (with_field("physics", {"dt_s": 0}), "/physics/dt_s"),
    "mass negative": (with_field("physics", {"mass_kg": -1}), "/physics/mass_kg"),
    "steps zero": (with_field("physics", {"n_steps": 0}), "/physics/n_steps"),
    "steps without end": (with_field("physics", {"n_steps": 10**12}), "/physics/n_steps"),
    "impact unknown": (with_field("physics", {"impact": "soft"}), "/physics/impact"),
    "bisection 53": (with_field("physics", {"impact": "bisection53"}), "/physics/impact"),
    "unknown physics": (with_field("physics", {"gravity": 9.8}), "/physics/gravity"),
    "physics a list": (with_field("physics", []), "/physics"),
    "precision unknown": (with_field("precision", "float16"), "/precision"),
    "priority unknown": (with_field("priority", "urgent"), "/priority"),
    "label too long": (with_field("label", "x" * 201), "/label"),
    "label a number": (with_field("label", 1), "/label"),
    "verify a string": (with_field("verify", "true"), "/verify"),
}


@pytest.mark.parametrize("name", INVALID)
def test_invalid(service, name):
    value, pointer = INVALID[name]
    reply = service.request("POST", "/v1/evaluations", value)
    assert reply.status == 422, reply.body
    assert pointer in reply.pointers(), reply.body


# Numbers that JSON can write and float64 cannot hold.
HUGE = {
    "height": (
        '{"designs":[{"cells":[[0,0,0]]}],'
        '"environments":[{"light_xy_m":[1,1],"terrain_heights_m":[1e400%s]}]}'
        % (",0" * 63), "/environments/0/terrain_heights_m/0"),
    "light": (
        '{"designs":[{"cells":[[0,0,0]]}],'
        '"environments":[{"light_xy_m":[1,-1e400],"terrain_sigma_m":0,"seed":1}]}',
        "/environments/0/light_xy_m/1"),
    "cell": ('{"designs":[{"cells":[[1e400,0,0]]}]}', "/designs/0/cells/0/0"),
    "physics": ('{"designs":[{"cells":[[0,0,0]]}],"physics":{"dt_s":1e400}}', "/physics/dt_s"),
    "integer": ('{"designs":[{"cells":[[0,0,0]]}],"record_stride":99999999999999999999}',
                "/record_stride"),
}


@pytest.mark.parametrize("name", HUGE)
def test_numbers_that_are_not_finite(service, name):
    body, pointer = HUGE[name]
    reply = service.request("POST", "/v1/evaluations", body=body)
    assert reply.status == 422 and reply.pointers() == [pointer], reply.body


MALFORMED = {
    "empty": b"",
    "blank": b"  ",
    "cut": b'{"designs":[{"cells":[[0,0',
    "comma at the end": b'{"designs":[],}',
    "two values": b'{"designs":[]}{}',
    "single quotes": b"{'designs':[]}",
    "comment": b'{"designs":[]/**/}',
    "NaN": b'{"designs":[{"cells":[[NaN,0,0]]}]}',
    "Infinity": b'{"environments":[{"light_xy_m":[Infinity,0]}]}',
    "leading zero": b'{"designs":[{"cells":[[01,0,0]]}]}',
    "repeated key": b'{"designs":[{"cells":[[0,0,0]]}],"designs":[]}',
    "repeated key, escaped": b'{"designs":[{"cells":[[0,0,0]]}],"\\u0064esigns":[]}',
    "repeated key inside": b'{"designs":[{"cells":[[0,0,0]],"cells":[[1,0,0]]}]}',
    "repeated key in an unknown field": b'{"x":{"a":1,"a":2}}',
    "depth bomb of arrays": b"[" * 100000,
    "depth bomb of objects": b'{"a":' * 100000,
    "depth bomb inside": b'{"designs":[{"cells":' + b"[" * 5000 + b"]" * 5000 + b"}]}",
    "not UTF-8": b'{"label":"\xff\xfe"}',
    "overlong UTF-8": b'{"label":"\xc0\xaf"}',
    "lone surrogate": b'{"label":"\\ud800"}',
    "NUL": b'{"label":"a\x00b"}',
    "escaped NUL": b'{"label":"a\\u0000b"}',
    "control character": b'{"label":"a\nb"}',
    "byte-order mark": b'\xef\xbb\xbf{"designs":[]}',
    "UTF-16": '{"designs":[]}'.encode("utf-16"),
    "too many keys": b'{"x":{' + b",".join(b'"k%d":0' % i for i in range(100)) + b"}}",
    "form": b"designs=1&cells=2",
    "safetensors": b"\x08\x00\x00\x00\x00\x00\x00\x00{}      ",
}


@pytest.mark.parametrize("name", MALFORMED)
def test_malformed(service, name):
    reply = service.request("POST", "/v1/evaluations", body=MALFORMED[name])
    assert reply.status == 400, reply.body
    value = reply.json()
    assert value["type"] == "/problems/malformed-json" and len(
        value["errors"]) == 1 and "line " in value["errors"][0]["detail"]


def test_escaped_keys(service):
    body = (b'{"\\u0064esigns":[{"c\\u0065lls":[[0,0,0]]}],'
            b'"ph\\u0079sics":{"n_steps":20,"\\u0069mpact":"exact"}}')
    reply = service.request("POST", "/v1/evaluations", body=body)
    assert reply.status == 202 and reply.json()["physics"]["impact"] == "exact", reply.body


def test_a_seed_that_only_rounds_to_a_whole_number(service):
    """A float64 has no digits for the fraction; the text has."""
    place = b'{"light_xy_m":[1,1],"terrain_sigma_m":0.1,"seed":9007199254740990.6}'
    reply = service.request("POST",
                            "/v1/evaluations",
                            body=b'{"designs":[{"cells":[[0,0,0]]}],"environments":[' + place +
                            b"]}")
    assert reply.status == 422 and reply.pointers() == ["/environments/0/seed"]


def test_place_of_a_syntax_error(service):
    reply = service.request("POST", "/v1/evaluations", body=MALFORMED["NaN"])
    assert reply.pointers() == ["/designs/0/cells/0/0"]


def test_many_faults_at_once(service):
    reply = service.request("POST", "/v1/evaluations",
                            {"designs": [{"cells": [[9, 0, 0]]} for _ in range(100)]})
    assert reply.status == 422 and reply.pointers() == [
        f"/designs/{i}/cells/0/0" for i in range(32)
    ]
    reply = service.request(
        "POST", "/v1/evaluations",
        {"designs": [DESIGN, {"voxels": "x"}], "controller": 5, "label": 7, "z": None})
    assert reply.pointers() == ["/designs/1/voxels", "/controller", "/label", "/z"]


def test_10001_designs(service):
    reply = service.request("POST", "/v1/evaluations", {"designs": [DESIGN] * 10001})
    assert reply.status == 422 and reply.pointers() == ["/designs"]


@pytest.mark.parametrize("headers, status",
                         [({"Content-Type": "text/plain"}, 415),
                          ({"Content-Type": "application/xml"}, 415),
                          ({"Content-Type": "application/json; charset=latin-1"}, 415),
                          ({"Content-Type": "nonsense"}, 415), ({"Content-Encoding": "gzip"}, 415),
                          ({"Content-Type": "application/json; charset=UTF-8"}, 422),
                          ({"Accept": "text/html"}, 406)])
def test_media_types(service, headers, status):
    assert service.request("POST", "/v1/evaluations", body="{}", headers=headers).status == status


def test_body_too_large(start):
    running = start("--max-body=64K")
    big = json.dumps({"label": "x" * 70000})
    assert running.request("POST", "/v1/evaluations", body=big).status == 413
    chunks = (big[i:i + 5000].encode() for i in range(0, len(big), 5000))
    connection = running.connection()
    assert running.request("POST",
                           "/v1/evaluations",
                           body=chunks,
                           connection=connection,
                           headers={"Content-Type": "application/json"}).status == 413
    connection.close()
    huge = b"x" * (3 << 20)
    assert running.request("POST", "/v1/evaluations", body=huge).status == 413
    assert running.request("POST", "/v1/jobs/1/pause", body=b"x" * 70000).status == 413
    assert running.request("GET", "/healthz").status == 200
