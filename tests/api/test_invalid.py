"""Invalid jobs: each request with its status and, if the fault has a position, its JSON pointer.
schema/openapi.yaml and the service agree on what a valid request is."""

import collections
import json

import pytest

from service import CONTRACT, DESIGN, tiny_controller

BAR = {"cells": [[x, 2, 0] for x in range(4)]}
DOT = {"cells": [[0, 0, 0]]}
FLAT = [0.05] * 64
ROWS = [[0] * 8] * 8
PLACE = {"light_xy_m": [4.5, 2.5], "terrain_heights_m": FLAT}
ROUGH = {"light_xy_m": [4.5, 2.5], "terrain_sigma_m": 0.1, "seed": 1}
BLOCK = {"voxels": "1" * 144}

# The position of a fault (a JSON pointer), and values of the field that have a fault there.
CELLS = {  # for a second design
    "": [[], [[0, 0, 0]] * 145],
    "/1": [[[0, 0, 0], [1, 1, 0]]],  # they touch only along an edge
    "/2": [[[0, 0, 0], [1, 0, 0], [3, 0, 0]], [[0, 0, 0], [1, 0, 0], [0, 0, 0]]],
    "/0": [[[0, 0]], [[0, 0, 0, 0]], [None]],
    "/0/0": [[[6, 0, 0]], [["0", 0, 0]], [[0.5, 0, 0]], [[True, 0, 0]]],
    "/0/1": [[[0, -1, 0]]],
    "/1/1": [[[0, 0, 0], [0, 6, 0]]],
    "/0/2": [[[0, 0, 4]], [[0, 0, 2**60]]],
}
ENVIRONMENT = {  # for a second environment
    "": [{"terrain_heights_m": FLAT}, {"light_xy_m": [1, 1]}, PLACE | ROUGH,
         {"light_xy_m": [1, 1], "terrain_sigma_m": 0.1}, "paper-test"],
    "/terrain_heights_m": [PLACE | {"terrain_heights_m": FLAT[1:]},
                           PLACE | {"terrain_heights_m": ROWS[1:]},
                           PLACE | {"terrain_heights_m": ROWS + ROWS},
                           PLACE | {"terrain_heights_m": FLAT + [0]}],
    "/terrain_heights_m/63": [PLACE | {"terrain_heights_m": FLAT[1:] + [101]}],
    "/terrain_heights_m/7": [PLACE | {"terrain_heights_m": ROWS[:7] + [[0] * 7]},
                             PLACE | {"terrain_heights_m": ROWS[:7] + [0]}],
    "/terrain_heights_m/7/2": [PLACE | {"terrain_heights_m": ROWS[:7] + [[0, 0, "0"] + [0] * 5]}],
    "/terrain_heights_m/0": [PLACE | {"terrain_heights_m": [None] + FLAT[1:]}],
    "/light_xy_m": [PLACE | {"light_xy_m": [1]}],
    "/light_xy_m/1": [PLACE | {"light_xy_m": [1, 1001]}],
    "/terrain_sigma_m": [ROUGH | {"terrain_sigma_m": -0.1}],
    "/seed": [ROUGH | {"seed": seed} for seed in (-1, 1.5, 2**53)],
    "/wind": [PLACE | {"wind": 1}],
}
COMMON = {
    "/epochs": [3],
    "/a~1b~0cé": [3],
    "/controller": ["nobody", "sha256:" + "0" * 64, "../default", "sha256:ab", 1],
    "/physics": [[], "Paper"],
    "/physics/dt_s": [{"dt_s": 0}],
    "/physics/mass_kg": [{"mass_kg": -1}],
    "/physics/n_steps": [{"n_steps": 0}, {"n_steps": 10**12}],
    "/physics/impact": [{"impact": impact} for impact in ("soft", "bisection53", "bisection08")],
    "/physics/integrator": [{"integrator": word} for word in ("euler", "Split", "", 1, None)],
    "/physics/gravity": [{"gravity": 9.8}],
    "/priority": ["urgent", 1],
    "/label": ["x" * 201, "é" * 201, 7],
    "/weight": [0, -1, 0.0009, 1000.1, 1e300, "2", None],
}
SEED = {"/seed": [-1, 2**53]}
LEARNING = {  # settings of training runs and campaigns
    "/batch": [0, -1, 65537],
    "/schedule": ["paper", "cosine", 0.001, None, {"peak": 0.001}],
    "/schedule/kind": [{"kind": "linear"}],
    "/schedule/peak": [{"kind": "cosine", "peak": peak} for peak in (-0.001, 0, 1.5, "fast")],
    "/schedule/floor": [{"kind": "cosine", "peak": 0.001, "floor": 0.01},
                        {"kind": "cosine", "floor": -0.01}, {"kind": "cosine", "floor": 0}],
    "/schedule/decay": [{"kind": "restarts", "decay": decay} for decay in (0, 1.5)],
    "/schedule/cycle_steps": [{"kind": "restarts", "cycle_steps": 0}],
    "/schedule/cycle_growth": [{"kind": "restarts", "cycle_growth": n} for n in (0, 1001)],
    "/schedule/warmup_steps": [{"kind": "restarts", "warmup_steps": -1}],
    "/schedule/min": [{"kind": "restarts", "min": 0}],
    "/adam": [0.9, []],
    "/adam/beta1": [{"beta1": 1}],
    "/adam/beta2": [{"beta2": -0.1}],
    "/adam/epsilon": [{"epsilon": 0}],
    "/adam/gamma": [{"gamma": 0}],
    "/gradient_norm_limit": [-1, 1e7],
    "/adjoint_bound": [-2, "off"],
    "/adjoint_rule": ["scale", "Restart", 1, None],
    "/restart_weight": [-1, 1e7, "3", None],
}
EVALUATION = {
    "/designs": [[], {"cells": []}],
    "/designs/1": [[DESIGN, 7]],
    "/designs/0": [[{}], [DESIGN | BLOCK]],
    "/designs/0/voxels": [[{"voxels": voxels}] for voxels in
                          ("1" * 145, "1" * 143, "2" * 144, "0" * 144, "101" + "0" * 141, 1,
                           "1" * 100000)],
    "/designs/0/id": [[{"id": id}] for id in ("80", "0" * 35 + "1", "x" * 36, "0" * 36)],
    "/designs/0/name": [[DESIGN | {"name": "x"}]],
    "/enviroments": ["paper-test"],
    "/environments": ["moon", [], 5, [PLACE] * 65],
    "/record": ["com"],
    "/record/1": [["com", "pose"], ["com", "com"]],
    "/record_stride": [0, 2501],
    "/precision": ["float16"],
    "/verify": ["true", None],
    **{f"/designs/1/cells{place}": [[DESIGN, {"cells": cells}] for cells in values]
       for place, values in CELLS.items()},
    **{f"/environments/1{place}": [[PLACE, one] for one in values]
       for place, values in ENVIRONMENT.items()},
    **COMMON,
}
TRAINING = {
    "/kind": ["train", 1],
    "/preset": ["demo", "Paper", "", 2, None, {"name": "paper"}, "x" * 50],
    "/name": ["Walker", "../walker", "", "1" * 65, None],
    "/sensor": ["camera"],
    "/designs": [[DESIGN]],  # in a pretraining run
    "/steps": [0, -5, 10**9, 10**6 + 1, 10**30, 0.5, "60"],
    "/validation": [50],
    "/validation/every_steps": [{"every_steps": -1}],
    "/validation/designs": [{"designs": 0}, {"designs": 10001}],
    "/validation/environments": [{"environments": 65}],
    "/validation/every": [{"every": 5}],
    "/checkpoint/every_steps": [{"every_steps": -1}],
    "/checkpoint/every_s": [{"every_s": -1}, {"every_s": 86401}],
    "/checkpoint/keep": [{"keep": 0}, {"keep": 101}],
    "/checkpoint/path": [{"path": "/"}],
    **COMMON, **SEED, **LEARNING,
}
TUNING = {
    "/preset": ["phototaxis"],
    "/controller": ["nobody", None],
    "/sensor": ["inverse_sqrt"],
    "/designs": [[], [DESIGN] * 10001],
    "/designs/1/cells/0/2": [[DESIGN, {"cells": [[0, 0, 4]]}]],
}
POPULATION = {
    "/population": [{}, 12],
    "/population/evaluation": [{"evaluation": id} for id in ("999999", 7, "", "012", "-1")],
    "/population/campaign": [{"campaign": id} for id in ("999999", 7)],
}
CAMPAIGN = {
    "/mode": ["one-shot", 0],
    "/preset": ["laptop"],
    "/population": [0, 1, 10**8, 1e8, -64, 63.5, "64", None, [64]],
    "/generations": [-1, 100001, 0.5],
    "/replicates": [0, 101],
    "/controller": [None],
    "/environments": [[], "paper", [ROUGH] * 65],
    "/environments/0": [[{"terrain_sigma_m": 0.1, "seed": 1}]],
    "/initial": ["best", 12, {}],
    "/initial/designs": [{"designs": []}],
    "/initial/campaign": [{"campaign": "999999"}, {"campaign": 12}],
    "/initial/evaluation": [{"designs": [DESIGN], "evaluation": "1"}],
    "/initial/designs/1/cells/0/2": [{"designs": [DESIGN, {"cells": [[0, 0, 4]]}]}],
    "/initial/designs/1": [{"designs": [BAR, {"cells": [[3, y, 2] for y in range(4)]}]}],  # image
    "/initial/designs/2": [{"designs": [DESIGN, BAR, DESIGN]}],
    "/workspace": [[6, 6], "6x6x4"],
    "/workspace/0": [[0, 6, 4]],
    "/workspace/2": [[6, 6, 5]],
    "/mutation": [0.25],
    "/mutation/share": [{"share": 1.01}],
    "/mutation/rate": [{"rate": 0}, {"rate": 0.6}],
    "/mutation/growth": [{"growth": 0.99}],
    "/mutation/chance": [{"chance": 0.1}],
    "/selection": ["roulette", 4, {"size": 4}],
    "/selection/kind": [{"kind": "roulette"}],
    "/selection/size": [{"kind": "tournament", "size": 1}, {"kind": "novelty", "size": 4}],
    "/selection/weight": [{"kind": "novelty", "weight": 2}],
    "/selection/layers": [{"kind": "age-layered", "layers": 1}],
    "/learning": [{"parent_steps": 1}],  # in a zero-shot campaign
    "/exclude_pretraining": [1],
    "/collapse_share": [1.5],
    "/name": ["walker"],  # in a campaign that does not learn
    **COMMON, **SEED,
}
FEW_SHOT = {
    "/controller": [None],
    "/name": ["Walker"],
    "/learning": [{"parent_steps": 0, "child_steps": 0}],
    **{f"/learning{place}": [{place.split("/")[1]: value} for value in values]
       for place, values in LEARNING.items() if place not in ("/gradient_norm_limit", )},
    "/learning/parent_steps": [{"parent_steps": -1}],
    "/learning/sensor": [{"sensor": "inverse_sqrt"}],
    "/learning/checkpoint_every_s": [{"checkpoint_every_s": -1}],
    "/learning/steps": [{"steps": 3}],
}
SIMULTANEOUS = {
    "/controller": ["nobody"],
    "/learning/sensor": [{"sensor": "camera"}],
}
PRETRAIN, TUNE = {"kind": "pretrain"}, {"kind": "finetune", "designs": [DESIGN, BAR]}
TABLES = [
    ("evaluations", {"designs": [DESIGN]}, EVALUATION),
    ("trainings", PRETRAIN, TRAINING),
    ("trainings", TUNE, TUNING),
    ("trainings", {"kind": "finetune"}, POPULATION),
    ("campaigns", {"mode": "zero-shot"}, CAMPAIGN),
    ("campaigns", {"mode": "few-shot"}, FEW_SHOT),
    ("campaigns", {"mode": "simultaneous"}, SIMULTANEOUS),
]
PLACES = [(kind, base, pointer, table[pointer]) for kind, base, table in TABLES
          for pointer in table]
# Faults of several fields together, and of the whole body.
TOGETHER = [
    *((kind, value, [""]) for kind in ("evaluations", "trainings", "campaigns")
      for value in ([], "designs", {})),
    ("evaluations", {"designs": [BLOCK] * 500, "record": ["masses"], "record_stride": 1},
     ["/record"]),
    ("evaluations", {"designs": [DESIGN, {"voxels": "x"}], "controller": 5, "label": 7, "z": None},
     ["/designs/1/voxels", "/controller", "/label", "/z"]),
    ("evaluations", {"designs": [{"cells": [[9, 0, 0]]}] * 100},
     [f"/designs/{i}/cells/0/0" for i in range(32)]),
    ("trainings", {"kind": "finetune"}, [""]),
    ("trainings", TUNE | {"population": {"evaluation": "999999"}}, ["", "/population/evaluation"]),
    ("trainings", PRETRAIN | {"population": {"evaluation": "999999"}},
     ["/population", "/population/evaluation"]),
    ("trainings", PRETRAIN | {"preset": "paper", "steps": 32769}, ["/steps"]),
    ("trainings", PRETRAIN | {"steps": 10**6, "batch": 65536}, ["/steps"]),
    ("trainings", PRETRAIN | {"sensor": "inverse_sqrt", "controller": "default"}, ["/sensor"]),
    ("trainings",
     {"kind": "finetune", "population": {"evaluation": "999999", "campaign": "999999"}},
     ["/population", "/population/campaign"]),
    ("trainings", {"kind": "finetune", "population": {"evaluation": "999999", "best": 0}},
     ["/population/best", "/population/evaluation"]),
    ("trainings", {"kind": "finetune", "controller": "nobody",
                   "population": {"evaluation": "999999"}, "steps": 10**9, "batch": 0,
                   "schedule": {"kind": "cosine", "peak": -1}, "epochs": 7},
     ["/steps", "/batch", "/schedule/peak", "/epochs", "/controller", "/population/evaluation"]),
    ("campaigns", {"mode": "few-shot", "population": 10001, "generations": 1}, ["/population"]),
    ("campaigns", {"mode": "zero-shot", "population": 65536, "generations": 100000},
     ["/generations"]),
    ("campaigns", {"mode": "zero-shot", "seed": 2**53 - 1, "replicates": 2}, ["/seed"]),
    ("campaigns", {"mode": "zero-shot", "initial": {"designs": [DESIGN], "campaign": "999999"}},
     ["/initial", "/initial/campaign"]),
    ("campaigns", {"mode": "zero-shot", "initial": {"designs": [DESIGN, BAR, DESIGN, DESIGN]}},
     ["/initial/designs/2", "/initial/designs/3"]),
    ("campaigns", {"mode": "zero-shot", "workspace": [3, 2, 4],
                   "initial": {"designs": [DESIGN, BAR]}}, ["/initial/designs/1"]),
    ("campaigns", {"mode": "zero-shot", "workspace": [6, 1, 1],
                   "initial": {"designs": [{"cells": [[0, 0, 0], [0, 1, 0]]}]}},
     ["/initial/designs/0"]),
    ("campaigns", {"mode": "zero-shot", "population": 2,
                   "initial": {"designs": [DESIGN, BAR, DOT]}}, ["/initial/designs"]),
    ("campaigns", {"mode": "zero-shot", "selection": {"kind": "truncation", "weight": 0,
                                                      "layers": 2, "age_gap": 1}},
     ["/selection/weight", "/selection/layers", "/selection/age_gap"]),
    ("campaigns", {"mode": "simultaneous", "generations": 1000,
                   "learning": {"parent_steps": 10000}}, ["/learning"]),
    ("campaigns", {"mode": "simultaneous", "controller": "default",
                   "learning": {"sensor": "inverse_sqrt"}}, ["/learning/sensor"]),
    ("campaigns", {"mode": "zero-shot", "population": 1, "generations": -1,
                   "controller": "nobody", "initial": {"campaign": "999999"}, "replicates": 101,
                   "workspace": [7, 6, 4], "mutation": {"share": -1}, "epochs": 7},
     ["/population", "/generations", "/replicates", "/workspace/0", "/mutation/share", "/epochs",
      "/controller", "/initial/campaign"]),
]


def refused(service, kind, value, pointers):
    reply = service.request("POST", f"/v1/{kind}", value)
    assert reply.status == 422 and sorted(reply.pointers()) == sorted(pointers), reply.body
    assert all(len(fault["detail"]) > 15 for fault in reply.json()["errors"])


def field(pointer):
    return pointer.split("/")[1].replace("~1", "/").replace("~0", "~")


@pytest.mark.parametrize("kind, base, pointer, values", PLACES,
                         ids=[f"{kind} {pointer}" for kind, _, pointer, _ in PLACES])
def test_place(service, kind, base, pointer, values):
    for value in values:
        refused(service, kind, base | {field(pointer): value}, [pointer])


@pytest.mark.parametrize("kind, value, pointers", TOGETHER)
def test_together(service, kind, value, pointers):
    refused(service, kind, value, pointers)


# How many of these requests fit the schema, by the first position: their faults depend on several
# fields, or on the state of the service.
BEYOND_SCHEMA = {
    "evaluations": {"": 1, "/designs/0/voxels": 2, "/designs/0/id": 2, "/designs/1/cells/1": 1,
                    "/designs/1/cells/2": 2, "/controller": 2, "/record": 1, "/record_stride": 1},
    "trainings": {"": 2, "/preset": 1, "/controller": 4, "/sensor": 2, "/designs": 1, "/steps": 2,
                  "/population": 1, "/population/evaluation": 1, "/population/campaign": 1,
                  "/schedule/floor": 1},
    "campaigns": {"/population": 1, "/generations": 1, "/seed": 1, "/controller": 4, "/name": 1,
                  "/initial/campaign": 1, "/initial/designs": 1, "/initial/designs/0": 1,
                  "/initial/designs/1": 2, "/initial/designs/2": 2, "/learning": 3,
                  "/learning/schedule/floor": 1, "/learning/sensor": 2},
}


@pytest.mark.parametrize("kind", BEYOND_SCHEMA)
def test_the_contract_refuses_the_same(kind):
    name = f"{kind[:-1].capitalize()}Request"
    taken = CONTRACT.validator({"$ref": f"#/components/schemas/{name}"}).is_valid
    requests = [(base | {field(pointer): value}, pointer) for of, base, pointer, values in PLACES
                for value in values if of == kind]
    requests += [(value, pointers[0]) for of, value, pointers in TOGETHER if of == kind]
    assert collections.Counter(place for value, place in requests
                               if taken(value)) == BEYOND_SCHEMA[kind]
    post = CONTRACT.document["paths"][f"/v1/{kind}"]["post"]["requestBody"]["content"]
    examples = post["application/json"]["examples"].values()
    assert examples and all(taken(example["value"]) for example in examples)


DESIGNS = '{"designs":[{"cells":[[0,0,0]]}],'
# Numbers that JSON can write but float64 cannot represent, or only approximately.
HUGE = [
    ("evaluations", DESIGNS + '"environments":[{"light_xy_m":[1,1],"terrain_heights_m":[1e400%s]}]}'
     % (",0" * 63), "/environments/0/terrain_heights_m/0"),
    ("evaluations", DESIGNS + '"environments":[{"light_xy_m":[1,-1e400],"terrain_sigma_m":0,'
     '"seed":1}]}', "/environments/0/light_xy_m/1"),
    ("evaluations", DESIGNS + '"environments":[{"light_xy_m":[1,1],"terrain_sigma_m":0,'
     '"seed":9007199254740990.6}]}', "/environments/0/seed"),
    ("evaluations", '{"designs":[{"cells":[[1e400,0,0]]}]}', "/designs/0/cells/0/0"),
    ("evaluations", DESIGNS + '"physics":{"dt_s":1e400}}', "/physics/dt_s"),
    ("evaluations", DESIGNS + '"record_stride":99999999999999999999}', "/record_stride"),
    ("trainings", '{"kind":"pretrain","schedule":{"kind":"cosine","peak":1e400}}',
     "/schedule/peak"),
    ("trainings", '{"kind":"pretrain","adjoint_bound":1e999}', "/adjoint_bound"),
    ("trainings", '{"kind":"pretrain","gradient_norm_limit":1e400}', "/gradient_norm_limit"),
    ("trainings", '{"kind":"pretrain","steps":99999999999999999999}', "/steps"),
    ("campaigns", '{"mode":"zero-shot","mutation":{"growth":1e400}}', "/mutation/growth"),
    ("campaigns", '{"mode":"zero-shot","weight":-1e999}', "/weight"),
    ("campaigns", '{"mode":"zero-shot","population":99999999999999999999}', "/population"),
]


@pytest.mark.parametrize("kind, body, pointer", HUGE)
def test_numbers_that_are_not_finite(service, kind, body, pointer):
    reply = service.request("POST", f"/v1/{kind}", body=body)
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
    "repeated kind": b'{"kind":"pretrain","kind":"pretrain"}',
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
    for kind in BEYOND_SCHEMA:
        reply = service.request("POST", f"/v1/{kind}", body=MALFORMED[name])
        assert reply.status == 400, reply.body
        assert reply.json()["type"] == "/problems/malformed-json"
        fault, = reply.json()["errors"]
        assert "line " in fault["detail"]
        assert name != "NaN" or fault["pointer"] == "/designs/0/cells/0/0"


def test_escaped_keys(service):
    body = (b'{"\\u0064esigns":[{"c\\u0065lls":[[0,0,0]]}],'
            b'"ph\\u0079sics":{"n_steps":20,"\\u0069mpact":"exact"}}')
    assert service.post("/v1/evaluations", body=body)["physics"]["impact"] == "exact"


@pytest.mark.parametrize("kind", BEYOND_SCHEMA)
@pytest.mark.parametrize("headers, status",
                         [({"Content-Type": "text/plain"}, 415),
                          ({"Content-Type": "application/xml"}, 415),
                          ({"Content-Type": "application/json; charset=latin-1"}, 415),
                          ({"Content-Type": "nonsense"}, 415), ({"Content-Encoding": "gzip"}, 415),
                          ({"Content-Type": "application/json; charset=UTF-8"}, 422),
                          ({"Accept": "text/html"}, 406), ({"Idempotency-Key": ""}, 400)])
def test_headers(service, kind, headers, status):
    reply = service.request("POST", f"/v1/{kind}", body="{}", headers=headers)
    assert reply.status == status
    assert reply.headers.get("Accept-Encoding") == ("identity" if "Content-Encoding" in headers
                                                    else None)


def test_body_too_large(start):
    running = start("--max-body=64K")
    big = json.dumps({"label": "x" * 70000})
    pieces = (big[i:i + 5000].encode() for i in range(0, len(big), 5000))
    connection = running.connection()
    for body, how in ((big, {}), (b"x" * (3 << 20), {}), (pieces, {"connection": connection})):
        assert running.request("POST", "/v1/evaluations", body=body, **how).status == 413
    connection.close()
    assert running.request("POST", "/v1/jobs/1/pause", body=b"x" * 70000).status == 413
    assert running.request("GET", "/healthz").status == 200


def test_controller_of_another_workspace(service):
    tiny_controller(service)
    jobs = [("trainings", TUNE, "/batch")]
    jobs += [("campaigns", {"mode": mode}, "/population")
             for mode in ("zero-shot", "few-shot", "simultaneous")]
    for kind, value, other in jobs:
        value = value | {"controller": "tiny"}
        refused(service, kind, value, ["/controller"])
        assert "1 × 1 × 1" in service.request("POST", f"/v1/{kind}", value).json()["detail"]
        refused(service, kind, value | {field(other): 0}, [other, "/controller"])
