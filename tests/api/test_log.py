"""A log without a reader: the service continues, lines are dropped and counted, and it stops in
time."""

import fcntl
import http.client
import os
import re
import signal
import time

import pytest

from service import soon

REQUESTS = 6000  # at least 260 bytes of log each: more than the buffer of 1 MiB
DROPPED = "morphod_log_lines_dropped_total"
PATH = "/" + "x" * 180


@pytest.fixture
def unread():
    """A pipe: (read end, write end)."""
    ends = list(os.pipe())
    fcntl.fcntl(ends[1], fcntl.F_SETPIPE_SZ, 4096)
    yield ends
    for end in ends:
        os.close(end)


def ask(service, n):
    connection = http.client.HTTPConnection(service.host, service.port, timeout=300)
    for _ in range(n):
        connection.request("GET", PATH)
        assert connection.getresponse().read()
    connection.close()


def read_until(end, pattern, seconds=300):
    text, deadline = "", time.monotonic() + seconds
    os.set_blocking(end, False)
    while not re.search(pattern, text):
        assert time.monotonic() < deadline, text[-2000:]
        try:
            text += os.read(end, 65536).decode()
        except BlockingIOError:
            time.sleep(0.01)
    return text


def test_lines_are_dropped_and_counted(start, unread):
    reading, writing = unread
    service = start(stderr=writing)
    assert service.metric(DROPPED) == 0
    ask(service, REQUESTS)
    assert service.request("GET", "/healthz").status == 200
    lost = service.metric(DROPPED)
    assert lost > 0
    text = read_until(reading, r"lines were dropped.*\n")
    assert f"lines={lost}\n" in text
    ask(service, 1)  # after the notice
    text += read_until(reading, re.escape(PATH) + r" .*\n")
    lines = [line for line in text.splitlines() if PATH in line]
    assert len(lines) == REQUESTS + 1 - lost and all(
        re.fullmatch(r"\S+ info: request .* seconds=\S+", line) for line in lines)
    assert PATH in text.splitlines()[-1] and service.metric(DROPPED) == lost
    assert service.stop() == 0
    assert "stopped work=finished" in read_until(reading, "stopped.*\n")


@pytest.mark.parametrize("number, status", [(signal.SIGTERM, 0), (signal.SIGSEGV, -signal.SIGSEGV)])
def test_the_end_does_not_wait_for_a_reader(start, unread, number, status):
    service = start(stderr=unread[1])
    ask(service, 600)  # the pipe is full long before
    with soon():
        assert service.stop(number) == status
