"""A study with an own score: its pages name that score and its unit, not meters or losses."""

import pytest

from conftest import CAMPAIGN
from service import await_end

OWN = {"name": "speed_lost", "unit": "m/s"}
BODIES = [{"cells": [[x, 0, 0] for x in range(n)]} for n in (2, 3, 4)]


@pytest.fixture(scope="module")
def study(service):
    id = service.post("/v1/campaigns", {
        "mode": "study", "label": "own", "own_score": OWN, "environments": [{"task": "walk"}],
        "physics": CAMPAIGN["physics"]})["id"]
    for batch, scores in enumerate(((-1.25, -0.5), (-2.0,))):
        bodies = BODIES[2 * batch:2 * batch + 2]
        service.post(f"/v1/campaigns/{id}/tell", {"batch": batch, "children": [
            {"body": body, "score": score} for body, score in zip(bodies, scores)]},
            headers={"Prefer": "wait=30"})
    return id


def test_the_campaign(browser, study):
    browser.open("campaigns/" + study)
    browser.until("document.querySelectorAll('.card strong.number').length === 3")
    numbers = browser.texts(".card strong.number")
    assert numbers[0] == "-2 m/s" and set(numbers) == {"-2 m/s", "-1.25 m/s", "-0.5 m/s"}
    page = browser.run("return document.querySelector('main').innerText")
    assert "speed_lost, m/s" in page and "sent by the client" in page
    assert "ranked by speed_lost, computed by its client" in page
    assert "Meters walked" not in page
    assert browser.faults() == []


def test_the_phylogeny(browser, study):
    """Negative scores are not lower bounds, and the best is the brightest."""
    browser.open(f"campaigns/{study}/phylogeny?design=2")
    browser.until("document.querySelector('main').innerText.includes('speed_lost -2 m/s')")
    page = browser.run("return document.querySelector('main').innerText")
    assert "speed_lost -0.5" in page and "-2, the best" in page
    assert "≥" not in page and "lower bound" not in page.lower()
    assert browser.faults() == []


def test_it_is_not_compared_with_scores_of_the_service(browser, service, study):
    browser.open(f"campaigns/{study}?compare={service.study}")
    browser.until("document.querySelector('main').innerText.includes('cannot be compared')")
    assert "speed_lost m/s; mean" in browser.run("return document.querySelector('main').innerText")
    assert browser.faults() == []


def test_other_aggregates_are_not_compared(browser, service):
    """They are scores of another kind. The settings show the aggregate, in bold."""
    ids = [service.post("/v1/campaigns", CAMPAIGN | {"aggregate": one, "generations": 1})["id"]
           for one in ("mean", {"kind": "cvar", "level": 0.75})]
    for id in ids:
        await_end(service, f"/v1/campaigns/{id}")
    browser.open(f"campaigns/{ids[0]}?compare={ids[1]}")
    browser.until("document.querySelector('main').innerText.includes('cannot be compared')")
    assert "their scores (mean; cvar 0.75)" in browser.run(
        "return document.querySelector('main').innerText")
    browser.open(f"campaigns/{ids[1]}/settings")
    browser.until("document.querySelector('dl.settings strong')")
    assert "cvar 0.75" in browser.texts("dl.settings strong")
    assert browser.faults() == []
