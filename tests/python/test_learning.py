"""The script of docs/learning.md, as printed, and what it must have done."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import torch

PAGE = Path(__file__).resolve().parents[2] / "docs" / "learning.md"


def test_the_pages_script_runs_and_its_gradients_arrive() -> None:
    torch.manual_seed(0)
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    assert len(blocks) > 4
    names: dict[str, Any] = {}
    exec("\n".join(blocks), names)
    for parameter in names["policy"].parameters():
        assert parameter.grad.dtype == torch.float32
        assert parameter.grad.any()
    assert names["loss"].dtype == torch.float64
    assert names["done"].any()
    assert not names["done"].all()
    assert torch.equal(names["state"].position[names["done"]][0], names["sim"].initial_state().position)
    assert len(names["end"]) == 4
    assert names["velocity"].grad.any()
    # ω = t τ / (factor I): the gradient of each scene with respect to its factor is -ω.
    spin = names["trajectory"][-1].angular_velocity[:, 0, 2]
    torch.testing.assert_close(names["factor"].grad, -spin.detach(), rtol=1e-9, atol=0.0)
