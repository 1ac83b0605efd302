"""Requests that schemathesis generates from the contract, valid and invalid ones, for all
operations.

It is not a package of Debian 12, so this runs only on request, for this many seconds:
    MORPHO_GENERATED=600 MORPHO_SCHEMATHESIS=…/bin/schemathesis python3 -m pytest
    tests/api/test_generated.py"""

import os
import pathlib
import shutil
import subprocess

import pytest

SECONDS = os.environ.get("MORPHO_GENERATED")
PROGRAM = os.environ.get("MORPHO_SCHEMATHESIS") or shutil.which("schemathesis")
CONFIG = """
hooks = "generated_rules.py"
[parameters]
"header.Prefer" = "wait=0"   # so that it does not wait for jobs
[[operations]]
include-operation-id = "getEvents"
parameters = {{ "query.format" = "json" }}   # a stream has no end
[[operations]]   # the campaign that was made need not be a study
include-operation-id = ["askStudy", "tellStudy", "getStudyBatch", "getStudySampler", "finishStudy"]
checks.ensure_resource_availability.enabled = false
[checks]
positive_data_acceptance.enabled = false   # generated_rules.py checks the refusals
use_after_free.enabled = false   # DELETE of a job cancels it; the job stays
"""


@pytest.mark.skipif(not SECONDS, reason="MORPHO_GENERATED is not a number of seconds")
@pytest.mark.skipif(
    not PROGRAM, reason="schemathesis is not installed, and MORPHO_SCHEMATHESIS is not its path")
def test_generated_requests(start, tmp_path):
    service = start()
    config = tmp_path / "schemathesis.toml"
    config.write_text(CONFIG.format())
    hooks = pathlib.Path(__file__).with_name("generated_rules.py")
    shutil.copy(hooks, tmp_path)
    done = subprocess.run([
        PROGRAM, "run", f"http://{service.host}:{service.port}/openapi.json",
        f"--max-time={SECONDS}", "--continue-on-failure", "--rate-limit=100/s",
        "--request-timeout=30", "--generation-database=none", "--suppress-health-check=all",
        "--no-color"
    ],
                          cwd=tmp_path,
                          stdout=subprocess.PIPE,
                          stderr=subprocess.STDOUT,
                          text=True,
                          check=False)
    assert done.returncode == 0, done.stdout[-20000:]
    assert service.request("GET", "/readyz").status == 200
