"""Environments, bodies, scenes and rollouts: what a viewer needs, and that it agrees with
evaluations."""

import hashlib
import json
import struct

import pytest

from contract import SOURCE
from service import DESIGN, SHORT, run

WORLD = {"light_xy_m": [4.5, 2.5], "terrain_sigma_m": 0.05, "seed": 7}
FORMATS = {"float64": "d", "float32": "f", "uint16": "H", "uint32": "I", "uint8": "B",
           "int8": "b", "int16": "h"}


def scene(reply):
    """Returns the header of a scene, and a function that reads one of its arrays as rows of
    numbers."""
    assert reply.headers["Content-Type"] == "application/vnd.morphod.scene"
    (length, ) = struct.unpack_from("<I", reply.body)
    header = json.loads(reply.body[4:4 + length])

    def array(described):
        n = 1
        for side in described["shape"]:
            n *= side
        assert described["offset"] % 8 == 0
        return struct.unpack_from(f"<{n}{FORMATS[described['type']]}", reply.body,
                                  4 + length + described["offset"])

    return header, array


def roll(service, value, **headers):
    headers = {"Accept": "application/vnd.morphod.scene", **headers}
    return service.request("POST", "/v1/rollouts", value, headers=headers)


def test_positions_of_16_bits(service):
    """On request only, they take half of the bytes and are within 0.5 mm; all else is the same.
    Positions that are too far apart for that stay float32."""
    value = {"designs": [DESIGN, {"cells": [[0, 0, 0], [1, 0, 0]]}], "environments": [WORLD],
             "record": ["masses", "contacts"], "record_stride": 20}
    exact, exact_array = scene(roll(service, value))
    small, small_array = scene(roll(service, value | {"masses_int16": True}))
    names = {"masses_int16", "masses_origin_m", "masses_unit_m"}
    assert len(small["rollouts"]) == 2
    for before, after in zip(exact["rollouts"], small["rollouts"]):
        assert names.isdisjoint(before)
        assert set(after) == set(before) - {"masses_m"} | names
        assert after["masses_int16"]["shape"] == before["masses_m"]["shape"]
        unit = after["masses_unit_m"]
        assert 0 < unit < 1e-4
        pairs = zip(exact_array(before["masses_m"]), small_array(after["masses_int16"]))
        far = max(abs(meters - after["masses_origin_m"][i % 3] - number * unit)
                  for i, (meters, number) in enumerate(pairs))
        assert far <= unit * 0.501
        assert after["loss"] == before["loss"]
        assert small_array(after["contacts"]) == exact_array(before["contacts"])
    flown = value | {"masses_int16": True, "physics": {"drop_height_m": 90, "gravity_m_per_s2": 90,
                                                     "drag_per_s": 0}}
    for rollout in scene(roll(service, flown))[0]["rollouts"]:
        assert "masses_m" in rollout and names.isdisjoint(rollout)
    assert roll(service, value | {"masses_int16": 1}).status == 422


def test_environments_are_reported(service):
    items = service.get("/v1/environment-sets/paper-test")["items"]
    assert len(items) == 10
    for item in items:
        numbers = item["light_xy_m"] + item["terrain_heights_m"]
        assert item["sha256"] == hashlib.sha256(struct.pack("<66d", *numbers)).hexdigest()
        assert service.get("/v1/environments/" + item["sha256"]) == item
    kept = service.request("GET", "/v1/environments/" + items[0]["sha256"])
    assert kept.headers["Cache-Control"] == "private, max-age=31536000, immutable"
    evaluation = service.evaluate({"designs": [DESIGN], "physics": SHORT, "environments": [WORLD]})
    listed = service.get(f"/v1/evaluations/{evaluation.json()['id']}/environments")["items"]
    assert len(listed) == 1 and listed[0]["light_xy_m"] == WORLD["light_xy_m"]
    for path in ("environments/" + "0" * 64, "environments/x", "environment-sets/none",
                 "physics/" + "0" * 64, "physics/x", "evaluations/999999/environments",
                 "campaigns/999999/environments"):
        service.refuses("/v1/" + path, "", status=404)


def test_a_score_can_be_recomputed_with_only_http(service):
    evaluation = service.evaluate({"designs": [DESIGN], "physics": {"n_steps": 37}}).json()
    result = evaluation["results"][0]
    design = service.get("/v1/designs/" + result["id"])
    stored = next(score for orientation in design["orientations"]
                  for score in orientation["scores"]
                  if score["losses"] == result["losses"])
    shown = service.get("/v1/physics/" + stored["physics"])
    environments = service.get(f"/v1/evaluations/{evaluation['id']}/environments")["items"]
    again = service.post("/v1/rollouts", {
        "designs": [{"voxels": result["genotype"]}],
        "environments": [{key: world[key] for key in ("light_xy_m", "terrain_heights_m")}
                         for world in environments],
        "controller": "sha256:" + stored["controller"],
        "physics": shown["physics"],
        "precision": shown["precision"],
    })
    assert [rollout["loss"] for rollout in again["rollouts"]] == result["losses"]
    assert again["designs"][0]["score"] == result["score"]
    assert again["physics_sha256"] == stored["physics"]
    assert [world["sha256"] for world in again["environments"]
            ] == [world["sha256"] for world in environments]


def test_a_scene_holds_what_an_evaluation_records(service):
    request = {
        "designs": [DESIGN, {"cells": [[0, 0, 0]]}], "physics": {"n_steps": 100},
        "environments": [WORLD, {**WORLD, "seed": 8}], "record_stride": 20,
        "record": ["com", "masses", "actuation", "contacts"]
    }
    header, array = scene(roll(service, request))
    assert header["frame_s"] == pytest.approx(0.04) and len(header["rollouts"]) == 4
    evaluation = service.evaluate(request).json()
    for rollout in header["rollouts"]:
        n, k = rollout["design"], rollout["environment"]
        path = f"/v1/evaluations/{evaluation['id']}/trajectories/{n}/file?environment={k}&array="
        masses = service.request("GET", path + "masses").body
        assert array(rollout["masses_m"]) == struct.unpack(f"<{len(masses) // 4}f", masses)
        com = service.request("GET", path + "com").body
        assert [struct.unpack("<f", struct.pack("<f", x))[0]
                for x in array(rollout["com_m"])] == list(struct.unpack(f"<{len(com) // 4}f", com))
        assert rollout["loss"] == evaluation["results"][n]["losses"][k]
        for name, form, of in (("actuation", "b", "springs"), ("contacts", "B", "masses")):
            file = service.request("GET", path + name)
            sizes = [6, header["designs"][n][of]["shape"][0]]
            assert rollout[name]["shape"] == sizes
            assert file.headers["Morphod-Shape"] == ",".join(map(str, sizes))
            assert file.headers["Morphod-Type"] == rollout[name]["type"]
            numbers = array(rollout[name])
            assert numbers == struct.unpack(f"<{len(file.body)}{form}", file.body)
            assert not any(numbers[:sizes[1]]) and any(numbers[sizes[1]:])
        assert set(array(rollout["contacts"])) == {0, 1}
    for world in header["environments"]:
        assert len(array(world["terrain_heights_m"])) == 64


def test_scenes_of_recordings(service):
    """A stored recording as a scene equals the rollouts of the same request, bit for bit."""
    request = {
        "designs": [{"cells": [[0, 0, 0]]}, DESIGN], "environments": [WORLD, {**WORLD, "seed": 8}],
        "physics": {"n_steps": 40, "gravity_m_per_s2": 9.5}, "record_stride": 20,
        "record": ["com", "masses", "actuation", "contacts"]
    }
    whole, numbers = scene(roll(service, request))
    evaluation = service.evaluate(request).json()
    path = f"/v1/evaluations/{evaluation['id']}/trajectories/"
    accept = {"Accept": "application/vnd.morphod.scene"}
    for rolled in whole["rollouts"]:
        n, k = rolled["design"], rolled["environment"]
        reply = service.request("GET", f"{path}{n}?environment={k}", headers=accept)
        header, array = scene(reply)
        assert reply.headers["Vary"] == "Accept"
        for member in ("controller", "physics_sha256", "physics", "precision", "frame_s"):
            assert header[member] == whole[member]
        (design, ), (world, ), (rollout, ) = (
            header[name] for name in ("designs", "environments", "rollouts"))
        assert (rollout["design"], rollout["environment"]) == (0, 0)
        assert rollout["loss"] == rolled["loss"] and rollout["diverged_step"] == 0
        for mine, its in ((design, whole["designs"][n]), (world, whole["environments"][k]),
                          (rollout, rolled)):
            assert list(mine) == list(its)
            for name, value in its.items():
                if isinstance(value, dict):
                    assert mine[name]["shape"] == value["shape"]
                    assert array(mine[name]) == numbers(value), name
                elif name not in ("design", "environment"):
                    assert mine[name] == value, name
        again = service.request("GET", f"{path}{n}?environment={k}&format=scene")
        assert again.body == reply.body
        tag = {"If-None-Match": reply.headers["ETag"], **accept}
        assert service.request("GET", f"{path}{n}?environment={k}", headers=tag).status == 304
    service.refuses(path + "0", "?format=csv")
    few = service.evaluate(request | {"record": ["com"], "verify": True}).json()
    header, _ = scene(service.request(
        "GET", f"/v1/evaluations/{few['id']}/trajectories/1?environment=1&format=scene"))
    assert "com_m" in header["rollouts"][0] and "masses_m" not in header["rollouts"][0]
    assert header["rollouts"][0]["loss"] == whole["rollouts"][3]["loss"]


def test_the_body_of_a_design(service):
    header, array = scene(roll(service, {"designs": [DESIGN], "physics": SHORT}))
    design = header["designs"][0]
    body = service.get(f"/v1/designs/{design['genotype']}/body")
    for name in ("masses", "springs", "voxels", "faces", "rest_lengths_m"):
        flat = [x for row in body[name] for x in (row if isinstance(row, list) else [row])]
        assert list(array(design[name])) == pytest.approx(flat)
    assert len(body["voxels"]) == 4 and len(body["faces"]) == 4 * 6 - 2 * 3
    assert body["masses"] == sorted(body["masses"]) and body["springs"] == sorted(body["springs"])
    for (a, b), rest_m in zip(body["springs"], body["rest_lengths_m"]):
        apart = sum((x - y)**2 for x, y in zip(body["masses"][a], body["masses"][b]))
        assert rest_m == pytest.approx(0.1 * apart**0.5)
    for *corners, voxel in body["faces"]:
        assert set(corners) <= set(body["voxels"][voxel])
        p, q, r = (body["masses"][corner] for corner in corners[:3])
        u, v = [[y - x for x, y in zip(p, other)] for other in (q, r)]
        normal = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]]
        middle = [sum(body["masses"][mass][axis] for mass in body["voxels"][voxel]) / 8
                  for axis in range(3)]
        assert sum(n * (x - m) for n, x, m in zip(normal, p, middle)) > 0, "a face points inwards"
    by_id = service.get(f"/v1/designs/{design['id']}/body")
    assert len(by_id["springs"]) == len(body["springs"])
    service.refuses("/v1/designs/none/body", "", status=404)


def test_rollouts_are_bounded(service):
    many = {"designs": [DESIGN] * 7}
    block = {"designs": [{"cells": [[x, y, z] for x in range(6) for y in range(6)
                                    for z in range(4)]}]}
    for value, words in ((many, "at most 64"), (block | {"physics": {"n_steps": 10000}}, "second"),
                         ({"designs": [DESIGN], "controller": "none"}, "does not exist"),
                         ({"designs": [DESIGN], "label": "x"}, ""), ({"designs": []}, "")):
        reply = service.request("POST", "/v1/rollouts", value)
        assert reply.status == 422 and words in json.dumps(reply.json()), value
    jobs = len(service.get("/v1/jobs?limit=1000")["items"])
    assert roll(service, {"designs": [DESIGN], "physics": SHORT}).status == 200
    assert len(service.get("/v1/jobs?limit=1000")["items"]) == jobs, "a rollout became a job"


def test_a_phylogeny_as_columns(service):
    campaign = run(service, "campaigns", {"mode": "zero-shot", "population": 8, "generations": 3,
                                          "physics": SHORT, "exclude_pretraining": False,
                                          "environments": [WORLD]})
    path = f"/v1/campaigns/{campaign['id']}/phylogeny"
    rows = service.pages(path)
    header, array = scene(service.request("GET", path + "?format=columns"))
    columns = {name: array(where) for name, where in header["columns"].items()}
    none, alive = 2**32 - 1, 2**16 - 1
    operators = ["random", "listed", "inherited", "mutation", "crossover"]
    for i, row in enumerate(rows):
        assert row["number"] == i
        parents = [columns[name][i] for name in ("parent", "other_parent")]
        assert [parent for parent in parents if parent != none] == row["parents"]
        assert columns["born"][i] == row["born"]
        assert columns["died"][i] == (alive if row["died"] is None else row["died"])
        assert operators[columns["operator"][i]] == row["operator"]
        assert columns["score"][i] == pytest.approx(row["score"], rel=1e-6)
        assert (columns["voxels"][i], columns["footprint"][i]) == (row["voxels"], row["footprint"])
    assert header["designs"] == len(rows) and "number" not in columns
    sizes = [struct.calcsize(FORMATS[where["type"]]) for where in header["columns"].values()]
    assert sum(sizes) == 19
    header, array = scene(service.request("GET", path + "?format=columns&keep=lineages"))
    kept = {row["number"] for row in rows if row["died"] is None}
    for row in reversed(rows):
        if row["number"] in kept:
            kept |= set(row["parents"])
    assert array(header["columns"]["number"]) == tuple(sorted(kept))
    header, array = scene(service.request("GET", path + "?format=columns&after=5"))
    assert array(header["columns"]["parent"]) == columns["parent"][6:]
    header, array = scene(service.request("GET", path + f"?format=columns&after={2**32 - 1}"))
    assert array(header["columns"]["parent"]) == ()
    service.refuses(path + "?", "keep=all", "format=columns&keep=none", "format=csv&after=1")
    assert len(service.get(f"/v1/campaigns/{campaign['id']}/environments")["items"]) == 1


def test_the_dashboard_is_served(service):
    page = service.request("GET", "/")
    assert page.headers["Content-Type"] == "text/html; charset=utf-8"
    assert "default-src 'none'" in page.headers["Content-Security-Policy"]
    script = page.body.split(b'type="module" src="')[1].split(b'"')[0].decode()
    plain = service.request("GET", "/" + script)
    assert plain.headers["Content-Type"].startswith("text/javascript")
    assert plain.headers["Cache-Control"] == "private, max-age=31536000, immutable"
    packed = service.request("GET", "/" + script, headers={"Accept-Encoding": "gzip, br"})
    assert packed.headers["Content-Encoding"] == "gzip" and len(packed.body) < len(plain.body) / 2
    tag = {"If-None-Match": page.headers["ETag"]}
    assert service.request("GET", "/", headers=tag).status == 304
    folder = script.rsplit("/", 1)[0]
    for path in ("/assets/0000000000000000/app.js", f"/{folder}/none.js", f"/{folder}/lib/none.js"):
        service.refuses(path, "", status=404)


def test_load_is_sampled(service):
    assert isinstance(service.get("/v1/load")["items"], list)
    service.refuses("/v1/load?", "seconds=0", "seconds=3601")


def test_the_example_of_the_format(service):
    """docs/scenes.md reads a scene with NumPy, in the shape that it shows: springs at rest, then
    springs that move."""
    text = (SOURCE / "docs" / "scenes.md").read_text(encoding="utf-8")
    names = {"api": service.addresses[0]}
    exec(text.split("```py\n")[1].split("```")[0], names)  # pylint: disable=exec-used
    assert f"# {names['masses'].shape}, meters" in text and names["masses"].shape[1:] == (12, 3)
    assert abs(names["strain"][0]).max() < 1e-6 < 0.01 < abs(names["strain"][-1]).max()
