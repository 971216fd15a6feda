"""One solve over a rig's graph: poses and clocks of all sensors from the evidence of their edges."""
