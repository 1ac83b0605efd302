"""morphod's command line as a process: help, --check-config, --print-config, exit statuses. Speaks
TAP.

Usage: check_config.py MORPHOD CONTROLLER"""
import os
import pathlib
import re
import subprocess
import sys
import tempfile

MORPHOD, CONTROLLER = sys.argv[1:3]


def run(*arguments, file=None, **variables):
    environment = {k: v for k, v in os.environ.items() if not k.startswith("MORPHOD_")}
    environment.update({"HOME": folder, **variables})
    for gone in ("XDG_STATE_HOME", "STATE_DIRECTORY", "CREDENTIALS_DIRECTORY"):
        if gone not in variables:
            environment.pop(gone, None)
    path = pathlib.Path(folder, "morphod.conf")
    if file is not None:
        path.write_text(file)
        arguments = (*arguments, f"--config={path}")
    done = subprocess.run([MORPHOD, *arguments], capture_output=True, text=True, timeout=300,
                          env=environment)
    return done.returncode, done.stdout, done.stderr


def check(*arguments, file=None, **variables):
    return run("--check-config", *arguments, file=file, **variables)


def says(result, status, *parts):
    assert result[0] == status, result
    for part in parts:
        assert part in result[2], (part, result)


def test_help_and_documents_name_every_setting():
    status, out, err = run("--help")
    assert status == 0 and err == ""
    table = run("--print-settings")[1]
    docs = pathlib.Path(__file__).resolve().parents[3] / "docs"
    assert table in (docs / "configuration.md").read_text(), "morphod --print-settings, into it"
    manual = (docs / "man" / "morphod.8").read_text()
    names = re.findall(r"^\| `(\w+)` ", table, re.M)
    assert len(names) > 20
    for name in names:
        assert f"--{name.replace('_', '-')} " in out and f".It Cm {name} " in manual, name
    assert max(map(len, out.splitlines())) <= 120


def test_defaults_are_sound():
    says(check(), 0)
    assert os.listdir(folder) == [], "a check must not write"


def test_state_dir():
    pathlib.Path(folder, "file").write_text("")
    says(check(f"--state-dir={folder}/file"), 78, "is not a folder")
    says(check("--state-dir=relative"), 78, "must be an absolute path")
    says(check("--state-dir="), 78, "the path is empty")
    says(check(f"--state-dir={folder}/file/below"), 78, "state_dir")
    says(check(f"--state-dir={folder}/a/b/c"), 0)
    os.unlink(f"{folder}/file")


def test_listen():
    says(check("--listen=127.0.0.1"), 78, "must be host:port")
    says(check("--listen=127.0.0.1:99999"), 78, "at most 65535")
    says(check("--listen=::1:80"), 78, "brackets")
    says(check("--listen=unix:relative"), 78, "must start with /")
    says(check(f"--listen=unix:/{'x' * 200}"), 78, "at most 107 bytes")
    says(check("--listen=unix:/nonexistent/socket"), 78, "/nonexistent")
    says(check("--listen="), 78, "at least one address")
    says(check("--listen=127.0.0.1:1", "--listen=127.0.0.1:1"), 78, "duplicate address")
    says(check("--listen=[::1]:8765", f"--listen=unix:{folder}/s"), 0)


def test_tokens():
    token = pathlib.Path(folder, "token")
    says(check("--listen=0.0.0.0:8765"), 78, "needs a token_file")
    says(check("--listen=0.0.0.0:8765", f"--token-file={token}"), 78, "No such file")
    token.write_text("  \n")
    says(check("--listen=0.0.0.0:8765", f"--token-file={token}"), 78, "has no tokens")
    token.write_text("# no token\n" + "#" * 5000)
    says(check(f"--token-file={token}"), 78, "has no tokens")
    token.write_text("# a comment\n\nshort\n")
    says(check(f"--token-file={token}"), 78, str(token), "16 to 512")
    token.write_text("0123456789abcdef0123456789\n0123456789abcdef012345678é\n")
    says(check(f"--token-file={token}"), 78, "line 2", "printable ASCII")
    says(check("--token-on-loopback=yes"), 78, "token_on_loopback", "token_file")
    token.write_text("0123456789abcdef0123456789\n")
    token.chmod(0o644)
    says(check("--listen=0.0.0.0:8765", f"--token-file={token}"), 0, "everyone can read")
    token.chmod(0o600)
    says(check("--listen=0.0.0.0:8765", CREDENTIALS_DIRECTORY=folder), 0)
    token.unlink()
    os.mkfifo(token)
    says(check(f"--token-file={token}"), 78, "is not a file")
    says(check(f"--config={token}"), 78, "is a pipe, not a file")
    token.unlink()


def test_fleet():
    base = pathlib.Path(folder)
    token, key, certificate = base / "token", base / "key.pem", base / "certificate.pem"
    for name in ("", "other-"):
        subprocess.run(["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt",
                        "ec_paramgen_curve:prime256v1", "-nodes", "-days", "1", "-subj", "/CN=test",
                        "-keyout", base / f"{name}key.pem",
                        "-out", base / f"{name}certificate.pem"], check=True, capture_output=True)
    pair = (f"--fleet-certificate={certificate}", f"--fleet-key={key}")
    beyond = ("--fleet-listen=0.0.0.0:8766", f"--token-file={token}")
    token.write_text("w worker 0123456789abcdef\n")
    token.chmod(0o600)
    says(check("--fleet-listen=127.0.0.1:0"), 0)
    says(check(*beyond, *pair), 0)
    says(check("--fleet-listen=nowhere"), 78, "fleet_listen", "must be host:port")
    says(check(*beyond), 78, "needs fleet_certificate and fleet_key")
    says(check("--fleet-listen=0.0.0.0:8766", *pair), 78, "fleet_listen", "NAME worker TOKEN")
    says(check("--compute=fleet"), 78, 'compute: "fleet" needs fleet_listen')
    says(check(pair[0]), 78, "set both or neither")
    says(check(pair[0], f"--fleet-key={base}/other-key.pem"), 78, "do not match")
    says(check(pair[0], f"--fleet-key={token}"), 78, "fleet_certificate, fleet_key")
    says(check(pair[0], f"--fleet-key={folder}"), 78, f"fleet_key: {folder}: not a file")
    says(check(pair[0], "--fleet-key=/nonexistent"), 78, "fleet_key: /nonexistent: No such file")
    key.chmod(0o644)
    says(check(*pair), 0, "fleet_key", "everyone can read")
    # Tokens of workers are not valid for clients, and vice versa.
    says(check("--listen=0.0.0.0:8765", f"--token-file={token}"), 78, "only worker tokens")
    token.write_text("anna admin 0123456789abcdef\n")
    says(check(*beyond, *pair), 78, "fleet_listen", "NAME worker TOKEN")
    token.write_text("anna overlord 0123456789abcdef\n")
    says(check(f"--token-file={token}"), 78, "read, submit, admin or worker")


def test_controller():
    says(check(f"--default-controller={CONTROLLER}"), 0)
    says(check("--default-controller=/nonexistent"), 78, "default_controller")
    broken = pathlib.Path(folder, "broken.safetensors")
    broken.write_bytes(pathlib.Path(CONTROLLER).read_bytes()[:100000])
    says(check(f"--default-controller={broken}"), 78, "default_controller", "broken.safetensors")
    broken.unlink()


def test_what_will_be_made():
    says(check("--port-file=/nonexistent/port"), 78, "port_file", "/nonexistent")
    says(check(f"--port-file={folder}/port"), 0)
    says(check("--unix-groups=root"), 0)
    says(check("--unix-groups=root,no-such-group"), 78, 'group "no-such-group" does not exist')


def test_mistakes():
    says(check(file="workerz = 3\n"), 78, "morphod.conf:1", 'did you mean "workers"?')
    says(check("--config=/nonexistent.conf"), 78, "/nonexistent.conf")
    says(run("--wrokers=3"), 64, "did you mean --workers?")
    says(run("stray"), 64, "stray")
    says(run("--workers"), 64, "needs a value")
    says(run("--workers=many"), 78, "not a whole number")
    says(run("--help=1"), 64, "takes no value")


def test_print_config_reads_back():
    values = "max_body = 5M\nlisten = 127.0.0.1:0, [::1]:0\nbody_timeout = 30min\n"
    status, out, _ = run("--print-config", "--workers=3", file=values, MORPHOD_ISA="avx2")
    assert status == 0
    for line in ("workers = 3  # flag", "max_body = 5M  # file", "isa = avx2  # environment",
                 "listen = 127.0.0.1:0, [::1]:0  # file", "body_timeout = 1800s  # file",
                 "max_connections = 1024  # default"):
        assert line in out.splitlines(), (line, out)
    again = run("--print-config", file=out)[1]
    strip = lambda text: [l.split("  #")[0] for l in text.splitlines() if not l.startswith("#")]
    assert strip(again) == strip(out)


def test_no_start_with_faults():
    says(run("--listen=0.0.0.0:0"), 78, "needs a token_file")
    says(
        run(f"--state-dir={folder}/s", "--listen=127.0.0.1:0", "--default-controller=/nonexistent"),
        78, "default_controller")
    assert not os.path.exists(f"{folder}/s")


def test_address_in_use():
    import socket
    with socket.create_server(("127.0.0.1", 0)) as server:
        says(
            run(f"--state-dir={folder}/s", f"--listen=127.0.0.1:{server.getsockname()[1]}",
                f"--default-controller={CONTROLLER}"), 69, "127.0.0.1")


tests = [(name, value) for name, value in sorted(globals().items()) if name.startswith("test_")]
print(f"1..{len(tests)}")
failed = 0
for number, (name, test) in enumerate(tests, 1):
    with tempfile.TemporaryDirectory() as folder:
        try:
            test()
            print(f"ok {number} - {name[5:].replace('_', ' ')}")
        except Exception as error:  # a failed test must not hide the others
            failed += 1
            print(f"# {type(error).__name__}: {str(error)[:2000]!r}")
            print(f"not ok {number} - {name[5:].replace('_', ' ')}")
sys.exit(1 if failed else 0)
