"""kill -9 while a bundle is imported: afterwards either all of it is stored, or nothing."""
import random
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
    seen = set()
    for _ in range(40 if soak else 8):
        victim.start()
        replies = []
        thread = threading.Thread(target=send, args=(victim, bundle, replies))
        begun = time.monotonic()
        thread.start()
        thread.join(generator.uniform(0, seconds))
        victim.kill()
        thread.join()
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
            assert victim.json("/v1/designs")["items"] == []
            assert victim.json("/v1/evaluations")["items"] == []
        victim.end()
        if items:
            victim = daemon(f"victim-{len(seen)}-{generator.random()}")
    print(f"campaigns after a kill: {sorted(seen)}")
