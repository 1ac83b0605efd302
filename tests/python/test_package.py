"""The package itself: documentation, and the synchronous client, which is generated from the
asynchronous one."""

import inspect
import pathlib
import re
import subprocess
import sys

import morphod

PACKAGE = pathlib.Path(morphod.__file__).parent.parent


def test_synchronous_client_is_made_from_the_other():
    subprocess.run([sys.executable, PACKAGE / "tools" / "synchronous", "--check"], check=True)


def test_every_public_name_is_documented():
    missing = []
    for name in morphod.__all__:
        thing = getattr(morphod, name)
        if not (inspect.isclass(thing) or inspect.isfunction(thing)):
            continue
        if not inspect.getdoc(thing):
            missing.append(name)
        if not inspect.isclass(thing):
            continue
        for own, member in vars(thing).items():
            plain = isinstance(member, property) or inspect.isfunction(member)
            if not own.startswith("_") and plain and not inspect.getdoc(member):
                missing.append(f"{name}.{own}")
    assert not missing


def test_no_page_installs_the_name_from_an_index():
    """The package is in no index, where anybody could take the name."""
    root = PACKAGE.parents[1]
    files = [root / "README.md", *(path for folder in ("clients/python", "docs", "experiments")
                                   for path in (root / folder).rglob("*")
                                   if path.suffix in (".md", ".py", ".ipynb", ".txt"))]
    assert len(files) > 50
    wrong = [str(path) for path in files
             if re.search(r"pip install ['\"\\\\]*morphod\b", path.read_text())]
    assert not wrong


def test_examples_of_the_readme(service, monkeypatch, tmp_path):
    """The examples run in order, unchanged, with a service."""
    monkeypatch.setenv("MORPHOD_SERVER", f"http://{service.host}:{service.port}")
    monkeypatch.chdir(tmp_path)
    names = {}
    examples = re.findall(r"```py\n(.*?)```", (PACKAGE / "README.md").read_text(), re.DOTALL)
    assert len(examples) >= 5
    for example in examples:
        exec(compile(example, "README.md", "exec"), names)  # noqa: S102
