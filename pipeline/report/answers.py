"""The first sentences of all pages, as one list; fields are filled where the page is made."""

__all__ = ["ANSWERS"]

# First sentences of pages. Of a day: may its numbers go on the car?
ANSWERS = {
    "moved since": "Not any more. The {sensor} moved on {since}, after this day.",
    "moved since, others": " Only {titles} still holds.",
    "moved, accepted": "Only {titles} may be used.",
    "moved": "{first} The {sensor} moved on {since}, this day was not accepted: no calibration of {titles} is valid.",
    "nothing": "No. Nothing was accepted: keep the transforms that the car has.",
    "all": "Yes. All {what} are accepted: they may go on the car, with the sigmas below.",
    "partly": "Partly. Accepted: {titles}. Keep what the car has for {others}.",
    # Of a day that shows tonight's state: may it be loaded?
    "state, nothing": "No. Nothing in tonight's state is certified: keep what the car has.",
    "state, all": "Yes. Load tonight's state: all sensors are certified.",
    "state, all in one": "Yes. Load tonight's state: all sensors are certified, in azimuth or elevation at least.",
    "state, partly": "Partly. Load tonight's state. Certified: {titles}.",
    "used": " Used, but not certified: {titles}.",
    "at prior": " At the prior: {titles}.",
    "in one": " Certified in {one} only: {titles}.",
    # Of the fleet: did a sensor move?
    "no audit": "No audit yet: run `boresight audit`.",
    "GREEN": "No sensor moved on {vehicles}.",
    "UNKNOWN": "No change found, but on {vehicles} more days are required to exclude one above the limit.",
    "RED": "A sensor moved on {vehicles}: {named}.",
    "YELLOW": "A sensor may have moved on {vehicles}: {named}.",
    "YELLOW too": " A sensor may have moved on {more} more.",
    # Of the calibration in use: is it right?
    "right": "Yes, within the limits",
    "wrong": "No",
    "inconclusive": "Undecided: this log is not sufficient",
    "wrong sensor": "Wrong: {error}.",
    "open": "This log does not determine: {axes}.",
    "passes": "Every axis that is judged passes.",
}
