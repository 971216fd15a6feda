"""Pages of a fleet, as a night draws them."""

from pathlib import Path

from pipeline.core.config import FleetConfig
from pipeline.report.fleet_page import render_fleet_page
from pipeline.report.upkeep import Album
from pipeline.report.verdicts import read_verdicts
from pipeline.report.window import read_window
from pipeline.store.files import LocalFiles
from pipeline.store.partitions import Lake, last_possible_day


def write_fleet_page(lake: Lake, fleet: FleetConfig, out: Path) -> str:
    """The page of the whole fleet alone, without pages of its days."""
    album = Album(lake, fleet, fleet.audit.method, out, LocalFiles())
    window = read_window(lake, album.method, fleet.audit.window_days, last_possible_day())
    render_fleet_page(album, window, read_verdicts(lake, album.method), ())
    return out.read_text()
