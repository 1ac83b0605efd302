import sys
import pathlib

import pytest

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parent))

from browser import Browser  # noqa: E402
from fixtures import start  # noqa: E402, F401
from service import DESIGN, Service, run  # noqa: E402

CAMPAIGN = {
    "mode": "zero-shot", "population": 12, "generations": 4, "physics": {"n_steps": 60},
    "exclude_pretraining": False, "label": "<b>walkers</b> & others",
    "environments": [{"light_xy_m": [4.0, 3.0], "terrain_sigma_m": 0.05, "seed": 3}]
}
TRAINING = {
    "kind": "finetune", "name": "tuned", "steps": 4, "batch": 4, "designs": [DESIGN],
    "physics": {"n_steps": 20}, "validation": {"every_steps": 2, "designs": 2, "environments": 2}
}


def make_study(running):
    """A study with two batches, which is waiting for its client."""
    study = {"mode": "study", "label": "a study", "environments": CAMPAIGN["environments"],
             "physics": CAMPAIGN["physics"]}
    id = running.post("/v1/campaigns", study)["id"]
    bodies = [DESIGN, {"cells": [[0, 0, 0], [1, 0, 0], [1, 1, 0]]}]
    for batch, parents in enumerate(([], [0, 1])):
        children = [{"body": body, "parents": parents, "operator": "dice", "measures": {"reach": 2}}
                    for body in bodies]
        running.post(f"/v1/campaigns/{id}/tell", {"batch": batch, "children": children},
                     headers={"Prefer": "wait=30"})
    return id


@pytest.fixture(scope="session")
def service():
    """A daemon with jobs and data of every kind."""
    running = Service()
    running.campaign = run(running, "campaigns", CAMPAIGN)["id"]
    running.request("PATCH", f"/v1/jobs/{running.campaign}",
                    {"experiment": "first steps", "note": "It falls.\nIt gets up."})
    running.study = make_study(running)
    running.training = run(running, "trainings", TRAINING)["id"]
    running.evaluation = running.evaluate(
        {"designs": [DESIGN, {"cells": [[0, 0, 0], [1, 0, 0]]}]}).json()["id"]
    yield running
    assert running.close() == 0, running.log_text()


@pytest.fixture(scope="session")
def browser(service):
    opened = Browser(service)
    yield opened
    opened.quit()


@pytest.fixture(scope="module")
def still(browser):
    """Robots stand still until they are asked to walk."""
    def prefer(value):
        browser.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {
            "features": [{"name": "prefers-reduced-motion", "value": value}]})

    prefer("reduce")
    yield
    prefer("")
