"""Finds files of a folder that use each other in a circle, by function or by data.

universal-ctags finds what a file defines. A header belongs to the source file with the same name;
fragments (.inc, .cuh) are separate files."""
import re
import subprocess
import tempfile
from pathlib import Path

SUFFIXES = (".c", ".h", ".inc", ".cu", ".cuh")
SOURCES = (".c", ".cu")
CTAGS = [
    "ctags", "-f", "-", "-L", "-", "--sort=no", "--excmd=number", "--languages=C,CUDA",
    "--langmap=C:.c.h.inc,CUDA:.cu.cuh", "--kinds-C=fvpxlzm", "--kinds-CUDA=fvpxlzm", "--fields=k"
]
COMMENT = re.compile(r"""/\*.*?\*/|//[^\n]*|"(?:\\.|[^"\\\n])*"|'(?:\\.|[^'\\\n])+'""", re.S)
INCLUDE = re.compile(r'^\s*#\s*include\s*[<"]([^>"]+)[>"]', re.M)
DIRECTIVE = re.compile(r"^[ \t]*#(?:[^\n\\]|\\.|\\\n)*", re.M)
MACRO = re.compile(r"^[ \t]*#[ \t]*define[ \t]+\w+((?:[^\n\\]|\\\n|\\.)*)", re.M)
OPENED = re.compile(r"extern\s+\{|namespace\s*\w*\s*\{")
# A word that may refer to a function or data: not a type, and not a member of a value.
WORD = re.compile(r"\b(?:struct|enum|union)\s+\w+|(?<![.\w])(?<!->)([A-Za-z_]\w*)(\s*\()?")


def code_files(folder):
    return sorted(p for p in folder.rglob("*") if p.suffix in SUFFIXES) if folder.is_dir() else []


def code_of(text):
    """Returns the bodies and values of a text, without comments and declarations."""
    text = COMMENT.sub(" ", text)
    macros = " ".join(MACRO.findall(text))
    kept, statement, depth = "", "", 0
    for part in re.split(r"([;{}])", OPENED.sub("", DIRECTIVE.sub("", text))):
        statement += part
        depth = max(0, depth + (part == "{") - (part == "}"))
        if depth == 0 and part in (";", "}"):
            kept += statement if "{" in statement or "=" in statement else ""
            statement = ""
    return kept + statement + macros


class Names:
    """Returns what the files of a folder define, declare, and have inside functions and types."""

    def __init__(self, files):
        self.owners, self.kind, self.declared, self.inner = {}, {}, set(), {}
        tags = subprocess.run(CTAGS, input="\n".join(map(str, files)), text=True,
                              capture_output=True, check=True).stdout
        for line in tags.splitlines():
            if line.startswith("!_"):
                continue
            name, path, _, kind = line.split("\t")[:4]
            if kind in "fv":
                self.owners.setdefault(name, set()).add(Path(path))
                self.kind[name] = kind
            elif kind in "lzm":
                self.inner.setdefault(Path(path), set()).add(name)
            elif path.endswith(".h"):
                self.declared.add(name)

    def used(self, path, text, beside):
        """Yields pairs of a name that a file uses and the file that defines it. beside: the files
        that are compiled together with it."""
        for word in WORD.finditer(text):
            name = word[1]
            if name not in self.owners or path in self.owners[name]:
                continue
            if name in self.inner.get(path, ()) and not (self.kind[name] == "f" and word[2]):
                continue  # a local name, such as a parameter
            for owner in self.owners[name]:
                shared = name.startswith("mo_") or name in self.declared
                if shared if owner.suffix in SOURCES else owner in beside:
                    yield name, owner


def compiled_together(files, roots):
    """Returns for each file the files that some source includes with it."""
    included = {
        p: {q for name in INCLUDE.findall(p.read_text())
            for q in (p.parent / name, *(root / name for root in roots)) if q.exists()}
        for p in files
    }
    together = {}
    for source in files:
        if source.suffix not in SOURCES:
            continue
        unit, left = {source}, [source]
        while left:
            found = included.get(left.pop(), set()) - unit
            unit |= found
            left += found
        for path in unit:
            together.setdefault(path, set()).update(unit)
    return together


def circles_of(folder, top):
    files = code_files(folder)
    if not files:
        return []
    names = Names(files)
    together = compiled_together(files, [top / "src", top / "clients"])

    def node(path):
        return path if path.suffix == ".inc" else path.with_suffix("")

    uses = {node(path): {} for path in files}
    for path in files:
        for name, owner in names.used(path, code_of(path.read_text()), together.get(path, ())):
            if node(owner) != node(path):
                uses[node(path)].setdefault(node(owner), name)
    reached = {}
    for path in uses:
        reached[path], left = set(), list(uses[path])
        while left:
            found = left.pop()
            if found not in reached[path]:
                reached[path].add(found)
                left += uses[found]
    circles = {frozenset(q for q in reached[p] if p in reached[q])
               for p in uses if p in reached[p]}
    return sorted("these files use each other in a circle: " + ", ".join(
        f"{p.name} uses {name} of {q.name}" for p in sorted(circle)
        for q, name in sorted(uses[p].items()) if q in circle) for circle in circles)


# Circles of two files, as pairs of a name and a text, and files that only look like circles.
CIRCLES = {
    "functions": ("a.c", "int mo_a(void) { return mo_b(); }", "b.c", "int mo_b(void) { mo_a(); }"),
    "types on separate lines":
        ("a.c", "const struct mo_x *\nmo_a(int n,\n     int m)\n{\n  return mo_b();\n}",
         "b.c", "const struct mo_x *\nmo_b(void)\n{\n  return mo_a(1, 2);\n}"),
    "data": ("a.c", "const int *const mo_a[] = {\n    &mo_b, 0};",
             "b.c", "int mo_b = sizeof(mo_a);"),
    "a table and its users":
        ("a.c", "static const struct k *const all[] = {&mo_b};\nint mo_a(void) { return *all; }",
         "b.c", "const struct k mo_b = {.run = mo_a};"),
    "a header": ("a.h", "static inline int mo_a(void) { return mo_b(); }",
                 "b.c", '#include "x/a.h"\nint mo_b(void) { return mo_a(); }'),
    "CUDA": ("a.cu", 'extern "C" int mo_a()\n{\n  return mo_b(1);\n}',
             "b.cu", "namespace {\nint f() { return mo_a(); }\n}\nint mo_b(int) { return f(); }"),
    "CUDA's fragments":
        ("a.cuh", "__device__ int a(int n)\n{\n  return b(n);\n}",
         "b.cuh", "__device__ int a(int n);\n__device__ int b(int n)\n{\n  return a(n);\n}",
         "c.cu", '#include "x/b.cuh"\n#include "x/a.cuh"'),
    "fragments": ("a.inc", "static int a(int n) { return n > 0 ? b(n) : 0; }",
                  "b.inc", "static int a(int n);\nMO_INLINE int b(int n)\n{\n  return a(n - 1);\n}",
                  "c.c", '#include "x/b.inc"\n#include "x/a.inc"'),
    "names of a client": ("a.h", "int a(void);\nint b(void);", "a.c", "int a(void) { return b(); }",
                          "b.c", "int b(void) { return a(); }"),
}
SOUND = {
    "declarations and types":
        ("a.h", "int mo_a(void);\nint mo_b(void);\nextern const int mo_c;",
         "a.c", "int mo_a(void) { return mo_b() + mo_c; }",
         "b.c", 'const int mo_c = 1; /* mo_a */\nint mo_b(void)\n{\n  struct mo_a *a = 0;\n'
         '  return a->mo_a + "mo_a"[0];\n}'),
    "local names":
        ("a.c", "static int b(int a) { return a; }\nint c(void) { return b(1); }",
         "b.c", "static int a(int b) { return b; }\nint d(void) { return a(1); }"),
    "fragments of different sources":
        ("a.inc", "static int a(int n) { return n; }", "b.inc", "static int b(int n) { return n; }",
         "a.c", '#include "x/a.inc"\nint mo_a(void) { return a(1) + mo_b(); }',
         "b.c", '#include "x/b.inc"\nstatic int a(int n);\nint mo_b(void) { return a(b(1)); }'),
}


def self_test():
    """Returns circles that were not noticed, and valid files that were refused."""
    wrong = []
    for what, files in (CIRCLES | SOUND).items():
        with tempfile.TemporaryDirectory() as top:
            folder = Path(top) / "src/x"
            folder.mkdir(parents=True)
            for name, text in zip(files[::2], files[1::2]):
                (folder / name).write_text(text + "\n")
            if bool(circles_of(folder, Path(top))) != (what in CIRCLES):
                wrong.append(f"{'not noticed' if what in CIRCLES else 'refused'}: circle of {what}")
    return wrong
