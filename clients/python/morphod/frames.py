"""Rows of the service as pandas tables; pandas is imported when the first one is made."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

from .errors import MorphodError, reading
from .scenes import read_envelope

if TYPE_CHECKING:
    import pandas as pd


def pandas() -> Any:
    """Returns the module, or raises an error that says how to install it."""
    try:
        import pandas as module
    except ImportError:
        raise MorphodError("tables need pandas: pip install pandas") from None
    return module


def flat(row: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Returns a row with nested objects as columns: {"score": {"mean": 1}} becomes {"score_mean":
    1}."""
    columns: dict[str, Any] = {}
    for name, value in row.items():
        if isinstance(value, Mapping):
            columns.update(flat(value, f"{prefix}{name}_"))
        else:
            columns[f"{prefix}{name}"] = value
    return columns


def frame(rows: Iterable[Mapping[str, Any]], **constant: Any) -> pd.DataFrame:
    """Returns a table with one line per row, preceded by the columns that are equal in all. null
    becomes NaN in numeric columns."""
    table = pandas().DataFrame([{**constant, **flat(row)} for row in rows])
    for name in table.columns:
        if table[name].dtype == object and _is_numeric(table[name]):
            table[name] = table[name].astype(float)
    made: pd.DataFrame = table
    return made


# The members of these objects of a design of a campaign, null if it has none, and their columns.
_OF_DESIGNS = {
    "held_out": {name: f"held_out_{name}" for name in (
        "generation", "worlds", "mean", "standard_error", "low", "high", "diverged")},
    "certificate": {"id": "certificate", "class": "certificate_class"},
}


def frame_of_designs(rows: Iterable[Mapping[str, Any]]) -> pd.DataFrame:
    """Returns a table of designs of a campaign: always with the columns of results in fresh worlds
    (`held_out_mean`, `held_out_low`, …) and of certificates (`certificate`,
    `certificate_class`)."""
    def line(row: Mapping[str, Any]) -> dict[str, Any]:
        made = {name: value for name, value in row.items() if name not in _OF_DESIGNS}
        for name, columns in _OF_DESIGNS.items():
            of_row = row[name] or {}
            made.update((column, of_row.get(member)) for member, column in columns.items())
        return made
    return frame(map(line, rows))


@reading()
def frame_of_columns(data: bytes) -> pd.DataFrame:
    """Returns the table of a reply in the format `columns`."""
    columns: dict[str, Any] = read_envelope(data)["columns"]
    for name, values in columns.items():
        if not isinstance(values, list) and values.dtype.kind == "u":
            columns[name] = values.astype(bool if values.dtype.itemsize == 1 else "int64")
    table: pd.DataFrame = pandas().DataFrame(columns)
    return table


def _is_numeric(column: Any) -> bool:
    return all(value is None or (isinstance(value, (int, float)) and not isinstance(value, bool))
               for value in column)
