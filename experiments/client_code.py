"""The Python client in the source tree, for programs that need no build: its part without asyncio
is generated."""
import runpy
from pathlib import Path

TOOL = Path(__file__).resolve().parents[1] / "clients" / "python" / "tools" / "synchronous"


def generate():
    runpy.run_path(str(TOOL))["main"]([])
