"""Studies: campaigns whose children a client makes, and crashes of either side."""

import base64
import http.client
import json
import random
import signal
import threading
import time

import pytest

from service import await_end, awaited, until

HERE = [{"light_xy_m": [4.0, 2.5], "terrain_sigma_m": 0.05, "seed": 7},
        {"light_xy_m": [0.5, 3.0], "terrain_sigma_m": 0.0, "seed": 1}]
STUDY = {"mode": "study", "population": 64, "environments": HERE, "physics": {"n_steps": 12}}
WAIT = {"Prefer": "wait=30"}
ONE, BAR, COLUMN = ({"cells": cells} for cells in (
    [[2, 2, 0]], [[x, 2, 0] for x in range(4)], [[2, 2, z] for z in range(4)]))


def new(service, **more):
    return service.post("/v1/campaigns", STUDY | more)["id"]


def tell(service, id, batch, children, status=200, **more):
    reply = service.request("POST", f"/v1/campaigns/{id}/tell",
                            {"batch": batch, "children": children, **more}, headers=WAIT)
    assert reply.status == status, reply.body
    return reply.json()


def packed(data):
    return base64.b64encode(data).decode()


def state(service, id):
    return service.get(f"/v1/campaigns/{id}")


def rows_of(service, id):
    return service.pages(f"/v1/campaigns/{id}/phylogeny")


def history(service, id):
    """Returns everything that a study holds, except times, the number of cached rollouts and
    certificates, which may come from other tests."""
    rows = [{name: row[name] for name in row if name not in ("seconds", "cached")}
            for row in service.pages(f"/v1/campaigns/{id}/generations")]
    designs = [service.pages(f"/v1/campaigns/{id}/{path}") for path in ("phylogeny", "population")]
    for one in designs[0] + designs[1]:
        del one["certificate"]
    return rows, designs, service.request(
        "GET", f"/v1/campaigns/{id}/phylogeny?format=newick").body


def reopen(service, label, headers=None, **more):
    return service.request("POST", "/v1/campaigns",
                           {"mode": "study", "label": label, "if_exists": "return", **more},
                           headers=headers)


def test_a_study_is_found_by_its_name(service):
    """One request returns the open study of a label, or a new one; other settings are refused."""
    given = {"population": 20, "seed": 3, "physics": {"n_steps": 12, "friction": 0.5},
             "selection": {"kind": "novelty", "weight": 0.25}, "workspace": [4, 4, 4],
             "environments": HERE, "mutation": {"rate": 1 / 64}}
    first = reopen(service, "found", **given)
    assert first.status == 202
    for again in ({}, given, {"physics": {"n_steps": 12}}, {"selection": "novelty"},
                  {"mutation": {"rate": None}}, {"controller": "default"}, {"device": "auto"}):
        reply = reopen(service, "found", **again)
        assert reply.status == 202 and reply.json()["id"] == first.json()["id"], reply.body
    other = [HERE[0], HERE[1] | {"light_xy_m": [1, 1]}]
    refused = {
        "/population": {"population": 21}, "/seed": {"seed": 4},
        "/physics/n_steps": {"physics": {"n_steps": 500}}, "/workspace": {"workspace": [6, 6, 4]},
        "/selection": {"selection": "truncation"}, "/mutation/rate": {"mutation": {"rate": 0.25}},
        "/racing": {"racing": "off"}, "/collapse_share": {"collapse_share": 0},
        "/environments": {"environments": "paper-test"},
        "/environments/1/light_xy_m": {"environments": other}, "/preset": {"preset": "paper"},
        "/weight": {"weight": 3}, "/experiment": {"experiment": "e"},
    }
    for pointer, more in refused.items():
        reply = reopen(service, "found", **more)
        assert reply.status == 409 and reply.pointers() == [pointer], reply.body
    reply = reopen(service, "found", population=30, physics={"n_steps": 500})
    assert [(fault["pointer"], fault["detail"]) for fault in reply.json()["errors"]] == [
        (pointer, f"got {asked}, but study {first.json()['id']} has {has}")
        for pointer, asked, has in (("/population", 30, 20), ("/physics/n_steps", 500, 12))]
    reply = reopen(service, "found", controller="not-there")
    assert reply.status == 422 and reply.pointers() == ["/controller"]
    # A key stays with the study that it returned; a refused request keeps no key.
    refuses, keeps = {"Idempotency-Key": "refused"}, {"Idempotency-Key": "found"}
    for _ in range(2):
        assert reopen(service, "found", refuses, population=30).status == 409
    kept = reopen(service, "found", keeps)
    assert kept.status == 202 and kept.json()["id"] == first.json()["id"]
    keyed = reopen(service, "keyed", {"Idempotency-Key": "new"}, experiment="a")
    service.request("PATCH", f"/v1/jobs/{keyed.json()['id']}", {"experiment": "b"})
    again = reopen(service, "keyed", {"Idempotency-Key": "new"}, experiment="a")
    assert again.status == 202 and again.json()["id"] == keyed.json()["id"], again.body
    # Names are compared exactly; a study that has ended is not found.
    assert reopen(service, "foun*").json()["id"] != first.json()["id"]
    assert new(service, label="found") != first.json()["id"]
    for _ in range(2):
        service.post(f"/v1/campaigns/{reopen(service, 'found').json()['id']}/finish", {})
    assert reopen(service, "found").json()["study"]["next_batch"] == 0
    kept = reopen(service, "found", keeps)
    assert kept.status == 202 and kept.json()["id"] == first.json()["id"], kept.body
    for bad in ({"mode": "zero-shot", "label": "x"}, {"mode": "study"}):
        reply = service.request("POST", "/v1/campaigns", bad | {"if_exists": "return"})
        assert reply.status == 422 and reply.pointers() == ["/if_exists"]


def test_one_study_for_all_who_open_a_new_name_at_once(service):
    ids, gate = [], threading.Barrier(8)

    def open_it():
        gate.wait()
        ids.append(reopen(service, "at once", population=20).json()["id"])

    threads = [threading.Thread(target=open_it) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(ids) == 8 and len(set(ids)) == 1
    assert len(service.pages("/v1/campaigns?label=at%20once")) == 1


def test_a_study(service):
    """A study from its start to its end, as a client sees it."""
    id = new(service, label="told by hand")
    path = f"/v1/campaigns/{id}"
    first = state(service, id)
    assert first["mode"] == "study" and first["state"] == "queued" and first["phase"] == "waiting"
    assert "batch 0" in first["reason"] and first["newest"] is None
    assert first["study"] == {"next_batch": 0, "pending": False, "operators": [], "measures": [],
                              "own_score": None, "sampler": None}
    assert service.get(f"/v1/jobs/{id}")["reason"] == first["reason"]
    assert [one["id"] for one in service.pages("/v1/campaigns?label=told%20by%20hand")] == [id]
    service.refuses(path, "/batch", "/sampler", status=404)

    children = [{"body": ONE, "measures": {"reach": 1}},
                {"body": BAR, "operator": "mine", "measures": {"reach": 4, "height": 0.1}},
                {"body": {"voxels": "1" * 144}, "operator": "random"}, {"body": ONE}]
    told = tell(service, id, 0, children, sampler_state=packed(b"\x00after 0"))
    assert (told["batch"], told["state"], told["campaign"]) == (0, "committed", id)
    rows = told["children"]
    assert [row["child"] for row in rows] == [row["number"] for row in rows] == [0, 1, 2, 3]
    assert [row["operator"] for row in rows] == ["listed", "mine", "random", "listed"]
    nothing = {"reach": None, "height": None}
    assert [row["measures"] for row in rows] == [
        nothing | {"reach": 1}, {"reach": 4, "height": 0.1}, nothing, nothing]
    for row in rows:
        assert row["score"] == sum(row["losses"]) / 2 and row["born"] == 0 and row["died"] is None
    assert rows[0]["losses"] == rows[3]["losses"] and rows[0]["id"] == rows[3]["id"]
    assert service.get(path + "/batch") == told

    # The same scores as those of an evaluation, which finds them.
    scored = service.evaluate({"designs": [ONE, BAR], "environments": HERE,
                               "physics": STUDY["physics"]}).json()
    assert scored["rollouts_cached"] == 4
    assert [one["losses"] for one in scored["results"]] == [row["losses"] for row in rows[:2]]

    # The same batch again, another one, and one out of order.
    assert tell(service, id, 0, children, sampler_state=packed(b"\x00after 0")) == told
    for batch, words in ((0, "different content"), (2, "1 is the next"), (7, "1 is the next")):
        reply = service.request("POST", path + "/tell", {"batch": batch, "children": []})
        assert reply.status == 409 and words in reply.json()["detail"], reply.body
        assert reply.headers["Morphod-Next-Batch"] == "1"

    # The client selects; parents can be any designs that were born.
    told = tell(service, id, 1, [{"body": COLUMN, "parents": [3, 1], "operator": "crossover"}],
                survivors=[2, 0])
    assert told["children"][0]["parents"] == [3, 1] and told["children"][0]["number"] == 4
    living = service.pages(path + "/population")
    assert {row["number"] for row in living} == {0, 2, 4}
    assert [row["score"] for row in living] == sorted(row["score"] for row in living)
    reply = service.request("GET", path + "/sampler")
    assert reply.status == 404  # this batch was sent without it
    tell(service, id, 2, [{"body": BAR, "parents": [1]}], survivors=[], sampler_state=packed(b"2"))
    assert [row["number"] for row in service.pages(path + "/population")] == [5]
    reply = service.tagged(path + "/sampler")
    assert reply.body == b"2" and reply.headers["Morphod-Batch"] == "2"

    # The same as for every campaign.
    lines = service.table(path + "/phylogeny?format=csv")
    assert [line["measures.reach"] for line in lines] == ["1", "4", "", "", "", ""]
    assert lines[1]["operator"] == "mine" and lines[4]["ancestor_list"] == "[3,1]"
    assert [line["destruction_time"] for line in lines] == ["2", "1", "2", "1", "2", "inf"]
    header = service.request("GET", path + "/phylogeny?format=columns").body
    assert b'"crossover","mine"]' in header and b"measures.height" in header
    rows = service.pages(path + "/generations")
    assert [row["born"] for row in rows] == [4, 1, 1] and [row["population"] for row in rows] == [
        4, 3, 1]
    assert service.get(path + "/champions?count=1")["items"][0]["number"] == 5
    ancestors = service.get(path + "/designs/4/ancestors")["items"]
    assert [row["number"] for row in ancestors] == [1, 3] and "measures" in ancestors[0]

    value = STUDY | {"mode": "zero-shot", "generations": 0, "population": 4,
                     "initial": {"campaign": id}}
    inherits = await_end(service, f"/v1/campaigns/{service.post('/v1/campaigns', value)['id']}")
    first = service.pages(inherits.json()["links"]["phylogeny"])[0]
    assert first["operator"] == "inherited" and first["id"] == rows_of(service, id)[5]["id"]

    done = service.post(path + "/finish")
    assert done["state"] == "succeeded" and done["end"] == "completed" and done["phase"] == "idle"
    assert service.post(path + "/finish") == done
    tell(service, id, 3, [], status=409)
    assert service.request("POST", path + "/ask", {"n": 1}).status == 409
    assert service.request("POST", path + "/extend", {"generations": 1}).status == 409
    assert service.get(path + "/batch")["batch"] == 2


def test_ask(service):
    """The service varies and selects; it produces only unseen bodies."""
    id = new(service, population=12, seed=5)
    path = f"/v1/campaigns/{id}"
    seen, sizes = set(), []
    for batch in range(4):
        asked = service.post(path + "/ask", {"n": 10})
        assert asked == service.post(path + "/ask", {"n": 10}) and asked["batch"] == batch
        told = tell(service, id, batch, asked["children"])
        for given, row in zip(asked["children"], told["children"]):
            assert given["parents"] == row["parents"] and given["operator"] == row["operator"]
            assert given["body"]["voxels"] == row["genotype"]
        forms = {row["id"] for row in told["children"]}
        assert len(forms) == 10 and not forms & seen
        seen |= forms
        sizes.append(len(service.pages(path + "/population")))
    assert sizes == [10, 12, 12, 12]
    operators = [row["operator"] for row in service.pages(path + "/phylogeny")]
    assert set(operators[:10]) == {"random"} and set(operators[10:]) == {"mutation", "crossover"}
    few = service.post(path + "/ask", {"n": 12, "parents": [3, 4]})["children"]
    assert {number for child in few for number in child["parents"]} == {3, 4}
    assert {child["operator"] for child in service.post(path + "/ask", {"n": 3, "by": "random"})[
        "children"]} == {"random"}
    for value in ({"n": 13}, {"n": 0}, {}, {"n": 1, "parents": [40]}, {"n": 1, "by": "luck"}):
        assert service.request("POST", path + "/ask", value).status == 422, value
    service.act(id, "cancel")
    tell(service, id, 4, few, status=409)


@pytest.mark.parametrize("more, pointer", [
    ({"children": [{"body": ONE}, {"body": {"cells": [[0, 0, 0], [2, 0, 0]]}}]},
     "/children/1/body/cells/1"),
    ({"children": [{"parents": [0]}]}, "/children/0"),
    ({"children": [{"body": ONE, "parents": [0]}]}, "/children/0/parents"),
    ({"children": [{"body": ONE, "parents": [0, 0, 0]}]}, "/children/0/parents"),
    ({"children": [{"body": ONE, "operator": "with blanks"}]}, "/children/0/operator"),
    ({"children": [{"body": ONE, "measures": {"": 1}}]}, "/children/0/measures/"),
    ({"children": [{"body": ONE, "measures": {"reach": "far"}}]}, "/children/0/measures/reach"),
    ({"children": [{"body": ONE, "measures": {f"m{i}": i for i in range(17)}}]},
     "/children/0/measures/m16"),
    ({"children": [{"body": BAR}]}, "/children/0/body"),  # of 2 × 2 × 2 voxels
    ({"children": [{"body": ONE}] * 5}, "/children"),
    ({"children": [], "survivors": [0]}, "/survivors/0"),
    ({"children": [], "sampler_state": "AAA"}, "/sampler_state"),
    ({"children": [], "sampler_state": "AAB="}, "/sampler_state"),
    ({"children": [], "sampler_state": "A===" }, "/sampler_state"),
    ({"children": [], "sampler_state": ""}, "/sampler_state"),
    ({"children": [], "batch": -1}, "/batch")])
def test_refused(service, tiny_study, more, pointer):
    reply = service.request("POST", f"/v1/campaigns/{tiny_study}/tell", {"batch": 0} | more)
    assert reply.status == 422 and pointer in reply.pointers(), reply.body
    assert state(service, tiny_study)["study"]["pending"] is False


def test_skipped_and_repaired(service):
    id = new(service, population=8, workspace=[3, 2, 2])
    pieces = {"cells": [[0, 0, 0], [1, 0, 0], [4, 4, 0]]}
    rules = {"on_fault": "skip", "repair": "largest"}
    told = tell(service, id, 0, [{"body": pieces}, {"body": {"cells": []}}, {"body": BAR},
                                 {"body": ONE, "operator": "mine"}], **rules)
    assert [(row["child"], row["number"], row["voxels"]) for row in told["children"]] == [
        (0, 0, 2), (3, 1, 1)]
    notes = [(note["place"], note["repaired"], note["fault"] and note["fault"]["pointer"])
             for note in told["notes"]]
    assert notes == [(0, 1, None), (1, 0, "/children/1/body/cells"), (2, 0, "/children/2/body")]
    told = tell(service, id, 1, [{"body": BAR}], **rules)
    assert told["children"] == [] and [note["place"] for note in told["notes"]] == [0]
    assert state(service, id)["founders"] == [] and state(service, id)["progress"]["designs"] == 2


def test_bodies_are_not_turned_to_fit(service):
    """Turned, a body is another robot with another score."""
    id = new(service, population=8, workspace=[2, 4, 2])
    along = [{"cells": [[x, 0, 0] for x in range(4)]}, {"cells": [[0, y, 0] for y in range(4)]}]
    refused = service.request("POST", f"/v1/campaigns/{id}/tell",
                              {"batch": 0, "children": [{"body": body} for body in along]})
    assert refused.status == 422 and refused.pointers() == ["/children/0/body"], refused.body
    told = tell(service, id, 0, [{"body": body} for body in along], on_fault="skip")
    assert [row["child"] for row in told["children"]] == [1]
    given = service.evaluate({"designs": along, "physics": {"n_steps": 5}}).json()["results"]
    assert [row["genotype"] for row in rows_of(service, id)] == [given[1]["genotype"]]


@pytest.fixture(scope="module")
def tiny_study(service):
    return new(service, population=4, workspace=[2, 2, 2])


def test_what_a_study_has_not(service):
    for more in ({"generations": 3}, {"replicates": 2}, {"initial": {"designs": [ONE]}},
                 {"exclude_pretraining": True}, {"name": "x"}, {"learning": {}}):
        reply = service.request("POST", "/v1/campaigns", STUDY | more)
        assert reply.status == 422 and reply.pointers() == ["/" + next(iter(more))], reply.body
    other = service.post("/v1/campaigns", STUDY | {"mode": "zero-shot", "generations": 0})["id"]
    for verb, value in {"tell": {"batch": 0, "children": []}, "ask": {"n": 1},
                        "finish": None}.items():
        assert service.request("POST", f"/v1/campaigns/{other}/{verb}", value).status == 404
    service.refuses(f"/v1/campaigns/{other}", "/batch", "/sampler", status=404)


def test_pause_and_a_batch_that_waits(service):
    """A pause keeps a pending batch, and other batches wait for it."""
    id = new(service)
    path = f"/v1/campaigns/{id}"
    assert service.act(id, "pause").json()["state"] == "paused"
    reply = service.request("POST", path + "/tell", {"batch": 0, "children": [{"body": ONE}]})
    assert reply.status == 202 and reply.json()["state"] == "pending"
    assert reply.headers["Location"] == path + "/batch"
    assert service.get(path + "/batch") == reply.json()
    assert state(service, id)["study"]["pending"] and state(service, id)["state"] == "paused"
    assert service.request("POST", path + "/ask", {"n": 1}).status == 409
    assert service.request("POST", path + "/finish").status == 409
    reply = service.request("POST", path + "/tell", {"batch": 1, "children": []})
    assert reply.status == 409 and "still being scored" in reply.json()["detail"]
    service.act(id, "resume")
    assert service.get(path + "/batch", headers=WAIT)["state"] == "committed"
    awaited(service, path, lambda seen: seen["phase"] == "waiting")
    assert service.act(id, "cancel").json()["state"] == "cancelled"
    assert service.request("POST", path + "/finish").status == 409


# ---- crashes ----


class Elites:
    """Seeded MAP-Elites over the number of voxels and the height. Its saved state is complete: it
    continues with the scores of the bodies that it requested."""

    def __init__(self, kept=None):
        self.random = random.Random(3)
        self.archive, self.asked = {}, []
        if kept is not None:
            kept = json.loads(kept)
            self.random.setstate((kept["random"][0], tuple(kept["random"][1]), kept["random"][2]))
            self.archive = {tuple(cell): elite for cell, elite in kept["archive"]}
            self.asked = kept["asked"]

    def kept(self):
        return json.dumps({"random": self.random.getstate(), "asked": self.asked,
                           "archive": sorted(self.archive.items())}).encode()

    def grow(self, cells):
        """Adds a voxel next to an existing one."""
        while True:
            cell = list(self.random.choice(cells))
            axis = self.random.randrange(3)
            cell[axis] += self.random.choice((-1, 1))
            if cell not in cells and all(0 <= x < most for x, most in zip(cell, (6, 6, 4))):
                return cells + [cell]

    def ask(self, n):
        self.asked = []
        for _ in range(n):
            elites = sorted(self.archive.values())
            _, number, cells = self.random.choice(elites) if elites else (0, None, [[2, 2, 0]])
            cells = self.grow(self.grow(cells if len(cells) < 12 else [[2, 2, 0]]))
            self.asked.append({"body": {"cells": cells}, "operator": "grow",
                               "parents": [] if number is None else [number],
                               "measures": {"voxels": len(cells)}})
        return {"children": self.asked, "sampler_state": packed(self.kept()),
                "survivors": sorted(number for _, number, _ in self.archive.values())}

    def tell(self, rows):
        for child, row in zip(self.asked, rows):
            cells = child["body"]["cells"]
            cell = (len(cells), max(z for _, _, z in cells))
            if row["score"] is not None and row["score"] < self.archive.get(cell, (10, ))[0]:
                self.archive[cell] = [row["score"], row["number"], cells]


def remembered(service, id):
    """Returns the search as the service stores it, and its next batch."""
    path = f"/v1/campaigns/{id}"
    study = state(service, id)["study"]
    if study["next_batch"] == 0 and not study["pending"]:
        return Elites(), 0
    told = service.get(path + "/batch", headers=WAIT)
    assert told["state"] == "committed"
    elites = Elites(service.request("GET", path + "/sampler").body)
    elites.tell(told["children"])
    return elites, told["batch"] + 1


def search(service, id, batches, dies):
    """Runs a study to its end. dies: may kill the service; returns the running one."""
    elites, batch = Elites(), 0
    while batch < batches:
        value = elites.ask(8)
        alive = dies(service, id, {"batch": batch} | value)
        if alive is not service:
            service = alive
            elites, batch = remembered(service, id)
            continue
        elites.tell(tell(service, id, batch, **value)["children"])
        batch += 1
    tell(service, id, batch, [], survivors=elites.ask(0)["survivors"])
    return service, elites.archive


def test_either_side_dies(service, start, tmp_path):
    """The service is killed at any moment of a batch, and the client loses its memory: archive,
    phylogeny and curve equal those of an undisturbed search."""
    luck, deaths = random.Random(8), []

    def die(running, id, value):
        moment = luck.choice(("live", "live", "live", "untold", "sent", "told", "committed"))
        if moment == "live":
            return running
        telling = threading.Thread(target=try_to_tell, args=(running, id, value))
        if moment != "untold":
            telling.start()
        if moment == "sent":
            time.sleep(luck.random() / 50)
        until(lambda: moment in ("untold", "sent") or has_come(
            state(running, id)["study"], value["batch"], moment))
        running.stop(signal.SIGKILL)
        if moment != "untold":
            telling.join()
        again = start(state=tmp_path / "state")
        study = state(again, id)["study"]
        deaths.append((study["next_batch"] > value["batch"], study["pending"]))
        return again

    undisturbed = new(service, population=128)
    _, expected = search(service, undisturbed, 25, lambda running, *_: running)
    running = start(state=tmp_path / "state")
    id = new(running, population=128)
    running, found = search(running, id, 25, die)
    assert found == expected and len(found) > 10
    assert history(running, id) == history(service, undisturbed)
    assert state(running, id)["progress"]["designs"] == 200
    assert len(deaths) >= 10 and {(False, False), (True, False)} <= set(deaths), deaths
    assert running.stop() == 0


def has_come(study, batch, moment):
    return study["next_batch"] > batch or (study["pending"] and moment == "told")


def try_to_tell(running, id, value):
    """Tells a batch to a service that may die."""
    connection = running.connection()
    try:
        connection.request("POST", f"/v1/campaigns/{id}/tell", json.dumps(value),
                           {"Content-Type": "application/json"})
        connection.getresponse().read()
    except (OSError, http.client.HTTPException):
        pass
    finally:
        connection.close()
