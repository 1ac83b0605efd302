"""Links lead to what they name, in its environment, and back to where the user was."""

import json
import re
import shlex
import time

import pytest

from browser import Browser
from conftest import CAMPAIGN
from contract import SOURCE
from service import DESIGN, run
from test_live import TOAST, go, module

HEADING = "document.querySelector('main h1')?.textContent"
BROKEN = {
    "stage?designs=zzz": "zzz is not a design", "stage?environment=77": "a number from 0 to 9",
    "stage?designs=" + "88" + "0" * 34 + ",12": "12 is not a design",
    "stage?world=moon": "campaign-N or evaluation-N", "stage?speed=7": "one of 2, 1, 0.5",
    "stage?show=bones": "a list of skin", "stage?view=1_2": "a camera as six numbers",
    "stage?time=soon": "a number of seconds", "stage?follow=9": "the number of a robot",
    "stage?evaluation={evaluation}&rows=5": "the evaluation has no design 5",
    "designs?order=tallest": "one of best, worst", "designs?controller=nobody": "no controller",
    "overview?state=bored": "one of queued", "overview?archived=maybe": "one of true, all",
    "campaigns/{campaign}?compare=x": "expected a job number",
    "trainings/{training}?compare=1,2,3,4": "compare names 4 jobs",
    "trainings/{training}?compare={training}": "this job is on the page already",
    "campaigns/{campaign}?compare=1,1": "compare=1: this job is on the page already",
    "lab?voxels=01": "144 digits", "compare?designs=12": "12 is not a robot",
    "compare": "names no robots",
}


@pytest.fixture(scope="module")
def own(service):
    """An evaluation in a custom environment."""
    return run(service, "evaluations", {
        "designs": [DESIGN, {"cells": [[0, 0, 0], [1, 0, 0]]}], "physics": {"n_steps": 160},
        "environments": [{"light_xy_m": [0.5, 1.0], "terrain_sigma_m": 0.02, "seed": 4}]})


def test_broken_links_say_what_is_wrong(service, browser, own):
    """The pages show nothing else."""
    browser.open("designs")
    for view, text in BROKEN.items():
        view = view.format(evaluation=own["id"], campaign=service.campaign,
                           training=service.training)
        browser.run("location.hash = '#/' + arguments[0]", view)
        browser.until(f"{HEADING} === 'This link cannot be shown'")
        browser.until(f"document.querySelector('main .error').innerText.includes({text!r})")
        assert browser.texts("main canvas, main table, main button") == [], view
    for view in ("__proto__", "constructor/1"):
        browser.run("location.hash = '#/' + arguments[0]", view)
        browser.until(f"{HEADING} === 'Page not found'")
    assert browser.faults() == []


def test_the_stage_has_the_world_of_a_score(service, browser, own):
    """The stage has the environments, physics and controller, and shows them; so do the commands to
    copy."""
    best = min(own["results"], key=lambda row: row["score"])
    browser.open(f"designs?evaluation={own['id']}")
    browser.until("document.querySelectorAll('.card').length === 2")
    browser.run("document.querySelector('.card').click()")
    browser.click("Watch selected")
    browser.until_walking()
    loss, seconds, light = browser.run("""
        const { stage } = document.querySelector('.stage').player;
        const [{ loss, world }] = stage.robots;
        return [loss, stage.durationS(), world.light];
    """)
    assert loss == pytest.approx(best["losses"][0], abs=1e-6)
    assert seconds == pytest.approx(160 * 0.002) and light == [0.5, 1.0]
    assert browser.texts(".world") == [
        f"World of evaluation {own['id']}: 1 custom environment, 160 steps of 0.002 s, "
        "integrator split, controller default"]
    browser.until(f"location.hash.includes('world=evaluation-{own['id']}')")
    browser.click("Commands")
    browser.until("document.querySelector('dialog[open] pre')")
    curl, film, python = browser.texts("dialog pre")
    body = json.loads(shlex.split(curl)[shlex.split(curl).index("-d") + 1])
    assert body["physics"]["n_steps"] == 160 and len(body["environments"]) == 1
    assert "n_steps=160" in shlex.split(film) and shlex.split(film)[0] == "echo"
    assert '"n_steps": 160' in python
    go(browser, f"campaigns/{service.campaign}")
    browser.until("document.querySelector('.pick input')")
    browser.run("document.querySelector('.pick input').click()")
    browser.click("Watch selected")
    browser.until("/^World of campaign/.test(document.querySelector('.world')?.innerText)")
    browser.until_walking()
    assert browser.run("return document.querySelector('.stage').player.stage.durationS()") == (
        pytest.approx(CAMPAIGN["physics"]["n_steps"] * 0.002))
    assert browser.faults() == []


def test_back_leads_to_where_one_was(service, browser):
    """The position on the page and the choices are restored; an open dialog is closed."""
    service.evaluate({"designs": [{"cells": [[x, 0, 0] for x in range(n)]} for n in (1, 2, 3)]})
    browser.open("designs")
    browser.until("document.querySelectorAll('.card').length > 2")
    # Without anchoring: cards that are still being drawn would move the page by themselves.
    browser.run("document.body.style.minHeight = '3000px';"
                "document.documentElement.style.overflowAnchor = 'none'; scrollTo(0, 300);"
                "[...document.querySelectorAll('.card')].slice(0, 3).forEach((e) => e.click())")
    browser.until("history.state.scrollY === 300")
    browser.run("document.querySelector('.pick a').click()")
    browser.until("document.querySelector('main h1 + code')")
    assert browser.run("return scrollY") == 0
    assert browser.run("return document.activeElement.tagName") == "H1"
    browser.click("Commands")
    browser.until("document.querySelector('dialog[open]')")
    browser.run("history.back()")
    browser.until(f"{HEADING} === 'Designs' && scrollY === 300")
    assert browser.run("return document.querySelectorAll('[aria-pressed=true]').length") == 3
    assert browser.run("return document.querySelectorAll('dialog').length") == 0


def test_a_late_timer_leaves_other_entries_alone(browser):
    """Going back changes the entry of the history before the page learns of it."""
    browser.open("designs")
    browser.run("document.body.style.minHeight = '3000px'")
    # Again and again, because the page scrolls to its top when the view has loaded.
    browser.until("(scrollTo(0, 40), history.state?.scrollY === 40)")
    browser.run("scrollTo(0, 50);"
                "addEventListener('scroll', () => requestAnimationFrame(() =>"
                " history.pushState({ scrollY: 300 }, '', '#/runs')), { once: true });"
                "setTimeout(() => { window.isLate = true; }, 1000)")
    browser.until("window.isLate && location.hash === '#/runs'")
    assert browser.run("return history.state.scrollY") == 300


def test_a_field_keeps_the_focus(browser):
    """It can be used before its page has loaded."""
    browser.open("machines")
    browser.until(f"{HEADING} === 'Machines'")
    browser.run("const { fetch } = window; const held = []; window.release = () => {"
                " window.fetch = fetch; held.forEach((go) => go()); };"
                "window.fetch = (url, ...all) => !/jobs/.test(url) ? fetch(url, ...all)"
                " : new Promise((resolve) => held.push(() => resolve(fetch(url, ...all))));"
                "location.hash = '#/runs'")
    browser.until("document.querySelector('input[type=search]')")
    browser.run("document.querySelector('input[type=search]').focus(); release()")
    browser.until("document.querySelector('main tbody tr')")
    time.sleep(0.3)  # the heading gets the focus after that, if nothing has it
    assert browser.run("return document.activeElement.type") == "search"


def test_tabs_are_named(service, browser):
    browser.open(f"campaigns/{service.campaign}")
    titles = {
        f"campaigns/{service.campaign}": "<b>walkers</b> & others, succeeded · morphod",
        f"campaigns/{service.campaign}/phylogeny":
            "Phylogeny of <b>walkers</b> & others · morphod",
        f"trainings/{service.training}": f"Training run {service.training}, succeeded · morphod",
        "machines": "Machines · morphod", "nowhere": "Page not found · morphod",
    }
    for view, title in titles.items():
        go(browser, view)
        browser.until(f"document.title === {title!r}")


def test_what_the_lab_keeps_stays(browser):
    browser.open("lab?voxels=" + "1" + "0" * 143)
    browser.click("→")
    browser.click("Keep")
    go(browser, "designs")
    go(browser, "lab")
    assert browser.run("return document.querySelectorAll('#tray li').length") == 1
    voxels = "new URLSearchParams(location.hash.split('?')[1]).get('voxels')"
    browser.click("Undo")
    assert browser.run(f"return {voxels}") == "1" + "0" * 143
    browser.click("Keep")  # the same body, elsewhere
    browser.until(TOAST + "?.innerText.includes('already in the tray')")


def test_the_lab_scores_again_when_the_service_is_back(browser):
    browser.open("lab?voxels=" + "1" + "0" * 143)
    browser.until("/^score/.test(document.querySelector('main p.result').textContent)")
    browser.run("document.querySelector('main p.result').textContent = 'cannot be reached'")
    browser.driver.execute_async_script("""
        const done = arguments[arguments.length - 1];
        import(document.querySelector('script[type=module]').src).then(({ app }) => {
          for (const listener of app.events.listeners) listener({ type: 'reset' });
          done();
        });
    """)
    browser.until("/^score/.test(document.querySelector('main p.result').textContent)")


def test_a_design_is_found_in_a_phylogeny(service, browser):
    """The message about a missing design disappears, and the view moves to the design."""
    browser.open(f"campaigns/{service.campaign}/phylogeny")
    find = """
        const form = document.querySelector('main form');
        form.querySelector('input').value = arguments[0];
        form.requestSubmit();
    """
    browser.until("/of them ancestors/.test(document.querySelector('.title').innerText)")
    browser.run(find, "abc")
    browser.until("document.querySelector('.title .error').innerText === "
                  "'There is no design abc in this campaign.'")
    browser.run("const canvas = document.querySelector('.lives');"
                "for (let i = 0; i < 9; i++) canvas.dispatchEvent(new WheelEvent('wheel',"
                "{ deltaY: -400, clientX: 900, clientY: 500 }))")
    browser.run(find, "5")
    browser.until("document.querySelector('main h2')?.innerText.startsWith('#5 ')")
    assert browser.texts(".title .error") == [""]
    pixels = browser.pixels(".over")[:, :, 3]
    marked = (pixels[:-60] > 150).sum()
    assert marked > 40 * browser.ratio ** 2, "the mark of the design is not in sight"
    assert "of them ancestors" in browser.texts(".title")[0]


FIELD = "document.querySelector('dialog[open] form').elements"


def fill(browser, values):
    browser.run("""
        const { elements } = document.querySelector('dialog[open] form');
        for (const [name, value] of Object.entries(arguments[0])) {
          elements[name].value = value;
          elements[name].dispatchEvent(new Event('change', { bubbles: true }));
        }
    """, values)


def test_a_finetuning_from_the_form(service, browser):
    """Tests random bodies and a population. The form of a pretraining run does not request
    bodies."""
    browser.open("trainings")
    browser.click("New training")
    browser.until("document.querySelector('dialog[open] form')")
    fill(browser, {"kind": "pretrain"})
    assert browser.run(f"return [{FIELD}.random.offsetParent === null,"
                       f"{FIELD}.controller.selectedOptions[0].text]") == [True, "random weights"]
    fill(browser, {"kind": "finetune", "random": "3", "steps": "1", "batch": "2"})
    assert browser.run(f"return {FIELD}.controller.selectedOptions[0].text") == "default"
    browser.click("Start")
    browser.until("/^#.trainings.\\d/.test(location.hash)")
    id = browser.run("return location.hash.split('/')[2]")
    assert service.get(f"/v1/trainings/{id}")["settings"]["n_designs"] == 3
    service.act(id, "cancel")
    go(browser, "trainings")
    browser.click("New training")
    browser.until("document.querySelector('dialog[open] form')")
    fill(browser, {"kind": "finetune", "learn-on": "population", "job": service.campaign,
                   "best": "2", "steps": "1", "batch": "2"})
    browser.click("Start")
    browser.until(f"/^#.trainings.\\d/.test(location.hash) && !location.hash.endsWith('/{id}')")
    second = browser.run("return location.hash.split('/')[2]")
    settings = service.get(f"/v1/trainings/{second}")["settings"]
    assert settings["population"] == {"campaign": service.campaign}
    assert settings["n_designs"] == 2
    service.act(second, "cancel")


def test_forms_say_what_they_leave_open(service, browser):
    """Empty fields show the numbers of the preset. A fault is shown once, at its field."""
    browser.open("overview")
    browser.click("New campaign")
    browser.until("document.querySelector('dialog[open] form')")
    contract = (SOURCE / "schema" / "openapi.yaml").read_text()
    text = re.search(r"CampaignPreset: .*description: '(.*)'", contract)[1]
    rows = [re.findall(r"\d+", part) for part in text.split(". ")]
    populations, generations = [row[0] for row in rows], [row[1:] for row in rows]
    modes = ("zero-shot", "few-shot", "simultaneous")
    for preset, population, row in zip(("paper", "workstation", "demo"), populations, generations):
        for mode, n in zip(modes, row):
            fill(browser, {"preset": preset, "mode": mode})
            assert browser.run(f"return [{FIELD}.population.placeholder,"
                               f"{FIELD}.generations.placeholder]") == [population, n]
    modes = "return [...document.querySelector('[name=mode]').options].map((e) => e.value)"
    assert "study" not in browser.run(modes)
    fill(browser, {"mode": "zero-shot", "name": "Not A Name", "preset": "demo", "replicates": "2"})
    browser.until("document.querySelector('dialog').innerText.includes("
                  "'Up to 39,680 rollouts')")  # 64 × 31 × 2 designs, 10 environments
    fill(browser, {"population": "10"})
    browser.until("document.querySelector('dialog').innerText.includes('Up to 6,200 rollouts')")
    fill(browser, {"mode": "few-shot"})
    browser.until("document.querySelector('dialog').innerText.includes(' gradients and ')")
    fill(browser, {"mode": "zero-shot"})
    browser.click("Start")
    browser.until("document.querySelector('details[open] .fault:not(:empty)')")
    assert browser.texts("dialog .error") == [""]
    browser.click("Cancel", "dialog button")
    browser.click("New training")
    browser.until("document.querySelector('dialog[open] [name=steps]')")
    steps = re.search(r"Number of learning steps, .*Default: (\d+), or (\d+) for",
                      contract).groups()
    batches = re.search(r"environment. Default: from the preset, (\d+) or (\d+)", contract).groups()
    for kind, n in zip(("pretrain", "finetune"), steps):
        for preset, batch in (("workstation", batches[0]), ("paper", batches[1])):
            fill(browser, {"kind": kind, "preset": preset})
            assert browser.run(f"return [{FIELD}.steps.placeholder,"
                               f"{FIELD}.batch.placeholder]") == [n, batch]
    browser.click("Cancel", "dialog button")
    browser.click("New evaluation")
    form = "document.querySelector('dialog[aria-label=\"New evaluation\"]')"
    browser.until(f"{form}?.querySelector('textarea')")
    assert "from the preset" not in browser.run(f"return {form}.innerText")
    browser.run(f"""
        const text = {form}.querySelector('textarea');
        text.value = '0'.repeat(36);
        text.dispatchEvent(new Event('input', {{ bubbles: true }}));""")
    browser.until(f"{form}.innerText.includes('10 rollouts')")


def test_bodies_of_pretraining_are_a_choice(service, browser):
    """The form shows the default of the contract, and sends the other value."""
    browser.open("overview")
    for value, label in (("true", "left out"), ("false", "allowed")):
        browser.click("New campaign")
        browser.until("document.querySelector('dialog[open] form')")
        assert browser.run(f"return {FIELD}.exclude_pretraining.value") == "true"
        fill(browser, {"exclude_pretraining": value, "population": "4", "generations": "0",
                       "label": label})
        browser.click("Start", "dialog button")
        browser.until(f"{HEADING} === {label!r}")
        id = browser.run("return location.hash.split('/')[2]")
        settings = service.get(f"/v1/campaigns/{id}")["settings"]
        assert settings["exclude_pretraining"] is (value == "true")
        service.act(id, "cancel")
        go(browser, "overview")
    assert browser.faults() == []


def test_dialogs_are_forms(service, browser):
    """Enter submits the form, and the browser checks the bounds."""
    from selenium.webdriver.common.keys import Keys
    browser.open("campaigns/" + service.campaign)
    browser.click("Extend")
    browser.until("document.querySelector('dialog[open] input')")
    field = browser.driver.find_element("css selector", "dialog input")
    field.clear()
    field.send_keys("-5", Keys.ENTER)
    assert browser.run("return document.querySelector('dialog[open] input').validity"
                       ".rangeUnderflow") is True
    browser.click("Cancel", "dialog button")
    job = run(service, "evaluations", {"designs": [DESIGN], "label": "before"})["id"]
    go(browser, f"designs?evaluation={job}")
    browser.click("Edit")
    browser.until("document.querySelector('dialog[open] input')")
    field = browser.driver.find_element("css selector", "dialog input")
    field.clear()
    field.send_keys("after", Keys.ENTER)
    browser.until(f"{HEADING} === 'after'")
    assert service.get(f"/v1/jobs/{job}")["label"] == "after"


def test_colors_of_the_person(browser):
    """With forced colors, selected and pressed controls still look different."""
    browser.open("lab?voxels=" + "1" + "0" * 143)
    media = {"features": [{"name": "forced-colors", "value": "active"}]}
    browser.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", media)
    try:
        for chosen, other in (("[aria-selected=true]", "[aria-selected=false]"),
                              ("[aria-pressed=true]", "[aria-pressed=false]")):
            colors = [browser.run("return getComputedStyle(document.querySelector(arguments[0]))"
                                  ".backgroundColor", one) for one in (chosen, other)]
            assert colors[0] != colors[1], chosen
    finally:
        browser.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})


def test_a_wrong_token_is_refused_in_the_dialog(start, tmp_path):
    path = tmp_path / "tokens"
    path.write_text("rita read the-right-token-of-rita\n")
    path.chmod(0o600)
    service = start(f"--token-file={path}", "--token-on-loopback=yes",
                    token="the-right-token-of-rita")
    browser = Browser(service)
    try:
        browser.driver.get(browser.base + "#/trainings")
        typed = "document.querySelector('dialog[open] input')"
        enter = (typed + ".value = arguments[0];"
                 "document.querySelector('dialog form').requestSubmit()")
        browser.until(typed)
        browser.run(enter, "a-wrong-token-of-nobody")
        browser.until("/does not accept/.test(document.querySelector('dialog .error').innerText)")
        assert browser.run(f"return {typed}.value") == "a-wrong-token-of-nobody"
        assert browser.run("return document.querySelectorAll('dialog').length") == 1
        browser.run("document.querySelector('dialog').close()")
        browser.until("!document.querySelector('dialog')")
        browser.click("Enter a token")
        browser.run(enter, "the-right-token-of-rita")
        browser.until(f"{HEADING} === 'Runs'")
        text = browser.run("return document.body.innerText")
        assert not re.search(r"\b(null|undefined|NaN)\b", text)
    finally:
        browser.quit()


def test_the_icon_is_at_the_usual_place(service):
    icon = service.request("GET", "/favicon.ico")
    assert icon.status == 200 and icon.body.startswith(b"<svg")
