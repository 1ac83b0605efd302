"""The event stream: order, resumption, filters, heartbeats, limits, slow readers, the end of the
service."""

import json
import re
import socket
import threading

from service import CONTRACT, DESIGN, SHORT, soon, until


class Stream:
    """A reader of /v1/events on its own socket."""
    def __init__(self, service, query="", headers="", timeout=300):
        self.sock = socket.create_connection((service.host, service.port), timeout=timeout)
        self.sock.sendall(
            f"GET /v1/events{query} HTTP/1.0\r\nHost: localhost\r\n{headers}\r\n".encode())
        self.file = self.sock.makefile("rb")
        self.status = int(self.file.readline().split(b" ")[1])
        self.headers = {}
        while (line := self.file.readline().strip()):
            name, _, value = line.decode().partition(": ")
            self.headers[name.lower()] = value

    def __iter__(self):
        event = {}
        while (line := self.file.readline()):
            line = line.decode().rstrip("\n")
            if line:
                name, _, value = line.partition(":")
                event[name or "comment"] = value.strip()
            elif event:
                yield event
                event = {}

    def events(self, n):
        found = []
        for event in self:
            if "data" in event:
                if event["event"] != "reset":
                    CONTRACT.validate({"$ref": "#/components/schemas/Event"},
                                      json.loads(event["data"]), "event")
                    assert json.loads(event["data"])["id"] == event["id"]
                found.append(event)
                if len(found) == n:
                    break
        return found

    def close(self):
        self.file.close()
        self.sock.close()


def page(service, query=""):
    return service.get("/v1/events?format=json" + query)


def test_a_job_in_order(service):
    stream = Stream(service)
    assert stream.status == 200 and stream.headers["content-type"] == "text/event-stream"
    # The place of a stream is fixed before its head is sent.
    job = service.evaluate({"designs": [DESIGN], "physics": {"n_steps": 61}}).json()["id"]
    events = []
    for event in stream:
        if "data" in event and json.loads(event["data"])["job"] == job:
            events.append(event)
            if event["event"] == "job.finished":
                break
    assert [event["event"] for event in events
            if event["event"] != "job.progress"] == ["job.created", "job.started", "job.finished"]
    numbers = [int(event["id"]) for event in events]
    assert numbers == sorted(numbers)
    stored = [event["id"] for event in page(service, f"&job={job}&limit=1000")["items"]]
    assert stored == [event["id"] for event in events]
    stream.close()


def test_resumption_loses_nothing(start):
    service = start()  # with few events, which are read in many small pages
    for n_steps in range(1, 9):
        service.evaluate({"designs": [DESIGN], "physics": {"n_steps": n_steps}})
    whole, cursor = [], "0"
    while cursor is not None:
        part = page(service, f"&cursor={cursor}&limit=7")
        whole += [event["id"] for event in part["items"]]
        cursor = part["next_cursor"]
    assert part["newest"] == whole[-1] and page(service, f"&after={whole[-1]}")["items"] == []
    assert whole == [event["id"]
                     for event in page(service, "&after=0&limit=1000")["items"]][:len(whole)]
    middle = len(whole) // 2
    for query, headers in ((f"?after={whole[middle]}", ""),
                           ("?after=0", f"Last-Event-ID: {whole[middle]}\r\n")):
        stream = Stream(service, query, headers)
        rest = stream.events(len(whole) - middle - 1)
        assert [event["id"] for event in rest] == whole[middle + 1:]
        stream.close()


def test_filter(service):
    stream_job = service.post("/v1/evaluations",
                              {"designs": [DESIGN], "physics": {"n_steps": 62}})["id"]
    service.evaluate({"designs": [DESIGN], "physics": {"n_steps": 63}})
    service.request("GET", f"/v1/jobs/{stream_job}", headers={"Prefer": "wait=20"})
    stream = Stream(service, f"?after=0&job={stream_job}")
    seen = []
    for event in stream:
        if "data" in event:
            seen.append(json.loads(event["data"]))
            if event["event"] == "job.finished":
                break
    assert {event["job"] for event in seen} == {stream_job} and seen[0]["type"] == "job.created"
    stream.close()


def test_reset(service):
    stream = Stream(service, "?after=999999999")
    event = stream.events(1)[0]
    assert event["event"] == "reset" and int(event["id"]) == int(
        json.loads(event["data"])["newest"])
    job = service.evaluate({"designs": [DESIGN], "physics": {"n_steps": 64}}).json()["id"]
    assert json.loads(stream.events(1)[0]["data"])["job"] == job
    stream.close()
    beyond = page(service, "&after=999999999999999999")
    assert beyond["reset"] is True and beyond["items"] == [] and int(beyond["newest"]) >= int(
        event["id"])


def test_events_of_a_job_that_never_was(service):
    for query in ("", "&format=json", "&format=csv", "&after=3"):
        reply = service.request("GET", f"/v1/events?job=999999{query}")
        assert reply.status == 404, query
    # Events of a deleted job stay.
    job = service.evaluate({"designs": [DESIGN], "physics": SHORT}).json()["id"]
    assert service.request("DELETE", f"/v1/jobs/{job}").status == 200
    assert [event["type"] for event in page(service, f"&job={job}&after=0")["items"]
            ][-1] == "job.deleted"


def test_bad_place(service):
    stream = Stream(service, "", "Last-Event-ID: yesterday\r\n")
    assert stream.status == 400
    stream.close()


def test_many_streams_see_the_same(service):
    streams = [Stream(service) for _ in range(40)]
    jobs = [
        service.post("/v1/evaluations", {"designs": [DESIGN], "physics": {"n_steps": 70 + i}})["id"]
        for i in range(5)
    ]
    for job in jobs:
        service.request("GET", f"/v1/jobs/{job}", headers={"Prefer": "wait=20"})
    newest = page(service, "&after=0&limit=1000")["items"][-1]["id"]
    seen = []
    for stream in streams:
        ids = []
        for event in stream:
            if "data" in event:
                ids.append(event["id"])
                if event["id"] == newest:
                    break
        seen.append(ids)
        stream.close()
    assert all(ids == seen[0] for ids in seen) and len(seen[0]) >= 15
    assert seen[0] == [str(i) for i in range(int(seen[0][0]), int(seen[0][-1]) + 1)]


def test_vanished_readers_are_noticed(service):
    before = service.metric("morphod_event_streams")
    streams = [Stream(service) for _ in range(10)]
    assert service.metric("morphod_event_streams") == before + 10
    for stream in streams:
        stream.close()
    until(lambda: service.metric("morphod_event_streams") <= before)


def test_streams_are_limited(start):
    running = start("--max-streams=3")
    streams = [Stream(running) for _ in range(3)]
    refused = running.request("GET", "/v1/events")
    assert refused.status == 503
    streams[0].close()
    until(lambda: Stream(running).status == 200)


def test_streams_end_with_the_service(start):
    running = start()
    stream = Stream(running)
    ended = []
    thread = threading.Thread(target=lambda: ended.extend(stream))
    thread.start()
    with soon():
        assert running.stop() == 0
        thread.join(timeout=300)
    assert not thread.is_alive()


def test_slow_reader_gets_everything_later(service):
    """More data than the sockets can buffer piles up while one reader sleeps. This does not affect
    the others or the service."""
    sock = socket.socket()
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    sock.connect((service.host, service.port))
    sock.sendall(b"GET /v1/events?after=0 HTTP/1.0\r\nHost: localhost\r\n\r\n")
    for i in range(60):
        service.upload(f"slow-{i % 3}", b"")
        assert service.request("GET", "/healthz").status == 200
    service.evaluate({"designs": [DESIGN], "physics": {"n_steps": 65}})
    newest = page(service, "&after=0&limit=1000")["items"][-1]["id"]
    sock.settimeout(300)
    data = b""
    while f"id: {newest}\n".encode() not in data:
        piece = sock.recv(65536)
        assert piece
        data += piece
    ids = [int(number) for number in re.findall(rb"^id: (\d+)$", data, re.M)]
    assert ids == list(range(ids[0], int(newest) + 1))
    sock.close()
