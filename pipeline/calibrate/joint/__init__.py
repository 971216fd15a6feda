"""Method `joint`: camera-lidar and lidar-radar by direct optimisation, camera-radar composed of them."""
