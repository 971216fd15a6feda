"""The study of KITTI's street counts a start that errs beyond what it says."""

from tests.benchmarks.studies.kitti import summary


def line(off_deg, z, start_deg=2.0, status="held"):
    angles = {"az_deg": 0.0, "el_deg": off_deg, "az_z": 0.0, "el_z": z}
    return {"start_deg": start_deg, "frames": 26, "status": status, "seed": 0} | angles


def test_a_row_tells_the_worst_error_and_how_many_lie_within_what_was_said():
    table = summary([line(0.3, 1.0), line(2.0, 5.7, status="accepted"), line(0.1, 0.2, start_deg=5.0)])
    assert "| 2 deg | 26 | 0.00, 0.00 | 1.15, 2.00 | 2.89 | 3/4 (75.0 %) | 1/2 (50.0 %) |" in table
    assert "| 5 deg | 26 | 0.00, 0.00 | 0.10, 0.10 | 0.14 | 2/2 (100.0 %) | 0/1 (0.0 %) |" in table


def test_a_start_without_a_result_is_a_row_without_numbers():
    refused = {"start_deg": 2.0, "frames": 5, "status": "refused", "seed": 0}
    assert "| 2 deg | 5 | - | - | nan | none | 0/1 (0.0 %) |" in summary([refused])
