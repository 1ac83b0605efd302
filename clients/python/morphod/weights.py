"""Controllers as arrays: safetensors files, read and written with only NumPy."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from .errors import MorphodError

if TYPE_CHECKING:
    from numpy.typing import NDArray

_HEADER_MAX = 100_000_000
_TYPES = {"F16": "<f2", "F32": "<f4", "F64": "<f8", "I8": "i1", "I32": "<i4", "I64": "<i8",
          "U8": "u1"}
_NAMES = {np.dtype(code): name for name, code in _TYPES.items()}


def read_safetensors(data: bytes) -> tuple[dict[str, NDArray[Any]], dict[str, str]]:
    """Returns the tensors of a safetensors file by name, and its metadata. Raises
    `MorphodError`."""
    length = int.from_bytes(data[:8], "little")
    if len(data) < 8 or length > _HEADER_MAX or len(data) < 8 + length:
        raise MorphodError("this is not a safetensors file: it ends before its header does")
    try:
        header = json.loads(data[8:8 + length])
        metadata = header.pop("__metadata__", {})
        tensors = {}
        for name, entry in header.items():
            begin, end = entry["data_offsets"]
            kind = np.dtype(_TYPES[entry["dtype"]])
            tensors[name] = np.frombuffer(data[8 + length + begin:8 + length + end],
                                          kind).reshape(entry["shape"])
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise MorphodError(f"this is not a safetensors file: {error}") from None
    return tensors, metadata


def write_safetensors(tensors: Mapping[str, Any], metadata: Mapping[str, str] | None = None
                      ) -> bytes:
    """Returns a safetensors file with the tensors, in their order: NumPy arrays, or anything that
    `numpy.asarray` accepts, such as the tensors of a torch `state_dict` on the CPU."""
    header: dict[str, Any] = {}
    if metadata:
        header["__metadata__"] = dict(metadata)
    parts = []
    at = 0
    for name, tensor in tensors.items():
        if hasattr(tensor, "detach"):
            tensor = tensor.detach().cpu()
        array = np.ascontiguousarray(tensor)
        array = array.astype(array.dtype.newbyteorder("<"), copy=False)
        if array.dtype not in _NAMES:
            raise MorphodError(f"tensor {name} has type {array.dtype}; controllers are float32")
        parts.append(array.tobytes())
        header[name] = {"dtype": _NAMES[array.dtype], "shape": list(array.shape),
                        "data_offsets": [at, at + len(parts[-1])]}
        at += len(parts[-1])
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text + b"".join(parts)


def torch_module(tensors: Mapping[str, NDArray[Any]]) -> Any:
    """Returns the controller as a `torch.nn.Module` with the names of the file in its `state_dict`:
    linear layers, layer norms followed by ReLU, and tanh at the end. Needs torch."""
    try:
        import torch
    except ImportError:
        raise MorphodError("torch is not installed: pip install torch") from None
    layers: list[Any] = []
    places = sorted({int(name.split(".")[1]) for name in tensors})
    for place in places:
        weight = tensors[f"net.{place}.weight"]
        if weight.ndim == 2:
            layers.append(torch.nn.Linear(weight.shape[1], weight.shape[0]))
        else:
            layers += [torch.nn.LayerNorm(weight.shape[0]), torch.nn.ReLU()]
    layers.append(torch.nn.Tanh())

    module = torch.nn.Module()
    module.net = torch.nn.Sequential(*layers)
    module.forward = module.net.forward
    module.load_state_dict({name: torch.tensor(array) for name, array in tensors.items()})
    return module
