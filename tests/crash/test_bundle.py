"""kill -9 while a bundle is imported: afterwards readers see all of its campaigns and evaluations,
or none. In that case their rows are deleted, and the bundle can be imported again."""
import contextlib
import random
import shutil
import sqlite3
import tempfile
import threading
import time

import requests

CAMPAIGN = {"mode": "zero-shot", "population": 500, "generations": 8, "physics": {"n_steps": 1},
            "exclude_pretraining": False,
            "environments": [{"light_xy_m": [4.0, 3.0], "terrain_sigma_m": 0.05, "seed": 3}]}


def send(daemon, bundle, replies):
    try:
        replies.append(requests.post(daemon.address + "/v1/bundles", data=bundle,
                                     headers={"Content-Type": "application/zstd"}, timeout=300))
    except requests.RequestException:
        replies.append(None)


def recordings(daemon, id):
    return requests.get(f"{daemon.address}/v1/evaluations/{id}/trajectories", timeout=300).content


def hidden(daemon):
    """Counts the jobs that readers do not see, because they are being imported or deleted. Reads a
    copy, so that a killed daemon's log stays for its next start."""
    with tempfile.TemporaryDirectory() as folder:
        for name in ("morphod.db", "morphod.db-wal"):
            if (daemon.state / name).exists():
                shutil.copy(daemon.state / name, folder)
        with contextlib.closing(sqlite3.connect(f"{folder}/morphod.db")) as database:
            return database.execute("SELECT count(*) FROM jobs WHERE state=6").fetchone()[0]


def hidden_now(daemon):
    """The same of a daemon that runs."""
    with contextlib.closing(sqlite3.connect(f"file:{daemon.state}/morphod.db?mode=ro",
                                            uri=True)) as database:
        return database.execute("SELECT count(*) FROM jobs WHERE state=6").fetchone()[0]


def test_kill_while_a_bundle_enters(daemon, soak, seed):
    print(f"seed {seed}")
    generator = random.Random(seed)
    home = daemon("home")
    with home:
        campaign = home.succeed(home.submit(CAMPAIGN, "campaigns"), "campaigns")
        best = home.json(f"/v1/campaigns/{campaign['id']}/population?limit=20")["items"]
        seen = home.score({"designs": [{"voxels": row["genotype"]} for row in best],
                           "environments": CAMPAIGN["environments"], "record": ["masses"],
                           "physics": CAMPAIGN["physics"]})
        recorded = recordings(home, seen["id"])
        bundle = requests.get(home.address + "/v1/bundles?recordings=true", timeout=300).content
        designs = requests.get(
            f"{home.address}/v1/campaigns/{campaign['id']}/phylogeny?format=csv", timeout=300).text
        home.end()
    victim = daemon("victim")
    seconds = 2.0
    seen, in_the_middle = set(), 0
    for round in range(40 if soak else 8):
        victim.start()
        replies = []
        thread = threading.Thread(target=send, args=(victim, bundle, replies))
        begun = time.monotonic()
        thread.start()
        if round < 2:  # surely in the middle, unless the daemon is very fast
            victim.until(lambda: hidden_now(victim) > 0 or not thread.is_alive())
        else:
            thread.join(generator.uniform(0, seconds))
        victim.kill()
        thread.join()
        in_the_middle += hidden(victim) > 0
        if replies[0] is not None:
            seconds = time.monotonic() - begun
        victim.start()
        items = victim.json("/v1/campaigns")["items"]
        assert replies[0] is None or replies[0].status_code in (200, 201)
        assert len(items) == 1 or (items == [] and replies[0] is None), "acknowledged is durable"
        seen.add(len(items))
        if items:
            table = f"{victim.address}/v1/campaigns/{items[0]['id']}/phylogeny?format=csv"
            assert requests.get(table, timeout=300).text == designs
            entered = victim.json("/v1/evaluations")["items"][0]["id"]
            assert recordings(victim, entered) == recorded
        else:
            assert victim.json("/v1/jobs")["items"] == []
            assert victim.json("/v1/usage?by=kind")["items"] == []
        victim.until(lambda: hidden_now(victim) == 0)
        victim.end()
        if items:
            victim = daemon(f"victim-{len(seen)}-{generator.random()}")
    # The last victim may have parts of many imports that were killed.
    victim.start()
    replies = []
    send(victim, bundle, replies)
    assert replies[0].status_code in (200, 201) and len(victim.json("/v1/campaigns")["items"]) == 1
    victim.end()
    print(f"campaigns after a kill: {sorted(seen)}; in the middle of an import: {in_the_middle}")
    assert in_the_middle > 0
