"""A row that cannot be decoded is an internal error: 500, and a line in the log."""

import contextlib
import sqlite3

from service import DESIGN, SHORT


def test_a_row_that_cannot_be_decoded(start, tmp_path):
    first = start(state=tmp_path)
    assert first.evaluate({"designs": [DESIGN], "physics": SHORT}).json()["state"] == "succeeded"
    first.stop()
    with contextlib.closing(sqlite3.connect(tmp_path / "morphod.db")) as database:
        database.execute("UPDATE physics SET encoding = x'02'")
        database.commit()
    service = start(state=tmp_path)
    for path in ("/v1/jobs/1", "/v1/jobs", "/v1/evaluations/1"):
        reply = service.request("GET", path)
        assert reply.status == 500 and "stored data is corrupt" in reply.json()["detail"], path
    assert "stored data is corrupt" in service.log_text()
    assert service.evaluate({"designs": [DESIGN],
                             "physics": {"n_steps": 7}}).json()["state"] == "succeeded"
