"""Archives of bundles and of scores: unpacked, altered, and repacked with correct sums."""

import hashlib
import json
import struct
import subprocess
import tarfile


def zstd(data, *flags):
    return subprocess.run(["zstd", "-q", "-c", *flags], input=data, stdout=subprocess.PIPE,
                          check=True).stdout


def unpack(bundle):
    """Returns [(name, bytes)] of all members."""
    data, at, members = zstd(bundle, "-d"), 0, []
    while data[at]:
        info = tarfile.TarInfo.frombuf(data[at:at + 512], "ascii", "strict")
        members.append((info.name, data[at + 512:at + 512 + info.size]))
        at += 512 + (info.size + 511) // 512 * 512
    assert data[at:] == bytes(1024)
    return members


def pack(members, sums=True, **header):
    """Returns a bundle of these members, with correct sums."""
    if sums:
        members = [(name, body) for name, body in members if name != "SHA256SUMS"]
        text = "".join(f"{hashlib.sha256(body).hexdigest()}  {name}\n" for name, body in members)
        members.append(("SHA256SUMS", text.encode()))
    data = []
    for name, body in members:
        info = tarfile.TarInfo(name)
        info.size = len(body)
        for key, value in header.items():
            setattr(info, key, value)
        data += [info.tobuf(tarfile.USTAR_FORMAT, "ascii"), body, bytes(-len(body) % 512)]
    return zstd(b"".join([*data, bytes(1024)]))


def altered(members, name, change, line=0):
    """Returns the members with one line changed in the first member with `name` in its name."""
    for place, (own, body) in enumerate(members):
        if name in own:
            lines = body.split(b"\n")
            lines[line] = change(lines[line])
            return members[:place] + [(own, b"\n".join(lines))] + members[place + 1:]
    raise AssertionError(name)


def put(key, value):
    """Sets a value, and writes the line as the service does."""
    def change(line):
        row = json.loads(line)
        *path, last = key.split(".")
        inner = row
        for name in path:
            inner = inner[name]
        inner[last] = value(inner[last]) if callable(value) else value
        return json.dumps(row, separators=(",", ":"), ensure_ascii=False).encode()
    return change


def blocks(data):
    """Returns the archives of a file of scores."""
    found = []
    while data:
        magic, four, size = struct.unpack_from("<3I", data)
        assert (magic, four) == (0x184D2A5D, 4)
        found.append(data[12:12 + size])
        data = data[12 + size:]
    return found


def block(members):
    """Returns a block of a file of scores with these members."""
    archive = pack(members)
    return struct.pack("<3I", 0x184D2A5D, 4, len(archive)) + archive


def lies(archive):
    """Returns a block of scores with a different first loss, from another origin."""
    members = altered(unpack(archive), "scores/", put("losses", lambda losses: [0.5] + losses[1:]))
    return block(altered(members, "scores/", put("origin", "liar@elsewhere")))
