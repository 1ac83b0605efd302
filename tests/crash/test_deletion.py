"""Deletion of a campaign with many designs, killed at any moment: the job is gone permanently, the
next start continues the deletion, and the database stays intact. Other writes happen between its
steps."""
import random
import sqlite3
import time

import requests

TABLES = ("jobs", "runs", "campaigns", "campaign_designs", "campaign_populations",
          "campaign_generations", "job_environments", "checkpoints")


def rows(daemon):
    with sqlite3.connect(f"file:{daemon.state}/morphod.db?mode=ro", uri=True) as db:
        found = {table: db.execute(f"SELECT count(*) FROM {table}").fetchone()[0]
                 for table in TABLES}
        assert db.execute("PRAGMA foreign_key_check").fetchall() == []
    db.close()
    return found


def test_killed_while_it_deletes(daemon, seed):
    generator = random.Random(seed)
    victim = daemon().start()
    campaign = victim.submit({
        "mode": "zero-shot", "population": 1024, "generations": 12, "physics": {"n_steps": 2},
        "environments": [{"light_xy_m": [3, 3], "terrain_sigma_m": 0, "seed": 1}]}, "campaigns")
    victim.succeed(campaign, "campaigns")
    designs = rows(victim)["campaign_designs"]
    assert designs > 10000
    assert requests.delete(f"{victim.address}/v1/jobs/{campaign}").status_code == 200
    partial, kills = set(), 0
    while kills == 0 or rows(victim)["jobs"] > 0:  # no check before the first kill: it takes time
        time.sleep(generator.uniform(0, 0.004))
        victim.kill()
        kills += 1
        partial.add(rows(victim)["campaign_designs"])
        victim.start()
        assert victim.get(f"/v1/jobs/{campaign}").status_code == 404
        assert victim.json("/v1/jobs?archived=all")["items"] == []
        if kills % 3 == 0:  # let it get further
            time.sleep(0.2)
        assert kills < 200
    assert any(0 < left < designs for left in partial), partial
    assert set(rows(victim).values()) == {0}, rows(victim)
    victim.end()
    print(f"{kills} kills, designs left: {sorted(partial)}")
