"""The table of runs, and what the pages of all kinds of runs share: tabs, settings, start again."""

import functools
import hashlib

import pytest

import atlases
from conftest import CAMPAIGN, TRAINING
from service import DESIGN, await_end, run
from test_live import TOAST, go, module

SHORT = {"designs": [DESIGN], "physics": {"n_steps": 20}, "experiment": "table"}
NAMES = "[...document.querySelectorAll('.runs tbody td.main a')].map((a) => a.text)"
BOXES = "document.querySelectorAll('.runs tbody input[type=checkbox]')"


@pytest.fixture(scope="module")
def table(service):
    """Jobs of an experiment, whose best scores are in the order of their labels."""
    made = {}
    for label, cells in (("Gait C", [[0, 0, 0]]), ("gait b", [[0, 0, 0], [1, 0, 0]]),
                         ("other", [[2, 2, 0], [3, 2, 0], [2, 3, 0]])):
        job = run(service, "evaluations", SHORT | {"designs": [{"cells": cells}], "label": label,
                                                   "physics": {"n_steps": 400}})
        made[label] = (job["id"], job["results"][0]["score"])
    request = CAMPAIGN | {"label": "gait a", "experiment": "table", "generations": 1}
    id = run(service, "campaigns", request)["id"]
    made["gait a"] = (id, service.get(f"/v1/campaigns/{id}")["newest"]["score"]["quantiles"]["p0"])
    return made


def names(browser, expected):
    browser.until(f"JSON.stringify({NAMES}) === JSON.stringify({expected!r})")


def sort(browser, column):
    browser.click(column, "th button")


def test_builds_of_atlases_are_listed(browser, service):
    """Among all runs, and by their kind, with their progress."""
    request = {"voxels": 6, "name": "shown", "label": "an atlas", "experiment": "atlases",
               "physics": {"n_steps": 5000}}
    id = service.post("/v1/atlases", request)["id"]
    service.act(id, "pause")
    run(service, "evaluations", SHORT | {"label": "beside it", "experiment": "atlases"})
    browser.open("runs?experiment=atlases")
    names(browser, ["beside it", "an atlas"])
    assert "bodies" in browser.texts(".runs tbody tr")[1]
    browser.open("runs?kind=atlas&experiment=atlases")
    names(browser, ["an atlas"])
    service.act(id, "cancel")
    browser.until("document.querySelector('.runs tbody tr').innerText.includes('cancelled')")


def test_certificates_are_listed(browser, service):
    """Among all runs, by their kind, and among the running jobs, with their progress."""
    request = SHORT | {"label": "a certificate", "experiment": "certificates",
                       "physics": {"n_steps": 200000}}
    id = service.post("/v1/certificates", request)["id"]
    browser.open("runs?experiment=certificates")
    names(browser, ["a certificate"])
    assert "of 780 rollouts" in browser.texts(".runs tbody tr")[0]
    browser.open("overview")
    browser.until("document.querySelector('article h2')?.innerText === 'a certificate'")
    service.act(id, "cancel")
    browser.open("runs?kind=certificate&experiment=certificates&state=cancelled")
    names(browser, ["a certificate"])


def test_runs_are_filtered_and_sorted(browser, table):
    """A filter finds what the service has, not only what is loaded; an order is of all of it."""
    browser.open("runs?experiment=table")
    newest = ["gait a", "other", "gait b", "Gait C"]
    names(browser, newest)
    field = browser.driver.find_element("css selector", "input[type=search]")
    field.send_keys("AIT")
    names(browser, ["gait a", "gait b", "Gait C"])
    assert "search=AIT" in browser.driver.current_url
    sort(browser, "Run")
    names(browser, ["gait a", "gait b", "Gait C"])
    assert browser.run("return document.querySelector('[data-sort=run]').ariaSort") == "ascending"
    sort(browser, "Run")
    names(browser, ["Gait C", "gait b", "gait a"])
    field.send_keys("x")
    browser.until("document.querySelector('.empty:not([hidden])')?.innerText === 'No jobs match.'")
    for _ in range(4):
        field.send_keys("\b")
    names(browser, sorted(newest, key=str.lower, reverse=True))
    sort(browser, "Best score")
    by_score = sorted(table, key=lambda label: table[label][1])
    names(browser, by_score)
    cells = browser.texts(".runs tbody td.right[data-name=Best]")
    assert cells[0].split()[0] == f"{table[by_score[0]][1]:.4f}"
    browser.run("const e = document.querySelector('[aria-label=Kind]'); e.value = 'campaign';"
                "e.dispatchEvent(new Event('change'))")
    names(browser, ["gait a"])
    # The link has all of it.
    browser.open(browser.driver.current_url.split("#/")[1])
    names(browser, ["gait a"])
    browser.open("runs?kind=study&search=a%20study")  # other tests have studies, too
    names(browser, ["a study"])
    assert browser.faults() == []


def test_a_long_list_is_loaded_in_parts(service, browser):
    first = [service.post("/v1/evaluations", SHORT | {"label": f"many {n}", "experiment": "many"})
             ["id"] for n in range(103)]
    await_end(service, f"/v1/evaluations/{first[-1]}")
    browser.open("runs?experiment=many")
    browser.until("document.querySelectorAll('.runs tbody tr').length === 100")
    assert "the newest 100 runs" in browser.texts("[aria-label=Runs]")[0]
    browser.open("runs?experiment=many&sort=run&order=ascending")  # the last was the first
    browser.until(f"{NAMES}[0] === 'many 0'")
    assert "103 runs" in browser.texts("[aria-label=Runs]")[0]
    browser.open("runs?experiment=many")
    browser.click("Show more")
    browser.until("document.querySelectorAll('.runs tbody tr').length === 103")


def test_many_are_selected_and_archived(service, browser):
    ids = [run(service, "evaluations", SHORT | {"label": f"select {n}", "experiment": "select"})
           ["id"] for n in range(3)]
    browser.open("runs?experiment=select")
    names(browser, ["select 2", "select 1", "select 0"])
    browser.run(f"{BOXES}[0].click(); {BOXES}[2].click()")
    assert "2 selected" in browser.texts("[aria-label='Selected runs']")[0]
    browser.click("Archive")
    browser.until(f"{TOAST}?.innerText.includes('2 runs archived')")
    names(browser, ["select 1"])
    assert [bool(service.get(f"/v1/jobs/{id}")["archived_at"]) for id in ids] == [True, False, True]
    browser.run("const e = document.querySelector('[aria-label=Archived]'); e.value = 'all';"
                "e.dispatchEvent(new Event('change'))")
    names(browser, ["select 2", "select 1", "select 0"])
    browser.run("document.querySelector('.runs thead input').click()")
    browser.click("Restore")
    browser.until(f"{TOAST}?.innerText.includes('2 runs restored')")
    browser.click("Delete")
    browser.until("document.querySelector('[role=alertdialog]')")
    assert "3 evaluations with their results and recordings" in browser.texts(
        "[role=alertdialog]")[0]
    browser.click("Keep", "dialog button")
    assert service.get(f"/v1/jobs/{ids[0]}")["id"] == ids[0]
    browser.click("Delete")
    browser.until("document.querySelector('[role=alertdialog]')")
    browser.click("Delete 3 runs", "dialog button")
    browser.until("document.querySelector('.empty:not([hidden])')?.innerText === 'No jobs match.'")
    assert service.request("GET", f"/v1/jobs/{ids[0]}").status == 404
    assert browser.faults() == []


def test_refused_actions_say_why(service, browser):
    """A campaign that another needs stays, and the page shows why."""
    first = run(service, "campaigns", CAMPAIGN | {"label": "needed", "experiment": "needs"})["id"]
    run(service, "campaigns", CAMPAIGN | {"label": "needs it", "experiment": "needs",
                                          "initial": {"campaign": first}})
    browser.open("runs?experiment=needs&search=needed")
    names(browser, ["needed"])
    browser.run(f"{BOXES}[0].click()")
    browser.click("Delete")
    browser.until("document.querySelector('[role=alertdialog]')")
    browser.click("Delete the job", "dialog button")
    browser.until(f"{TOAST}?.innerText.includes('0 deleted, 1 refused. needed: ')")
    names(browser, ["needed"])


def test_a_refresh_of_the_table_leaves_what_is_in_use(service, browser):
    run(service, "evaluations", SHORT | {"label": "before", "experiment": "live"})
    browser.open("runs?experiment=live")
    names(browser, ["before"])
    browser.run(f"window.box = {BOXES}[0]; box.focus(); box.click();")
    run(service, "evaluations", SHORT | {"label": "after", "experiment": "live"})
    names(browser, ["after", "before"])
    assert browser.run("return document.activeElement === box && box.checked && box.isConnected")
    assert "1 selected" in browser.texts("[aria-label='Selected runs']")[0]


def test_replicates_by_keyboard(service, browser):
    """They are one row; it opens and closes with the keyboard, and the focus stays."""
    from selenium.webdriver.common.action_chains import ActionChains
    from selenium.webdriver.common.keys import Keys
    first = run(service, "campaigns", CAMPAIGN | {
        "replicates": 2, "label": "twice", "generations": 1, "experiment": "twice"})["id"]
    await_end(service, f"/v1/campaigns/{int(first) + 1}")
    browser.open("runs?experiment=twice")
    names(browser, ["twice"])
    assert browser.run("return document.querySelector('td.main a').hash") == (
        f"#/campaigns/{first}/replicates")
    browser.run("document.querySelector('[aria-expanded]').focus()")
    for expected in (["twice", "replicate 1 of 2", "replicate 2 of 2"], ["twice"]):
        ActionChains(browser.driver).send_keys(Keys.ENTER).perform()
        names(browser, expected)
        assert browser.run("return document.activeElement.matches('[aria-expanded]')")
    browser.run(f"{BOXES}[0].click()")  # all of them
    assert "2 selected" in browser.texts("[aria-label='Selected runs']")[0]
    browser.click("Compare")
    browser.until("document.querySelectorAll('[aria-label=Comparison] tbody tr').length === 2")
    browser.until("document.querySelectorAll('[aria-label=\"Settings that differ\"] tbody tr')"
                  ".length === 1")
    assert browser.texts("[aria-label='Settings that differ'] tbody tr") == ["Seed\t1\t2"]
    assert browser.faults() == []


def test_old_links_lead_to_the_same_pages(service, browser):
    for old, new in (("campaigns?state=succeeded", "runs?state=succeeded&kind=campaign"),
                     ("trainings", "runs?kind=training"),
                     (f"designs?evaluation={service.evaluation}",
                      f"evaluations/{service.evaluation}"),
                     (f"runs/{service.training}", f"trainings/{service.training}"),
                     (f"runs/{service.study}", f"campaigns/{service.study}")):
        browser.open(old)
        browser.until(f"location.hash === '#/{new}'")
        browser.until("!/Loading/.test(document.querySelector('main').innerText)")
        assert browser.texts("nav [aria-current=page]")[0] == "Runs", old
        assert [one for one in browser.faults() if "status of 4" not in one] == []


# ---- tabs, settings ----


def test_a_tab_keeps_the_head(service, browser):
    browser.open("campaigns/" + service.campaign)
    browser.until("document.querySelectorAll('.pick').length > 1")
    browser.run("window.head = document.querySelector('h1')")
    browser.click("Population", ".tabs a")
    browser.until("document.querySelector('.chart h2')?.innerText === 'Population'")
    assert browser.run("return head.isConnected")
    browser.click("Settings", ".tabs a")
    browser.until("document.querySelector('dl.settings')")
    assert browser.texts(".tabs [aria-current]") == ["Settings"]
    browser.driver.back()
    browser.until("document.querySelector('.chart h2')?.innerText === 'Population'")
    browser.click("Phylogeny", ".tabs a")
    browser.until("document.querySelector('h1')?.innerText === 'Phylogeny'")
    assert browser.faults() == []


def test_settings_that_differ_are_bold(service, browser):
    browser.open(f"campaigns/{service.campaign}/settings")
    browser.until("document.querySelector('dl.settings strong')")
    pairs = dict(zip(browser.texts("dl.settings dt"), browser.texts("dl.settings dd")))
    assert pairs["Population"] == "12 (default 512)" and pairs["Seed"] == "1"
    assert pairs["Gravity"] == "9.8 m/s²" and pairs["Integrator"] == "split"
    assert pairs["Controller"].startswith("default (") and "Duration" in pairs
    bold = browser.texts("dl.settings strong")
    assert bold == ["12", "4", "no", "1 listed environment", "60"]
    browser.until("/photo · light at \\(4, 3\\) m/.test(document.querySelector('ol').innerText)")
    browser.open(f"trainings/{service.training}/settings")
    browser.until("document.querySelector('dl.settings strong')")
    assert browser.texts("dl.settings strong") == ["4", "4", "20", "2", "2", "2"]
    browser.open(f"evaluations/{service.evaluation}/settings")
    browser.until("document.querySelector('dl.settings')")
    assert browser.texts("dl.settings strong") == []
    assert "No setting differs from the defaults" in browser.texts("main")[0]


DIFFERS = """({ settingsOf }) => {
  const { preset, rows } = settingsOf(window.job, window.period);
  return [preset, rows.filter(({ differs }) => differs).map(({ path, text, usual }) =>
    `${path.join('.')}: ${text}, not ${usual}`),
    rows.filter(({ isUnknown }) => isUnknown).map(({ path }) => path.join('.'))];
}"""
# Settings that no preset has: they say which designs.
OPEN = {"campaign": set(), "training": {"population", "n_designs"},
        "evaluation": {"n_designs", "random"}}


def differing(browser, job, period):
    """Returns the preset and what differs from it. The page knows the preset of each setting."""
    browser.run("[window.job, window.period] = arguments", job, period)
    preset, rows, unknown = module(browser, "settings", DIFFERS)
    assert set(unknown) <= OPEN[job["kind"]]
    return [preset, rows]


def test_the_presets_are_those_of_the_service(service, browser):
    """A job that was started with a preset alone differs from it in nothing."""
    browser.open("nowhere")
    period = next(one for one in service.get("/v1/controllers")["items"]
                  if one["name"] == "default")["control_period_s"]
    for mode in ("zero-shot", "few-shot", "simultaneous", "study"):
        for preset in ("paper", "workstation", "demo"):
            request = {"mode": mode, "preset": preset}
            id = service.post("/v1/campaigns", request)["id"]
            job = service.get(f"/v1/campaigns/{id}") | {"kind": "campaign"}
            service.act(id, "cancel")
            expected = [preset, []]
            assert differing(browser, job, period) == expected, request
    for kind, preset in (("pretrain", "workstation"), ("pretrain", "phototaxis"),
                         ("pretrain", "paper"), ("pretrain", "robust"),
                         ("finetune", "workstation"), ("finetune", "paper")):
        request = {"kind": kind, "preset": preset, "device": "cpu"}
        if kind == "finetune":
            request["designs"] = [DESIGN]
        id = service.post("/v1/trainings", request)["id"]
        job = service.get(f"/v1/trainings/{id}")
        service.act(id, "cancel")
        job |= {"trainingKind": kind, "kind": "training"}
        assert differing(browser, job, period) == [preset, []], request
    job = run(service, "evaluations", {"designs": [DESIGN], "record": ["masses"]})
    assert differing(browser, job, period) == ["", ["record: masses, not none"]]


# ---- start again ----


def again(browser, view):
    browser.open(view)
    browser.click("Start again with…")
    browser.until("document.querySelector('dialog[open] form')")
    return browser.texts("dialog .kept")[0]


def newest(service, path):
    return service.get(f"/v1/{path}/{service.get(f'/v1/{path}?limit=1')['items'][0]['id']}")


def test_a_campaign_starts_again(service, browser):
    request = CAMPAIGN | {
        "label": "again", "seed": 5, "selection": {"kind": "tournament", "size": 3},
        "mutation": {"share": 0.5}, "initial": {"designs": [DESIGN]}, "generations": 2}
    id = run(service, "campaigns", request)["id"]
    words = again(browser, f"campaigns/{id}")
    assert words.startswith(f"Based on campaign {id}, also keeping: ")
    assert "Mutation: share 0.5" in words
    form = "document.querySelector('dialog form').elements"
    assert browser.run(f"return [{form}.population.value, {form}.seed.value, {form}.label.value]"
                       ) == ["12", "5", "again"]
    assert "null" not in browser.texts("dialog")[0]
    browser.run(f"{form}.seed.value = '6'")
    browser.click("Start", "dialog button")
    browser.until(f"/campaigns.\\d+$/.test(location.hash) && !location.hash.endsWith('/{id}')")
    first, second = service.get(f"/v1/campaigns/{id}"), newest(service, "campaigns")
    assert second["settings"] == first["settings"] | {"seed": 6}
    assert second["controller"] == first["controller"] and second["label"] == "again"
    sets = [service.get(f"/v1/campaigns/{one['id']}/environments") for one in (first, second)]
    assert sets[0] == sets[1]
    assert browser.faults() == []


def start(browser, path, id):
    """Sends the form, and waits for the page of the new job."""
    browser.click("Start", "dialog button")
    browser.until(f"/{path}.\\d+$/.test(location.hash) && !location.hash.endsWith('/{id}')")


@pytest.mark.parametrize("worlds, usual, environments", [
    ("environments", "random", CAMPAIGN["environments"]),
    ("environments", "random", "paper-test"),
    ("random", "environments", [{"task": "walk"}]),
    ("random", "environments", "morpho-12-walk")])
def test_the_worlds_of_learning_are_kept(service, browser, worlds, usual, environments):
    """Where they are not what the service chooses, and only there."""
    request = CAMPAIGN | {"mode": "few-shot", "generations": 1, "environments": environments}
    learning = {"parent_steps": 1, "child_steps": 1}
    for given, is_kept in ((worlds, True), (None, False)):
        own = learning | ({"worlds": given} if given else {})
        id = service.post("/v1/campaigns", request | {"learning": own})["id"]
        service.act(id, "cancel")
        browser.open(f"campaigns/{id}/settings")
        browser.until("document.querySelector('dl.settings strong')")
        assert (worlds in browser.texts("dl.settings strong")) == is_kept
        words = again(browser, f"campaigns/{id}")
        assert (f"Learning: worlds {worlds}" in words) == is_kept
        start(browser, "campaigns", id)
        second = newest(service, "campaigns")
        service.act(second["id"], "cancel")
        assert second["settings"] == service.get(f"/v1/campaigns/{id}")["settings"]
        assert second["settings"]["learning"]["worlds"] == (given or usual)


def test_recordings_and_priorities_are_kept(service, browser):
    id = run(service, "evaluations", SHORT | {"record": ["masses"], "record_stride": 4,
                                              "priority": "batch"})["id"]
    assert "Record stride 4" in again(browser, f"evaluations/{id}")
    start(browser, "evaluations", id)
    second = newest(service, "evaluations")
    assert (second["record_stride"], second["priority"]) == (4, "batch")
    id = service.post("/v1/campaigns", CAMPAIGN | {"priority": "interactive"})["id"]
    service.act(id, "cancel")
    assert "Priority interactive" in again(browser, f"campaigns/{id}")
    start(browser, "campaigns", id)
    second = newest(service, "campaigns")
    service.act(second["id"], "cancel")
    assert second["priority"] == "interactive"
    assert browser.faults() == []


def test_an_evaluation_and_a_training_start_again(service, browser):
    id = run(service, "evaluations", {
        "designs": [DESIGN, {"cells": [[0, 0, 0]]}], "physics": {"n_steps": 30},
        "environments": [{"task": "walk"}], "measures": ["mean_speed_m_per_s"]})["id"]
    assert "2 designs" in again(browser, f"evaluations/{id}")
    browser.click("Start", "dialog button")
    browser.until(f"/evaluations.\\d+$/.test(location.hash) && !location.hash.endsWith('/{id}')")
    first, second = (await_end(service, f"/v1/evaluations/{one}").json()
                     for one in (id, newest(service, "evaluations")["id"]))
    for name in ("physics", "measures", "environments", "n_designs", "precision", "controller"):
        assert second[name] == first[name], name
    assert [row["score"] for row in second["results"]] == [
        row["score"] for row in first["results"]]
    request = {key: value for key, value in TRAINING.items() if key != "designs"} | {
        "population": {"campaign": service.campaign, "best": 2}, "adam": {"beta1": 0.7},
        "schedule": "paper-finetune", "environments": [{"task": "walk"}],
        "validation": {"every_steps": 2, "designs": 2}}
    id = run(service, "trainings", request)["id"]
    again(browser, f"trainings/{id}")
    browser.click("Start", "dialog button")
    browser.until(f"/trainings.\\d+$/.test(location.hash) && !location.hash.endsWith('/{id}')")
    first, second = service.get(f"/v1/trainings/{id}"), newest(service, "trainings")
    assert second["settings"] == first["settings"] and second["parent"] == first["parent"]
    service.act(second["id"], "cancel")
    assert "does not return its 1 listed design" in again(browser, f"trainings/{service.training}")
    assert browser.faults() == []


def test_bodies_of_an_atlas_start_again(service, browser):
    """From the same file, unless its hash is removed."""
    put = functools.partial(service.request, "PUT", "/v1/atlases/drawn/file",
                            headers={"Content-Type": "application/octet-stream"})
    assert put(body=atlases.file_of()).status == 201
    request = {key: value for key, value in TRAINING.items() if key != "designs"} | {
        "population": {"atlas": "drawn", "count": 5, "seed": 3}}
    id = run(service, "trainings", request)["id"]
    browser.open(f"trainings/{id}/settings")
    browser.until("document.querySelector('dl.settings')")
    assert "5 bodies of atlas drawn, seed 3" in " ".join(browser.texts("dl.settings"))
    again(browser, f"trainings/{id}")
    start(browser, "trainings", id)
    first, second = service.get(f"/v1/trainings/{id}"), newest(service, "trainings")
    service.act(second["id"], "cancel")
    assert second["settings"] == first["settings"] and second["sample"] == first["sample"]
    assert put(body=atlases.file_of(seed=2)).status == 200
    again(browser, f"trainings/{id}")
    browser.click("Start", "dialog button")
    browser.until("document.querySelector('dialog .error').innerText.includes('another file')")
    # The refusal says to leave the hash out.
    browser.run("document.querySelector('dialog form').elements['atlas-sha256'].value = ''")
    start(browser, "trainings", id)
    third = newest(service, "trainings")
    service.act(third["id"], "cancel")
    digest = hashlib.sha256(atlases.file_of(seed=2)).hexdigest()
    assert third["settings"]["population"] == first["settings"]["population"] | {"sha256": digest}
    assert service.request("DELETE", "/v1/atlases/drawn").status == 204


def test_a_study_has_no_form(service, browser):
    browser.open("campaigns/" + service.study)
    assert "Start again with…" not in browser.texts("button")
    go(browser, "runs?kind=study&search=A%20STUDY")
    names(browser, ["a study"])
