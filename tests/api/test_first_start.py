"""The first start of a daemon whose settings name no controller: it stores those of the
installation."""

import hashlib
import os
import pathlib
import subprocess

import pytest

import service as module
from ctl import MORPHOCTL
from service import DESIGN, run

# The daemon with the source tree's controllers as those of the installation.
IN_PLACE = pathlib.Path(module.BINARY).parents[2] / "tests" / "morphod-in-place"
CONTROLLERS = module.SOURCE / "data" / "controllers"
BAR = {"cells": [[2, 2, 0], [3, 2, 0]]}


def hash_of(name):
    return hashlib.sha256((CONTROLLERS / f"{name}.safetensors").read_bytes()).hexdigest()


@pytest.fixture
def in_place(start, monkeypatch):
    """in_place(…) starts it without a default controller."""
    class Unconfigured(subprocess.Popen):
        def __init__(self, command, **how):
            super().__init__([part for part in command
                              if not part.startswith("--default-controller")], **how)

    monkeypatch.setattr(module, "BINARY", str(IN_PLACE))
    monkeypatch.setattr(module.subprocess, "Popen", Unconfigured)
    return start


def test_the_shipped_controllers(in_place, tmp_path):
    service = in_place(state=tmp_path)
    shown = {row["name"]: row["sha256"] for row in service.get("/v1/controllers")["items"]}
    assert shown == {"default": hash_of("phototaxis-16ms"),
                     "phototaxis-16ms": hash_of("phototaxis-16ms"),
                     "phototaxis": hash_of("phototaxis"),
                     "generalist-16ms": hash_of("generalist-16ms"),
                     "robust-16ms": hash_of("robust-16ms")}
    assert service.get("/v1/controllers/default")["control_period_s"] == 0.016
    small = {"designs": [DESIGN], "environments": [{"light_xy_m": [3, 3], "terrain_sigma_m": 0,
                                                    "seed": 1}]}
    done = run(service, "evaluations", small)
    assert done["warnings"] == [] and 0 < done["results"][0]["score"] < 1
    paper = run(service, "evaluations", small | {"physics": "paper", "controller": "phototaxis"})
    assert paper["warnings"] == [] and 0 < paper["results"][0]["score"] < 1
    # The next start takes nothing from the installation: a client may have chosen another one.
    assert service.request("DELETE", "/v1/controllers/phototaxis").status == 204
    assert service.stop() == 0
    again = in_place(state=tmp_path)
    assert {row["name"] for row in again.get("/v1/controllers")["items"]} == {
        "default", "generalist-16ms", "phototaxis-16ms", "robust-16ms"}


def test_rankings_under_the_physics_of_the_paper(in_place):
    """As clients ask for them: the same rows as over HTTP, and other ones than by default."""
    service = in_place()
    run(service, "evaluations", {"designs": [DESIGN]})
    run(service, "evaluations", {"designs": [BAR], "physics": "paper",
                                 "controller": "phototaxis"})
    environment = {name: value for name, value in os.environ.items()
                   if not name.startswith("MORPHO")}
    environment.update(MORPHOD_SERVER=service.addresses[0], LC_ALL="C.UTF-8")

    def listed(*options):
        done = subprocess.run([MORPHOCTL, "design", "list", "--sort", "score", "--json", *options],
                              env=environment, capture_output=True, text=True, check=True)
        return module.json.loads(done.stdout)["items"]

    def ranked(query):
        return service.get(f"/v1/designs?sort=score{query}")["items"]

    paper = listed("-c", "phototaxis", "--physics", "paper")
    assert paper == ranked("&controller=phototaxis&physics=paper") and len(paper) == 1
    assert listed() == listed("-p", "default", "-e", "paper-test") == ranked("") != paper
    assert len(ranked("")) == 1 and ranked("&physics=paper") == listed("-p", "paper") == []
    assert listed("-e", "morpho-12-walk") == []
    done = subprocess.run([MORPHOCTL, "design", "list", "--sort", "score", "-p", "split"],
                          env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 2 and "paper" in done.stderr
