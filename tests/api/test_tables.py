"""Lists and curves as CSV, NDJSON and columns: the same values as in the JSON pages."""

import csv
import io
import json
import struct

import pytest

from service import DESIGN, SHORT, await_end, run

SCENE = "application/vnd.morphod.scene"
HERE = [{"light_xy_m": [4.0, 3.0], "terrain_sigma_m": 0.05, "seed": 3}]
LABEL = 'a "label", with\na line'
LISTS = ["jobs", "evaluations", "campaigns", "trainings", "designs", "designs?sort=score",
         "controllers", "campaigns/{}/population", "campaigns/{}/designs/60/ancestors",
         "campaigns/{}/designs/3/descendants", "campaigns/{}/champions",
         "campaigns/{}/environments", "campaigns/{}/checkpoints", "environment-sets/paper-test",
         "campaigns/{}/generations", "campaigns/{}/learning", "campaigns/{}/replicates",
         "campaigns/generations?label=two"]


@pytest.fixture(scope="module")
def campaign(service):
    value = {"mode": "zero-shot", "population": 16, "generations": 4, "physics": {"n_steps": 2},
             "exclude_pretraining": False, "environments": HERE, "label": "two", "replicates": 2}
    first = service.post("/v1/campaigns", value)
    for id in (first["id"], str(int(first["id"]) + 1)):
        await_end(service, f"/v1/campaigns/{id}")
    service.evaluate({"designs": [DESIGN], "physics": SHORT, "label": LABEL})
    return first["id"]


def form(service, path, format, **headers):
    query = "&" if "?" in path else "?"
    return service.request("GET", f"{path}{query}format={format}", headers=headers)


def columns(reply):
    """Returns {column: values} of the form `columns`."""
    assert reply.headers["Content-Type"] == SCENE
    length = struct.unpack("<I", reply.body[:4])[0]
    header, arrays = json.loads(reply.body[4:4 + length]), reply.body[4 + length:]
    read = {}
    for name, shown in header["columns"].items():
        if isinstance(shown, dict):
            letter = {"uint8": "B", "uint32": "I", "uint64": "Q", "float64": "d"}[shown["type"]]
            shown = struct.unpack_from(f"<{shown['shape'][0]}{letter}", arrays, shown["offset"])
        assert len(shown) == header["rows"]
        read[name] = list(shown)
    return read


def at(item, name):
    """Returns the value of a column: names of members and indices of arrays, joined by _."""
    if name in item:
        return item[name]
    for key in item:
        if name.startswith(key + "_") and item[key] is None:
            return None
        if name.startswith(key + "_") and isinstance(item[key], list):
            return item[key][int(name[len(key) + 1:])]
        if name.startswith(key + "_") and isinstance(item[key], dict):
            return at(item[key], name[len(key) + 1:])
    return None  # of jobs of another kind


def same(cell, value):
    """Returns whether a cell of CSV agrees with the JSON value."""
    if value is None:
        return cell == ""
    if isinstance(value, bool):
        return cell == str(int(value))
    if isinstance(value, (int, float)):
        return float(cell) == value
    if isinstance(value, (list, dict)):
        return json.loads(cell) == value
    letter = "d" if len(value) == 36 else "g" if len(value) == 144 else ""
    return cell in (value, letter + value)


@pytest.mark.parametrize("path", LISTS)
def test_the_same_in_every_form(service, campaign, path):
    path = "/v1/" + path.format(campaign)
    page = service.get(path)
    items = page["items"]
    while page.get("next_cursor"):
        query = "&" if "?" in path else "?"
        page = service.get(f"{path}{query}cursor={page['next_cursor']}")
        items += page["items"]
    lines = form(service, path, "ndjson")
    assert [json.loads(line) for line in lines.body.splitlines()] == items
    table = list(csv.DictReader(io.StringIO(form(service, path, "csv").body.decode(), newline=""),
                                strict=True))
    assert table == list(csv.DictReader(io.StringIO(
        service.request("GET", path, headers={"Accept": "text/csv"}).body.decode(), newline="")))
    assert len(table) == len(items)
    for name, values in columns(form(service, path, "columns")).items():
        shown = [at(item, name) for item in items]
        assert all(value == right or (right is None and value != value)
                   for value, right in zip(values, shown)), name
        if table and name in table[0]:  # curves have short names in CSV
            assert all(same(line[name], right) for line, right in zip(table, shown)), name


def test_long_lists_are_whole(service, campaign):
    """More items than fit on a page; `limit` and `cursor` work as for pages."""
    service.evaluate({"designs": [{"cells": [[x, y, z] for x in range(a) for y in range(b)
                                             for z in range(c)]}
                                  for a in range(1, 7) for b in range(1, 7) for c in range(1, 5)],
                      "physics": {"n_steps": 1}, "environments": HERE})
    run(service, "campaigns", {"mode": "zero-shot", "population": 700, "generations": 1,
                               "physics": {"n_steps": 1}, "exclude_pretraining": False,
                               "environments": HERE})
    items = service.pages("/v1/designs")
    assert len(items) > 1000
    lines = form(service, "/v1/designs", "ndjson").body.splitlines()
    assert [json.loads(line) for line in lines] == items
    assert len(columns(form(service, "/v1/designs", "columns"))["id"]) == len(items)
    page = service.get("/v1/designs?limit=5")
    rest = form(service, f"/v1/designs?limit=3&cursor={page['next_cursor']}", "ndjson")
    assert [json.loads(line) for line in rest.body.splitlines()] == items[5:8]
    packed = form(service, "/v1/designs", "ndjson", **{"Accept-Encoding": "gzip"})
    assert packed.headers["Content-Encoding"] == "gzip"


def test_no_cell_is_taken_for_a_number(service, campaign):
    for line in service.table("/v1/designs?format=csv"):
        for name in ("id", "genotype"):
            with pytest.raises(ValueError):
                float(line[name])
    labels = {line["label"] for line in service.table("/v1/jobs?format=csv")}
    assert LABEL in labels


def test_refusals_are_problems(service, campaign):
    """A list that cannot be read, and an unknown format, are refused as in JSON."""
    for query in ("?format=tsv", "?format=csv&limit=0", "?format=csv&limit=-1",
                  f"?format=ndjson&limit={2**64}", "?format=ndjson&cursor=x",
                  "?format=columns&state=odd"):
        assert service.request("GET", "/v1/jobs" + query).status == 400
    assert form(service, "/v1/campaigns/999999/population", "csv").status == 404
    assert service.request("GET", "/v1/jobs", headers={"Accept": "image/png"}).status == 406


def test_several_campaigns(service, campaign):
    path = "/v1/campaigns/generations"
    ids = [campaign, str(int(campaign) + 1)]
    rows = service.pages(f"{path}?campaigns={','.join(ids)}", 3)
    assert [(row["campaign"], row["generation"]) for row in rows] == [
        (id, generation) for id in ids for generation in range(5)]
    assert {(row["group"], row["label"], row["mode"], row["state"]) for row in rows} == {
        (campaign, "two", "zero-shot", "succeeded")}
    assert [row["replicate"] for row in rows] == [0] * 5 + [1] * 5 and rows[0]["seed"] == 1
    own = service.get(f"/v1/campaigns/{ids[1]}/generations")["items"]
    assert [{name: row[name] for name in own[0]} for row in rows[5:]] == own
    for query in (f"group={campaign}", "label=two"):
        assert service.pages(f"{path}?{query}", 1000) == rows
    assert rows[0] in service.pages(path)
    coarse = service.pages(f"{path}?group={campaign}&stride=3")
    assert [row["generation"] for row in coarse] == [0, 3] * 2
    assert service.pages(f"{path}?group={campaign}&stride=3", 1) == coarse
    one = service.get(f"/v1/campaigns/{campaign}/generations?stride=2&limit=2")
    assert [row["generation"] for row in one["items"]] == [0, 2]
    assert service.get(f"{path}?label=none")["items"] == []
    service.refuses(path, "?campaigns=x", f"?campaigns={ids[1]},{ids[0]}", f"?campaigns={ids[0]},",
                    "?campaigns=", "?label=two&group=1", "?cursor=1", "?stride=0")
    service.refuses(path, "?campaigns=999999", status=404)
    evaluation = service.evaluate({"designs": [DESIGN], "physics": SHORT}).json()["id"]
    service.refuses(path, f"?campaigns={evaluation}", status=404)


def test_wide_tables_have_their_last_column(service, campaign):
    for path, last in (("campaigns", "result_controller_sha256"),
                       ("trainings", "controller_sha256")):
        heading = service.request("GET", f"/v1/{path}?format=csv").body.split(b"\n")[0].decode()
        assert heading.split(",")[-1] == last


def test_a_phylogeny_for_trees(service, campaign):
    """parents=first names at most one parent; root=1 adds a root with an id after all others."""
    path = f"/v1/campaigns/{campaign}/phylogeny"
    plain = service.table(path + "?format=csv")
    tree = service.table(path + "?format=csv&parents=first&root=1")
    assert tree[0]["id"] == str(len(plain)) and tree[0]["operator"] == "root"
    assert tree[0]["ancestor_list"] == "[none]" and len(tree) == len(plain) + 1
    assert None not in tree[0].values(), "the root's line has fewer columns than the heading"
    for line, shown in zip(plain, tree[1:]):
        first = line["ancestor_list"].strip("[]").split(",")[0]
        assert shown == line | {
            "ancestor_list": f"[{len(plain) if first == 'none' else first}]"}
    assert service.request("GET", path + "?format=csv").headers["ETag"] != service.request(
        "GET", path + "?format=csv&root=1").headers["ETag"]
    lines = service.request("GET", path + "?format=ndjson").body.splitlines()
    assert [json.loads(line) for line in lines] == service.pages(path)
    service.refuses(path, "?root=1", "?format=newick&parents=first", "?format=csv&root=2")


def test_events_are_a_table_too(service, campaign):
    table = service.table(f"/v1/events?format=csv&job={campaign}")
    items = service.pages(f"/v1/events?format=json&job={campaign}")
    assert [line["type"] for line in table] == [item["type"] for item in items]
    assert json.loads(table[0]["data"]) == items[0]["data"]
