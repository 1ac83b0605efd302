"""The estimate of a form: rollouts, processor time and minutes, from what was measured here."""

import pathlib
import re

import pytest

from browser import Browser
from fixtures import start  # noqa: F401
from service import BINARY, DESIGN, run

MODULE = pathlib.Path(BINARY).parents[2] / "tests" / "device" / "fake-device.so"
DEVICES = (f"--compute-module={MODULE}", "--devices=auto")  # one
UNKNOWN = "Nothing similar was measured here."
SHORT = {"n_steps": 20}
JUMP = [{"task": {"guide": {"kind": "ahead"}, "objective": "jump"}}]
GRID = [{"terrain": {"kind": "grid", "heights_m": [[0, 0.1], [0, 0.1]], "spacing_m": 1},
         "light_xy_m": [4, 3]}]
SHOWN = "document.querySelector('dialog[open] .estimate').innerText"


def form(browser, kind, view="overview", words=None):
    browser.run("document.querySelectorAll('dialog').forEach((one) => one.close())")
    browser.open(view)
    browser.click(words or f"New {kind}")
    browser.until("document.querySelector('dialog[open] form')")


def enter(browser, **values):
    for name, value in values.items():
        browser.run(f"""
            const field = document.querySelector('dialog[open] form').elements[{name!r}];
            field.value = {str(value)!r};
            field.dispatchEvent(new Event('change', {{ bubbles: true }}));
        """)


def figures(browser, words="Measured here on"):
    """Returns the text, and its numbers of gradients, rollouts and core-seconds."""
    browser.until(f"{SHOWN}.includes({words!r})")
    text = browser.run(f"return {SHOWN}")
    found = [re.search(rf"([\d.,]+) {unit}", text)
             for unit in ("gradient", "rollout", "core-second")]
    return text, [float(one[1].replace(",", "")) if one else None for one in found]


@pytest.fixture()
def fresh(request, start):
    """A page of a daemon that has computed nothing. A parameter: its flags."""
    running = start(*getattr(request, "param", ()))
    opened = Browser(running)
    yield running, opened
    opened.quit()


def estimate(browser, kind, request, controllers=()):
    """Returns what a form would say of a request, once it has looked for measurements."""
    return browser.driver.execute_async_script("""
        const [kind, request, controllers, done] = arguments;
        const folder = document.querySelector('script[type=module]').src.replace(/app.js$/, '');
        import(folder + 'lib/estimate.js').then(async ({ estimateFor }) => {
          const { element, show } = await estimateFor(kind);
          show(request, controllers, { environments: request.environments?.length });
          const look = () => (/second|Nothing/.test(element.textContent)
            ? done(element.textContent) : setTimeout(look, 20));
          look();
        });
    """, kind, request, list(controllers))


def test_a_campaign_takes_what_was_estimated(fresh):
    service, page = fresh
    assert service.get("/v1/rates")["items"] == []
    form(page, "campaign")
    enter(page, preset="demo", population=24, generations=4)
    text, (_, rollouts, seconds) = figures(page)
    assert text.startswith("Up to 1,200 rollouts: roughly ") and rollouts == 1200
    assert re.search(r" core-seconds?, at least [\d.]+ m?s here\. "
                     r"Measured here on 30 rollouts with the same settings\.$", text)
    [rate] = service.get("/v1/rates")["items"]
    assert (rate["work"], rate["device"], rate["control_period_s"]) == ("rollouts", "cpu", 0.016)
    page.run("document.querySelector('dialog form').elements.generations.value = 9;"
              "document.querySelector('dialog form').dispatchEvent(new Event('input'))")
    page.until(f"{SHOWN}.startsWith('Up to 2,400 rollouts')")
    took = run(service, "campaigns", {
        "mode": "zero-shot", "preset": "demo", "population": 24, "generations": 4,
        "exclude_pretraining": False})["core_seconds"]
    assert took / 2 < seconds < 2 * took
    assert page.faults() == []


def test_every_kind_has_an_estimate(service, browser):
    form(browser, "evaluation")
    browser.run(f"""
        const area = document.querySelector('dialog[open] textarea');
        area.value = '{"f" * 36}';
        area.dispatchEvent(new Event('input', {{ bubbles: true }}));
    """)
    text, (_, rollouts, plain) = figures(browser)
    assert text.startswith("10 rollouts: about ") and rollouts == 10
    enter(browser, precision="float64")
    browser.until(f"!{SHOWN}.includes('{plain} core')")
    assert figures(browser)[1][2] > plain
    enter(browser, device="cuda")
    figures(browser, UNKNOWN)

    form(browser, "training")
    enter(browser, kind="pretrain", preset="workstation", steps=100, batch=64)
    text, (gradients, rollouts, seconds) = figures(browser)
    assert (gradients, rollouts) == (6400, 3 * 64 * 8)
    enter(browser, steps=200)
    assert figures(browser)[1][2] > 1.5 * seconds
    enter(browser, preset="paper")  # its controller acts in every step
    assert figures(browser)[1][2] != seconds

    form(browser, "campaign")
    enter(browser, mode="few-shot", preset="demo", population=10, generations=2)
    text, (gradients, rollouts, _) = figures(browser)
    assert (gradients, rollouts) == (10 * (30 + 2 * 60), 10 * (1 + 2 * 2) * 10)
    assert "roughly" in text
    assert browser.faults() == []


def test_a_run_that_is_started_again(service, browser):
    """Its settings without a field in the form count, too."""
    id = service.evaluate({"designs": [DESIGN], "physics": {"n_steps": 50000}}).json()["id"]
    form(browser, "evaluation", f"evaluations/{id}", "Start again with…")
    text, (_, rollouts, long) = figures(browser)
    assert text.startswith("10 rollouts: about ") and rollouts == 10
    id = service.evaluate({"designs": [DESIGN], "physics": {"n_steps": 10000}}).json()["id"]
    form(browser, "evaluation", f"evaluations/{id}", "Start again with…")
    assert long / figures(browser)[1][2] == pytest.approx(5, rel=0.3)
    form(browser, "campaign", f"campaigns/{service.campaign}", "Start again with…")
    assert figures(browser)[1][1] == 12 * 5
    form(browser, "training", f"trainings/{service.training}", "Start again with…")
    assert figures(browser)[1][0] == 16
    assert browser.faults() == []


@pytest.mark.parametrize("fresh", [DEVICES], indirect=True)
def test_processors_compute_what_devices_cannot(fresh):
    """With a device that was not used yet, there is an estimate exactly if the service chooses the
    processors."""
    service, page = fresh
    page.open("overview")
    training = {"kind": "pretrain", "steps": 3, "batch": 40, "preset": "workstation",
                "validation": {"every_steps": 0}}
    campaign = {"preset": "demo", "population": 12, "generations": 2}
    evaluation = {"designs": 100 * [{"voxels": 36 * "f"}]}
    weighted = [{"task": {"guide": {"kind": "ahead"}, "objective": {"travel": 1, "climb": 1}}}]
    other = [{"task": "walk"}, {"task": {"guide": {"kind": "ahead"}, "objective": "travel"}}]
    cases = [(kind, {**usual, **more}) for kind, usual, members in (
        ("training", training, (
            {}, {"environments": JUMP}, {"environments": weighted}, {"environments": GRID},
            {"environments": other}, {"environments": "paper-test"},
            {"tasks": [other[0]["task"], JUMP[0]["task"]]}, {"tasks": [other[0]["task"]]},
            {"device": "cpu"}, {"device": "cuda"})),
        ("campaign", campaign, (
            {"mode": "zero-shot", "environments": JUMP},
            {"mode": "zero-shot", "environments": GRID},
            {"mode": "few-shot", "environments": JUMP},
            {"mode": "few-shot", "environments": other},
            {"mode": "simultaneous", "environments": weighted})),
        ("evaluation", evaluation, (
            {}, {"designs": evaluation["designs"][1:]}, {"precision": "float64"}, {"error": True},
            {"tolerance": 0.01}, {"record": ["com"]}, {"verify": True}, {"best": 5},
            {"environments": JUMP * 10}, {"environments": GRID * 10}))) for more in members]
    wrong = []
    for kind, request in cases:
        text = estimate(page, kind, {**request, "physics": SHORT})
        job = service.post(f"/v1/{kind}s", {**request, "physics": SHORT})
        service.withdraw(job["id"])
        if ("core-second" in text) != (job["device"] == "cpu"):
            wrong.append((kind, request, job["device"], text))
    assert wrong == []


@pytest.mark.parametrize("fresh", [DEVICES], indirect=True)
def test_devices_learn_every_task_of_the_form(fresh):
    _, page = fresh
    form(page, "training")
    figures(page, UNKNOWN)
    for task in ("jump", "walk"):
        page.run(f"document.querySelector('dialog[open] input[value={task}]').click()")
        figures(page, UNKNOWN)
    assert page.faults() == []


def test_few_steps_say_little_about_gradients(fresh):
    service, page = fresh
    short = {"kind": "pretrain", "steps": 4, "batch": 4, "physics": SHORT,
             "validation": {"every_steps": 0}}
    asked = {"kind": "pretrain", "preset": "workstation", "steps": 4, "batch": 4}
    run(service, "trainings", short)
    assert [rate["steps"] for rate in service.get("/v1/rates")["items"]] == [320]
    page.open("overview")
    text = estimate(page, "training", asked)
    assert ": roughly " in text and text.endswith(" on 30 rollouts with the same settings.")
    run(service, "trainings", {**short, "steps": 8, "batch": 8, "physics": {"n_steps": 200}})
    text = estimate(page, "training", asked)
    assert ": about " in text
    assert text.endswith(" on 80 gradients and 30 rollouts with the same settings.")
    text = estimate(page, "training", {**asked, "validation": {"every_steps": 0}})
    assert text.startswith("16 gradients: about ")
    assert text.endswith(" on 80 gradients with the same settings.")


def test_little_work(fresh):
    _, page = fresh
    page.open("overview")
    request = {"designs": [{"voxels": "1"}], "physics": {"n_steps": 1}}
    assert estimate(page, "evaluation", request) == (
        "10 rollouts: less than 0.01 core-seconds. Measured here on 30 rollouts with the same "
        "settings.")
