"""A road network for tests: every environment that the road test has, on a network large enough for statistics."""

import numpy as np

from sensors.simulate.environment import Environment, Road, Sky
from sensors.simulate.network import NetworkPlan

START_LLH = (np.radians(48.137), np.radians(11.575), 560.0)
START_NS = 1_715_673_600 * 10**9
PLAN = NetworkPlan()
ENVIRONMENTS = {
    "city": Environment(share=48.0, length_min_m=300.0, length_max_m=3000.0),
    "canyon": Environment(share=12.0, length_min_m=200.0, length_max_m=900.0),
    "highway": Environment(
        share=25.0,
        length_min_m=1000.0,
        length_max_m=6000.0,
        road=Road(on="highways", speed_limits=(22.0, 27.0, 33.0), stop_probability=0.0, curve_radius_min_m=400.0),
    ),
    "tunnel": Environment(
        share=6.0,
        length_min_m=200.0,
        length_max_m=1500.0,
        road=Road(on="any", speed_limits=(16.0,), stop_probability=0.0),
        sky=Sky(blocked=True),
    ),
    "bridge": Environment(
        share=5.0, length_min_m=100.0, length_max_m=600.0, road=Road(on="any", rise_m=4.0, grade_max=0.08)
    ),
    "underpass": Environment(share=4.0, length_min_m=60.0, length_max_m=150.0, road=Road(rise_m=-5.0, grade_max=0.09)),
}
