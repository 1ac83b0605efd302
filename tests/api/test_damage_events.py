"""Events that cannot be read: pages name them, streams pass over them, and both go on behind them."""

import contextlib
import json
import sqlite3

from service import CONTRACT, DESIGN, SHORT
from test_damage import damage, unclean

EVENTS = "/v1/events?format=json&after=0&limit=1000"
UNREADABLE_EVENTS = {
    2: ("time_us = -1", "events.time_us of row 2 is -1"), 3: ("job = -7", "events.job of row 3 is -7"),
    4: ("type = 'x' || char(10) || 'data: 7'", "events.type of row 4 is none"), 5: ("type = type || char(0)", "events.type of row 5 is none"),
    6: ("time_us = 253402300800000000", "events.time_us of row 6 is 253402300800000000"), 7: ("type = NULL", "events.type of row 7 is none"),
    1 << 60: ("sequence = 1 << 60", f"events.sequence of row {1 << 60} is {1 << 60}"),
}
ODD_DATA = {8: ("NULL", {"unreadable": "events.data is not JSON"}), 9: ("CAST(data AS BLOB)", None), 10: ("'{\n\"a\":\r\n7}'", {"a": 7}), 11: ("'[1]'", {"unreadable": "events.data is no object"})}


def stream_of(service, after):
    """What a stream gives, event by event, without end."""
    with contextlib.closing(service.connection(timeout=10)) as connection:
        connection.request("GET", f"/v1/events?after={after}", headers={"Accept": "text/event-stream"})
        found = {}
        for line in connection.getresponse():
            name, _, value = line.decode().rstrip("\n").partition(": ")
            if name == "data":
                CONTRACT.validate({"$ref": "#/components/schemas/Event"}, json.loads(value), "event")
                yield {**found, "data": json.loads(value)}
            assert name in ("", "id", "event", "data", "retry"), line
            found[name] = value


def test_events_that_cannot_be_read(start, tmp_path):
    """Pages name them and go on behind them; streams pass over them, and do not end."""
    first = start(state=tmp_path)
    for n_steps in range(30, 36):
        assert first.evaluate({"designs": [DESIGN], "physics": {"n_steps": n_steps}}).status == 200
    whole = {event["id"]: event for event in first.request("GET", EVENTS).json()["items"]}
    assert len(whole) > 16
    first.stop()
    with contextlib.closing(sqlite3.connect(tmp_path / "morphod.db")) as database:  # as a flipped bit does: any column holds anything
        database.execute("PRAGMA writable_schema = ON")
        database.execute("UPDATE sqlite_schema SET sql = replace(replace(sql, 'STRICT', ''), 'NOT NULL', '') WHERE name = 'events'")
        database.commit()
    last = max(map(int, whole))
    damages = {**{at: sql for at, (sql, _) in UNREADABLE_EVENTS.items()}, **{at: f"data = {sql}" for at, (sql, _) in ODD_DATA.items()}}
    damage(tmp_path, "; ".join(f"UPDATE events SET {sql} WHERE sequence = {min(at, last)}" for at, sql in damages.items()))
    service = start("--log-format=logfmt", state=tmp_path)
    reply = service.request("GET", EVENTS)
    page = reply.json()
    named = [{"id": str(at), "kind": "event", "detail": words} for at, (_, words) in UNREADABLE_EVENTS.items()]
    assert page["unreadable"] == named and page["next_after"] == str(last - 1) and not page["reset"]
    assert [event["id"] for event in page["items"]] == [str(at) for at in range(1, last) if at not in UNREADABLE_EVENTS]
    for event in page["items"]:
        data = ODD_DATA.get(int(event["id"]), (None, None))[1]
        assert event == {**whole[event["id"]], **({"data": data} if data is not None else {})}
    line = unclean(service, [reply])[-1]
    assert "level=warning" in line and "event 2 cannot be read: events.time_us of row 2 is -1; event 3 cannot be read: " in line

    after, seen = 0, []
    for _ in range(last):  # each page has one, readable or not
        page = service.request("GET", f"/v1/events?format=json&limit=1&after={after}").json()
        seen += page["items"] + page.get("unreadable", [])
        assert page["next_after"] == str(min(after + 1, last - 1)) and not page["reset"]
        after = int(page["next_after"])
    assert [int(event["id"]) for event in seen] == [*range(1, last), 1 << 60]
    by_job = service.request("GET", EVENTS + "&job=1").json()
    assert {event["id"] for event in by_job["items"]} <= set(whole) and {one["id"] for one in by_job["unreadable"]} <= {"2", "4", "5", "6", "7"}
    stream = stream_of(service, 0)
    streamed = [next(stream) for _ in range(last - 1 - 6)]
    assert [event["data"] for event in streamed] == service.request("GET", EVENTS).json()["items"]
    assert all(event["id"] == event["data"]["id"] and event["event"] == event["data"]["type"] for event in streamed)


def test_a_stream_behind_damaged_events(start, tmp_path):
    """A stream that has passed over what cannot be read goes on with what happens next, and so does a page."""
    service = start(state=tmp_path)
    assert service.evaluate({"designs": [DESIGN], "physics": SHORT}).status == 200
    newest = int(service.request("GET", EVENTS).json()["next_after"])
    damage(tmp_path, "UPDATE events SET time_us = 0 WHERE sequence > 1")
    stream = stream_of(service, 0)
    assert next(stream)["id"] == "1"
    job = service.evaluate({"designs": [DESIGN], "physics": {"n_steps": 21}}).json()["id"]
    following = next(stream)
    assert following["id"] == str(newest + 1) and following["data"]["job"] == job
    page = service.request("GET", f"/v1/events?format=json&after={newest - 1}").json()
    assert page["unreadable"][0]["id"] == str(newest) and page["items"][0] == following["data"]


def test_every_type_of_event_is_read(start, tmp_path):
    """The store knows the types that the contract names."""
    service = start(state=tmp_path)
    for type_ in CONTRACT.document["components"]["schemas"]["Event"]["properties"]["type"]["enum"]:
        damage(tmp_path, f"UPDATE events SET type = '{type_}'")
        page = service.request("GET", EVENTS).json()
        assert "unreadable" not in page and {event["type"] for event in page["items"]} == {type_}
