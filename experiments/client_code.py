"""The Python client in the source tree, for programs that need no build: its part without asyncio
is generated."""
import importlib.util
import runpy
import sys
from pathlib import Path

CLIENT = Path(__file__).resolve().parents[1] / "clients" / "python"


def prepare():
    """Makes `import morphod` work, or ends the program with a message that says what is missing."""
    missing = [name for name in ("numpy", "httpx") if importlib.util.find_spec(name) is None]
    if missing:
        sys.exit(f"{sys.executable} has no {' and no '.join(missing)}: install it there, or put "
                 "another python3 first in PATH")
    sys.path.insert(0, str(CLIENT))
    runpy.run_path(str(CLIENT / "tools" / "synchronous"))["main"]([])
