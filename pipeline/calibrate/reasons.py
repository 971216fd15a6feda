"""Every reason and note that records and poses of a day give, as one list; fields are filled where each is given."""

from schemas.words import sentences_of

__all__ = ["REASONS", "because"]

REASONS = {
    # Frames: what a pair, an edge or the day lacks.
    "few frames": "too few frames: {used}, needs {needed}",
    "few of a pair": "too few frames: {pair} has {used} of {all}, needs {needed} ({counts})",
    "no more": "the day has no more frames",
    "few moments": "only {both} moments have both sensors, {needed} are needed ({why})",
    "few of a sensor": "the {sensor} is silent: {seen} of {all} frames have it, {needed} are needed",
    "silent": "{sensor} is silent: the day has no {what} of it",
    "no labels": "{fault}, {camera}: {pair} needs {what}",
    "cause": "most often {cause}, {times} times",
    "no observations": "no observations of this day: ingest or perceive refused it, or did not run",
    "no images": "no frames of this day: {method} looks at images and sweeps, not at observations alone",
    "needs all": "method {method} needs camera, lidar and radar: {why}",
    "needs three": "method {method} works on a camera, a lidar and a radar that share a view: {why}",
    "lacks": "the rig has no {kind}",
    "no three": "the rig has no such three",
    "not these": "{some} and {last} do not: name others as `three` of the rig",
    "few of a camera": "camera-lidar needs {needed} frames of one camera, the day has {used}",
    "few static": "lidar-radar needs {needed} frames with static detections, the day has {used}",
    "few common": "two lidars need {needed} moments that both see, the day has {used}",
    "few image pairs": "{used} pairs of images determine the motion of {camera}, {needed} are required",
    "few edges": "camera-lidar: hardly any depth edges in the camera's field of view",
    "few surfaces": "{edge}: only {share:.0%} of one lidar's points lie on surfaces of the other",
    "no motion": "no source except {sensor} measures the car's motion",
    "no motion, backwards": "no source except {sensor} measures the car's motion: the car drives backwards by {others}",
    "few tracks": "too few moving objects: {paired} pairs of tracks, needs {needed} ({lidar} tracks of the lidar, "
    "{other} of the {sensor})",
    "no tracks": "no moving objects in the lidar ({other} tracks of the {sensor})",
    "tracks differ": "only {kept} of {all} pairs of tracks agree, needs {needed}",
    "not triggered": "not triggered: the prior stays",
    # Checks of the whole day.
    "few scenes": "too few scenes: {used} frames show {scenes}, needs {needed}",
    "far position": "by this day alone the position is {shift:+.2f} +- {sigma:.2f} m off the prior ({axis}), whose "
    "sigma is {prior:g} m: measure the mounting",
    "far camera": "by its motion {camera} is {deg:.1f} deg off the prior, beyond the search range; the search began "
    "there",
    "far clock": "the stamps are apart by {shift:+.0f} ms, far beyond time_offset_sigma_s ({sigma:.0f} ms): "
    "synchronise the clocks, or raise time_offset_sigma_s",
    "other clock": "frames align far better with stamps moved by {shift:+.0f} ms, far beyond time_offset_sigma_s "
    "({sigma:.0f} ms): synchronise the clocks, or raise time_offset_sigma_s",
    "moved": "{axis} turned by about {step:+.2f} deg ({sigmas:.1f} sigma) within the day, between {first} and {last} "
    "UTC: the {sensor} moved",
    "moved, other": "the {sensor} moved during the day, as {edge} shows",
    "labels": "labels are offset from their image: in the middle the image is {right} label px right of and {down} px "
    "below its labels; {more_right} px more at the right border, {more_down} px more at the lower one (check padding, "
    "resizing and the image that the segmenter was given)",
    "labels moved": "{reason}; the offset was removed{effect}",
    "focal length": "CameraInfo's focal length is contradicted by the day: measured {off:+.1%} +- {sigma:.1%}",
    "principal point": "CameraInfo's principal point is contradicted by the day: measured {right} px right, {down} px "
    "down: the pose is turned by so much",
    # Sources of the car's motion, and axes.
    "speed": "{source} agrees with {other} in {share:.0%} of the moving frames, and shows {ratio:+.2f} times the "
    "speed: {hint}",
    "turning": "odometry turns {ratio:+.2f} times as fast as the lidar's sweeps: {hint}",
    "lag": "odometry is {lag:.0f} ms {order} the radar's Doppler: check the stamps of both",
    "fits": "{fits} fits",
    "scale": "its scale is wrong",
    "doppler sign": "{hint} (doppler_positive in fleet.toml, or the transform if it is turned by 180 deg)",
    "backwards": "by the radar's Doppler the car drives backwards: {hint}",
    "radar backwards": "by the Doppler of {sensor} the car drives backwards, by other sources it does not: correct "
    "doppler_positive in fleet.toml, or the transform if it is turned by 180 deg",
    "lidar backwards": "by odometry and Doppler the lidar drives backwards: its x must point ahead",
    "no velocity": "no velocity of the radar explains {silent} of {all} scans: check doppler_field, its unit, and "
    "doppler_period_mps",
    "axes": "{met:.0%} of the radar's detections match the lidar if {how}, {given:.0%} as given: correct its axes or "
    "its transform",
    "mirrored": "{camera} turns right where the car turns left: a mirrored image, or a yaw rate of the wrong sign",
    # The solution: other minima, parts that contradict each other.
    "other minimum": "another minimum of the search fits the frames as well: {off:.1f} deg from the best one "
    "({origin}), {z:.1f} standard errors behind",
    "no minimum": "no minimum of the search is significant: the best one ({origin}) scores {total:.0f}, chance alone "
    "{needed:.0f}",
    "term": "{term} contradict the best minimum of the search ({origin}): they fit another pose",
    "border": "the minimum lies at the border of the search range",
    "other start": "a search from another start ends at another pose with as many matching points",
    "parts": "the evidence disagrees on {axis}: {a}, {b}",
    "radar pitch": "sources of radar pitch contradict each other ({sources}): its sigma is multiplied by {factor:.1f}",
    "height": "the road shows a height {off:+.0f} cm off the measured one",
    # The verdict: held-out frames, the prior, the limits.
    "none held out": "the day has too few frames to hold any out, so the result is not checked",
    "few held out": "too few held-out frames to judge: {used}, needs {needed}",
    "worse": "held-out frames align worse than at the prior ({after:.4g} after {before:.4g}, z = {z:.1f})",
    "not better": "{axis} moved by {ratio:.1f} of its sigmas, but held-out frames do not align better (z = {z:.1f})",
    "elsewhere": "held-out frames, more than those of the fit, align better at another pose: {azimuth:.2f} deg in "
    "azimuth and {elevation:.2f} deg in elevation away (z = {z:.1f})",
    "far turn": "the result is {off:.1f} deg off the prior, beyond the search range",
    "far shift": "the result is {off:.2f} m off the prior, beyond the search range",
    "far": "{axis} moved by {ratio:.1f} sigmas of the prior",
    "prior right": "the prior is right",
    "claim": "{direction}: {reason}",
    "too large": "its sigma of {sigma:.2f} deg is too large for the limit of {limit:.2f} deg at {percent:.3g} %",
    "exceeded": "held-out frames put it {off:.2f} deg off, and {reason}",
    "uncertified": "{direction} not certified: {reason}",
    "not certified": "{reason}: {directions} not certified",
    "sized": "{reason}: {size} deg at the targets, {limit}",
    "within": "within the limit",
    "beyond": "not within the limit",
    "composed": "it is composed of a pair that is not accepted",
    "no view": "{parent} and {child} see no direction in common at the prior: nothing to certify",
    "undetermined": "not determined by the day: {axes}",
    "nothing": "the day determines no degree of freedom",
    # The rig: edges together, and the pose of each sensor.
    "contradicts": "{edge} contradicts the other edges by {sigmas:.1f} sigmas",
    "contradicts, or": "{edge} contradicts the other edges by {sigmas:.1f} sigmas; it or {others} is wrong",
    "edges": "{edges} contradict each other: undecided which is wrong",
    "other edges": "{edge} and the other edges",
    "of its edges": "its edges contradict each other, undecided which is wrong: {edges}",
    "prior wrong": "it depends on the prior pose of {sensor}, which {edge} contradicts",
    "reference": "it is the reference of all poses",
    "no evidence": "no edge of the rig has evidence",
    "no prior": "its prior pose is unknown",
    "no edge": "it shares no view with another sensor",
    "none used": "none of its edges can be used: {edges}",
    "untied": "no usable edge joins it and {sensors} to the reference {reference}: it stays at the prior",
    "at prior": "the day determines no degree of freedom: the pose stays at the prior",
    # Notes: what the day leaves open, and what the result assumes.
    "rigid": "sensors are rigid over the day",
    "rigid, tested": "sensors are rigid over the day (tested: its first and its last part differ by {sigmas:.1f} "
    "sigma)",
    "clocks": "clocks keep their offsets and scales over the day",
    "camera as logged": "camera intrinsics as logged: a focal length 0.1 % off moves the image's edge by {edge:.2f} "
    "deg; a principal point 1 px off has the effect of a camera turned by {turn:.2f} deg",
    "in the image": "azimuth and elevation are directions in the image with CameraInfo's principal point. As a "
    "mounting, that point adds a sigma of {yaw:.2f} deg of yaw and {pitch:.2f} deg of pitch (from {source})",
    "centre stated": "centre_sigma_px and the day",
    "centre by day": "the day, without centre_sigma_px",
    "off CameraInfo": "difference from CameraInfo by the day alone: focal length {focal:+.1%} +- {sigma:.1%}, "
    "principal point {right} px to the right, {down} px down",
    "readout": "image rows are exposed within {ms:.0f} ms (readout_s); a day does not measure this",
    "unchecked": "no road users were detected: neither boxes nor a radar confirm the pose",
    "camera clock": "camera time offset: the day's speeds do not determine it",
    "no shift": "translation stays at the prior",
    "azimuth open": "azimuth is not determined: another rotation matches {share:.0%} as many moving clusters to boxes",
    "at the prior": "not determined by this day, kept at the prior: {axes}",
    "no clock": "time offset: not determined by this day; the constant gap of its stamps is kept",
    "clock unsure": "time offset known to {ms:.0f} ms only: at constant speed a shift in x has the same effect",
    "no boxes": "vehicle boxes are not used: roll and pitch depend on the registration and the prior",
    "parallel": "radar pitch assumes that the car drives parallel to the road that the lidar sees under it",
    "mirror images": "{share:.0%} of the detections of low objects lie between the object and its mirror image in the "
    "road; radar pitch allows for them, with a sigma of {sigma:.2f} deg",
    "own elevation": "pitch is the direction of the radar's detections: its mounting differs by the radar's own "
    "constant elevation error (0 +- {sigma:.2f} deg)",
    "no elevation": "the radar measures no elevation: azimuth and range only, roll and pitch are the prior's",
    "range bias": "range bias {bias:+.3f} +- {sigma:.3f} m (prior 0 +- {prior:.2f})",
    "below conditions": "the paper's frame conditions hold for {passed} frames of {pair}; {below} of the {used} frames "
    "used are below them",
    "no uncertainty": "the paper gives no uncertainty: block sandwich of its loss plus a bias floor from simulation",
    "polished": "started by {method}, finished by joint",
    "rotation only": "only the rotation is calibrated, as in the source; the translation keeps the prior",
    "tracks agree": "{kept} of {all} pairs of tracks agree",
    "tracks fit": "the prior is consistent with the tracks: {statistic:.1f}, threshold {threshold:.1f}",
    "tracks deny": "the prior is miscalibrated: {statistic:.1f}, threshold {threshold:.1f}",
    "over lidar": "composed over the lidar, the reference sensor",
    # Of an edge to the vehicle's frame, or between two lidars.
    "camera base, yaw": "yaw and pitch to the base: too few images show the direction of travel",
    "camera base, roll": "roll to the base: the car hardly turns, or nothing shows its speed",
    "camera base, clock": "clock against the base: the car hardly begins or ends a turn",
    "camera base, shift": "x, y, z to the base: motion has no scale",
    "radar base, yaw": "yaw to the base: too few scans determine the direction of travel",
    "radar base, pitch": "pitch to the base: no lidar shares the radar's view",
    "radar base, clock": "clock against the base: the car hardly changes its speed",
    "radar base, rest": "roll, x, y, z to the base: the motion does not determine them",
    "lidar base, yaw": "yaw to the base: no pair of sweeps determines the motion",
    "lidar base, road": "{axis} to the base: too little road is seen",
    "lidar base, shift": "x, y to the base: neither road nor motion determines them",
    "lidar clocks": "clocks of both lidars: the car drives too slowly to determine them",
    # What to drive next time.
    "drive faster": "drive faster than {speed:.0f} m/s: slower frames do not determine time offsets",
    "drive, radar": "drive in traffic: the radar hardly sees moving road users",
    "drive, camera": "drive in traffic: the images hardly show road users",
    "drive on": "drive some 100 m further: the frames show the same street from the same place",
    "no drive": "no drive determines roll, pitch and height of this radar: it measures no elevation",
    "drive where": "drive where there are {what}: the frames show none",
    "drive where, some": "drive where there are {what} {where}: the frames hardly show any",
}
because = sentences_of(REASONS)
