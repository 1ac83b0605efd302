"""A private service, for as long as it is needed."""

from __future__ import annotations

import atexit
import os
import pathlib
import shutil
import subprocess
import tempfile
import time
from typing import Any

from ._sync.client import Client
from .errors import MorphodError

_START_S = 60.0
_STOP_S = 60.0
_SOCKET_MAX = 108
"""Maximum bytes of a unix socket's address, including the terminating zero."""


class LocalClient(Client):
    """A client that also stops its service; see `local`."""

    def __init__(self, state_dir: str | os.PathLike[str] | None,
                 binary: str | os.PathLike[str] | None, settings: dict[str, object]) -> None:
        program = _binary(binary)
        self._pid = os.getpid()
        self._base = base = pathlib.Path(tempfile.mkdtemp(prefix="morphod-"))
        self._process: subprocess.Popen[bytes] | None = None
        self._guard: _Guard | None = None
        try:
            self.state_dir = pathlib.Path(state_dir) if state_dir is not None else base / "state"
            self.state_dir.mkdir(mode=0o700, parents=True, exist_ok=True)
            self.log = base / "log" if state_dir is None else self.state_dir.parent / "morphod.log"
            ready = base / "addresses"
            # The address of a unix socket has room only for a short path. Even at the loopback
            # address, the service accepts only its own user.
            socket = base / "socket" if len(os.fsencode(base / "socket")) < _SOCKET_MAX else None
            command = [program, f"--state-dir={self.state_dir}", "--listen=127.0.0.1:0",
                       f"--port-file={ready}"]
            command += [f"--listen=unix:{socket}"] if socket is not None else []
            command += [f"--{name.replace('_', '-')}={value}" for name, value in settings.items()]
            with open(self.log, "ab") as log:
                # In a separate session: Ctrl-C is for the program, not for its service.
                self._process = subprocess.Popen(command, stdout=log, stderr=log,
                                                 stdin=subprocess.DEVNULL, start_new_session=True)
            self._guard = _Guard(self._process.pid)
            self._await_start(ready, 1 if socket is None else 2)
            self.url = next(line for line in ready.read_text().split() if line.startswith("http"))
            super().__init__(self.url if socket is None else f"unix:{socket}")
            self._await_ready()
        except BaseException:
            self._end()
            raise
        atexit.register(self.close)

    def __reduce__(self) -> Any:
        """A copy, or a client in another process, uses the same service, which continues."""
        address = self._connection.address
        return Client, (address.url if address.unix is None else f"unix:{address.unix}", )

    def _await_start(self, ready: pathlib.Path, addresses: int) -> None:
        assert self._process is not None
        deadline = time.monotonic() + _START_S
        while not ready.exists() or ready.read_text().count("\n") < addresses:
            if self._process.poll() is not None or time.monotonic() > deadline:
                text = self.log.read_text(errors="replace")[-2000:]
                raise MorphodError(f"the service did not start; its log ends with:\n{text}")
            time.sleep(0.02)

    def _await_ready(self) -> None:
        deadline = time.monotonic() + _START_S
        while True:
            try:
                self.request("GET", "/readyz")
                return
            except MorphodError:
                if time.monotonic() > deadline:
                    raise
                time.sleep(0.05)

    def _end(self) -> None:
        if self._guard is not None:
            self._guard.close()
        if self._process is not None and self._process.poll() is None:
            self._process.terminate()
            try:
                self._process.wait(_STOP_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        shutil.rmtree(self._base, ignore_errors=True)

    def close(self) -> None:
        """Closes the connections and stops the service. A given `state_dir` is kept; a temporary
        one is deleted. In a forked child the service continues, because it belongs to the
        parent."""
        if os.getpid() != self._pid:
            return
        atexit.unregister(self.close)
        super().close()
        self._end()


class _Guard:
    """Ends a process when this one ends, in whatever way, and whichever thread started it: a shell
    reads a pipe that only this process can write to, and sends SIGTERM when the pipe breaks."""

    def __init__(self, pid: int) -> None:
        end, self._pipe = os.pipe()
        try:
            self._shell = subprocess.Popen(
                ["/bin/sh", "-c", 'read -r _; kill -TERM "$1"', "sh", str(pid)], stdin=end,
                stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)
        finally:
            os.close(end)
        _guards.add(self)

    def close(self) -> None:
        """Stops watching: the process has not ended yet, so its number is still its own."""
        _guards.discard(self)
        self._shell.kill()
        self._shell.wait()
        os.close(self._pipe)

    def leave(self) -> None:
        """In a forked child: the pipe must break when the parent ends, without waiting for the
        child."""
        os.close(self._pipe)


_guards: set[_Guard] = set()


def _leave_guards() -> None:
    while _guards:
        _guards.pop().leave()


os.register_at_fork(after_in_child=_leave_guards)


def _binary(given: str | os.PathLike[str] | None) -> str:
    name = os.fspath(given) if given is not None else os.environ.get("MORPHOD_BINARY", "morphod")
    found = shutil.which(name)
    if found is None:
        raise MorphodError(f"program {name} not found: install morphod, or specify it with binary= "
                           "or $MORPHOD_BINARY")
    return found


def local(state_dir: str | os.PathLike[str] | None = None, *,
          binary: str | os.PathLike[str] | None = None, **settings: object) -> LocalClient:
    """Starts a service on this machine, and returns a client for it.

    Without `state_dir`, everything that it stores is deleted at the end. With it, a later `local`
    continues where this one ended, including campaigns. `binary` is the program, otherwise
    $MORPHOD_BINARY or `morphod` on the path. `settings` are those of docs/configuration.md, such as
    `workers=4`. Use it in a `with` statement, or call `close`::

        with morphod.local() as m:
            m.evaluate([[[2, 2, 0]]]).scores

    The client's `url` is the address of its dashboard.
    """
    return LocalClient(state_dir, binary, settings)
