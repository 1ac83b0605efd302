"""Controllers: uploads and downloads, by name and by hash; files that are not controllers."""

import hashlib
import json
import struct
import urllib.parse

import pytest

from service import BOOTSTRAP, DESIGN, SHORT, run

BYTES = BOOTSTRAP.read_bytes()
HEADER_SIZE = struct.unpack("<Q", BYTES[:8])[0]
HEADER = json.loads(BYTES[8:8 + HEADER_SIZE])
DATA = BYTES[8 + HEADER_SIZE:]


def pack(header, data=DATA):
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return struct.pack("<Q", len(text)) + text + data


def changed(name, **fields):
    return pack({**HEADER, name: {**HEADER[name], **fields}})


def test_round_trip(service):
    put = service.upload("round-trip", BYTES)
    digest, path = hashlib.sha256(BYTES).hexdigest(), "/v1/controllers/round-trip"
    assert put.status == 201 and put.headers["Location"] == path
    assert put.json()["sha256"] == digest and put.json()["parameters"] == 620912
    assert put.json()["workspace"] == [6, 6, 4]
    got = service.tagged(path + "/file")
    assert got.body == BYTES and got.headers["Content-Type"] == "application/octet-stream"
    by_hash = service.get(f"/v1/controllers/sha256:{digest}")
    assert by_hash["name"] is None and by_hash["sha256"] == digest
    upper = "sha256:" + digest.upper()
    assert service.request("GET", f"/v1/controllers/{upper}/file").body == BYTES
    request = {"designs": [DESIGN], "physics": SHORT, "controller": upper}
    assert service.evaluate(request).json()["controller"]["sha256"] == digest
    again = service.request("PUT", path + "/file", body=BYTES,
                            headers={"Content-Type": "application/vnd.safetensors"})
    assert again.status == 200 and service.get(path) == again.json()
    assert service.request("DELETE", path).status == 204
    service.refuses(path, "", status=404)
    assert service.request("DELETE", path).status == 404
    assert service.request("DELETE", "/v1/controllers/default").status == 409


def test_control_periods(service):
    """A controller states how often it computes its outputs; a request can override that."""
    metadata = {**HEADER["__metadata__"], "control_period_s": "0.016", "of": "this test alone"}
    put = service.upload("slow", pack({**HEADER, "__metadata__": metadata}))
    assert put.status == 201 and put.json()["control_period_s"] == 0.016
    del metadata["control_period_s"]
    put = service.upload("plain", pack({**HEADER, "__metadata__": metadata}))
    assert put.status == 201 and put.json()["control_period_s"] is None
    request = {"designs": [DESIGN], "physics": {"n_steps": 200}}

    def run(controller, **physics):
        body = {**request, "controller": controller, "physics": {"n_steps": 200, **physics}}
        value = service.evaluate(body).json()
        rolled = service.post("/v1/rollouts", body)
        losses = value["results"][0]["losses"]
        assert [r["loss"] for r in rolled["rollouts"]] == losses
        assert rolled["physics"] == value["physics"]
        return value["physics"]["control_period_s"], losses

    every_step, held = run("plain"), run("slow")
    assert every_step[0] == 0 and held[0] == 0.016 and held[1] != every_step[1]
    assert run("slow", control_period_s=0.002) == (0.002, every_step[1])
    assert run("plain", control_period_s=0.002) == every_step  # by its plain name
    assert run("plain", control_period_s=0.016) == held
    long = run("plain", control_period_s=10)[1]
    assert long == run("plain", control_period_s=0.8)[1] != held[1]  # one computation in both

    # The best robots under a controller are those under its own period.
    best = service.get("/v1/designs?sort=score&controller=slow")["items"]
    assert best == []  # 200 steps are not the default
    service.evaluate({"designs": [DESIGN], "controller": "slow"})
    assert len(service.get("/v1/designs?sort=score&controller=slow")["items"]) == 1


def test_control_periods_that_do_not_fit(service):
    for text in ("", "0", "-1", "11", "NaN", "x", "0.016 s", "[0.016]", "1e999"):
        metadata = {**HEADER["__metadata__"], "control_period_s": text}
        put = service.upload("bad", pack({**HEADER, "__metadata__": metadata}))
        assert put.status == 422 and "control_period_s" in put.json()["detail"], text
    metadata = {**HEADER["__metadata__"], "control_period_s": "0.016"}
    service.upload("slow", pack({**HEADER, "__metadata__": metadata}))
    for kind in ("evaluations", "rollouts"):
        for physics, place in (({"dt_s": 0.005}, "slow"), ({"control_period_s": 0.005}, "physics"),
                               ({"control_period_s": 0.001}, "physics")):
            reply = service.request("POST", f"/v1/{kind}", {
                "designs": [DESIGN], "controller": "slow", "physics": {"n_steps": 10, **physics}})
            assert reply.status == 422, reply.body
            assert place in reply.json()["detail"] and "whole multiple" in reply.json()["detail"]
    learned = {"kind": "pretrain", "name": "n", "steps": 1, "batch": 1,
               "physics": {"n_steps": 4, "control_period_s": 0.005}}
    assert "whole multiple" in service.request("POST", "/v1/trainings", learned).json()["detail"]
    learned["physics"] = {"n_steps": 400, "control_period_s": 0.514}  # 257 steps
    assert "at most 256 steps" in service.request("POST", "/v1/trainings", learned).json()["detail"]
    metadata = {**HEADER["__metadata__"], "control_period_s": "0.514"}
    service.upload("slower", pack({**HEADER, "__metadata__": metadata}))
    for kind, more in (("trainings", {"kind": "finetune", "steps": 1, "designs": [DESIGN]}),
                       ("campaigns", {"mode": "few-shot", "preset": "demo"})):
        reply = service.request("POST", f"/v1/{kind}", {
            "name": "n", "controller": "slower", "physics": {"n_steps": 400}, **more})
        assert reply.status == 422 and "256 times" in reply.json()["detail"], reply.body
    finetune = {"kind": "finetune", "name": "n", "controller": "slow", "steps": 1, "batch": 1,
                "designs": [DESIGN], "physics": {"n_steps": 4, "dt_s": 0.005}}
    assert "whole multiple" in service.request("POST", "/v1/trainings", finetune).json()["detail"]


def test_a_controller_keeps_the_period_that_it_learned_with(service):
    """Training, finetuning and campaigns pass a control period on."""
    small = {"steps": 1, "batch": 2, "validation": {"every_steps": 0}}
    slow = {"n_steps": 12, "control_period_s": 0.012}

    def train(**settings):
        job = run(service, "trainings", {**small, **settings})
        return service.get(f"/v1/trainings/{job['id']}")["settings"]["physics"]

    train(kind="pretrain", name="slow-pretrained", physics=slow)
    assert service.get("/v1/controllers/slow-pretrained")["control_period_s"] == 0.012
    own = train(kind="finetune", name="slow-finetuned", controller="slow-pretrained",
                designs=[DESIGN], physics={"n_steps": 12})
    assert own["control_period_s"] == 0.012
    assert service.get("/v1/controllers/slow-finetuned")["control_period_s"] == 0.012
    other = train(kind="finetune", name="quick-finetuned", controller="slow-pretrained",
                  designs=[DESIGN], physics={"n_steps": 12, "control_period_s": 0.004})
    assert other["control_period_s"] == 0.004
    assert service.get("/v1/controllers/quick-finetuned")["control_period_s"] == 0.004
    for mode, start in (("zero-shot", {"controller": "slow-finetuned"}),
                        ("few-shot", {"controller": "slow-finetuned"}), ("simultaneous", {})):
        request = {"mode": mode, "preset": "demo", "name": "slow-" + mode, "population": 4,
                   "generations": 1, "exclude_pretraining": False, **start,
                   "physics": {"n_steps": 12} if start else slow}
        if mode == "zero-shot":
            del request["name"]
        else:
            request["learning"] = {"parent_steps": 1, "child_steps": 1, "batch": 2}
        job = run(service, "campaigns", request)
        campaign = service.get(f"/v1/campaigns/{job['id']}")
        assert campaign["settings"]["physics"]["control_period_s"] == 0.012
        if mode != "zero-shot":
            sha256 = campaign["result"]["controller"]["sha256"]
            result = service.get(f"/v1/controllers/sha256:{sha256}")
            assert result["control_period_s"] == 0.012


def test_repointing_changes_what_is_computed(service):
    other = pack(HEADER, DATA[:-4] + struct.pack("<f", 0.5))
    request = {"designs": [DESIGN], "physics": SHORT, "controller": "moving"}
    service.upload("moving", BYTES)
    first = service.evaluate(request).json()
    assert service.upload("moving", other).status == 200
    second = service.evaluate(request).json()["controller"]
    assert first["controller"]["name"] == second["name"] == "moving"
    before = first["controller"]["sha256"]
    assert before != second["sha256"] == hashlib.sha256(other).hexdigest()
    by_hash = service.evaluate(request | {"controller": "sha256:" + before}).json()
    assert by_hash["results"] == first["results"] and by_hash["rollouts_cached"] == 10
    assert by_hash["controller"]["name"] is None


def test_list(service):
    for name in ("list-a", "list-b", "list-c"):
        service.upload(name, BYTES)
    names = [item["name"] for item in service.pages("/v1/controllers", 2)]
    assert names == sorted(names)
    assert {"default", "bootstrap", "list-a", "list-b", "list-c"} <= set(names)


@pytest.mark.parametrize(
    "name", ["UPPER", "-minus", ".dot", "a" * 65, "sha256:" + "0" * 64, "a%20b", "%C3%A9"])
def test_names(service, name):
    assert service.upload(name, BYTES).status == 422


def test_damaged_file_is_named_and_healed(start):
    service = start()
    digest = hashlib.sha256(BYTES).hexdigest()
    request = {"designs": [DESIGN], "physics": SHORT}
    (service.state / "controllers" / f"{digest}.safetensors").write_bytes(BYTES[:-4])
    got = service.request("GET", "/v1/controllers/default/file")
    assert got.status == 500 and digest in got.json()["detail"] and "PUT" in got.json()["detail"]
    job = service.evaluate(request).json()
    assert job["state"] == "failed" and job["error"]["code"] == "corrupt" and digest in job[
        "error"]["detail"]
    assert f"{digest}.safetensors" in service.log_text()
    assert service.upload("default", BYTES).status == 200
    assert service.request("GET", "/v1/controllers/default/file").body == BYTES
    assert service.evaluate(request).json()["state"] == "succeeded"


FIRST = "net.0.weight"
SECOND = "net.0.bias"
HOSTILE = {
    "empty": b"",
    "seven bytes": BYTES[:7],
    "header only": BYTES[:8 + HEADER_SIZE],
    "cut in the header": BYTES[:100],
    "cut in the data": BYTES[:-4],
    "a byte more": BYTES + b"\0",
    "header of 2^63 bytes": struct.pack("<Q", 1 << 63) + BYTES[8:],
    "header of 2^64 - 1 bytes": b"\xff" * 8 + BYTES[8:],
    "header larger than the file": struct.pack("<Q", len(BYTES)) + BYTES[8:],
    "huge header": pack(b"{" + b" " * (2 << 20) + b"}"),
    "header not JSON": pack(b"{nonsense}"),
    "header an array": pack([]),
    "header not UTF-8": pack(b'{"\xff":1}'),
    "deep header": pack(b"[" * 100000),
    "no tensors": pack({}),
    "tensor missing": pack({name: HEADER[name] for name in HEADER if name != SECOND}),
    "tensor too many": pack({**HEADER, "net.99.weight": HEADER[SECOND]}),
    "repeated tensor": pack(json.dumps(HEADER).encode()[:-1] + b',"net.0.bias":' +
                            json.dumps(HEADER[SECOND]).encode() + b"}"),
    "wrong type": changed(SECOND, dtype="F16"),
    "wrong shape": changed(FIRST, shape=[1, 2]),
    "turned shape": changed(FIRST, shape=HEADER[FIRST]["shape"][::-1]),
    "shape overflow": changed(FIRST, shape=[1 << 40, 1 << 40]),
    "negative shape": changed(FIRST, shape=[-256, -250]),
    "overlapping offsets": changed(SECOND, data_offsets=[0, 1024]),
    "offsets beyond the end": changed(SECOND, data_offsets=[len(DATA), len(DATA) + 1024]),
    "offsets reversed": changed(SECOND, data_offsets=HEADER[SECOND]["data_offsets"][::-1]),
    "offsets of text": changed(SECOND, data_offsets=["0", "4"]),
    "offsets negative": changed(SECOND, data_offsets=[-4, 1020]),
    "unknown sensor": changed("__metadata__", sensor="nose"),
    "metadata not text": pack({**HEADER, "__metadata__": {"a": 1}}),
    "workspace that does not fit": changed("__metadata__", workspace="9x9x9"),
    "not a number inside": pack(HEADER, struct.pack("<f", float("nan")) + DATA[4:]),
    "infinity inside": pack(HEADER, DATA[:-4] + struct.pack("<f", float("inf"))),
    "JSON": b'{"designs":[]}',
    "zeros": bytes(100000),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile(service, name):
    reply = service.upload("hostile", HOSTILE[name])
    assert reply.status == 422, reply.body
    assert reply.pointers() == [""] and reply.json()["errors"][0]["detail"]
    assert service.request("GET", "/v1/controllers/hostile").status == 404


def test_upload_limits(start):
    running = start("--max-controller=3M")
    assert running.upload("big", bytes(4 << 20)).status == 413
    assert running.upload("fits", BYTES).status == 201
    assert running.request("PUT", "/v1/controllers/x/file", body=BYTES,
                           headers={"Content-Type": "application/json"}).status == 415


@pytest.mark.parametrize("file, names", [("slow-gait.safetensors", ["default", "slow-gait"]),
                                         ("Not a Name.safetensors", ["default"])])
def test_name_of_the_first(start, tmp_path, file, names):
    (tmp_path / file).write_bytes(BYTES)
    service = start(f"--default-controller={tmp_path / file}")
    items = service.get("/v1/controllers")["items"]
    assert [item["name"] for item in items] == names and len({item["sha256"]
                                                              for item in items}) == 1


@pytest.mark.parametrize("cursor", ["~", "~1", "{}", "", "UPPER", "a" * 65])
def test_cursors_that_no_page_gave(service, cursor):
    reply = service.request("GET", f"/v1/controllers?cursor={urllib.parse.quote(cursor)}")
    assert reply.status == 400, reply.body
