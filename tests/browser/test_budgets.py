"""Budgets of the dashboard that do not depend on the speed of a machine. `tools/bench dashboard`
measures the others."""

import pytest

from contract import SOURCE

FOLDER = SOURCE / "clients" / "dashboard"


def test_all_files_together_are_small(service):
    page = service.request("GET", "/", headers={"Accept-Encoding": "gzip"})
    text = service.request("GET", "/").body.decode()
    root = "/" + text.split('type="module" src="')[1].split("app.js")[0]
    sizes = {"index.html": len(page.body)}
    for file in [file for kind in ("js", "css", "svg") for file in FOLDER.rglob("*." + kind)]:
        name = file.relative_to(FOLDER).as_posix()
        reply = service.request("GET", root + name, headers={"Accept-Encoding": "gzip"})
        assert (reply.status, reply.headers["Content-Encoding"]) == (200, "gzip"), name
        sizes[name] = len(reply.body)
    assert sum(sizes.values()) <= 150e3, sizes


@pytest.mark.parametrize("view, shown, length", [
    # The page, its frame, the view's modules beside the number of the newest event, the data. The
    # newest events may come between these.
    ("", "document.querySelector('.tile')", 5),
    # The same, then the robots.
    ("stage", "performance.getEntriesByName('morphod-first-picture').length", 6)
])
def test_a_page_waits_for_few_requests_in_a_row(browser, view, shown, length):
    assert browser.chain(view, shown) <= length
