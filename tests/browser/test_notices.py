"""A notice at the end of a run: a notification, or a line and the title where there are none."""

import pytest

from conftest import CAMPAIGN
from service import until

BUTTON = "[...document.querySelectorAll('main button')].find((e) => e.innerText === 'Notify me')"
TOAST = "document.querySelector('#toast[data-open] span')?.innerText"
# What a browser has, and what the user answers; headless browsers refuse everything.
FAKE = """
window.asked = 0;
window.shown = [];
class Notification {
  static permission = sessionStorage.answer ?? '%s';
  static async requestPermission() {
    asked++;
    return Notification.permission = sessionStorage.answer = '%s';
  }
  constructor(text, { tag }) { shown.push(text); this.tag = tag; window.newest = this; }
  close() { window.wasClosed = true; }
}
window.Notification = Notification;
"""


@pytest.fixture
def endless(service):
    id = service.post("/v1/campaigns", CAMPAIGN | {"generations": 90000, "label": "long"})["id"]
    until(lambda: service.get(f"/v1/campaigns/{id}")["progress"]["generation"] is not None)
    yield id
    service.act(id, "cancel")


@pytest.fixture
def faked(browser):
    """Lets a test choose what the browser answers, in all pages that it opens."""
    added = []

    def fake(before, answer):
        added.append(browser.driver.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {
            "source": FAKE % (before, answer)}))

    yield fake
    for one in added:
        browser.driver.execute_cdp_cmd("Page.removeScriptToEvaluateOnNewDocument", one)
    browser.run("localStorage.clear(); sessionStorage.clear()")


def test_a_notification_at_the_end(service, browser, endless, faked):
    """It is requested by a click, remembered, and comes on any page."""
    faked("default", "granted")
    browser.open(f"campaigns/{endless}")
    browser.until(BUTTON)
    assert browser.run(f"return [asked, {BUTTON}.ariaPressed]") == [0, "false"]
    browser.click("Notify me", "main button")
    browser.until(f"{TOAST}?.startsWith('You will get a notification')")
    assert browser.run("return asked") == 1
    browser.open(f"campaigns/{endless}")
    browser.until(f"{BUTTON}?.ariaPressed === 'true'")
    browser.run("location.hash = '#/designs'")
    browser.until("document.querySelector('h1')?.innerText === 'Designs'")
    service.act(endless, "cancel")
    browser.until("shown.length")
    assert browser.run("return shown") == ["long: cancelled"]
    browser.run("newest.onclick()")
    browser.until("document.querySelector('h1')?.innerText === 'long'")
    assert browser.run(f"return wasClosed && {BUTTON}.checkVisibility()") is False
    assert browser.faults() == []


def test_where_notifications_are_refused(service, browser, endless, faked):
    faked("denied", "denied")
    browser.open(f"campaigns/{endless}")
    browser.until(BUTTON)
    browser.click("Notify me", "main button")
    browser.until(f"{TOAST}?.startsWith('Notifications are not available')")
    assert browser.run("return asked") == 0
    browser.run("location.hash = '#/designs'")
    service.act(endless, "cancel")
    browser.until(f"{TOAST} === 'long: cancelled'")
    assert browser.run("return document.title") == "long: cancelled – Designs · morphod"
    browser.run("document.dispatchEvent(new KeyboardEvent('keydown', { key: 'Tab' }))")
    assert browser.run("return document.title") == "Designs · morphod"
    assert browser.run("return shown") == [] and browser.faults() == []


def test_a_hidden_tab_is_notified(service, browser, endless, faked):
    """Its events go on while someone waits for one."""
    faked("granted", "granted")
    browser.open(f"campaigns/{endless}")
    browser.until(BUTTON)
    browser.click("Notify me", "main button")
    browser.run("Object.defineProperty(document, 'hidden', { get: () => true });"
                "document.dispatchEvent(new Event('visibilitychange'));")
    service.act(endless, "cancel")
    browser.until("shown.length")


def test_a_tab_that_opens_in_the_background_is_notified(service, browser, endless, faked):
    faked("granted", "granted")
    browser.open(f"campaigns/{endless}")
    browser.until(BUTTON)
    browser.click("Notify me", "main button")
    hidden = "Object.defineProperty(document, 'hidden', { get: () => true });"
    with browser.adding(hidden):
        browser.open("designs")
        service.act(endless, "cancel")
        browser.until("shown.length")


def test_a_run_that_ended_while_no_tab_was_open(service, browser, endless, faked):
    faked("granted", "granted")
    browser.open(f"campaigns/{endless}")
    browser.until(BUTTON)
    browser.click("Notify me", "main button")
    browser.driver.get("about:blank")
    service.act(endless, "cancel")
    until(lambda: service.get(f"/v1/jobs/{endless}")["state"] == "cancelled")
    browser.open("designs")
    browser.until("shown.length")
    browser.open("designs")
    browser.until("document.querySelector('h1')")
    assert browser.run("return [shown, localStorage.length]")[0] == []
