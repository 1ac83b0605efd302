"""Evaluations of more designs than are stored with the submission."""

import json
import sqlite3

import pytest

from ctl import ctl  # noqa: F401
from service import awaited, run

WORLD = {"environments": [{"light_xy_m": [2.6, 2.5], "terrain_sigma_m": 0.02, "seed": 1}],
         "physics": {"n_steps": 10}}
N = 10_400


@pytest.fixture(scope="module")
def bodies(service):
    return [body for first in (0, 10_000)
            for body in service.post("/v1/bodies/random", {"count": min(10_000, N - first),
                                                           "seed": 41, "first": first})["items"]]


def hexadecimal(genotype):
    return f"{int(genotype, 2):036x}"


def results(service, id, query=""):
    return service.pages(f"/v1/evaluations/{id}/results{query}")


def test_same_as_random(service, bodies):
    """Designs in every form, in order, with one `best`; the same scores as for random ones."""
    designs = [{"voxels": hexadecimal(body["genotype"])} for body in bodies]
    designs[5] = {"voxels": "g" + bodies[5]["genotype"]}
    designs[7] = designs[N - 1] = {"id": bodies[7]["id"] + "@3"}
    job = run(service, "evaluations", WORLD | {"designs": designs})
    assert job["state"] == "succeeded" and job["n_designs"] == N and job["random"] is None
    assert job["n_waiting"] == 0 and job["rollouts_done"] == N and "results" not in job
    items = results(service, job["id"])
    assert [item["number"] for item in items] == list(range(N))
    assert items[7]["robot"] == items[N - 1]["robot"]
    random = run(service, "evaluations", WORLD | {"random": {"count": N, "seed": 41}})
    drawn = results(service, random["id"])
    differ = [a["number"] for a, b in zip(items, drawn) if a != b]
    assert set(differ) <= {7, N - 1} and N - 1 in differ
    best = run(service, "evaluations", WORLD | {"designs": designs, "best": 3})
    whole = results(service, best["id"], "?whole=true")
    assert sorted(item["score"] for item in whole)[:3] == sorted(
        item["score"] for item in items)[:3]


def test_few_hexadecimal_voxels(service, bodies):
    few = [{"voxels": hexadecimal(body["genotype"])} for body in bodies[:3]]
    listed = run(service, "evaluations", WORLD | {"designs": few})
    assert [row["genotype"] for row in listed["results"]] == [
        body["genotype"] for body in bodies[:3]]
    wrong = service.request("POST", "/v1/evaluations",
                            WORLD | {"designs": [{"voxels": hexadecimal("1" * 144)[1:] + "x"}]})
    assert wrong.status == 422 and wrong.pointers() == ["/designs/0/voxels"]


def test_restart_while_they_are_stored(start, tmp_path, bodies):
    """Waiting designs are stored after a pause and a restart, and deleted with the job."""
    designs = [{"voxels": hexadecimal(body["genotype"])} for body in bodies] * 4
    service = start(state=tmp_path / "state")
    job = service.post("/v1/evaluations", WORLD | {"designs": designs})
    assert 0 < job["n_waiting"] <= len(designs)
    path = f"/v1/evaluations/{job['id']}"
    assert service.act(job["id"], "pause").status == 200
    before = service.get(path)["n_waiting"]
    assert 0 < before and service.stop() == 0
    service = start(state=tmp_path / "state")
    assert service.get(path)["n_waiting"] == before
    assert service.act(job["id"], "resume").status == 200
    awaited(service, path, lambda seen: seen["n_waiting"] < before)
    assert service.stop() == 0
    service = start(state=tmp_path / "state")
    done = awaited(service, path, lambda seen: seen["state"] in ("succeeded", "failed"))
    assert done["state"] == "succeeded" and done["n_waiting"] == 0
    items = service.get(f"{path}/results?limit=500&cursor={3 * N}")["items"]
    assert [item["genotype"] for item in items] == [body["genotype"] for body in bodies[:500]]
    assert service.request("DELETE", f"/v1/jobs/{job['id']}").status in (200, 204)
    assert service.request("GET", path).status == 404


@pytest.mark.parametrize("damage", ["DELETE FROM waiting_designs",
                                    "UPDATE waiting_designs SET checksum=checksum+1"])
def test_a_damaged_list_delays_no_other_job(start, tmp_path, bodies, damage):
    designs = [{"voxels": hexadecimal(body["genotype"])} for body in bodies]
    service = start(state=tmp_path / "state")
    job = service.post("/v1/evaluations", WORLD | {"designs": designs * 3})
    assert service.act(job["id"], "pause").status == 200 and service.stop() == 0
    with sqlite3.connect(tmp_path / "state" / "morphod.db") as database:
        assert database.execute(damage).rowcount > 0
    service = start(state=tmp_path / "state")
    other = service.post("/v1/evaluations", WORLD | {"random": {"count": 60_000, "seed": 3}})
    assert service.act(job["id"], "resume").status == 200
    ended = awaited(service, f"/v1/jobs/{job['id']}", lambda seen: seen["state"] == "failed")
    assert "damaged" in ended["error"]["detail"]
    awaited(service, f"/v1/jobs/{other['id']}", lambda seen: seen["n_waiting"] < 50_000)
    assert service.act(other["id"], "cancel").status == 200


@pytest.mark.parametrize("place, design, more, pointer", [
    (17, lambda body: {"id": body["id"]}, {}, "/designs/17"),
    (10_399, lambda body: {"id": body["id"]}, {}, "/designs/10399"),
    (3, lambda body: {"voxels": "1" + "0" * 142 + "1"}, {"repair": "largest"}, "/designs/3"),
    (10_300, lambda body: {"voxels": "0" * 144}, {"on_fault": "skip"}, "/designs/10300"),
    (9, lambda body: {"voxels": "0" * 144}, {}, "/designs/9/voxels"),
    (0, None, {"record": ["com"]}, "/designs"),
    (0, None, {"verify": True}, "/designs"),
    (0, None, {"environments": WORLD["environments"] * 64, "physics": {"n_steps": 1}}, None),
])
def test_what_is_refused(service, bodies, place, design, more, pointer):
    designs = [{"voxels": hexadecimal(body["genotype"])} for body in bodies]
    if design is not None:
        designs[place] = design(bodies[place])
    reply = service.request("POST", "/v1/evaluations", WORLD | {"designs": designs} | more)
    if pointer is None:
        assert reply.status == 202
        assert service.act(reply.json()["id"], "cancel").status == 200
    else:
        assert reply.status == 422 and reply.pointers() == [pointer], reply.body


def test_a_million_and_one(service):
    sent = b'{"designs":[' + b'{"cells":[[0,0,0]]},' * 1_000_000 + b'{"cells":[[0,0,0]]}]}'
    reply = service.request("POST", "/v1/evaluations", body=sent)
    assert reply.status == 422 and reply.pointers() == ["/designs"], reply.body[:500]


def test_others_take_ten_thousand(service, bodies):
    designs = [{"voxels": body["genotype"]} for body in bodies[:10_001]]
    reply = service.request("POST", "/v1/trainings", {"kind": "finetune", "designs": designs})
    assert reply.status == 422 and "/designs" in reply.pointers()


def test_morphoctl(ctl, bodies, tmp_path):  # noqa: F811
    """A file of more than 10,000 bodies."""
    file = tmp_path / "bodies.txt"
    named = [{"voxels": body["genotype"], "name": f"n{i}"} for i, body in enumerate(bodies)]
    file.write_text("\n".join(map(json.dumps, named)))
    world = tmp_path / "world.json"
    world.write_text('[{"light_xy_m": [2.6, 2.5], "terrain_sigma_m": 0.02, "seed": 1}]')
    status, shown, said = ctl("eval --physics n_steps=10 --best 3 --environments", str(world),
                              str(file))
    assert status == 0 and "@" in shown, said
    for line in shown.splitlines()[1:]:  # each row names its design
        assert line[0] == "…" or f"n{line.split()[0]}" in line.split(), line
    assert "10,400 rollouts" in said and "export evaluations/" in said
