"""A server with arbitrary replies: the package raises a MorphodError that describes them."""

import http.server
import json
import threading

import morphod
import numpy as np
import pytest

JOB = {"id": "7", "state": "succeeded", "label": None, "n_designs": 1, "results": [{}],
       "study": {"next_batch": 1, "pending": False, "sampler": {}}, "group": 5, "progress": [],
       "newest": 3, "settings": None, "warnings": [], "founders": [5], "controller": 1,
       "result": None}
NOT_OF_THE_FORM = [
    b"", b"null", b"5", b"[1,2]", b'"text"', b"{}", b"[" * 100000, b'{"items": 5}',
    b'{"items": [5], "next_cursor": null}', b'{"items": [{}], "next_cursor": []}', b"\xff\xfe",
    b'{"id": [], "state": {}}', b'{"id": "1", "state": "succeeded", "results": 3}',
    json.dumps(JOB).encode(),
    json.dumps(JOB | {"study": [], "results": [5], "progress": None, "group": {}}).encode(),
    json.dumps(JOB | {"warnings": [5]}).encode(),
    json.dumps(JOB | {"results": None, "n_designs": "x", "study": None,
                      "items": {"a": 1}, "newest": {"score": []}}).encode(),
    json.dumps(JOB | {"results": [{"score": "x", "losses": {}, "id": 5, "genotype": 7,
                                   "repaired": "y", "fault": 3, "lower_bound": []}]}).encode(),
]

CALLS = {
    "evaluate": lambda m: m.evaluate([[[0, 0, 0]]]).frame(),
    "scores": lambda m: m.evaluate([[[0, 0, 0]]], wait=False).scores,
    "losses": lambda m: m.evaluation(1).losses,
    "results": lambda m: [(row.scores, row.body) for row in m.evaluation(1)],
    "recording": lambda m: m.evaluation(1).recording(0),
    "recordings": lambda m: m.evaluation(1).recordings(),
    "show": lambda m: m.evaluation(1).show(),
    "rollouts": lambda m: m.rollouts([[[0, 0, 0]]]),
    "show bodies": lambda m: m.show([[[0, 0, 0]]]),
    "random": lambda m: m.random_bodies(1),
    "mutate": lambda m: m.mutate([[[0, 0, 0]]]),
    "cross": lambda m: m.cross([[[0, 0, 0]]], [[[0, 0, 0]]]),
    "canonical": lambda m: m.canonical([[[0, 0, 0]]]),
    "objective": lambda m: m.objective(["path_length_m"])(np.ones((1, 144))),
    "designs": lambda m: m.designs(),
    "campaign": lambda m: m.campaign("zero-shot", replicates=2)[0].live(),
    "campaigns": lambda m: m.campaigns().live(),
    "wait": lambda m: m.get_campaign(1).wait(0.1),
    "curve": lambda m: m.get_campaign(1).curve(),
    "population": lambda m: m.get_campaign(1).learning(),
    "champions": lambda m: m.get_campaign(1).champions(),
    "phylogeny": lambda m: m.get_campaign(1).phylogeny(),
    "show campaign": lambda m: m.get_campaign(1).show(),
    "compare": lambda m: m.compare_campaigns(1, 2),
    "compare groups": lambda m: m.compare_campaigns(m.campaigns(), 2),
    "compare controllers": lambda m: m.compare_controllers("a", "b"),
    "compare trainings": lambda m: m.compare_controllers(m.training(1), "b"),
    "left out": lambda m: m.get_campaign(1).left_out,
    "certify": lambda m: m.certify([[[0, 0, 0]]]).live().report(),
    "certificate": lambda m: [row.score for row in m.certificate(1).report().designs],
    "certificate's table": lambda m: m.certificate(1).report().frame(),
    "study": lambda m: m.study("x").tell([[[0, 0, 0]]]).frame(),
    "ask": lambda m: m.study("x").ask(3),
    "restore": lambda m: m.study("x").restore(),
    "train": lambda m: m.pretrain().live(),
    "training": lambda m: m.training(1).steps(),
    "controller": lambda m: m.controller("x").arrays,
    "usage": lambda m: m.usage(),
    "fleet": lambda m: repr(m.fleet()),
    "events": lambda m: next(m.events()),
    "version": lambda m: m.version().encode(),
    "repr": lambda m: repr(m.evaluation(1)) + str(m.evaluation(1).label),
}


@pytest.fixture
def answered():
    """A client, and the replies of its server: bytes, or a status and bytes."""
    replies = {"body": b"{}", "status": 200, "type": "application/json", "n": 0,
               "more": {}}

    class Handler(http.server.BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_GET(self):
            self.rfile.read(int(self.headers.get("Content-Length", 0)))
            replies["n"] += 1
            body = replies["body"]
            body = body(self.path) if callable(body) else body
            self.send_response(replies["status"])
            self.send_header("Content-Type", replies["type"])
            for name, value in replies["more"].items():
                self.send_header(name, value)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        do_POST = do_PUT = do_DELETE = do_PATCH = do_GET

        def log_message(self, *_):
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    with morphod.Client(f"http://127.0.0.1:{server.server_port}", retry_s=0.0) as client:
        yield client, replies
    server.shutdown()
    server.server_close()


@pytest.mark.parametrize("what", CALLS)
def test_a_reply_of_another_form(answered, what):
    client, replies = answered
    for body in NOT_OF_THE_FORM:
        replies["body"] = body
        try:
            CALLS[what](client)
        except morphod.MorphodError as error:
            assert str(error).isprintable() or "\n" in str(error)


@pytest.mark.parametrize("body", [
    b"", b"[]", b"5", b"\xff", b"[" * 100000, b'{"detail": {}, "errors": 5}',
    b'{"errors": [3, {}, {"detail": null}, {"pointer": [], "detail": {}}], "request_id": []}',
])
def test_a_refusal_of_another_form(answered, body):
    client, replies = answered
    replies.update(status=422, body=body)
    with pytest.raises(morphod.InvalidError) as caught:
        client.version()
    assert caught.value.status == 422


def test_headers_of_another_form(answered):
    client, replies = answered
    for retry_after in ("\xb2", "-1", "Fri, 32 Foo 99999 99:99:99 GMT", "9" * 400):
        replies.update(status=503, more={"Retry-After": retry_after}, n=0)
        client._connection.retry_s = 0.3
        with pytest.raises(morphod.BusyError):
            client.version()
    replies.update(status=200, more={"Content-Encoding": "gzip"}, body=b"no gzip")
    with pytest.raises(morphod.MorphodError, match="cannot be decoded"):
        client.version()
    replies.update(status=302, more={"Location": "http://elsewhere.invalid/"}, body=b"")
    with pytest.raises(morphod.MorphodError, match="not JSON"):
        client.version()


def test_control_characters_of_a_service_are_escaped(answered):
    client, replies = answered
    text = "red \x1b[31m\x9b8m \u202e reversed \u2066\r\nother line"
    escaped = "red \\x1b[31m\\x9b8m \\u202e reversed \\u2066\\r\\nother line"
    replies.update(status=422, body=json.dumps(
        {"detail": text, "errors": [{"pointer": "/\x07", "detail": text + "2"}]}).encode())
    with pytest.raises(morphod.InvalidError) as caught:
        client.version()
    assert str(caught.value) == f"422: {escaped}\n  /\\x07: {escaped}2"
    replies.update(status=200, body=json.dumps(
        JOB | {"state": "failed", "error": {"detail": text}}).encode())
    with pytest.raises(morphod.JobError) as caught:
        client.evaluation(7).wait()
    assert str(caught.value) == f"job 7 failed: {escaped}"


def test_a_list_that_goes_round_ends(answered):
    client, replies = answered
    replies["body"] = b'{"items": [], "next_cursor": "same"}'
    with pytest.raises(morphod.MorphodError, match="does not end"):
        client.jobs()
    assert replies["n"] == 2
    turns = iter("abcabc")
    replies["body"] = lambda _: json.dumps({"items": [], "next_cursor": next(turns)}).encode()
    with pytest.raises(morphod.MorphodError, match="'a' repeats"):
        client.jobs()


def test_a_wait_that_is_answered_at_once_is_not_repeated_at_once(answered):
    client, replies = answered
    replies["body"] = json.dumps(JOB | {"state": "running"}).encode()
    with pytest.raises(morphod.WaitError):
        client.evaluation(7).wait(timeout_s=1.2)
    assert replies["n"] < 6


def test_results_of_other_bodies_are_refused(answered):
    client, replies = answered
    row = {"score": 1.0, "lower_bound": False, "losses": [1.0], "id": "x", "fault": None,
           "repaired": 0, "robot": "x@0", "orientation": None}
    bar = np.zeros((6, 6, 4), dtype=bool)
    bar[3:5, 2, 1] = True
    for genotype, is_right in ((bar, True), (np.roll(bar, (-2, 1, -1), (0, 1, 2)), True),
                               (np.roll(bar, 1, 1) | bar, False)):
        text = "".join("01"[voxel] for voxel in genotype.ravel().astype(int))
        replies["body"] = json.dumps(JOB | {"results": [row | {"genotype": text}]}).encode()
        if is_right:
            assert client.evaluate([bar]).scores[0] == 1
        else:
            with pytest.raises(morphod.MorphodError, match="is not for the requested body"):
                client.evaluate([bar])
    with pytest.raises(morphod.MorphodError, match="has 1 results, but 2 were"):
        client.evaluate([bar, bar])
