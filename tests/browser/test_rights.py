"""What pages offer to users who may only read; links with another token."""


import pytest

from browser import Browser
from service import DESIGN, run

READ, SUBMIT = "a-token-that-may-look-only", "a-token-that-may-submit"
NAME = "<img/src=x>rita"  # an operator may write any name
CAMPAIGN = {
    "mode": "zero-shot", "population": 8, "generations": 1, "physics": {"n_steps": 60},
    "exclude_pretraining": False, "label": "<b>walkers</b>",
    "environments": [{"light_xy_m": [4.0, 3.0], "terrain_sigma_m": 0.05, "seed": 3}]
}
WRITES = ("New evaluation", "New training", "New campaign", "Pause", "Resume", "Cancel", "Extend",
          "Breed these", "Edit", "Archive", "Start again with…")
BUTTONS = "main button:not(.stage *, [hidden])"  # the stage has its own Pause


@pytest.fixture
def guarded(start, tmp_path):
    """A daemon that requires a token for every request, with a job in each state that has
    buttons."""
    path = tmp_path / "tokens"
    path.write_text(f"{NAME} read {READ}\n<b>sam</b> submit {SUBMIT}\n")
    path.chmod(0o600)
    service = start(f"--token-file={path}", "--token-on-loopback=yes", token=SUBMIT)
    service.campaign = run(service, "campaigns", CAMPAIGN)["id"]
    service.post(f"/v1/campaigns/{service.campaign}/extend", {"generations": 90000})
    service.post(f"/v1/jobs/{service.campaign}/pause", None)
    return service


@pytest.fixture
def page(guarded):
    browser = Browser(guarded)
    yield browser
    browser.quit()


def shown(browser, view, token=None):
    """Opens a view, with the token in the address if one is given. Returns the texts of its
    buttons."""
    browser.driver.get("about:blank")
    browser.driver.get(f"{browser.base}#/{view}" + (f"&token={token}" if token else ""))
    browser.until("document.querySelector('main h1')")
    return set(browser.texts(BUTTONS))


def test_who_may_only_look(guarded, page):
    """No page has a button that writes; each shows the reason, and the name as text."""
    views = ("overview", "", "campaigns", f"campaigns/{guarded.campaign}", "trainings", "lab",
             "designs")
    seen = set()
    for i, view in enumerate(views):
        seen |= shown(page, view, SUBMIT if i == 0 else None)
    # Users who may submit see the buttons. The campaign is paused.
    assert set(WRITES) - {"Pause"} <= seen
    page.run("sessionStorage.clear()")
    for i, view in enumerate(views):
        buttons = shown(page, view, READ if i == 0 else None)
        page.until("document.querySelector('.note')?.innerText.includes('has the right read')")
        assert not buttons & set(WRITES), view
        assert page.run("return document.querySelectorAll('main .field input[type=number]')"
                        ".length") == 0
        assert NAME in page.texts(".caller")[0] and NAME in page.texts(".note")[0]
        assert page.run("return document.querySelectorAll('header img, .note img, main b')"
                        ".length") == 0
    page.until("document.querySelector('h1')?.textContent === 'Designs'")
    shown(page, "overview")
    page.until("[...document.querySelectorAll('main td')].some((e) => "
               "e.innerText.includes('by <b>sam</b>'))")
    assert page.faults() == []


def test_pages_that_only_show(start):
    """dashboard = read-only: the pages omit all buttons that write, for everyone; the API still
    accepts writes."""
    service = start("--dashboard=read-only")
    service.evaluate({"designs": [DESIGN]})
    browser = Browser(service)
    try:
        browser.open("")
        browser.until(
            "document.querySelector('.note')?.innerText.includes('dashboard = read-only')")
        assert not set(browser.texts(BUTTONS)) & set(WRITES)
        assert browser.faults() == []
    finally:
        browser.quit()


def whose(page):
    return page.run("return document.querySelector('.caller').innerText")


def test_a_link_asks_before_it_replaces_a_token(guarded, page):
    """The other token is used only if it works. In any case, it is removed from the address
    immediately."""
    shown(page, "", SUBMIT)
    page.until("document.querySelector('.caller').innerText.includes('sam')")
    link = f"location.hash = '#/campaigns&token={READ}'"
    page.run(link)
    page.until("document.querySelector('dialog[open]')")
    assert "token" not in page.run("return location.href")
    assert "<b>sam</b>" in page.texts("dialog")[0]
    page.click("Keep", "dialog button")
    page.until("document.querySelector('h1')?.textContent === 'Runs'")
    assert "sam" in whose(page) and page.run("return sessionStorage['morphod-token']") == SUBMIT
    page.run(link)
    page.until("document.querySelector('dialog[open]')")
    page.click("Use the other token", "dialog button")
    page.until("document.querySelector('.caller').innerText.includes('rita')")
    # A token that no longer works is replaced without a question.
    page.run("sessionStorage['morphod-token'] = 'of-nobody-any-more'")
    shown(page, "", SUBMIT)
    page.until("document.querySelector('.caller').innerText.includes('sam')")
    assert page.run("return document.querySelectorAll('dialog').length") == 0
    assert SUBMIT not in guarded.log_text() and READ not in guarded.log_text()
    assert page.run("return document.cookie") == ""


