"""The static world along a road, made chunk by chunk, so that a drive of any length needs no memory."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.simulate.world.chunk import Chunk
from pipeline.simulate.world.drives import Drive
from pipeline.simulate.world.meshes import Mesh, join
from pipeline.simulate.world.motorway import add_motorway
from pipeline.simulate.world.plots import add_halls, add_plots, add_rows
from pipeline.simulate.world.road_surface import add_asphalt
from pipeline.simulate.world.street import add_street

__all__ = ["chunk_mesh"]


def chunk_mesh(drive: Drive, index: int) -> Mesh:
    """The static world between arc lengths `index * CHUNK_M` and `(index + 1) * CHUNK_M`, in the map."""
    chunk = Chunk(drive, index, np.random.default_rng([drive.seed, 31, index + 1000]))
    add_asphalt(chunk)
    if drive.landscape.ceiling_m:
        add_halls(chunk)
    elif drive.landscape.fast:
        add_motorway(chunk)
    elif drive.landscape.plain:
        add_street(chunk)
    else:
        add_plots(chunk)
    if not drive.landscape.plain:
        add_rows(chunk)
    flat = chunk.along.mesh()
    bent = drive.road.to_map(flat.corners.astype(np.float64)).astype(np.float32)
    return join([replace(flat, corners=bent), *chunk.rigid])
