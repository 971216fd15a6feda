"""A synthetic fleet with exact truth, from models of roads and sensors; the estimator never imports it.

World: roads, scenery and traffic as triangle meshes, functions of a seed and of time (drives, traffic,
scenery, props, actors, materials), ray-traced at each ray's own time (casting). Sensors: camera, semantics,
lidar, radar on a rig with mounting errors (rigs, faults). Output: logs in three containers, fleet.toml and
truth (recording, logs, fleet, reflectors). Not modelled: rain, fog, dirt on lenses, interference between
radars.
"""
