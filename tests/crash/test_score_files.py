"""kill -9 while scores are imported: acknowledged blocks are stored, no block is stored in part,
and sending the same file again completes it."""
import random
import re
import subprocess
import threading

import requests

from daemon import MORPHOCTL

CAMPAIGN = {"mode": "zero-shot", "population": 2000, "generations": 8, "physics": {"n_steps": 1},
            "exclude_pretraining": False, "racing": "off",
            "environments": [{"light_xy_m": [4.0, 3.0], "terrain_sigma_m": 0.05, "seed": seed}
                             for seed in range(4)]}


def enter(daemon, block):
    return requests.post(daemon.address + "/v1/scores", data=block, timeout=300,
                         headers={"Content-Type": "application/zstd"})


def computed(daemon):
    text = requests.get(daemon.address + "/metrics", timeout=300).text
    return int(re.search("^morphod_rollouts_total (.*)$", text, re.M)[1])


def blocks(path):
    data = path.read_bytes()
    while data:
        size = 12 + int.from_bytes(data[8:12], "little")
        yield data[:size]
        data = data[size:]


def test_kill_while_scores_enter(daemon, soak, seed, tmp_path):
    print(f"seed {seed}")
    generator = random.Random(seed)
    home, path = daemon("home"), tmp_path / "scores"
    with home:
        home.succeed(home.submit(CAMPAIGN, "campaigns"), "campaigns")
        subprocess.run([MORPHOCTL, "--server", home.address, "scores", "export", path], check=True,
                       timeout=300)
        home.end()
    victim, seconds, entered = daemon("victim"), 0.8, []

    def send():
        for block in blocks(path):
            try:
                reply = enter(victim, block)
            except requests.RequestException:
                return
            assert reply.status_code == 200, reply.text
            entered.append(reply.json()["new"] + reply.json()["known"])

    for _ in range(20 if soak else 4):
        victim.start()
        entered.clear()
        thread = threading.Thread(target=send)
        thread.start()
        thread.join(generator.uniform(0, seconds))
        victim.kill()
        thread.join()
        acknowledged = sum(entered)
    victim.start()
    shown = [enter(victim, block).json() for block in blocks(path)]
    assert all(0 in (one["new"], one["known"]) for one in shown), "a block in part"
    known = sum(one["known"] for one in shown)
    assert known + sum(one["new"] for one in shown) == 4 * 9 * CAMPAIGN["population"]
    assert known >= acknowledged, "acknowledged is durable"
    print(f"{known} rollouts were stored before the last kill")
    victim.succeed(victim.submit(CAMPAIGN, "campaigns"), "campaigns")
    assert computed(victim) == 0
    victim.end()
