"""The shipped job file on a real Slurm cluster: its workers compute a campaign for a daemon while a
node crashes, jobs are cancelled, and a job reaches its time limit. The campaign equals that of a
single machine."""

import os
import pathlib
import re
import subprocess
import time

import cluster
from service import BINARY, SOURCE, run, until

CTL = os.environ.get("MORPHOCTL", str(SOURCE / "build/clients/morphoctl/morphoctl"))
TOKENS = {"admin": "a-token-that-may-everything-here", "worker": "a-token-of-a-worker-and-no-more"}
CAMPAIGN = {"mode": "zero-shot", "population": 24, "generations": 100, "seed": 5,
            "physics": {"n_steps": 300}}


def rows_of(service, campaign):
    """Returns the results of a campaign, without durations."""
    lists = [service.pages(f"/v1/campaigns/{campaign}/{what}")
             for what in ("generations", "population")]
    return [{name: value for name, value in row.items() if name != "seconds"}
            for rows in lists for row in rows]


def a_daemon(start, folder, *flags):
    """Returns a daemon that the nodes can reach, and the command with which a user starts workers
    for it."""
    files = [str(folder / name) for name in ("fleet.pem", "fleet.key", "tokens", "token")]
    subprocess.run(["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt",
                    "ec_paramgen_curve:prime256v1", "-nodes", "-days", "1", "-subj", "/CN=lab",
                    "-out", files[0], "-keyout", files[1]], check=True, capture_output=True)
    pin = subprocess.run(f"openssl x509 -in {files[0]} -pubkey -noout | openssl pkey -pubin "
                         "-outform der | openssl dgst -sha256 -binary | base64", shell=True,
                         check=True, capture_output=True, text=True).stdout.strip()
    for path, lines in ((files[2], TOKENS.items()), (files[3], [("worker", TOKENS["worker"])])):
        with open(path, "w", opener=lambda p, f: os.open(p, f, 0o600)) as file:
            file.writelines(f"{right} {right} {token}\n" for right, token in lines)
    service = start(f"--fleet-listen={cluster.ADDRESS}:0", f"--fleet-certificate={files[0]}",
                    f"--fleet-key={files[1]}", f"--token-file={files[2]}", "--compute=fleet",
                    *flags, token=TOKENS["admin"])
    return service, [CTL, "fleet", "slurm", f"--fleet={service.addresses[-1]}",
                     f"--pin=sha256//{pin}", f"--worker-token-file={files[3]}", "--cpus=2"]


def install(slurm, binary):
    """Puts a program where the jobs find it."""
    place = slurm.base / "morphod"
    place.unlink(missing_ok=True)
    place.symlink_to(binary)
    slurm.environment["PATH"] = f"{slurm.base}:{os.environ['PATH']}"


def submit_job(slurm, command, *options):
    made = subprocess.run([*command, *options], check=True, capture_output=True, text=True)
    script = slurm.base / "workers.sbatch"
    script.write_text(made.stdout)
    return re.search(r"\d+$", slurm.slurm("sbatch", str(script)))[0]


def sessions(service):
    """Returns the names of the hosts that compute."""
    return sorted(session["host"] for session in service.get("/v1/fleet")["sessions"]
                  if session["ended_at"] is None)


def test_a_campaign_survives_what_slurm_does(slurm, start, tmp_path):
    alone = start("--workers=2")
    expected = rows_of(alone, run(alone, "campaigns", CAMPAIGN, 600)["id"])
    alone.close()
    service, command = a_daemon(start, tmp_path)
    install(slurm, BINARY)
    campaign = service.post("/v1/campaigns", CAMPAIGN)["id"]

    def submit(*options):
        return submit_job(slurm, command, *options)

    def generation():
        return service.get(f"/v1/campaigns/{campaign}")["progress"]["generation"] or 0

    def goes_on(generations=2):
        begin = generation()
        until(lambda: generation() >= begin + generations)

    first = submit("--workers=2")
    until(lambda: sessions(service) == ["n1", "n2"])
    goes_on()
    # A node disappears: its leases go to the other one after 6 s of silence. Slurm notices later.
    slurm.crash("n1")
    until(lambda: sessions(service) == ["n2"])
    assert [one["why"] for one in service.get("/v1/fleet")["sessions"]
            if one["state"] == "lost"] == ["it stopped responding"]
    goes_on()
    # scancel: the worker leaves in order and without a silence, so it is not lost.
    slurm.slurm("scancel", first)
    until(lambda: sessions(service) == [])
    assert service.get("/v1/fleet")["lost"] == 1
    # A job that reaches its limit of two minutes has left before, and counts as completed.
    slurm.revive("n1")
    slurm.until(lambda: slurm.states() == ["idle", "idle"])
    short = submit("--workers=1", "--time=2")
    until(lambda: sessions(service) != [])
    goes_on()
    assert service.act(campaign, "pause").status in (200, 202)
    until(lambda: sessions(service) == [], 130)
    slurm.until(lambda: f"JobId={short}" not in slurm.jobs("RUNNING"))
    assert f"JobId={short}" in slurm.jobs("COMPLETED")
    assert service.act(campaign, "resume").status in (200, 202)
    # A further array finishes the campaign, and leaves when there is no more work.
    last = submit("--workers=2", "--idle=2s")
    until(lambda: service.get(f"/v1/campaigns/{campaign}")["state"] == "succeeded", 600)
    slurm.until(lambda: f"ArrayJobId={last}" not in slurm.jobs("RUNNING"))
    assert rows_of(service, campaign) == expected
    status = service.get("/v1/fleet")
    assert (status["lost"], status["audits_failed"]) == (1, 0)


def test_an_upgrade_restarts_the_job(slurm, start, tmp_path):
    service, command = a_daemon(start, tmp_path)
    install(slurm, pathlib.Path(BINARY).parents[2] / "tests" / "morphod-older")
    job = submit_job(slurm, command, "--workers=1", "--idle=1h")
    until(lambda: sessions(service) != [])
    (old, ) = service.get("/v1/fleet")["sessions"]
    install(slurm, BINARY)
    path = f"/v1/fleet/sessions/{old['id']}/drain?upgrade=true"
    assert old["older"] and service.request("POST", path).status == 204
    began = time.monotonic()
    until(lambda: sessions(service) == [])
    slurm.until(lambda: f"ArrayJobId={job}" in slurm.jobs("PENDING"))
    until(lambda: sessions(service) != [], 300)
    print(f"back after {time.monotonic() - began:.0f} s")
    new, *_ = service.get("/v1/fleet")["sessions"]
    assert new["version"] == service.get("/healthz")["version"] != old["version"]
    slurm.slurm("scancel", job)
