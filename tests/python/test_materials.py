"""What cloth may be made of: fields that are checked, presets whose numbers follow from what their docstrings say."""

import pickle
from dataclasses import FrozenInstanceError, astuple, fields, replace
from typing import Any

import pytest
import torch

import diffsim as ds
from diffsim import ClothMaterial

PRESETS = ("cotton", "denim", "silk", "paper", "rubber_sheet")
GF_CM = 0.980665  # 1 gf/cm [N/m]
GF_CM_DEGREE = 56.187  # 1 gf/(cm·°) [N/m]
GF_CM2_CM = 9.80665e-5  # 1 gf·cm²/cm [N·m]


def test_the_default_is_plain_cotton() -> None:
    assert ClothMaterial() == ClothMaterial.cotton()
    assert ds.ClothMaterial is ClothMaterial
    assert [field.name for field in fields(ClothMaterial)] == [
        "density", "stretch", "shear", "bend", "damping", "poisson",
    ]  # fmt: skip


def test_fields_are_frozen_floats() -> None:
    material = ClothMaterial(1, torch.tensor(2.0), shear=3)  # type: ignore[arg-type]
    assert astuple(material)[:3] == (1.0, 2.0, 3.0)
    assert all(type(value) is float for value in astuple(material))
    with pytest.raises(FrozenInstanceError):
        material.bend = 1.0  # type: ignore[misc]
    assert pickle.loads(pickle.dumps(material)) == material
    assert replace(material, damping=0.0).damping == 0.0


@pytest.mark.parametrize("name", PRESETS)
def test_presets_are_sheets_one_could_make(name: str) -> None:
    material = getattr(ClothMaterial, name)()
    assert 0.03 < material.density < 2.0
    assert 1e3 <= material.stretch <= 1e6
    assert 0.0 < material.shear < material.stretch
    assert 1e-7 < material.bend < 1e-2
    assert 0.0 <= material.damping <= 0.02
    assert getattr(ClothMaterial, name).__doc__


def test_woven_presets_follow_from_kawabatas_numbers() -> None:
    for material, extension, shear, bend in (
        (ClothMaterial.cotton(), 0.05, 1.1, 0.08),
        (ClothMaterial.denim(), 0.055, 2.18, 0.172),
        (ClothMaterial.silk(), 0.04, 0.3, 0.02),
    ):
        assert material.stretch == pytest.approx(500.0 * GF_CM / extension, rel=0.03)
        assert material.shear == pytest.approx(shear * GF_CM_DEGREE, rel=0.04)
        assert material.bend == pytest.approx(bend * GF_CM2_CM, rel=0.03)
    assert ClothMaterial.denim().density == pytest.approx(11 * 0.0339, rel=1e-3)
    assert ClothMaterial.silk().density == pytest.approx(14 * 4.34e-3, rel=5e-3)


def test_paper_and_rubber_are_isotropic_sheets() -> None:
    paper, rubber = ClothMaterial.paper(), ClothMaterial.rubber_sheet()
    assert paper.density == pytest.approx(0.08)
    assert paper.stretch == pytest.approx(3e5)
    assert paper.shear == pytest.approx(1.154e5, rel=1e-3)
    assert paper.bend == pytest.approx(2.747e-4, rel=1e-3)
    assert rubber.stretch == pytest.approx(1500.0)
    assert rubber.shear == pytest.approx(500.0)
    assert rubber.bend == pytest.approx(1.5e6 * 1e-9 / 9.0)
    for material in (paper, rubber):  # the energy does not know a direction: E/(1 - ν²) - ν E/(1 - ν²) = 2 G
        assert material.stretch / (1.0 + material.poisson) == pytest.approx(2.0 * material.shear)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"density": 0.0}, r"ClothMaterial: density must be positive, got 0 \[kg/m²\]"),
        ({"stretch": -1.0}, r"ClothMaterial: stretch must be positive, got -1 \[N/m\]"),
        ({"shear": 0}, r"ClothMaterial: shear must be positive, got 0 \[N/m\]"),
        ({"bend": -2e-6}, r"ClothMaterial: bend must be positive, got -2e-06 \[N·m\]"),
        ({"damping": -0.1}, r"ClothMaterial: damping must not be negative, got -0.1 \[s\]"),
        ({"poisson": 1.0}, r"ClothMaterial: poisson must lie between -1 and 1 exclusive, got 1;"),
        ({"poisson": -1.5}, r"ClothMaterial: poisson must lie between -1 and 1 exclusive, got -1.5;"),
        ({"stretch": float("nan")}, r"ClothMaterial: stretch must be finite, got nan"),
        ({"bend": float("inf")}, r"ClothMaterial: bend must be finite, got inf"),
        ({"shear": [1.0, 2.0]}, r"ClothMaterial: shear must be a number, got shape \(2,\)"),
    ],
)
def test_values_out_of_range_are_refused_by_name(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ClothMaterial(**arguments)


def test_types_are_refused_by_name() -> None:
    with pytest.raises(TypeError, match=r"ClothMaterial: stretch must be a number, got 'stiff'"):
        ClothMaterial(stretch="stiff")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"ClothMaterial\.isotropic: thickness must be positive, got 0 \[m\]"):
        ClothMaterial.isotropic(1e9, 0.0, 800.0)
    with pytest.raises(ValueError, match=r"ClothMaterial\.isotropic: poisson must lie between -1 exclusive and 0.5"):
        ClothMaterial.isotropic(1e9, 1e-4, 800.0, poisson=0.6)
