"""Checks the units with systemd's own tools: they parse, and the service is as closed as it can be.

Usage: check_units.py SERVICE SOCKET. Status 77 (skipped) without systemd-analyze."""
import pathlib
import re
import shutil
import subprocess
import sys
import tempfile

THRESHOLD = 15  # tenths: exposure at most 1.5


def main():
    if shutil.which("systemd-analyze") is None:
        print("systemd-analyze is not installed")
        return 77
    service, socket = (pathlib.Path(a) for a in sys.argv[1:])
    text = service.read_text()
    for line in ("Type=notify", "WatchdogSec=", "DynamicUser=yes", "StateDirectory=morphod",
                 "StateDirectoryMode=0700", "LoadCredential=token",
                 "RestartPreventExitStatus=64 78", "ExecReload=kill -HUP $MAINPID"):
        if not re.search("^" + re.escape(line), text, re.M):
            print(f"{service}: no line {line}")
            return 1
    if "@" in re.search("^ExecStart=.*", text, re.M).group():
        print(f"{service}: ExecStart is not complete")
        return 1
    with tempfile.TemporaryDirectory() as folder:
        # verify wants a program that exists: the one of the build is not installed yet.
        copy = pathlib.Path(folder, "morphod.service")
        copy.write_text(re.sub("^ExecStart=.*", "ExecStart=/bin/true", text, flags=re.M))
        shutil.copy(socket, folder)
        verify = subprocess.run(
            ["systemd-analyze", "verify", "--man=no", copy,
             pathlib.Path(folder, "morphod.socket")],
            capture_output=True,
            text=True)
        complaints = [l for l in (verify.stdout + verify.stderr).splitlines() if "morphod" in l]
        if verify.returncode != 0 or complaints:
            print(verify.stdout, verify.stderr)
            return 1
        security = subprocess.run([
            "systemd-analyze", "security", "--offline=true", f"--threshold={THRESHOLD}",
            "--no-pager", copy
        ],
                                  capture_output=True,
                                  text=True)
        print((security.stdout + security.stderr).strip().splitlines()[-1])
        return 1 if security.returncode != 0 else 0


sys.exit(main())
