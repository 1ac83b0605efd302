"""Finetuning runs of each design alone: their scores are those of training runs and evaluations of
the design, and the controllers that were requested are kept."""

import pytest

from service import DESIGN, await_end, run

BAR = {"cells": [[x, 2, 0] for x in range(4)]}
PLATE = {"cells": [[x, y, 0] for x in range(2) for y in range(3)]}
SMALL = {"kind": "finetune", "steps": 4, "batch": 4, "physics": {"n_steps": 30}}
EACH = SMALL | {"designs": [DESIGN, BAR, PLATE], "each": True,
                "validation": {"environments": 2}}


@pytest.fixture(scope="module")
def each(service):
    return run(service, "trainings", EACH | {"keep": "all", "name": "own"})


@pytest.fixture(scope="module")
def rows(service, each):
    return service.get(f"/v1/trainings/{each['id']}/each")["items"]


def test_the_reply_says_what_it_is(each):
    settings = each["settings"]
    assert (settings["each"], settings["keep"], settings["best"]) == (True, "all", None)
    assert settings["validation"] == {"every_steps": 4, "designs": 1, "environments": 2}
    assert each["progress"] | {"bodies": 3, "bodies_done": 3, "step": 12,
                               "steps": 12} == each["progress"]
    assert each["controller"] is None and each["links"]["each"].endswith("/each")


def test_settings_of_a_reply_can_be_sent_again(service, each):
    settings = each["settings"]
    again = EACH | {name: settings[name] for name in ("each", "keep", "validation", "steps")}
    assert run(service, "trainings", again)["settings"]["validation"] == settings["validation"]


def test_rows_and_summary(service, each, rows):
    path = f"/v1/trainings/{each['id']}/each"
    page = service.get(path)
    summary = page["summary"]
    gains = [row["zero_shot"] - row["finetuned"] for row in rows]
    assert [row["gain"] for row in rows] == gains
    assert summary["compared"] == summary["bodies_done"] == summary["bodies"] == 3
    assert summary["mean_gain"] == pytest.approx(sum(gains) / 3)
    assert summary["improved"] == sum(gain > 0 for gain in gains)
    pairs = [(0, 1), (0, 2), (1, 2)]
    agree = sum(1 if (rows[i]["zero_shot"] < rows[k]["zero_shot"])
                == (rows[i]["finetuned"] < rows[k]["finetuned"]) else -1 for i, k in pairs)
    assert summary["tau"] == pytest.approx(agree / 3) and summary["tau_interval"] is None
    low, high = summary["mean_gain_interval"]
    assert low < summary["mean_gain"] < high
    assert [row["voxels"] for row in rows[1:]] == [4, 6]
    first = service.get(path + "?limit=2")
    second = service.get(path + f"?limit=2&cursor={first['next_cursor']}")
    assert first["items"] + second["items"] == rows and second["summary"] is None
    lines = service.table(path + "?format=csv")
    assert [float(line["finetuned"]) for line in lines] == [row["finetuned"] for row in rows]
    assert [line["controller_name"] for line in lines] == ["own-0", "own-1", "own-2"]


def test_a_design_ends_as_in_a_training_of_its_own(service, each, rows):
    curve = service.get(f"/v1/trainings/{each['id']}/steps")["items"]
    for place in (1, 2):
        alone = run(service, "trainings", SMALL | {
            "designs": [EACH["designs"][place]], "name": "alone",
            "validation": {"every_steps": 4, "environments": 2}})
        row = rows[place]
        path = f"/v1/trainings/{alone['id']}"
        before, after = service.get(path + "/validations")["items"]
        assert (row["zero_shot"], row["finetuned"]) == (before["mean_score"], after["mean_score"])
        assert row["controller"]["sha256"] == alone["controller"]["sha256"]
        steps = service.get(path + "/steps")["items"]
        mine = curve[4 * place:4 * place + 4]
        assert [step["step"] for step in mine] == [4 * place + i for i in (1, 2, 3, 4)]
        assert [step["mean_loss"] for step in mine] == [step["mean_loss"] for step in steps]
        assert (row["first_loss"], row["last_loss"]) == (steps[0]["mean_loss"],
                                                         steps[-1]["mean_loss"])


def test_scores_are_those_of_evaluations(service, each, rows):
    held_out = service.get(f"/v1/trainings/{each['id']}/held-out")
    assert len(held_out["designs"]) == 3
    before = run(service, "evaluations", held_out)["results"]
    assert [result["score"] for result in before] == [row["zero_shot"] for row in rows]
    assert [result["id"] for result in before] == [row["id"] for row in rows]
    for place, row in enumerate(rows):
        after = run(service, "evaluations", held_out | {
            "designs": [held_out["designs"][place]], "controller": f"own-{place}"})
        assert after["controller"]["sha256"] == row["controller"]["sha256"]
        assert after["results"][0]["score"] == row["finetuned"]


def test_scores_in_a_named_set(service):
    """With environments of its own, a training run learns and scores in these."""
    value = {key: value for key, value in EACH.items() if key != "validation"}
    done = run(service, "trainings", value | {"environments": "paper-test", "steps": 1})
    row = service.get(f"/v1/trainings/{done['id']}/each")["items"][1]
    scored = run(service, "evaluations", {"designs": [BAR], "physics": {"n_steps": 30},
                                          "environments": "paper-test"})
    assert row["zero_shot"] == scored["results"][0]["score"]
    assert done["settings"]["environments"] == "paper-test"


def test_only_the_best_are_kept(service, rows):
    """By default, no controller is kept."""
    for given, kept in (({"best": 1}, 1), ({}, 0), ({"keep": "none"}, 0)):
        done = run(service, "trainings", EACH | given)
        best = min(row["finetuned"] for row in rows)
        items = service.get(f"/v1/trainings/{done['id']}/each")["items"]
        names = [row["controller"]["name"] for row in items]
        assert [row["finetuned"] for row in items] == [row["finetuned"] for row in rows]
        assert names == [f"training-{done['id']}-{row['position']}"
                         if kept and row["finetuned"] == best else None for row in items]
        settings = done["settings"]
        assert settings["best"] == given.get("best")
        assert settings["keep"] == (None if "best" in given else "none")
        for name in filter(None, names):
            assert service.request("GET", f"/v1/controllers/{name}/file").status == 200


def test_it_has_no_controller_of_its_own(service, each):
    reply = service.request("GET", f"/v1/trainings/{each['id']}/controller")
    assert reply.status == 404 and "controller per design" in reply.json()["detail"]
    other = run(service, "trainings", SMALL | {"designs": [BAR], "steps": 1})
    reply = service.request("GET", f"/v1/trainings/{other['id']}/each")
    assert reply.status == 404 and "for all of its bodies" in reply.json()["detail"]
    assert not {"each", "keep", "best"} & set(other["settings"])
    assert "bodies" not in other["progress"]


@pytest.mark.parametrize("change, pointers", [
    ({"keep": "some"}, ["/keep"]),
    ({"keep": "all", "best": 2}, ["/best"]),
    ({"best": 0}, ["/best"]),
    ({"validation": {"every_steps": 2, "designs": 3}},
     ["/validation/every_steps", "/validation/designs"]),
    ({"keep": "all", "name": "n" * 60}, ["/name"]),
    ({"each": False, "keep": "all", "best": 2}, ["/keep", "/best"]),
    ({"kind": "pretrain", "designs": None}, None),
    ({"steps": 400000}, [""]),
])
def test_refusals(service, change, pointers):
    value = {key: value for key, value in (EACH | change).items() if value is not None}
    reply = service.request("POST", "/v1/trainings", value)
    assert reply.status == 422, reply.body
    if pointers is not None:
        assert sorted(reply.pointers()) == sorted(pointers), reply.body
    else:
        assert "/each" in reply.pointers()


def test_deletion(service):
    done = run(service, "trainings", EACH | {"steps": 1})
    assert service.request("DELETE", f"/v1/jobs/{done['id']}").status == 200
    assert service.request("GET", f"/v1/trainings/{done['id']}/each").status == 404


def test_events(service, each, rows):
    events = service.get(f"/v1/events?job={each['id']}&format=json&limit=100")["items"]
    bodies = [event["data"] for event in events if event["type"] == "training.body"]
    assert bodies == [{"id": each["id"], "position": row["position"],
                       "zero_shot": row["zero_shot"], "finetuned": row["finetuned"]}
                      for row in rows]


def test_pause_and_cancel(service):
    job = service.post("/v1/trainings", EACH | {"steps": 5000})["id"]
    service.act(job, "pause")
    service.act(job, "cancel")
    assert await_end(service, f"/v1/trainings/{job}").json()["state"] == "cancelled"
    page = service.get(f"/v1/trainings/{job}/each")
    assert len(page["items"]) == page["summary"]["bodies_done"]
