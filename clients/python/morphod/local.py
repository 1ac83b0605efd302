"""A service of one's own, for as long as it is needed."""

from __future__ import annotations

import atexit
import os
import pathlib
import shutil
import subprocess
import tempfile
import time

from ._sync.client import Client
from .errors import MorphodError, UnreachableError

_START_S = 60.0
_STOP_S = 60.0


class LocalClient(Client):
    """A client whose service ends with it; see `local`."""

    def __init__(self, state_dir: str | os.PathLike[str] | None,
                 binary: str | os.PathLike[str] | None, settings: dict[str, object]) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="morphod-")
        base = pathlib.Path(self._folder.name)
        self.state_dir = pathlib.Path(state_dir) if state_dir is not None else base / "state"
        self.state_dir.mkdir(mode=0o700, parents=True, exist_ok=True)
        socket = base / "socket"
        ready = base / "addresses"
        # A process that is killed takes its service with it, where util-linux is there.
        setpriv = shutil.which("setpriv")
        command = [setpriv, "--pdeathsig=TERM"] if setpriv is not None else []
        command += [_binary(binary), f"--state-dir={self.state_dir}", f"--listen=unix:{socket}",
                    "--listen=127.0.0.1:0", f"--port-file={ready}"]
        command += [f"--{name.replace('_', '-')}={value}" for name, value in settings.items()]
        self.log = base / "log" if state_dir is None else self.state_dir.parent / "morphod.log"
        with open(self.log, "ab") as log:
            self._process = subprocess.Popen(command, stdout=log, stderr=log,
                                             stdin=subprocess.DEVNULL)
        self._await_start(ready)
        self.url = next(line for line in ready.read_text().split() if line.startswith("http"))
        super().__init__(f"unix:{socket}")
        atexit.register(self.close)
        self._await_ready()

    def _await_start(self, ready: pathlib.Path) -> None:
        deadline = time.monotonic() + _START_S
        while not ready.exists() or ready.read_text().count("\n") < 2:
            if self._process.poll() is not None or time.monotonic() > deadline:
                text = self.log.read_text(errors="replace")[-2000:]
                self._end()
                raise MorphodError(f"the service did not start; its log ends with:\n{text}")
            time.sleep(0.02)

    def _await_ready(self) -> None:
        deadline = time.monotonic() + _START_S
        while True:
            try:
                self.request("GET", "/readyz")
                return
            except (MorphodError, UnreachableError):
                if time.monotonic() > deadline:
                    self.close()
                    raise
                time.sleep(0.05)

    def _end(self) -> None:
        if self._process.poll() is None:
            self._process.terminate()
            try:
                self._process.wait(_STOP_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        self._folder.cleanup()

    def close(self) -> None:
        """Closes the connections and stops the service. What it stored in a `state_dir` of its own
        stays; a temporary one is deleted."""
        atexit.unregister(self.close)
        super().close()
        self._end()


def _binary(given: str | os.PathLike[str] | None) -> str:
    name = os.fspath(given) if given is not None else os.environ.get("MORPHOD_BINARY", "morphod")
    found = shutil.which(name)
    if found is None:
        raise MorphodError(f"there is no program {name}: install morphod, or name it with binary= "
                           "or $MORPHOD_BINARY")
    return found


def local(state_dir: str | os.PathLike[str] | None = None, *,
          binary: str | os.PathLike[str] | None = None, **settings: object) -> LocalClient:
    """Starts a service on this machine, and gives its client.

    Without `state_dir` everything that it stores is deleted at the end; with it a later `local`
    goes on where this one ended, campaigns included. `binary` is the program, otherwise
    $MORPHOD_BINARY or `morphod` on the path. `settings` are those of docs/configuration.md, such
    as `workers=4`. Use it in a `with` statement, or call `close`::

        with morphod.local() as m:
            m.evaluate([[[2, 2, 0]]]).scores

    `url` of the client is the address of its dashboard.
    """
    return LocalClient(state_dir, binary, settings)
