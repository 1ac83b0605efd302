"""Atlases: all queries, compared with a plain reading of the file; storing, replacing and deleting
files; files that are not atlases."""

import concurrent.futures
import itertools
import json
import math
import os
import pathlib
import random
import re
import socket
import struct
import time

import pytest

from atlases import INFINITY, Plain, file_of, write
from ctl import ctl  # noqa: F401
from service import await_end

FILE = {"Content-Type": "application/octet-stream"}
OF = "/v1/atlases/five"


def put(service, name, data):
    return service.request("PUT", f"/v1/atlases/{name}/file", body=data, headers=FILE)


@pytest.fixture(scope="module")
def plain():
    return Plain(file_of(levels=20))  # some scores are equal


@pytest.fixture(scope="module")
def atlas(service, plain):
    """The path of an atlas with all bodies of at most five voxels."""
    assert put(service, "five", file_of(levels=20)).status in (200, 201)
    return OF


def cases(plain):
    """Bodies of all sizes, some that diverged, the best and the worst."""
    chosen = random.Random(1).sample(range(len(plain.scores)), 20)
    diverged = [i for i, score in enumerate(plain.scores) if score == INFINITY]
    return sorted({0, 1, 2, 123, plain.order[0], plain.order[-1], *diverged[:2], *chosen})


def test_description(service, atlas, plain):
    shown = service.get(atlas)
    assert shown["name"] == "five" and shown["bytes"] == len(file_of(levels=20))
    assert shown["workspace"] == list(plain.sides) and shown["voxels_max"] == 5
    assert shown["controller"] == plain.controller and shown["physics"] == plain.physics
    assert shown["fingerprint"] == "invented losses" and shown["orientations"] == "canonical"
    assert shown["environments"] == service.get("/v1/environment-sets/paper-test")["items"]
    assert shown["bodies"] == 124 and [size["bodies"] for size in shown["sizes"]] == plain.counts
    assert shown["best"] == plain.body(plain.order[0])
    for size in shown["sizes"]:
        of_size = plain.size(size["voxels"])
        assert size["best"] == plain.body(of_size[0])
        middle = [plain.scores[of_size[(len(of_size) - k) // 2]] for k in (1, 0)]
        assert size["median"] == (None if INFINITY in middle else sum(middle) / 2)
    listed = service.get("/v1/atlases")
    assert service.get(atlas) in listed["items"] and listed["unreadable"] == []
    service.tagged(atlas)
    service.tagged("/v1/atlases")


def test_where_a_body_stands(service, atlas, plain):
    for position in cases(plain):
        of_size = plain.size(len(plain.voxels[position]))
        rank, percentile = plain.rank(position, of_size)
        for steps in (("add", "remove"), ("add", "remove", "move"), ("move", )):
            given = "" if steps == ("add", "remove") else f"&steps={','.join(steps)}"
            shown = service.get(f"{atlas}/body?position={position}{given}")
            neighbors = plain.neighbors(position, steps)
            best = min((plain.scores[i] for i in neighbors), default=INFINITY)
            losses = [None if loss == INFINITY else loss for loss in plain.losses[position]]
            basin, optimum = shown.pop("basin"), shown.pop("optimum")
            assert (basin is None) == (optimum is None)
            assert shown == plain.body(position) | {
                "of_size": {"rank": rank, "bodies": len(of_size), "percentile": percentile},
                "losses": losses, "best_of_size": plain.body(of_size[0]),
                "best_changes": [plain.body(i) | {"step": step} for i, step in
                                 itertools.islice(neighbors.items(), 8)],
                "is_optimum": best >= plain.scores[position]}
    assert len(service.get(f"{atlas}/body?position=5&changes=2")["best_changes"]) == 2
    assert service.get(f"{atlas}/body?position=5&changes=0")["best_changes"] == []


def test_a_body_in_any_notation(service, atlas, plain):
    for position in (0, 5, 40, 100):
        body = plain.body(position)
        shown = service.get(f"{atlas}/body?design={body['id']}")
        assert shown["position"] == position
        form = {"designs": [{"voxels": body["genotype"]}]}
        for image in range(8):
            robot = f"{body['id']}@{image}"
            if service.request("GET", f"/v1/designs/{robot}/body").status != 200:
                continue  # the image does not fit
            genotype = service.get(f"/v1/designs/{robot}/body")["genotype"]
            for design in (robot, robot.upper(), "d" + robot, genotype):
                assert service.get(f"{atlas}/body?design={design}") == shown, design
        moved = "0000" + body["genotype"][:-4]  # one voxel along y; the forms have room
        assert service.get(f"{atlas}/body?design={moved}") == shown
        assert service.post("/v1/bodies/canonical", form)["items"][0]["id"] == body["id"]


def test_neighbors(service, atlas, plain):
    for position in cases(plain):
        for steps in (("add", ), ("remove", ), ("move", ), ("add", "remove", "move")):
            items = service.get(f"{atlas}/neighbors?position={position}"
                                f"&steps={','.join(steps)}")["items"]
            expected = plain.neighbors(position, steps)
            assert items == [plain.body(i) | {"step": expected[i]} for i in expected]


def test_ascent(service, atlas, plain):
    for position, steps in itertools.product(cases(plain), (("add", "remove"), ("add", "move"))):
        path = plain.ascend(position, steps)
        shown = service.get(f"{atlas}/ascent?position={position}&steps={','.join(steps)}")
        assert shown == {"items": [plain.body(i) for i in path], "bodies_on_path": len(path),
                         "optimum": plain.body(path[-1])}


def test_similar(service, atlas, plain):
    for position in cases(plain):
        distances = {}
        for i in plain.neighbors(position):
            distances[i] = 1
        for i in list(distances):
            for k in plain.neighbors(i):
                distances.setdefault(k, 2)
        distances.pop(position, None)
        expected = [plain.body(i) | {"distance": distances[i]} for i in plain.order
                    if i in distances]
        assert service.get(f"{atlas}/similar?position={position}&limit=1000")["items"] == expected
        assert service.get(f"{atlas}/similar?position={position}&limit=3")["items"] == expected[:3]


def test_the_best(service, atlas, plain):
    finite = [i for i in plain.order if plain.scores[i] < INFINITY]
    assert service.pages(f"{atlas}/best", 50) == [plain.body(i) for i in plain.order]
    assert service.pages(f"{atlas}/best?voxels=4") == [plain.body(i) for i in plain.size(4)]
    middle = plain.scores[finite[40]]
    assert plain.scores[finite[0]] < middle < plain.scores[finite[-1]]
    for lo, hi in itertools.product((None, middle, 0.4), (None, middle + 0.1, 5)):
        chosen = [i for i in plain.order if (lo is None or plain.scores[i] >= lo) and
                  (hi is None or plain.scores[i] < hi)]
        given = "".join(f"&{name}={value!r}" for name, value in (("lo", lo), ("hi", hi))
                        if value is not None)
        page = service.get(f"{atlas}/best?limit=1000{given}")
        assert page["items"] == [plain.body(i) for i in chosen], given
        assert page["bodies"] == len(chosen) and page["next_cursor"] is None
    page = service.get(f"{atlas}/best?limit=7&cursor=100")
    assert page["items"] == [plain.body(i) for i in plain.order[100:107]]
    assert page["next_cursor"] == "107" and page["bodies"] == 124
    assert service.get(f"{atlas}/best?cursor=124")["items"] == []


def test_histogram(service, atlas, plain):
    finite = [score for score in plain.scores if score < INFINITY]
    for query in ("", "?bins=1", "?bins=7", "?bins=1024", "?lo=0.4&hi=0.5&bins=4", "?voxels=4",
                  "?lo=0.45&bins=3&voxels=5"):
        shown = service.get(f"{atlas}/histogram{query}")
        edges = [struct.unpack("f", struct.pack("f", edge))[0] for edge in shown["edges"]]
        assert edges == sorted(edges) and len(edges) - 1 == len(shown["counts"][0])
        if "lo" not in query:
            assert edges[0] == min(finite) and max(finite) < edges[-1] < max(finite) + 1e-6
        for size, counts, outside in zip(shown["sizes"], shown["counts"], shown["outside"]):
            scores = [plain.scores[i] for i in plain.size(size)]
            assert counts == [sum(low <= score < high for score in scores)
                              for low, high in itertools.pairwise(edges)]
            assert sum(counts) + outside == len(scores)
        assert shown["sizes"] == ([int(query.split("voxels=")[1])] if "voxels" in query
                                  else [1, 2, 3, 4, 5])


def test_footprints(service, atlas, plain):
    best = {}
    for i in plain.order:
        best.setdefault(len({v // 4 for v in plain.voxels[i]}), []).append(i)
    assert service.get(f"{atlas}/footprints")["items"] == [
        {"footprint": n, "bodies": len(best[n]), "best": plain.body(best[n][0])}
        for n in sorted(best)]


def test_optima(service, plain):
    assert put(service, "optima", file_of(levels=20)).status in (200, 201)
    of = "/v1/atlases/optima"
    ends = [plain.ascend(i)[-1] for i in range(124)]
    largest = sorted(set(ends), key=lambda i: (-ends.count(i), plain.scores[i], i))
    assert service.get(of)["optima"] is None
    assert service.get(f"{of}/body?position=3")["basin"] is None
    for limit in (1, 3, 500):
        listed = largest[:limit]
        shown = service.get(f"{of}/optima?limit={limit}")
        assert shown["optima"] == len(largest)
        assert shown["items"] == [plain.body(i) | {"basin": ends.count(i)} for i in listed]
        touching = {}
        for i in range(124):
            for k in plain.neighbors(i):
                pair = tuple(sorted(listed.index(ends[body]) if ends[body] in listed else -1
                                    for body in (i, k)))
                if i < k and pair[0] >= 0 and pair[0] != pair[1]:
                    touching[pair] = touching.get(pair, 0) + 1
        assert shown["edges"] == [[*pair, touching[pair]] for pair in sorted(touching)]
        assert limit < 500 or touching
    assert service.get(of)["optima"] == len(largest)
    for position in range(124):
        shown = service.get(f"{of}/body?position={position}&changes=0")
        assert shown["basin"] == ends.count(position)
        assert shown["optimum"] == plain.body(ends[position])


def tau(pairs):
    """Kendall's tau-b by its definition."""
    balance = ties = others = 0
    for (a, b), (c, d) in itertools.combinations(pairs, 2):
        first, second = (a > c) - (a < c), (b > d) - (b < d)
        balance += first * second
        ties += first == 0
        others += second == 0
    n = len(pairs) * (len(pairs) - 1) / 2
    untied = (n - ties) * (n - others)
    return balance / math.sqrt(untied) if untied > 0 else None


@pytest.mark.parametrize("other", [
    {"levels": 20, "seed": 2}, {"levels": 1000, "seed": 3, "voxels": 4}, {"levels": 20},
    {"levels": 1}])
def test_comparison(service, atlas, plain, other):
    """With other scores, fewer voxels, itself, and one in which all scores are equal."""
    assert put(service, "other", file_of(**other)).status in (200, 201)
    second = Plain(file_of(**other))
    n = min(len(plain.scores), len(second.scores))
    pairs = list(zip(plain.scores[:n], second.scores[:n]))
    finite = [pair for pair in pairs if INFINITY not in pair]
    for of, a, b in (("five", 0, 1), ("other", 1, 0)):
        name = "other" if of == "five" else "five"
        shown = service.get(f"/v1/atlases/{of}/compare?with={name}&bins=6")
        assert (shown["a"], shown["b"], shown["bodies"]) == (of, name, n)
        assert shown["outside"] == n - len(finite)
        expected = tau([(pair[a], pair[b]) for pair in pairs])
        assert (shown["kendall_tau"] is None if expected is None else
                math.isclose(shown["kendall_tau"], expected, rel_tol=1e-12, abs_tol=1e-15))
        edges = [[struct.unpack("f", struct.pack("f", edge))[0] for edge in shown[which]]
                 for which in ("edges_a", "edges_b")]
        assert shown["counts"] == [
            [sum(edges[0][i] <= pair[a] < edges[0][i + 1] and
                 edges[1][k] <= pair[b] < edges[1][k + 1] for pair in finite) for k in range(6)]
            for i in range(6)]
        assert sum(map(sum, shown["counts"])) == len(finite)


def test_what_is_refused(service, atlas):
    service.refuses(f"{atlas}/body", "", "?position=124", "?position=-1", "?design=12",
                    f"?design={'0' * 144}", f"?design={'1' + '0' * 142 + '1'}",
                    f"?position=1&design={'1' + '0' * 143}", "?position=1&steps=",
                    "?position=1&steps=add,", "?position=1&steps=jump", "?position=1&changes=65",
                    "?id=1")
    service.refuses(f"{atlas}/best", "?voxels=6", "?voxels=0", "?limit=0", "?limit=1001",
                    "?cursor=-1", "?lo=x", "?lo=nan", "?lo=inf", "?lo=0x1", "?lo=", "?lo=1&hi=1",
                    "?hi=1e99")
    service.refuses(f"{atlas}/histogram", "?bins=0", "?bins=1025", "?lo=2", "?hi=-1")
    service.refuses(f"{atlas}/optima", "?limit=0", "?limit=501")
    service.refuses(f"{atlas}/compare", "", "?with=five&bins=257")
    service.refuses(f"{atlas}/compare", "?with=none", "?with=../five", status=404)
    for below in ("", "/body?position=1", "/file", "/optima", "/best"):
        service.refuses("/v1/atlases/none" + below, "", status=404)
    for name in ("Five", "five.atlas", "-five", "a" * 65, "%2e%2e", "f%2Fg"):
        service.refuses(f"/v1/atlases/{name}", "", "/file", status=404)
        assert service.request("DELETE", f"/v1/atlases/{name}").status == 404
        assert put(service, name, file_of()).status == 422
    six = service.request("GET", f"{atlas}/body?design={'1' * 6 + '0' * 138}")
    assert six.status == 404 and "6 voxels" in six.json()["detail"]  # 4 + 2 of the next column


def test_files(service, tmp_path):
    """Storing, replacing, sending and deleting; the folder has nothing else afterward."""
    first, second = file_of(seed=4), file_of(seed=5, voxels=4, orientations="images")
    made = put(service, "mine", first)
    assert made.status == 201 and made.headers["Location"] == "/v1/atlases/mine"
    assert made.json() == service.get("/v1/atlases/mine")
    sent = service.tagged("/v1/atlases/mine/file")
    assert sent.body == first and sent.headers["Content-Type"] == "application/octet-stream"
    assert put(service, "mine", first).status == 200
    replaced = put(service, "mine", second)
    assert replaced.status == 200 and replaced.json()["voxels_max"] == 4
    assert replaced.json()["orientations"] == "images"
    assert service.request("GET", "/v1/atlases/mine/file").body == second
    assert service.get("/v1/atlases/mine/best")["bodies"] == 29
    assert service.request("PUT", "/v1/atlases/mine/file", body=first,
                           headers={"Content-Type": "application/json"}).status == 415
    assert service.request("DELETE", "/v1/atlases/mine").status == 204
    assert service.request("DELETE", "/v1/atlases/mine").status == 404
    service.refuses("/v1/atlases/mine", "", "/file", "/best", status=404)
    folder = service.state / "atlases"
    assert all(path.suffix == ".atlas" for path in folder.iterdir())
    assert not (folder / "mine.atlas").exists()


def test_files_that_are_refused(service):
    good = bytearray(file_of())
    assert put(service, "kept", bytes(good)).status == 201
    for damaged, word in (
            (b"", "not an atlas"), (b"{}", "not an atlas"), (good[:-1], "bytes"),
            (good[:100], "truncated"), (good + b"\0", "bytes"),
            (good[:5000] + bytes([good[5000] ^ 1]) + good[5001:], "damaged"),
            (good[:20] + b"\x09" + good[21:], "version 9"),
            (file_of(voxels=3, side=4), "4 × 4 × 4")):
        reply = put(service, "kept", bytes(damaged))
        assert reply.status == 422 and word in reply.json()["detail"], (word, reply.body)
        assert put(service, "another", bytes(damaged)).status == 422
    assert service.request("GET", "/v1/atlases/kept/file").body == bytes(good)
    service.refuses("/v1/atlases/another", "", status=404)
    service.request("DELETE", "/v1/atlases/kept")


def test_files_from_elsewhere(start):
    """The service notices files that are put into the folder, changed and removed, and reports
    those that it cannot use; a good one repairs a name."""
    service = start()
    folder = service.state / "atlases"
    assert service.get("/v1/atlases") == {"items": [], "unreadable": []}
    write(folder / "a.atlas", seed=1)
    first = service.get("/v1/atlases/a/body?position=7")
    (folder / "a.atlas").unlink()
    write(folder / "a.atlas", seed=2)
    assert service.get("/v1/atlases/a/body?position=7") != first
    (folder / "b.atlas").write_bytes(file_of()[:-8])
    write(folder / "c.atlas", voxels=2, side=3)
    (folder / "notes.txt").write_text("not an atlas")
    (folder / "d.atlas.part").write_bytes(b"unfinished")
    for _ in range(2):
        listed = service.get("/v1/atlases")
        assert [item["name"] for item in listed["items"]] == ["a"]
        assert [(item["name"], item["bytes"]) for item in listed["unreadable"]] == [
            (name, (folder / f"{name}.atlas").stat().st_size) for name in ("b", "c")]
    reply = service.request("GET", "/v1/atlases/b/body?position=1")
    assert reply.status == 500 and "atlases/b.atlas" in reply.json()["detail"]
    assert put(service, "b", file_of()).status == 200
    assert service.get("/v1/atlases/b/body?position=1")["position"] == 1
    assert service.request("DELETE", "/v1/atlases/c").status == 204
    assert service.get("/v1/atlases")["unreadable"] == []


def count_mapped(service):
    """Returns how many copies of atlas files the service has mapped, and that of no file itself."""
    maps = pathlib.Path(f"/proc/{service.process.pid}/maps").read_text()
    assert ".atlas" not in maps
    return len(re.findall(r"/atlases/\.tmp-\w+ \(deleted\)$", maps, re.M))


def make_socket(path):
    with socket.socket(socket.AF_UNIX) as made:
        made.bind(os.path.relpath(path))  # a path of a socket must be short


def make_unreadable(path):
    path.touch(0o000)
    if os.geteuid() == 0:  # may read everything
        path.unlink()
        path.symlink_to(path.name)


# What to make, and what is said about it.
ODD = {
    "directory": (pathlib.Path.mkdir, "is a directory, not a file: move it elsewhere"),
    "pipe": (os.mkfifo, "is a pipe, a socket or a device, not a file: remove it"),
    "socket": (make_socket, "is a pipe, a socket or a device, not a file: remove it"),
    "device": (lambda path: path.symlink_to("/dev/zero"), "a device, not a file: remove it"),
    "dangling": (lambda path: path.symlink_to("nothing"), "is a link to a file that does not"),
    "unreadable": (make_unreadable, "cannot be read: check its owner and its permissions"),
    "empty": (pathlib.Path.touch, "is not an atlas file: check its name"),
    "later": (lambda path: path.write_bytes(file_of()[:20] + b"\x09" + file_of()[21:]),
              "has version 9; this program reads versions 1 and 2"),
}


def test_entries_that_are_no_atlases(start):
    """Each is listed with what it is, and hides no other; nothing waits for a pipe. A good file
    replaces all but a directory, and so does deletion."""
    service = start()
    folder = service.state / "atlases"
    write(folder / "a.atlas", seed=1)
    for name, (make, _) in ODD.items():
        make(folder / f"{name}.atlas")
    listed = service.get("/v1/atlases")
    assert [item["name"] for item in listed["items"]] == ["a"]
    assert [item["name"] for item in listed["unreadable"]] == sorted(ODD)
    for item in listed["unreadable"]:
        assert ODD[item["name"]][1] in item["reason"], item
        assert item["bytes"] == (len(file_of()) if item["name"] == "later" else 0)
    for name, (make, words) in ODD.items():
        path = folder / f"{name}.atlas"
        for below in ("", "/body?position=1", "/optima", *([] if path.is_file() else ["/file"])):
            reply = service.request("GET", f"/v1/atlases/{name}{below}")
            assert reply.status == 500 and words in reply.json()["detail"], (name, reply.body)
        reply = service.request("GET", f"/v1/atlases/a/compare?with={name}")
        assert reply.status == 500 and words in reply.json()["detail"]
        reply = service.request("POST", "/v1/trainings", {
            "kind": "finetune", "population": {"atlas": name, "count": 2}})
        assert reply.status == 409 and words in reply.json()["detail"], reply.body
        reply = service.request("POST", "/v1/atlases", {"voxels": 1, "name": name})
        assert reply.status == 409 and "already exists" in reply.json()["detail"], reply.body
        if name == "directory":
            for reply in (put(service, name, file_of()),
                          service.request("DELETE", f"/v1/atlases/{name}")):
                assert reply.status == 409 and words in reply.json()["detail"], reply.body
            path.rmdir()
            service.refuses(f"/v1/atlases/{name}", "", status=404)
            continue
        assert put(service, name, file_of()).status == 200
        assert service.get(f"/v1/atlases/{name}/body?position=1")["position"] == 1
        path.unlink()
        make(path)
        assert service.request("DELETE", f"/v1/atlases/{name}").status == 204
        assert not path.is_symlink() and not path.exists()
    assert service.get("/v1/atlases")["unreadable"] == []


def ticks(service):
    """Returns the processor time that the service has used, in hundredths of a second."""
    fields = pathlib.Path(f"/proc/{service.process.pid}/stat").read_text().split()
    return int(fields[13]) + int(fields[14])


def test_files_that_change_while_they_are_used(start):
    """Overwritten in place or truncated, as by cp, in the middle of a query of seconds: the query
    ends as if nothing had happened, and later ones see what the file is now."""
    service = start()
    path = service.state / "atlases" / "a.atlas"
    write(path, voxels=9, seed=1)
    optima = service.get("/v1/atlases/a/optima?limit=9")
    good = path.read_bytes()
    for change in (lambda: path.write_bytes(b""), lambda: os.truncate(path, 5000),
                   lambda: path.write_bytes(file_of(seed=5))):
        path.unlink()
        path.write_bytes(good)
        inode = path.stat().st_ino
        service.get("/v1/atlases/a/best?limit=1")  # opens and sorts it
        with concurrent.futures.ThreadPoolExecutor(1) as pool:
            before = ticks(service)
            asked = pool.submit(service.get, "/v1/atlases/a/optima?limit=9")
            while ticks(service) < before + 3 and not asked.done():
                time.sleep(0.001)  # it takes thirty
            change()
            assert asked.result() == optima and path.stat().st_ino == inode
    plain = Plain(file_of(seed=5))
    assert service.get("/v1/atlases/a/best?limit=1")["items"] == [plain.body(plain.order[0])]
    path.write_bytes(good[:-8])
    assert "should have" in service.request("GET", "/v1/atlases/a").json()["detail"]


def test_deleted_files_are_closed(start):
    service = start()
    folder = service.state / "atlases"
    for name in "abc":
        write(folder / f"{name}.atlas", seed=1)
        service.get(f"/v1/atlases/{name}/body?position=7")
    assert count_mapped(service) == 3
    (folder / "a.atlas").unlink()
    assert service.request("DELETE", "/v1/atlases/b").status == 204
    assert count_mapped(service) == 1


def test_many_at_once(service):
    """More files than are kept open, replaced and deleted while requests use them: every reply is
    that of one of the files that the name had."""
    seeds = range(2)
    best = {seed: Plain(file_of(seed=seed)) for seed in seeds}
    expected = [plain.body(plain.order[0]) for plain in best.values()]
    names = [f"many-{i}" for i in range(7)]

    def use(i):
        name, drawn = names[i % 7], random.Random(i)
        if i % 10 == 0:
            reply = put(service, name, file_of(seed=drawn.choice(seeds)))
            assert reply.status in (200, 201, 409), reply.body  # 409: deleted at once
            return
        if i % 31 == 0:
            assert service.request("DELETE", f"/v1/atlases/{name}").status in (204, 404)
            return
        what = drawn.choice(("/best?limit=1", "/optima?limit=1", "", "/compare?with=many-1&bins=2"))
        reply = service.request("GET", f"/v1/atlases/{name}{what}")
        assert reply.status in (200, 404), reply.body
        if what[:5] == "/best" and reply.status == 200:
            assert reply.json()["items"][0] in expected

    with concurrent.futures.ThreadPoolExecutor(8) as pool:
        list(pool.map(use, range(200)))
    for name in names:
        service.request("DELETE", f"/v1/atlases/{name}")


def test_a_restart_keeps_them(start, tmp_path):
    state = tmp_path / "state"
    service = start(state=state)
    assert put(service, "kept", file_of()).status == 201
    before = service.get("/v1/atlases/kept")
    service.stop()
    (state / "atlases" / ".tmp-7").write_bytes(b"left by a crash")
    service = start(state=state)
    assert service.get("/v1/atlases/kept") == before
    assert [path.name for path in (state / "atlases").iterdir()] == ["kept.atlas"]


def test_a_built_one(service):
    """An atlas of a task that a job builds: its scores are those of an evaluation, and losses have
    the unit of the task."""
    settings = {"physics": {"n_steps": 50}, "environments": "morpho-12-walk"}
    job = service.post("/v1/atlases", {"name": "built", "voxels": 2,
                                       "orientations": "canonical", **settings})["id"]
    assert await_end(service, f"/v1/jobs/{job}").json()["state"] == "succeeded"
    for body in service.get("/v1/atlases/built/best")["items"]:
        shown = service.get(f"/v1/atlases/built/body?design={body['id']}")
        designs = [{"id": body["id"] + "@0"}]
        result = service.evaluate({"designs": designs, **settings}).json()["results"][0]
        assert math.isclose(shown["score"], result["score"], rel_tol=1e-6)
        assert shown["unit"] == result["unit"]
        assert math.isclose(shown["value"], result["value"], rel_tol=1e-2, abs_tol=1e-3)
        for loss, exact in zip(shown["losses"], result["losses"]):
            assert math.isclose(loss["loss"], exact["loss"], rel_tol=2**-11)
    assert put(service, "built", file_of()).status == 200  # the job has ended
    assert service.request("DELETE", "/v1/atlases/built").status == 204


def test_a_name_that_a_job_builds(service):
    job = service.post("/v1/atlases", {"name": "busy", "voxels": 9})["id"]
    reply = put(service, "busy", file_of())
    assert reply.status == 409 and f"job {job}" in reply.json()["detail"]
    service.refuses("/v1/atlases/busy", "", "/file", status=404)
    service.withdraw(job)
    await_end(service, f"/v1/jobs/{job}")
    assert put(service, "busy", file_of()).status == 201
    assert service.request("DELETE", "/v1/atlases/busy").status == 204


def memory(service):
    """Returns the resident bytes that do not belong to a file."""
    text = pathlib.Path(f"/proc/{service.process.pid}/status").read_text()
    return 1024 * int(re.search(r"RssAnon:\s+(\d+) kB", text)[1])


def test_memory(start):
    """All bodies of ten voxels, in five files: more than may be open, and more than the memory for
    indices and basins holds. The service's memory grows by at most 20 MB."""
    service = start()
    folder = service.state / "atlases"
    write(folder / "a.atlas", voxels=10, levels=10**6)
    for name in "bcde":
        os.link(folder / "a.atlas", folder / f"{name}.atlas")
    put(service, "small", file_of())
    for path in ("/small/body?position=1", "/small/optima", "/small/compare?with=small"):
        service.get("/v1/atlases" + path)
    before = memory(service)
    for name, path in (("a", "body?position=9"), ("a", "optima?limit=20"), ("b", "best?limit=9"),
                       ("a", "compare?with=b&bins=8"), ("c", "histogram?bins=8"),
                       ("c", "footprints"), ("d", "similar?position=700000&limit=9"),
                       ("e", "ascent?position=0"),
                       ("a", "body?position=1000000")):
        service.get(f"/v1/atlases/{name}/{path}")
        assert memory(service) - before < 20e6, (name, path)
    mapped = count_mapped(service)
    assert len(service.get("/v1/atlases")["items"]) == 6
    assert 1 <= mapped <= 4
    assert memory(service) - before < 20e6


# ---- morphoctl ----


def test_commands(service, atlas, plain, ctl, tmp_path):  # noqa: F811
    def run(command, *arguments):
        code, out, err = ctl("atlas " + command, *arguments)
        assert code == 0, err
        return out

    best = plain.body(plain.order[0])
    words = ["five", "5", "124", "canonical", "10", f"{best['score']:.4f}", "0.0", "MB"]
    assert words in [line.split()[:8] for line in run("list").splitlines()]
    shown = run("show five")
    assert f"best           {best['id']}, score {best['score']:.4f}" in shown
    assert json.loads(run("show five --json")) == service.get(atlas)
    body = plain.body(40)
    for given in (["--position", "40"], [body["id"]], [body["genotype"]]):
        assert f"rank           {body['rank']}, better than " in run("body five", *given)
    assert json.loads(run("body five --json --steps move --changes 3", body["id"])) == service.get(
        f"{atlas}/body?position=40&steps=move&changes=3")
    neighbors = plain.neighbors(40, ("add", "move"))
    lines = run("neighbors five --position 40 --steps add,move").splitlines()[1:]
    assert [line.split()[0] for line in lines] == list(neighbors.values())
    assert [line.split()[-1] for line in lines] == [plain.body(i)["id"] for i in neighbors]
    path = [line.split()[-1] for line in run("ascent five --position 40").splitlines()[1:]]
    assert path == [plain.body(i)["id"] for i in plain.ascend(40)]
    assert "\n1 body; the last one" in "\n" + ctl(
        f"atlas ascent five --position {plain.order[0]}")[2]
    similar = service.get(f"{atlas}/similar?position=40&limit=5")["items"]
    assert [line.split()[-1] for line in
            run("similar five --position 40 -n 5").splitlines()[1:]] == [b["id"] for b in similar]
    assert [line.split()[-1] for line in run("best five --voxels 4 -n 9").splitlines()[1:]] == [
        plain.body(i)["id"] for i in plain.size(4)[:9]]
    assert len(run("best five --limit 200").splitlines()) == 125
    assert len(run("optima five -n 2").splitlines()) == 3
    assert len(run("histogram five --bins 7").splitlines()) == 8  # and one for diverged bodies
    file = tmp_path / "mine.atlas"
    run("download five --output", str(file))
    assert file.read_bytes() == file_of(levels=20)
    assert "124 bodies" in run("upload from-morphoctl", str(file))
    assert service.get("/v1/atlases/from-morphoctl")["bodies"] == 124
    assert "Kendall's tau  1.0000" in run("compare five from-morphoctl --bins 4")
    run("delete from-morphoctl")
    for command, code, words in (
            ("show from-morphoctl", 3, 'no atlas "from-morphoctl"'), ("body five", 2, "--position"),
            ("body five --position 3 " + body["id"], 2, "not both"),
            ("body five " + "1" * 144, 3, "144 voxels"),
            ("upload five /dev/null", 6, "not an atlas"),
            ("neighbors five --position 3 --steps up", 6, "steps")):
        got, _, err = ctl("atlas " + command)
        assert got == code and words in err, (command, got, err)
