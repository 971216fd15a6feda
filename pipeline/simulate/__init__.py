"""A synthetic fleet with exact truth, made from what roads and sensors do; the estimator never imports it.

World: roads, scenery and traffic as triangle meshes, functions of a seed and of time (drives, traffic, scenery, props,
actors, materials), hit by rays at each ray's own time (casting). Sensors: camera, semantics, lidar, radar on a rig with
mounting errors (rigs, faults). Output: logs in three containers, fleet.toml and truth (recording, logs, fleet,
reflectors). Not modelled: rain, fog, dirt on lenses, rolling shutter, several radars that disturb one another.
"""
