#!/usr/bin/env python3
"""Embeds the dashboard's files in a C source, both unchanged and compressed.

usage: embed.py OUTPUT ESBUILD FOLDER FILE...

ESBUILD minifies scripts and styles; '' leaves them as they are, except for comments and
indentation. Modules that saved pages contain keep their names, because a page is one script. FILE
is relative to FOLDER.

They are served from assets/HASH/…, with one hash over all files.
Modules can therefore import each other by relative names, and clients may cache them. index.html is
the page itself; @assets@ in it becomes that folder. @preload@ becomes the list of modules that
app.js imports, and for each view the additional modules that it imports, without .js. The browser
then loads all of them at once instead of import by import.
"""
import gzip
import hashlib
import pathlib
import posixpath
import re
import subprocess
import sys
import tempfile

SHADERS = "stage/shaders.js"
PAGE = "export/page.js"
IMPORT = r"^import [^;]*;$"
TYPES = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".svg": "image/svg+xml",
}


def array(name: str, data: bytes) -> list[str]:
    rows = [",".join(map(str, data[at : at + 32])) for at in range(0, len(data), 32)]
    return [f"static const unsigned char {name}[] = {{", *(row + "," for row in rows), "};"]


def without_comments(name: str, text: str) -> str:
    """Empties the lines that have nothing but a comment, and removes indentation, which must not
    matter in a template literal, either; lines keep their numbers."""
    lines, inside = [], False
    for number, line in enumerate(text.split("\n"), 1):
        bare = line.strip()
        begins = not inside and bare.startswith("/*") and not re.search(r"\*/.", bare)
        if (inside or begins) and re.search(r"\*/.", bare):
            raise SystemExit(f"{name}:{number}: code follows a comment that has lines of its own")
        empty = inside or begins or (name.endswith(".js") and bare.startswith("//"))
        lines.append("" if empty else bare)
        inside = (inside or begins) and not bare.endswith("*/")
    return "\n".join(lines)


def inlined(page: str) -> set[str]:
    """Returns the files that saved pages and other clients read as source, so they keep their
    top-level names."""
    modules = re.search(r"const MODULES = \[(.*?)\]", page, re.DOTALL)
    assert modules
    return {PAGE, *re.findall(r"'([^']+)'", modules[1])}


def parted(source: str) -> tuple[list[str], str]:
    """Separates a module from its imports. esbuild then keeps the names, because they could be
    anything; most are used too rarely for an alias to make the compressed file smaller."""
    imports = [re.sub(r"(?<=[{,])\s+|,?\s*(})\s*| (?=[{'])", r"\1", found).replace("'", '"')
               for found in re.findall(IMPORT, source, re.MULTILINE)]
    return imports, re.sub(IMPORT, "", source, flags=re.MULTILINE)


def minify(esbuild: str, files: dict[str, bytes]) -> dict[str, bytes]:
    imports = {}
    with tempfile.TemporaryDirectory() as folder:
        for name, content in files.items():
            path = pathlib.Path(folder) / name
            path.parent.mkdir(exist_ok=True)
            found, rest = parted(content.decode())
            imports[name] = "".join(found).encode()
            path.write_text(rest, encoding="utf-8")
        subprocess.run([esbuild, "--minify", "--charset=utf8", "--log-level=warning",
                        "--outdir=.", "--outbase=.", "--allow-overwrite", *files],
                       cwd=folder, check=True)
        return {name: imports[name] + (pathlib.Path(folder) / name).read_bytes()
                for name in files}


def dense(text: str) -> str:
    """Removes spaces and ends of lines in the shaders, which are template literals, so that esbuild
    leaves them as they are. `- -1.0` is not a decrement, so those stay apart, as do lines of the
    preprocessor."""
    def without_spaces(shader: re.Match) -> str:
        lines = [line if line.startswith("#") else re.sub(
            r"(?<!-) - (?!-)", "-", re.sub(r" *([=,;(){}*/<>?:+&|]) *", r"\1", line))
            for line in shader[0].split("\n")]
        return re.sub(r"(?<=[;{},])\n(?!#)", "", "\n".join(lines))

    return re.sub(r"`[^`]*`", without_spaces, text)


def minified(esbuild: str, source: str) -> str:
    return subprocess.run([esbuild, "--minify", "--legal-comments=inline", "--charset=utf8",
                           "--log-level=warning"], input=source, capture_output=True, check=True,
                          encoding="utf-8").stdout.strip()


def squeeze(esbuild: str, source: str) -> str:
    """Minifies a module, but keeps its top-level names: without its imports and exports, it is a
    script, whose top-level names esbuild keeps. Each import and each export still begins a line,
    because saved pages and the Python client find them there."""
    imports, script = parted(source)
    script, n = re.subn(r"^export (?=const|function|class|async)", "/*!export*/", script,
                        flags=re.MULTILINE)
    script, n_kept = re.subn(r"\n?/\*!export\*/\n?", "\nexport ", minified(esbuild, script))
    if n_kept != n:
        raise SystemExit("esbuild removed comments that --legal-comments=inline keeps")
    lines = [line.replace("import{", "import {") + "\n" for line in imports]
    return "".join(lines) + script.lstrip()


def squeeze_page(esbuild: str, page: str) -> str:
    """Minifies export/page.js, but leaves its constants as they are, because the Python client
    reads them there; of SCRIPT it keeps the top-level names."""
    found = re.fullmatch(r"(.*?\nconst SCRIPT = `)(.*?)(`;\n)(.*)", page, re.DOTALL)
    assert found
    constants, script, end, functions = found.groups()
    script = minified(esbuild, script)
    if re.search(r"[`$\\]", script):
        raise SystemExit("export/page.js: SCRIPT is minified to what a template literal escapes")
    return constants + script + end + minified(esbuild, functions)


def modules_of(sources: dict[str, str], name: str) -> set[str]:
    """Returns a module and everything that it imports."""
    found, new = set(), [name]
    while new:
        module = new.pop()
        if module not in found:
            found.add(module)
            folder = posixpath.dirname(module)
            new += [posixpath.normpath(posixpath.join(folder, path)) for path in
                    re.findall(r"^(?:import .*|} )from '(\..*)';$", sources[module],
                               re.MULTILINE)]
    return found


def preload(sources: dict[str, str]) -> str:
    core = modules_of(sources, "app.js")
    lines = [f'<link rel="modulepreload" href="@assets@/{name}">' for name in sorted(core)]
    for key, view in re.findall(r"^  (\w+): \{ name: .*module: '\./(.*?)'", sources["app.js"],
                                re.MULTILINE):
        names = " ".join(name.removesuffix(".js")
                         for name in sorted(modules_of(sources, view) - core))
        lines.append(f'<meta name="view" data-view="{key}" content="{names}">')
    return "\n".join(lines)


def main() -> None:
    output, esbuild, folder, *names = sys.argv[1:]
    sources = {name: (pathlib.Path(folder) / name).read_text(encoding="utf-8")
               for name in sorted(names)}
    files = {name: without_comments(name, text).encode() if name.endswith((".js", ".css"))
             else text.encode() for name, text in sources.items()}
    if esbuild:
        kept = inlined(sources[PAGE])
        files[SHADERS] = dense(files[SHADERS].decode()).encode()
        files |= minify(esbuild, {name: content for name, content in files.items()
                                  if name.endswith((".js", ".css")) and name not in kept})
        files |= {name: (squeeze_page if name == PAGE else squeeze)(
            esbuild, files[name].decode()).encode() for name in kept}
    page = files["index.html"].replace(b"@preload@", preload(sources).encode())
    digest = hashlib.sha256()
    for name, data in files.items():
        digest.update(f"{name} {len(data)}\n".encode() + data)
    version = digest.hexdigest()[:16]
    files["index.html"] = page.replace(b"@assets@", f"assets/{version}".encode())
    lines = ["/* Generated by clients/dashboard/embed.py. */", '#include "api/assets.h"', ""]
    table = []
    for n, (name, data) in enumerate(files.items()):
        packed = gzip.compress(data, 9, mtime=0)
        lines += array(f"plain_{n}", data) + array(f"packed_{n}", packed)
        kind = TYPES[pathlib.Path(name).suffix]
        sizes = f"plain_{n}, sizeof(plain_{n}), packed_{n}, sizeof(packed_{n})"
        table.append(f'  {{"{name}", "{kind}", {sizes}}},')
    lines += [
        f'const char mo_assets_version[] = "{version}";',
        "const struct mo_asset mo_assets[] = {",
        *table,
        "};",
        f"const size_t mo_assets_count = {len(table)};",
    ]
    pathlib.Path(output).write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
