"""What radars state of their own alignment: messages of five drivers, in real bytes."""

import numpy as np
import pytest

from pipeline.errors import LogError
from pipeline.ingest.containers.reader import Channel
from pipeline.ingest.messages.alignment import read_alignment
from pipeline.rigs import AlignmentFields
from tests.makers import alignment_messages as of

STAMP_NS = 1_700_000_000 * 10**9
# Angles as the driver logs them, and what they are [deg].
STATED = {
    of.BOSCH: (
        {"theta": 0.005, "theta_variance": 1e-6, "phi": -0.004, "phi_variance": 4e-6, "status": 0},
        (0.2865, -0.2292),
    ),
    of.NEBULA: (
        {"alignment_azimuth_correction": 0.01, "alignment_elevation_correction": -0.02},
        (0.5730, -1.1459),
    ),
    of.ARS548: ({"aln_azimuthcorrection": 0.01, "aln_elevationcorrection": -0.02}, (0.5730, -1.1459)),
    of.ESR4: ({"auto_align_angle": -0.3125}, (-0.3125, None)),
    of.ESR6: ({"vertical_misalignment": 0.125}, (None, 0.125)),
    of.MRR: ({"can_auto_align_hangle": 0.5}, (0.5, None)),
    of.SRR: ({"can_tx_auto_align_angle": -0.25}, (-0.25, None)),
}


def sent(ros, kind, **values):
    kit = of.kit_of(ros)
    message = of.message(kit, kind, STAMP_NS, **values)
    definition = kit.store.generate_msgdef(kind, ros_version=ros)[0]
    pack = kit.store.serialize_cdr if ros == 2 else kit.store.serialize_ros1
    return Channel("/radar/status", kind, "cdr" if ros == 2 else "ros1", definition), memoryview(
        bytes(pack(message, kind))
    )


@pytest.mark.parametrize("ros", [1, 2])
@pytest.mark.parametrize("kind", STATED)
def test_the_angles_of_every_known_message_are_read(kind, ros):
    values, expected = STATED[kind]
    found = read_alignment(*sent(ros, kind, **values))
    for angle, degrees in zip((found.azimuth_rad, found.elevation_rad), expected, strict=True):
        assert angle == (degrees if degrees is None else pytest.approx(np.radians(degrees), rel=2e-4))


def test_a_variance_is_read_as_a_sigma_and_a_status_as_logged():
    found = read_alignment(*sent(2, of.BOSCH, **STATED[of.BOSCH][0] | {"status": 3}))
    assert (found.azimuth_sigma_rad, found.elevation_sigma_rad) == pytest.approx((1e-3, 2e-3), rel=1e-5)
    assert found.status == "3"
    assert read_alignment(*sent(2, of.ESR4)).azimuth_sigma_rad is None


def test_nan_states_no_angle():
    found = read_alignment(
        *sent(2, of.BOSCH, theta=np.nan, theta_variance=np.nan, phi=0.1, phi_variance=np.nan)
    )
    assert found.azimuth_rad is None
    assert found.elevation_rad == pytest.approx(0.1)
    assert found.elevation_sigma_rad is None


def test_fields_of_another_message_may_be_named_with_their_sign_and_unit():
    fields = AlignmentFields(azimuth="-factory_misalignment", unit="deg", status="factory_align_status_1")
    found = read_alignment(*sent(2, of.ESR6, factory_misalignment=0.5, factory_align_status_1=2), fields)
    assert found.azimuth_rad == pytest.approx(np.radians(-0.5))
    assert (found.elevation_rad, found.status) == (None, "2")


def test_a_field_that_is_not_there_is_named_with_those_that_are():
    with pytest.raises(
        LogError, match=r"topic /radar/status, field packet\.theta.*no packet there, only header"
    ):
        read_alignment(*sent(2, of.ESR4), AlignmentFields(azimuth="packet.theta"))


def test_a_field_that_is_no_number_is_named():
    with pytest.raises(LogError, match=r"field header: .*not a number"):
        read_alignment(*sent(2, of.ESR4), AlignmentFields(azimuth="header"))


def test_a_type_that_is_not_known_needs_its_fields_named():
    channel, data = sent(2, of.ESR4)
    with pytest.raises(LogError, match="alignment_fields"):
        read_alignment(Channel(channel.topic, "std_msgs/msg/Header", "cdr"), data)
