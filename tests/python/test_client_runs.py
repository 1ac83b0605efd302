"""Campaigns, training runs, their tables and files, and lists of jobs through the package."""

import datetime
import json
import time

import morphod
import networkx
import numpy as np
import pandas
import pytest
from service import BOOTSTRAP, DESIGN, run
from test_racing import CAMPAIGN as RACED

SHORT = {"n_steps": 20}
WORLD = [{"light_xy_m": [4.5, 2.5], "terrain_sigma_m": 0.05, "seed": 7}]


def test_a_campaign_as_tables(m, service, campaign):
    group = m.campaigns(label="for tests")
    assert sorted(member.id for member in group) == sorted(campaign)
    first = m.get_campaign(campaign[0])
    rows = service.get(f"/v1/campaigns/{first.id}/generations")["items"]
    curve = first.curve()
    assert curve["score_mean"].tolist() == [row["score"]["mean"] for row in rows]
    assert curve["score_quantiles_p0"].tolist() == [row["score"]["quantiles"]["p0"] for row in rows]
    assert curve["operators_mutation_born"].tolist() == [
        row["operators"]["mutation"]["born"] for row in rows]
    assert curve["rollouts"].dtype == "int64" and curve["exhausted"].dtype == bool
    assert first.curve(stride=2)["generation"].tolist() == [0, 2, 4]
    both = m.curves(label="for tests")
    assert both.equals(group.curves()) and set(both["state"]) == {"succeeded"}
    assert len(both) == 12 and set(both["campaign"]) == set(campaign)
    assert both.groupby("generation")["score_mean"].count().tolist() == [2] * 6
    assert (m.curves(ids=[first.id])["seed"] == 1).all() and len(m.curves(label="none")) == 0
    assert len(m.curves()) >= len(both) and m.curves(ids=[]).empty
    population = first.population()
    assert len(population) == 24 and population["score"].is_monotonic_increasing
    assert len(first.population(generation=2)) == 24
    assert first.champions(3)["number"].nunique() == 3 and first.learning().empty


def test_scores_without_luck(m, service, campaign):
    """The columns are there with and without results."""
    first = m.get_campaign(campaign[0])
    plain = first.champions(3)
    names = [f"held_out_{name}" for name in ("generation", "worlds", "mean", "standard_error",
                                             "low", "high", "diverged")]
    assert plain[names].isna().all(axis=None)
    items = service.get(f"/v1/campaigns/{first.id}/champions?count=3")["items"]
    # A certificate of another test may have the same robot.
    assert [one if isinstance(one, str) else None for one in plain["certificate"]] == [
        row["certificate"] and row["certificate"]["id"] for row in items]
    group = m.campaign("zero-shot", population=20, generations=1, physics={"n_steps": 60},
                       re_evaluate={"every": 1, "environments": 5, "designs": 2})
    group.wait()
    lucky = group[0]
    certificate = m.certify(campaign=lucky.id, best=1, axes=["friction"], levels=[0.5])
    certificate.wait()
    report = certificate.report()
    items = service.get(f"/v1/campaigns/{lucky.id}/champions")["items"]
    table = lucky.champions()
    assert table["held_out_mean"].tolist() == [row["held_out"]["mean"] for row in items]
    assert (table["held_out_low"] < table["held_out_mean"]).all()
    assert (table["held_out_worlds"] == 5).all() and len(table) == 12
    certified = table[table["certificate"] == certificate.id]
    assert certified["robot"].tolist() == [report.designs[0].robot]
    assert certified["certificate_class"].tolist() == [report.designs[0].verdict_class]
    assert set(report.designs[0].worse) <= {"friction"}
    population = lucky.population()
    assert 12 <= population["held_out_mean"].notna().sum() < 20
    assert set(
        population.columns) == set(table.columns) - {"distinctiveness"}
    assert lucky.curve()["held_out_mean"].notna().all()
    assert lucky.phylogeny().frame().shape[0] == 40


def test_lists_are_saved_as_files(m, service, campaign, tmp_path):
    path = m.export("campaigns/generations", tmp_path / "two.csv", label="for tests")
    table = pandas.read_csv(path, float_precision="round_trip")
    assert table["mean"].tolist() == m.curves(label="for tests")["score_mean"].tolist()
    born = pandas.read_csv(m.export(f"campaigns/{campaign[0]}/phylogeny", tmp_path / "born.csv"))
    shown = service.get(f"/v1/campaigns/{campaign[0]}/phylogeny?limit=1000")["items"]
    assert born["genotype"].tolist() == ["g" + row["genotype"] for row in shown]
    assert born["design"].tolist() == ["d" + row["id"] for row in shown]
    lines = m.export("/v1/jobs", tmp_path / "jobs.jsonl", label="for tests")
    assert [json.loads(line)["id"] for line in lines.open()] == sorted(campaign, reverse=True)
    with pytest.raises(ValueError):
        m.export("jobs", tmp_path / "jobs.tsv")
    with pytest.raises(morphod.InvalidError):
        m.export("jobs", tmp_path / "odd.csv", state="odd")
    assert sorted(file.name for file in tmp_path.iterdir()) == ["born.csv", "jobs.jsonl", "two.csv"]


def test_bundles_travel(m, start, campaign, tmp_path):
    other = start()
    with morphod.Client(f"http://{other.host}:{other.port}") as there:
        best = m.get_campaign(campaign[0]).population()["genotype"][:2]
        seen = m.evaluate(list(best), record=["com"], physics={"n_steps": 60})
        path = m.bundle(tmp_path / "two.tar.zst", ids=campaign, recordings=True)
        table = there.verify_bundle(path)
        assert table["source_campaign"].tolist() == campaign and table["campaign"].isna().all()
        assert table["recordings"].tolist() == [1, 0]
        entered = there.import_bundle(path)
        assert [member.id for member in entered] == ["1", "3"] and entered[0].ended
        assert (there.evaluation("2").recordings("com") == seen.recordings("com")).all()
        assert there.curves(group="1")["score_mean"].tolist() == m.curves(
            ids=campaign)["score_mean"].tolist()
        assert [member.id for member in there.import_bundle(path)] == ["1", "3"]
        path.write_bytes(path.read_bytes()[:-9])
        with pytest.raises(morphod.InvalidError):
            there.import_bundle(path)
    m.get_campaign(campaign[1]).edit(experiment="that travels")
    for which, first in (({"label": "for tests"}, campaign[0]),
                         ({"experiment": "that travels"}, campaign[1])):
        assert m.import_bundle(m.bundle(path, **which))[0].id == first, "its own"


def test_scores_travel(m, start, tmp_path):
    seen = m.evaluate([[[0, 0, 0], [1, 0, 0], [1, 0, 1]]], physics={"n_steps": 61})
    other = start()
    with morphod.Client(f"http://{other.host}:{other.port}") as there:
        path = m.save_scores(tmp_path / "scores", controller="default")
        entered = there.import_scores(path)
        assert entered.new >= 10 and entered.different == 0
        all_of_it = entered.new + entered.known  # a loss can be in two rows
        assert there.import_scores(path) == morphod.Entered(known=all_of_it)
        again = there.evaluate([[[0, 0, 0], [1, 0, 0], [1, 0, 1]]], physics={"n_steps": 61})
        assert again.data["rollouts_cached"] == 10 and (again.scores == seen.scores).all()
        own = there.save_scores(tmp_path / "own", fingerprint="no such class",
                                since=datetime.datetime.now(datetime.timezone.utc))
        assert there.import_scores(own) == morphod.Entered()
        whole = path.read_bytes()
        for broken, words in ((whole[:-9], "ends early"), (whole[:7], "ends early"),
                              (b"", "its last block"), (b"x" * 12, "begins at byte 0")):
            path.write_bytes(broken)
            with pytest.raises(morphod.MorphodError, match=words):
                there.import_scores(path)
        path.write_bytes(whole[:90] + b"x" + whole[91:])
        with pytest.raises(morphod.InvalidError):
            there.import_scores(path)
    with pytest.raises(ValueError):
        m.save_scores(path, since=datetime.datetime(2026, 11, 21))


def test_a_phylogeny(m, service, campaign):
    phylogeny = m.get_campaign(campaign[0]).phylogeny()
    rows = {}
    cursor = ""
    while cursor is not None:
        page = service.get(f"/v1/campaigns/{campaign[0]}/phylogeny?format=json&limit=1000{cursor}")
        rows |= {row["number"]: row for row in page["items"]}
        cursor = page["next_cursor"] and f"&cursor={page['next_cursor']}"
    table = phylogeny.frame()
    assert table.index.tolist() == list(rows) and len(phylogeny) == len(rows)
    for number, line in table.iterrows():
        row = rows[number]
        parents = [parent for parent in (line["parent"], line["other_parent"])
                   if parent is not pandas.NA]
        assert parents == row["parents"] and line["operator"] == row["operator"]
        assert line["score"] == np.float32(row["score"]) and line["born"] == row["born"]
        assert (line["voxels"], line["footprint"]) == (row["voxels"], row["footprint"])
        assert (None if line["died"] is pandas.NA else line["died"]) == row["died"]
    graph = phylogeny.to_networkx()
    assert networkx.is_directed_acyclic_graph(graph) and set(graph.edges) == {
        (parent, number) for number, row in rows.items() for parent in row["parents"]}
    newick = service.request("GET", f"/v1/campaigns/{campaign[0]}/phylogeny?format=newick").body
    assert sorted(phylogeny.to_newick().split()) == sorted(newick.decode().split())
    youngest = max(rows)
    line = m.get_campaign(campaign[0]).ancestors(youngest)
    assert line["number"].tolist() == sorted(networkx.ancestors(graph, youngest)) + [youngest]
    for name in ("robot", "genotype", "parents", "score", "born"):
        assert line[name].tolist() == [rows[number][name] for number in line["number"]]
    with pytest.raises(morphod.NotFoundError):
        m.get_campaign(campaign[0]).ancestors(youngest + 1)
    lineages = m.get_campaign(campaign[0]).phylogeny(lineages=True)
    assert lineages.alive.sum() == phylogeny.alive.sum() and len(lineages) < len(phylogeny)


def test_a_phylogeny_with_lower_bounds(m, service):
    id = run(service, "campaigns", RACED | {"generations": 3})["id"]
    rows = service.pages(f"/v1/campaigns/{id}/phylogeny")
    phylogeny = m.get_campaign(id).phylogeny()
    table, graph = phylogeny.frame(), phylogeny.to_networkx()
    assert table["lower_bound"].dtype == bool and phylogeny.lower_bound.any()
    assert table["lower_bound"].tolist() == [row["lower_bound"] for row in rows]
    assert table["score"].tolist() == [np.float32(row["score"]) for row in rows]
    assert [graph.nodes[row["number"]]["lower_bound"] for row in rows] == [
        row["lower_bound"] for row in rows]
    assert m.get_campaign(id).curve()["children_cut"].sum() == phylogeny.lower_bound.sum()


def test_a_campaign_continues(m, capsys):
    group = m.campaign("zero-shot", preset="demo", population=8, generations=1, physics=SHORT,
                       initial=[DESIGN], environments=WORLD)
    assert group.live() is group and "2 of 2" not in capsys.readouterr().out
    own = group[0]
    assert own.data["settings"]["initial"] == {"n_designs": 1}
    own.extend(2)
    own.wait(timeout_s=300)
    assert own.data["progress"]["generation"] == 3
    more = m.campaign("zero-shot", preset="demo", population=8, generations=0, physics=SHORT,
                      initial=own, environments=WORLD)[0]
    assert more.data["settings"]["initial"] == {"campaign": own.id}
    more.wait()


def test_actions(m):
    job = m.campaign("zero-shot", preset="demo", generations=1000)[0]
    job.pause()
    assert job.state == "paused"
    job.weigh(3)
    job.resume()
    assert job.state in ("queued", "running") and job.data["weight"] == 3
    with pytest.raises(morphod.WaitError, match="it continues"):
        job.wait(timeout_s=1)
    job.cancel()
    with pytest.raises(morphod.JobError, match="was cancelled") as caught:
        job.wait()
    assert caught.value.job["id"] == job.id
    with pytest.raises(morphod.ConflictError):
        job.resume()


def test_a_training_and_its_controller(m, service, tmp_path):
    training = m.pretrain(name="small", steps=3, batch=4, physics=SHORT,
                          validation={"designs": 2, "environments": 1})
    assert training.live().state == "succeeded"
    rows = service.get(f"/v1/trainings/{training.id}/steps")["items"]
    assert training.steps()["mean_loss"].tolist() == [row["mean_loss"] for row in rows]
    assert training.validations()["step"].tolist() == [0, 3]
    learned = training.controller()
    by_name = m.controller("small")
    assert learned.content == by_name.content and by_name.arrays["net.9.bias"].shape == (1648, )
    assert by_name.metadata["sensor"] == "inverse_sqrt"
    by_name.save(tmp_path / "c.safetensors")
    assert m.put_controller("copy", tmp_path / "c.safetensors").data["sha256"] == (
        by_name.data["sha256"])
    halved = {name: array / 2 for name, array in by_name.arrays.items()}
    stored = m.put_controller("halved", halved, by_name.metadata)
    assert (m.controller("halved").arrays["net.0.bias"] == halved["net.0.bias"]).all()
    assert "halved" in m.controllers()["name"].tolist() and stored.name == "halved"
    tuned = m.finetune([DESIGN], controller="small", steps=1, batch=2, physics=SHORT)
    tuned.wait()
    with pytest.raises(morphod.MorphodError, match="not a safetensors"):
        morphod.read_safetensors(b"\x00" * 7)
    assert m.controller().content == BOOTSTRAP.read_bytes()


def test_finetuning_each_body(m, service):
    bodies = [DESIGN, [[0, 0, 0], [1, 0, 0]]]
    training = m.finetune(bodies, each=True, best=1, steps=2, batch=2, physics=SHORT,
                          validation={"environments": 2})
    training.wait()
    page = service.get(f"/v1/trainings/{training.id}/each")
    table = training.each()
    assert table["finetuned"].tolist() == [row["finetuned"] for row in page["items"]]
    assert table.attrs == page["summary"] and table.attrs["compared"] == 2
    names = [row["controller"]["name"] for row in page["items"]]
    assert len([name for name in names if name is not None]) == 1
    with pytest.raises(morphod.MorphodError, match="controller per design"):
        training.controller()


def test_events_from_the_beginning(m):
    events = m.events(after=0)
    first = next(events)
    assert first["id"] == "1" and first["type"] == "controller.stored"
    events.close()
    job = m.evaluate([DESIGN], WORLD, physics=SHORT, wait=False)
    types = []
    for event in m.events(after=0, job=job.id):
        types.append(event["type"])
        if event["type"] == "job.finished":
            break
    assert types[0] == "job.created"


def test_designs_and_jobs(m):
    m.evaluate([DESIGN])
    assert m.designs(limit=1)["score"].tolist()[0] <= 1
    m.evaluate([[[1, 1, 0], [1, 2, 0]]], physics="paper")
    paper = m.designs(physics="paper", limit=1)
    assert paper["score"].tolist() == [row["score"] for row in m.request(
        "GET", "/v1/designs", sort="score", physics="paper", limit=1)["items"]]
    assert paper["id"].tolist() != m.designs(limit=1)["id"].tolist()
    assert set(m.jobs(kind="evaluation")["kind"]) == {"evaluation"}
    assert m.request("GET", "/v1/threads")["n_threads"] == 1 and m.version()


def test_jobs_in_order(m):
    """Labels, experiments, notes, the archive, usage, deletion."""
    label = f"order {time.time()}"
    job = m.evaluate([np.ones((2, 1, 1))], label=label, experiment=label, physics={"n_steps": 23})
    assert job.experiment == label and job.note is None and job.core_seconds > 0
    job.edit(note="walks", archived=True)
    assert job.note == "walks" and job.label == label
    assert len(m.jobs(experiment=label)) == 0
    assert list(m.jobs(label=label[:-2] + "*", archived="all")["id"]) == [job.id]
    used = m.usage("experiment").set_index("name").loc[label]
    assert used["jobs"] == 1 and used["core_seconds"] == pytest.approx(job.core_seconds, abs=1e-6)
    assert [one["what"] for one in job.delete()["stays"]] == ["designs", "scores"]
    with pytest.raises(morphod.ApiError):
        job.refresh()
    assert len(m.campaigns(experiment=label)) == 0
