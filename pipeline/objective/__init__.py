"""What is minimised: one definition that solvers and learning share."""
