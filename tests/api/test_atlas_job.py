"""Jobs that build atlases: scores equal those of evaluations, and the file does not depend on what
computed it or interrupted it."""

import pathlib
import random
import sqlite3
import struct

import numpy
import pytest

from atlases import MEASURES
from ctl import ctl  # noqa: F401
from service import Service, await_end, awaited, until
from test_devices import FLAGS, fake

WORLDS = [{"task": "walk"}, {"light_xy_m": [4, 2.5], "terrain_sigma_m": 0.05, "seed": 3},
          {"task": "circle", "terrain": {"kind": "stairs-up"}}]
REQUEST = {"voxels": 4, "environments": WORLDS, "physics": {"n_steps": 60}}
COUNTS = [1, 2, 5, 21]
ENDED = ("succeeded", "failed", "cancelled")


def build(service, value, state="succeeded"):
    """Submits the build of an atlas, and returns its job at the end."""
    reply = service.request("POST", "/v1/atlases", value)
    assert reply.status == 202, reply.body
    path = f"/v1/jobs/{reply.json()['id']}"
    assert reply.headers["Location"] == path
    done = await_end(service, path).json()
    assert done["state"] == state, (done, service.log_text()[-2000:])
    return done


def file_of(service, name):
    return service.state / "atlases" / f"{name}.atlas"


class Atlas:
    """A file, read as docs/atlas.md describes it."""
    def __init__(self, path):
        data = pathlib.Path(path).read_bytes()
        assert data[:16] == b"morphod atlas\r\n\0\0"[:16]
        (order, version, *self.sides, self.voxels, self.orientations, self.n, block,
         worlds) = struct.unpack("<10I", data[16:56])
        assert order == 0x01020304 and version in (1, 2)
        header = 304 if version == 1 else 312
        bits = struct.unpack("<Q", data[296:304])[0] if version == 2 else 0
        self.names = [name for m, name in enumerate(MEASURES) if bits >> m & 1]
        self.counts = struct.unpack("<10Q", data[56:136])
        self.controller, self.physics = data[136:168].hex(), data[168:200].hex()
        self.fingerprint = data[232:296].rstrip(b"\0").decode()
        self.scores, self.losses, self.measures, at = [], [], [], header + worlds
        while at < len(data):
            _, n, first = struct.unpack("<IIQ", data[at:at + 16])
            assert n <= block and first == len(self.scores)
            at += 16 + 8 * n
            self.scores += list(numpy.frombuffer(data, "<f4", n, at))
            at += (4 * n + 7) // 8 * 8
            self.losses += list(numpy.frombuffer(data, "<f2", n * self.n, at).reshape(n, self.n))
            at += (2 * n * self.n + 7) // 8 * 8
            k = len(self.names)
            self.measures += list(numpy.frombuffer(data, "<f4", n * k, at).reshape(k, n).T)
            at += (4 * n * k + 7) // 8 * 8 + 8
        assert len(self.scores) == sum(self.counts)


def all_bodies(service, voxels):
    """Returns the ids of all bodies of at most so many voxels, in the order of an atlas."""
    shapes, ids = {frozenset([(2, 2, 0)])}, []
    for size in range(1, voxels + 1):
        designs = [{"cells": [list(cell) for cell in sorted(shape)]} for shape in sorted(
            shapes, key=sorted)]
        found = set()
        for i in range(0, len(designs), 1000):
            made = service.post("/v1/bodies/canonical", {"designs": designs[i:i + 1000]})
            found |= {item["id"] for item in made["items"]}
        ids += sorted(found, reverse=True)
        grown = set()
        for shape in shapes:
            for x, y, z in shape:
                for more in ((x + 1, y, z), (x - 1, y, z), (x, y + 1, z), (x, y - 1, z),
                             (x, y, z + 1), (x, y, z - 1)):
                    if more not in shape:
                        low = [min(cell[i] for cell in shape | {more}) for i in range(3)]
                        moved = frozenset((a - low[0], b - low[1], c - low[2])
                                          for a, b, c in shape | {more})
                        if all(a < 6 and b < 6 and c < 4 for a, b, c in moved):
                            grown.add(moved)
        shapes = grown
    return ids


def evaluated(service, robots, value):
    """Returns the losses of robots from an ordinary evaluation, as float64."""
    request = {"designs": [{"id": robot} for robot in robots], "physics": value["physics"],
               "environments": value["environments"]}
    reply = service.evaluate(request, wait=60)
    assert reply.status == 200, reply.body
    results = reply.json()["results"]
    return ([[cell["loss"] for cell in result["losses"]] for result in results],
            [result["genotype"] for result in results])


@pytest.fixture(scope="module", name="service")
def service_of_this_module():
    running = Service("--workers=2")
    yield running
    assert running.close() == 0, running.log_text()


@pytest.fixture(scope="module")
def built(service):
    """The jobs and files of both orientations, built before anything else is scored."""
    jobs = {orientations: build(service, REQUEST | {"orientations": orientations})
            for orientations in ("images", "canonical")}
    with sqlite3.connect(f"file:{service.state}/morphod.db?mode=ro", uri=True) as database:
        for table in ("scores", "genotypes", "designs", "set_scores"):
            assert database.execute(f"SELECT count(*) FROM {table}").fetchone() == (0, ), table
    return jobs


def test_the_job(service, built):
    job = built["images"]
    assert job["kind"] == "atlas" and job["priority"] == "batch" and job["error"] is None
    assert job["atlas"]["name"] == "atlas-4" and job["atlas"]["environments"] == {"count": 3}
    assert built["canonical"]["atlas"]["name"] == "atlas-4-canonical"
    assert job["atlas"]["bodies_done"] == job["atlas"]["bodies_total"] == sum(COUNTS)
    assert job["atlas"]["rollouts_done"] == 3 * (1 + 3 + 15 + 86)
    assert built["canonical"]["atlas"]["rollouts_done"] == 3 * sum(COUNTS)
    assert job["core_seconds"] > 0
    listed = service.get("/v1/jobs?kind=atlas")["items"]
    assert [row["id"] for row in listed[-2:]] == [built["canonical"]["id"], job["id"]]
    events = service.get(f"/v1/events?format=json&job={job['id']}")["items"]
    types = [event["type"] for event in events]
    assert types[:2] == ["job.created", "job.started"] and types[-1] == "job.finished"
    assert "atlas.progress" in types and events[-1]["data"]["atlas"] == "atlas-4"
    assert service.metric("morphod_atlas_bodies_total") >= 2 * sum(COUNTS)
    assert service.metric("morphod_atlases_running") == 0
    assert [path.name for path in sorted((service.state / "atlases").iterdir())] == [
        "atlas-4-canonical.atlas", "atlas-4.atlas"]


def test_scores_are_those_of_evaluations(service, built):
    """Bodies drawn at random, in both orientations, bit for bit."""
    bodies = all_bodies(service, 4)
    assert len(bodies) == sum(COUNTS)
    atlases = {name: Atlas(file_of(service, built[name]["atlas"]["name"])) for name in built}
    for name, atlas in atlases.items():
        assert list(atlas.counts) == COUNTS + [0] * 6 and atlas.voxels == 4 and atlas.n == 3
        assert atlas.sides == [6, 6, 4] and atlas.orientations == (name == "images")
        assert atlas.controller == built[name]["atlas"]["controller"]["sha256"]
        assert atlas.fingerprint.startswith("cpu ")
    differ = 0
    for i in random.Random(5).sample(range(len(bodies)), 12):
        losses, genotypes = evaluated(service, [f"{bodies[i]}@{k}" for k in range(8)], REQUEST)
        distinct = [losses[k] for k in range(8) if genotypes[k] not in genotypes[:k]]
        means = []
        for e in range(3):
            total = 0.0
            for one in distinct:
                total += one[e]
            means.append(total / len(distinct))
        for name, expected in (("canonical", losses[0]), ("images", means)):
            score = 0.0
            for loss in expected:
                score += loss
            score /= 3
            assert atlases[name].scores[i] == numpy.float32(score), (name, bodies[i])
            assert (atlases[name].losses[i] == numpy.array(expected, "<f2")).all(), name
        differ += atlases["images"].scores[i] != atlases["canonical"].scores[i]
    assert differ > 6, "most bodies are not symmetric"


def means_of(service, robots, value, measures):
    """Returns the measures of each rollout, and the means of each robot, from an evaluation."""
    request = {"designs": [{"id": robot} for robot in robots], "physics": value["physics"],
               "environments": value["environments"], "measures": measures}
    results = service.evaluate(request, wait=60).json()["results"]
    names = list(results[0]["measures"])

    def row(of):
        return [numpy.nan if of["measures"][name] is None else of["measures"][name]
                for name in names]

    return (names, [[row(cell) for cell in result["losses"]] for result in results],
            [row(result) for result in results], [result["genotype"] for result in results])


@pytest.mark.parametrize("orientations", ("images", "canonical"))
@pytest.mark.parametrize("measures", (True, ["mean_speed_m_per_s", "displacement_m", "work_j"]))
def test_measures_are_those_of_evaluations(service, orientations, measures):
    """The means of measures, bit for bit as float32."""
    value = REQUEST | {"orientations": orientations}
    job = build(service, value | {"measures": measures})
    named = list(MEASURES) if measures is True else sorted(measures, key=MEASURES.index)
    assert job["atlas"]["measures"] == named
    measured = Atlas(file_of(service, job["atlas"]["name"]))
    assert measured.names == named
    plain = build(service, value)
    assert plain["atlas"]["measures"] == []
    plain = Atlas(file_of(service, plain["atlas"]["name"]))
    assert plain.scores == measured.scores and not plain.names, "measures change no score"
    bodies = all_bodies(service, 4)
    for i in (0, 2, *random.Random(7).sample(range(len(bodies)), 8)):
        names, rollouts, means, genotypes = means_of(
            service, [f"{bodies[i]}@{k}" for k in range(8)], REQUEST, measures)
        assert names == named
        if orientations == "canonical":
            expected = means[0]
        else:
            distinct = [rollouts[k] for k in range(8) if genotypes[k] not in genotypes[:k]]
            expected = []
            for m in range(len(named)):
                total = 0.0
                for e in range(3):
                    inner = 0.0
                    for one in distinct:
                        inner += one[e][m]
                    total += inner / len(distinct)
                expected.append(total / 3)
        numpy.testing.assert_array_equal(measured.measures[i], numpy.float32(expected))
        assert not numpy.isnan(measured.measures[i]).all()


def test_no_measures_of_diverged_bodies(service):
    """As in evaluations, a mean needs all of its numbers."""
    wild = {"integrator": "paper", "dt_s": 0.05, "n_steps": 500, "control_period_s": 0.05}
    value = {"voxels": 2, "measures": True, "physics": wild, "environments": [{"task": "walk"}],
             "name": "diverged"}
    build(service, value)
    atlas = Atlas(file_of(service, "diverged"))
    assert numpy.isinf(atlas.scores).all() and numpy.isnan(atlas.measures).all()
    assert len(atlas.measures[0]) == 20
    data = service.get("/v1/atlases/diverged/body?position=1")
    assert set(data["measures"].values()) == {None} == set(data["of_size"]["measures"].values())


def test_measured_elsewhere(service, start):
    """With measures, too, the file is the same for other numbers of threads, and devices."""
    value = REQUEST | {"measures": True}
    done = build(service, value | {"name": "measured"})
    expected = file_of(service, "measured").read_bytes()
    assert done["atlas"]["rollouts_done"] == 3 * (1 + 3 + 15 + 86)
    other = start("--workers=1")
    build(other, value | {"name": "other"})
    assert file_of(other, "other").read_bytes() == expected
    on_device = start(*FLAGS, environment=fake(devices=2))
    done = build(on_device, value | {"device": "cuda", "name": "third"})
    assert done["device"] == "cuda"
    found = file_of(on_device, "third")
    assert Atlas(found).scores == Atlas(file_of(service, "measured")).scores
    numpy.testing.assert_array_equal(
        Atlas(found).measures, Atlas(file_of(service, "measured")).measures)


@pytest.mark.parametrize("orientations", ("images", "canonical"))
def test_the_same_file_elsewhere(service, built, start, orientations):
    """Other numbers of threads, and devices: the module for tests computes the same bits, but says
    that they are of another class."""
    expected = file_of(service, built[orientations]["atlas"]["name"]).read_bytes()
    other = start("--workers=1")
    done = build(other, REQUEST | {"orientations": orientations, "name": "other"})
    assert file_of(other, "other").read_bytes() == expected
    assert done["device"] == "cpu"
    files = []
    for n in (1, 2):
        on_device = start(*FLAGS, environment=fake(devices=n))
        done = build(on_device, REQUEST | {"orientations": orientations, "device": "cuda"})
        assert done["device"] == "cuda" and done["device_seconds"] > 0
        files.append(file_of(on_device, done["atlas"]["name"]).read_bytes())
        on_device.close()
    assert files[0] == files[1] and len(files[0]) == len(expected)


def test_names(service):
    value = {"voxels": 1, "task": "walk", "physics": {"n_steps": 4}}
    names = [build(service, value)["atlas"]["name"] for _ in range(3)]
    assert names == ["walk-1", "walk-1-2", "walk-1-3"]
    assert build(service, {"voxels": 1, "orientations": "canonical", "physics": {"n_steps": 4}})[
        "atlas"]["name"] == "paper-test-1-canonical"
    reply = service.request("POST", "/v1/atlases", value | {"name": "walk-1"})
    assert reply.status == 409 and reply.pointers() == ["/name"]
    assert "already exists; choose another name" in reply.json()["detail"]


def test_a_name_in_use(service):
    long = {"voxels": 6, "name": "long", "physics": {"n_steps": 5000}}
    id = service.post("/v1/atlases", long)["id"]
    reply = service.request("POST", "/v1/atlases", long | {"voxels": 1})
    assert reply.status == 409 and f"job {id} builds the atlas" in reply.json()["detail"]
    path = f"/v1/jobs/{id}"
    running = awaited(service, path, lambda job: job["atlas"]["bodies_done"] > 0 and
                      job["atlas"]["progress"]["rollouts_per_s"] is not None)
    assert running["state"] == "running" and running["atlas"]["phase"] == "scoring"
    assert running["atlas"]["bodies_total"] == sum(COUNTS) + 95 + 530
    part = service.state / "atlases" / "long.atlas.part"
    assert part.exists()
    assert service.request("DELETE", path).status == 409
    assert service.act(id, "pause").status == 200
    assert service.get(path)["state"] == "paused"
    assert service.act(id, "cancel").status == 200
    until(lambda: not part.exists())
    assert service.request("DELETE", path).status == 200
    assert build(service, long | {"voxels": 1})["atlas"]["name"] == "long"


def test_keys(service):
    value = {"voxels": 1, "physics": {"n_steps": 4}, "name": "keyed"}
    headers = {"Idempotency-Key": "one atlas"}
    first = service.post("/v1/atlases", value, headers=headers)
    assert service.post("/v1/atlases", value, headers=headers)["id"] == first["id"]
    assert service.request("POST", "/v1/atlases", value | {"voxels": 2},
                           headers=headers).status == 422


@pytest.mark.parametrize("change,pointer", [
    ({"voxels": 11}, "/voxels"), ({"voxels": None}, "/voxels"), ({"name": "-a"}, "/name"),
    ({"name": "A"}, "/name"), ({"name": "a" * 65}, "/name"), ({"name": ""}, "/name"),
    ({"task": "swim"}, "/task"), ({"task": "walk"}, "/task"),
    ({"environments": "morpho-12"}, "/environments"), ({"orientations": "best"}, "/orientations"),
    ({"priority": "interactive"}, "/priority"), ({"controller": "nobody"}, "/controller"),
    ({"measures": ["speed"]}, "/measures/0"), ({"measures": []}, "/measures"),
    ({"measures": 3}, "/measures"), ({"physics": {"dt_s": -1}}, "/physics/dt_s"),
    ({"designs": []}, "/designs")])
def test_refusals(service, change, pointer):
    reply = service.request("POST", "/v1/atlases", REQUEST | change)
    assert reply.status == 422 and reply.pointers() == [pointer], reply.body


def test_stops_and_pauses(service, start, tmp_path):
    """A service that stops and starts again, with pauses in between: the same file. The job is long
    enough that it is not over when its first bodies are durable."""
    value = REQUEST | {"physics": {"n_steps": 4000}}
    whole = build(service, value | {"name": "undisturbed"})
    expected = file_of(service, "undisturbed").read_bytes()
    state = tmp_path / "state"
    keeper = start("--workers=1", state=state)
    path = f"/v1/jobs/{keeper.post('/v1/atlases', value | {'name': 'mine'})['id']}"
    done, stops, pauses = 0, 0, 0
    for stop in range(4):
        job = awaited(keeper, path, lambda job, least=done: job["atlas"]["bodies_done"] > least or
                      job["state"] in ENDED)
        done = job["atlas"]["bodies_done"]
        if stop % 2 == 0 and keeper.act(job["id"], "pause").status == 200:
            assert keeper.get(path)["state"] == "paused"
            pauses += 1
            keeper.act(job["id"], "resume")
        assert keeper.stop() == 0
        keeper = start("--workers=2", state=state)
        stops += keeper.get(path)["state"] not in ENDED
    assert stops > 0 and pauses > 0, "the job was over too soon"
    job = await_end(keeper, path).json()
    assert job["state"] == "succeeded" and job["attempts"] == 0
    assert job["atlas"]["rollouts_done"] == whole["atlas"]["rollouts_done"]
    assert (state / "atlases" / "mine.atlas").read_bytes() == expected


def test_morphoctl(service, ctl):  # noqa: F811
    code, out, said = ctl("atlas build --voxels 2 --task walk --orientations canonical "
                          "-p n_steps=20 --name by-hand --wait")
    assert code == 0 and out.strip() == "by-hand" and "3 bodies" in said
    code, out, said = ctl("atlas build -n 2 -p n_steps=20")
    id = out.strip()
    assert code == 0 and f"morphoctl watch {id}" in said
    assert await_end(service, f"/v1/jobs/{id}").json()["atlas"]["name"] == "paper-test-2"
    shown = ctl(f"job show {id}")[1]
    assert "paper-test-2" in shown and "at most 2 voxels, images" in shown
    assert any(row.split()[:2] == [id, "atlas"] for row in ctl("job list")[1].splitlines())
    assert "3 of 3 bodies" in ctl(f"watch {id}")[1]
    code, _, said = ctl("atlas build -n 2 --name by-hand")
    assert code != 0 and "choose another name" in said
    assert ctl("atlas build")[0] == 2 and ctl("atlas build -n 2 -t walk -e paper-test")[0] == 2
