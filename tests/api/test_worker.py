"""`morphod worker` with a fake daemon: leases in, rows out, and what can go wrong.
"""

import hashlib
import json
import os
import pathlib
import re
import socket
import subprocess
import time

import pytest

from contract import SOURCE
from fleet_daemon import DONE, GIVEN_BACK, PASSIVE, FakeDaemon, Lease, Proxy, Worker, message
from service import BINARY, SOON_S, soon, until

DESIGNS = [json.loads((SOURCE / "data/designs" / f"{name}.json").read_text())
           for name in ("voxel", "table", "wheel", "crawler")]
N_STEPS = 200
LIAR = os.environ.get("MORPHO_LIAR")
MODULE = pathlib.Path(BINARY).parents[2] / "tests" / "device" / "fake-device.so"


def evaluated(service, **physics):
    return service.evaluate({"designs": [{"cells": design["cells"]} for design in DESIGNS],
                             "physics": {"n_steps": N_STEPS} | physics}).json()


def losses_of(done):
    return [tuple(result["losses"]) for result in done["results"]]


@pytest.fixture(scope="module")
def known(service):
    """Replies of a daemon about some designs: genotypes, environments, weights, losses."""
    done = evaluated(service)
    worlds = service.get("/v1/environment-sets/paper-test")["items"]
    file = service.request("GET", "/v1/controllers/default/file").body
    return {"genotypes": [result["genotype"] for result in done["results"]],
            "losses": losses_of(done),
            "physics": done["physics"],
            "environments": [world["light_xy_m"] + world["terrain_heights_m"] for world in worlds],
            "file": file, "controller": hashlib.sha256(file).digest()}


@pytest.fixture
def launch():
    """Starts fake daemons and workers for a single test."""
    started = []

    def start(kind, *how, **more):
        started.append(kind(*how, **more))
        return started[-1]

    yield start
    for running in reversed(started):
        running.close()


@pytest.fixture
def daemon(launch, known):
    fake = launch(FakeDaemon)
    fake.controllers[known["controller"].hex()] = known["file"]
    return fake


def lease(known, number, epoch=1, designs=(0, 1, 2, 3), n_steps=None, **more):
    """The paper's test set for some designs, in blocks of varying size."""
    blocks = [(known["genotypes"][d], part) for d in designs for part in (range(7), range(7, 10))]
    physics = known["physics"] | ({"n_steps": n_steps} if n_steps else {})
    what = {"controller": known["controller"], "physics": physics,
            "environments": known["environments"], "blocks": blocks} | more
    return Lease(epoch, number, **what)


def long_lease(known, number, n_steps=4000, **more):
    """A lease that takes several seconds of one processor."""
    return lease(known, number, designs=(3, ) * 8, n_steps=n_steps, **more)


def endless_lease(known, number):
    """A lease that takes far longer than a test waits."""
    return long_lease(known, number, n_steps=1_000_000)


def losses(known, designs=(0, 1, 2, 3)):
    return sum((known["losses"][d] for d in designs), ())


def running(fake, *ids):
    """Waits until leases have been issued."""
    fake.until(lambda: all(i in fake.out for i in ids))


def test_rows_have_the_bits_of_the_daemon(daemon, launch, known, service):
    """Also in the older forms of a lease, without an integrator or a control period. A period of 0
    is one computation per step."""
    worker = launch(Worker, daemon.url, "--name=here")
    for number in range(5):
        daemon.give(lease(known, number))
    daemon.give(lease(known, 5, designs=(2, )), lease(known, 6, controller=PASSIVE))
    for number, period_s in ((7, 0.016), (8, 0)):
        daemon.give(lease(known, number, physics=known["physics"] | {
            "integrator": "paper", "control_period_s": period_s}))
    daemon.until(lambda: len(daemon.results) == 9)
    for number in range(5):
        assert daemon.done((1, number)) == losses(known)
    assert daemon.done((1, 5)) == losses(known, (2, ))
    assert daemon.done((1, 6)) != losses(known)  # nothing moves them
    for number, period_s in ((7, 0.016), (8, known["physics"]["dt_s"])):
        done = evaluated(service, integrator="paper", control_period_s=period_s)
        assert daemon.done((1, number)) == sum(losses_of(done), ()) != losses(known)
    assert all(state == DONE and busy_s > 0 for _, state, busy_s, _, _ in daemon.results)
    offer = daemon.offers[0]
    assert (offer["name"], offer["n_threads"], offer["protocol"]) == ("here", 1, 7)
    assert len(offer["classes"]["cpu"]["canary"]) == 64 and "device" not in offer["classes"]
    fetched = [path for _, path in daemon.requests if "/controllers/" in path]
    assert len(fetched) == 1 and worker.stop() == 0, worker.log_text()
    assert daemon.sessions == {}


def test_two_leases_are_held_all_the_time(daemon, launch, known):
    launch(Worker, daemon.url)
    for number in range(3):
        daemon.give(long_lease(known, number))
    running(daemon, (1, 0), (1, 1))
    assert (1, 2) not in daemon.out
    daemon.until(lambda: daemon.done((1, 0)))
    running(daemon, (1, 1), (1, 2))  # the result and the next lease share a call
    daemon.until(lambda: sum(path.endswith("/orders") for _, path in daemon.requests) >= 2)


def test_devices_compute_leases_of_their_own(daemon, launch, known, start):
    flags = (f"--compute-module={MODULE}", "--devices=auto")
    done = start(*flags).evaluate({
        "designs": [{"cells": design["cells"]} for design in DESIGNS], "device": "cuda",
        "physics": {"n_steps": N_STEPS}}).json()
    launch(Worker, daemon.url, *flags)
    daemon.give(*(long_lease(known, number) for number in range(2)),
                *(lease(known, number, on_device=True) for number in range(2, 6)))
    daemon.until(lambda: all(daemon.done((1, number)) is not None for number in range(2, 6)))
    on_device = sum((tuple(result["losses"]) for result in done["results"]), ())
    assert all(daemon.done((1, number)) == on_device for number in range(2, 6))
    assert daemon.done((1, 1)) is None  # four of the others were faster than two of these
    assert daemon.offers[0]["n_devices"] > 0 and set(daemon.offers[0]["classes"]["device"]) == {
        "scores", "gradients", "canary"}


def test_sigterm_ends_a_worker_within_a_block(daemon, launch, known):
    worker = launch(Worker, daemon.url)
    daemon.give(lease(known, 0), *(long_lease(known, number, n_steps=16_000) for number in (1, 2)))
    running(daemon, (1, 1), (1, 2))
    with soon():
        assert worker.stop() == 0, worker.log_text()
    assert {i: state for i, state, *_ in daemon.results} == {
        (1, 0): DONE, (1, 1): GIVEN_BACK, (1, 2): GIVEN_BACK}
    assert daemon.sessions == {} and ": left, 0 leases held" in worker.log_text()


def test_dropped_leases_make_room_at_once(daemon, launch, known):
    launch(Worker, daemon.url)
    daemon.give(endless_lease(known, 0), endless_lease(known, 1))
    running(daemon, (1, 0), (1, 1))
    daemon.give(lease(known, 2))
    with soon():
        daemon.drop((1, 0), (1, 1))
        daemon.until(lambda: daemon.done((1, 2)))
    assert len(daemon.results) == 1


def test_a_session_that_is_gone_is_replaced(daemon, launch, known):
    launch(Worker, daemon.url)
    daemon.give(long_lease(known, 0), lease(known, 1))
    running(daemon, (1, 0))
    daemon.forget()
    daemon.give(lease(known, 2))
    daemon.until(lambda: daemon.done((1, 2)))
    assert len(daemon.offers) == 2 and daemon.done((1, 0)) is None


def test_a_daemon_that_starts_again_costs_little(daemon, launch, known):
    worker = launch(Worker, daemon.url)
    daemon.give(lease(known, 0), long_lease(known, 1))
    daemon.until(lambda: daemon.done((1, 0)))
    daemon.close()
    # While there is no reply, it retries often enough to find the next daemon quickly. With the
    # longest pauses, of several seconds, this would take a minute.
    with socket.create_server(("127.0.0.1", daemon.port)) as deaf, soon():
        deaf.settimeout(SOON_S)
        for _ in range(20):
            deaf.accept()[0].close()
    again = launch(FakeDaemon, epoch=2, port=daemon.port, sessions=100)
    again.controllers = daemon.controllers
    again.give(lease(known, 0, epoch=2))
    again.until(lambda: again.results)
    # The worker still has the weights, and sends nothing of the old epoch.
    assert [result[0] for result in again.results] == [(2, 0)]
    assert not any("/controllers/" in path for _, path in again.requests)
    assert again.done((2, 0)) == losses(known) and worker.stop() == 0


def test_hostile_leases_are_refused_and_the_worker_continues(daemon, launch, known):
    good = message(b"L", [lease(known, 99).encode()])
    bad_world = lease(known, 99, environments=[[float("nan")] * 66] * 10).encode()
    many = [lease(known, n, designs=(3, ), n_steps=4000).encode() for n in range(90, 94)]
    hostile = [good[:-1], good + b"\0", b"MOFLEETL", good.replace(b"MOFLEETL", b"MOFLEETR"),
               message(b"L", [bad_world]), message(b"L", many * 2), b"\0" * (50 << 20)]
    worker = launch(Worker, daemon.url)
    for n, body in enumerate(hostile):
        daemon.give(body)
        daemon.until(lambda n=n: len(daemon.offers) == n + 2)
        daemon.give(lease(known, n, designs=(0, )))
        daemon.until(lambda n=n: daemon.done((1, n)))
    assert len(daemon.results) == len(hostile), worker.log_text()


def test_bytes_that_are_not_their_digest_are_not_used(daemon, launch, known):
    def spoil(handler):
        body = message(b"L", [lease(known, 0).encode()])
        daemon.answers.clear()
        return handler.reply(200, body, "application/octet-stream", Content_Digest="sha-256=:AA=:")

    daemon.answers["/exchange"] = spoil
    worker = launch(Worker, daemon.url)
    daemon.until(lambda: len(daemon.offers) == 2)
    wrong = {"/controllers/" + known["controller"].hex(): lambda handler: (
        daemon.answers.clear(), handler.reply(200, known["file"] + b" "))}
    with daemon.changed:
        daemon.answers.update(wrong)
    daemon.give(lease(known, 1))
    daemon.until(lambda: len(daemon.offers) == 3)
    daemon.give(lease(known, 2))
    daemon.until(lambda: daemon.done((1, 2)))
    assert daemon.done((1, 1)) is None and "digest" in worker.log_text()


def test_weights_that_are_gone_give_the_lease_back(daemon, launch, known):
    launch(Worker, daemon.url)
    daemon.give(lease(known, 0, controller=b"\1" * 32), lease(known, 1))
    daemon.until(lambda: len(daemon.results) == 2)
    assert {i: state for i, state, *_ in daemon.results} == {(1, 0): GIVEN_BACK, (1, 1): DONE}


def test_weights_that_the_daemon_is_too_busy_for_give_the_lease_back(daemon, launch, known):
    busy = {"/controllers/" + known["controller"].hex(): lambda handler: (
        daemon.answers.clear(), handler.problem(503))}
    with daemon.changed:
        daemon.answers.update(busy)
    launch(Worker, daemon.url)
    daemon.give(lease(known, 0))
    daemon.until(lambda: len(daemon.results) == 1)
    daemon.give(lease(known, 1))
    daemon.until(lambda: len(daemon.results) == 2)
    assert {i: state for i, state, *_ in daemon.results} == {(1, 0): GIVEN_BACK, (1, 1): DONE}
    assert len(daemon.offers) == 1


REFUSALS = [("/sessions", 409, 76), ("/sessions", 422, 69), ("/sessions", 401, 77),
            ("/sessions", 403, 77), ("/sessions", 404, 78), ("/sessions", 405, 78),
            ("/exchange", 409, 76), ("/exchange", 401, 77), ("/orders", 409, 76)]


@pytest.mark.parametrize("end, reply, status", REFUSALS)
def test_a_refusal_ends_the_worker_with_its_reason(daemon, launch, end, reply, status):
    daemon.answers[end] = lambda handler: handler.problem(reply, "version 9.9 is wanted")
    worker = launch(Worker, daemon.url)
    assert worker.ends() == status and f"{reply}: version 9.9 is wanted" in worker.log_text()


def test_the_address_of_the_api_is_named_as_such(service, launch):  # noqa: F811
    worker = launch(Worker, service.addresses[0])
    assert worker.ends() == 78 and "the daemon's fleet_listen, not of its API" in worker.log_text()


@pytest.mark.skipif(LIAR is None, reason="MORPHO_LIAR names no program with other arithmetic")
def test_a_worker_with_other_arithmetic_is_refused(launch, start):
    service = start("--fleet-listen=127.0.0.1:0")
    kind = service.get("/v1/fleet")["classes"]["cpu"]["scores"]
    if "avx512" not in kind:
        pytest.skip(f"fused operations have the same bits in {kind}")
    worker = launch(Worker, service.addresses[-1], binary=LIAR)
    assert worker.ends() == 76 and len(re.findall("[0-9a-f]{64}", worker.log_text())) >= 1
    assert service.get("/v1/fleet")["joined"] == 0


@pytest.mark.parametrize("reply", [429, 500, 503])
def test_a_busy_daemon_is_asked_again(daemon, launch, known, reply):
    daemon.answers["/sessions"] = lambda handler: (daemon.answers.clear(), handler.problem(reply))
    launch(Worker, daemon.url)
    daemon.give(lease(known, 0))
    daemon.until(lambda: daemon.results)


def test_orders_drain_and_refuse(daemon, launch, known):
    for state, status, n in (("draining", 0, 1), ("refused", 76, 0)):
        worker = launch(Worker, daemon.url)
        daemon.until(lambda: daemon.sessions)
        daemon.give(lease(known, 0))
        running(daemon, (1, 0))
        with daemon.changed:
            next(iter(daemon.sessions.values()))["state"] = state
            daemon.changed.notify_all()
        assert worker.ends() == status
        assert n == 0 or daemon.done((1, 0)) == losses(known)
        daemon.forget()


def test_an_upgrade_is_another_end(daemon, launch, known):
    """Status 69 and the requested version, unless a signal arrives first."""
    for stops, status in ((False, 69), (True, 0)):
        worker = launch(Worker, daemon.url)
        daemon.until(lambda: daemon.sessions)
        daemon.give(long_lease(known, 0) if stops else lease(known, 0))
        running(daemon, (1, 0))
        with daemon.changed:
            next(iter(daemon.sessions.values())).update(state="draining", wanted="9.8")
            daemon.changed.notify_all()
        until(lambda: "for an upgrade" in worker.log_text())
        assert (worker.stop() if stops else worker.ends()) == status
        assert ("version 9.8" in worker.log_text()) == (not stops)
        daemon.forget()


def test_reasons_to_leave(daemon, launch, known, tmp_path):
    idle = launch(Worker, daemon.url, "--leave-when-idle=1")
    daemon.give(lease(known, 0))
    assert idle.ends() == 0 and daemon.done((1, 0)) and daemon.sessions == {}
    # 30 s before the end of a job, according to its environment or squeue.
    squeue = tmp_path / "squeue"
    end = time.strftime("%Y-%m-%dT%H:%M:%S", time.localtime(time.time() + 32))
    squeue.write_text(f'#!/bin/sh\n[ "$*" = "-h -j 17 -o %e" ] && echo {end}\n')
    squeue.chmod(0o755)
    for environment in ({"SLURM_JOB_END_TIME": str(int(time.time()) + 32)},
                        {"SLURM_JOB_ID": "17", "PATH": f"{tmp_path}:/usr/bin:/bin"}):
        slurm = launch(Worker, daemon.url, "--until-slurm", environment=environment)
        assert slurm.ends() == 0 and daemon.sessions == {}
        assert "job's time limit" in slurm.log_text()
    nobody = launch(Worker, "http://127.0.0.1:1", "--give-up=300ms")
    assert nobody.ends() == 75


@pytest.fixture(scope="module")
def certificate(tmp_path_factory):
    """Returns the paths of a self-signed certificate and its key, and the pin."""
    folder = tmp_path_factory.mktemp("tls")
    paths = [str(folder / name) for name in ("certificate.pem", "key.pem")]
    subprocess.run(["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt",
                    "ec_paramgen_curve:prime256v1", "-nodes", "-days", "2", "-subj", "/CN=lab",
                    "-addext", "subjectAltName=IP:127.0.0.1", "-out", paths[0], "-keyout",
                    paths[1]], check=True, capture_output=True)
    pin = subprocess.run("openssl x509 -pubkey -noout -in " + paths[0] + " | openssl pkey -pubin "
                         "-outform der | openssl dgst -sha256 -binary | base64", shell=True,
                         check=True, capture_output=True, text=True).stdout.strip()
    return paths, "sha256//" + pin


def test_only_the_expected_daemon_gets_the_token(launch, known, certificate, tmp_path):
    paths, pin = certificate
    daemon = launch(FakeDaemon, tls=paths)
    daemon.controllers[known["controller"].hex()] = known["file"]
    token = tmp_path / "token"
    token.write_text("a-token-of-a-worker-0123456789\n")
    seen = []
    daemon.answers["/sessions"] = lambda handler: (seen.append(handler.headers["Authorization"]),
                                                   False)[1]
    flags = [f"--token-file={token}"]
    wrong = "sha256//" + "A" * 43 + "="
    for trust in ([], [f"--pin={wrong}"], [f"--ca={paths[0]}", f"--pin={wrong}"]):
        worker = launch(Worker, daemon.url, *flags, *trust)
        assert worker.ends() == 77 and seen == [], worker.log_text()
    for n, trust in enumerate(([f"--pin={pin}"], [f"--ca={paths[0]}"])):
        worker = launch(Worker, daemon.url, *flags, *trust)
        daemon.give(lease(known, n))
        daemon.until(lambda n=n: daemon.done((1, n)))
        assert seen[n] == "Bearer " + token.read_text().strip() and worker.stop() == 0
    proxy = launch(Proxy)
    launch(Worker, daemon.url, *flags, f"--pin={pin}", f"--proxy={proxy.url}")
    daemon.give(lease(known, 2))
    daemon.until(lambda: daemon.done((1, 2)))
    assert set(proxy.asked) == {f"127.0.0.1:{daemon.port}"} and len(proxy.asked) <= 3


def test_wrong_configurations(launch, tmp_path):
    token = tmp_path / "token"
    token.write_text("a-token-of-a-worker-0123456789\n")
    server = "http://127.0.0.1:1"
    for url, status, flags in ((server, 64, ["--no-such"]), (server, 64, ["--threads=x"]),
                               (server, 64, ["--name"]), ("", 64, []), ("ftp://x", 78, []),
                               ("http://x/path", 78, []), (server, 78, ["--pin=md5//x"]),
                               (server, 78, ["--pin=sha256//x"]),
                               (server, 78, ["--ca=/none"]), (server, 78, ["--token-file=/none"]),
                               (server, 78, ["--name=a b"]),
                               ("http://192.0.2.1:1", 78, [f"--token-file={token}"])):
        worker = launch(Worker, url, *flags)
        assert worker.ends() == status and worker.log_text().count("\n") >= 1, (url, flags)
    worker = launch(Worker, server, environment={"MORPHOD_WORKER_ISA": "z80"})
    assert worker.ends() == 78 and "MORPHOD_WORKER_ISA" in worker.log_text()
