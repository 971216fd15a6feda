"""Method `joint`: the best direct optimisation here."""
