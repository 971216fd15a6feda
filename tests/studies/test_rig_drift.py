"""Study rig_drift on a small fleet: it counts what it says, and finds a knock."""

import numpy as np

from tests.benchmarks.studies.rig_drift import false_alarms, named, vehicle


def test_a_quiet_fleet_of_many_sensors_has_no_alarm_and_a_knocked_one_is_named():
    rng = np.random.default_rng(9300)
    quiet = [vehicle(rng, 10, 1.0, knocked=False) for _ in range(4)]
    assert false_alarms(quiet, 10) == {"nights": 20, "red": 0.0, "any": 0.0}
    knocked = [vehicle(rng, 24, 1.0, knocked=True) for _ in range(6)]
    found = named(knocked, 24)
    assert found["right"] == found["red"] >= 0.8
    assert found["wrong"] == 0.0
