"""An import writes in pieces: other writes wait only for one of them, its campaigns and evaluations
appear together at the end, and an import that ends early leaves none of them."""

import http.client
import socket
import sqlite3
import threading
import time

import pytest

from service import DESIGN, await_end, until

ZSTD = {"Content-Type": "application/zstd"}
HERE = [{"light_xy_m": [4.0, 3.0], "terrain_sigma_m": 0.05, "seed": 3}]
SMALL = {"designs": [DESIGN], "environments": HERE, "physics": {"n_steps": 1}}
CAMPAIGNS = 2


@pytest.fixture(scope="module")
def bundle(service):
    """Two campaigns of 10,000 designs, and an evaluation that recorded one of them: about a second
    of the writer's time."""
    first = service.post("/v1/campaigns", {
        "mode": "zero-shot", "population": 1000, "generations": 9, "physics": {"n_steps": 1},
        "environments": HERE, "exclude_pretraining": False, "replicates": CAMPAIGNS,
        "label": "large", "initial": {"designs": [DESIGN]}})["id"]
    for place in range(CAMPAIGNS):
        await_end(service, f"/v1/campaigns/{int(first) + place}")
    service.evaluate(SMALL | {"record": ["com"], "label": "recorded"})
    return service.request("GET", "/v1/bundles?label=large&recordings=true").body


class Import:
    """An import in the background."""

    def __init__(self, service, bundle):
        self.seconds = self.reply = None
        self.connection = service.connection()
        self.thread = threading.Thread(target=self.run, args=(service, bundle))
        self.thread.start()

    def run(self, service, bundle):
        begun = time.monotonic()
        try:
            self.reply = service.request("POST", "/v1/bundles", body=bundle, headers=ZSTD,
                                         connection=self.connection)
        except (OSError, http.client.HTTPException):  # the test has ended the connection
            pass
        self.seconds = time.monotonic() - begun

    def is_running(self):
        return self.thread.is_alive()


def hidden(service):
    """Counts the jobs that readers do not see."""
    with sqlite3.connect(f"file:{service.state}/morphod.db?mode=ro", uri=True) as database:
        return database.execute("SELECT count(*) FROM jobs WHERE state=6").fetchone()[0]


def jobs_used(service):
    return sum(row["jobs"] for row in service.get("/v1/usage?by=kind")["items"])


def test_other_writes_wait_for_a_piece_only(start, bundle):
    other = start()
    connection = other.connection()
    begun = Import(other, bundle)
    longest, seen, staged = 0, [], 0
    while begun.is_running():
        before = time.monotonic()
        other.post("/v1/evaluations", SMALL, connection=connection)
        longest = max(longest, time.monotonic() - before)
        staged = max(staged, hidden(other))
        seen.append(len(other.get("/v1/campaigns", connection=connection)["items"]))
    assert begun.reply.status == 201
    # In one transaction, the longest write takes about half the time of the whole import.
    print(f"import {begun.seconds:.2f} s, longest write {longest:.2f} s, {len(seen)} writes")
    assert longest < begun.seconds / 4, (longest, begun.seconds)
    assert staged >= CAMPAIGNS and set(seen) <= {0, CAMPAIGNS}, (staged, seen)
    assert hidden(other) == 0 and jobs_used(other) == len(other.pages("/v1/jobs"))
    recorded = other.get("/v1/evaluations?label=recorded")["items"][0]["id"]
    assert other.request("GET", f"/v1/evaluations/{recorded}/trajectories").status == 200


def test_an_import_whose_client_leaves(start, bundle):
    """Its campaigns are deleted, and the same bundle can be imported at once."""
    other = start()
    before = jobs_used(other)
    begun = Import(other, bundle)
    until(lambda: other.get("/v1/designs?limit=1")["items"] or not begun.is_running())
    assert hidden(other) > 0
    begun.connection.sock.shutdown(socket.SHUT_RDWR)
    begun.thread.join()
    until(lambda: hidden(other) == 0)
    assert begun.reply is None and other.get("/v1/campaigns")["items"] == []
    assert other.get("/v1/jobs")["items"] == [] and jobs_used(other) == before
    assert other.get("/v1/designs?limit=1")["items"] != [], "designs belong to no job, and stay"
    assert all(event["job"] is None for event in other.get("/v1/events?format=json")["items"])
    reply = other.request("POST", "/v1/bundles", body=bundle, headers=ZSTD)
    assert reply.status == 201 and all(item["entered"] for item in reply.json()["items"])
    assert len(other.get("/v1/campaigns")["items"]) == CAMPAIGNS
    assert reply.json()["losses_stored"] < 10_000 * CAMPAIGNS, "the first part was there"


def test_two_imports_at_once(start, bundle):
    other = start()
    both = [Import(other, bundle) for _ in range(2)]
    for one in both:
        one.thread.join()
    assert sorted(one.reply.status for one in both) == [200, 201]
    assert len(other.get("/v1/campaigns")["items"]) == CAMPAIGNS
