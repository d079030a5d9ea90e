"""IMUs by name: what their datasheets say, and what else a part of that class does wrong.

ImuSpec is what a filter is told. ImuFlaws are one sigma over parts, drawn anew for each drive; where a datasheet gives
limits, a third of them is taken.
"""

from typing import Literal, NamedTuple

import msgspec

from sensors.bounds import NonNegative
from sensors.vehicle import ImuSpec


class ImuFlaws(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Errors in proportion to the signal and to temperature: one sigma over axes and parts."""

    gyro_scale_ppm: NonNegative = 0.0
    """Constant scale-factor error of the gyro, ppm."""
    accel_scale_ppm: NonNegative = 0.0
    """Constant scale-factor error of the accelerometer, ppm."""
    misalignment_deg: NonNegative = 0.0
    """Each axis against each other one, deg."""
    gyro_bias_deg_per_h_per_k: NonNegative = 0.0
    """Change of the gyro bias with temperature, deg/h per kelvin."""
    accel_bias_mg_per_k: NonNegative = 0.0
    """Change of the accelerometer bias with temperature, milli-g per kelvin."""
    gyro_scale_ppm_per_k: NonNegative = 0.0
    """Change of the gyro's scale with temperature, ppm per kelvin."""
    accel_scale_ppm_per_k: NonNegative = 0.0
    """Change of the accelerometer's scale with temperature, ppm per kelvin."""


class ImuPreset(NamedTuple):
    """One part."""

    spec: ImuSpec
    flaws: ImuFlaws
    source: str
    """Datasheet that the spec follows."""


PresetName = Literal["tactical", "tactical-fog-class", "automotive", "consumer"]

PRESETS: dict[PresetName, ImuPreset] = {
    "tactical": ImuPreset(
        ImuSpec(),
        ImuFlaws(
            gyro_scale_ppm=1000.0,
            accel_scale_ppm=500.0,
            misalignment_deg=0.02,
            gyro_bias_deg_per_h_per_k=4.0,
            accel_bias_mg_per_k=0.02,
            gyro_scale_ppm_per_k=10.0,
            accel_scale_ppm_per_k=10.0,
        ),
        "Seiko Epson M-G320PDG0 data sheet; NovAtel PwrPak7D-E1 product sheet",
    ),
    "tactical-fog-class": ImuPreset(
        ImuSpec(
            name="honeywell-hg4930",
            gyro_noise_deg_per_sqrt_h=0.04,
            accel_noise_m_per_s_per_sqrt_h=0.03,
            gyro_bias_instability_deg_per_h=0.25,
            accel_bias_instability_mg=0.025,
            gyro_turn_on_bias_deg_per_h=7.0,
            accel_turn_on_bias_mg=1.7,
        ),
        ImuFlaws(
            gyro_scale_ppm=300.0,
            accel_scale_ppm=300.0,
            misalignment_deg=0.01,
            gyro_bias_deg_per_h_per_k=0.1,
            accel_bias_mg_per_k=0.01,
            gyro_scale_ppm_per_k=3.0,
            accel_scale_ppm_per_k=3.0,
        ),
        "Honeywell HG4930CA51 data sheet (typical performance over temperature)",
    ),
    "automotive": ImuPreset(
        ImuSpec(
            name="st-asm330lhh",
            gyro_noise_deg_per_sqrt_h=0.3,
            accel_noise_m_per_s_per_sqrt_h=0.035,
            gyro_bias_instability_deg_per_h=3.0,
            accel_bias_instability_mg=0.04,
            gyro_turn_on_bias_deg_per_h=1200.0,
            accel_turn_on_bias_mg=10.0,
        ),
        ImuFlaws(
            gyro_scale_ppm=3000.0,
            accel_scale_ppm=3000.0,
            misalignment_deg=0.2,
            gyro_bias_deg_per_h_per_k=18.0,
            accel_bias_mg_per_k=0.1,
            gyro_scale_ppm_per_k=70.0,
            accel_scale_ppm_per_k=100.0,
        ),
        "STMicroelectronics ASM330LHH data sheet DocID031239 (5 mdps and 60 ug per sqrt(Hz), 0.005 dps/degC)",
    ),
    "consumer": ImuPreset(
        ImuSpec(
            name="bosch-bmi270",
            gyro_noise_deg_per_sqrt_h=0.42,
            accel_noise_m_per_s_per_sqrt_h=0.094,
            gyro_bias_instability_deg_per_h=10.0,
            accel_bias_instability_mg=0.1,
            gyro_turn_on_bias_deg_per_h=1800.0,
            accel_turn_on_bias_mg=20.0,
        ),
        ImuFlaws(
            gyro_scale_ppm=4000.0,
            accel_scale_ppm=4000.0,
            misalignment_deg=0.3,
            gyro_bias_deg_per_h_per_k=72.0,
            accel_bias_mg_per_k=0.25,
            gyro_scale_ppm_per_k=200.0,
            accel_scale_ppm_per_k=40.0,
        ),
        "Bosch Sensortec BMI270 data sheet BST-BMI270-DS000 (7 mdps and 160 ug per sqrt(Hz), 0.5 dps, 20 mg)",
    ),
}
