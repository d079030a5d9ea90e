"""Faults of the wheel speed: stuck, slipping, locked, reversed, of another tyre."""

import numpy as np

from sensors.simulate.faults.fault import During, Fault, Rows, lost, stuck, times
from sensors.simulate.faults.gnss import OUT, SHORT


def _slipping(rows: Rows, during: During) -> Rows:
    return rows.having(speed=rows.columns["speed"] + during.size)


def _locked(rows: Rows, during: During) -> Rows:
    return rows.having(speed=np.zeros(len(rows.true_ns)))


def _reversed(rows: Rows, during: During) -> Rows:
    return rows.having(speed=-rows.columns["speed"])


FAULTS = (
    Fault("wheel-stuck", "the speed stays the same for {}", {"wheel": stuck("speed")}, None, SHORT),
    Fault("wheel-scale", "speeds are {} too large", {"wheel": times("speed")}, (1.02, 1.1, 1.5), unit="times"),
    Fault("wheel-slip", "wheels spin {} too fast", {"wheel": _slipping}, (0.5, 2.0, 10.0), (3.0,) * 3, "m/s"),
    Fault("wheel-locked", "wheels stand still for {}", {"wheel": _locked}, None, (0.3, 1.0, 3.0)),
    Fault("wheel-reversed", "the speed has the wrong sign for {}", {"wheel": _reversed}, None, SHORT),
    Fault("wheel-dropout", "nothing for {}", {"wheel": lost}, None, OUT),
)
