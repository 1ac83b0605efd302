"""The designs of a campaign: populations, designs and their lineage, the phylogeny in all its
forms, champions."""

import csv
import io
import itertools
import json
import math
import re
import socket

import pytest

from service import DESIGN, PATIENCE_S, awaited, until
from test_campaigns import HERE, LEARNS, NONE, SMALL, end, finished, run_campaign

LARGE = {
    "mode": "zero-shot", "population": 2048, "generations": 2, "environments": HERE,
    "physics": {"n_steps": 2}
}


@pytest.fixture(scope="module")
def evolved(service):
    return run_campaign(service, SMALL | {"population": 12, "generations": 6,
                                          "initial": {"designs": [DESIGN]}, "label": "lineage"})


@pytest.fixture(scope="module")
def designs(service, evolved):
    return service.pages(evolved["links"]["phylogeny"])


@pytest.fixture(scope="module")
def large(service):
    """A campaign with more designs than fit in one piece of a reply."""
    return run_campaign(service, LARGE)


def test_every_design(evolved, designs):
    assert [row["number"] for row in designs] == list(range(84))
    assert evolved["progress"]["designs"] == 84
    assert len({row["id"] for row in designs}) == 84, "no form is born twice"
    n_parents = {"random": 0, "listed": 0, "inherited": 0, "mutation": 1, "crossover": 2}
    for row in designs:
        parents = [designs[number] for number in row["parents"]]
        assert len(parents) == n_parents[row["operator"]] and row["born"] == row["number"] // 12
        assert all(parent["number"] < row["number"] and parent["born"] < row["born"]
                   for parent in parents)
        assert all(parent["died"] is None or parent["died"] >= row["born"]
                   for parent in parents), "parents lived"
        assert row["died"] is None or row["died"] >= row["born"]
        assert row["genotype"].count("1") == row["voxels"] >= row["footprint"] and row["score"] > 0
    assert designs[0]["operator"] == "listed"
    assert {row["operator"] for row in designs[1:12]} == {"random"}


def test_pages(service, evolved, designs):
    path = evolved["links"]["phylogeny"]
    for limit in (1, 5, 84, 85):
        assert service.pages(path, limit) == designs
    assert service.tagged(path).json() == {"items": designs, "next_cursor": None}
    assert service.get(path + "?cursor=83") == NONE
    service.refuses(path, "?limit=0", "?limit=1001", "?cursor=x", "?cursor=-1", "?format=nexus",
                    "?after=3", "?format=csv&limit=5", "?format=newick&cursor=5")
    for accept in ("image/png", "application/xml"):
        assert service.request("GET", path, headers={"Accept": accept}).status == 406


def read_standard(text):
    """Reads a phylogeny in the ALife data standard (https://alife-data-standards.github.io), and
    checks its rules and their consequences."""
    rows = list(csv.DictReader(io.StringIO(text), strict=True))
    assert {"id", "ancestor_list", "origin_time", "destruction_time"} <= set(rows[0])
    taxa = {}
    for row in rows:
        assert re.fullmatch("[0-9]+", row["id"])
        assert int(row["id"]) not in taxa, "ids are unique integers"
        assert re.fullmatch(r"\[(none|[0-9]+(,[0-9]+)*)\]", row["ancestor_list"])
        ancestors = [] if row["ancestor_list"] == "[none]" else json.loads(row["ancestor_list"])
        origin, destruction = float(row["origin_time"]), float(row["destruction_time"])
        assert 0 <= origin <= destruction and len(row) == 19 and None not in row
        assert all(taxa[ancestor][1] < origin <= taxa[ancestor][2]
                   for ancestor in ancestors), "every ancestor exists, is older, and lived"
        taxa[int(row["id"])] = (ancestors, origin, destruction, row)
    return taxa


def compare(taxa, designs):
    assert list(taxa) == [row["number"] for row in designs]
    for row in designs:
        ancestors, origin, destruction, cells = taxa[row["number"]]
        assert ancestors == row["parents"] and origin == row["born"]
        assert destruction == (math.inf if row["died"] is None else row["died"])
        assert cells["operator"] == row["operator"]
        assert cells["design"] == "d" + row["id"] and cells["genotype"] == "g" + row["genotype"]
        assert (float(cells["score"]) if cells["score"] else None) == row["score"]
        for key in ("voxels", "footprint", "masses", "springs"):
            assert int(cells[key]) == row[key]


def test_standard_csv(service, evolved, designs):
    path = evolved["links"]["phylogeny"]
    for table in (service.tagged(path + "?format=csv"),
                  service.request("GET", path, headers={"Accept": "text/csv"})):
        assert table.headers["Content-Type"].startswith("text/csv")
        assert table.headers["Vary"] == "Accept, Accept-Encoding"
        taxa = read_standard(table.body.decode())
        compare(taxa, designs)
    cells = taxa[3][3]
    for column in (cells["design"], cells["genotype"]):
        with pytest.raises(ValueError):
            float(column)  # no reader of tables mistakes them for numbers, and requests accept them
    both = service.evaluate({
        "designs": [{"id": cells["design"]}, {"voxels": cells["genotype"]}],
        "physics": {"n_steps": 5}
    }).json()["results"]
    assert [row["id"] for row in both] == [designs[3]["id"]] * 2
    assert both[1]["genotype"] == designs[3]["genotype"]
    assert service.get(f"/v1/designs/{cells['design']}")["id"] == designs[3]["id"]


def read_newick(text):
    """Returns {number: (parent or None, branch length or None)} and the order of the children of
    each."""
    nodes, children, stack, last, closed = {}, {}, [], None, None
    for token in re.findall(r"[(),;]|[^(),;:\s]+(?::[0-9.]+)?", text):
        if token == "(":
            stack.append([])
        elif token in ",;":
            if token == ";":
                assert not stack
                nodes[last] = (None, nodes[last][1])
        elif token == ")":
            last = None
            closed = stack.pop()
        else:
            number, _, length = token.partition(":")
            assert re.fullmatch(
                "n[0-9]+", number), "readers take a bare number at an inner node for a confidence"
            number = int(number[1:])
            assert number not in nodes
            if closed is not None:
                children[number] = closed
                for child in closed:
                    nodes[child] = (number, nodes[child][1])
                closed = None
            nodes[number] = (None, float(length) if length else None)
            if stack:
                stack[-1].append(number)
            last = number
    assert not stack and text.endswith(";\n") and text.count("\n") == text.count(";")
    return nodes, children


def compare_newick(text, designs):
    nodes, children = read_newick(text)
    assert sorted(nodes) == [row["number"] for row in designs]
    for row in designs:
        parent, length = nodes[row["number"]]
        assert parent == (row["parents"][0] if row["parents"] else None)
        if parent is not None:
            assert length == row["born"] - designs[parent]["born"]
    for number, young in children.items():
        assert young == sorted(young), number
    assert text.count(";") == sum(not row["parents"] for row in designs)


def test_newick(service, evolved, designs):
    path = evolved["links"]["phylogeny"]
    reply = service.tagged(path + "?format=newick")
    assert reply.headers["Content-Type"].startswith("text/x-nh")
    compare_newick(reply.body.decode(), designs)
    assert service.request("GET", path, headers={"Accept": "text/x-nh"}).body == reply.body


def test_population(service, evolved, designs):
    path = evolved["links"]["population"]
    rows = service.pages(evolved["links"]["generations"])
    for generation in range(7):
        page = service.get(f"{path}?generation={generation}")
        assert page["generation"] == generation and page["next_cursor"] is None
        assert page["size"] == len(page["items"]) == 12
        scores = [row["score"] for row in page["items"]]
        assert scores == sorted(scores)
        assert scores[0] == rows[generation]["score"]["quantiles"]["p0"]
        assert abs(sum(scores) / 12 - rows[generation]["score"]["mean"]) < 1e-12
        alive = {row["number"] for row in designs if row["born"] <= generation and
                 (row["died"] is None or row["died"] > generation)}
        assert {row["number"] for row in page["items"]} == alive
    assert service.tagged(path).json() == page
    assert service.pages(path, 5) == service.pages(path + "?generation=6", 5) == page["items"]
    cursor = service.get(path + "?limit=5")["next_cursor"]
    service.refuses(path, "?generation=7", status=404)
    service.refuses(path, "?generation=-1", "?generation=x", "?limit=0", "?cursor=5",
                    "?cursor=6-x", "?cursor=-", f"?generation=5&cursor={cursor}", "?best=3")


def test_scores_are_those_of_an_evaluation(service, evolved):
    best = service.get(evolved["links"]["population"] + "?limit=3")["items"]
    evaluation = service.evaluate({
        "designs": [{"voxels": row["genotype"]} for row in best], "environments": HERE,
        "physics": {"n_steps": 30}
    }).json()
    assert [(result["id"], result["score"]) for result in evaluation["results"]
            ] == [(row["id"], row["score"]) for row in best]
    assert evaluation["rollouts_cached"] == 3


def test_lineage(service, evolved, designs):
    base = f"/v1/campaigns/{evolved['id']}/designs"
    children, ancestors = {row["number"]: [] for row in designs}, {}
    for row in designs:
        ancestors[row["number"]] = set(row["parents"]).union(
            *(ancestors[parent] for parent in row["parents"]))
        for parent in row["parents"]:
            children[parent].append(row["number"])
    for number in (0, 5, 11, 12, 40, 83, max(children, key=lambda one: len(children[one]))):
        path = f"{base}/{number}"
        value = service.tagged(path).json()
        young = value.pop("children")["items"]
        assert value == {"campaign": evolved["id"], **designs[number]}
        assert young == [designs[child] for child in children[number]]
        descendants = [one for one in ancestors if number in ancestors[one]]
        for below, expected in (("ancestors", ancestors[number]), ("descendants", descendants)):
            assert service.pages(f"{path}/{below}", 3) == [designs[n] for n in sorted(expected)]
            assert service.get(f"{path}/{below}?limit=1")["total"] == len(expected)
        page = service.get(path + "?limit=1")["children"]
        assert page["items"] == young[:1]
        assert (page["next_cursor"] is None) == (len(young) <= 1)
        if page["next_cursor"] is not None:
            rest = service.get(f"{path}?cursor={page['next_cursor']}")
            assert rest["children"]["items"] == young[1:]
    for below in ("", "/ancestors", "/descendants"):
        for bad in ("84", "4294967295", "99999999999999999999", "x", "-1", "007", "1.5"):
            service.refuses(f"{base}/{bad}", below, status=404)
        service.refuses(f"{base}/0{below}", "?limit=0", "?cursor=x", "?generation=1")


def test_designs_know_their_campaigns(service, evolved, designs):
    for row in (designs[0], designs[50]):
        campaigns = service.get(f"/v1/designs/{row['id']}")["campaigns"]
        born = {key: row[key] for key in ("number", "parents", "operator", "born", "died", "score",
                                          "lower_bound")}
        assert [one for one in campaigns if one["campaign"] == evolved["id"]
                ] == [{"campaign": evolved["id"], **born}]
        numbers = [int(one["campaign"]) for one in campaigns]
        assert numbers == sorted(numbers)
    learned = run_campaign(service, LEARNS | {"generations": 1})
    for row in service.pages(learned["links"]["phylogeny"]):
        value = service.get(f"/v1/designs/{row['id']}")
        assert value["voxels"] == row["voxels"]
        assert value["campaigns"][-1]["campaign"] == learned["id"]
        assert value["campaigns"][-1]["number"] == row["number"]
    alone = service.evaluate({
        "designs": [{"cells": [[x, 0, 0] for x in range(6)] + [[5, 1, 0], [5, 1, 1]]}],
        "physics": {"n_steps": 5}
    }).json()["results"][0]
    assert service.get(f"/v1/designs/{alone['id']}")["campaigns"] == []


def test_champions(service, evolved):
    path = evolved["links"]["champions"]
    value = service.tagged(path).json()
    population = service.pages(evolved["links"]["population"])
    assert value["generation"] == 6 and len(value["items"]) == 12
    assert {row["number"] for row in value["items"]} == {row["number"] for row in population}
    distances = [row["distinctiveness"] for row in value["items"]]
    assert distances == sorted(distances, reverse=True) and distances[-1] > 0
    genotypes = [row["genotype"] for row in value["items"]]
    for row in value["items"]:
        mean = sum(sum(a != b for a, b in zip(row["genotype"], other))
                   for other in genotypes) / 11 / 144
        assert abs(row["distinctiveness"] - mean) < 1e-12
    few = service.get(path + "?count=3&generation=2")
    assert few["generation"] == 2 and len(few["items"]) == 3
    best = service.get(evolved["links"]["population"] + "?generation=2")["items"][0]
    assert best["number"] in [row["number"] for row in few["items"]]
    service.refuses(path, "?generation=7", status=404)
    service.refuses(path, "?count=0", "?count=1001", "?count=x", "?generation=-1", "?limit=3")


@pytest.mark.parametrize("mode", ["zero-shot", "few-shot", "few-shot, paused"])
def test_champions_are_recorded(service, evolved, mode):
    if mode == "few-shot, paused":
        done = service.post("/v1/campaigns", LEARNS | {"generations": 1000})
        path = f"/v1/campaigns/{done['id']}"
        awaited(service, path, lambda now: (now["progress"]["generation"] or 0) >= 2)
        service.act(done["id"], "pause")
        awaited(service, path, lambda now: now["phase"] == "idle")
    else:
        done = evolved if mode == "zero-shot" else run_campaign(service, LEARNS)
    reply = service.request("POST", done["links"]["champions"], {"count": 3, "stride": 5})
    assert reply.status == 202, reply.body
    value = reply.json()
    assert reply.headers["Location"] == f"/v1/evaluations/{value['id']}"
    assert value["record"] == ["com"] and value["record_stride"] == 5
    assert value["priority"] == "interactive"
    results = service.get(reply.headers["Location"], headers={"Prefer": "wait=30"})["results"]
    champions = service.get(done["links"]["champions"] + "?count=3")["items"]
    # The same scores: with the controller that scored them.
    assert [(result["genotype"], result["score"]) for result in results
            ] == [(row["genotype"], row["score"]) for row in champions]
    track = service.get(f"/v1/evaluations/{value['id']}/trajectories/2")
    assert track["frames"] == 7 and len(track["com_m"]) == 7
    seen = service.request("POST", done["links"]["champions"],
                           {"count": 1, "record": ["masses", "actuation"]}).json()
    assert seen["record"] == ["masses", "actuation"]
    if mode == "few-shot, paused":
        end(service, done["id"])


@pytest.mark.parametrize("body, pointer", [
    ([], ""), ({"count": 0}, "/count"), ({"count": 1001}, "/count"), ({"count": "3"}, "/count"),
    ({"stride": 0}, "/stride"), ({"stride": 1.5}, "/stride"),
    ({"record": "com"}, "/record"), ({"record": ["pose"]}, "/record/0"),
    ({"records": ["com"]}, "/records")])
def test_bad_recordings(service, evolved, body, pointer):
    reply = service.request("POST", evolved["links"]["champions"], body)
    assert reply.status == 422 and reply.pointers() == [pointer], reply.body


def ask(sock, campaign, form):
    sock.sendall(f"GET {campaign['links']['phylogeny']}?format={form} HTTP/1.1\r\n"
                 "Host: localhost\r\n\r\n".encode())


def test_replies_of_many_pieces(service, large):
    path = large["links"]["phylogeny"]
    rows, cursor = service.get(path + "?limit=100").values()
    while cursor is not None:  # the others need not be checked against the contract
        connection = service.connection()
        connection.request("GET", f"{path}?limit=1000&cursor={cursor}")
        more, cursor = json.loads(connection.getresponse().read()).values()
        rows += more
        connection.close()
    assert len(rows) == 2048 * 3
    table = service.tagged(path + "?format=csv")
    assert table.headers["Transfer-Encoding"] == "chunked" and "Content-Length" not in table.headers
    compare(read_standard(table.body.decode()), rows)
    compare_newick(service.request("GET", path + "?format=newick").body.decode(), rows)
    old, ended = service.raw(f"GET {path}?format=csv HTTP/1.0\r\nHost: localhost\r\n\r\n".encode())
    assert ended and old.partition(b"\r\n\r\n")[2] == table.body


def test_readers_that_go_away(service, large):
    """Some read nothing, some a little; then they leave. The service continues and keeps nothing
    for them."""
    for form, taken in itertools.product(("csv", "newick"), 4 * (0, 1, 5000)):
        with socket.socket() as sock:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            sock.connect((service.host, service.port))
            ask(sock, large, form)
            assert not taken or sock.recv(taken)
    until(lambda: service.metric("morphod_http_requests_in_flight") == 1)


def test_exports_while_it_runs(service):
    """Each reply is a snapshot: complete and consistent, no matter how many generations are
    committed at the same time."""
    id = service.post("/v1/campaigns", LARGE | {"population": 64, "generations": 100000,
                                                "physics": {"n_steps": 20}})["id"]
    path = f"/v1/campaigns/{id}/phylogeny"
    until(lambda: len(service.table(path + "?format=csv")) >= 64)
    sizes = []
    for _ in range(5):
        taxa = read_standard(service.request("GET", path + "?format=csv").body.decode())
        forest = service.request("GET", path + "?format=newick").body.decode()
        alive = [one for one in taxa.values() if one[2] == math.inf]
        assert len(alive) == 64, "the population of the newest generation"
        assert len(taxa) % 64 == 0 and list(taxa) == list(range(len(taxa)))
        nodes, _ = read_newick(forest)
        assert len(nodes) % 64 == 0 and len(nodes) >= len(taxa)
        sizes.append(len(taxa))
    assert sizes == sorted(sizes)
    end(service, id)
    finished(service, id)


def test_a_service_that_stops_in_the_middle(start):
    """A reply that cannot be finished does not look complete: its last chunk is missing."""
    running = start()
    done = run_campaign(running, LARGE | {"generations": 1})
    with socket.socket() as sock:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
        sock.connect((running.host, running.port))
        sock.settimeout(PATIENCE_S)
        ask(sock, done, "csv")
        received = sock.recv(1000)
        running.process.terminate()
        while piece := sock.recv(65536):
            received += piece
    assert running.process.wait(timeout=300) == 0
    assert received.startswith(b"HTTP/1.1 200")
    assert received.endswith(b"\r\n0\r\n\r\n") == (received.count(b"\n4095,") == 1)
