"""`"aggregate"` of campaigns: how the losses of a design over the environments become its score."""

import csv
import io
import math

import pytest

from archives import altered, pack, put, unpack
from ctl import ctl  # noqa: F401
from service import Service, await_end, awaited, run
from test_bundles import enter
from test_campaign_measures import BODIES, FAR, LEARNING, STUDY, history, tell
from test_campaign_measures import CAMPAIGN as FREE
from test_racing import CAMPAIGN as RACED, CONTROLLER, LIVES

CAMPAIGN = RACED | {"generations": 3}
QUANTILE = {"kind": "quantile", "level": 0.95}
CVAR = {"kind": "cvar", "level": 0.75}
MEAN_SD = {"kind": "mean-sd", "weight": 1.5}
ALL = [QUANTILE, CVAR, MEAN_SD]
kinds = pytest.mark.parametrize("aggregate", ALL, ids=lambda value: value["kind"])


def mean_of(losses):
    total = 0.0
    for loss in losses:  # sum() would compensate rounding errors
        total += loss
    return total / len(losses)


def score_of(aggregate, losses):
    """Returns the score by the definition, in the order of rounding that docs/evolution.md
    gives."""
    n, kind, ordered = len(losses), aggregate["kind"], sorted(losses)
    if kind == "mean":
        return mean_of(losses)
    if kind == "quantile":
        place = aggregate["level"] * (n - 1)
        below = math.floor(place)
        share = place - below
        return ((1 - share) * ordered[below] + share * ordered[below + 1] if share > 0
                else ordered[below])
    if kind == "cvar":
        before = aggregate["level"] * n
        first = math.ceil(before)
        if first == n:
            return ordered[-1]
        total = (first - before) * ordered[first - 1] if first > 0 else 0
        for loss in ordered[first:]:
            total += loss
        return total / (n - before)
    mean, squares = mean_of(losses), 0.0
    for loss in losses:
        squares += (loss - mean) * (loss - mean)
    return mean + aggregate["weight"] * math.sqrt(squares / (n - 1))


@pytest.fixture(scope="module", name="raced")
def racing_service():
    """A service with the controller of the races."""
    running = Service(CONTROLLER)
    yield running
    assert running.close() == 0, running.log_text()


@pytest.fixture(scope="module", name="whole")
def other_service():
    """Another one, without its scores."""
    running = Service(CONTROLLER)
    yield running
    assert running.close() == 0, running.log_text()


@pytest.fixture(scope="module", name="full")
def campaigns_without_races(whole):
    """Returns a campaign of each kind."""
    return {one["kind"]: run(whole, "campaigns", CAMPAIGN | {
        "aggregate": one, "racing": "off", "seed": 20 + i}) for i, one in enumerate(ALL)}


def lives(service, id):
    return [[row[name] for name in LIVES] for row in service.pages(f"/v1/campaigns/{id}/phylogeny")]


def listed_losses(service, row):
    """Returns the losses that the page of a design lists for this orientation; None: not computed,
    or diverged."""
    found, = [one["scores"] for one in service.get(f"/v1/designs/{row['id']}")["orientations"]
              if one["genotype"] == row["genotype"]]
    assert len(found) == 1
    return found[0]["losses"]


def evaluated_losses(service, rows, **more):
    """Returns the losses of designs of FREE from an evaluation."""
    value = run(service, "evaluations", {
        "designs": [{"voxels": row["genotype"]} for row in rows], "physics": FREE["physics"],
        "environments": FREE["environments"], **more})
    return [row["losses"] for row in value["results"]]


# ---- scores ----

@kinds
def test_scores_follow_from_the_losses(whole, full, aggregate):
    """Every score, to the last bit; the population is the best of parents and children."""
    value = full[aggregate["kind"]]
    path = f"/v1/campaigns/{value['id']}"
    assert value["settings"]["aggregate"] == aggregate and value["settings"]["racing"] == "off"
    rows = whole.pages(path + "/phylogeny")
    assert len(rows) == 48 and not any(row["lower_bound"] for row in rows)
    differs = 0
    for row in rows:
        losses = listed_losses(whole, row)
        assert len(losses) == 10 and row["score"] == score_of(aggregate, losses)
        differs += row["score"] != mean_of(losses)
    assert differs > 40
    best = sorted(rows, key=lambda row: (row["score"], row["number"]))[:12]
    population = whole.get(path + "/population")["items"]
    assert [row["number"] for row in population] == [row["number"] for row in best]
    curve = whole.pages(path + "/generations")
    assert curve[-1]["score"]["quantiles"]["p0"] == best[0]["score"]
    champion, = whole.get(path + "/champions?count=1")["items"]
    assert champion["number"] == best[0]["number"] and champion["score"] == best[0]["score"]


def test_the_mean_is_the_default(service):
    """It is what a campaign without the setting does, and its bundle has the same settings."""
    campaigns = [run(service, "campaigns", FREE | {"seed": 31} | more)
                 for more in ({}, {"aggregate": "mean"}, {"aggregate": {"kind": "mean"}})]
    assert [one["settings"]["aggregate"] for one in campaigns] == [{"kind": "mean"}] * 3
    plain, *others = [history(service, one["id"])[1:] for one in campaigns]
    assert others == [plain, plain]
    for row in plain[0]:
        if row["died"] is None:
            assert row["score"] == mean_of(evaluated_losses(service, [row])[0])
    for one in campaigns:
        members = dict(unpack(service.request("GET", f"/v1/bundles?campaigns={one['id']}").body))
        assert b"aggregate" not in members[f"campaigns/{one['id']}/campaign.json"]


def test_a_word_has_the_usual_number(service):
    for word, usual in (("quantile", {"level": 0.9}), ("cvar", {"level": 0.9}),
                        ("mean-sd", {"weight": 1})):
        for given in (word, {"kind": word}):
            value = run(service, "campaigns", FREE | {"aggregate": given, "generations": 0})
            assert value["settings"]["aggregate"] == {"kind": word} | usual


@kinds
def test_a_diverged_design_has_no_score(service, aggregate):
    value = run(service, "campaigns", {
        "mode": "zero-shot", "population": 8, "generations": 1, "aggregate": aggregate,
        "exclude_pretraining": False, "physics": {
            "integrator": "paper", "dt_s": 0.05, "control_period_s": 0.05, "n_steps": 400}})
    rows = service.pages(f"/v1/campaigns/{value['id']}/phylogeny")
    assert rows and {(row["score"], row["lower_bound"]) for row in rows} == {(None, False)}


@kinds
def test_parents_that_learn_are_scored_again(service, aggregate):
    """The survivors' scores follow from the losses under the newest weights."""
    name = f"robust-{aggregate['kind']}"
    value = run(service, "campaigns", LEARNING | {"name": name, "aggregate": aggregate})
    population = service.get(f"/v1/campaigns/{value['id']}/population")["items"]
    assert [row["score"] for row in population] == [
        score_of(aggregate, losses)
        for losses in evaluated_losses(service, population, controller=name)]


def test_a_table_of_several_campaigns_says_so(service, bundle):
    """Their scores are not comparable."""
    ids = [*bundle[0], run(service, "campaigns", FREE | {"generations": 0})["id"]]
    path = f"/v1/campaigns/generations?campaigns={','.join(ids)}"
    words = dict(zip(ids, ["quantile 0.95", "cvar 0.75", "mean-sd 1.5", None]))
    assert {(row["campaign"], row["aggregate"]) for row in service.get(path)["items"]} == set(
        words.items())
    text = service.request("GET", path + "&format=csv").body.decode()
    for row in csv.DictReader(io.StringIO(text)):
        assert row["aggregate"] == (words[row["campaign"]] or "")


# ---- racing ----

@pytest.mark.parametrize("aggregate", [QUANTILE, CVAR], ids=lambda value: value["kind"])
def test_races_change_no_survivor(raced, whole, full, aggregate):
    """A bound is the score with 0 for the losses that were not computed."""
    value = run(raced, "campaigns", CAMPAIGN | {
        "aggregate": aggregate, "seed": 20 + ALL.index(aggregate)})
    assert value["settings"]["racing"] == "lossless"
    id, same = value["id"], full[aggregate["kind"]]["id"]
    assert lives(raced, id) == lives(whole, same)
    for generation in range(4):
        path = f"population?generation={generation}"
        assert raced.get(f"/v1/campaigns/{id}/{path}") == whole.get(
            f"/v1/campaigns/{same}/{path}")
    rows = raced.pages(f"/v1/campaigns/{id}/phylogeny")
    for row, known in zip(rows, whole.pages(f"/v1/campaigns/{same}/phylogeny"), strict=True):
        losses = listed_losses(raced, row)
        assert row["lower_bound"] == (None in losses)
        assert row["score"] == score_of(aggregate, [loss or 0 for loss in losses])
        assert row["score"] <= known["score"]
    cut = sum(row["lower_bound"] for row in rows)
    assert cut >= 10, "most children are far worse than the worst parent"


def test_no_race_without_bounds(raced):
    """The settings say that the campaign does not race, and it does not."""
    value = run(raced, "campaigns", CAMPAIGN | {
        "aggregate": MEAN_SD, "seed": 22, "generations": 2})
    assert value["settings"]["racing"] == "off"
    curve = raced.pages(f"/v1/campaigns/{value['id']}/generations")
    assert [row["children_cut"] for row in curve] == [0] * 3
    assert [row["rollouts"] for row in curve] == [10 * row["born"] for row in curve]


# ---- refusals ----

@pytest.mark.parametrize("more, pointer, words", [
    ({"aggregate": "median"}, "/aggregate", '"mean", "quantile", "cvar" or "mean-sd"'),
    ({"aggregate": 3}, "/aggregate", "or an object with kind"),
    ({"aggregate": None}, "/aggregate", "or an object with kind"),
    ({"aggregate": {"level": 0.5}}, "/aggregate", "kind is missing"),
    ({"aggregate": {"kind": "worst"}}, "/aggregate/kind", '"cvar"'),
    ({"aggregate": {"kind": "mean", "level": 0.5}}, "/aggregate/level",
     "the aggregate mean has no level"),
    ({"aggregate": {"kind": "cvar", "weight": 1}}, "/aggregate/weight",
     "the aggregate cvar has no weight"),
    ({"aggregate": {"kind": "mean-sd", "level": 0.5}}, "/aggregate/level", "has no level"),
    ({"aggregate": {"kind": "cvar", "level": 1.5}}, "/aggregate/level", "at most 1, got 1.5"),
    ({"aggregate": {"kind": "quantile", "level": -0.1}}, "/aggregate/level", "at least 0"),
    ({"aggregate": {"kind": "mean-sd", "weight": -1}}, "/aggregate/weight", "at least 0"),
    ({"aggregate": {"kind": "cvar", "share": 1}}, "/aggregate/share", "level"),
    ({"aggregate": CVAR, "select_by": FAR}, "/aggregate", "with select_by"),
    ({"aggregate": MEAN_SD, "racing": "lossless"}, "/racing", "cannot race"),
    ({"aggregate": MEAN_SD, "environments": FREE["environments"][:1]}, "/aggregate",
     "at least two environments")])
def test_refusals(service, more, pointer, words):
    reply = service.request("POST", "/v1/campaigns", FREE | more)
    assert reply.status == 422 and reply.pointers() == [pointer], reply.json()
    assert words in reply.json()["errors"][0]["detail"], reply.json()


def test_what_goes_together(service):
    """The mean with a measure to select by; mean-sd without racing; one environment."""
    for more in ({"aggregate": "mean", "select_by": FAR}, {"aggregate": MEAN_SD, "racing": "off"},
                 {"aggregate": CVAR, "environments": FREE["environments"][:1]},
                 {"aggregate": CVAR, "measures": ["work_j"]}):
        run(service, "campaigns", FREE | more | {"generations": 0})


# ---- studies ----

@kinds
def test_a_study_scores_by_it(service, aggregate):
    id = service.post("/v1/campaigns", STUDY | {"aggregate": aggregate})["id"]
    told = tell(service, id, 0, [{"body": body} for body in BODIES])
    for row in told:
        assert row["score"] == score_of(aggregate, row["losses"])
    population = service.get(f"/v1/campaigns/{id}/population")["items"]
    assert [row["score"] for row in population] == sorted(row["score"] for row in told)


def test_a_study_with_its_own_score_has_none(service):
    reply = service.request("POST", "/v1/campaigns", STUDY | {
        "aggregate": CVAR, "own_score": {"name": "effort", "unit": "J"}})
    assert reply.status == 422 and reply.pointers() == ["/aggregate"]
    assert "with own_score" in reply.json()["errors"][0]["detail"]


def test_a_study_is_found_by_it(service):
    one = STUDY | {"label": "robust", "if_exists": "return", "aggregate": CVAR}
    id = service.post("/v1/campaigns", one)["id"]
    assert service.post("/v1/campaigns", one)["id"] == id
    for other in (QUANTILE, {"kind": "cvar", "level": 0.5}, "mean"):
        reply = service.request("POST", "/v1/campaigns", one | {"aggregate": other})
        assert reply.status == 409 and reply.pointers() == ["/aggregate"], reply.json()


# ---- restarts and bundles ----

@kinds
@pytest.mark.parametrize("mode", [FREE, LEARNING], ids=lambda value: value["mode"])
def test_a_stop_in_the_middle_changes_nothing(start, tmp_path, mode, aggregate):
    value = mode | {"aggregate": aggregate, "physics": {"n_steps": 1500}}
    whole = start("--workers=2")
    expected = history(whole, run(whole, "campaigns", value)["id"])
    first = start("--workers=2", state=tmp_path)
    path = f"/v1/campaigns/{first.post('/v1/campaigns', value)['id']}"
    awaited(first, path, lambda now: now["phase"] == "scoring" and now["progress"]["done"] and
            (now["progress"]["generation"] or 0) >= 1)
    assert first.stop() == 0, first.log_text()
    last = start("--workers=1", state=tmp_path)
    assert last.get(path)["settings"]["aggregate"] == aggregate
    assert await_end(last, path).json()["state"] == "succeeded"
    assert history(last, path.rsplit("/", 1)[1])[1:] == expected[1:]


@pytest.fixture(scope="module", name="bundle")
def bundle_of_each_kind(service):
    ids = [run(service, "campaigns", FREE | {"aggregate": aggregate, "seed": 50 + i})["id"]
           for i, aggregate in enumerate(ALL)]
    return ids, service.request("GET", f"/v1/bundles?campaigns={','.join(ids)}").body


def test_bundles_keep_it(service, start, bundle):
    """The other service lists the same settings and scores, sends the same bundle, and continues
    the campaign with the same results."""
    ids, sent = bundle
    other = start()
    reply = enter(other, sent)
    assert reply.status == 201, reply.body
    for old, item, aggregate in zip(ids, reply.json()["items"], ALL, strict=True):
        new = item["campaign"]
        assert history(service, old) == history(other, new)
        settings = other.get(f"/v1/campaigns/{new}")["settings"]
        assert settings == service.get(f"/v1/campaigns/{old}")["settings"]
        assert settings["aggregate"] == aggregate
        ends = []
        for one, id in ((other, new), (service, old)):
            one.post(f"/v1/campaigns/{id}/extend", {"generations": 1})
            assert await_end(one, f"/v1/campaigns/{id}").json()["state"] == "succeeded"
            ends.append([row["number"] for row in
                         one.get(f"/v1/campaigns/{id}/population")["items"]])
        assert ends[0] == ends[1]
    assert enter(other, sent, "verify").status == 200


@pytest.mark.parametrize("place", range(3), ids=[value["kind"] for value in ALL])
def test_other_scores_are_refused(service, start, bundle, place):
    """Also the mean of the losses, which is the score of other campaigns."""
    id = bundle[0][place]
    members = unpack(service.request("GET", f"/v1/bundles?campaigns={id}").body)
    dead = next(row for row in service.pages(f"/v1/campaigns/{id}/phylogeny")
                if row["died"] is not None and not row["lower_bound"])
    mean = mean_of(evaluated_losses(service, [dead])[0])
    for wrong in (mean, math.nextafter(dead["score"], 9)):
        change = put("score", lambda _, to=wrong: to)
        reply = enter(start(), pack(altered(members, "designs/", change, dead["number"])), "verify")
        assert reply.status == 422
        detail = reply.json()["errors"][0]["detail"]
        assert f"is not the {ALL[place]['kind']} of its losses" in detail, detail


@pytest.mark.parametrize("place, more, words", [
    (1, {"aggregate": {"kind": "mean"}}, 'expected "}}"'),
    (1, {"aggregate": {"kind": "cvar", "level": 2}}, "not the settings of a campaign"),
    (1, {"aggregate": CVAR | {"level": 0.5}}, "is not the cvar of its losses"),
    (2, {"racing": "lossless"}, "not the settings of a campaign")],
                         ids=["mean", "bounds", "level", "racing"])
def test_other_settings_are_refused(service, start, bundle, place, more, words):
    """A bundle has one form: by the mean, without the setting. With mean-sd, racing is off."""
    sent = service.request("GET", f"/v1/bundles?campaigns={bundle[0][place]}").body
    change = put("settings", lambda settings: {name: more.get(name, value)
                                               for name, value in settings.items()})
    reply = enter(start(), pack(altered(unpack(sent), "campaign.json", change)), "verify")
    assert reply.status == 422 and words in reply.json()["errors"][0]["detail"], reply.json()


# ---- morphoctl ----

def test_morphoctl(service, ctl):  # noqa: F811
    settings = "--population 4 --generations 1 --physics n_steps=60"

    def campaign(more):
        status, out, err = ctl(f"campaign start zero-shot {settings} {more} -q")
        assert status == 0, err
        await_end(service, f"/v1/campaigns/{out.strip()}")
        return out.strip()

    for text, aggregate, words in (
            ("cvar:0.75", CVAR, "cvar, level 0.75"), ("quantile:1", QUANTILE | {"level": 1}, "1"),
            ("mean-sd:1.5", MEAN_SD, "mean-sd, weight 1.5"), ("cvar", CVAR | {"level": 0.9}, "0.9"),
            ("mean", {"kind": "mean"}, "")):
        id = campaign(f"--aggregate {text}")
        value = service.get(f"/v1/campaigns/{id}")["settings"]
        assert value["aggregate"] == aggregate
        out = ctl(f"campaign show {id}")[1]
        assert words in out and ("aggregate" in out) == (text != "mean"), out
        assert ("racing off" in out) == (aggregate["kind"] == "mean-sd")
    for wrong in ("cvar:", "cvar:x", "cvar:0.5:1", "cvar:nan"):
        status, _, err = ctl(f"campaign start zero-shot --aggregate {wrong}")
        assert status != 0 and "cvar:0.9" in err, err
    for wrong, words in (("median", "mean-sd"), ("cvar:2", "at most 1"), ("mean:1", "no level")):
        status, _, err = ctl(f"campaign start zero-shot --aggregate {wrong}")
        assert status != 0 and words in err, err
    plain, robust = campaign(""), campaign("--aggregate cvar:0.5")
    status, _, err = ctl(f"campaign compare {plain} {robust}")
    assert status != 0 and "settings.aggregate" in err, err
