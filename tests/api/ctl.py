"""morphoctl, run against the daemon of these tests."""

import json
import os
import shlex
import subprocess

import pytest
from service import BINARY, DESIGN

MORPHOCTL = os.environ.get(
    "MORPHOCTL",
    os.path.join(os.path.dirname(BINARY), "..", "..", "clients", "morphoctl", "morphoctl"))
SHORT = "--physics n_steps=20"
CELLS = json.dumps(DESIGN)


@pytest.fixture(scope="module")
def ctl(service):

    def run(command, *arguments, server=None, input_text="", **variables):
        environment = {k: v for k, v in os.environ.items() if not k.startswith("MORPHOD")}
        environment.update({"MORPHOD_SERVER": server or service.addresses[0], "LC_ALL": "C.UTF-8"},
                           **variables)
        done = subprocess.run([MORPHOCTL, *shlex.split(command), *arguments],
                              input=input_text,
                              capture_output=True,
                              text=True,
                              timeout=300,
                              env=environment)
        return done.returncode, done.stdout, done.stderr

    return run
