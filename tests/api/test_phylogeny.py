"""What was born in a campaign: populations, designs and their lineage, the phylogeny in all its
forms, champions."""

import csv
import io
import json
import re
import socket
import time

import pytest
from service import DESIGN
from test_campaigns import HERE, LEARNS, SMALL, but, ended, finished, run

LARGE = {
    "mode": "zero-shot", "population": 2048, "generations": 2, "environments": HERE,
    "physics": {"n_steps": 2}
}


def items(service, path, limit=1000):
    """All pages of a list."""
    found, cursor = [], ""
    while cursor is not None:
        page = service.request("GET", f"{path}?limit={limit}" +
                               (f"&cursor={cursor}" if cursor else "")).json()
        found += page["items"]
        cursor = page["next_cursor"]
    return found


@pytest.fixture(scope="module")
def evolved(service):
    return run(
        service,
        but(SMALL, population=12, generations=6, initial={"designs": [DESIGN]}, label="lineage"))


@pytest.fixture(scope="module")
def designs(service, evolved):
    return items(service, evolved["links"]["phylogeny"])


@pytest.fixture(scope="module")
def large(service):
    """More designs than a reply holds in one piece."""
    return run(service, LARGE)


def test_every_design(evolved, designs):
    assert [row["number"] for row in designs] == list(range(
        evolved["progress"]["designs"])) and len(designs) == 84
    assert len({row["id"] for row in designs}) == 84, "no form is born twice"
    for row in designs:
        parents = {"random": 0, "listed": 0, "inherited": 0, "mutation": 1,
                   "crossover": 2}[row["operator"]]
        assert len(row["parents"]) == parents and all(parent < row["number"]
                                                      for parent in row["parents"])
        assert all(designs[parent]["born"] < row["born"]
                   for parent in row["parents"]) and row["born"] == row["number"] // 12
        assert all(designs[parent]["died"] is None or designs[parent]["died"] >= row["born"]
                   for parent in row["parents"]), "parents lived"
        assert row["died"] is None or row["died"] >= row["born"]
        assert row["genotype"].count(
            "1") == row["voxels"] and row["footprint"] <= row["voxels"] and row["score"] > 0
    assert designs[0]["operator"] == "listed" and {row["operator"]
                                                   for row in designs[1:12]} == {"random"}


def test_pages(service, evolved, designs):
    path = evolved["links"]["phylogeny"]
    for limit in (1, 5, 84, 85):
        assert items(service, path, limit) == designs
    reply = service.request("GET", path)
    assert len(reply.json()["items"]) == 84 and reply.json()["next_cursor"] is None
    assert service.request("GET", path,
                           headers={"If-None-Match": reply.headers["ETag"]}).status == 304
    assert service.request("GET", path + "?cursor=83").json() == {"items": [], "next_cursor": None}
    for bad in ("?limit=0", "?limit=1001", "?cursor=x", "?cursor=-1", "?format=nexus", "?after=3",
                "?format=csv&limit=5", "?format=newick&cursor=5"):
        assert service.request("GET", path + bad).status == 400, bad
    for accept in ("image/png", "application/xml"):
        assert service.request("GET", path, headers={"Accept": accept}).status == 406


def read_standard(text):
    """A phylogeny by the ALife data standard (https://alife-data-standards.github.io): its rules,
    and what follows from them."""
    rows = list(csv.DictReader(io.StringIO(text), strict=True))
    assert {"id", "ancestor_list", "origin_time", "destruction_time"} <= set(rows[0])
    taxa = {}
    for row in rows:
        assert re.fullmatch("[0-9]+", row["id"]) and int(
            row["id"]) not in taxa, "ids are unique integers"
        assert re.fullmatch(r"\[(none|[0-9]+(,[0-9]+)*)\]",
                            row["ancestor_list"]), row["ancestor_list"]
        ancestors = [] if row["ancestor_list"] == "[none]" else json.loads(row["ancestor_list"])
        origin, destruction = float(row["origin_time"]), float(row["destruction_time"])
        assert origin >= 0 and destruction >= origin and len(row) == 12 and None not in row
        taxa[int(row["id"])] = (ancestors, origin, destruction, row)
    for ancestors, origin, _, _ in taxa.values():
        for ancestor in ancestors:
            assert ancestor in taxa and taxa[ancestor][1] < origin and taxa[ancestor][
                2] >= origin, "every ancestor exists, is older, and lived"
    return taxa


def compare(taxa, designs):
    assert list(taxa) == [row["number"] for row in designs]
    for row in designs:
        ancestors, origin, destruction, cells = taxa[row["number"]]
        assert ancestors == row["parents"] and origin == row["born"] and destruction == (
            float("inf") if row["died"] is None else row["died"])
        assert cells["operator"] == row["operator"] and cells[
            "design"] == "d" + row["id"] and cells["genotype"] == "g" + row["genotype"]
        assert (float(cells["score"]) if cells["score"] else None) == row["score"]
        assert [int(cells[key]) for key in ("voxels", "footprint", "masses", "springs")
                ] == [row[key] for key in ("voxels", "footprint", "masses", "springs")]


def test_standard_csv(service, evolved, designs):
    path = evolved["links"]["phylogeny"]
    for table in (service.request("GET", path + "?format=csv"),
                  service.request("GET", path, headers={"Accept": "text/csv"})):
        assert table.headers["Content-Type"].startswith(
            "text/csv") and table.headers["Vary"] == "Accept"
        compare(read_standard(table.body.decode()), designs)
    cells = list(read_standard(table.body.decode()).values())[3][3]
    for column in (cells["design"], cells["genotype"]
                   ):  # no reader of tables takes them for numbers, and requests take them
        with pytest.raises(ValueError):
            float(column)
    both = service.evaluate({
        "designs": [{"id": cells["design"]}, {"voxels": cells["genotype"]}],
        "physics": {"n_steps": 5}
    })
    assert [
        row["id"] for row in both.json()["results"]
    ] == [designs[3]["id"]] * 2 and both.json()["results"][1]["genotype"] == designs[3]["genotype"]
    assert service.request("GET", f"/v1/designs/{cells['design']}").json()["id"] == designs[3]["id"]
    again = service.request("GET",
                            path + "?format=csv",
                            headers={"If-None-Match": table.headers["ETag"]})
    assert again.status == 304 and again.body == b""
    assert service.request("HEAD", path + "?format=csv").headers["ETag"] == table.headers["ETag"]


def read_newick(text):
    """{number: (parent or None, branch length or None)} and the order of each one's children."""
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
    path = evolved["links"]["phylogeny"] + "?format=newick"
    reply = service.request("GET", path)
    assert reply.headers["Content-Type"].startswith("text/x-nh")
    compare_newick(reply.body.decode(), designs)
    assert service.request("GET", path,
                           headers={"If-None-Match": reply.headers["ETag"]}).status == 304
    assert service.request("GET", evolved["links"]["phylogeny"],
                           headers={"Accept": "text/x-nh"}).body == reply.body


def test_population(service, evolved, designs):
    path = evolved["links"]["population"]
    rows = service.request("GET",
                           "/v1/campaigns/{}/generations".format(evolved["id"])).json()["items"]
    for generation in range(7):
        page = service.request("GET", f"{path}?generation={generation}").json()
        assert page["generation"] == generation and page["size"] == len(
            page["items"]) == 12 and page["next_cursor"] is None
        scores = [row["score"] for row in page["items"]]
        assert scores == sorted(
            scores) and scores[0] == rows[generation]["score"]["quantiles"]["p0"]
        assert abs(sum(scores) / 12 - rows[generation]["score"]["mean"]) < 1e-12
        alive = {
            row["number"]
            for row in designs
            if row["born"] <= generation and (row["died"] is None or row["died"] > generation)
        }
        assert {row["number"] for row in page["items"]} == alive
    newest = service.request("GET", path)
    assert newest.json() == page and service.request(
        "GET", path, headers={"If-None-Match": newest.headers["ETag"]}).status == 304
    first = service.request("GET", path + "?limit=5").json()
    second = service.request("GET", f"{path}?limit=5&cursor={first['next_cursor']}").json()
    third = service.request("GET",
                            f"{path}?limit=5&generation=6&cursor={second['next_cursor']}").json()
    assert first["items"] + second["items"] + third["items"] == page["items"] and third[
        "next_cursor"] is None
    assert service.request("GET", path + "?generation=7").status == 404
    for bad in ("?generation=-1", "?generation=x", "?limit=0", "?cursor=5", "?cursor=6-x",
                "?cursor=-", f"?generation=5&cursor={first['next_cursor']}", "?best=3"):
        assert service.request("GET", path + bad).status == 400, bad


def test_scores_are_those_of_an_evaluation(service, evolved):
    best = service.request("GET", evolved["links"]["population"] + "?limit=3").json()["items"]
    value = {
        "designs": [{"voxels": row["genotype"]} for row in best], "environments": HERE,
        "physics": {"n_steps": 30}
    }
    evaluation = service.evaluate(value).json()
    assert [result["score"] for result in evaluation["results"]] == [row["score"] for row in best]
    assert [result["id"] for result in evaluation["results"]
            ] == [row["id"] for row in best] and evaluation["rollouts_cached"] == 3


def test_lineage(service, evolved, designs):
    base = f"/v1/campaigns/{evolved['id']}/designs"
    children, ancestors = {row["number"]: [] for row in designs}, {}
    for row in designs:
        ancestors[row["number"]] = set(row["parents"]).union(*(ancestors[parent]
                                                               for parent in row["parents"]))
        for parent in row["parents"]:
            children[parent].append(row["number"])
    for number in (0, 5, 11, 12, 40, 83, max(children, key=lambda one: len(children[one]))):
        reply = service.request("GET", f"{base}/{number}")
        value = reply.json()
        young = value.pop("children")
        assert value == {"campaign": evolved["id"], **designs[number]}
        assert young == {
            "items": [designs[child] for child in children[number]], "next_cursor": None
        }
        assert service.request("GET",
                               f"{base}/{number}",
                               headers={"If-None-Match": reply.headers["ETag"]}).status == 304
        for below, expected in (("ancestors", ancestors[number]),
                                ("descendants",
                                 {one
                                  for one in ancestors if number in ancestors[one]})):
            found = items(service, f"{base}/{number}/{below}", 3)
            assert found == [designs[one] for one in sorted(expected)], (number, below)
            assert service.request(
                "GET", f"{base}/{number}/{below}?limit=1").json()["total"] == len(expected)
        page = service.request("GET", f"{base}/{number}?limit=1").json()["children"]
        assert page["items"] == young["items"][:1] and (page["next_cursor"] is None) == (len(
            young["items"]) <= 1)
        if page["next_cursor"] is not None:
            assert service.request("GET", f"{base}/{number}?cursor={page['next_cursor']}").json(
            )["children"]["items"] == young["items"][1:]
    for bad in ("84", "4294967295", "99999999999999999999", "x", "-1", "007", "1.5"):
        for below in ("", "/ancestors", "/descendants"):
            assert service.request("GET", f"{base}/{bad}{below}").status == 404, bad
    for bad in ("?limit=0", "?cursor=x", "?generation=1"):
        for below in ("", "/ancestors", "/descendants"):
            assert service.request("GET", f"{base}/0{below}{bad}").status == 400, bad


def test_designs_know_their_campaigns(service, evolved, designs):
    for row in (designs[0], designs[50]):
        value = service.request("GET", f"/v1/designs/{row['id']}").json()
        mine = [one for one in value["campaigns"] if one["campaign"] == evolved["id"]]
        assert mine == [{
            "campaign": evolved["id"],
            **{key: row[key]
               for key in ("number", "parents", "operator", "born", "died", "score")}
        }]
        assert [int(one["campaign"]) for one in value["campaigns"]
                ] == sorted(int(one["campaign"]) for one in value["campaigns"])
    learned = run(service, but(LEARNS, generations=1))
    for row in service.request("GET", learned["links"]["phylogeny"]).json()["items"]:
        value = service.request("GET", f"/v1/designs/{row['id']}").json()
        assert {"campaign": learned["id"], "number": row["number"]
                }.items() <= value["campaigns"][-1].items() and value["voxels"] == row["voxels"]
    alone = service.evaluate({
        "designs": [{"cells": [[x, 0, 0] for x in range(6)] + [[5, 1, 0], [5, 1, 1]]}],
        "physics": {"n_steps": 5}
    }).json()
    assert service.request("GET",
                           f"/v1/designs/{alone['results'][0]['id']}").json()["campaigns"] == []


def test_champions(service, evolved):
    path = evolved["links"]["champions"]
    reply = service.request("GET", path)
    value = reply.json()
    population = service.request("GET", evolved["links"]["population"]).json()["items"]
    assert value["generation"] == 6 and len(value["items"]) == 12
    assert {row["number"] for row in value["items"]} == {row["number"] for row in population}
    distances = [row["distinctiveness"] for row in value["items"]]
    assert distances == sorted(distances, reverse=True) and distances[-1] > 0
    genotypes = [row["genotype"] for row in value["items"]]
    for row in value["items"]:
        mean = sum(sum(a != b for a, b in zip(row["genotype"], other))
                   for other in genotypes) / 11 / 144
        assert abs(row["distinctiveness"] - mean) < 1e-12
    few = service.request("GET", path + "?count=3&generation=2").json()
    assert few["generation"] == 2 and len(few["items"]) == 3
    best = service.request("GET",
                           evolved["links"]["population"] + "?generation=2").json()["items"][0]
    assert best["number"] in [row["number"] for row in few["items"]]
    assert service.request("GET", path,
                           headers={"If-None-Match": reply.headers["ETag"]}).status == 304
    assert service.request("GET", path + "?generation=7").status == 404
    for bad in ("?count=0", "?count=1001", "?count=x", "?generation=-1", "?limit=3"):
        assert service.request("GET", path + bad).status == 400, bad


@pytest.mark.parametrize("mode", ["zero-shot", "few-shot"])
def test_champions_are_recorded(service, evolved, mode):
    done = evolved if mode == "zero-shot" else run(service, but(LEARNS, mode=mode))
    reply = service.request("POST", done["links"]["champions"], {"count": 3, "stride": 5})
    assert reply.status == 202, reply.body
    value = reply.json()
    assert reply.headers["Location"] == f"/v1/evaluations/{value['id']}" and value["record"] == [
        "com"
    ] and value["record_stride"] == 5
    assert value["priority"] == "interactive"
    evaluation = service.request("GET", reply.headers["Location"],
                                 headers={"Prefer": "wait=30"}).json()
    champions = service.request("GET", done["links"]["champions"] + "?count=3").json()["items"]
    assert [result["genotype"]
            for result in evaluation["results"]] == [row["genotype"] for row in champions]
    assert [result["score"] for result in evaluation["results"]
            ] == [row["score"] for row in champions], "with the controller that scored them"
    track = service.request("GET", f"/v1/evaluations/{value['id']}/trajectories/2").json()
    assert track["frames"] == 7 and len(track["com_m"]) == 7


@pytest.mark.parametrize("body, pointer", [([], ""), ({"count": 0}, "/count"),
                                           ({"count": 1001}, "/count"), ({"count": "3"}, "/count"),
                                           ({"stride": 0}, "/stride"), ({"stride": 1.5}, "/stride"),
                                           ({"record": ["com"]}, "/record")])
def test_bad_recordings(service, evolved, body, pointer):
    reply = service.request("POST", evolved["links"]["champions"], body)
    assert reply.status == 422 and reply.pointers() == [pointer], reply.body


def test_replies_of_many_pieces(service, large):
    rows, cursor = service.request("GET",
                                   large["links"]["phylogeny"] + "?limit=100").json().values()
    while cursor is not None:  # the contract need not be held against each of the others
        connection = service.connection()
        connection.request("GET", f"{large['links']['phylogeny']}?limit=1000&cursor={cursor}")
        more, cursor = json.loads(connection.getresponse().read()).values()
        rows += more
        connection.close()
    assert len(rows) == 2048 * 3
    table = service.request("GET", large["links"]["phylogeny"] + "?format=csv")
    assert table.headers["Transfer-Encoding"] == "chunked" and "Content-Length" not in table.headers
    compare(read_standard(table.body.decode()), rows)
    assert service.request("GET",
                           large["links"]["phylogeny"] + "?format=csv",
                           headers={"If-None-Match": table.headers["ETag"]}).status == 304
    assert service.request("HEAD", large["links"]["phylogeny"] + "?format=csv").body == b""
    compare_newick(
        service.request("GET", large["links"]["phylogeny"] + "?format=newick").body.decode(), rows)
    old = service.raw(
        f"GET {large['links']['phylogeny']}?format=csv HTTP/1.0\r\nHost: localhost\r\n\r\n".encode(
        ))
    assert old[1] and old[0].partition(b"\r\n\r\n")[2] == table.body


def test_readers_that_go_away(service, large):
    """Some read nothing, some a little; then they leave. The service goes on and keeps nothing of
    them."""
    for form in ("csv", "newick"):
        for taken in (0, 1, 5000):
            for _ in range(4):
                with socket.socket() as sock:
                    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
                    sock.connect((service.host, service.port))
                    sock.sendall(
                        f"GET {large['links']['phylogeny']}?format={form} HTTP/1.1\r\nHost: "
                        f"localhost\r\n\r\n"
                        .encode())
                    if taken:
                        assert sock.recv(taken)
    deadline = time.monotonic() + 20
    while True:
        text = service.request("GET", "/metrics").body.decode()
        if "\nmorphod_http_requests_in_flight 1\n" in text:
            break
        assert time.monotonic() < deadline, text
        time.sleep(0.05)


def test_exports_while_it_runs(service):
    """Each is of one moment: complete and consistent, however many generations come meanwhile."""
    id = service.request("POST", "/v1/campaigns",
                         but(LARGE, population=64, generations=100000,
                             physics={"n_steps": 20})).json()["id"]
    path = f"/v1/campaigns/{id}/phylogeny"
    deadline = time.monotonic() + 30
    sizes = []
    while len(sizes) < 5:
        assert time.monotonic() < deadline
        taxa = service.request("GET", path + "?format=csv").body.decode()
        forest = service.request("GET", path + "?format=newick").body.decode()
        if taxa.count("\n") < 65:
            time.sleep(0.05)
            continue
        taxa = read_standard(taxa)
        alive = [
            origin for _, origin, destruction, _ in taxa.values() if destruction == float("inf")
        ]
        assert len(taxa) % 64 == 0 and list(taxa) == list(range(
            len(taxa))) and len(alive) == 64, "the population of the newest generation told"
        nodes, _ = read_newick(forest)
        assert len(nodes) % 64 == 0 and len(nodes) >= len(taxa)
        sizes.append(len(taxa))
    assert sizes == sorted(sizes)
    ended(service, [id])
    finished(service, id)


def test_a_service_that_stops_in_the_middle(start):
    """A reply that cannot be finished does not look finished: its last chunk is missing."""
    running = start()
    done = run(running, but(LARGE, generations=1))
    with socket.socket() as sock:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
        sock.connect((running.host, running.port))
        sock.settimeout(20)
        sock.sendall(
            f"GET {done['links']['phylogeny']}?format=csv HTTP/1.1\r\nHost: localhost\r\n\r\n".
            encode())
        received = sock.recv(1000)
        running.process.terminate()
        while (piece := sock.recv(65536)):
            received += piece
    assert running.process.wait(timeout=30) == 0
    assert received.startswith(b"HTTP/1.1 200") and (received.endswith(b"\r\n0\r\n\r\n")
                                                     == (received.count(b"\n4095,") == 1))
