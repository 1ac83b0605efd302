"""Compressed replies: which replies are compressed, and how tags, HEAD, ranges and clients without
gzip are handled."""

import gzip
import zlib

import pytest

from service import DESIGN, SHORT, run, until

GZIP = {"Accept-Encoding": "br;q=1.0, gzip;q=0.8, *;q=0.1"}
COLUMNS = ["format=columns", "format=columns&keep=lineages", "format=csv", "format=newick",
           "limit=1000"]


@pytest.fixture(scope="module")
def campaign(service):
    """Returns the path of a campaign with several thousand designs."""
    done = run(service, "campaigns", {
        "mode": "zero-shot", "population": 1000, "generations": 6, "physics": {"n_steps": 2},
        "exclude_pretraining": False,
        "environments": [{"light_xy_m": [4.0, 3.0], "terrain_sigma_m": 0.05, "seed": 3}]})
    return f"/v1/campaigns/{done['id']}"


def replies(service, path, **headers):
    """Returns the plain and the compressed reply. Their bodies must agree."""
    plain = service.request("GET", path, headers=headers)
    packed = service.request("GET", path, headers=headers | GZIP)
    assert plain.status == packed.status == 200
    assert "Content-Encoding" not in plain.headers
    assert packed.headers["Content-Encoding"] == "gzip", path
    assert packed.headers["Content-Type"] == plain.headers["Content-Type"]
    assert gzip.decompress(packed.body) == plain.body
    return plain, packed


@pytest.mark.parametrize("query", COLUMNS)
def test_a_phylogeny(service, campaign, query):
    path = f"{campaign}/phylogeny?{query}"
    plain, packed = replies(service, path)
    assert len(packed.body) < 0.6 * len(plain.body)
    for reply in plain, packed:
        assert {"Accept", "Accept-Encoding"} == set(reply.headers["Vary"].split(", "))
    tag, other = plain.headers["ETag"], packed.headers["ETag"]
    assert tag != other == tag[:-1] + '-gzip"'
    # A client that has either form has the current content.
    for headers in {}, GZIP:
        for known in tag, other, f'"x", W/{other}':
            reply = service.request("GET", path, headers=headers | {"If-None-Match": known})
            assert reply.status == 304 and reply.body == b"" and reply.headers["ETag"] in known
            assert "Accept-Encoding" in reply.headers["Vary"]
            assert "Content-Encoding" not in reply.headers
        unknown = {"If-None-Match": tag[:-1] + '-gzi"'}
        assert service.request("GET", path, headers=headers | unknown).status == 200


@pytest.mark.parametrize("query", COLUMNS)
def test_head_and_ranges(service, campaign, query):
    """HEAD replies like GET. Ranges are not served from either form."""
    path = f"{campaign}/phylogeny?{query}"
    for headers in {}, GZIP:
        whole = service.request("GET", path, headers=headers)
        head = service.request("HEAD", path, headers=headers)
        part = service.request("GET", path, headers=headers | {"Range": "bytes=0-99"})
        for name in "ETag", "Vary", "Content-Type", "Content-Encoding", "Content-Length":
            assert head.headers.get(name) == whole.headers.get(name), name
        assert head.body == b"" and part.status == 200 and part.body == whole.body


def test_a_long_reply_comes_in_pieces(service, start):
    """More than one piece: there is no length, and the content is complete."""
    big = start()
    done = run(big, "campaigns", {
        "mode": "zero-shot", "population": 4000, "generations": 2, "physics": {"n_steps": 1},
        "exclude_pretraining": False,
        "environments": [{"light_xy_m": [4.0, 3.0], "terrain_sigma_m": 0.05, "seed": 3}]})
    path = f"/v1/campaigns/{done['id']}/phylogeny?format=csv"
    plain, packed = replies(big, path)
    assert len(plain.body) > 2 ** 21
    assert packed.headers["Transfer-Encoding"] == "chunked"
    # A reader that stops halfway does not disturb others.
    connection = big.connection()
    connection.request("GET", path, headers=GZIP)
    head = connection.getresponse().read(50000)
    connection.close()
    assert plain.body.startswith(zlib.decompressobj(31).decompress(head)) and len(head) == 50000
    assert replies(big, path)[1].body == packed.body


def test_lists_and_results(service, campaign):
    replies(service, f"{campaign}/population?limit=500")
    designs = [{"cells": [[x, y, z] for x in range(a) for y in range(b) for z in range(c)]}
               for a in range(1, 7) for b in range(1, 7) for c in range(1, 5)]
    value = {"designs": designs, "physics": {"n_steps": 2}}
    posted = service.request("POST", "/v1/evaluations", value,
                             headers=GZIP | {"Prefer": "wait=30"})
    if posted.status == 202:
        until(lambda: service.get(posted.headers["Location"])["state"] == "succeeded")
    plain, packed = replies(service, posted.headers["Location"])
    tags = plain.headers["ETag"], packed.headers["ETag"]
    if posted.status == 200:
        assert gzip.decompress(posted.body) == plain.body and posted.headers["ETag"] == tags[1]
    for tag in tags:
        known = {"If-None-Match": tag}
        assert service.request("GET", posted.headers["Location"], headers=known).status == 304


def test_what_the_build_has_compressed(service):
    plain, packed = replies(service, "/openapi.json")
    assert len(packed.body) < 0.25 * len(plain.body) and packed.headers["Vary"] == "Accept-Encoding"
    for reply in plain, packed:
        known = {"If-None-Match": reply.headers["ETag"]}
        for headers in {}, GZIP:
            again = service.request("GET", "/openapi.json", headers=headers | known)
            assert again.status == 304 and again.headers["ETag"] == reply.headers["ETag"]


def test_what_stays_plain(service, campaign):
    """Small replies, those of event loops, numbers that barely shrink, problems, and all replies to
    clients that do not accept gzip."""
    recorded = service.evaluate({"designs": [DESIGN], "record": ["masses"], "physics": SHORT})
    file = f"/v1/evaluations/{recorded.json()['id']}/trajectories/0/file"
    for path in "/v1/jobs?limit=1", "/metrics", "/v1/threads", file, "/v1/none":
        reply = service.request("GET", path, headers=GZIP)
        assert "Content-Encoding" not in reply.headers, path
    for refused in "identity", "gzip;q=0", "gzip;q=0, *", "br", "":
        reply = service.request("GET", f"{campaign}/phylogeny?format=csv",
                                headers={"Accept-Encoding": refused})
        assert "Content-Encoding" not in reply.headers, refused
        assert reply.body.startswith(b"id,")
