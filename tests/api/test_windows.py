"""Rollouts that continue from a state: windows have the bits of the whole, also through JSON, and
no state can do harm."""

import copy
import json
import random

import pytest

from service import DESIGN
from test_worlds import WORLD, roll, scene

OTHER = {"cells": [[0, 0, 0], [1, 0, 0], [1, 1, 0]]}
RECORDED = ["com", "masses", "actuation", "contacts"]
TASKS = [None, "photo-auc", "walk", "climb", "circle", "path", "pursue",
         {"guide": {"kind": "ahead", "heading_rad": 1}, "objective": "jump"},
         {"guide": {"kind": "fixed"}, "objective": "efficient"},
         {"guide": {"kind": "turning", "heading_rad": 0, "turn_rad_per_s": 1},
          "objective": {"travel": 1, "work_j": -1e-4, "tilt_rad": -0.1, "hops_per_s": 0.1,
                        "inverted_voxels": -0.2}}]


def world(task=None, **more):
    """An environment with a task, whose guide may have no place for the light."""
    made = {key: value for key, value in WORLD.items() if key != "light_xy_m"} | more
    if task is not None:
        made["task"] = task
    fixed = task in (None, "photo-auc")
    if fixed or isinstance(task, dict) and task["guide"]["kind"] == "fixed":
        made["light_xy_m"] = more.get("light_xy_m", WORLD["light_xy_m"])
    return made


def drive(service, value, *lengths, states=None):
    """Returns headers and arrays of windows, each of which starts where the one before ended."""
    windows = []
    for n_steps in lengths:
        window = copy.deepcopy(value) | {"final_states": True}
        window["physics"] = value.get("physics", {}) | {"n_steps": n_steps}
        if states is not None:
            window["states"] = states
        reply = roll(service, window)
        assert reply.status == 200, reply.body
        windows.append(scene(reply))
        states = [rollout["state"] for rollout in windows[-1][0]["rollouts"]]
    return windows


def frames(window, rollout, name):
    header, array = window
    described = header["rollouts"][rollout][name]
    return array(described), len(array(described)) // described["shape"][0]


@pytest.mark.parametrize("task", TASKS, ids=str)
@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_windows_have_the_bits_of_the_whole(service, task, precision):
    dice = random.Random(f"{task} {precision}")
    paper = dice.random() < 0.3
    physics = {"control_period_s": 0.016} if dice.random() < 0.5 else {}
    physics |= {"integrator": "paper"} if paper else {}
    value = {"designs": [DESIGN, OTHER], "environments": [world(task), world(task, damage={
        "octant": dice.randrange(8), "time_s": 0.05})], "record": RECORDED, "record_stride": 1,
        "precision": precision, "physics": physics}
    cut, second = sorted(dice.sample(range(1, 100), 2))
    (whole, ) = drive(service, value, 100)
    windows = drive(service, value, cut, second - cut, 100 - second)
    assert whole[0]["rollouts"][0]["state"] is not None
    for i in range(4):
        last, first = windows[-1][0]["rollouts"][i], whole[0]["rollouts"][i]
        for name in ("loss", "value", "state"):
            assert last.get(name) == first.get(name), name
        for name in ("com_m", "masses_m", "actuation", "contacts"):
            numbers, size = frames(whole, i, name)
            joined = []
            for window in windows:
                part, _ = frames(window, i, name)
                assert not joined or joined[-size:] == list(part[:size]), name
                joined += part[size if joined else 0:]
            assert list(numbers) == joined, name
    if task in ("walk", "circle"):
        numbers, size = frames(whole, 0, "lights_m")
        part, _ = frames(windows[-1], 0, "lights_m")
        assert numbers[-size:] == pytest.approx(part[-size:], abs=1e-5)
    assert whole[0]["designs"][0]["score"] == windows[-1][0]["designs"][0]["score"]


def test_a_light_that_moves_drives_the_robot(service):
    """Without the second window's light, the robot would go on to the first one."""
    value = {"designs": [DESIGN], "environments": [world(light_xy_m=[4.5, 2.5])]}
    ((header, _), ) = drive(service, value, 500)
    states = [header["rollouts"][0]["state"]]
    ends = {}
    for x in (0.5, 4.5):
        moved = value | {"environments": [world(light_xy_m=[x, 2.5])]}
        ((after, _), ) = drive(service, moved, 500, states=states)
        ends[x] = after["rollouts"][0]["state"]
        assert ends[x]["time_s"] == pytest.approx(2)
        assert ends[x]["tally"]["begun_s"] == 0
        positions = ends[x]["positions_m"]
        end = [sum(axis) / len(positions) for axis in zip(*positions)]
        start = ends[x]["tally"]["com_start_m"]
        loss = ((end[0] - x)**2 + (end[1] - 2.5)**2)**0.5 / ((start[0] - x)**2 +
                                                             (start[1] - 2.5)**2)**0.5
        assert after["rollouts"][0]["loss"] == pytest.approx(loss, rel=1e-5)
    assert ends[0.5]["positions_m"][0][0] < ends[4.5]["positions_m"][0][0]
    walks = value | {"environments": [world("walk")]}
    ((after, _), ) = drive(service, walks, 100, states=states)
    assert after["rollouts"][0]["state"]["tally"]["begun_s"] == 1, "a new task has a new tally"


def test_states_are_read_as_json_too(service):
    """The reply as JSON has the same states, and other spellings of numbers lead to the same."""
    value = {"designs": [DESIGN], "environments": [WORLD], "physics": {"n_steps": 1},
             "final_states": True}
    first = service.post("/v1/rollouts", value)["rollouts"][0]
    header, _ = scene(roll(service, value))
    assert header["rollouts"][0]["state"] == first["state"]
    again = service.post("/v1/rollouts", value | {"states": [first["state"]]})["rollouts"][0]
    spelled = json.loads(json.dumps(first["state"]), parse_float=lambda text: float(text))
    spelled["tally"].setdefault("begun_s", 0)
    assert service.post("/v1/rollouts", value | {"states": [spelled]})["rollouts"][0] == again
    assert again["state"]["time_s"] == pytest.approx(0.004)
    assert "state" not in service.post("/v1/rollouts", {"designs": [DESIGN],
                                                        "environments": [WORLD]})["rollouts"][0]


def with_member(state, path, value):
    changed = copy.deepcopy(state)
    place = changed
    for step in path[:-1]:
        place = place[step]
    if value is None:
        del place[path[-1]]
    else:
        place[path[-1]] = value
    return changed


def test_states_that_do_not_fit_are_refused(service):
    value = {"designs": [DESIGN], "environments": [WORLD], "physics": {"n_steps": 8},
             "final_states": True}
    state = service.post("/v1/rollouts", value)["rollouts"][0]["state"]
    go_on = value | {"states": [state]}
    assert service.post("/v1/rollouts", go_on)
    others = [
        (go_on | {"designs": [OTHER]}, "a different robot"),
        (go_on | {"precision": "float64"}, "request that precision"),
        (go_on | {"physics": {"n_steps": 8, "gravity_m_per_s2": 9}}, "only n_steps"),
        (go_on | {"physics": {"n_steps": 8, "dt_s": 0.003}}, "whole number of steps"),
        (go_on | {"environments": [WORLD | {"seed": 8}]}, "start a new world without a state"),
        (go_on | {"environments": [WORLD, WORLD]}, "one for each rollout"),
        (value | {"states": []}, "1 to 64"),
        (value | {"states": [state] * 65}, "1 to 64"),
        (value | {"states": [None]}, "diverged"),
        (value | {"states": state}, "array"),
        (value | {"states": [7]}, "object"),
        (value | {"states": [[]]}, "object"),
        (value | {"states": [{}]}, "missing"),
        (value | {"environments": [WORLD, WORLD],
                  "states": [state, with_member(state, ["time_s"], 0.014)]}, "a different time"),
    ]
    masses = len(state["positions_m"])
    others += [
        (value | {"states": [with_member(state, ["position_remainders_m"], [[0, 0, 1e-9]] * n)]},
         "at most 245 vectors" if n > 245 else "position_remainders_m is missing")
        for n in (1, 2 * masses, 5 * masses, 246, 65535) if n % masses or n // masses > 1]
    others += [
        (value | {"states": [with_member(state, [name], [0] * n)]}, words)
        for name, n, words in (("outputs", 1649, "at most 1648"), ("contacts", 246, "at most 245"),
                               ("cut_springs", 1649, "at most 1648"),
                               ("inverted_voxels", 145, "at most 144"))]
    for wrong, words in others:
        reply = service.request("POST", "/v1/rollouts", wrong)
        assert reply.status == 422, (words, reply.body)
        assert words in json.dumps(reply.json(), ensure_ascii=False), (words, reply.json())


def test_hostile_states_do_no_harm(service):
    """Every member with every kind of value: refused with its place, or computed."""
    value = {"designs": [DESIGN], "physics": {"n_steps": 8}, "final_states": True,
             "environments": [world(TASKS[-1])]}
    state = service.post("/v1/rollouts", value)["rollouts"][0]["state"]
    places = [[name] for name in state] + [["tally", name] for name in state["tally"]]
    places += [["tally", part, name] for part in ("task", "measures")
               for name in state["tally"][part]]
    for name in ("positions_m", "velocities_m_per_s"):
        places += [[name, 0], [name, 0, 0]]
    places += [["outputs", 0], ["contacts", 0], ["tally", "com_start_m", 0]]
    wrong = [-1, 0, 1, 2, 0.5, 1e308, -1e308, 1e19, 2**32, 2**53, 3600.5, "", "x", "0" * 32, [], {},
             [1], [[1]], [[1, 2]], [[1, 2, 3]], [[1, 2, 3, 4]], [[[1]]], True, [1e308] * 3,
             [[0, 0, 0]] * 70000, None]
    refused = 0
    for path in places:
        for number in wrong:
            changed = with_member(state, path, number)
            reply = service.request("POST", "/v1/rollouts", value | {"states": [changed]})
            assert reply.status in (200, 422), (path, number, reply.body[:300])
            refused += reply.status == 422
            if reply.status == 422:
                assert all(at.startswith("/states") for at in reply.pointers()), (path, number)
    assert refused > len(places) * 12
    text = json.dumps(value | {"states": [state]})
    for number in ("NaN", "Infinity", "-Infinity", "1e999", "01", "1."):
        bad = text.replace('"time_s": 0.016', f'"time_s": {number}')
        assert bad != text
        reply = service.request("POST", "/v1/rollouts", body=bad.encode(),
                                headers={"Content-Type": "application/json"})
        assert reply.status in (400, 422), number
    assert service.request("GET", "/healthz").status == 200


def test_a_diverged_rollout_has_no_state(service):
    value = {"designs": [DESIGN], "environments": [WORLD], "final_states": True,
             "physics": {"n_steps": 200, "stiffness_n_per_m": 1e6, "integrator": "paper"}}
    rollout = service.post("/v1/rollouts", value)["rollouts"][0]
    assert rollout["diverged_step"] > 0 and rollout["state"] is None
