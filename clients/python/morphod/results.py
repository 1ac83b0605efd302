"""Results that need no further requests: the scores of a design, and controllers."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from .bodies import Body, dropped
from .weights import read_safetensors, torch_module

if TYPE_CHECKING:
    from numpy.typing import NDArray


class Result:
    """The scores of one design in all environments of its evaluation.

    `id` is the canonical form of the design, `genotype` what was simulated, `lost` what the
    conversion and the repair of the body left out. `fault` is None, or why there was no body to
    score: then `id` and `genotype` are empty, and the score is NaN.
    """

    def __init__(self, data: Mapping[str, Any], lost: tuple[str, ...],
                 fault: str | None = None) -> None:
        self.data = data
        self.lost = lost + dropped(data["repaired"])
        told = data["fault"]
        self.fault: str | None = fault if told and fault else told and str(told["detail"])
        self.id = str(data["id"] or "")
        self.genotype = str(data["genotype"] or "")
        score = data["score"]
        self.score = float("nan") if score is None else float(score)

    @property
    def body(self) -> Body:
        """What was simulated."""
        return Body.of(self.genotype)

    @property
    def losses(self) -> NDArray[np.float64]:
        """One per environment; NaN where the rollout diverged."""
        return np.array(self.data["losses"], dtype=np.float64)

    def __repr__(self) -> str:
        return f"<Result {self.id}: score {self.score:.6g}>"


class Controller:
    """A controller: its file, and what is known of it.

    `data` is what the service tells of it, `content` the bytes of its safetensors file.
    """

    def __init__(self, data: Mapping[str, Any], content: bytes) -> None:
        self.data = data
        self.content = content
        self.name: str | None = data["name"]

    @property
    def arrays(self) -> dict[str, NDArray[Any]]:
        """The tensors by name: net.0.weight, net.0.bias, …"""
        return read_safetensors(self.content)[0]

    @property
    def metadata(self) -> dict[str, str]:
        """What the file tells of itself: sensor, parent, settings, …"""
        return read_safetensors(self.content)[1]

    def torch(self) -> Any:
        """The controller as a `torch.nn.Module`. Needs torch."""
        return torch_module(self.arrays)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes the safetensors file."""
        with open(path, "wb") as file:
            file.write(self.content)

    def __repr__(self) -> str:
        return f"<Controller {self.name or self.data.get('sha256', 'without a name')}>"
