"""Bodies that are generated on request but not stored."""

from service import DESIGN

APART = {"cells": [[0, 0, 0], [1, 0, 0], [3, 3, 0]]}


def voxels(genotype):
    return {place for place, digit in enumerate(genotype) if digit == "1"}


def test_random_bodies(service):
    items = service.post("/v1/bodies/random", {"count": 300, "seed": 5})["items"]
    assert len({item["id"] for item in items}) == 300
    assert items[:7] == service.post("/v1/bodies/random", {"count": 7, "seed": 5})["items"]
    assert items[0] != service.post("/v1/bodies/random", {"seed": 6})["items"][0]
    for item in items[:20]:
        assert item["voxels"] == len(voxels(item["genotype"])) and item["parents"] == []
        assert item["footprint"] == len({place // 4 for place in voxels(item["genotype"])})
    # The reply describes a body exactly as scoring does.
    scored = service.evaluate({"designs": [{"voxels": item["genotype"]} for item in items[:9]],
                               "physics": {"n_steps": 1}}).json()["results"]
    for item, row in zip(items, scored):
        assert {key: row[key] for key in item if key != "parents"} == {
            key: item[key] for key in item if key != "parents"
        }
    largest = max(items[9:], key=lambda item: item["voxels"])
    service.refuses(f"/v1/designs/{largest['id']}", "", status=404)  # nothing is stored


def test_random_bodies_from_an_offset(service):
    def draw(**request):
        return service.post("/v1/bodies/random", dict(request, seed=9))["items"]

    items = draw(count=2000)
    assert draw(first=0, count=2000) == items
    # Forward, backward, and with a gap, whatever stream the previous request left.
    for first, count in ((0, 100), (100, 50), (150, 1), (1990, 10), (60, 90), (151, 3), (700, 300)):
        assert draw(first=first, count=count) == items[first:first + count]
    service.post("/v1/bodies/random", {"count": 3, "seed": 8})
    assert draw(first=3, count=4) == items[3:7]
    for faulty in ({"first": 999_999, "count": 2}, {"first": -1}):
        reply = service.request("POST", "/v1/bodies/random", faulty)
        assert reply.status == 422 and reply.json()["errors"][0]["pointer"] == "/first"


def test_mutants(service):
    parents = service.post("/v1/bodies/random", {"count": 20, "seed": 1})["items"]
    request = {"designs": [{"id": item["id"]} for item in parents], "seed": 3, "children": 4}
    items = service.post("/v1/bodies/mutate", request)["items"]
    assert items == service.post("/v1/bodies/mutate", request)["items"]
    assert [item["parents"] for item in items] == [[place // 4] for place in range(80)]
    assert len({item["id"] for item in items + parents}) == 100  # all of them are new
    wild = service.post("/v1/bodies/mutate", dict(request, rate=0.3))["items"]
    assert wild != items
    assert sum(item["voxels"] for item in wild) != sum(item["voxels"] for item in items)
    # Parents that are not bodies have no children; repaired ones do.
    items = service.post("/v1/bodies/mutate", {
        "designs": [DESIGN, {"cells": [[0, 0, 9]]}, APART], "children": 2, "on_fault": "skip",
        "repair": "largest"
    })["items"]
    assert [item["id"] is None for item in items] == [False, False, True, True, False, False]
    assert items[2]["fault"]["pointer"] == "/designs/1/cells/0/2" and items[4]["repaired"] == 1


def test_crossed_bodies(service):
    designs = [DESIGN, {"cells": [[2, 2, 0], [2, 3, 0]]}, DESIGN, {"voxels": "2"}]
    items = service.post("/v1/bodies/cross", {
        "designs": designs, "pairs": [[0, 1], [1, 0], [0, 2], [0, 3]], "on_fault": "skip"
    })["items"]
    placed = service.post("/v1/bodies/canonical", {"designs": [DESIGN, designs[1]]})["items"]
    assert items[0]["genotype"] == items[1]["genotype"] and items[1]["parents"] == [1, 0]
    assert 0 < items[0]["voxels"] <= placed[0]["voxels"] + placed[1]["voxels"]
    assert items[2]["fault"]["pointer"] == "/pairs/2" and items[2]["genotype"] is None
    assert items[3]["fault"]["pointer"] == "/designs/3/voxels"


def test_canonical_forms(service):
    turned = {"cells": [[y + 1, x, z] for x, y, z in DESIGN["cells"]]}
    request = {"designs": [DESIGN, turned, APART], "repair": "largest"}
    items = service.post("/v1/bodies/canonical", request)["items"]
    assert items[0] == items[1] and items[2]["repaired"] == 1 and items[2]["voxels"] == 2
    digits = items[0]["genotype"]
    assert items[0]["id"] == f"{int(digits, 2):036x}"
    assert service.post("/v1/bodies/canonical",
                        {"designs": [{"id": items[0]["id"]}]})["items"] == items[:1]


def test_refusals(service):
    for path, value, pointers in [
        ("random", {"count": 0}, ["/count"]), ("random", {"count": 10001}, ["/count"]),
        ("random", {"designs": []}, ["/designs"]), ("mutate", {}, [""]),
        ("mutate", {"designs": [DESIGN], "rate": 0}, ["/rate"]),
        ("mutate", {"designs": [DESIGN] * 3, "children": 5000}, ["/children"]),
        ("cross", {"designs": [DESIGN]}, [""]),
        ("cross", {"designs": [DESIGN], "pairs": [[0, 1], [1, 0]]}, ["/pairs/0/1", "/pairs/1/0"]),
        ("cross", {"designs": [DESIGN], "pairs": [[0], [0, 0, 0], 7]},
         ["/pairs/0", "/pairs/1", "/pairs/2"]),
        ("canonical", {"designs": [APART]}, ["/designs/0/cells/2"])
    ]:
        reply = service.request("POST", f"/v1/bodies/{path}", value)
        assert reply.status == 422 and reply.pointers() == pointers, (path, value)
