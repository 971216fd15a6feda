"""Every reason that charts, vehicles and states give, as one list; fields are filled where the reason is given."""

from schemas.words import sentences_of

__all__ = ["REASONS", "because"]

REASONS = {
    # Of a chart: a change, or none.
    "lasting": "a lasting change above the limit",
    "lasting, held": "a lasting change above the limit; depends on days whose calibration was held",
    "small": "a change below the limit",
    "one day": "one day differs: the next day decides whether the change lasts",
    "few days": "two days differ, as single days of this fleet often do: the next day decides whether the change lasts",
    "maybe": "a change that may be above the limit: the next days decide",
    "begun": "a change may have begun: the next days decide",
    "same": "no change",
    "back": "back at the reference",
    # Of a chart: what it lacks.
    "few": "{days} of data, {needed} required",
    "hidden": "a change below {visible} would not be noticed yet (limit {limit}); about {more} required",
    "no estimate": "no estimate in the window ({counts}), {needed} days required",
    "no record": "no record in the window, {needed} days required",
    "ended": "{reason}; no estimate after {day}",
    "determined on": "determined on {used} of {days} days: {reason}",
    "since work": "since the {event}",
    "fleet": "less the change of {some} of {all} vehicles since {day}",
    "no common days": "the pairs have no common days before and after",
    # Of a vehicle.
    "no day": "undecided: no day has data",
    "GREEN": "no sensor moved: {clear} of {all} charts exclude a change above the limit",
    "GREEN, but few": "no sensor moved: {clear} of {all} charts exclude a change above the limit, enough to exclude a "
    "rotation of any sensor; {few} have too little data",
    "UNKNOWN": "undecided whether {names} turned; {chart}; {few} of {all} charts have too little data",
    "UNKNOWN, one day": "undecided: {reason}",
    "moved": "the {sensor} moved on {day}",
    "moved, unnamed": "a sensor moved on {day}, undecided which",
    "drifts": "the {sensor} has been drifting since {day}",
    "damaged": "some of its records cannot be read",
    "kept": "kept, because some of its records cannot be read",
    # Of a state.
    "reference": "it is the reference of all poses",
    "after work": "after the {event}",
    "since": "since {day}: {sensor} moved",
    "since, unnamed": "since {day}: {sensor} moved, undecided which",
    "changed": "its pose changed on {day}",
    "moved in day": "since it or {other} moved during {day}",
    "moved in day, drive": "it or {other} moved during {day}, and no later day is usable yet: drive",
    "held differs": "{day} was held and differs from the days before: the sensor may have moved",
    "differ": "not counted, because they differ from the later days: {days}",
    "other reference": "not counted, because their poses refer to another sensor: {days}",
    "no usable day": "no usable day {why}",
    "no pose": "no pose of {sensors} is known",
    "at prior": "{sensor} is at its prior: {reason}",
    "too large": "{direction} not certified: its sigma of {sigma:.2f} deg is too large for the limit of {limit:.2f} "
    "deg at {percent:.3g} %",
    "no records": "no calibration record in the window",
    "left out": "left out: {records}{more}",
}
because = sentences_of(REASONS)
