"""What all Python tests share."""

from importlib.metadata import version
from importlib.util import find_spec

import pytest
import torch
from small_scenes import make_scene

import diffsim as ds


def pytest_configure(config: pytest.Config) -> None:
    """Many scenes are of 1 or 2 kg/m³, for round numbers."""
    config.addinivalue_line("filterwarnings", "ignore::diffsim.UnitsWarning")


def pytest_report_header() -> str:
    """Name the copy of diffsim under test: the installed one, unless PYTHONPATH says otherwise."""
    spec = find_spec("diffsim")
    return f"diffsim: {spec.origin if spec else 'not found'}, torch {version('torch')}"


if find_spec("hypothesis"):
    from hypothesis import settings

    settings.register_profile("quick", max_examples=25, deadline=None, derandomize=True, database=None)
    settings.register_profile("long", max_examples=2000, deadline=None)
    settings.load_profile("quick")


@pytest.fixture
def sim() -> ds.Simulator:
    """A box and a ball in free flight."""
    return ds.Simulator(make_scene(), dt=0.01)


@pytest.fixture
def state(sim: ds.Simulator) -> ds.State:
    """Where the file's `sim` starts."""
    return sim.initial_state()


@pytest.fixture(autouse=True)
def _seeded() -> None:
    torch.manual_seed(0)
