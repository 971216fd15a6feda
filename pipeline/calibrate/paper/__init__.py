"""The paper's direct optimisation: pairwise, then joint under the loop."""
