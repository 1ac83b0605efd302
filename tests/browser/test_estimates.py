"""The estimate of a form: rollouts, processor time and minutes, from what was measured here."""

import re

import pytest

from browser import Browser
from fixtures import start  # noqa: F401
from service import DESIGN, run

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


def figures(browser, words="Based on"):
    """Returns the text, and its numbers of gradients, rollouts and core-seconds."""
    browser.until(f"{SHOWN}.includes({words!r})")
    text = browser.run(f"return {SHOWN}")
    found = [re.search(rf"([\d.,]+) {unit}", text)
             for unit in ("gradient", "rollout", "core-second")]
    return text, [float(one[1].replace(",", "")) if one else None for one in found]


@pytest.fixture()
def fresh(start):
    """A page of a daemon that has computed nothing."""
    running = start()
    opened = Browser(running)
    yield running, opened
    opened.quit()


def test_a_campaign_takes_what_was_estimated(fresh):
    service, page = fresh
    assert service.get("/v1/rates")["items"] == []
    form(page, "campaign")
    enter(page, preset="demo", population=24, generations=4)
    text, (_, rollouts, seconds) = figures(page)
    assert text.startswith("Up to 1,200 rollouts: roughly ") and rollouts == 1200
    assert "Based on 30 rollouts like these" in text
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
    figures(browser, "Nothing like these was measured here yet")

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
    id = service.evaluate({"designs": [DESIGN], "physics": {"n_steps": 4000}}).json()["id"]
    form(browser, "evaluation", f"evaluations/{id}", "Start again with…")
    text, (_, rollouts, long) = figures(browser)
    assert text.startswith("10 rollouts: about ") and rollouts == 10
    id = service.evaluate({"designs": [DESIGN], "physics": {"n_steps": 400}}).json()["id"]
    form(browser, "evaluation", f"evaluations/{id}", "Start again with…")
    assert long / figures(browser)[1][2] == pytest.approx(10, rel=0.3)
    form(browser, "campaign", f"campaigns/{service.campaign}", "Start again with…")
    assert figures(browser)[1][1] == 12 * 5
    form(browser, "training", f"trainings/{service.training}", "Start again with…")
    assert figures(browser)[1][0] == 16
    assert browser.faults() == []
