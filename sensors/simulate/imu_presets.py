"""IMUs by name, each typical of a class: what a filter is told of it, and what else such a part does wrong.

No figure here was read from a manufacturer's sheet. `source` says which of them public pages give; all others are of
the order usual for the part's class. ImuFlaws are one sigma over parts, drawn anew for each drive.
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
    """A part like one on the market."""

    spec: ImuSpec
    flaws: ImuFlaws
    like: str
    """The part that it is like."""
    source: str
    """Which figures public pages give for it, and what kind of page."""


PresetName = Literal["tactical", "tactical-fog-class", "automotive", "consumer"]

PRESETS: dict[PresetName, ImuPreset] = {
    "tactical": ImuPreset(
        ImuSpec(
            gyro_scale_ppm=1000.0,
            gyro_misalignment_deg=0.02,
            accel_scale_ppm=500.0,
            accel_misalignment_deg=0.02,
            gyro_bias_deg_per_h_per_k=4.0,
            accel_bias_mg_per_k=0.02,
        ),
        ImuFlaws(
            gyro_scale_ppm=1000.0,
            accel_scale_ppm=500.0,
            misalignment_deg=0.02,
            gyro_bias_deg_per_h_per_k=4.0,
            accel_bias_mg_per_k=0.02,
            gyro_scale_ppm_per_k=10.0,
            accel_scale_ppm_per_k=10.0,
        ),
        "Epson G320N, the IMU of the NovAtel PwrPak7D-E1",
        "that it is the PwrPak7D-E1's: NovAtel's OEM7 manual (RAWIMUSX); no figure",
    ),
    "tactical-fog-class": ImuPreset(
        ImuSpec(
            name="honeywell-hg4930-class",
            gyro_noise_deg_per_sqrt_h=0.04,
            accel_noise_m_per_s_per_sqrt_h=0.03,
            gyro_bias_instability_deg_per_h=0.25,
            accel_bias_instability_mg=0.025,
            gyro_turn_on_bias_deg_per_h=7.0,
            accel_turn_on_bias_mg=1.7,
            gyro_scale_ppm=300.0,
            gyro_misalignment_deg=0.01,
            accel_scale_ppm=300.0,
            accel_misalignment_deg=0.01,
            gyro_bias_deg_per_h_per_k=0.1,
            accel_bias_mg_per_k=0.01,
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
        "Honeywell HG4930",
        "no figure",
    ),
    "automotive": ImuPreset(
        ImuSpec(
            name="st-asm330lhh-class",
            gyro_noise_deg_per_sqrt_h=0.3,
            accel_noise_m_per_s_per_sqrt_h=0.035,
            gyro_bias_instability_deg_per_h=3.0,
            accel_bias_instability_mg=0.04,
            gyro_turn_on_bias_deg_per_h=1200.0,
            accel_turn_on_bias_mg=10.0,
            gyro_scale_ppm=3000.0,
            gyro_misalignment_deg=0.2,
            accel_scale_ppm=3000.0,
            accel_misalignment_deg=0.2,
            gyro_bias_deg_per_h_per_k=18.0,
            accel_bias_mg_per_k=0.1,
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
        "STMicroelectronics ASM330LHH",
        "5 mdps and 60 ug per sqrt(Hz): within another simulator's ranges for it",
    ),
    "consumer": ImuPreset(
        ImuSpec(
            name="bosch-bmi270-class",
            gyro_noise_deg_per_sqrt_h=0.42,
            accel_noise_m_per_s_per_sqrt_h=0.094,
            gyro_bias_instability_deg_per_h=10.0,
            accel_bias_instability_mg=0.1,
            gyro_turn_on_bias_deg_per_h=1800.0,
            accel_turn_on_bias_mg=20.0,
            gyro_scale_ppm=4000.0,
            gyro_misalignment_deg=0.3,
            accel_scale_ppm=4000.0,
            accel_misalignment_deg=0.3,
            gyro_bias_deg_per_h_per_k=72.0,
            accel_bias_mg_per_k=0.25,
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
        "Bosch Sensortec BMI270",
        "7 mdps and 160 ug per sqrt(Hz), 0.5 dps: copies and users of sheet BST-BMI270-DS000",
    ),
}
