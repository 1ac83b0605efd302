"""The robot that was scored: the notation ID@K of a design in one orientation, which every reply
shows with a score, and the meaning of an id without an orientation."""

import json

import pytest

from ctl import ctl
from service import DESIGN, awaited, run

QUICK = {"n_steps": 30}
SEARCH = {"mode": "zero-shot", "population": 12, "generations": 3, "physics": QUICK,
          "racing": "off"}
# They have 8, 4, 2 and 1 different images.
LEANING = {"cells": [[0, 0, 0], [1, 0, 0], [1, 1, 0], [1, 1, 1], [2, 1, 0]]}
CORNER = {"cells": [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]}
ROW = {"cells": [[0, 0, 0], [1, 0, 0]]}
CUBE = {"cells": [[0, 0, 0]]}


def images(voxels):
    """Returns the 8 images of a body, as lists of cells."""
    cells = [(place // 24, place // 4 % 6, place % 4)
             for place, digit in enumerate(voxels) if digit == "1"]
    for k in range(8):
        turned = [(y, x, z) if k & 4 else (x, y, z) for x, y, z in cells]
        yield {"cells": [[5 - x if k & 1 else x, 5 - y if k & 2 else y, z] for x, y, z in turned]}


def scored(service, designs, **others):
    rows = service.evaluate({"designs": designs, "physics": QUICK, **others}).json()["results"]
    return [{key: row[key] for key in ("id", "robot", "genotype", "score", "losses",
                                       "orientation")} for row in rows]


def test_every_image_of_random_bodies(service):
    """Each image is one robot: sending its notation back yields the same bits, for any image and
    any position in the workspace."""
    for body in service.post("/v1/bodies/random", {"count": 12, "seed": 3})["items"]:
        rows = scored(service, list(images(body["genotype"])))
        assert {row["id"] for row in rows} == {body["id"]}
        assert body["robot"] in {row["robot"] for row in rows}
        again = scored(service, [{"id": row["robot"]} for row in rows])
        assert again == rows
        distinct = {row["robot"]: row["genotype"] for row in rows}
        assert len(distinct) == len(set(distinct.values()))
        assert all(row["orientation"] is None for row in rows)
        best = min(rows, key=lambda row: (row["score"], row["robot"]))
        [alone] = scored(service, [{"id": body["id"]}])
        assert alone == dict(best, orientation="best")


@pytest.mark.parametrize("design, n", [(LEANING, 8), (CORNER, 4), (ROW, 2), (CUBE, 1)])
def test_equal_images_have_the_smallest_number(service, design, n):
    [row] = scored(service, [design])
    robots = {row["id"] + f"@{k}": None for k in range(8)}
    rows = scored(service, [{"id": robot} for robot in robots])
    for robot, row in zip(robots, rows):
        robots[robot] = row["genotype"]
        assert row["robot"] == min(other for other in robots
                                   if robots[other] == row["genotype"])
    assert len(set(robots.values())) == n


def test_meaning_of_an_id_without_an_orientation(service):
    cells = [[0, 0, 0], [1, 0, 0], [2, 0, 0], [2, 1, 0], [2, 1, 1]]
    world = [{"light_xy_m": [4.5, 2.5], "terrain_sigma_m": 0.02, "seed": 3}]
    rows = list(images(service.post("/v1/bodies/canonical", {"designs": [{"cells": cells}]})
                       ["items"][0]["genotype"]))
    design = {"id": scored(service, [rows[3]])[0]["id"]}
    [first] = scored(service, [design])
    assert first["robot"].endswith("@3") and first["orientation"] == "best"
    # Other environments, physics or precision: nothing is stored.
    for others in ({"environments": world}, {"physics": {"n_steps": 31}},
                   {"precision": "float64"}):
        [row] = scored(service, [design], **others)
        assert row["robot"].endswith("@0") and row["orientation"] == "canonical"
        [row] = scored(service, [design], **others)
        assert row["robot"].endswith("@0") and row["orientation"] == "best"  # now it is stored
    # A rollout, a recording and a verification use the same robot.
    rolled = service.post("/v1/rollouts", {"designs": [design], "physics": QUICK})["designs"][0]
    assert (rolled["robot"], rolled["score"], rolled["orientation"]) == (
        first["robot"], first["score"], "best")
    for others in ({"verify": True}, {"record": ["com"]}):
        assert scored(service, [design], **others) == [first]
    # A score in only some of the environments does not count.
    two = world + [{"light_xy_m": [0.5, 2.5], "terrain_sigma_m": 0, "seed": 4}]
    scored(service, [{"id": design["id"] + "@5"}], environments=[two[1]])
    assert scored(service, [design], environments=two)[0]["orientation"] == "canonical"
    # Its position among others, including skipped and repaired ones, does not matter.
    mixed = scored(service, [{"cells": [[0, 0, 9]]}, DESIGN, design, {"id": first["robot"]},
                             {"cells": [[0, 0, 0], [3, 3, 0]]}, design],
                   on_fault="skip", repair="largest")
    assert [row["orientation"] for row in mixed] == [None, None, "best", None, None, "best"]
    assert mixed[0]["robot"] is None and mixed[2] == mixed[5] == dict(mixed[3], orientation="best")


def test_where_else_a_robot_is_taken(service):
    [row] = scored(service, [LEANING])
    robot = row["robot"]
    for letter in ("", "d"):
        assert service.get(f"/v1/designs/{letter}{robot}")["id"] == row["id"]
        body = service.get(f"/v1/designs/{letter}{robot}/body")
        assert (body["robot"], body["genotype"]) == (robot, row["genotype"])
        assert scored(service, [{"id": letter + robot}]) == [row]
    other = row["id"] + "@" + str((int(robot[-1]) + 3) % 8)
    assert service.get(f"/v1/designs/{other}/body")["genotype"] != row["genotype"]
    [made] = service.post("/v1/bodies/mutate", {"designs": [{"id": robot}], "seed": 3})["items"]
    same = {"designs": [{"voxels": row["genotype"]}], "seed": 3}
    assert service.post("/v1/bodies/mutate", same)["items"] == [made]
    stored = service.get(f"/v1/designs/{row['id']}")["orientations"]
    assert [entry["genotype"] for entry in stored if entry["robot"] == robot] == [row["genotype"]]
    for wrong in ("@8", "@", "@00", "@-1", "#1"):
        reply = service.evaluate({"designs": [{"id": row["id"] + wrong}]})
        assert reply.status == 422 and reply.pointers() == ["/designs/0/id"]
        place = f"/v1/designs/{row['id']}{wrong.replace('#', '%23')}"
        service.refuses(place, "", "/body", status=404)


def test_campaigns(service):
    """The robots that a campaign shows have the scores that it shows, in every format; the same
    holds for the list of the best designs. An id without an orientation means the robot that the
    campaign scored."""
    campaign = run(service, "campaigns", SEARCH)
    path = f"/v1/campaigns/{campaign['id']}"
    born = service.get(f"{path}/population")["items"]
    assert service.get(f"{path}/champions?count=1")["items"][0]["robot"] == born[0]["robot"]
    rows = scored(service, [{"id": item["robot"]} for item in born])
    for key in ("id", "robot", "genotype", "score"):
        assert [row[key] for row in rows] == [item[key] for item in born]
    assert any(not item["robot"].endswith("@0") for item in born)
    alone = scored(service, [{"id": item["id"]} for item in born])
    assert alone == [dict(row, orientation="best") for row in rows]
    all_born = {item["number"]: item["robot"] for item in service.pages(f"{path}/phylogeny")}
    table = service.table(f"{path}/phylogeny?format=csv")
    assert {int(line["id"]): line["robot"] for line in table} == all_born
    for line in service.table(f"{path}/population?format=csv"):
        assert line["robot"] == all_born[int(line["number"])]
        assert line["id"] == "d" + line["robot"][:-2]
    # Founders given by an id without an orientation are the robots that were scored, and the
    # campaign reports this.
    designs = [{"id": item["id"]} for item in born[:3]] + [{"id": born[3]["robot"]}, ROW]
    founded = run(service, "campaigns", dict(SEARCH, generations=1,
                                             initial={"designs": designs}, replicates=2))
    assert [(note["place"], note["robot"], note["orientation"], note["fault"])
            for note in founded["founders"]] == [
                (place, born[place]["robot"], "best", None) for place in range(3)]
    first = service.get(f"/v1/campaigns/{founded['id']}/phylogeny?limit=4")["items"]
    assert [item["robot"] for item in first] == [item["robot"] for item in born[:4]]


def test_a_workspace_that_is_not_square(service):
    """Orientations that the workspace would turn are not used."""
    flat = dict(SEARCH, workspace=[2, 5, 3], population=8)
    path = f"/v1/campaigns/{run(service, 'campaigns', flat)['id']}"
    born = service.get(f"{path}/population")["items"]
    rows = scored(service, [{"id": item["robot"]} for item in born])
    assert [row["score"] for row in rows] == [item["score"] for item in born]
    bar = {"cells": [[x, 0, 0] for x in range(4)] + [[0, 0, 1]]}  # lies along x: four wide
    [across] = scored(service, [bar])
    founded = run(service, "campaigns", dict(flat, initial={"designs": [{"id": across["id"]}]}))
    assert [note["orientation"] for note in founded["founders"]] == ["canonical"]
    first = service.get(f"/v1/campaigns/{founded['id']}/phylogeny?limit=1")["items"][0]
    assert first["robot"] == across["id"] + "@0"
    assert scored(service, [{"id": first["robot"]}])[0]["score"] == first["score"]


def test_leaderboard(service):
    rows = service.evaluate({"designs": list(images(service.post(
        "/v1/bodies/canonical", {"designs": [LEANING]})["items"][0]["genotype"]))})
    assert rows.json()["state"] == "succeeded"
    items = service.pages("/v1/designs?sort=score")
    again = service.evaluate({"designs": [{"id": item["robot"]} for item in items]}).json()
    assert [row["score"] for row in again["results"]] == [item["score"] for item in items]
    assert again["rollouts_cached"] == again["rollouts_total"]
    lines = service.table("/v1/designs?sort=score&format=csv")
    assert [line["robot"] for line in lines] == [item["robot"] for item in items]
    assert all("robot" not in item for item in service.pages("/v1/designs"))


def test_trainings(service):
    """A finetuning run learns on the robots that were scored in the test set, and says so."""
    tuning = {"kind": "finetune", "steps": 1, "batch": 4, "physics": {"n_steps": 20}}
    rows = service.evaluate({"designs": list(images(service.post(
        "/v1/bodies/canonical", {"designs": [LEANING]})["items"][0]["genotype"])),
                             "physics": {"n_steps": 20}}).json()["results"]
    best = min(rows, key=lambda row: (row["score"], row["robot"]))
    designs = [{"id": best["id"]}, CUBE]
    tuned = run(service, "trainings", dict(tuning, designs=designs))
    [note] = tuned["notes"]
    assert (note["place"], note["robot"], note["orientation"]) == (0, best["robot"], "best")
    learned = service.get(f"/v1/trainings/{tuned['id']}/held-out")["designs"]
    assert learned[0]["voxels"] == best["genotype"]


def test_studies(service):
    """A child given by an id without an orientation is the robot that was scored under the
    conditions of the study."""
    study = service.post("/v1/campaigns", {"mode": "study", "population": 12, "physics": QUICK})
    path = f"/v1/campaigns/{study['id']}"
    rows = scored(service, list(images(service.post(
        "/v1/bodies/canonical", {"designs": [LEANING]})["items"][0]["genotype"])))
    best = min(rows, key=lambda row: (row["score"], row["robot"]))
    children = [{"body": CUBE}, {"body": {"id": best["id"]}}]
    service.post(f"{path}/tell", {"batch": 0, "children": children})
    batch = awaited(service, f"{path}/batch", lambda value: value["state"] == "committed")
    [note] = batch["notes"]
    assert (note["place"], note["robot"], note["orientation"]) == (1, best["robot"], "best")
    assert (batch["children"][1]["robot"], batch["children"][1]["score"]) == (
        best["robot"], best["score"])


def rows_of(table):
    """Returns the rows of a table of morphoctl, by their headings."""
    lines = [line.split() for line in table.splitlines() if line.strip()]
    return [dict(zip(lines[0], line)) for line in lines[1:]]


def test_morphoctl(service, ctl):
    """A robot that a table shows with a score has that score everywhere."""
    quick = "--physics n_steps=32"  # those of no other test: an id is its best stored image
    campaign = run(service, "campaigns", dict(SEARCH, seed=9, physics={"n_steps": 32}))
    status, table, err = ctl(f"campaign champions {campaign['id']} --count 3")
    assert status == 0, err
    best = rows_of(table)
    robots = [row["design"] for row in best]
    assert len(best) == 3 and any(not robot.endswith("@0") for robot in robots)
    status, table, err = ctl(f"eval {quick} {' '.join(robots)}")
    assert status == 0 and "30 from the store" in err, err
    assert [(row["design"], row["score"]) for row in rows_of(table)] == [
        (row["design"], row["score"]) for row in best]
    # Ids without an orientation are the same robots, and this is reported.
    ids = [robot[:-2] for robot in robots]
    status, table, err = ctl(f"eval {quick} {' '.join(ids)}")
    assert [(row["design"], row["score"]) for row in rows_of(table)] == [
        (row["design"], row["score"]) for row in best]
    assert err.count(": its best stored score of all orientations") == 3, err
    status, _, err = ctl(f"eval --physics n_steps=33 {ids[0]}")
    assert f"using {ids[0]}@0, the canonical orientation: no stored score" in err, err
    # In detail: the orientation, its drawing, and other commands that accept it.
    status, text, err = ctl(f"design show {robots[0]}")
    assert status == 0 and f"\n{robots[0]}\n" in text and best[0]["score"] in text, text
    drawn = json.loads(ctl(f"eval {quick} {robots[0]} --json")[1])["results"][0]["genotype"]
    turned = ctl(f"design draw {robots[0]}", LC_ALL="C")[1].count("##")
    assert turned == drawn.count("1")
    status, text, err = ctl(f"verify {quick} {robots[0]}")
    assert status == 0 and "1 the same, 0 different" in text, (text, err)
    assert ctl(f"eval {quick} {ids[0]}@9")[0] == 2 and ctl(f"design show {ids[0]}@")[0] == 2


@pytest.mark.parametrize("command", ["picture -o {}.png", "film -o {}/"])
def test_films(service, ctl, command, tmp_path):
    """A film and a picture of an id without an orientation show the robot that was scored, and say
    so."""
    [row] = scored(service, [{"cells": [[0, 0, 0], [1, 0, 0], [1, 1, 0], [1, 2, 0], [1, 2, 1]]}])
    command = command.format(tmp_path / "made")
    (tmp_path / "made").mkdir()
    status, _, err = ctl(f"{command} --physics n_steps=30 --size 64x64 {row['id']}")
    assert status == 0 and f"using {row['robot']}: its best" in err, err
    status, _, err = ctl(f"{command} --physics n_steps=30 --size 64x64 {row['robot']}")
    assert status == 0 and "using" not in err and not row["robot"].endswith("@0"), err
