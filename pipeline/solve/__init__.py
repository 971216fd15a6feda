"""How it is minimised: selection, triggers, solvers, covariance."""
