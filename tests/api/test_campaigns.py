"""Campaigns: their settings, running to each end, curves, replicates, extensions, checkpoints."""

import concurrent.futures

import pytest

from service import DESIGN, await_end, awaited, check_rows, run, until

BAR = {"cells": [[x, 2, 0] for x in range(4)]}
HERE = [{"light_xy_m": [4.0, 2.5], "terrain_sigma_m": 0.05, "seed": 7}]
SMALL = {
    "mode": "zero-shot", "population": 8, "generations": 3, "environments": HERE,
    "physics": {"n_steps": 30}
}
LONG = SMALL | {"population": 16, "generations": 100000, "physics": {"n_steps": 300}}
LEARNS = SMALL | {
    "mode": "few-shot", "population": 4, "generations": 2,
    "learning": {"parent_steps": 1, "child_steps": 2, "batch": 4}
}
NONE = {"items": [], "next_cursor": None}


def run_campaign(service, value):
    return run(service, "campaigns", value)


def finished(service, id):
    return await_end(service, f"/v1/campaigns/{id}").json()


def end(service, *ids):
    for id in ids:
        service.act(id, "cancel")


@pytest.fixture(scope="module")
def evolved(service):
    """A small zero-shot campaign that has succeeded."""
    return run_campaign(service, SMALL | {"initial": {"designs": [DESIGN, BAR]}})


@pytest.fixture(scope="module")
def learned(service):
    """A few-shot campaign that has succeeded."""
    return run_campaign(service, LEARNS | {"name": "tuned-by-evolution"})


def test_founders_that_cannot_be_are_skipped(service, evolved):
    """The campaign keeps the remaining founders, and reports what happened to the others."""
    apart = {"cells": BAR["cells"] + [[0, 0, 3]]}
    flat = SMALL | {"workspace": [4, 4, 1]}
    designs = [{"cells": [[9, 0, 0]]}, DESIGN, BAR, {"voxels": "1" * 144}, apart, BAR]
    rules = {"on_fault": "skip", "repair": "largest"}
    value = run_campaign(service, SMALL | {"initial": {"designs": designs[:3]} | rules})
    assert [row["place"] for row in value["founders"]] == [0]
    assert value["settings"] == evolved["settings"] and evolved["founders"] == []
    generations = [service.get(f"/v1/campaigns/{id}/generations")["items"]
                   for id in (value["id"], evolved["id"])]
    assert [row["score"] for row in generations[0]] == [row["score"] for row in generations[1]]
    value = run_campaign(service, flat | {"initial": {"designs": designs} | rules, "replicates": 2})
    assert value["settings"]["initial"] == {"n_designs": 1}
    assert [(row["place"], row["repaired"], row["fault"] and row["fault"]["pointer"])
            for row in value["founders"]] == [
                (0, 0, "/initial/designs/0/cells/0/0"), (1, 0, "/initial/designs/1"),
                (3, 0, "/initial/designs/3"), (4, 0, "/initial/designs/4"),
                (5, 0, "/initial/designs/5")
            ]
    second = service.get(f"/v1/campaigns/{int(value['id']) + 1}")
    assert second["founders"] == value["founders"]
    refused = service.request("POST", "/v1/campaigns",
                              flat | {"initial": {"designs": designs[:2]} | rules})
    assert refused.status == 422 and refused.pointers() == ["/initial/designs"]


def test_settings_are_reported_with_their_defaults(service, evolved, learned):
    assert evolved["mode"] == "zero-shot" and evolved["preset"] == "workstation"
    assert evolved["priority"] == "batch" and evolved["name"] is None
    assert evolved["settings"] | {
        "population": 8, "generations": 3, "seed": 1, "workspace": [6, 6, 4],
        "mutation": {"share": 0.25, "rate": 1 / 144, "growth": 1.025},
        "selection": {"kind": "truncation"}, "environments": {"count": 1},
        "initial": {"n_designs": 2}, "learning": None, "exclude_pretraining": True,
        "collapse_share": 0.5
    } == evolved["settings"] and evolved["settings"]["physics"]["n_steps"] == 30
    assert evolved["controller"]["name"] == "default"
    assert evolved["group"] == {"id": evolved["id"], "replicate": 0, "replicates": 1}
    learning = learned["settings"]["learning"]
    assert learning["schedule"]["peak"] == 3.5e-4 and learning["adam"]["beta1"] == 0.9
    assert learning | {
        "batch": 4, "sensor": None, "checkpoint_every_s": 60, "worlds": "random",
        "adjoint_bound": 2, "adjoint_rule": "clip", "restart_weight": 3
    } == learning
    rule = {"adjoint_rule": "restart", "restart_weight": 0.5}
    queued = service.post("/v1/campaigns",
                          {"mode": "simultaneous", "preset": "demo", "learning": rule})
    settings = queued["settings"]
    assert queued["controller"] is None and queued["name"] == f"campaign-{queued['id']}"
    assert settings | {"generations": 30, "environments": "paper-test",
                       "initial": "random"} == settings
    assert settings["learning"] | {"batch": 64, "sensor": "inverse_sqrt", **rule
                                   } == settings["learning"]
    end(service, queued["id"])


@pytest.mark.parametrize(
    "given, shown",
    [("tournament", {"kind": "tournament", "size": 4}),
     ({"kind": "tournament", "size": 8}, {"kind": "tournament", "size": 8}),
     ("novelty", {"kind": "novelty", "weight": 0.5}), ("truncation", {"kind": "truncation"}),
     ({"kind": "age-layered", "layers": 3}, {"kind": "age-layered", "layers": 3, "age_gap": 5})])
def test_selections(service, given, shown):
    done = run_campaign(service, SMALL | {"selection": given, "generations": 2})
    assert done["settings"]["selection"] == shown and done["progress"]["generation"] == 2


def test_the_end(service, evolved):
    progress = evolved["progress"]
    assert progress | {"generation": 3, "generations": 3, "designs": 32,
                       "under_way": None} == progress
    assert evolved["end"] == "completed" and evolved["phase"] == "idle"
    assert evolved["newest"]["generation"] == 3 and evolved["result"] is None
    job = service.get(evolved["links"]["job"])
    assert job["campaign"] == {
        "mode": "zero-shot", "population": 8, "generation": 3, "generations": 3, "group": {
            "id": str(evolved["id"]), "replicate": 0, "replicates": 1
        },
        "seed": evolved["settings"]["seed"], "environments": evolved["settings"]["environments"],
        "best_score": evolved["newest"]["score"]["quantiles"]["p0"]
    }


def test_learning_gives_a_controller(service, learned):
    assert learned["result"]["controller"]["name"] == "tuned-by-evolution" == learned["name"]
    described = service.get("/v1/controllers/tuned-by-evolution")
    assert described["sha256"] == learned["result"]["controller"]["sha256"]
    assert described["sha256"] != learned["controller"]["sha256"]
    path = learned["links"]["learning"]
    rows = service.pages(path)
    places = [(row["generation"], row["step"]) for row in rows]
    assert places == sorted(places) and len(places) >= 6
    assert {row["on"] for row in rows} == {"parents", "children"}
    assert all(row["mean_loss"] > 0 and row["gradient_norm"] > 0 for row in rows)
    check_rows(service, path, rows, ["generation", "step", "on", "mean_loss"],
               lambda row: "{generation}.{step}".format(**row))
    service.refuses(path, "?cursor=1", "?cursor=-1.0", "?cursor=1.x", "?cursor=1.2.3", "?step=1",
                    "?format=xml")


def test_generations(service, evolved):
    path = evolved["links"]["generations"]
    rows = service.pages(path)
    assert [row["generation"] for row in rows] == [0, 1, 2, 3] and rows[-1] == evolved["newest"]
    assert [row["first_number"] for row in rows] == [0, 8, 16, 24]
    assert all(row["born"] == row["population"] == 8 for row in rows)
    for row in rows:
        quantiles = list(row["score"]["quantiles"].values())
        assert quantiles == sorted(quantiles)
        assert quantiles[0] <= row["score"]["mean"] <= quantiles[-1]
        assert 0 < row["diversity"] < 1 and row["species"] == 8 and row["seconds"] > 0
        assert row["voxels"]["least"] <= row["voxels"]["mean"] <= row["voxels"]["most"] <= 144
    for row in rows[1:]:
        mutation, crossover = row["operators"]["mutation"], row["operators"]["crossover"]
        assert mutation["born"] + crossover["born"] == 8 and mutation["born"] >= 2
        assert mutation["attempts"] >= 2
        assert mutation["survived"] + crossover["survived"] == row["turnover"] * 8
    best = [row["score"]["quantiles"]["p0"] for row in rows]
    assert best == sorted(best, reverse=True)
    check_rows(service, path, rows,
               {"mean": "score.mean", "p95": "score.quantiles.p95", "rollouts": "rollouts",
                "springs_mean": "springs.mean", "seconds": "seconds",
                "parents_mean": "parents_mean", "mutation_attempts": "operators.mutation.attempts"},
               lambda row: str(row["generation"]))
    service.refuses(path, "?cursor=1.1", "?stride=0")
    assert service.get(evolved["links"]["learning"]) == NONE


def test_the_same_again(service, evolved):
    """Another campaign with the same settings has the same history, except for the seconds."""
    again = run_campaign(service, SMALL | {"initial": {"designs": [DESIGN, BAR]}})
    for what in ("generations", "phylogeny"):
        first, second = ([{key: value for key, value in row.items()
                           if key not in ("seconds", "rollouts", "cached")}
                          for row in service.pages(one["links"][what])] for one in (evolved, again))
        assert first == second, what
    other = run_campaign(service, SMALL | {"initial": {"designs": [DESIGN, BAR]}, "seed": 2})
    assert other["newest"]["score"] != evolved["newest"]["score"]


@pytest.mark.parametrize("workspace, designs", [([1, 1, 1], 1), ([2, 1, 1], 2)])
def test_a_morphospace_that_is_exhausted(service, workspace, designs):
    done = run_campaign(service, SMALL | {"workspace": workspace, "generations": 50})
    assert done["end"] == "exhausted" and done["progress"]["designs"] == designs
    assert done["newest"]["population"] <= designs
    reply = service.request("POST", f"/v1/campaigns/{done['id']}/extend", {"generations": 1})
    assert reply.status == 409 and "exhausted" in reply.json()["detail"], reply.body
    assert len(service.pages(done["links"]["phylogeny"])) == designs


def test_no_generations(service):
    done = run_campaign(service, SMALL | {"generations": 0})
    assert done["end"] == "completed"
    assert done["progress"] | {"generation": 0, "designs": 8} == done["progress"]


def test_from_another_campaign(service, evolved):
    done = run_campaign(service, SMALL | {"initial": {"campaign": evolved["id"]}, "population": 10,
                                          "generations": 1})
    first = service.pages(done["links"]["population"] + "?generation=0")
    last = service.pages(evolved["links"]["population"])
    assert {row["operator"] for row in first} == {"inherited", "random"}
    assert {row["genotype"] for row in first if row["operator"] == "inherited"
            } == {row["genotype"] for row in last}
    assert done["settings"]["initial"] == {"campaign": evolved["id"]}
    evaluation = service.evaluate({"designs": [DESIGN], "physics": {"n_steps": 5}}).json()["id"]
    reply = service.request("POST", "/v1/campaigns", SMALL | {"initial": {"campaign": evaluation}})
    assert reply.status == 422 and reply.pointers() == ["/initial/campaign"], reply.body


def test_founders_that_do_not_fit_are_counted(service):
    """Founders from another campaign that do not fit the workspace are noted. If none fits, the
    request is refused."""
    cube = {"cells": [[x, y, z] for x in range(3) for y in range(3) for z in range(3)]}
    rules = {"exclude_pretraining": False, "population": 2, "generations": 0}
    parent = run_campaign(service, SMALL | rules | {"initial": {"designs": [DESIGN, cube]}})
    best_first = [row["number"] for row in service.pages(parent["links"]["population"])]
    asked = SMALL | rules | {"population": 4, "initial": {"campaign": parent["id"]}}
    assert service.post("/v1/campaigns", asked)["founders"] == []
    reply = service.post("/v1/campaigns", asked | {"workspace": [3, 3, 2], "replicates": 2})
    assert reply["founders"] == [{
        "place": best_first.index(1), "robot": None, "orientation": None, "repaired": 0, "fault": {
            "pointer": "/initial/campaign",
            "detail": f"design 1 of campaign {parent['id']} does not fit the workspace of 3 × 3 × 2"
                      " voxels"}}]
    second = finished(service, int(reply["id"]) + 1)
    assert second["founders"] == reply["founders"]
    first = service.pages(second["links"]["population"] + "?generation=0")
    assert sorted(row["operator"] for row in first) == ["inherited"] + 3 * ["random"]
    # None is rotated to fit, because it would be a different robot than in the parent campaign.
    bar = {"cells": [[x, 0, 0] for x in range(4)]}
    parent = run_campaign(service, SMALL | rules | {"initial": {"designs": [bar, DESIGN]}})
    narrow = asked | {"initial": {"campaign": parent["id"]}, "workspace": [3, 4, 2]}
    assert "design 0 of" in str(service.post("/v1/campaigns", narrow)["founders"])
    refused = service.request("POST", "/v1/campaigns", asked | {"workspace": [1, 1, 4]})
    assert refused.status == 422 and refused.pointers() == ["/initial/campaign"], refused.body
    assert "no design of that campaign fits" in refused.json()["detail"]


def test_replicates(service):
    first = service.post("/v1/campaigns", SMALL | {"replicates": 3, "seed": 5})
    ids = [str(int(first["id"]) + i) for i in range(3)]
    all_done = [finished(service, id) for id in ids]
    assert [one["settings"]["seed"] for one in all_done] == [5, 6, 7]
    assert [one["group"] for one in all_done] == [{"id": ids[0], "replicate": i, "replicates": 3}
                                                  for i in range(3)]
    assert [one["id"] for one in service.pages(f"/v1/campaigns?group={ids[0]}")] == ids[::-1]
    curves = [service.pages(one["links"]["generations"]) for one in all_done]
    path = f"/v1/campaigns/{ids[0]}/replicates"
    rows = service.pages(path)
    assert [row["generation"] for row in rows] == [0, 1, 2, 3]
    assert all(service.pages(f"/v1/campaigns/{id}/replicates") == rows for id in ids)
    for row in rows:
        of_all = [curve[row["generation"]] for curve in curves]
        for name, values in (("mean_score", [one["score"]["mean"] for one in of_all]),
                             ("best_score", [one["score"]["quantiles"]["p0"] for one in of_all]),
                             ("diversity", [one["diversity"] for one in of_all])):
            assert row[name]["least"] == min(values) and row[name]["most"] == max(values)
            assert abs(row[name]["mean"] - sum(values) / 3) < 1e-12
        assert row["campaigns"] == 3
    check_rows(service, path, rows, {"diversity_most": "diversity.most"},
               lambda row: str(row["generation"]), left_out=[])
    service.refuses(path, "?generation=1")


def test_replicates_wait_for_the_slowest(service):
    """Generations that not all replicates have are left out; cancelled replicates do not count."""
    first = service.post("/v1/campaigns", LONG | {"replicates": 3})
    ids = [str(int(first["id"]) + i) for i in range(3)]
    path = f"/v1/campaigns/{ids[0]}/replicates"
    assert service.act(ids[1], "cancel").json()["state"] == "cancelled"
    service.act(ids[2], "pause")
    assert all(row["campaigns"] == 2 for row in service.get(path)["items"])
    assert service.get(path)["left_out"] == [{"id": ids[1], "state": "cancelled"}]
    end(service, *ids)
    assert service.get(path) == NONE | {"left_out": [{"id": id, "state": "cancelled"}
                                                     for id in ids[::-1]]}


def test_extend(service):
    """A campaign that is extended after its end, in the queue, or while it is parked equals one
    that was longer from the beginning."""
    whole = run_campaign(service, SMALL | {"generations": 5})
    hold = service.post("/v1/campaigns", LONG)["id"]
    reply = service.request("POST", f"/v1/campaigns/{hold}/extend", {"generations": 1})
    assert reply.status == 422 and reply.pointers() == ["/generations"]  # the maximum
    short = service.post("/v1/campaigns", SMALL | {"generations": 2})["id"]
    extended = service.post(f"/v1/campaigns/{short}/extend", {"generations": 1})
    assert extended["progress"]["generations"] == 3
    end(service, hold)
    reply = service.request("POST", f"/v1/campaigns/{hold}/extend", {"generations": 5})
    assert reply.status == 409 and "cancelled" in reply.json()["detail"], reply.body
    finished(service, short)
    again = service.post(f"/v1/campaigns/{short}/extend", {"generations": 2})
    assert again["settings"]["generations"] == 5
    assert again["state"] == "succeeded" or (again["state"] in ("queued", "running") and
                                             again["end"] is None)
    done = finished(service, short)
    assert done["state"] == "succeeded" and done["progress"]["generation"] == 5
    assert [done["newest"][key] for key in ("score", "diversity")
            ] == [whole["newest"][key] for key in ("score", "diversity")]
    events = service.get(f"/v1/events?format=json&job={short}&after=0&limit=1000")["items"]
    assert [event["data"]["generations"] for event in events
            if event["type"] == "campaign.extended"] == [3, 5]


@pytest.mark.parametrize("body, pointer", [
    ({}, ""), ([], ""), ({"generations": 0}, "/generations"), ({"generations": -3}, "/generations"),
    ({"generations": 1.5}, "/generations"), ({"generations": "9"}, "/generations"),
    ({"generations": 1, "seed": 2}, "/seed"), ({"generations": 100001}, "/generations"),
    ({"generations": 99999}, "/generations")])
def test_bad_extensions(service, evolved, body, pointer):
    path = f"/v1/campaigns/{evolved['id']}"
    reply = service.request("POST", path + "/extend", body)
    assert reply.status == 422 and reply.pointers() == [pointer], reply.body
    assert service.get(path)["settings"]["generations"] == 3


def test_an_extension_that_would_change_the_past(service):
    """With one cosine over all generations, more generations change the rate of every step."""
    learning = {"parent_steps": 1, "child_steps": 1, "batch": 2, "schedule": "one-cosine"}
    id = run_campaign(service, LEARNS | {"mode": "simultaneous", "generations": 1,
                                         "learning": learning})["id"]
    reply = service.request("POST", f"/v1/campaigns/{id}/extend", {"generations": 1})
    assert reply.status == 409 and len(reply.json()["detail"]) > 40, reply.body


def test_checkpoints_are_deleted(service):
    """A campaign that has ended needs no checkpoint. Any other keeps the one from which it
    continues."""
    def delete(path):
        return service.request("DELETE", path).json()

    simultaneous = LEARNS | {
        "mode": "simultaneous", "learning": {"parent_steps": 1, "child_steps": 1, "batch": 2}
    }
    done = run_campaign(service, simultaneous | {"generations": 1})
    path, folder = done["links"]["checkpoints"], service.state / "campaigns" / done["id"]
    item, = service.tagged(path).json()["items"]
    assert (item["generation"], item["step"]) == (1, 2)
    assert [file.name for file in folder.iterdir()] == ["1-2.checkpoint"]
    deleted = delete(path)
    assert deleted == {"items": [{"generation": 1, "step": 2}], "bytes": item["size"]}
    assert deleted["bytes"] > 12e6 and not folder.exists() and service.get(path) == {"items": []}
    assert delete(path) == {"items": [], "bytes": 0}
    service.get(f"/v1/controllers/{done['result']['controller']['name']}")  # the result stays
    reply = service.request("POST", f"/v1/campaigns/{done['id']}/extend", {"generations": 1})
    assert reply.status == 409 and "was deleted" in reply.json()["detail"], reply.body
    assert service.get(f"/v1/campaigns/{done['id']}")["state"] == "succeeded"
    # A running campaign keeps its checkpoint, even if its deletion is requested.
    id = service.post("/v1/campaigns", simultaneous | {"generations": 100000})["id"]
    path = f"/v1/campaigns/{id}/checkpoints"
    awaited(service, path, lambda seen: seen["items"])
    assert delete(path)["items"] == [] and service.get(path)["items"]
    assert service.act(id, "cancel").status == 200
    finished(service, id)
    assert delete(path)["items"]
    # Its thread may write one more file, but its row is refused.
    until(lambda: not (service.state / "campaigns" / id).exists())
    assert service.get(path)["items"] == []
    frozen = run_campaign(service, SMALL)["links"]["checkpoints"]
    assert service.get(frozen) == {"items": []} and delete(frozen) == {"items": [], "bytes": 0}
    assert service.request("DELETE", frozen + "?all=1").status == 400


def test_idempotency_of_what_is_done_with_a_campaign(service):
    """An extension that is sent twice is applied once, and champions are recorded once, even if
    there are newer requests by then."""
    id = run_campaign(service, SMALL)["id"]
    path = f"/v1/campaigns/{id}"

    def send(about, body, key):
        return service.request("POST", about, body, headers={"Idempotency-Key": key})

    generations = SMALL["generations"] + 2
    for _ in range(3):
        reply = send(path + "/extend", {"generations": 2}, "more-of-it")
        assert reply.status == 200 and reply.json()["settings"]["generations"] == generations
    assert finished(service, id)["progress"]["generation"] == generations
    again = send(path + "/extend", {"generations": 2}, "more-of-it")
    assert again.json()["state"] == "succeeded"
    other = run_campaign(service, SMALL | {"seed": 77})["id"]
    for about, body in ((path + "/extend", {"generations": 1}), (path + "/champions", {}),
                        (f"/v1/campaigns/{other}/extend", {"generations": 2})):
        reply = send(about, body, "more-of-it")
        assert reply.status == 422, reply.body
        assert reply.json()["errors"][0]["header"] == "Idempotency-Key", about
    champions = path + "/champions"
    first = send(champions, {"count": 2}, "record-it")
    assert first.status == 202, first.body
    assert send(path + "/extend", {"generations": 1}, "and-more").status == 200
    finished(service, id)
    again = send(champions, {"count": 2}, "record-it")
    assert again.status == 202 and again.json()["id"] == first.json()["id"]
    assert again.headers["Location"] == first.headers["Location"]
    assert send(champions, {"count": 3}, "record-it").status == 422
    assert send(champions, {"count": 2}, "record-it-again").json()["id"] != first.json()["id"]


def test_events(service, evolved):
    events = service.get(
        f"/v1/events?format=json&job={evolved['id']}&after=0&limit=1000")["items"]
    shown = [event["data"] for event in events if event["type"] == "campaign.generation"]
    rows = service.pages(evolved["links"]["generations"])
    assert [data["generation"] for data in shown] == [0, 1, 2, 3]
    for data, row in zip(shown, rows):
        assert set(data) >= {"id", "generation", "generations", "mean", "best", "diversity",
                             "turnover", "seconds_left"}
        assert data["id"] == evolved["id"] and data["generations"] == 3
        for name, value in (("best", row["score"]["quantiles"]["p0"]),
                            ("mean", row["score"]["mean"]), ("diversity", row["diversity"])):
            assert abs(data[name] - value) < 1e-6


def test_a_training_on_a_population(service, evolved):
    value = {
        "kind": "finetune", "population": {"campaign": evolved["id"], "best": 3}, "steps": 1,
        "batch": 2, "physics": {"n_steps": 20}, "validation": {"every_steps": 0, "designs": 3}
    }
    training = service.post("/v1/trainings", value)
    assert training["settings"]["population"] == {"campaign": evolved["id"]}
    assert training["settings"]["n_designs"] == 3
    best = service.get(evolved["links"]["population"] + "?limit=3")["items"]
    held_out = service.get(training["links"]["held_out"])
    assert [design["voxels"] for design in held_out["designs"]] == [row["genotype"] for row in best]
    for population, pointers in (
        ({"evaluation": evolved["id"]}, ["/population/evaluation"]),
        ({"campaign": training["id"]}, ["/population/campaign"]),
        ({"campaign": evolved["id"], "evaluation": "999999"},
         ["/population", "/population/evaluation"]),
        ({"best": 3}, ["/population"])):
        reply = service.request("POST", "/v1/trainings", value | {"population": population})
        assert reply.status == 422 and sorted(reply.pointers()) == pointers, reply.body


def test_campaigns_without_a_population(service):
    """Two campaigns that wait for others have no population yet, and say so."""
    hold = int(service.post("/v1/campaigns", LONG | {"replicates": 20})["id"])
    waits = service.post("/v1/campaigns", LONG)
    assert waits["state"] == "queued" and waits["progress"]["generation"] is None
    assert waits["newest"] is None
    path = f"/v1/campaigns/{waits['id']}"
    for below in ("/population", "/population?generation=0", "/champions",
                  "/champions?generation=0", "/designs/0"):
        reply = service.request("GET", path + below)
        assert reply.status == 404 and len(reply.json()["detail"]) > 30, reply.body
    assert service.get(path + "/generations") == service.get(path + "/phylogeny") == NONE
    assert service.table(path + "/phylogeny?format=csv") == []
    assert service.request("GET", path + "/phylogeny?format=newick").body == b""
    reply = service.request("POST", path + "/champions", {})
    assert reply.status == 409 and len(reply.json()["detail"]) > 30, reply.body
    for kind, value, pointer in (
        ("campaigns", SMALL | {"initial": {"campaign": waits["id"]}}, "/initial/campaign"),
        ("trainings", {"kind": "finetune", "population": {"campaign": waits["id"]}},
         "/population/campaign")):
        reply = service.request("POST", f"/v1/{kind}", value)
        assert reply.status == 409 and reply.pointers() == [pointer], reply.body
    end(service, *(hold + i for i in range(20)), waits["id"])


def test_clients_at_once(service):
    """Several clients submit, read, change and cancel concurrently. Every reply is complete and
    fits the contract."""
    def work(number):
        id = service.post("/v1/campaigns", SMALL | {"seed": 100 + number},
                          headers={"Idempotency-Key": f"at-once-{number}"})["id"]
        for below in ("", "/generations", "/population", "/phylogeny?format=csv", "/replicates",
                      "/phylogeny?format=newick"):
            assert service.request("GET", f"/v1/campaigns/{id}{below}").status in (200, 404)
        if number % 3 == 0:
            assert service.act(id, "cancel").status in (200, 409)
        return finished(service, id)

    with concurrent.futures.ThreadPoolExecutor(8) as pool:
        done = list(pool.map(work, range(12)))
    assert len({one["id"] for one in done}) == 12
    assert all(one["state"] == "succeeded" or (i % 3 == 0 and one["state"] == "cancelled")
               for i, one in enumerate(done))
