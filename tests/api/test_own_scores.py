"""Studies with an own score: the client computes what designs are ranked by."""

import random
import signal

from service import until
from test_worlds import scene

HERE = [{"light_xy_m": [4.0, 2.5], "terrain_sigma_m": 0.05, "seed": 7},
        {"light_xy_m": [0.5, 3.0], "terrain_sigma_m": 0.0, "seed": 1}]
COST = {"name": "cost_of_transport", "unit": "J/(kg·m)"}
STUDY = {"mode": "study", "population": 2, "environments": HERE, "physics": {"n_steps": 12},
         "own_score": COST}
WAIT = {"Prefer": "wait=30"}
ONE, BAR, COLUMN = ({"cells": cells} for cells in (
    [[2, 2, 0]], [[x, 2, 0] for x in range(4)], [[2, 2, z] for z in range(4)]))


def new(service, **more):
    return service.post("/v1/campaigns", STUDY | more)["id"]


def send(service, id, batch, scored, **more):
    """Tells pairs of a body and its score."""
    children = [{"body": body, "score": score} for body, score in scored]
    return service.request("POST", f"/v1/campaigns/{id}/tell",
                           {"batch": batch, "children": children, **more}, headers=WAIT)


def tell(service, id, batch, scored, **more):
    reply = send(service, id, batch, scored, **more)
    assert reply.status == 200, reply.body
    return reply.json()


def test_designs_are_ranked_by_the_own_score(service):
    id = new(service)
    path = f"/v1/campaigns/{id}"
    assert service.get(path)["study"]["own_score"] == COST
    told = tell(service, id, 0, [(ONE, 0.5), (BAR, -3.25)])
    assert [row["score"] for row in told["children"]] == [0.5, -3.25]
    told = tell(service, id, 1, [(COLUMN, -1.0), (ONE, 0.5)])
    # The two best of four live, by the client's numbers and whatever the losses are.
    population = service.get(path + "/population")
    assert [(row["number"], row["score"]) for row in population["items"]] == [(1, -3.25), (2, -1.0)]
    champions = service.get(path + "/champions?count=1")
    assert champions["items"][0]["number"] == 1 and champions["items"][0]["score"] == -3.25
    curve = service.pages(path + "/generations")
    assert [row["score"]["quantiles"]["p0"] for row in curve] == [-3.25, -3.25]
    assert curve[1]["score"]["mean"] == -2.125 and curve[1]["children_cut"] == 0
    exported = service.get(f"/v1/campaigns/generations?campaigns={id}")["items"]
    assert [row["own_score"] for row in exported] == ["cost_of_transport"] * 2
    # Every list of its scores says whose they are, and no negative score is taken for a bound.
    history = service.get(path + "/phylogeny")
    assert population["own_score"] == champions["own_score"] == history["own_score"] == COST
    assert [row["lower_bound"] for row in history["items"]] == [False] * 4
    header, array = scene(service.request("GET", path + "/phylogeny?format=columns"))
    scores = array(header["columns"]["score"])
    assert header["own_score"] == COST and list(scores) == [0.5, -3.25, -1.0, 0.5]
    csv = service.request("GET", path + "/phylogeny?format=csv").body.decode().splitlines()
    assert csv[2].split(",")[5] == "-3.25"
    places = service.get(f"/v1/designs/{population['items'][0]['id']}")["campaigns"]
    assert [one["own_score"] for one in places if one["campaign"] == id] == [COST]


def test_the_losses_are_those_of_the_service(service):
    """Own scores never enter the stored scores of the service, which any job may use."""
    id = new(service, seed=77)
    told = tell(service, id, 0, [(BAR, 11.5), (COLUMN, 12.5)])
    result = service.post("/v1/evaluations", {
        "designs": [BAR, COLUMN], "environments": HERE, "physics": {"n_steps": 12}}, headers=WAIT)
    rows = service.pages(f"/v1/evaluations/{result['id']}/results")
    assert [row["losses"] for row in rows] == [row["losses"] for row in told["children"]]
    assert all(row["score"] < 2 for row in rows)
    design = service.get(f"/v1/designs/{rows[0]['id']}")
    assert all(score["score"] < 2 for one in design["orientations"] for score in one["scores"])
    assert all(row["score"] is None or row["score"] < 10
               for row in service.pages("/v1/designs?sort=score"))
    plain = service.post("/v1/campaigns", STUDY | {"own_score": None})["id"]
    reply = service.request("POST", f"/v1/campaigns/{plain}/tell",
                            {"batch": 0, "children": [{"body": BAR}]}, headers=WAIT).json()
    assert reply["children"][0]["score"] == rows[0]["score"]
    assert service.get(f"/v1/campaigns/{plain}")["study"]["own_score"] is None
    assert "own_score" not in service.get(f"/v1/campaigns/{plain}/population")


def test_a_body_has_one_score(service):
    id = new(service, population=8)
    reply = send(service, id, 0, [(ONE, 1.0), (BAR, 2.0), (ONE, 1.5)])
    assert reply.status == 422 and reply.pointers() == ["/children/2/score"]
    assert "already has the score 1 in this study" in reply.json()["errors"][0]["detail"]
    assert service.get(f"/v1/campaigns/{id}")["study"]["next_batch"] == 0
    first = tell(service, id, 0, [(ONE, 1.0), (BAR, 0.0), (ONE, 1.0)])
    assert tell(service, id, 0, [(ONE, 1.0), (BAR, 0.0), (ONE, 1.0)]) == first
    reply = send(service, id, 0, [(ONE, 1.0), (BAR, 0.25), (ONE, 1.0)])
    assert reply.status == 409 and "different content" in reply.json()["detail"]
    reply = send(service, id, 1, [(COLUMN, 4.0), (BAR, 1e-300)])
    assert reply.status == 422 and reply.pointers() == ["/children/1/score"]
    assert [row["score"] for row in tell(service, id, 1, [(BAR, -0.0)])["children"]] == [0.0]


def test_scores_are_finite_and_wanted(service):
    id = new(service)
    path = f"/v1/campaigns/{id}/tell"
    for score, words in (("1e999", "finite"), ("-1e39", "-1e+30"), ("null", "missing"),
                         ('"low"', "number")):
        body = '{"batch": 0, "children": [{"body": {"cells": [[2,2,0]]}, "score": %s}]}' % score
        reply = service.request("POST", path, body=body)
        assert reply.status == 422 and reply.pointers() == ["/children/0/score"], reply.body
        assert words in reply.json()["errors"][0]["detail"]
    reply = service.request("POST", path, {"batch": 0, "children": [{"body": ONE}]})
    assert reply.pointers() == ["/children/0/score"]
    told = tell(service, id, 0, [({"cells": []}, None), (BAR, 7)], on_fault="skip")
    assert [(row["child"], row["score"]) for row in told["children"]] == [(1, 7)]
    plain = new(service, own_score=None)
    reply = send(service, plain, 0, [(ONE, 1.0)])
    assert reply.status == 422 and reply.pointers() == ["/children/0/score"]
    assert "own_score" in reply.json()["errors"][0]["detail"]
    assert tell(service, id, 1, [])["children"] == []


def test_the_settings_name_the_score(service):
    for own, pointer in (({"unit": "m"}, "/own_score"), ({"name": "two words"}, "/own_score/name"),
                         ({"name": "x" * 33}, "/own_score/name"), (3, "/own_score"),
                         ({"name": "x", "unit": "u" * 17}, "/own_score/unit"),
                         ({"name": "x", "better": "higher"}, "/own_score/better")):
        reply = service.request("POST", "/v1/campaigns", STUDY | {"own_score": own})
        assert reply.status == 422 and reply.pointers() == [pointer], reply.body
    reply = service.request("POST", "/v1/campaigns",
                            {"mode": "zero-shot", "preset": "demo", "own_score": COST})
    assert reply.status == 422 and reply.pointers() == ["/own_score"]
    again = {"mode": "study", "label": "named", "if_exists": "return"}
    first = service.post("/v1/campaigns", again | {"own_score": {"name": "cost"}})
    assert first["study"]["own_score"] == {"name": "cost", "unit": ""}
    assert service.post("/v1/campaigns", again)["id"] == first["id"]
    for other in ({"name": "cost", "unit": "J"}, None):
        reply = service.request("POST", "/v1/campaigns", again | {"own_score": other})
        assert reply.status == 409 and reply.pointers() == ["/own_score"], reply.body
    reply = service.request("GET", "/v1/bundles?label=named")
    assert reply.status == 409


def test_own_scores_survive_kills(start, tmp_path):
    """Killed between a told batch and its commit, and after commits: nothing is lost."""
    running = start(state=tmp_path / "state")
    luck, id, sent = random.Random(2), new(running, population=64), []
    for batch in range(6):
        children = running.post(f"/v1/campaigns/{id}/ask", {"n": 6})["children"]
        for child in children:
            child["score"] = luck.gauss(0, 1)
            sent.append(child["score"])
        reply = running.request("POST", f"/v1/campaigns/{id}/tell",
                                {"batch": batch, "children": children})
        assert reply.status in (200, 202), reply.body
        running.stop(signal.SIGKILL)
        running = start(state=tmp_path / "state")
        until(lambda: running.get(f"/v1/campaigns/{id}")["study"]["next_batch"] == batch + 1)
    told = running.get(f"/v1/campaigns/{id}/batch")["children"]
    assert [row["score"] for row in told] == sent[-6:]
    rows = running.pages(f"/v1/campaigns/{id}/phylogeny")
    assert [row["score"] for row in rows] == sent
    population = running.get(f"/v1/campaigns/{id}/population?limit=100")["items"]
    assert [row["score"] for row in population] == sorted(sent)
    assert running.stop() == 0
