"""Messages in which radars state their own alignment, by the definitions of their drivers."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
from rosbags.typesys import get_types_from_msg

from pipeline.ros_definitions import register
from tests.makers.written_logs import Kit

BOSCH = "off_highway_premium_radar_msgs/msg/LocationAttributes"
NEBULA = "continental_msgs/msg/ContinentalArs548DetectionList"
ARS548 = "ars548_messages/msg/DetectionList"
ESR4, ESR6 = "delphi_esr_msgs/msg/EsrStatus4", "delphi_esr_msgs/msg/EsrStatus6"
MRR, SRR = "delphi_mrr_msgs/msg/MrrHeaderAlignmentState", "delphi_srr_msgs/msg/SrrStatus4"
_LINES = {
    "continental_msgs/msg/ContinentalArs548Detection": (
        "float32 azimuth_angle;float32 azimuth_angle_std;bool invalid_distance;bool invalid_distance_std;"
        "bool invalid_azimuth;bool invalid_azimuth_std;bool invalid_elevation;bool invalid_elevation_std;"
        "bool invalid_range_rate;bool invalid_range_rate_std;float32 elevation_angle;float32 elevation_angle_std;"
        "float32 range;float32 range_std;float32 range_rate;float32 range_rate_std;int8 rcs;uint16 measurement_id;"
        "uint8 raw_positive_predictive_value;uint8 classification;uint8 raw_multi_target_probability;"
        "uint16 object_id;uint8 raw_ambiguity_flag"
    ),
    NEBULA: (
        "std_msgs/Header header;uint8 stamp_sync_status;geometry_msgs/Point origin_pos;float32 origin_pitch;"
        "float32 origin_pitch_std;float32 origin_yaw;float32 origin_yaw_std;float32 ambiguity_free_velocity_min;"
        "float32 ambiguity_free_velocity_max;float32 alignment_azimuth_correction;"
        "float32 alignment_elevation_correction;uint8 alignment_status;"
        "continental_msgs/ContinentalArs548Detection[] detections"
    ),
    "ars548_messages/msg/Detection": (
        "float32 f_azimuthangle;float32 f_azimuthanglestd;uint8 u_invalidflags;float32 f_elevationangle;"
        "float32 f_elevationanglestd;float32 f_range;float32 f_rangestd;float32 f_rangerate;float32 f_rangeratestd;"
        "int8 s_rcs;uint16 u_measurementid;uint8 u_positivepredictivevalue;uint8 u_classification;"
        "uint8 u_multitargetprobabilitym;uint16 u_objectid;uint8 u_ambiguityflag;uint16 u_sortindex"
    ),
    ARS548: (
        "std_msgs/Header header;uint64 crc;uint32 length;uint32 sqc;uint32 dataid;uint32 timestamp_nanoseconds;"
        "uint32 timestamp_seconds;uint8 timestamp_syncstatus;uint32 eventdataqualifier;uint8 extendedqualifier;"
        "uint16 origin_invalidflags;float32 origin_xpos;float32 origin_xstd;float32 origin_ypos;float32 origin_ystd;"
        "float32 origin_zpos;float32 origin_zstd;float32 origin_roll;float32 origin_rollstd;float32 origin_pitch;"
        "float32 origin_pitchstd;float32 origin_yaw;float32 origin_yawstd;uint8 list_invalidflags;"
        "ars548_messages/Detection[800] list_detections;float32 list_radveldomain_min;float32 list_radveldomain_max;"
        "uint32 list_numofdetections;float32 aln_azimuthcorrection;float32 aln_elevationcorrection;uint8 aln_status"
    ),
    ESR4: (
        "std_msgs/Header header;string canmsg;bool truck_target_det;bool lr_only_grating_lobe_det;"
        "bool sidelobe_blockage;bool partial_blockage;uint8 mr_lr_mode;uint8 rolling_count_3;uint8 path_id_acc;"
        "uint8 path_id_cmbb_move;uint8 path_id_cmbb_stat;uint8 path_id_fcw_move;uint8 path_id_fcw_stat;"
        "float32 auto_align_angle;uint8 path_id_acc_stat"
    ),
    ESR6: (
        "std_msgs/Header header;string canmsg;uint8 supply_1p8v_a2d;uint8 supply_n5v_a2d;uint8 wave_diff_a2d;"
        "uint8 sw_version_dsp_3rd_byte;bool vertical_align_updated;uint8 system_power_mode;bool found_target;"
        "bool recommend_unconverge;uint8 factory_align_status_1;uint8 factory_align_status_2;"
        "float32 factory_misalignment;uint8 serv_align_updates_done;float32 vertical_misalignment"
    ),
    MRR: (
        "std_msgs/Header header;uint8 can_auto_align_hangle_qf;uint8 can_alignment_status;uint8 can_alignment_state;"
        "float32 can_auto_align_hangle_ref;float32 can_auto_align_hangle"
    ),
    SRR: (
        "std_msgs/Header header;uint16 can_tx_sw_version_host;uint8 can_tx_path_id_blis_ignore;"
        "uint8 can_tx_path_id_blis;float32 can_tx_angle_misalignment;float32 can_tx_auto_align_angle"
    ),
}


def kit_of(ros: int = 2) -> Kit:
    """A kit that knows these types too."""
    kit = Kit(ros=ros)
    for name, text in _LINES.items():
        kit.store.register(get_types_from_msg(text.replace(";", "\n"), name))
    register(kit.store, BOSCH)
    return kit


def message(kit: Kit, kind: str, stamp_ns: int, **values: Any) -> Any:
    """A message of a type, every field zero but those given; of nested ones by the last name of their path."""
    made = _filled(kit, kind, values, kit.header(stamp_ns, "radar"))
    assert not values, f"{kind} has no {', '.join(values)}"
    return made


def _filled(kit: Kit, kind: str, values: dict[str, Any], header: Any) -> Any:
    fields = {}
    for name, (node, detail) in kit.store.fielddefs[kind][1]:
        if name in values:
            fields[name] = values.pop(name)
        elif detail == "std_msgs/msg/Header":
            fields[name] = header
        else:
            fields[name] = _zero(kit, node, detail, values, header)
    return kit.new(kind, **fields)


def _zero(kit: Kit, node: Any, detail: Any, values: dict[str, Any], header: Any) -> Any:
    sort = SimpleNamespace(base=1, name=2, array=3, sequence=4)
    if node == sort.base:
        return {"string": "", "bool": False}.get(detail[0], 0.0 if "float" in detail[0] else 0)
    if node == sort.name:
        return _filled(kit, detail, values, header)
    (inner, of), count = detail
    if inner == sort.name:
        return [_filled(kit, of, {}, header) for _ in range(count)]
    return np.zeros(count, np.dtype(of[0]))
