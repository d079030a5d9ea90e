"""One simulated drive for every test of the simulator."""

import pytest

from sensors.simulate.drive import Drive, DriveConfig, simulate_drive
from sensors.simulate.trajectory import Truth


@pytest.fixture(scope="session")
def drive() -> Drive:
    """Ten minutes by the default config."""
    return simulate_drive(600.0, 3, DriveConfig())


@pytest.fixture(scope="session")
def truth(drive: Drive) -> Truth:
    return drive.truth
