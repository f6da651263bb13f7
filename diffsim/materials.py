"""What cloth is made of: a thin sheet described by areal density, stiffness and damping."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

from ._arguments import number, positive

__all__ = ["ClothMaterial"]

_UNITS = {"density": "kg/m²", "stretch": "N/m", "shear": "N/m", "bend": "N·m"}


@dataclass(frozen=True)
class ClothMaterial:
    """A cloth's material, as numbers; the defaults are those of `cotton`.

    Gradients reach the parameters a simulator makes of it, `sim.cloth_density`, `sim.cloth_stretch`, `sim.cloth_shear`,
    `sim.cloth_bend` and `sim.cloth_damping`, and not `poisson`.

    In its plane the sheet is orthotropic St. Venant-Kirchhoff, equally stiff along warp and weft. With Green's strain
    ε, 1 the warp's direction and 2 the weft's, it stores per area

        ½ stretch/(1 - poisson²) (ε11² + ε22² + 2 poisson ε11 ε22) + ½ shear (2 ε12)²

    and out of it ½ bend |κ|², with |κ|² = κ11² + κ22² + 2 κ12² of the curvature: a cylinder of radius r stores
    bend/(2 r²), whichever way it is rolled. A strip of length L hanging under its own weight stretches by
    density g L²/(2 stretch).

    Where a sheet is cut from a homogeneous isotropic material of Young's modulus E, thickness t and Poisson's ratio ν,
    stretch = E t, shear = E t/(2 (1 + ν)), bend = E t³/(12 (1 - ν²)); `isotropic` computes them. Woven cloth is no such
    sheet: its yarns slide, so that it shears and bends far more easily than it stretches.

    Damping is of Kelvin-Voigt type: stress grows by `damping` times the rate at which the elastic stress changes. A
    mode of angular frequency ω loses energy as with a loss factor tan δ = damping ω. The friction between yarns that
    damps real cloth does not depend on the rate, so a number fits one frequency only: 0.01 s is tan δ = 0.13 at 2 Hz.

    Args:
        density: Mass per area [kg/m²].
        stretch: Force per width and strain in a uniaxial pull along warp or weft [N/m].
        shear: Shear force per width and shear angle between warp and weft [N/m].
        bend: Moment per width and curvature [N·m].
        damping: Ratio of viscous to elastic stiffness [s]; 0 for none.
        poisson: Ratio of the strain across to the strain along a uniaxial pull, between -1 and 1 exclusive.
    Raises: TypeError, ValueError naming the field, for what is not a finite number in range.
    """

    density: float = 0.15
    stretch: float = 1.0e4
    shear: float = 60.0
    bend: float = 8.0e-6
    damping: float = 0.01
    poisson: float = 0.0

    def __post_init__(self) -> None:
        where = "ClothMaterial"
        values: dict[str, Any] = {field.name: getattr(self, field.name) for field in fields(self)}
        for name, unit in _UNITS.items():
            values[name] = positive(values[name], f"{where}: {name}", unit)
        for name in ("damping", "poisson"):
            values[name] = number(values[name], f"{where}: {name}")
        if values["damping"] < 0.0:
            raise ValueError(f"{where}: damping must not be negative, got {values['damping']:g} [s]")
        if not -1.0 < values["poisson"] < 1.0:
            raise ValueError(
                f"{where}: poisson must lie between -1 and 1 exclusive, got {values['poisson']:g}; beyond, no sheet is "
                "stable"
            )
        for name, value in values.items():
            object.__setattr__(self, name, value)

    @classmethod
    def isotropic(
        cls, young: float, thickness: float, density: float, poisson: float = 0.3, damping: float = 0.0
    ) -> ClothMaterial:
        """A sheet cut from a homogeneous isotropic material, by the formulas above.

        Args:
            young: Young's modulus [Pa].
            thickness: [m]
            density: Mass per volume [kg/m³].
            poisson: Poisson's ratio, above -1 and at most 0.5.
            damping: Ratio of viscous to elastic stiffness [s].
        Raises: TypeError, ValueError naming the argument, for what is not a finite number in range.
        """
        where = "ClothMaterial.isotropic"
        young = positive(young, f"{where}: young", "Pa")
        thickness = positive(thickness, f"{where}: thickness", "m")
        density = positive(density, f"{where}: density", "kg/m³")
        poisson = number(poisson, f"{where}: poisson")
        if not -1.0 < poisson <= 0.5:
            raise ValueError(f"{where}: poisson must lie between -1 exclusive and 0.5, got {poisson:g}")
        return cls(
            density=density * thickness,
            stretch=young * thickness,
            shear=young * thickness / (2.0 * (1.0 + poisson)),
            bend=young * thickness**3 / (12.0 * (1.0 - poisson**2)),
            damping=damping,
            poisson=poisson,
        )

    # The units of Kawabata's instruments: 1 gf/cm = 0.980665 N/m, 1 gf/(cm·°) = 56.2 N/m, 1 gf·cm²/cm = 9.80665e-5 N·m.
    # A tensile test ends at 500 gf/cm = 490 N/m, at a strain EMT; stretch is the secant 490 N/m / EMT.

    @classmethod
    def cotton(cls) -> ClothMaterial:
        """Plain-woven cotton of shirt or sheet weight.

        Round numbers of the size Kawabata's instruments [kawabata1980standardization] report for such cloth, not the
        measurement of one sample: 150 g/m²; EMT = 5 %, so 490/0.05 = 1e4 N/m; G = 1.1 gf/(cm·°), so 60 N/m;
        B = 0.08 gf·cm²/cm, so 8e-6 N·m. Samples differ from each other by factors of two and three. Damping: see the
        class.
        """
        return cls()

    @classmethod
    def denim(cls) -> ClothMaterial:
        """Cotton denim of 11 oz/yd².

        Measured with Kawabata's instruments [kumari2016regenerated, table 5, fabric A]: EMT = 5.5 %, so
        490/0.055 = 8.9e3 N/m; G = 2.18 gf/(cm·°), so 122 N/m; B = 0.172 gf·cm²/cm, so 1.7e-5 N·m. Density: 11 oz/yd²
        of 33.9 g/m² each. Denims differ: the 11 oz black denim of [wang2011data], in the data files that simulators
        pass on, has 0.324 kg/m² and bends with 6e-5 N·m. Damping: see the class.
        """
        return cls(density=0.373, stretch=8.9e3, shear=122.0, bend=1.7e-5, damping=0.01)

    @classmethod
    def silk(cls) -> ClothMaterial:
        """Light plain-woven silk (habotai).

        14 momme of 4.34 g/m² are 61 g/m². The rest are round numbers of the size Kawabata's instruments
        [kawabata1980standardization] report for light silks, not the measurement of one sample: EMT = 4 %, so
        490/0.04 = 1.2e4 N/m; G = 0.3 gf/(cm·°), so 17 N/m; B = 0.02 gf·cm²/cm, so 2e-6 N·m. Damping: half of cotton's,
        by estimate: light silk recovers from bending and shear with less hysteresis.
        """
        return cls(density=0.061, stretch=1.2e4, shear=17.0, bend=2.0e-6, damping=0.005)

    @classmethod
    def paper(cls) -> ClothMaterial:
        """Copy paper of 80 g/m².

        Taken for an isotropic sheet with E = 3 GPa, t = 0.1 mm, ν = 0.3: textbook size, between the values along and
        across the machine's direction, which differ by about two. So stretch = E t = 3e5 N/m,
        shear = E t/(2 (1 + ν)) = 1.15e5 N/m, bend = E t³/(12 (1 - ν²)) = 2.7e-4 N·m. Damping: tan δ = 0.03 at 5 Hz, an
        estimate.
        """
        return cls.isotropic(young=3.0e9, thickness=1.0e-4, density=800.0, poisson=0.3, damping=0.001)

    @classmethod
    def rubber_sheet(cls) -> ClothMaterial:
        """Soft vulcanised natural rubber, 1 mm thick.

        Isotropic and incompressible: E = 1.5 MPa, ν = 0.5, 950 kg/m³, textbook size for unfilled rubber at small
        strains. So density = 0.95 kg/m², stretch = E t = 1500 N/m, shear = E t/3 = 500 N/m, bend = E t³/9 = 1.7e-4 N·m.
        Damping: tan δ = 0.06 at 10 Hz, an estimate.
        """
        return cls.isotropic(young=1.5e6, thickness=1.0e-3, density=950.0, poisson=0.5, damping=0.001)
