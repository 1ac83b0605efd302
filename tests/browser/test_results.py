"""What the page of an evaluation shows besides scores, and where jobs name their tasks."""

from conftest import CAMPAIGN, TRAINING
from service import DESIGN, run

TALL = {"cells": [[x, y, z] for x in (2, 3) for y in (2, 3) for z in (0, 1)]}
SUITE = {"random": {"seed": 7, "count": 8}, "environments": "morpho-12",
         "physics": {"n_steps": 100}}
IMAGE = "document.querySelector('.radar img')"
DRAWN = f"{IMAGE}?.complete && {IMAGE}.naturalWidth > 0"


def rows(browser, title):
    """Returns the cells of the table with a title."""
    return browser.run("""
        const section = [...document.querySelectorAll('section.panel')].find((one) =>
          one.querySelector('h2')?.innerText.startsWith(arguments[0]));
        return [...section.querySelectorAll('tbody tr')].map((row) =>
          [...row.cells].map((cell) => cell.innerText));""", title)


def test_a_suite_has_a_picture_and_a_table(service, browser):
    """The table has the values in the unit of each task, and their means; the picture shows the
    best designs or the selected ones, in the theme and width of the page."""
    job = service.evaluate(SUITE).json()
    browser.open(f"designs?evaluation={job['id']}", "light")
    browser.until(DRAWN)
    assert browser.run(f"return {IMAGE}.naturalWidth") == 760
    assert "in all tasks of morpho-12" in browser.run("return document.body.innerText")
    shown = rows(browser, "Tasks of morpho-12")
    order = sorted(range(8), key=lambda d: job["results"][d]["score"])
    assert [int(row[0].split(":")[0]) for row in shown[:-1]] == order
    best = job["results"][order[0]]
    assert shown[0][1] == f"{best['tasks']['photo']['value']:.3f}"
    assert shown[0][3] == f"{best['tasks']['walk']['value']:.3f} m"
    assert shown[0][-1] == f"{best['tasks_mean']['loss']:.4f}"
    assert shown[-1][0] == "mean of 8"
    assert shown[-1][3] == f"{job['suite']['tasks'][2]['mean_value']:.3f} m"
    asked = "performance.getEntriesByType('resource').map((one) => one.name)" \
            ".filter((name) => name.includes('picture.svg'))"
    assert "theme=light" in browser.run(f"return {asked}.at(-1)")
    browser.click("Dark theme")
    browser.until(f"{asked}.at(-1).includes('theme=dark')")
    browser.run("document.querySelectorAll('.pick .card')[7].click()")
    browser.until(f"{asked}.at(-1).includes('designs={order[7]}')")
    browser.until(DRAWN)
    browser.driver.set_window_size(500, 900)
    try:
        browser.until(f"Number(/width=(\\d+)/.exec({asked}.at(-1))[1]) < 500")
        browser.until(f"{DRAWN} && {IMAGE}.naturalWidth < 500")
        assert browser.run("return document.documentElement.scrollWidth <= innerWidth")
    finally:
        browser.driver.set_window_size(1280, 900)
    assert browser.faults() == []


def test_a_form_starts_the_suite(service, browser):
    """The form of an evaluation offers the suite, with its rollouts and commands; that of a
    campaign does not."""
    browser.open("overview")
    browser.click("New evaluation")
    browser.until("document.querySelector('dialog[open] form')")
    browser.run("document.querySelector(\".tasks input[value='morpho-12']\").click();"
                "const text = document.querySelector('dialog textarea');"
                f"text.value = '{service.get('/v1/designs?limit=1')['items'][0]['id']}@0';"
                "text.dispatchEvent(new Event('input', { bubbles: true }))")
    browser.until("document.querySelector('dialog').innerText.includes('120 rollouts')")
    browser.click("Copy as a command", "dialog button")
    browser.until("document.querySelectorAll('dialog[open] pre').length === 3")
    curl, shell, python = browser.texts("dialog pre")
    assert '"environments":"morpho-12"' in curl and "morphoctl suite run " in shell
    assert "--environments" not in shell and '"environments": "morpho-12"' in python
    browser.run("document.querySelectorAll('dialog')[1].close()")
    browser.click("Start", "dialog button")
    browser.until(DRAWN)
    browser.open("overview")
    browser.click("New campaign")
    browser.until("document.querySelector('dialog[open] form')")
    assert "morpho-12" not in browser.run(
        "return [...document.querySelectorAll('.tasks input')].map((e) => e.value)")
    browser.run("document.querySelector('dialog').close()")
    assert browser.faults() == []


def test_measures_and_flags(service, browser):
    """A column for each measure, with its unit, and the flags."""
    job = service.evaluate({"designs": [DESIGN, TALL], "physics": {"n_steps": 200},
                            "measures": ["work_j", "mean_speed_m_per_s", "air_share"]}).json()
    browser.open(f"designs?evaluation={job['id']}")
    browser.until("document.querySelector('main th')")
    heads = browser.texts("main thead th")
    assert heads == ["Design", "mean speed, m/s", "air share", "work, J", "Flags"]
    for row in rows(browser, "Measures"):
        result = job["results"][int(row[0].split(":")[0])]
        assert float(row[3].replace(",", "")) == float(f"{result['measures']['work_j']:.3g}") or \
            abs(float(row[3].replace(",", "")) - result["measures"]["work_j"]) <= 0.5
        assert row[4] == (", ".join(result["flags"]) or "–")
    assert browser.faults() == []


def test_tolerances(service, browser):
    """The settings of the rung that each design ended on, its error, and what each rung gave."""
    job = service.evaluate({"designs": [DESIGN, TALL], "physics": {"n_steps": 100},
                            "tolerance": 1e-4,
                            "environments": [{"task": "walk"}]}).json()
    browser.open(f"designs?evaluation={job['id']}")
    browser.until("document.querySelector('main th')")
    shown = rows(browser, "Tolerance")
    assert len(shown) == 2
    for row in shown:
        result = job["results"][int(row[0].split(":")[0])]
        climbed = result["tolerance"]
        assert row[1] == f"{result['score']:.4f}"
        assert row[2].startswith("yes" if climbed["reached"] else "no")
        assert row[4] == f"{1000 * climbed['dt_s']:.3g} ms, {climbed['precision']}"
        assert len(row[5].splitlines()) == len(climbed["rungs"])
        assert f"{climbed['rungs'][0]['score']:.4f} ±" in row[5]
    assert browser.faults() == []


def test_jobs_name_their_tasks(service, browser):
    """The list of campaigns compares tasks, with the best score in the unit of each; the page of a
    training run says where it learns."""
    named = run(service, "campaigns", CAMPAIGN | {
        "label": "downstairs", "environments": "morpho-12-down", "generations": 1})
    run(service, "campaigns", CAMPAIGN | {
        "label": "circler", "environments": [{"task": "circle"}], "generations": 1})
    browser.open("campaigns")
    browser.until("document.body.innerText.includes('travel (turning)')")
    browser.until("/loss [0-9]/.test(document.querySelector('.runs').innerText)")
    browser.until("[...document.querySelectorAll('main tbody tr')].find((row) =>"
                  "row.textContent.includes('<b>walkers')).cells[4].textContent")  # read later
    cells = {row[1].splitlines()[0]: row for row in browser.run(
        "return [...document.querySelectorAll('main tbody tr')].map((row) =>"
        "[...row.cells].map((cell) => cell.innerText || cell.textContent))")}
    assert cells["downstairs"][4] == "down" and cells["circler"][4] == "travel (turning)"
    assert cells["<b>walkers</b> & others"][4] == "photo"
    value, loss = cells["downstairs"][6].splitlines()
    best = service.get(f"/v1/campaigns/{named['id']}")["newest"]["score"]["quantiles"]["p0"]
    assert value.endswith(" m ↑") and loss == f"loss {best:.4f}"
    walking = run(service, "trainings", {
        **TRAINING, "name": "walks", "environments": [{"task": "walk"}, {"task": "path"}],
        "validation": {"every_steps": 2, "designs": 2}})
    browser.open(f"trainings/{walking['id']}")
    browser.until("document.body.innerText.includes('2 listed environments: "
                  "travel (ahead), follow (path)')")
    drawn = run(service, "trainings", {**TRAINING, "name": "both",
                                       "tasks": ["walk", "walk", "photo"]})
    browser.open(f"trainings/{drawn['id']}")
    browser.until("document.body.innerText.includes("
                  "'with the tasks 2 × travel (ahead), photo')")
    assert browser.faults() == []
