"""Every reason that `boresight check` and a refused or incomplete day give, as one list; fields are filled in place.

What is wrong in one message or file stands beside the code that reads it.
"""

from schemas.words import sentences_of

__all__ = ["REASONS", "because"]

_LABELS = "log labels and detections, or name models (`boresight models --fetch`)"
REASONS = {
    # Of a day that is refused, and of a sensor that it lacks.
    "nothing": "no usable message on {topics}: correct the topics in fleet.toml (see `boresight check`)",
    "apart": "{messages} are never {near}",
    "none near": "no message of {topic} is {near}",
    "unusable": "no moment has two usable sensors, most often {cause} ({times})",
    "sensor unusable": "{topic} was unusable, most often {cause} ({times})",
    "gate": "within {ms:g} ms of each other: check their clocks, raise ingest.sync_gate_s, or leave it out to gate by "
    "motion",
    "motion gate": "within {m:g} m of driving and {deg:g} deg of turning, apart from constant offsets: check the "
    "sensors' clocks and rates, or raise ingest.sync_gate_m and sync_gate_deg",
    "other date": "sweeps are stamped {stamped:%Y-%m-%d %H:%M} UTC, far from the day {day} that they are filed under",
    # Of a log.
    "cut off": "{log}: is cut off",
    "damage": "{log}: {count} {damage}",
    "lost": "{log}: cannot be read further: {error}",
    "unread": "{log}: not read: it has no usable index, and other logs have one",
    "no index": "{logs}: no usable index, so all of the day's {sweeps} sweeps were read, not a selection",
    "log times": "log times do not follow the stamps, so all of the day's {sweeps} sweeps were read, not a selection",
    # Of a topic.
    "no message": "no message",
    "type": "type {types}, not {wanted}",
    "no intrinsics": "no usable intrinsics: {remedy}",
    "elsewhere": "{reason}; the same type comes on {topics}: correct the topic in fleet.toml",
    "correct": "{reason}: correct the topic in fleet.toml",
    "CameraInfo": "log a sensor_msgs/CameraInfo with a calibrated K",
    # What degrees of freedom lack.
    "too few": "{frames} usable synchronised frames; at least {needed} are needed",
    "few": "{frames} usable frames: record {needed} or more",
    "no frames": "{reason} (prior, labels and motion were therefore not checked)",
    "no prior": "no prior: log /tf_static with a chain between the sensors, or give prior.file",
    "no semantics": f"{{without}}; better {_LABELS}",
    "no labels": f"no semantic labels on the topics of `semantics`: {_LABELS}, or remove `semantics` from fleet.toml, "
    "for borders by brightness",
    "some labels": "labels on {share:.0%} of the frames only",
    "no boxes": f"no boxes of road users to compare with the radar: {_LABELS}",
    "no detections": "no camera detections to compare with the radar's elevation",
    "few rings": "the lidar has few rings and logs no intensity: pitch depends on vertical edges only",
    "shift": "far objects constrain shifts weakly: the prior provides part of it",
    "no elevation": "the radar measures no elevation: roll, pitch and z keep their prior",
    "elevation": "radar elevation is coarse: expect half a degree, and z from the prior",
    "motion unknown": "Doppler and odometry do not show whether the car moves",
    "stands": "the car moves in {share:.0%} of the frames: time offsets are not observable",
    "turns, shift": "x and y of the vehicle are observable only in turns",
    "turns, roll": "roll of a camera on the vehicle is observable only in turns",
    # Of a Doppler, an odometry, and the direction in which a sensor looks.
    "backwards": "the car would drive backwards: {remedy}",
    "velocity fields": "velocity_fields must be relative to the radar, x ahead of it",
    "tracks": "velocities of tracks must be relative to the radar, x ahead of it",
    "other sign": 'doppler_positive{whose} is probably "{sign}"',
    "assumed": 'fleet.toml does not set doppler_positive{whose}, so "{sign}" is assumed; {shown}',
    "confirmed": "the log confirms it: enter it",
    "opposite": "the log shows the opposite: enter it",
    "undecided": "this log does not determine it: drive, or see the data sheet",
    "signs differ": "by tf the radars need different signs: doppler_positive of {signs}; correct the transform of "
    "{few} if it is turned round, else keep both if the data sheets differ",
    "span": "Doppler spans {span:.1f} m/s, more than doppler_period_mps = {period:g} allows",
    "no fit": "most scans fit no static world: check doppler_field, doppler_period_mps and the radar's heading",
    "km/h": "most scans fit no static world, {share:.0%} do as km/h: log the Doppler in m/s",
    "ratio": "the speed of the odometry is {ratio:+.2f} times the speed of the Doppler: {fits}",
    "fits": "{fits} fits the {source}",
    "scale": "a scale is wrong",
    "points back": "{sensor} points backwards: {met:.0%} of the detections match the sweeps if it is turned by 180 "
    "deg, {given:.0%} by the prior; correct its transform",
    # Advice.
    "no times": "the lidar logs no time per point: its sweeps stay as logged. If it turns, and its driver does not "
    'de-skew, state its turn in fleet.toml, below points: turn = {{ sense = "right", begins_deg = 180.0 }}',
    "not optical": "the image's frame id is not an optical frame (x right, y down, z forward): check /tf_static",
    "no speed": "no odometry configured, and no radar: the car's speed and the time offset stay unknown",
    "no odometry": "no odometry configured: ego speed comes from Doppler, and the lidar is de-skewed without turns",
    "odometry silent": "{topic} has no messages around any sweep: the lidar is de-skewed by Doppler, without turns",
    "longer": "{frames} frames: a calibration uses up to 100, so log a longer drive",
    "write prior": "{reason} (`boresight import` writes such a file)",
    "again": "{problem}: copy or record this log again",
}
because = sentences_of(REASONS)
